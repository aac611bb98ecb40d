//! What lies on an edge: of an overlap, a region, a footprint, a protocol.

use realo_schemas::{Box3, Boxes, GroundTruth, Header, Kind};
use realo_scoring::*;

fn outline(x: f64, length: f64, width: f64) -> Outline {
    Outline::new([x, 0.0], length, width, 0.0)
}

fn frame(detections: &[Outline], truths: &[Outline]) -> Frame {
    let detection = |outline: &Outline| Detection {
        class: 0,
        score: 0.5,
        outline: *outline,
    };
    let truth = |outline: &Outline| Truth {
        class: 0,
        outline: *outline,
        points: None,
    };
    Frame {
        key: true,
        processed: true,
        detections: detections.iter().map(detection).collect(),
        truths: truths.iter().map(truth).collect(),
        ..Frame::default()
    }
}

fn outcomes(frame: &Frame, iou: f64) -> Vec<(usize, Outcome)> {
    match_frame(frame, &Protocol::load("default").unwrap(), 0, iou, Scope::All)
}

#[test]
fn an_overlap_of_just_the_threshold_is_true() {
    let half = frame(&[outline(0.0, 2.0, 1.0)], &[outline(0.0, 2.0, 2.0)]);
    assert_eq!(outcomes(&half, 0.5), [(0, Outcome::True(0))]);
    assert_eq!(outcomes(&half, 0.5 + 1e-9), [(0, Outcome::False)]);
}

#[test]
fn of_equal_overlaps_the_first_is_taken_and_of_equal_scores_the_first_takes() {
    let [a, b, between] = [-0.5, 0.5, 0.0].map(|x| outline(x, 4.0, 2.0));
    assert_eq!(
        outcomes(&frame(&[between, between], &[a, b]), 0.3),
        [(0, Outcome::True(0)), (1, Outcome::True(1))]
    );
    assert_eq!(
        outcomes(&frame(&[b, between], &[between]), 0.3),
        [(0, Outcome::True(0)), (1, Outcome::False)]
    );
}

#[test]
fn outlines_overlap_by_their_headings() {
    let turned = |length, width, yaw| Outline::new([10.0, -5.0], length, width, yaw);
    let quarter = std::f64::consts::FRAC_PI_2;
    let across = frame(&[turned(4.0, 1.0, quarter)], &[turned(1.0, 4.0, 0.0)]);
    assert_eq!(outcomes(&across, 0.99), [(0, Outcome::True(0))]);
    let crossed = frame(&[turned(4.0, 1.0, quarter)], &[turned(4.0, 1.0, 0.0)]);
    assert_eq!(outcomes(&crossed, 0.142), [(0, Outcome::True(0))], "1 of 7 m²");
    assert_eq!(outcomes(&crossed, 0.143), [(0, Outcome::False)]);
}

#[test]
fn outlines_are_in_micrometres_and_ten_nanoradians() {
    let car = Outline::new([10.0, -2.5], 4.5, 1.9, 0.5);
    let expected = Outline {
        center: [10_000_000, -2_500_000],
        length: 4_500_000,
        width: 1_900_000,
        yaw: 50_000_000,
    };
    assert_eq!(car, expected);
    assert_eq!(car.center_m(), [10.0, -2.5]);
    let far = Outline::new([1e9, -1e9], 1e9, 2.0, 7.0);
    assert_eq!((far.center, far.length), ([i32::MAX, i32::MIN], i32::MAX));
    assert_eq!(far.yaw, ((7.0 - std::f64::consts::TAU) * 1e8).round() as i32);
}

fn car(x: f64, y: f64) -> Box3 {
    Box3 {
        center: [x, y, 0.8],
        length: 4.0,
        width: 2.0,
        height: 1.5,
        yaw: 0.0,
        velocity: None,
        class: "Car".into(),
        score: 0.5,
        track: None,
        covariance: None,
    }
}

#[test]
fn a_rule_says_what_of_a_box_lies_in_the_region() {
    let mut protocol = Protocol::load("default").unwrap();
    assert!(protocol.takes_in(&car(98.0, 0.0)) && !protocol.takes_in(&car(98.1, 0.0)));
    protocol.rule = Rule::Center;
    for (x, y, inside) in [(100.0, 40.0, true), (100.1, 0.0, false), (0.0, -40.1, false)] {
        assert_eq!(protocol.takes_in(&car(x, y)), inside, "{x} {y}");
    }
}

#[test]
fn names_of_super_classes_count_in_any_case() {
    let mut protocol = Protocol::load("default").unwrap();
    assert_eq!(
        (protocol.class_of("Truck"), protocol.class_of("TRUCK")),
        (Some(2), Some(2))
    );
    assert_eq!(protocol.class_of("van"), Some(2));
    protocol.ignore_case = false;
    assert_eq!((protocol.class_of("van"), protocol.class_of("Van")), (None, Some(2)));
}

#[test]
fn a_protocol_is_held_to_its_limits() {
    let text = include_str!("../protocols/default.yml");
    let parse = |from: &str, to: &str| {
        assert!(text.contains(from), "{from}");
        Protocol::parse("mine.yml", &text.replacen(from, to, 1)).map_err(|error| error.to_string())
    };
    assert!(parse("ious: [0.3, 0.5]", "ious: [1]").is_ok());
    assert!(parse("ignore_case: true\n", "").is_ok_and(|protocol| protocol.ignore_case));
    let cases = [
        ("ious: [0.3, 0.5]", "ious: [1.1]", "`ious`"),
        ("ious: [0.3, 0.5]", "ious: []", "`ious`"),
        ("ious: [0.3, 0.5]", "ious: [0.3, 0.3]", "`ious`"),
        ("range_edges: [0, 30, 50]", "range_edges: [0, 30, 30]", "`range_edges`"),
        ("range_edges: [0, 30, 50]", "range_edges: [0, .inf]", "`range_edges`"),
        ("range_edges: [0, 30, 50]", "range_edges: []", "`range_edges`"),
        ("name: truck", "name: \"\"", "lower case"),
        ("name: truck", "name: vehicle", "`super-class vehicle` appears twice"),
        ("ignore_case: true", "ignore_cas: true", "ignore_cas"),
    ];
    for (from, to, expected) in cases {
        let error = parse(from, to).unwrap_err();
        assert!(error.contains("mine.yml") && error.contains(expected), "{to}: {error}");
    }
    // In any case, `truck` and `Truck` are one name.
    assert!(parse("ignore_case: true", "ignore_case: false").is_ok());
    let twice = text.replacen("PoliceCar", "VAN", 1);
    assert!(
        Protocol::parse("mine.yml", &twice)
            .unwrap_err()
            .to_string()
            .contains("`van` appears twice")
    );
    let many = |n: usize| {
        let classes: Vec<String> = (0..n).map(|i| format!("{{name: c{i}, raw: []}}")).collect();
        let start = text.find("classes:").unwrap();
        let end = text.find("ignore_case").unwrap();
        let text = format!("{}classes: [{}]\n{}", &text[..start], classes.join(", "), &text[end..]);
        Protocol::parse("mine.yml", &text).map(|protocol| protocol.classes.len())
    };
    assert_eq!(many(255).unwrap(), 255);
    for n in [0, 256] {
        assert!(
            many(n)
                .unwrap_err()
                .to_string()
                .contains(&format!("1 to 255 super-classes, found {n}"))
        );
    }
}

#[test]
fn what_is_centred_on_the_egos_own_edge_is_the_ego() {
    let header = |kind| Header::origin(&"run".into(), &"cav1".into(), kind, 0, 0, 0);
    let truth = GroundTruth {
        ego_footprint: Some([-1.0, 4.0, -1.0, 1.0]),
        key: true,
        ..GroundTruth::default()
    };
    let detections = [
        (-1.0, -1.0),
        (4.0, 1.0),
        (4.01, 0.0),
        (-1.01, 0.0),
        (0.0, 1.01),
        (0.0, -1.01),
    ];
    let detections = detections.map(|(x, y)| car(x, y)).to_vec();
    let evaluation = evaluate(
        [(header(Kind::Truth), truth)],
        [(header(Kind::Boxes), Boxes(detections))],
        &Protocol::load("default").unwrap(),
    )
    .unwrap();
    let scene = &evaluation.scenes[0];
    assert_eq!(
        (scene.dropped_detections.own_body, scene.frames[0].detections.len()),
        (2, 4)
    );
}

#[test]
fn what_was_dropped_adds_up_over_scenes() {
    let dropped = |n: u64| Dropped {
        invalid: n,
        outside: 2 * n,
        own_body: 3 * n,
        few_points: 4 * n,
        classes: [("tree".to_string(), 5 * n)].into(),
    };
    let scene = |ego: &str, n: u64| Scene {
        ego: ego.into(),
        dropped_detections: dropped(n),
        dropped_truths: dropped(10 * n),
        boxes_without_truth: n,
        ..Scene::default()
    };
    let evaluation = Evaluation {
        protocol: Protocol::load("default").unwrap(),
        scenes: vec![scene("a", 1), scene("b", 2)],
    };
    let scores = score(&evaluation);
    assert_eq!(scores.dropped_detections, dropped(3));
    assert_eq!(scores.dropped_truths, dropped(30));
    assert_eq!(scores.boxes_without_truth, 3);
}

#[test]
fn the_protocol_of_the_page_has_every_key() {
    let page = include_str!("../../../docs/reference/protocols.md");
    let text = page.split("```yaml").nth(1).and_then(|rest| rest.split("```").next());
    let protocol = Protocol::parse("page", text.expect("the page has an example")).unwrap();
    assert_eq!((&*protocol.name, protocol.class_of("walker")), ("mine", Some(1)));
    let keys = serde_json::to_value(&protocol).unwrap();
    for key in keys.as_object().unwrap().keys() {
        assert!(page.contains(&format!("| `{key}` |")), "the page explains `{key}`");
    }
    for rule in [Rule::AllBottomCorners, Rule::Center] {
        let name = serde_json::to_value(rule).unwrap();
        assert!(page.contains(&format!("`{}`", name.as_str().unwrap())), "{name}");
    }
}
