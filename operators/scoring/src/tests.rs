use realo_schemas::geometry::View;
use realo_schemas::{Box3, Boxes, GroundTruth, Header, Kind, OwnLabels};

use super::*;

fn object(class: &str, x: f64, y: f64, score: f32) -> Box3 {
    Box3 {
        center: [x, y, 0.8],
        length: 4.0,
        width: 2.0,
        height: 1.5,
        yaw: 0.0,
        velocity: None,
        class: class.into(),
        score,
        track: None,
        covariance: None,
    }
}

fn car(x: f64, score: f32) -> Box3 {
    object("Car", x, 0.0, score)
}

fn header(seq: u64, kind: Kind) -> Header {
    let stamp = 1_000 + 100 * seq as i64;
    Header::origin(&"run".into(), &"cav1".into(), kind, seq, stamp, stamp + 50)
}

fn truth(boxes: Vec<Box3>) -> GroundTruth {
    GroundTruth {
        boxes,
        agents: vec!["cav1".into()],
        points: vec![],
        ego_footprint: None,
        key: true,
        ..GroundTruth::default()
    }
}

/// Truth with points of (all others, the ego) on each object.
fn truth_with_points(boxes: Vec<Box3>, points: &[[u32; 2]]) -> GroundTruth {
    let points = points.iter().flat_map(|[others, ego]| [*ego, *others]).collect();
    GroundTruth {
        agents: vec!["cav1".into(), "rsu1".into()],
        points,
        ..truth(boxes)
    }
}

/// What a collector hears.
#[derive(Clone)]
enum Fed {
    Truth(Header, GroundTruth),
    Boxes(Header, Boxes),
}

fn with_truth(seq: u64, truth: GroundTruth) -> Fed {
    Fed::Truth(header(seq, Kind::Truth), truth)
}

fn with_boxes(seq: u64, boxes: Vec<Box3>) -> Fed {
    Fed::Boxes(header(seq, Kind::Boxes), Boxes(boxes))
}

fn feed(collector: &mut Collector, fed: Fed) -> Result<(), EvaluationError> {
    match fed {
        Fed::Truth(header, truth) => collector.add_truth(&header, &truth),
        Fed::Boxes(header, boxes) => collector.add_boxes(&header, boxes),
    }
}

fn run(protocol: &str, messages: Vec<Fed>) -> EvaluationReport {
    let mut collector = Collector::new(Protocol::load(protocol).unwrap());
    for message in messages {
        feed(&mut collector, message).unwrap();
    }
    collector.finish().into()
}

fn counts(scores: &Scores, class: &str, iou: &str) -> (u64, u64, u64) {
    let counts = scores.accuracy.sorted.counts[class][iou];
    assert_eq!(scores.accuracy.v2x_real.counts[class][iou], counts);
    (counts.true_positives, counts.false_positives, counts.total)
}

#[test]
fn the_report_has_the_shape_that_scripts_rely_on() {
    let report = run(
        "default",
        vec![
            with_truth(0, truth(vec![car(10.0, 1.0)])),
            with_boxes(0, vec![car(10.0, 0.9)]),
        ],
    );
    let json = serde_json::to_value(&report.scores).unwrap();
    for table in ["accuracy", "accuracy_seen", "accuracy_processed"] {
        for order in ["sorted", "v2x-real"] {
            let accuracy = &json[table][order];
            for class in ["vehicle", "pedestrian", "truck"] {
                for iou in ["0.3", "0.5"] {
                    assert!(
                        accuracy["AP"][class].get(iou).is_some(),
                        "{table} {order} {class} {iou}"
                    );
                    for count in ["true", "false", "total"] {
                        assert!(accuracy["counts"][class][iou][count].is_u64());
                    }
                }
            }
            assert!(accuracy["mAP"].get("0.5").is_some());
        }
    }
    assert_eq!(json["accuracy"]["sorted"]["AP"]["vehicle"]["0.5"], 1.0);
    assert!(json["accuracy"]["sorted"]["AP"]["truck"]["0.5"].is_null());
    assert!(json["accuracy"]["sorted"]["mAP"]["0.5"].is_null());
    assert!(
        report
            .scores
            .notes
            .iter()
            .any(|note| note.contains("`pedestrian`, `truck`")),
        "{:?}",
        report.scores.notes
    );
}

#[test]
fn the_two_orders_differ_where_frames_differ_in_score() {
    let messages = vec![
        with_truth(0, truth(vec![car(10.0, 1.0)])),
        with_boxes(0, vec![car(50.0, 0.2), car(10.0, 0.3)]),
        with_truth(1, truth(vec![car(10.0, 1.0)])),
        with_boxes(1, vec![car(10.0, 0.9)]),
    ];
    let scores = run("default", messages).scores;
    assert_eq!(scores.accuracy.sorted.ap["vehicle"]["0.5"], Some(1.0));
    // Frame 0 first: true, false, then frame 1: true.
    assert_eq!(
        scores.accuracy.v2x_real.ap["vehicle"]["0.5"],
        Some(0.5 + 0.5 * 2.0 / 3.0)
    );
}

#[test]
fn a_key_frame_without_boxes_misses_all_its_objects() {
    let messages = vec![
        with_truth(0, truth(vec![car(10.0, 1.0)])),
        with_truth(1, truth(vec![car(10.0, 1.0), car(20.0, 1.0), car(30.0, 1.0)])),
        with_boxes(0, vec![car(10.0, 0.9)]),
    ];
    let scores = run("default", messages).scores;
    assert_eq!(counts(&scores, "vehicle", "0.5"), (1, 0, 4));
    assert_eq!(scores.accuracy.sorted.ap["vehicle"]["0.5"], Some(0.25));
    assert_eq!(scores.accuracy_processed.sorted.ap["vehicle"]["0.5"], Some(1.0));
    assert_eq!(
        scores.frames,
        FrameCounts {
            total: 2,
            key: 2,
            skipped: 1
        }
    );
}

#[test]
fn a_frame_without_truth_never_counts() {
    let silent = GroundTruth {
        key: false,
        ..truth(vec![])
    };
    let messages = vec![
        with_truth(0, truth(vec![car(10.0, 1.0)])),
        with_boxes(0, vec![car(10.0, 0.9)]),
        with_truth(1, silent),
        with_boxes(1, vec![car(10.0, 0.95)]),
        with_boxes(2, vec![car(10.0, 0.95)]),
    ];
    let scores = run("default", messages).scores;
    assert_eq!(counts(&scores, "vehicle", "0.5"), (1, 0, 1));
    assert_eq!(
        scores.frames,
        FrameCounts {
            total: 2,
            key: 1,
            skipped: 0
        }
    );
    assert_eq!(scores.boxes_without_truth, 1);
    let scores = run(
        "default",
        vec![with_truth(
            0,
            GroundTruth {
                key: false,
                ..truth(vec![])
            },
        )],
    )
    .scores;
    assert_eq!(scores.notes, ["no frame has ground truth: nothing is scored"]);
}

#[test]
fn a_key_frame_without_objects_makes_detections_false() {
    let messages = vec![
        with_truth(0, truth(vec![car(10.0, 1.0)])),
        with_boxes(0, vec![car(10.0, 0.5)]),
        with_truth(1, truth(vec![])),
        with_boxes(1, vec![car(10.0, 0.9)]),
    ];
    let scores = run("default", messages).scores;
    assert_eq!(counts(&scores, "vehicle", "0.3"), (1, 1, 1));
    assert_eq!(scores.accuracy.sorted.ap["vehicle"]["0.3"], Some(0.5));
}

#[test]
fn the_order_of_arrival_does_not_matter() {
    let messages = vec![
        with_truth(0, truth(vec![car(10.0, 1.0)])),
        with_truth(1, truth(vec![car(30.0, 1.0)])),
        with_boxes(0, vec![car(10.0, 0.9), car(50.0, 0.8)]),
        with_boxes(1, vec![car(30.0, 0.9)]),
    ];
    let mut other = messages.clone();
    other.reverse();
    let (one, other) = (run("default", messages), run("default", other));
    assert_eq!(one, other);
}

#[test]
fn drops_what_the_protocol_does_not_count() {
    let footprint = Some([-1.0, 4.0, -1.0, 1.0]);
    let objects = vec![
        car(10.0, 1.0),
        car(98.5, 1.0),
        object("FireHydrant", 5.0, 5.0, 1.0),
        car(f64::NAN, 1.0),
    ];
    let detections = vec![
        car(10.0, 0.9),
        car(2.0, 0.9),
        object("Car", 20.0, 39.5, 0.9),
        object("traffic_light", 20.0, 0.0, 0.9),
        Box3 {
            length: 0.0,
            ..car(30.0, 0.9)
        },
        car(1e30, 0.9),
    ];
    let key = GroundTruth {
        ego_footprint: footprint,
        ..truth(objects)
    };
    let report = run("default", vec![with_truth(0, key), with_boxes(0, detections)]);
    assert_eq!(counts(&report.scores, "vehicle", "0.5"), (1, 0, 1));
    let dropped = &report.scores.dropped_detections;
    assert_eq!((dropped.invalid, dropped.outside, dropped.own_body), (2, 1, 1));
    assert_eq!(dropped.classes, [("traffic_light".to_string(), 1)].into());
    let dropped = &report.scores.dropped_truths;
    assert_eq!((dropped.invalid, dropped.outside, dropped.own_body), (1, 1, 0));
    assert_eq!(dropped.classes, [("FireHydrant".to_string(), 1)].into());
}

#[test]
fn objects_with_few_points_do_not_count_and_unseen_ones_are_ignored_in_seen() {
    let objects = [10.0, 20.0, 30.0, 35.0, 40.0].map(|x| car(x, 1.0)).to_vec();
    // Seen by the ego; by the others only; by nobody enough, twice; by both a little.
    let key = truth_with_points(objects, &[[0, 10], [300, 9], [4, 0], [0, 1], [3, 2]]);
    let detections = vec![car(10.0, 0.9), car(20.0, 0.8), car(50.0, 0.7)];
    let scores = run("default", vec![with_truth(0, key), with_boxes(0, detections)]).scores;
    assert_eq!(counts(&scores, "vehicle", "0.5"), (2, 1, 3));
    assert_eq!(scores.dropped_truths.few_points, 2);
    let seen = scores.accuracy_seen.sorted.counts["vehicle"]["0.5"];
    assert_eq!((seen.true_positives, seen.false_positives, seen.total), (1, 1, 1));
    assert_eq!(scores.accuracy_seen.sorted.ap["vehicle"]["0.5"], Some(1.0));
}

#[test]
fn seen_needs_to_know_the_points() {
    let scores = run(
        "default",
        vec![
            with_truth(0, truth(vec![car(10.0, 1.0)])),
            with_boxes(0, vec![car(10.0, 0.9)]),
        ],
    )
    .scores;
    let seen = &scores.accuracy_seen.sorted;
    assert_eq!(
        (seen.ap["vehicle"]["0.5"], seen.counts["vehicle"]["0.5"].total),
        (None, 0)
    );
    assert!(
        scores.notes[0].contains("1 of 1 scenes do not say how many points"),
        "{:?}",
        scores.notes
    );
}

#[test]
fn notes_say_what_is_null_and_nothing_else() {
    let notes = |truths: Vec<GroundTruth>| {
        let scene = |truth: GroundTruth| {
            let protocol = Protocol::load("default").unwrap();
            evaluate([(header(0, Kind::Truth), truth)], [], &protocol).unwrap()
        };
        score(&pool(truths.into_iter().map(scene).collect()).unwrap()).notes
    };
    let all = || {
        ["Car", "Pedestrian", "Truck"]
            .map(|class| object(class, 10.0, 0.0, 1.0))
            .to_vec()
    };
    let cars = || vec![car(10.0, 1.0)];
    let missing = |table: &str| {
        format!(
            "{table}: the scored frames have no object of class `pedestrian`, `truck`, so there is no AP of it and no mAP over all \
             classes"
        )
    };
    let silent = |scenes: &str| {
        format!("{scenes} scenes do not say how many points the ego has on each object: left out of accuracy_seen")
    };
    let known = |boxes: Vec<Box3>| {
        let points = vec![[0, 10]; boxes.len()];
        truth_with_points(boxes, &points)
    };
    assert_eq!(notes(vec![known(all())]), Vec::<String>::new());
    assert_eq!(
        notes(vec![known(cars())]),
        [missing("accuracy"), missing("accuracy_seen")]
    );
    assert_eq!(notes(vec![truth(cars())]), [silent("1 of 1"), missing("accuracy")]);
    assert_eq!(
        notes(vec![known(cars()), truth(all())]),
        [silent("1 of 2"), missing("accuracy_seen")]
    );
}

#[test]
fn objects_and_detections_count_in_the_log_of_their_scene() {
    let scene = |name: &str, ego: &str, objects: usize| {
        let objects: Vec<_> = (0..objects).map(|i| car(10.0 * i as f64, 1.0)).collect();
        let boxes = [(header(0, Kind::Boxes), Boxes(vec![car(0.0, 0.9)]))];
        let protocol = Protocol::load("default").unwrap();
        let mut evaluation = evaluate([(header(0, Kind::Truth), truth(objects))], boxes, &protocol).unwrap();
        evaluation.scenes[0].name = name.into();
        evaluation.scenes[0].ego = ego.into();
        evaluation
    };
    let pooled = pool(vec![
        scene("a", "x", 1),
        scene("b", "x", 2),
        scene("a", "y", 4),
        scene("c", "x", 3),
    ])
    .unwrap();
    let vehicles = &sequence::sequences(&pooled, Scope::All)[0][0];
    assert_eq!(vehicles.totals, [5, 2, 3]);
    let logs: Vec<usize> = vehicles.entries.iter().map(|entry| entry.log).collect();
    assert_eq!(logs, [0, 0, 1, 2]);
}

#[test]
fn dair_counts_one_class_whatever_the_case() {
    let objects = vec![object("car", 10.0, 0.0, 1.0), object("bus", 30.0, 0.0, 1.0)];
    let detections = vec![object("Car", 10.0, 0.0, 1.0), object("Van", 30.0, 0.0, 1.0)];
    let scores = run("dair", vec![with_truth(0, truth(objects)), with_boxes(0, detections)]).scores;
    assert_eq!(counts(&scores, "vehicle", "0.5"), (2, 0, 2));
    assert_eq!(scores.accuracy.sorted.mean_ap["0.5"], Some(1.0));
}

#[test]
fn range_bins_count_an_object_where_it_is() {
    let objects = vec![car(29.0, 1.0), car(60.0, 1.0), car(-70.0, 1.0)];
    // The first detection lies beyond the edge, its object before.
    let detections = vec![car(30.5, 0.9), car(60.0, 0.8), car(40.0, 0.7)];
    let scores = run(
        "default",
        vec![with_truth(0, truth(objects)), with_boxes(0, detections)],
    )
    .scores;
    let bins = &scores.by_range["vehicle"]["0.3"];
    let values: Vec<_> = bins
        .iter()
        .map(|bin| (bin.from, bin.to, bin.precision, bin.recall))
        .collect();
    assert_eq!(
        values,
        [
            (0.0, Some(30.0), Some(1.0), Some(1.0)),
            (30.0, Some(50.0), Some(0.0), None),
            (50.0, None, Some(1.0), Some(0.5))
        ]
    );
}

#[test]
fn points_bins_count_what_the_ego_has_on_an_object() {
    let objects = vec![car(10.0, 1.0), car(20.0, 1.0), car(40.0, 1.0), car(60.0, 1.0)];
    let all = truth_with_points(objects, &[[90, 9], [0, 10], [0, 49], [0, 50]]);
    let detections = vec![car(10.0, 0.9), car(20.0, 0.8), car(60.0, 0.7), car(80.0, 0.6)];
    let scores = run("default", vec![with_truth(0, all), with_boxes(0, detections)]).scores;
    let bins = scores.by_points["vehicle"]["0.5"].iter();
    let values: Vec<_> = bins
        .map(|bin| (bin.from, bin.to, bin.true_positives, bin.total, bin.recall))
        .collect();
    assert_eq!(
        values,
        [
            (0, Some(10), 1, 1, Some(1.0)),
            (10, Some(50), 1, 2, Some(0.5)),
            (50, None, 1, 1, Some(1.0))
        ]
    );
}

#[test]
fn boxes_and_truth_of_two_times_are_refused_in_either_order() {
    let later = Header {
        stamp: header(0, Kind::Boxes).stamp + 1,
        ..header(0, Kind::Boxes)
    };
    for boxes_first in [false, true] {
        let mut collector = Collector::new(Protocol::load("default").unwrap());
        let add_truth =
            |collector: &mut Collector| collector.add_truth(&header(0, Kind::Truth), &truth(vec![car(10.0, 1.0)]));
        let add_boxes = |collector: &mut Collector| collector.add_boxes(&later, Boxes(vec![car(10.0, 0.9)]));
        let refused = if boxes_first {
            add_boxes(&mut collector).unwrap();
            add_truth(&mut collector)
        } else {
            add_truth(&mut collector).unwrap();
            add_boxes(&mut collector)
        };
        let expected = EvaluationError::Stamps {
            agent: "cav1".into(),
            seq: 0,
            truth: 1_000,
            boxes: 1_001,
        };
        assert_eq!(refused, Err(expected));
        let scenes = collector.finish().scenes;
        assert!(!scenes[0].frames[0].processed, "its objects are missed");
    }
}

#[test]
fn refuses_second_messages_and_boxes_of_another_frame() {
    let mut collector = Collector::new(Protocol::load("default").unwrap());
    feed(&mut collector, with_truth(0, truth(vec![car(10.0, 1.0)]))).unwrap();
    let error = feed(&mut collector, with_truth(0, truth(vec![])))
        .unwrap_err()
        .to_string();
    assert!(error.contains("second message of truth for sweep 0"), "{error}");
    feed(&mut collector, with_boxes(0, vec![])).unwrap();
    let error = feed(&mut collector, with_boxes(0, vec![])).unwrap_err().to_string();
    assert!(error.contains("second message of boxes"), "{error}");
    feed(&mut collector, with_truth(1, truth(vec![car(10.0, 1.0)]))).unwrap();
    let elsewhere = Header {
        frame: "rsu1/body".into(),
        ..header(1, Kind::Boxes)
    };
    let boxes = Boxes(vec![car(10.0, 0.9)]);
    let error = collector.add_boxes(&elsewhere, boxes).unwrap_err().to_string();
    assert!(
        error.contains("`cav1/body`") && error.contains("`rsu1/body`"),
        "{error}"
    );
    let report = EvaluationReport::from(collector.finish());
    assert_eq!(report.scores.frames.skipped, 1);
    assert_eq!(counts(&report.scores, "vehicle", "0.5"), (0, 0, 2));
}

/// A log of ten frames in which the detections' luck depends on `luck`.
fn evaluation(name: &str, luck: u64) -> Evaluation {
    let frame = |seq: u64| {
        let objects: Vec<_> = (0..4)
            .map(|i| car(10.0 * f64::from(i) + 7.123456789 / 3.0, 1.0))
            .collect();
        let detections = (0..4u64).map(|i| {
            let off = if (seq + i).is_multiple_of(luck) {
                3.0
            } else {
                0.1 * (1.0 / 3.0)
            };
            car(
                objects[i as usize].center[0] + off,
                ((seq * 7 + i * 3 + luck) % 11) as f32 / 11.0,
            )
        });
        (
            (header(seq, Kind::Truth), truth(objects.clone())),
            (header(seq, Kind::Boxes), Boxes(detections.collect())),
        )
    };
    let (truths, boxes): (Vec<_>, Vec<_>) = (0..10).map(frame).unzip();
    let mut evaluation = evaluate(truths, boxes, &Protocol::load("default").unwrap()).unwrap();
    evaluation.scenes[0].name = name.into();
    evaluation
}

#[test]
fn evaluations_survive_json_bit_by_bit() {
    let evaluation = evaluation("a", 3);
    let text = serde_json::to_string(&evaluation).unwrap();
    assert_eq!(serde_json::from_str::<Evaluation>(&text).unwrap(), evaluation);
}

#[test]
fn pooling_is_scoring_all_frames_at_once() {
    let (a, b) = (evaluation("a", 3), evaluation("b", 4));
    let pooled = pool(vec![b.clone(), a.clone()]).unwrap();
    assert_eq!(pooled, pool(vec![a.clone(), b.clone()]).unwrap());
    // The same frames as one log: the same accuracies.
    let mut joined = a.clone();
    let shifted = b.scenes[0].frames.iter().map(|frame| Frame {
        seq: frame.seq + 10,
        ..frame.clone()
    });
    joined.scenes[0].frames.extend(shifted);
    assert_eq!(score(&pooled).accuracy, score(&joined).accuracy);
    let mut other = b.clone();
    other.protocol = Protocol::load("dair").unwrap();
    assert_eq!(
        pool(vec![a, other]).unwrap_err(),
        PoolError::Protocols("default".into(), "dair".into())
    );
    assert_eq!(pool(vec![]).unwrap_err(), PoolError::Empty);
}

#[test]
fn blocks_of_one_log_have_an_interval_and_all_its_frames() {
    let one = evaluation("a", 3);
    let keys = |of: &Evaluation| {
        let frames = of.scenes.iter().flat_map(|scene| &scene.frames);
        frames
            .filter(|frame| frame.key)
            .map(|frame| frame.seq)
            .collect::<Vec<_>>()
    };
    let scored = keys(&one).len();
    assert!(scored > 1);
    for most in [2, 20] {
        let blocks = one.blocks(most);
        assert_eq!(blocks.scenes.len(), most.min(scored));
        assert_eq!(keys(&blocks), keys(&one));
        let frames = |of: &Evaluation| of.scenes.iter().map(|scene| scene.frames.len()).sum::<usize>();
        assert_eq!(frames(&blocks), frames(&one));
        assert_eq!(score(&blocks).accuracy.sorted, score(&one).accuracy.sorted);
        assert!(score(&blocks).intervals.is_some());
    }
    // The frames of two egos of one log are drawn together.
    let mut two = one.clone();
    two.scenes.push(Scene {
        ego: "other".into(),
        ..one.scenes[0].clone()
    });
    let names: Vec<String> = two.blocks(2).scenes.into_iter().map(|scene| scene.name).collect();
    assert_eq!(names[0], names[1]);
    assert_eq!(one.blocks(1).scenes.len(), 1);
}

#[test]
fn intervals_need_two_logs_and_hold_the_value() {
    assert!(score(&evaluation("a", 3)).intervals.is_none());
    let pooled = pool((2..9).map(|luck| evaluation(&format!("log{luck}"), luck)).collect()).unwrap();
    let scores = score(&pooled);
    assert_eq!(scores, score(&pooled));
    let intervals = scores.intervals.unwrap();
    for (bounds, accuracy) in [
        (&intervals.accuracy.sorted, &scores.accuracy.sorted),
        (&intervals.accuracy.v2x_real, &scores.accuracy.v2x_real),
    ] {
        let [low, high] = bounds.ap["vehicle"]["0.5"].unwrap();
        let value = accuracy.ap["vehicle"]["0.5"].unwrap();
        assert!(
            low < value && value < high && low > 0.0 && high <= 1.0,
            "{low} {value} {high}"
        );
        assert_eq!(bounds.ap["truck"]["0.5"], None);
        assert_eq!(bounds.mean_ap["0.5"], None);
    }
    // Logs that are all alike leave nothing to chance.
    let alike = pool(vec![evaluation("a", 3), evaluation("b", 3)]).unwrap();
    let scores = score(&alike);
    let [low, high] = scores.intervals.unwrap().accuracy.sorted.ap["vehicle"]["0.5"].unwrap();
    assert!((high - low).abs() < 0.05, "{low} {high}");
}

#[test]
fn frame_scores_add_up() {
    let evaluation = evaluation("a", 3);
    let scores = score(&evaluation);
    let frames = frame_scores(&evaluation);
    assert_eq!(frames.len(), 10);
    let sum = |pick: fn(&Counts) -> u64| {
        frames
            .iter()
            .map(|frame| pick(&frame.counts["vehicle"]["0.5"]))
            .sum::<u64>()
    };
    let sums = (sum(|c| c.true_positives), sum(|c| c.false_positives), sum(|c| c.total));
    assert_eq!(sums, counts(&scores, "vehicle", "0.5"));
    assert_eq!((frames[3].seq, frames[3].stamp, &*frames[3].ego), (3, 1300, "cav1"));
}

/// 90° wide, from the ego along x.
fn ahead() -> View {
    let axes = nalgebra::Matrix3::new(0.0, 0.0, 1.0, -1.0, 0.0, 0.0, 0.0, -1.0, 0.0);
    View {
        frame_from_camera: nalgebra::Isometry3::from_parts(
            nalgebra::Translation3::new(0.0, 0.0, 1.5),
            nalgebra::UnitQuaternion::from_matrix(&axes),
        ),
        focal: [500.0, 500.0],
        center: [500.0, 300.0],
        size: [1000, 600],
        margin: 0.0,
    }
}

/// What a vehicle and its partner labelled, of which one lies behind the vehicle, and what was detected there.
fn in_views() -> (GroundTruth, Vec<Box3>) {
    let both = GroundTruth {
        views: vec![ahead()],
        own: Some(Box::new(OwnLabels {
            boxes: vec![car(20.0, 1.0)],
            points: vec![],
            key: true,
            views: vec![ahead()],
        })),
        ..truth(vec![car(20.0, 1.0), car(40.0, 1.0), car(-30.0, 1.0)])
    };
    let detections = vec![car(20.0, 0.9), car(-30.0, 0.8), car(-50.0, 0.7), car(60.0, 0.6)];
    (both, detections)
}

fn with_keys(labels: Labels, outside_views: OutsideViews) -> Protocol {
    Protocol {
        labels,
        outside_views,
        ..Protocol::load("default").unwrap()
    }
}

#[test]
fn only_what_could_be_labelled_is_scored() {
    let (truth, boxes) = in_views();
    let score = |protocol: &Protocol, truth: &GroundTruth| -> EvaluationReport {
        let truths = [(header(0, Kind::Truth), truth.clone())];
        let boxes = [(header(0, Kind::Boxes), Boxes(boxes.clone()))];
        evaluate(truths, boxes, protocol).unwrap().into()
    };
    for (labels, outside, expected, ignored) in [
        (Labels::All, OutsideViews::Counted, (2, 2, 3), None),
        (Labels::All, OutsideViews::Ignored, (1, 1, 2), Some((2, 1))),
        (Labels::Own, OutsideViews::Counted, (1, 3, 1), None),
        (Labels::Own, OutsideViews::Ignored, (1, 1, 1), Some((2, 0))),
    ] {
        let report = score(&with_keys(labels, outside), &truth);
        assert_eq!(
            counts(&report.scores, "vehicle", "0.5"),
            expected,
            "{labels:?} {outside:?}"
        );
        let in_no_view = report
            .scores
            .in_no_view
            .map(|ignored| (ignored.detections, ignored.objects));
        assert_eq!(in_no_view, ignored, "{labels:?} {outside:?}");
        let frames = &frame_scores(&report.evaluation)[0].counts["vehicle"]["0.5"];
        assert_eq!((frames.true_positives, frames.false_positives, frames.total), expected);
        // A file gives the same back.
        let text = serde_json::to_string(&report).unwrap();
        assert_eq!(serde_json::from_str::<EvaluationReport>(&text).unwrap(), report);
        assert_eq!(text.contains("in_no_view\":{\"detections\":["), ignored.is_some());
    }
    // Two views: in one of them is enough.
    let behind = ahead().moved(&nalgebra::Isometry3::rotation(
        nalgebra::Vector3::z() * std::f64::consts::PI,
    ));
    let wider = GroundTruth {
        views: vec![ahead(), behind],
        ..truth.clone()
    };
    let report = score(&with_keys(Labels::All, OutsideViews::Ignored), &wider);
    assert_eq!(counts(&report.scores, "vehicle", "0.5"), (2, 2, 3));
    // Without views all is scored as ever, and a note says so.
    let blind = GroundTruth { views: vec![], ..truth };
    let report = score(&with_keys(Labels::All, OutsideViews::Ignored), &blind);
    assert_eq!(counts(&report.scores, "vehicle", "0.5"), (2, 2, 3));
    let notes = &report.scores.notes;
    assert!(
        notes
            .iter()
            .any(|note| note.contains("1 of 1 scored frames have no views")),
        "{notes:?}"
    );
}

#[test]
fn own_labels_that_did_not_come_are_asked_for() {
    let mut collector = Collector::new(with_keys(Labels::Own, OutsideViews::Ignored));
    let error = collector
        .add_truth(&header(0, Kind::Truth), &truth(vec![car(20.0, 1.0)]))
        .unwrap_err();
    let error = error.to_string();
    assert!(
        error.contains("/cav1/own_labels") && error.contains("`labels: all`") && error.contains("protocol `default`"),
        "{error}"
    );
}

#[test]
fn own_labels_count_by_the_egos_own_points() {
    let protocol = with_keys(Labels::Own, OutsideViews::Counted);
    let labelled = GroundTruth {
        own: Some(Box::new(OwnLabels {
            boxes: vec![car(20.0, 1.0), car(30.0, 1.0), car(40.0, 1.0)],
            points: vec![4, 5, 10],
            key: true,
            views: vec![],
        })),
        key: false,
        ..truth(vec![])
    };
    let truths = [(header(0, Kind::Truth), labelled)];
    let boxes = [(header(0, Kind::Boxes), Boxes(vec![car(30.0, 0.9), car(40.0, 0.8)]))];
    let scores = score(&evaluate(truths, boxes, &protocol).unwrap());
    assert_eq!(counts(&scores, "vehicle", "0.5"), (2, 0, 2));
    assert_eq!(scores.dropped_truths.few_points, 1);
    let seen = scores.accuracy_seen.sorted.counts["vehicle"]["0.5"];
    assert_eq!(
        (seen.true_positives, seen.false_positives, seen.total),
        (1, 0, 1),
        "a frame that only own labels score"
    );
}
