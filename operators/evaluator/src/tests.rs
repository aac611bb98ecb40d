use realo_operator::{Outputs, PortId};
use realo_schemas::report::from_report;
use realo_schemas::{Box3, Boxes, GroundTruth, Header, Kind, Message, Pose, Report, TraceEntry};

use super::*;

fn car() -> Box3 {
    Box3 {
        center: [10.0, 0.0, 0.8],
        length: 4.0,
        width: 2.0,
        height: 1.5,
        yaw: 0.0,
        velocity: None,
        class: "Car".into(),
        score: 0.9,
        track: None,
        covariance: None,
    }
}

fn header(seq: u64, kind: Kind) -> Header {
    let stamp = 1_000 + 100 * seq as i64;
    Header::origin(&"run".into(), &"cav1".into(), kind, seq, stamp, stamp + 50)
}

fn truth(seq: u64, boxes: Vec<Box3>) -> Message {
    let truth = GroundTruth {
        boxes,
        agents: vec!["cav1".into()],
        points: vec![],
        ego_footprint: None,
        key: true,
        ..GroundTruth::default()
    };
    Message::new(header(seq, Kind::Truth), truth)
}

fn boxes(seq: u64, boxes: Vec<Box3>) -> Message {
    Message::new(header(seq, Kind::Boxes), Boxes(boxes))
}

#[test]
fn reports_once_at_the_end() {
    let mut evaluator = Evaluator::new(Settings::default()).unwrap();
    let mut out = Outputs::at(0);
    evaluator
        .on_message(Input::BOXES, boxes(0, vec![car()]), &mut out)
        .unwrap();
    evaluator
        .on_message(Input::TRUTH, truth(0, vec![car()]), &mut out)
        .unwrap();
    evaluator
        .on_message(Input::BOXES, boxes(5, vec![car()]), &mut out)
        .unwrap();
    evaluator
        .on_message(Input::TRUTH, truth(1, vec![car()]), &mut out)
        .unwrap();
    assert!(out.take_sent().is_empty());
    evaluator.on_end(&mut out).unwrap();
    let mut sent = out.take_sent();
    assert_eq!(sent.len(), 1);
    let (port, message) = sent.remove(0);
    let (header, report): (Header, Report) = message.into_parts().unwrap();
    let of = (port, header.kind, &*header.agent, header.seq, &*report.topic);
    assert_eq!(of, (Output::REPORT, Kind::Report, "cav1", 0, "evaluation"));
    let report: EvaluationReport = from_report(&report).unwrap();
    let counts = report.scores.accuracy.sorted.counts["vehicle"]["0.5"];
    assert_eq!((counts.true_positives, counts.false_positives, counts.total), (1, 0, 2));
    assert_eq!(out.counted("boxes_without_truth"), 1);
}

#[test]
fn the_header_of_the_report_is_that_of_the_last_truth_without_its_way() {
    let mut operator = Evaluator::new(Settings::default()).unwrap();
    let mut out = Outputs::at(0);
    let mut last = header(4, Kind::Truth);
    last.pose = Some(Pose::exact(Default::default()));
    last.trace.push(TraceEntry {
        node: "player".into(),
        input: 0,
        start: 0,
        done: 0,
        ready: 0,
    });
    let second = Message {
        header: last,
        ..truth(4, vec![])
    };
    for (port, message) in [
        (Input::TRUTH, truth(3, vec![])),
        (Input::TRUTH, second),
        (Input::BOXES, boxes(5, vec![])),
    ] {
        operator.on_message(port, message, &mut out).unwrap();
    }
    operator.on_end(&mut out).unwrap();
    let found = out.take_sent().remove(0).1.header;
    let expected = Header {
        kind: Kind::Report,
        seq: 0,
        ..header(4, Kind::Truth)
    };
    assert_eq!(found, expected);
}

#[test]
fn counts_by_its_protocol() {
    let config = |protocol: &str| Settings {
        protocol: protocol.into(),
    };
    let mut evaluator = Evaluator::new(config("dair")).unwrap();
    let mut out = Outputs::at(0);
    evaluator
        .on_message(Input::TRUTH, truth(0, vec![car()]), &mut out)
        .unwrap();
    evaluator.on_end(&mut out).unwrap();
    let report: Report = out.take_sent().remove(0).1.into_parts().unwrap().1;
    let report: EvaluationReport = from_report(&report).unwrap();
    assert_eq!(report.evaluation.protocol, Protocol::load("dair").unwrap());
    let error = Evaluator::new(config("no/such/protocol.yml"))
        .err()
        .unwrap()
        .to_string();
    assert!(error.contains("no/such/protocol.yml"), "{error}");
}

#[test]
fn refuses_what_fits_no_port_and_second_messages() {
    let mut evaluator = Evaluator::new(Settings::default()).unwrap();
    let mut out = Outputs::at(0);
    evaluator.on_message(Input::TRUTH, truth(0, vec![]), &mut out).unwrap();
    let mut refused = |port, message| evaluator.on_message(port, message, &mut out).unwrap_err().to_string();
    let error = refused(Input::TRUTH, truth(0, vec![]));
    assert!(error.contains("second message of truth for sweep 0"), "{error}");
    let error = refused(Input::BOXES, truth(3, vec![]));
    assert!(error.contains("expected a Boxes"), "{error}");
    let error = refused(PortId(2), boxes(3, vec![]));
    assert!(error.contains("port"), "{error}");
}

#[test]
fn has_nothing_to_report_without_truth() {
    let mut evaluator = Evaluator::new(Settings::default()).unwrap();
    let mut out = Outputs::at(0);
    evaluator.on_message(Input::BOXES, boxes(0, vec![]), &mut out).unwrap();
    evaluator.on_end(&mut out).unwrap();
    assert!(out.take_sent().is_empty());
}
