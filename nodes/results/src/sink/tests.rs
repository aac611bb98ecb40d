use std::path::Path;

use realo_operator::{Books, InputBooks, NodeBooks, PortId, Tally};
use realo_schemas::report::{Channel, Crossing, Fate, Traffic, Use, to_report};
use realo_schemas::{Box3, Boxes, Clock, GroundTruth, Header, Kind, Message, Nanos, TraceEntry};
use realo_scoring::{EvaluationReport, Protocol, evaluate, score};

use super::*;
use crate::{Accounted, Fates, FilesError, Frames, LinkBooks, read_run};

const MS: Nanos = 1_000_000;

fn header(seq: u64, kind: Kind) -> Header {
    let stamp = seq as Nanos * 100 * MS;
    Header::origin(&"run-17".into(), &"cav1".into(), kind, seq, stamp, stamp + 50 * MS)
}

fn car(x: f64, score: f32) -> Box3 {
    Box3 {
        score,
        ..Box3::new("Car", [x, 0.0, 0.8], [4.0, 2.0, 1.6], 0.0)
    }
}

fn truth() -> GroundTruth {
    GroundTruth {
        boxes: vec![car(10.0, 1.0), car(20.0, 1.0)],
        agents: vec!["cav1".into(), "rsu1".into()],
        key: true,
        ..GroundTruth::default()
    }
}

/// Final boxes, and the way that they came: detection takes 4 ms, then fusion 2.
fn boxes(seq: u64) -> Message {
    let mut header = header(seq, Kind::Boxes);
    let ready = header.ready;
    let entry = |node: &str, from: Nanos, to: Nanos| TraceEntry {
        node: node.into(),
        input: ready + from * MS,
        start: ready + from * MS,
        done: ready + to * MS,
        ready: ready + to * MS,
    };
    header.trace = vec![entry("player", 0, 0), entry("detect", 0, 4), entry("fusion", 4, 6)];
    header.ready += 6 * MS;
    Message::new(header, Boxes(vec![car(10.0, 0.9)]))
}

fn a_report<T: Serialize>(topic: &str, document: &T) -> Message {
    Message::new(header(0, Kind::Report), to_report(topic, document))
}

/// What became of a message of rsu1; data that were used are 30 ms old.
fn fated(kind: Kind, seq: u64, fate: Fate) -> Fated {
    let r#use = Use {
        query: seq,
        age_ns: 30 * MS,
    };
    Fated {
        message: Crossing {
            from: "rsu1".into(),
            to: "cav1".into(),
            kind,
            seq,
        },
        fate,
        r#use: (fate == Fate::Used).then_some(r#use),
        entry: None,
    }
}

fn channel(kind: Kind, sent: u64) -> Channel {
    Channel {
        from: "rsu1".into(),
        to: "cav1".into(),
        kind,
        traffic: Traffic {
            sent,
            bytes: 1000 * sent,
            ..Traffic::default()
        },
    }
}

fn evaluation(sweeps: u64, skipped: &[u64]) -> Message {
    let truths = (0..sweeps).map(|seq| (header(seq, Kind::Truth), truth()));
    let found = (0..sweeps).filter(|seq| !skipped.contains(seq)).map(boxes);
    let found = found.map(|message| message.into_parts::<Boxes>().unwrap());
    let evaluation = evaluate(truths, found, &Protocol::load("default").unwrap()).unwrap();
    let report = EvaluationReport {
        scores: score(&evaluation),
        evaluation,
    };
    a_report(TOPIC, &report)
}

/// Books of a graph whose bank takes what a link brought, and whose decoder could not read one of them.
fn books(channels: &[Channel]) -> Books {
    let link = NodeBooks {
        name: "link".into(),
        channels: channels.to_vec(),
        ..NodeBooks::default()
    };
    let mut decoder = NodeBooks {
        name: "transmission-decoder".into(),
        errors: 1,
        ..NodeBooks::default()
    };
    decoder
        .compute
        .entry("packets > messages".into())
        .or_default()
        .record(2 * MS);
    let others = InputBooks {
        accounts: vec![Kind::Points, Kind::Boxes],
        receivers: ["cav1".to_string()].into(),
        ..InputBooks::default()
    };
    let bank = NodeBooks {
        name: "feature-bank".into(),
        inputs: [("others".into(), others)].into(),
        ..NodeBooks::default()
    };
    Books {
        nodes: [
            ("link".into(), link),
            ("decoder".into(), decoder),
            ("bank".into(), bank),
        ]
        .into(),
    }
}

/// Of the ten sweeps: what two links carried.
fn both() -> Books {
    books(&[channel(Kind::Boxes, 17), channel(Kind::AgentState, 100)])
}

fn sink(out: &Path) -> Results {
    let reported = RunSettings {
        log: "intersection".into(),
        settings: crate::Settings {
            graph: "late_fusion".into(),
            ..crate::Settings::default()
        },
        ..RunSettings::default()
    };
    let path = out.join("run.json");
    std::fs::write(&path, serde_json::to_string(&reported).unwrap()).unwrap();
    Results::new(Settings {
        out: out.into(),
        run_settings: path,
        stamps: StampRule::default(),
    })
    .unwrap()
}

/// Ten sweeps; sweep 3 is skipped.
fn ten_sweeps() -> Vec<(PortId, Message)> {
    let mut messages = Vec::new();
    for seq in 0..10 {
        messages.push((Input::TRUTH, Message::new(header(seq, Kind::Truth), truth())));
        if seq != 3 {
            messages.push((Input::BOXES, boxes(seq)));
        }
    }
    messages.push((Input::EVALUATION, evaluation(10, &[3])));
    messages
}

/// Of the ten sweeps: sweep 3 is skipped, the fusion takes no more at 5, a guard leaves 6 out, the rest uses what was selected; one message
/// each is skipped, rejected, stale, superseded, in flight, and two are lost.
fn ten_fates() -> Vec<Fated> {
    let selected = (0..10).map(|seq| match seq {
        3 => Fate::Skipped,
        5 => Fate::OverLimit,
        6 => Fate::Distrusted,
        _ => Fate::Used,
    });
    let others = [
        Fate::Skipped,
        Fate::Rejected,
        Fate::Stale,
        Fate::Superseded,
        Fate::InFlight,
        Fate::Lost,
        Fate::Lost,
    ];
    let all = selected.chain(others).zip(0..);
    let mut fates: Vec<_> = all.map(|(fate, seq)| fated(Kind::Boxes, seq, fate)).collect();
    // What several stages say of a message is joined.
    fates.push(fated(Kind::Boxes, 2, Fate::Superseded));
    fates.extend((0..7).map(|seq| fated(Kind::AgentState, seq, Fate::Lost)));
    fates
}

fn run_in(out: &Path, messages: Vec<(PortId, Message)>, fates: &[Fated], books: &Books) -> Run {
    let mut sink = sink(out);
    messages
        .into_iter()
        .for_each(|(port, message)| sink.on_message(port, message).unwrap());
    sink.fates(fates).unwrap();
    assert!(
        matches!(read_run(out), Err(FilesError::Incomplete { .. })),
        "no result before the end"
    );
    sink.finish(books).unwrap();
    read_run(out).unwrap()
}

#[test]
fn accounts_for_every_message() {
    let folder = tempfile::tempdir().unwrap();
    let Run { result, samples, .. } = run_in(folder.path(), ten_sweeps(), &ten_fates(), &both());
    let expected = LinkBooks {
        sent: 17,
        bytes: 17_000,
        lost: 2,
        accounted: Some(Accounted {
            fates: Fates {
                used: 7,
                skipped: 2,
                over_limit: 1,
                distrusted: 1,
                stale: 1,
                superseded: 1,
                rejected: 1,
                in_flight: 1,
            },
            unaccounted: 0,
        }),
        ..LinkBooks::default()
    };
    assert_eq!(result.links["rsu1-cav1"]["boxes"], expected);
    let state = &result.links["rsu1-cav1"]["agent_state"];
    assert_eq!((state.sent, state.lost, state.accounted), (100, 7, None));
    assert_eq!((result.age_ms.all.count, result.age_ms.by_kind["boxes"].count), (7, 7));
    assert!((result.age_ms.all.p50.unwrap() - 30.0).abs() < 0.05);
    assert_eq!(samples.ages_ns[&Kind::Boxes].count(), 7);
    assert!(
        result
            .notes
            .iter()
            .any(|note| note == "1 of 10 sweeps of the ego gave no boxes"),
        "{:?}",
        result.notes
    );
    assert!(
        result
            .notes
            .iter()
            .any(|note| note.starts_with("decoder (transmission-decoder) failed on 1 of 1 messages"))
    );
}

#[test]
fn scores_are_those_of_the_evaluator() {
    let folder = tempfile::tempdir().unwrap();
    let Run { result, samples, .. } = run_in(folder.path(), ten_sweeps(), &ten_fates(), &both());
    let frames = Frames {
        total: 10,
        key: 10,
        skipped: 1,
        key_skipped: 1,
        processed: 9,
    };
    assert_eq!(result.frames, frames);
    let evaluation = samples.evaluation.unwrap();
    assert_eq!(evaluation.scenes[0].name, "intersection");
    let scores = score(&evaluation);
    assert_eq!(result.accuracy, Some(scores.accuracy));
    let json: serde_json::Value =
        serde_json::from_slice(&std::fs::read(folder.path().join("result.json")).unwrap()).unwrap();
    assert_eq!(json["accuracy"]["sorted"]["AP"]["vehicle"]["0.5"], 0.45);
    assert_eq!(json["accuracy_processed"]["v2x-real"]["AP"]["vehicle"]["0.5"], 0.5);
    assert_eq!(json["accuracy_seen"]["sorted"]["counts"]["vehicle"]["0.3"]["total"], 0);
    assert_eq!(json["links"]["rsu1-cav1"]["boxes"]["over_limit"], 1);
    assert_eq!((&json["mode"], &json["ego"]), (&"virtual".into(), &"cav1".into()));
    assert_eq!(json["agents"], serde_json::json!(["cav1", "rsu1"]));
}

#[test]
fn a_result_in_virtual_time_names_no_run_place_or_date() {
    let (one, other) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let _ = run_in(one.path(), ten_sweeps(), &ten_fates(), &both());
    let again: Vec<_> = ten_sweeps()
        .into_iter()
        .map(|(port, mut message)| {
            message.header.run = "run-18".into();
            (port, message)
        })
        .collect();
    let _ = run_in(other.path(), again, &ten_fates(), &both());
    for file in ["result.json", "timing.json", "evaluation.json"] {
        let read = |folder: &Path| std::fs::read_to_string(folder.join(file)).unwrap();
        assert_eq!(read(one.path()), read(other.path()), "{file}");
        assert!(!read(one.path()).contains("run-17") && !read(one.path()).contains(one.path().to_str().unwrap()));
    }
}

#[test]
fn times_are_those_of_the_way_of_the_boxes() {
    let folder = tempfile::tempdir().unwrap();
    let mut messages = ten_sweeps();
    for (_, message) in &mut messages {
        message.header.clock = Some(Clock {
            wall_origin: 0,
            log_origin: 0,
            rate: 2.0,
        });
    }
    let Run { timing, result, .. } = run_in(folder.path(), messages, &ten_fates(), &both());
    assert_eq!(result.settings.mode, "realtime");
    let p50 = |stage: &str| (timing.latency_ms[stage].p50.unwrap() * 10.0).round() / 10.0;
    assert_eq!(
        [p50("detect"), p50("fusion"), p50("end_to_end"), p50("framework")],
        [2.0, 1.0, 3.0, 3.0]
    );
    assert_eq!(timing.rate_hz, Some(9.0));
    let decoding = timing.compute_ns["decoder"]["packets > messages"];
    assert!((decoding - 2 * MS).abs() < 2 * MS / 500);
}

#[test]
fn without_fusion_there_are_no_links() {
    let folder = tempfile::tempdir().unwrap();
    let messages = vec![
        (Input::TRUTH, Message::new(header(0, Kind::Truth), truth())),
        (Input::BOXES, boxes(0)),
        (Input::EVALUATION, evaluation(1, &[])),
    ];
    let Run { result, .. } = run_in(folder.path(), messages, &[], &books(&[]));
    assert!(result.links.is_empty());
    assert_eq!(
        (result.age_ms.all.count, result.age_ms.all.p50, result.frames.processed),
        (0, None, 1)
    );
}

#[test]
fn what_busy_nodes_skip_of_collaborators_is_a_note() {
    let folder = tempfile::tempdir().unwrap();
    let mut books = books(&[channel(Kind::Boxes, 0)]);
    let tally = |agent: &str, kind: Kind, n: u64| {
        let mut tally = Tally::default();
        let mut header = header(0, kind);
        header.agent = agent.into();
        (0..n).for_each(|_| tally.add(&Message::new(header.clone(), Boxes(vec![]))));
        tally
    };
    let input = |agent: &str, kind: Kind| InputBooks {
        received: tally(agent, kind, 15),
        skipped: tally(agent, kind, 5),
        ..InputBooks::default()
    };
    if let Some(bank) = books.nodes.get_mut("bank") {
        bank.inputs.insert("maps".into(), input("rsu1", Kind::Features));
        bank.inputs.insert("states".into(), input("rsu1", Kind::AgentState));
        bank.inputs.insert("own".into(), input("cav1", Kind::Features));
    }
    let messages = vec![
        (Input::TRUTH, Message::new(header(0, Kind::Truth), truth())),
        (Input::BOXES, boxes(0)),
    ];
    let Run { result, .. } = run_in(folder.path(), messages, &[], &books);
    let about = |words: &str| result.notes.iter().filter(|note| note.starts_with(words)).count();
    let found = [about("rsu1: 5 of 20 messages were skipped at `bank`"), about("cav1: ")];
    assert_eq!(found, [1, 0], "{:?}", result.notes);
}

#[test]
fn boxes_that_come_again_answer_no_other_sweep() {
    let folder = tempfile::tempdir().unwrap();
    let truths = (0..4).map(|seq| (Input::TRUTH, Message::new(header(seq, Kind::Truth), truth())));
    let mut messages: Vec<_> = truths.collect();
    // Of four sweeps one is answered, four times; and one that nobody has measured.
    messages.extend([1, 1, 1, 1, 9].map(|seq| (Input::BOXES, boxes(seq))));
    let Run { result, timing, .. } = run_in(folder.path(), messages, &[], &books(&[]));
    let frames = (result.frames.total, result.frames.processed, result.frames.skipped);
    assert_eq!(frames, (4, 1, 3));
    assert_eq!(timing.samples.processed, 1);
    let boxes = result.boxes.unwrap();
    assert_eq!((boxes.frames, boxes.total), (2, 2), "each sweep once");
    assert!(
        result
            .notes
            .iter()
            .any(|note| note == "3 of 4 sweeps of the ego gave no boxes")
    );
}

#[test]
fn counts_boxes_whether_or_not_there_is_truth() {
    let folder = tempfile::tempdir().unwrap();
    let of = |seq: u64, found: Vec<Box3>| (Input::BOXES, Message::new(header(seq, Kind::Boxes), Boxes(found)));
    let bus = Box3::new("Bus", [5.0, 0.0, 1.5], [12.0, 2.5, 3.0], 0.0);
    let messages = vec![of(0, vec![car(10.0, 0.9), bus, car(20.0, 0.8)]), of(1, vec![])];
    let Run { result, .. } = run_in(folder.path(), messages, &[], &books(&[]));
    assert_eq!(result.accuracy, None);
    let text = std::fs::read_to_string(folder.path().join("result.json")).unwrap();
    let json: serde_json::Value = serde_json::from_str(&text).unwrap();
    let expected = serde_json::json!({"frames": 2, "total": 3, "per_frame": 1.5, "by_class": {"Bus": 1, "Car": 2}});
    assert_eq!(json["boxes"], expected);
    let folder = tempfile::tempdir().unwrap();
    let truth = vec![(Input::TRUTH, Message::new(header(0, Kind::Truth), truth()))];
    let Run { result, .. } = run_in(folder.path(), truth, &[], &books(&[]));
    assert_eq!(result.boxes, None, "no list came");
}

#[test]
fn says_nothing_about_fates_where_nobody_takes_what_crossed() {
    let folder = tempfile::tempdir().unwrap();
    let mut books = books(&[channel(Kind::Boxes, 5)]);
    books.nodes.remove("bank");
    let Run { result, .. } = run_in(folder.path(), vec![(Input::BOXES, boxes(0))], &[], &books);
    assert_eq!(result.links["rsu1-cav1"]["boxes"].accounted, None);
    assert_eq!(result.accuracy, None);
}

#[test]
fn tells_what_dora_lost_and_what_is_missing_for_it() {
    let folder = tempfile::tempdir().unwrap();
    let mut books = books(&[channel(Kind::Boxes, 19)]);
    let lossy = InputBooks {
        transport_lost: 2,
        transport_reordered: 1,
        ..InputBooks::default()
    };
    if let Some(bank) = books.nodes.get_mut("bank") {
        bank.inputs.insert("ego".into(), lossy);
    }
    let Run { result, .. } = run_in(folder.path(), ten_sweeps(), &ten_fates(), &books);
    let edge = EdgeBooks {
        lost: 2,
        repeated: 0,
        reordered: 1,
    };
    assert_eq!((result.transport.total_lost, result.transport.edges.len()), (2, 1));
    assert_eq!(result.transport.edges["bank.ego"], edge);
    assert_eq!(result.links["rsu1-cav1"]["boxes"].accounted.unwrap().unaccounted, 2);
    assert!(result.notes[1].contains("dora lost 2 messages"), "{:?}", result.notes);
    assert!(
        result
            .notes
            .iter()
            .any(|note| note.contains("2 of 19 boxes messages are not accounted for"))
    );
}

#[test]
fn refuses_reports_of_another_topic_or_form() {
    let folder = tempfile::tempdir().unwrap();
    let mut sink = sink(folder.path());
    let error = sink
        .on_message(Input::EVALUATION, a_report("fusion", &1))
        .unwrap_err()
        .to_string();
    assert!(error.contains("`evaluation`") && error.contains("`fusion`"), "{error}");
    let error = sink
        .on_message(Input::EVALUATION, a_report(TOPIC, &["x"]))
        .unwrap_err()
        .to_string();
    assert!(error.contains("report `evaluation`"), "{error}");
    let error = sink
        .on_message(Input::BOXES, a_report(TOPIC, &1))
        .unwrap_err()
        .to_string();
    assert!(error.contains("expected a Boxes"), "{error}");
    assert!(sink.on_message(PortId(3), boxes(0)).is_err());
    sink.on_message(Input::EVALUATION, evaluation(1, &[])).unwrap();
    let error = sink
        .on_message(Input::EVALUATION, evaluation(1, &[]))
        .unwrap_err()
        .to_string();
    assert!(error.contains("second report"), "{error}");
}

#[test]
fn refuses_a_folder_of_somebody_else_before_the_run() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("result.json"), "{\"mine\": true}").unwrap();
    let config = Settings {
        out: folder.path().into(),
        ..Settings::default()
    };
    let error = Results::new(config).err().unwrap().to_string();
    assert!(error.contains("not overwritten"), "{error}");
}

#[test]
fn without_a_name_the_graph_is_named_as_its_folder() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("my_graph");
    let config = Settings {
        out: out.clone(),
        ..Settings::default()
    };
    let mut sink = Results::new(config).unwrap();
    sink.on_message(Input::BOXES, boxes(0)).unwrap();
    sink.finish(&Books::default()).unwrap();
    let settings = read_run(&out).unwrap().result.settings;
    assert_eq!(
        (&*settings.graph, &*settings.mode, &*settings.ego),
        ("my_graph", "virtual", "cav1")
    );
    for (text, expected) in [
        ("{", "expected the settings that `realo run` writes"),
        ("{\"lag\": 1}", "lag"),
    ] {
        let reported = folder.path().join("bad.json");
        std::fs::write(&reported, text).unwrap();
        let config = Settings {
            out: out.clone(),
            run_settings: reported,
            stamps: StampRule::default(),
        };
        let error = Results::new(config).err().unwrap().to_string();
        assert!(error.contains("`run_settings`") && error.contains(expected), "{error}");
    }
}

#[test]
fn a_stage_fails_where_it_fails_on_half_of_its_messages_or_gave_nothing() {
    let node = |errors, calls: &[(&str, u64)], sends: bool| {
        let mut node = NodeBooks {
            errors,
            ..NodeBooks::default()
        };
        for (trigger, count) in calls {
            let durations = node.compute.entry(trigger.to_string()).or_default();
            (0..*count).for_each(|_| durations.record(MS));
        }
        if sends {
            let message = Message::new(header(0, Kind::Boxes), Boxes::default());
            node.outputs.entry("boxes".into()).or_default().add(&message);
        }
        node
    };
    let messages = [("ego > boxes", 8), ("ego", 12)];
    for (books, expected) in [
        (node(20, &[("ego", 20)], false), true),
        (node(12, &messages, true), true),
        (node(9, &messages, true), false),
        // What it did not fail on gave nothing.
        (node(9, &[("ego", 9), ("states", 11)], false), true),
        (node(0, &[("ego", 20)], false), false),
        // A node that is no operator is not called by messages alone.
        (node(3, &[], false), false),
    ] {
        assert_eq!(has_failed(&books), expected, "{books:?}");
    }
    let wakes_failed = NodeBooks {
        other_errors: 12,
        ..node(12, &[("ego > boxes", 20), ("wake", 12)], true)
    };
    assert!(!has_failed(&wakes_failed), "wakes are not messages");
    let woken = node(1, &[("ego > boxes", 8), ("wake", 3), ("wake > boxes", 4)], true);
    assert_eq!(
        (calls(&woken, |trigger| !is_wake(trigger)), calls(&woken, is_wake)),
        (8, 7)
    );
}
