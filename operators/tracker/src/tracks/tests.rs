use nalgebra::{Translation3, UnitQuaternion};
use proptest::prelude::*;

use super::*;

const LIMITS: Limits = Limits {
    noise: Noise {
        position_m: 0.2,
        heading_rad: 0.05,
        velocity_mps: 1.0,
        speed_mps: 8.0,
        acceleration_mps: 2.0,
        turn_rps: 0.3,
    },
    gate: 3.5,
    max_distance_m: 4.0,
    min_hits: 3,
    filter_centers: false,
    max_gap: 600 * MS,
    coast: 0,
    max_tracks: 64,
};

const MS: Nanos = 1_000_000;

fn pose(x: f64, y: f64, yaw: f64) -> Isometry3<f64> {
    let rotation = UnitQuaternion::from_euler_angles(0.0, 0.0, yaw);
    Isometry3::from_parts(Translation3::new(1e5 + x, y, 12.0), rotation)
}

fn car(x: f64, y: f64, yaw: f64) -> Box3 {
    Box3::new("Car", [1e5 + x, y, 12.8], [4.5, 1.9, 1.6], yaw)
}

fn walker(x: f64, y: f64) -> Box3 {
    Box3::new("Pedestrian", [1e5 + x, y, 12.9], [0.7, 0.6, 1.7], 0.0)
}

/// Objects in `map`, as the frame sees them, after the tracks have followed them.
fn follow(
    tracks: &mut Tracks,
    stamp: Nanos,
    frame: &Isometry3<f64>,
    objects: &[Box3],
    limits: &Limits,
) -> (Vec<Box3>, Outcome) {
    let seen = frame.inverse();
    let mut boxes: Vec<Box3> = objects.iter().map(|object| transform_box(&seen, object)).collect();
    let outcome = tracks.follow(stamp, frame, &mut boxes, limits).unwrap();
    (boxes, outcome)
}

fn ids(boxes: &[Box3]) -> Vec<Option<u64>> {
    boxes.iter().map(|object| object.track).collect()
}

#[test]
fn the_senders_own_motion_is_no_motion_of_what_it_sees() {
    let mut tracks = Tracks::default();
    for sweep in 0..10 {
        let t = 0.1 * f64::from(sweep);
        // Driving and turning past a parked car and one that drives along the map's y.
        let frame = pose(14.0 * t, 0.3 * t, 0.5 * t);
        let objects = [car(20.0, 3.0, 0.4), car(30.0, 9.0 * t, std::f64::consts::FRAC_PI_2)];
        let (boxes, outcome) = follow(&mut tracks, sweep as Nanos * 100 * MS, &frame, &objects, &LIMITS);
        assert_eq!(ids(&boxes), [Some(1), Some(2)]);
        assert_eq!(
            (outcome.order, outcome.begun),
            (Order::Next, if sweep == 0 { 2 } else { 0 })
        );
        let velocities: Vec<bool> = boxes.iter().map(|object| object.velocity.is_some()).collect();
        assert_eq!(velocities, [sweep >= 2; 2], "from the third hit on");
        if sweep == 9 {
            let in_map = |object: &Box3| frame.rotation * Vector3::from(object.velocity.unwrap());
            assert!(in_map(&boxes[0]).norm() < 0.05, "{:?}", boxes[0].velocity);
            let off = in_map(&boxes[1]) - Vector3::new(0.0, 9.0, 0.0);
            assert!(off.norm() < 0.3, "{off}");
        }
    }
}

#[test]
fn nothing_but_identity_and_velocity_of_a_box_changes() {
    let mut tracks = Tracks::default();
    let frame = pose(3.0, -2.0, 0.7);
    for sweep in 0..4 {
        let mut object = car(10.0 + f64::from(sweep), 0.0, 0.1);
        (object.track, object.score) = (Some(77), 0.4);
        let before = transform_box(&frame.inverse(), &object);
        let (boxes, _) = follow(&mut tracks, Nanos::from(sweep) * 100 * MS, &frame, &[object], &LIMITS);
        let expected = Box3 {
            track: Some(1),
            velocity: boxes[0].velocity,
            ..before
        };
        assert_eq!(boxes, [expected]);
    }
}

#[test]
fn centres_of_tracks_are_nearer_to_the_objects_than_those_of_boxes() {
    let mut tracks = Tracks::default();
    let limits = Limits {
        filter_centers: true,
        ..LIMITS
    };
    let (mut seen, mut told) = (0.0, 0.0);
    for sweep in 0..40 {
        let t = 0.1 * f64::from(sweep);
        let frame = pose(2.0 * t, 0.0, 0.1 * t);
        // Centres that are up to 0.2 m off.
        let off = [0.2 * libm::sin(37.0 * t), 0.2 * libm::sin(53.0 * t + 1.0)];
        let object = walker(1.4 * t + off[0], off[1]);
        let (boxes, _) = follow(&mut tracks, sweep as Nanos * 100 * MS, &frame, &[object], &limits);
        let there = frame * Point3::from(boxes[0].center);
        assert!((there.z - 12.9).abs() < 1e-9);
        if sweep >= 10 {
            seen += libm::hypot(off[0], off[1]);
            told += libm::hypot(there.x - 1e5 - 1.4 * t, there.y);
        }
    }
    assert!(told < 0.6 * seen, "{told} and {seen}");
}

#[test]
fn those_who_pass_each_other_keep_their_identities() {
    let mut tracks = Tracks::default();
    for sweep in 0..30 {
        let t = 0.1 * f64::from(sweep);
        // Two cars in neighbouring lanes, and a walker between two walkers.
        let mut objects = vec![
            car(8.0 * t, 0.0, 0.0),
            car(24.0 - 8.0 * t, 3.0, std::f64::consts::PI),
            walker(1.4 * t, 9.0),
            walker(3.0 - 1.4 * t, 9.8),
        ];
        // The order of boxes says nothing.
        if sweep % 2 == 1 {
            objects.reverse();
        }
        let (mut boxes, _) = follow(
            &mut tracks,
            sweep as Nanos * 100 * MS,
            &pose(0.0, 0.0, 0.0),
            &objects,
            &LIMITS,
        );
        if sweep % 2 == 1 {
            boxes.reverse();
        }
        assert_eq!(ids(&boxes), [1, 2, 3, 4].map(Some), "sweep {sweep}");
    }
}

#[test]
fn who_is_hidden_for_a_while_comes_back_and_who_is_longer_gone_does_not() {
    let drive = |hidden: std::ops::Range<i32>| {
        let mut tracks = Tracks::default();
        let mut last = None;
        for sweep in (0..20).filter(|sweep| !hidden.contains(sweep)) {
            // Another car is always there, so that there is no gap in the stream.
            let objects = [car(-50.0, 9.0, 0.0), car(f64::from(sweep), 0.0, 0.0)];
            last = Some(
                follow(
                    &mut tracks,
                    Nanos::from(sweep) * 100 * MS,
                    &pose(0.0, 0.0, 0.0),
                    &objects,
                    &LIMITS,
                )
                .0,
            );
            for between in hidden.clone().filter(|_| sweep + 1 == hidden.start) {
                let stamp = Nanos::from(between) * 100 * MS;
                follow(&mut tracks, stamp, &pose(0.0, 0.0, 0.0), &objects[..1], &LIMITS);
            }
        }
        ids(&last.unwrap())
    };
    assert_eq!(drive(6..10), [Some(1), Some(2)], "400 ms");
    assert_eq!(drive(6..13), [Some(1), Some(3)], "700 ms");
}

#[test]
fn stamps_decide_what_is_followed() {
    let mut tracks = Tracks::default();
    let at = |tracks: &mut Tracks, ms: Nanos| {
        let mut object = car(0.0, 0.0, 0.0);
        object.track = Some(9);
        let (boxes, outcome) = follow(tracks, ms * MS, &pose(0.0, 0.0, 0.0), &[object], &LIMITS);
        (outcome.order, boxes[0].track)
    };
    let steps = [
        (1000, Order::Next, 1),
        (1100, Order::Next, 1),
        (1100, Order::Repeated, 9),
        (1000, Order::Late, 9),
        (500, Order::Late, 9),
        (1200, Order::Next, 1),
        (1800, Order::Next, 1),
        (2401, Order::Gap, 2),
        (1800, Order::Restart, 3),
        (1900, Order::Next, 3),
    ];
    for (ms, order, track) in steps {
        assert_eq!(at(&mut tracks, ms), (order, Some(track)), "{ms} ms");
    }
    for wild in [Nanos::MIN, Nanos::MAX, Nanos::MIN, 0] {
        let (order, _) = at(&mut tracks, wild / MS);
        assert!(matches!(order, Order::Gap | Order::Restart), "{order:?}");
    }
}

#[test]
fn a_car_is_not_paired_with_a_walker_but_with_a_van_that_is_as_long() {
    let mut tracks = Tracks::default();
    let van = |x| Box3 {
        class: "Van".into(),
        length: 5.5,
        ..car(x, 0.0, 0.0)
    };
    let still = pose(0.0, 0.0, 0.0);
    let mut step =
        |sweep: Nanos, object: Box3| ids(&follow(&mut tracks, sweep * 100 * MS, &still, &[object], &LIMITS).0);
    assert_eq!(step(0, car(0.0, 0.0, 0.0)), [Some(1)]);
    assert_eq!(step(1, walker(0.0, 0.0)), [Some(2)]);
    assert_eq!(step(2, van(0.0)), [Some(1)]);
}

#[test]
fn tracks_are_bounded_and_the_best_boxes_have_them() {
    let mut tracks = Tracks::default();
    let limits = Limits {
        max_tracks: 3,
        ..LIMITS
    };
    let mut objects: Vec<Box3> = (0..10).map(|i| car(20.0 * f64::from(i), 0.0, 0.0)).collect();
    for (object, score) in objects
        .iter_mut()
        .zip([0.1, 0.2, 0.9, 0.3, 0.8, 0.1, 0.2, 0.7, 0.0, 0.1])
    {
        object.score = score;
    }
    let (boxes, outcome) = follow(&mut tracks, 0, &pose(0.0, 0.0, 0.0), &objects, &limits);
    let tracked: Vec<usize> = (0..10).filter(|index| boxes[*index].track.is_some()).collect();
    assert_eq!((tracked, outcome.begun, outcome.untracked), (vec![2, 4, 7], 3, 7));
    // Others are better now, but the old tracks are not over.
    objects[9].score = 1.0;
    let (boxes, outcome) = follow(&mut tracks, 100 * MS, &pose(0.0, 0.0, 0.0), &objects, &limits);
    assert_eq!(
        (outcome.paired, outcome.begun, outcome.untracked, boxes[9].track),
        (2, 0, 8, None)
    );
    assert_eq!(tracks.len(), 3);
}

#[test]
fn what_no_object_can_be_has_no_track() {
    let mut tracks = Tracks::default();
    let mut wrong = car(0.0, 0.0, 0.0);
    wrong.center[0] = f64::NAN;
    let mut fast = car(30.0, 0.0, 0.0);
    fast.velocity = Some([5000.0, 0.0, 0.0]);
    let (boxes, outcome) = follow(
        &mut tracks,
        0,
        &pose(0.0, 0.0, 0.0),
        &[wrong, fast, car(9.0, 0.0, 0.0)],
        &LIMITS,
    );
    assert_eq!((ids(&boxes), outcome.untracked), (vec![None, None, Some(1)], 2));
}

#[test]
fn only_who_is_asked_to_coasts() {
    let run = |coast| {
        let mut tracks = Tracks::default();
        let limits = Limits { coast, ..LIMITS };
        let mut counts = Vec::new();
        for sweep in 0..12 {
            let object = car(f64::from(sweep), 0.0, 0.0);
            let objects = if sweep < 6 { vec![object] } else { vec![] };
            let (_, outcome) = follow(
                &mut tracks,
                Nanos::from(sweep) * 100 * MS,
                &pose(0.0, 0.0, 0.0),
                &objects,
                &limits,
            );
            counts.push(outcome.coasted);
        }
        counts
    };
    assert!(run(0).iter().all(Vec::is_empty));
    let coasted = run(300 * MS);
    let counts: Vec<usize> = coasted.iter().map(Vec::len).collect();
    assert_eq!(counts, [0, 0, 0, 0, 0, 0, 1, 1, 1, 0, 0, 0]);
    let there = &coasted[8][0];
    assert!(
        (there.center[0] - 8.0).abs() < 0.2 && there.track == Some(1),
        "{there:?}"
    );
    assert!(there.score < coasted[6][0].score && there.score > 0.0);
}

#[test]
fn a_velocity_that_a_box_brings_is_where_its_track_begins() {
    let mut tracks = Tracks::default();
    let frame = pose(0.0, 0.0, 1.0);
    let mut object = car(0.0, 0.0, 0.0);
    object.velocity = Some([15.0, 0.0, 0.0]);
    let (boxes, _) = follow(&mut tracks, 0, &frame, &[object.clone()], &LIMITS);
    let kept = frame.rotation * Vector3::from(boxes[0].velocity.unwrap());
    assert!((kept - Vector3::new(15.0, 0.0, 0.0)).norm() < 1e-9);
    // A gap of two sweeps, in which it went beyond what a track of unknown speed would take.
    let (boxes, outcome) = follow(&mut tracks, 300 * MS, &frame, &[car(4.5, 0.0, 0.0)], &LIMITS);
    assert_eq!((outcome.paired, boxes[0].track), (1, Some(1)));
}

proptest! {
    #[test]
    fn identities_are_never_twice_in_a_message_and_never_come_again_to_another(
        sweeps in proptest::collection::vec(
            (-700i64..900, proptest::collection::vec((-30.0..30.0f64, -30.0..30.0f64, 0u8..3), 0..12)), 1..25,
        ),
    ) {
        let mut tracks = Tracks::default();
        let limits = Limits { max_tracks: 8, ..LIMITS };
        let (mut stamp, mut newest) = (0, 0);
        for (step, places) in sweeps {
            stamp += step * MS;
            let objects: Vec<Box3> = places.iter().map(|(x, y, kind)| match kind {
                0 => walker(*x, *y),
                _ => car(*x, *y, 0.1 * x),
            }).collect();
            let (boxes, outcome) = follow(&mut tracks, stamp, &pose(0.0, 0.0, 0.3), &objects, &limits);
            let mut known: Vec<u64> = boxes.iter().filter_map(|object| object.track).collect();
            known.sort_unstable();
            prop_assert!(known.windows(2).all(|two| two[0] < two[1]), "{:?}", known);
            let begun = known.iter().filter(|id| **id > newest).count() as u64;
            if matches!(outcome.order, Order::Next | Order::Gap | Order::Restart) {
                prop_assert_eq!(outcome.begun, begun);
                prop_assert_eq!(outcome.paired + outcome.begun + outcome.untracked, objects.len() as u64);
                prop_assert_eq!(known.len() as u64, outcome.paired + outcome.begun);
            }
            newest = known.last().copied().unwrap_or(newest).max(newest);
            prop_assert!(tracks.len() <= 8);
            prop_assert!(boxes.iter().flat_map(|object| object.velocity.iter().flatten()).all(|v| v.is_finite()));
        }
    }
}
