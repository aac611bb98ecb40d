//! Frames and boxes by hand: values that a sheet of paper gives, edges, and the same bits on every machine.

use std::f64::consts::{FRAC_PI_2, PI, TAU};

use nalgebra::{Isometry3, Point3, UnitQuaternion, Vector3};
use realo_schemas::geometry::{Motion, *};
use realo_schemas::*;

const MS: Nanos = 1_000_000;

fn object(x: f64, y: f64, yaw: f64) -> Box3 {
    Box3 {
        center: [x, y, 1.0],
        length: 4.0,
        width: 2.0,
        height: 1.5,
        yaw,
        velocity: None,
        class: "Car".into(),
        score: 0.5,
        track: None,
        covariance: None,
    }
}

fn pose(x: f64, y: f64, yaw: f64) -> Isometry3<f64> {
    Isometry3::new(Vector3::new(x, y, 0.0), Vector3::new(0.0, 0.0, yaw))
}

#[track_caller]
fn near(found: impl AsRef<[f64]>, expected: impl AsRef<[f64]>) {
    let (found, expected) = (found.as_ref(), expected.as_ref());
    let close = found.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-9);
    assert!(
        found.len() == expected.len() && close,
        "{found:?}, expected {expected:?}"
    );
}

#[test]
fn yaw_is_wrapped_to_half_a_turn_either_way() {
    let cases = [
        (0.0, 0.0),
        (PI, PI),
        (-PI, PI),
        (3.0 * PI, PI),
        (PI + 0.5, 0.5 - PI),
        (-PI - 0.5, PI - 0.5),
        (2.5 * TAU + 1.0, 1.0 - PI),
        (-7.0, TAU - 7.0),
    ];
    for (yaw, expected) in cases {
        near([normalize_yaw(yaw)], [expected]);
    }
    assert!(normalize_yaw(-PI) > 0.0, "half a turn has one name");
}

#[test]
fn frames_are_related_through_the_map() {
    let (ego, sender) = (pose(10.0, 5.0, FRAC_PI_2), pose(10.0, 25.0, PI));
    let ego_from_sender = relative(&ego, &sender);
    // 20 m ahead of the ego; what lies ahead of the sender (towards -x of the map) lies to the ego's left.
    near(ego_from_sender.translation.vector, [20.0, 0.0, 0.0]);
    near([yaw_of(&ego_from_sender.rotation)], [FRAC_PI_2]);
    let tilted = UnitQuaternion::from_euler_angles(0.1, -0.2, 2.0);
    near([yaw_of(&tilted)], [2.0]);
}

#[test]
fn a_box_is_moved_with_all_that_it_knows() {
    let known = Box3 {
        velocity: Some([3.0, 1.0, 0.5]),
        covariance: Some([4.0, 0.5, 0.1, 0.5, 1.0, 0.2, 0.1, 0.2, 9.0]),
        ..object(2.0, 1.0, 0.25)
    };
    let moved = transform_box(&pose(100.0, 50.0, FRAC_PI_2), &known);
    near(moved.center, [99.0, 52.0, 1.0]);
    near([moved.yaw], [FRAC_PI_2 + 0.25]);
    near(moved.velocity.unwrap(), [-1.0, 3.0, 0.5]);
    // x and y change places, and what ties them changes sign.
    near(
        moved.covariance.unwrap(),
        [1.0, -0.5, -0.2, -0.5, 4.0, 0.1, -0.2, 0.1, 9.0],
    );
    assert_eq!(
        (moved.length, moved.width, moved.height, moved.score),
        (known.length, known.width, known.height, known.score)
    );
    let bare = transform_box(&pose(0.0, 0.0, 1.0), &object(0.0, 0.0, 0.0));
    assert_eq!((bare.velocity, bare.covariance), (None, None));
}

#[test]
fn corners_go_round_from_front_left() {
    let corners = bottom_corners(&object(10.0, 5.0, FRAC_PI_2));
    near(corners.concat(), [9.0, 7.0, 11.0, 7.0, 11.0, 3.0, 9.0, 3.0]);
    let of_footprint = Footprint::of(&object(10.0, 5.0, FRAC_PI_2)).corners();
    near(of_footprint.concat(), corners.concat());
}

#[test]
fn a_footprint_contains_its_edges() {
    let car = object(10.0, 5.0, 0.0);
    for (point, inside) in [
        ([12.0, 6.0], true),
        ([8.0, 4.0], true),
        ([12.001, 5.0], false),
        ([7.999, 5.0], false),
        ([10.0, 6.001], false),
        ([10.0, 3.999], false),
    ] {
        assert_eq!(footprint_contains(&car, point), inside, "{point:?}");
    }
    let turned = object(10.0, 5.0, FRAC_PI_2);
    assert!(footprint_contains(&turned, [10.5, 6.9]) && !footprint_contains(&turned, [11.5, 5.0]));
    let diagonal = object(0.0, 0.0, PI / 4.0);
    assert!(footprint_contains(&diagonal, [1.3, 1.3]) && !footprint_contains(&diagonal, [1.3, -1.3]));
}

#[test]
fn a_valid_box_is_finite_has_extents_and_a_score() {
    let good = object(1.0, 2.0, 3.0);
    assert!(is_valid(&good));
    for score in [0.0, 1.0] {
        assert!(is_valid(&Box3 { score, ..good.clone() }));
    }
    let changes: [fn(&mut Box3); 9] = [
        |b| b.center[2] = f64::NAN,
        |b| b.yaw = f64::INFINITY,
        |b| b.length = 0.0,
        |b| b.width = -1.0,
        |b| b.height = 0.0,
        |b| b.height = f64::INFINITY,
        |b| b.score = 1.001,
        |b| b.score = -0.001,
        |b| b.score = f32::NAN,
    ];
    for (index, change) in changes.iter().enumerate() {
        let mut bad = good.clone();
        change(&mut bad);
        assert!(!is_valid(&bad), "change {index}");
    }
}

#[test]
fn a_plausible_box_is_no_farther_and_no_larger_than_anything_that_is_seen() {
    let good = object(1.0, 2.0, 3.0);
    let at = |x: f64| Box3 {
        center: [x, 0.0, 0.0],
        ..good.clone()
    };
    assert!(is_plausible(&at(10_000.0)) && is_valid(&at(10_001.0)) && !is_plausible(&at(-10_001.0)));
    let long = |length: f64| Box3 { length, ..good.clone() };
    assert!(is_plausible(&long(100.0)) && !is_valid(&long(100.1)));
    assert_eq!(box_fault(&good), None);
    for (bad, words) in [
        (at(1e30), "a distance of 1.000e30 m"),
        (at(1e300), "a distance of inf m"),
        (at(f64::NAN), "not finite"),
        (long(0.0), "a size of 0.000 × 2.000 × 1.500 m"),
        (long(1e30), "a size of 1.000e30 × "),
        (
            Box3 {
                score: 1.5,
                ..good.clone()
            },
            "a score of 1.5",
        ),
    ] {
        let said = box_fault(&bad).unwrap_or_default();
        assert!(!is_plausible(&bad) && said.contains(words), "{said}");
    }
}

#[test]
fn a_region_contains_its_edges() {
    let region = Region {
        x: [-10.0, 20.0],
        y: [-5.0, 6.0],
    };
    for (point, inside) in [
        ([-10.0, -5.0], true),
        ([20.0, 6.0], true),
        ([20.5, 0.0], false),
        ([-10.5, 0.0], false),
        ([0.0, 6.5], false),
        ([0.0, -5.5], false),
    ] {
        assert_eq!(region.contains(point), inside, "{point:?}");
    }
    assert!(region.checked().is_ok());
    for x in [[1.0, 1.0], [2.0, 1.0], [f64::NEG_INFINITY, 1.0], [0.0, f64::INFINITY]] {
        assert!(
            Region { x, ..region }.checked().unwrap_err().contains("region's x"),
            "{x:?}"
        );
    }
}

#[test]
fn a_pose_between_two_turns_the_short_way() {
    let (a, b) = (pose(0.0, 10.0, 3.0), pose(4.0, 20.0, -3.0));
    let half = interpolate(&a, &b, 0.5);
    near(half.translation.vector, [2.0, 15.0, 0.0]);
    near([yaw_of(&half.rotation).abs()], [PI]);
    let quarter = interpolate(&a, &b, 0.25);
    near([yaw_of(&quarter.rotation)], [3.0 + (TAU - 6.0) / 4.0]);
    let beyond = interpolate(&pose(0.0, 0.0, 0.0), &pose(1.0, 2.0, 0.1), 2.0);
    near(beyond.translation.vector, [2.0, 4.0, 0.0]);
    near([yaw_of(&beyond.rotation)], [0.2]);
}

/// Poses every 100 ms, 1 m and 0.1 rad further each.
fn track(stamps: &[Nanos]) -> PoseTrack {
    let mut track = PoseTrack::new(1000 * MS, 150 * MS);
    for stamp in stamps {
        let step = *stamp as f64 / (100 * MS) as f64;
        track.insert(*stamp, pose(step, 0.0, 0.1 * step));
    }
    track
}

fn x_at(track: &PoseTrack, stamp: Nanos) -> Option<f64> {
    track.at(stamp).map(|pose| (pose.translation.x * 1e6).round() / 1e6)
}

#[test]
fn a_track_knows_poses_at_between_and_a_little_beyond() {
    let track = track(&[0, 100 * MS, 200 * MS]);
    let cases = [
        (-1_001, None),
        // Rounded by seconds in double precision.
        (-1_000, Some(0.0)),
        (0, Some(0.0)),
        (50 * MS, Some(0.5)),
        (200 * MS, Some(2.0)),
        (260 * MS, Some(2.6)),
        (350 * MS, Some(3.5)),
        (350 * MS + 1, None),
    ];
    for (stamp, expected) in cases {
        assert_eq!(x_at(&track, stamp), expected, "{stamp}");
    }
    assert_eq!(track.newest(), Some(200 * MS));
    assert_eq!(PoseTrack::new(MS, MS).newest(), None);
}

#[test]
fn a_gap_is_bridged_up_to_the_max() {
    let wide = |gap: Nanos| x_at(&track(&[0, gap]), gap / 2);
    assert_eq!(wide(150 * MS), Some(0.75));
    assert_eq!(wide(150 * MS + 2), None);
    // Nothing says how one pose goes on.
    assert_eq!(x_at(&track(&[0]), 1_001), None);
    assert_eq!(x_at(&track(&[0]), 0), Some(0.0));
}

#[test]
fn a_track_takes_poses_in_any_order_and_forgets_old_ones() {
    let mut unordered = track(&[200 * MS, 0, 100 * MS]);
    assert_eq!(x_at(&unordered, 150 * MS), Some(1.5));
    unordered.insert(100 * MS, pose(7.0, 0.0, 0.0));
    assert_eq!(x_at(&unordered, 100 * MS), Some(7.0), "the later word counts");
    unordered.insert(1000 * MS, pose(9.0, 0.0, 0.0));
    assert!(unordered.at(0).is_some(), "just as old as what is kept");
    unordered.insert(1001 * MS, pose(9.0, 0.0, 0.0));
    assert!(unordered.at(0).is_none() && unordered.at(100 * MS).is_some());
    unordered.insert(MS / 2, pose(9.0, 0.0, 0.0));
    assert!(unordered.at(MS / 2).is_none(), "older than what is kept");
}

#[test]
fn motion_is_that_of_the_neighbours() {
    let track = track(&[0, 100 * MS, 200 * MS]);
    for stamp in [-5, 0, 50 * MS, 100 * MS, 200 * MS, 900 * MS] {
        let (velocity, rate) = track.motion_at(stamp).unwrap();
        near(velocity, [10.0, 0.0, 0.0]);
        near(rate, [0.0, 0.0, 1.0]);
    }
    let mut bend = track.clone();
    bend.insert(300 * MS, pose(2.0, 3.0, 0.2));
    near(bend.motion_at(250 * MS).unwrap().0, [0.0, 30.0, 0.0]);
    near(bend.motion_at(200 * MS).unwrap().0, [10.0, 0.0, 0.0]);
    let of = |stamps: &[Nanos]| self::track(stamps).motion_at(0);
    assert!(of(&[]).is_none() && of(&[0]).is_none());
    assert!(of(&[0, 150 * MS]).is_some() && of(&[0, 150 * MS + 1]).is_none());
}

#[test]
fn a_sweep_is_straightened_between_knots_and_at_its_ends() {
    let track = track(&[0, 100 * MS, 200 * MS, 300 * MS]);
    let motion = Motion::new(&track, 150 * MS, -50 * MS, 50 * MS).unwrap();
    for time in [-50_000_000, -49_999_999, -1, 0, 1_500_000, 49_999_999, 50_000_000] {
        let found = motion.at_stamp([&[10.0], &[0.0], &[1.0]], &[time]).map(|axis| axis[0]);
        let [at, then] = [150 * MS, 150 * MS + Nanos::from(time)].map(|stamp| track.at(stamp).unwrap());
        let expected = relative(&at, &then) * Point3::new(10.0, 0.0, 1.0);
        let off = (Point3::from(found.map(f64::from)) - expected).norm();
        assert!(off < 1e-5, "{off} m at {time} ns");
    }
    assert!(Motion::new(&track, -1_001, 0, 0).is_none(), "no pose at the stamp");
    assert!(
        Motion::new(&track, 150 * MS, 0, Nanos::MAX).is_none(),
        "no time so late"
    );
}

#[test]
fn footprints_know_their_hull_and_area() {
    let turned = Footprint::new([3.0, -2.0], 4.0, 2.0, FRAC_PI_2);
    near(turned.hull, [1.0, 2.0]);
    near([turned.area], [8.0]);
    let diagonal = Footprint::new([0.0; 2], 4.0, 2.0, PI / 4.0);
    near(diagonal.hull, [3.0 / 2f64.sqrt(), 3.0 / 2f64.sqrt()]);
    // A line has no area, but a direction.
    let line = Footprint::new([0.0; 2], 0.0, 2.0, 0.0);
    near(line.half, [0.0, 1.0]);
    near([line.heading[1], line.area], [0.0, 0.0]);
}

/// Nothing here comes from the machine's own mathematics library, whose last digits differ from one to the next.
#[test]
fn geometry_has_the_same_bits_everywhere() {
    let mut bits = 0u64;
    let mut take = |value: f64| bits = bits.rotate_left(7).wrapping_mul(0x9e37_79b9_7f4a_7c15) ^ value.to_bits();
    for step in 0..4000 {
        let yaw = f64::from(step) * 0.0031 - 6.0;
        let car = object(f64::from(step % 50), 3.0, yaw);
        bottom_corners(&car).concat().into_iter().for_each(&mut take);
        Footprint::of(&car).heading.into_iter().for_each(&mut take);
        let here = Isometry3::new(Vector3::new(yaw, 2.0, 0.1), Vector3::new(0.01, yaw / 50.0, yaw / 2.0));
        let moved = transform_box(&here, &car);
        moved.center.into_iter().chain([moved.yaw]).for_each(&mut take);
        let between = interpolate(&here, &pose(1.0, 2.0, 0.3), 0.37);
        between.rotation.coords.iter().copied().for_each(&mut take);
        take(yaw_of(&between.rotation));
    }
    assert_eq!(format!("{bits:016x}"), "c580dcbae6cec1a5");
}
