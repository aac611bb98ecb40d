use std::sync::LazyLock;

use nalgebra::{Isometry3, Translation3, UnitQuaternion};
use proptest::prelude::*;
use realo_bev::Maps;
use realo_kernels::bev::BevMap;
use realo_operator::PortId;
use realo_schemas::geometry::{relative, transform_box};
use realo_schemas::report::Fate;
use realo_schemas::{Box3, Boxes, FeatureMap, Kind, Pose};

use super::*;
use crate::cells::tests::BLOCKS;
use crate::objects::tests::{car, pedestrian};
use crate::view::tests::sweep;

const MS: Nanos = 1_000_000;

fn pose(x: f64, y: f64, yaw: f64) -> Isometry3<f64> {
    let rotation = UnitQuaternion::from_euler_angles(0.0, 0.0, yaw);
    Isometry3::from_parts(Translation3::new(1e5 + x, -1e5 + y, 12.0), rotation)
}

const EGO: (f64, f64, f64) = (0.0, 0.0, 0.4);
const SENDER: (f64, f64, f64) = (30.0, 12.0, 2.5);

fn at((x, y, yaw): (f64, f64, f64)) -> Isometry3<f64> {
    pose(x, y, yaw)
}

/// What is there, in `map`.
fn town() -> Vec<Box3> {
    let cars = [
        (12.0, 3.0, 0.1),
        (25.0, -4.0, 3.1),
        (8.0, 14.0, 1.6),
        (31.0, 22.0, 1.5),
        (22.0, 9.0, 0.0),
        (16.0, -9.0, 0.4),
    ];
    let mut boxes: Vec<Box3> = cars.map(|(x, y, yaw)| car(1e5 + x, -1e5 + y, yaw)).into();
    boxes.push(pedestrian(1e5 + 4.0, -1e5 + 8.0));
    boxes.iter_mut().for_each(|object| object.center[2] += 12.0);
    boxes
}

fn seen_from(map_from_body: Isometry3<f64>, boxes: &[Box3]) -> Vec<Box3> {
    boxes
        .iter()
        .map(|object| transform_box(&map_from_body.inverse(), object))
        .collect()
}

fn header(agent: &str, seq: u64, stamp: Nanos, map_from_body: Option<Isometry3<f64>>) -> Header {
    let mut header = Header::origin(&"run".into(), &agent.into(), Kind::Boxes, seq, stamp, stamp + 50 * MS);
    header.pose = map_from_body.map(Pose::exact);
    header.to = Some("cav1".into());
    header
}

fn entry(agent: &str, stated: Option<Isometry3<f64>>, boxes: Vec<Box3>) -> Message {
    Message::new(header(agent, 3, 100 * MS, stated), Boxes(boxes))
}

/// Feeds a set; the messages that are given on.
fn guard(
    operator: &mut FusionGuard,
    own: Vec<Box3>,
    sweep: Option<PointCloud>,
    entries: Vec<Message>,
) -> (Vec<Message>, Outputs<Output>) {
    let mut out = Outputs::at(200 * MS);
    let ego = header("cav1", 7, 100 * MS, Some(at(EGO)));
    let mut feed = |port: PortId, message: Message| operator.on_message(port, message, &mut out).unwrap();
    feed(Input::EGO, Message::new(ego.clone(), Boxes(own)));
    if let Some(sweep) = sweep {
        feed(Input::CLOUDS, Message::new(ego.clone(), sweep));
    }
    feed(Input::SELECTIONS, Message::new(ego, Selection { query: 7, entries }));
    let mut sent = out.take_sent();
    assert_eq!((sent.len(), sent[0].0), (1, Output::SELECTIONS));
    let (header, selection) = sent.remove(0).1.into_parts::<Selection>().unwrap();
    assert_eq!((&*header.agent, header.seq, selection.query), ("cav1", 7, 7));
    (selection.entries, out)
}

fn new() -> FusionGuard {
    FusionGuard::new(Settings::default()).unwrap()
}

/// A sweep of flat ground with nothing on it but a wall far behind.
fn empty_ground() -> PointCloud {
    static GROUND: LazyLock<PointCloud> = LazyLock::new(|| sweep(1.9, &[([0.0, -45.0], [30.0, 0.5], 4.0)], true));
    GROUND.clone()
}

#[test]
fn wrong_poses_are_corrected_by_what_both_see() {
    for (dx, dy, turn) in [(1.0, 0.5, 0.0), (-3.0, 2.0, 0.03), (5.0, -7.0, -0.1), (9.0, 3.0, 0.12)] {
        let stated = at((SENDER.0 + dx, SENDER.1 + dy, SENDER.2 + turn));
        let theirs = seen_from(at(SENDER), &town());
        let (kept, out) = guard(
            &mut new(),
            seen_from(at(EGO), &town()),
            None,
            vec![entry("rsu1", Some(stated), theirs.clone())],
        );
        assert_eq!(out.counted("corrected_messages"), 1);
        let found = kept[0].header.pose.as_ref().unwrap().map_from_frame;
        for object in &theirs {
            let [found, there] = [found, at(SENDER)].map(|pose| transform_box(&pose, object));
            let off = libm::hypot(found.center[0] - there.center[0], found.center[1] - there.center[1]);
            assert!(off < 0.1, "{off} m for {dx} {dy} {turn}");
        }
        let covariance = kept[0]
            .header
            .pose
            .as_ref()
            .unwrap()
            .covariance
            .as_ref()
            .expect("a covariance");
        assert!(covariance[0] > 0.0 && covariance[7] > 0.0 && covariance[35] > 0.0 && covariance[0] < 0.1);
    }
}

#[test]
fn exact_poses_and_their_boxes_stay_as_they_are() {
    let mut theirs = seen_from(at(SENDER), &town());
    for (object, sign) in theirs.iter_mut().zip([1.0, -1.0].into_iter().cycle()) {
        object.center[0] += 0.15 * sign;
    }
    let said = entry("rsu1", Some(at(SENDER)), theirs);
    let (kept, out) = guard(&mut new(), seen_from(at(EGO), &town()), None, vec![said.clone()]);
    assert_eq!(kept, [said]);
    assert_eq!(out.counted("corrected_messages"), 0);
}

#[test]
fn a_pose_that_is_said_to_be_unsure_is_moved_by_less_than_one_that_is_said_to_be_exact() {
    let (dx, dy) = (0.3, -0.2);
    let stated = at((SENDER.0 + dx, SENDER.1 + dy, SENDER.2));
    let few = &town()[..2];
    let off = |place_m: f64| {
        let mut said = entry("rsu1", Some(stated), seen_from(at(SENDER), few));
        let mut covariance = Box::new([0.0; 36]);
        (covariance[0], covariance[7], covariance[35]) = (place_m * place_m, place_m * place_m, 1e-4);
        said.header.pose.as_mut().unwrap().covariance = Some(covariance);
        let (kept, _) = guard(&mut new(), seen_from(at(EGO), few), None, vec![said]);
        let found = kept[0].header.pose.as_ref().unwrap().map_from_frame;
        (found.translation.vector - at(SENDER).translation.vector).norm()
    };
    assert!((off(0.02) - libm::hypot(dx, dy)).abs() < 1e-6, "{}", off(0.02));
    assert!(off(2.0) < 0.1, "{}", off(2.0));
}

#[test]
fn an_agent_without_a_pose_is_placed_and_may_not_be() {
    let theirs = || entry("rsu1", None, seen_from(at(SENDER), &town()));
    let own = || seen_from(at(EGO), &town());
    let (kept, out) = guard(&mut new(), own(), None, vec![theirs()]);
    let plane = kept[0].header.pose.as_ref().expect("it is placed").map_from_frame;
    let off = relative(&at(SENDER), &plane);
    assert!(
        off.translation.vector.norm() < 0.1 && off.rotation.angle() < 0.01,
        "{off}"
    );
    assert_eq!(out.counted("placed_messages"), 1);
    let mut without = FusionGuard::new(Settings {
        constellations: false,
        ..Settings::default()
    })
    .unwrap();
    let (kept, out) = guard(&mut without, own(), None, vec![theirs()]);
    assert!(kept[0].header.pose.is_none());
    assert_eq!(out.counted("unchecked_messages"), 1);
}

fn ghosts(count: usize) -> Vec<Box3> {
    let place = |ghost: usize| {
        let (sin, cos) = libm::sincos(2.4 * ghost as f64);
        let range = 8.0 + 1.1 * ghost as f64;
        car(range * cos, range * sin, 0.3 * ghost as f64)
    };
    (0..count).map(place).collect()
}

#[test]
fn ghosts_where_nothing_stands_condemn_their_sender_and_nobody_else() {
    // The ego sees free ground all around, so that whatever is said of it is not so.
    let liar = entry("cav2", Some(at(EGO)), ghosts(20));
    let honest = entry(
        "rsu1",
        Some(at(SENDER)),
        seen_from(at(SENDER), &[car(1e5 + 400.0, -1e5, 0.0)]),
    );
    let mut operator = new();
    let (kept, mut out) = guard(&mut operator, vec![], Some(empty_ground()), vec![liar, honest.clone()]);
    assert_eq!(kept.iter().map(|one| &*one.header.agent).collect::<Vec<_>>(), ["rsu1"]);
    assert_eq!(out.counted("contradicted_messages"), 1);
    let fates: Vec<_> = out
        .take_fates()
        .into_iter()
        .map(|fated| (fated.message.from, fated.fate))
        .collect();
    assert_eq!(fates, [("cav2".to_string(), Fate::Distrusted)]);
    // What it says now could be so, but it is not believed any more.
    let again = entry(
        "cav2",
        Some(at(SENDER)),
        seen_from(at(SENDER), &[car(1e5 + 400.0, -1e5, 0.0)]),
    );
    let (kept, out) = guard(&mut operator, vec![], Some(empty_ground()), vec![again.clone()]);
    assert!(kept.is_empty() && out.counted("distrusted_messages") == 1);
    // After a while it is forgotten.
    let later = 60_000 * MS;
    let mut out = Outputs::at(later);
    let ego = header("cav1", 8, later, Some(at(EGO)));
    let feeds = [
        (Input::EGO, Message::new(ego.clone(), Boxes(vec![]))),
        (Input::CLOUDS, Message::new(ego.clone(), empty_ground())),
        (
            Input::SELECTIONS,
            Message::new(
                ego,
                Selection {
                    query: 8,
                    entries: vec![again],
                },
            ),
        ),
    ];
    for (port, message) in feeds {
        operator.on_message(port, message, &mut out).unwrap();
    }
    assert_eq!(out.counted("distrusted_messages"), 0);
}

/// Boxes that lie to and fro across where they head, m.
fn scattered(boxes: &[Box3], metres: f64, message: usize) -> Vec<Box3> {
    let mut boxes = boxes.to_vec();
    for (place, object) in boxes.iter_mut().enumerate() {
        let by = if (place + message).is_multiple_of(2) {
            metres
        } else {
            -metres
        };
        let (sin, cos) = libm::sincos(object.yaw);
        object.center[0] -= by * sin;
        object.center[1] += by * cos;
    }
    boxes
}

#[test]
fn an_agent_whose_boxes_scatter_counts_less_and_then_not_at_all() {
    let said = |metres: f64, message: usize| {
        let boxes = scattered(&seen_from(at(SENDER), &town()), metres, message);
        entry("cav2", Some(at(SENDER)), boxes)
    };
    let own = || seen_from(at(EGO), &town());
    let (mut honest, mut blurred) = (new(), new());
    let (mut scores, mut left_out) = (Vec::new(), 0);
    for message in 0..8 {
        let good = said(0.2, message);
        let (kept, out) = guard(&mut honest, own(), None, vec![good.clone()]);
        assert_eq!((kept, out.counted("scattered_messages")), (vec![good], 0));
        let (kept, out) = guard(&mut blurred, own(), None, vec![said(0.6, message)]);
        left_out += out.counted("scattered_messages");
        scores.extend(
            kept.into_iter()
                .map(|one| one.into_parts::<Boxes>().unwrap().1.0[0].score),
        );
    }
    assert!(left_out >= 4, "{left_out}");
    assert!(scores.windows(2).all(|pair| pair[1] < pair[0]), "{scores:?}");
}

#[test]
fn few_ghosts_are_dropped_one_by_one() {
    let own = seen_from(at(EGO), &town());
    let mut theirs = seen_from(at(SENDER), &town());
    let ghost = transform_box(&relative(&at(SENDER), &at(EGO)), &car(-20.0, -5.0, 0.0));
    theirs.push(ghost);
    let (kept, out) = guard(
        &mut new(),
        own,
        Some(empty_ground()),
        vec![entry("rsu1", Some(at(SENDER)), theirs.clone())],
    );
    let (_, Boxes(boxes)) = kept[0].clone().into_parts().unwrap();
    assert_eq!((boxes.len(), out.counted("free_boxes")), (theirs.len() - 1, 1));
}

#[test]
fn what_is_wrong_is_counted_and_nothing_panics() {
    let own = seen_from(at(EGO), &town());
    let theirs = seen_from(at(SENDER), &town());
    let mut many: Vec<Box3> = (0..10_000)
        .map(|n| car(f64::from(n % 100), f64::from(n / 100) - 50.0, 0.1))
        .collect();
    many[0].center[1] = f64::NAN;
    let mut covariance = entry("cav2", Some(at(SENDER)), theirs.clone());
    covariance.header.pose.as_mut().unwrap().covariance = Some(Box::new([f64::NAN; 36]));
    let mut negative = covariance.clone();
    negative.header.agent = "cav3".into();
    negative.header.pose.as_mut().unwrap().covariance = Some(Box::new([-1.0; 36]));
    let entries = vec![
        entry("rsu1", Some(at(SENDER)), many),
        covariance,
        negative,
        entry("rsu2", Some(at(SENDER)), vec![]),
        Message::new(header("rsu3", 3, 100 * MS, Some(at(SENDER))), PointCloud::empty()),
        entry("rsu4", None, theirs),
    ];
    let (_, out) = guard(&mut new(), own, Some(PointCloud::empty()), entries);
    let counted = [
        "excess_boxes",
        "implausible_boxes",
        "wrong_covariances",
        "unchecked_messages",
        "placed_messages",
    ];
    assert_eq!(counted.map(|name| out.counted(name)), [10_000 - 256 - 1, 1, 2, 1, 1]);
}

#[test]
fn a_selection_alone_is_an_error_and_who_is_off_checks_nothing() {
    let ego = header("cav1", 7, 100 * MS, Some(at(EGO)));
    let selection = Selection {
        query: 7,
        entries: vec![],
    };
    let mut out = Outputs::at(0);
    let error = new()
        .on_message(Input::SELECTIONS, Message::new(ego, selection), &mut out)
        .unwrap_err();
    assert!(error.to_string().contains("without the ego's message"), "{error}");
    let off = Settings {
        enabled: false,
        ..Settings::default()
    };
    let said = entry("cav2", Some(at(EGO)), ghosts(20));
    let (kept, _) = guard(
        &mut FusionGuard::new(off).unwrap(),
        vec![],
        Some(empty_ground()),
        vec![said.clone()],
    );
    assert_eq!(kept, [said]);
}

#[test]
fn clocks_that_are_off_are_corrected_in_stamps() {
    let ways = [[8.0, 0.0], [-11.0, 0.5], [0.3, 6.0]];
    let at_time = |seconds: f64| -> Vec<Box3> {
        let mut boxes = town();
        for (object, way) in boxes.iter_mut().zip(ways) {
            object.velocity = Some([way[0], way[1], 0.0]);
            object.center[0] += way[0] * seconds;
            object.center[1] += way[1] * seconds;
        }
        boxes
    };
    let settings = Settings {
        move_boxes: true,
        ..Settings::default()
    };
    let mut operator = FusionGuard::new(settings).unwrap();
    let theirs = entry("rsu1", Some(at(SENDER)), seen_from(at(SENDER), &at_time(-0.6)));
    for _ in 0..3 {
        let (kept, out) = guard(
            &mut operator,
            seen_from(at(EGO), &at_time(0.0)),
            None,
            vec![theirs.clone()],
        );
        let ahead = theirs.header.stamp - kept[0].header.stamp;
        assert!((ahead - 600 * MS).abs() < 20 * MS, "{ahead} ns");
        assert_eq!(out.counted("corrected_clocks"), 1);
    }
}

#[test]
fn points_are_laid_over_the_egos_own_and_ghosts_among_them_are_gone() {
    let own = sweep(1.9, &BLOCKS, true);
    let with = |column: &[f32], more: f32| column.iter().copied().chain([more; 50]).collect::<Vec<f32>>();
    let n = own.len() + 50;
    let (x, y, z) = (with(&own.x, 7.0), with(&own.y, 5.0), with(&own.z, 1.0));
    let theirs = PointCloud::new(x, y, z, vec![9u8; n], vec![0; n], vec![0u16; n]).expect("columns of one length");
    let mut stated = at((3.0, -2.0, EGO.2 + 0.03));
    stated.translation.z += 1.5;
    let ego = header("cav1", 7, 100 * MS, Some(at(EGO)));
    let entries = vec![Message::new(header("rsu1", 3, 100 * MS, Some(stated)), theirs)];
    let (mut operator, mut out) = (new(), Outputs::at(200 * MS));
    operator
        .on_message(Input::EGO, Message::new(ego.clone(), own.clone()), &mut out)
        .unwrap();
    operator
        .on_message(
            Input::SELECTIONS,
            Message::new(ego, Selection { query: 7, entries }),
            &mut out,
        )
        .unwrap();
    let (_, selection) = out.take_sent().remove(0).1.into_parts::<Selection>().unwrap();
    let (header, kept) = selection.entries[0].clone().into_parts::<PointCloud>().unwrap();
    let off = header.pose.unwrap().map_from_frame.translation.vector - at(EGO).translation.vector;
    assert!(libm::hypot(off.x, off.y) < 0.5 && off.z.abs() < 0.1, "{off}");
    assert!(
        kept.len() <= own.len() && kept.len() > own.len() * 9 / 10,
        "{} of {}",
        kept.len(),
        own.len()
    );
    assert_eq!(out.counted("corrected_messages"), 1);
}

/// A map of a size, by a number that tells the feature.
fn map(maps: &Maps, [rows, columns, channels]: [usize; 3], feature: impl Fn(usize) -> f32) -> FeatureMap {
    maps.write(BevMap {
        rows,
        columns,
        channels,
        data: (0..rows * columns * channels).map(feature).collect(),
    })
}

/// Feeds a set of maps; the error, or the agents whose maps are given on.
fn guard_maps(
    operator: &mut FusionGuard,
    ego: FeatureMap,
    theirs: Vec<(&str, FeatureMap)>,
) -> (Result<Vec<Name>, String>, Outputs<Output>) {
    let mut out = Outputs::at(200 * MS);
    let header_of = |agent: &str, place| Header {
        kind: Kind::Features,
        ..header(agent, 7, 100 * MS, Some(at(place)))
    };
    let asked = header_of("cav1", EGO);
    let entries = theirs
        .into_iter()
        .map(|(agent, map)| Message::new(header_of(agent, SENDER), map));
    let entries = entries.collect();
    operator
        .on_message(Input::EGO, Message::new(asked.clone(), ego), &mut out)
        .unwrap();
    operator
        .on_message(Input::CLOUDS, Message::new(asked.clone(), empty_ground()), &mut out)
        .unwrap();
    let selection = Message::new(asked, Selection { query: 7, entries });
    let done = operator.on_message(Input::SELECTIONS, selection, &mut out);
    let kept = done.map_err(|error| error.to_string()).map(|()| {
        let (_, selection) = out.take_sent().remove(0).1.into_parts::<Selection>().unwrap();
        selection.entries.into_iter().map(|entry| entry.header.agent).collect()
    });
    (kept, out)
}

#[test]
fn a_map_that_does_not_fit_stops_nobody_and_one_of_the_egos_is_an_error() {
    let model = concat!(env!("CARGO_MANIFEST_DIR"), "/../../models/lite-attfuse.toml");
    let settings = Settings {
        model: model.into(),
        ..Settings::default()
    };
    let maps = Maps::of(&settings.computing.load(&settings.model).unwrap());
    let others = Maps {
        identity: "other-1".into(),
        ..maps.clone()
    };
    let mut operator = FusionGuard::new(settings).unwrap();
    let whole = [100, 256, 64];
    let empty = map(&maps, whole, |_| 0.0);
    let odd = [
        map(&maps, [1, 1, 1], |_| 0.0),
        map(&others, whole, |_| 0.0),
        map(&maps, whole, |at| if at == 77 { f32::NAN } else { 0.0 }),
    ];
    for odd in odd {
        let theirs = vec![("rsu1", empty.clone()), ("cav2", odd.clone())];
        let (kept, out) = guard_maps(&mut operator, empty.clone(), theirs);
        assert_eq!(kept.unwrap(), [Name::from("rsu1"), "cav2".into()]);
        assert_eq!(
            out.counted("unchecked_messages"),
            1,
            "the fusion says what is wrong with it"
        );
        let (kept, _) = guard_maps(&mut operator, odd, vec![("rsu1", empty.clone())]);
        let error = kept.unwrap_err();
        assert!(
            error.contains("does not fit `model`") && error.contains(&*maps.identity),
            "{error}"
        );
    }
    // Features that no encoder made show boxes where nothing stands, or where no object on the map can be.
    for size in [5.0, 50.0, 5000.0] {
        let noise = map(&maps, whole, |at| ((at * 2_654_435_761) % 1000) as f32 / 1000.0 * size);
        let theirs = vec![("rsu1", empty.clone()), ("cav2", noise)];
        let (kept, out) = guard_maps(&mut operator, empty.clone(), theirs);
        assert_eq!(kept.unwrap(), [Name::from("rsu1")]);
        assert_eq!(
            out.counted("contradicted_messages") + out.counted("distrusted_messages"),
            1
        );
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(12))]

    #[test]
    fn whatever_comes_in_nothing_panics_and_no_more_comes_out(
        boxes in proptest::collection::vec((-60.0..60.0f64, -60.0..60.0f64, -4.0..4.0f64, 0.0..1.0f32, any::<bool>()), 0..60),
        dx in -20.0..20.0f64, dy in -20.0..20.0f64, turn in -0.5..0.5f64, split in 0usize..60,
    ) {
        let all: Vec<Box3> = boxes.iter().map(|(x, y, yaw, score, is_car)| {
            let object = if *is_car { car(*x, *y, *yaw) } else { pedestrian(*x, *y) };
            Box3 { score: *score, ..object }
        }).collect();
        let (own, theirs) = all.split_at(split.min(all.len()));
        let said = entry("rsu1", Some(at((dx, dy, turn))), theirs.to_vec());
        let once = || guard(&mut new(), own.to_vec(), Some(empty_ground()), vec![said.clone()]).0;
        let kept = once();
        prop_assert_eq!(&kept, &once(), "the same input gives the same bits");
        for message in kept {
            let (header, Boxes(boxes)) = message.into_parts().unwrap();
            prop_assert!(boxes.len() <= theirs.len());
            prop_assert!(boxes.iter().all(|object| (0.0..=1.0).contains(&object.score)));
            prop_assert!(header.pose.unwrap().map_from_frame.translation.vector.iter().all(|number| number.is_finite()));
        }
    }
}
