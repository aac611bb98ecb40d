//! Scoring a recording after the fact gives the table of the run, or refuses.

mod common;

use std::path::{Path, PathBuf};

use common::{folder, realo, realo_ok, run_virtual, simulated, text};
use serde_json::Value;

fn log(seed: &str) -> PathBuf {
    let args = ["--seconds", "2", "--no-clouds", "--agents", "cav1,rsu1", "--seed", seed];
    simulated(&format!("evaluated_{seed}"), &args)
}

/// Where a run of one log leaves its recording.
fn recording(out: &str, log: &Path) -> PathBuf {
    let log = log.file_stem().expect("a log has a name");
    Path::new(env!("CARGO_TARGET_TMPDIR"))
        .join(out)
        .join(log)
        .join("cav1/recording.mcap")
}

fn evaluate(log: &Path, recording: &Path) -> [PathBuf; 4] {
    ["evaluate".into(), log.into(), "--detections".into(), recording.into()]
}

#[test]
fn a_recording_scores_as_its_run_did() {
    let log = log("911");
    let cases: [(&str, &[&str]); 4] = [
        ("whole", &[]),
        ("start", &["--set", "player.start=1"]),
        ("repeat", &["--set", "player.repeat=2"]),
        (
            "piece",
            &[
                "--set",
                "player.repeat=3",
                "--set",
                "player.start=0.5",
                "--set",
                "player.duration=0.8",
            ],
        ),
    ];
    let mut objects = Vec::new();
    for (name, args) in cases {
        let out = format!("evaluate_{name}");
        let args = [&["--recorded-detections"][..], args].concat();
        let result = run_virtual(&out, "late_fusion", &log, &args);
        let mut again = evaluate(&log, &recording(&out, &log)).to_vec();
        again.push("--json".into());
        let table: Value = serde_json::from_str(&realo_ok(again)).expect("JSON");
        let scored = &table["runs"][0]["result"];
        for key in ["accuracy", "accuracy_seen"] {
            assert!(result[key].is_object(), "{name}: {result}");
            assert_eq!(scored[key], result[key], "{name}: {key}");
        }
        objects.push(common::counts(&result, "vehicle", "0.5").2);
    }
    let [whole, start, repeat, _] = objects[..] else {
        panic!("{objects:?}");
    };
    assert!(0 < start && start < whole, "part of the log: {objects:?}");
    assert_eq!(repeat, 2 * whole, "{objects:?}");
}

#[test]
fn a_recording_of_another_log_is_refused() {
    let (played, other) = (log("911"), log("912"));
    run_virtual("evaluate_other", "late_fusion", &played, &["--recorded-detections"]);
    let output = realo(evaluate(&other, &recording("evaluate_other", &played)));
    let said = text(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{said}");
    for named in ["evaluated_912.mcap", "recording.mcap", "another log", "sweep 0 of cav1"] {
        assert!(said.contains(named), "`{named}` in: {said}");
    }
}

#[test]
fn a_recording_without_truth_is_refused() {
    let dir = folder("evaluate_no_truth");
    let path = dir.join("recording.mcap");
    record_boxes_only(&path);
    let output = realo(evaluate(&log("911"), &path));
    let said = text(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(said.contains("player/truth") && said.contains("recorder"), "{said}");
}

/// What a graph records whose recorder has no truth.
fn record_boxes_only(path: &Path) {
    use realo_operator::{PortId, Sink};
    use realo_schemas::{Boxes, Header, Kind, Message};
    let config = realo_recorder::Config {
        path: path.into(),
        clouds: false,
    };
    let mut recorder = realo_recorder::Recorder::new(config).expect("a recorder");
    let header = Header::origin(&"run".into(), &"cav1".into(), Kind::Boxes, 0, 1_000, 1_000);
    let boxes = Message::new(header, Boxes(Vec::new()));
    recorder.accept(PortId(0), boxes).expect("boxes are recorded");
    recorder.finish(&Default::default()).expect("the recording is finished");
}
