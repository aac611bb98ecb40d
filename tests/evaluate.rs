//! Scoring a recording after the fact gives the table of the run, or refuses.

mod common;

use std::fs;
use std::path::{Path, PathBuf};

use common::{counts, folder, json, realo, realo_ok, run_virtual, simulated, text};
use realo_logs::{Log, LogWriter, Stream};
use realo_schemas::geometry::transform_box;
use realo_schemas::{AgentState, Boxes, Pose};
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

/// A copy of a log without points whose bodies nod by up to 2° and lean by 1°: what is level lies no more along their axes.
fn nodding(from: &Path, to: &Path) {
    let turn = |axis: usize, angle: f64| {
        let mut quaternion = [0.0, 0.0, 0.0, (angle / 2.0).cos()];
        quaternion[axis] = (angle / 2.0).sin();
        let pose = Pose::from_parts([0.0; 3], quaternion);
        pose.expect("a rotation").map_from_frame
    };
    let log = Log::open(from).expect("the log can be read");
    let mut copy = LogWriter::create(to, log.info()).expect("the log can be made");
    let names: Vec<&str> = log.info().agents.iter().map(|agent| agent.name.as_str()).collect();
    let streams = [
        Stream::Pose,
        Stream::PoseTruth,
        Stream::Sweeps,
        Stream::Detections,
        Stream::DetectionsInfo,
        Stream::GroundTruth,
        Stream::GroundTruthInfo,
    ];
    let wanted: Vec<(&str, Stream)> = names
        .iter()
        .flat_map(|name| streams.map(|stream| (*name, stream)))
        .collect();
    let mut reader = log.read_all(&wanted).expect("all is there");
    let mut waiting = std::collections::BTreeMap::new();
    while let Some(entry) = reader.next().expect("the log can be read") {
        let (agent, stamp, ready) = (&*entry.agent, entry.stamp(), entry.ready());
        let level_from_body = turn(1, 0.035 * (3e-9 * (stamp % 1_000_000_000_000) as f64).sin()) * turn(0, 0.017);
        let written = match entry.stream {
            Stream::Pose | Stream::PoseTruth => {
                let state = entry.pose().expect("a pose");
                let state = AgentState {
                    map_from_body: state.map_from_body * level_from_body,
                    ..state
                };
                match entry.stream {
                    Stream::Pose => copy.pose(agent, stamp, ready, &state),
                    _ => copy.pose_truth(agent, stamp, ready, &state),
                }
            }
            Stream::Sweeps => copy.sweep(agent, stamp, ready),
            Stream::Detections | Stream::GroundTruth => {
                waiting.insert(entry.agent.clone(), entry.boxes().expect("boxes"));
                Ok(())
            }
            _ => {
                let mut boxes: Boxes = waiting
                    .remove(&entry.agent)
                    .expect("an array goes before its companion");
                let info = entry.info(&mut boxes).expect("a companion");
                let body_from_level = level_from_body.inverse();
                let boxes = boxes.0.iter().map(|object| transform_box(&body_from_level, object));
                let boxes = Boxes(boxes.collect());
                match entry.stream {
                    Stream::DetectionsInfo => copy.detections(agent, stamp, ready, &boxes),
                    _ => copy.truth(agent, stamp, ready, &boxes.0, info.points.as_deref(), info.key),
                }
            }
        };
        written.expect("the log can be written");
    }
    copy.finish().expect("the log can be finished");
}

#[test]
fn a_log_that_tilts_scores_as_its_level_copy() {
    let straight = log("911");
    let dir = folder("evaluate_nodding");
    let [tilted, level] = ["tilted", "level"].map(|name| dir.join(name).with_extension("mcap"));
    nodding(&straight, &tilted);
    let said = realo_ok(["info".as_ref(), tilted.as_os_str()]);
    assert!(
        said.contains("TILTS by up to 2.") && said.contains("levelled while played"),
        "{said}"
    );
    realo_ok(["import", "log"].iter().map(|word| word.as_ref()).chain([
        tilted.as_os_str(),
        "-o".as_ref(),
        level.as_os_str(),
    ]));
    for (name, args) in [
        ("virtual", &[][..]),
        ("repeat", &["--set", "player.repeat=2"]),
        ("offline", &["--offline"]),
    ] {
        let args = [&["--recorded-detections"][..], args].concat();
        let [(of_tilted, found), (of_level, expected), (of_straight, _)] = [&tilted, &level, &straight].map(|log| {
            let out = format!(
                "evaluate_nodding_{name}_{}",
                log.file_stem().unwrap_or_default().display()
            );
            let result = run_virtual(&out, "late_fusion", log, &args);
            let scored = Path::new(env!("CARGO_TARGET_TMPDIR")).join(&out);
            (result, common::boxes(&scored))
        });
        // Offline the true poses are played, and level what was detected; the copy was levelled by the poses as believed.
        if name != "offline" {
            assert!(found == expected, "{name}: the same boxes in every frame");
            for key in ["accuracy", "accuracy_seen"] {
                assert_eq!(of_tilted[key], of_level[key], "{name}: {key}");
            }
        }
        let of = |result: &Value| counts(result, "vehicle", "0.5");
        assert!(of(&of_straight).0 > 50, "{name}: {:?}", of(&of_straight));
        assert_eq!(of(&of_tilted), of(&of_level), "{name}");
        assert_eq!(
            of(&of_tilted),
            of(&of_straight),
            "{name}: as if nothing had ever tilted"
        );
        let notes = of_tilted["notes"].to_string();
        let sweeps = if name == "repeat" { 40 } else { 20 };
        let said = format!("cav1: {sweeps} of {sweeps} (its body tilts by up to 2.");
        assert!(
            notes.contains("levelled while played") && notes.contains(&said),
            "{notes}"
        );
        assert!(!of_level["notes"].to_string().contains("tilt"), "{of_level}");
    }
    // Scored after the fact, the truth is levelled alike.
    let recording = recording("evaluate_nodding_virtual_tilted", &tilted);
    let again = evaluate(&tilted, &recording).into_iter().chain(["--json".into()]);
    let table: Value = serde_json::from_str(&realo_ok(again)).expect("JSON");
    let run = json(&Path::new(env!("CARGO_TARGET_TMPDIR")).join("evaluate_nodding_virtual_tilted/result.json"));
    assert_eq!(table["runs"][0]["result"]["accuracy"], run["accuracy"]);
    // So it is where it is drawn: a picture of another log would be refused.
    let run = Path::new(env!("CARGO_TARGET_TMPDIR")).join("evaluate_nodding_virtual_tilted");
    let picture = dir.join("frame.svg");
    realo_ok([
        "render".as_ref(),
        run.as_os_str(),
        "--log".as_ref(),
        tilted.as_os_str(),
        "-o".as_ref(),
        picture.as_os_str(),
    ]);
    assert!(fs::read_to_string(&picture).expect("a picture").contains("<svg"));
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

/// A copy without its last part.
fn cut(from: &Path, to: &Path, share: f64) -> PathBuf {
    let bytes = fs::read(from).expect("the file can be read");
    fs::write(to, &bytes[..(bytes.len() as f64 * share) as usize]).expect("the file can be written");
    to.into()
}

#[test]
fn a_cut_recording_is_scored_up_to_the_cut_and_says_so() {
    let log = log("911");
    run_virtual("evaluate_cut", "late_fusion", &log, &["--recorded-detections"]);
    let whole = recording("evaluate_cut", &log);
    let cut = cut(&whole, &folder("evaluate_cut_copy").join("recording.mcap"), 0.5);
    let lines = |recording: &Path| {
        let mut args = evaluate(&log, recording).to_vec();
        args.push("--frames".into());
        let output = realo(args);
        let lines: Vec<String> = text(&output.stdout).lines().map(String::from).collect();
        (output.status.code(), lines, text(&output.stderr))
    };
    let (code, all, _) = lines(&whole);
    assert_eq!(code, Some(0));
    let (code, some, said) = lines(&cut);
    assert_eq!(code, Some(3), "{said}");
    assert!(
        1 < some.len() && some.len() < all.len(),
        "{} of {}",
        some.len(),
        all.len()
    );
    // What is left scores as it did: no frame is missed because its boxes were cut off.
    assert_eq!(some[..], all[..some.len()]);
    for part in [
        "recording.mcap",
        "cut at byte",
        "was scored",
        "of 20 of cav1 in the log",
    ] {
        assert!(said.contains(part), "no `{part}` in: {said}");
    }
    let output = realo(evaluate(&log, &cut));
    assert!(text(&output.stdout).contains("cut at byte"), "the table says it too");
}

#[test]
fn a_recording_of_a_whole_log_is_refused_beside_the_cut_one() {
    let log = log("911");
    run_virtual("evaluate_cut_log", "late_fusion", &log, &["--recorded-detections"]);
    let short = cut(&log, &folder("evaluate_cut_log_copy").join("evaluated_911.mcap"), 0.5);
    let output = realo(evaluate(&short, &recording("evaluate_cut_log", &log)));
    let said = text(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{said}");
    for part in [
        "evaluated_911.mcap is cut at byte",
        "goes on after the cut",
        "the whole log",
    ] {
        assert!(said.contains(part), "no `{part}` in: {said}");
    }
    assert!(!said.contains("another log"), "{said}");
    // What was played of the cut log is scored against it.
    let out = "evaluate_cut_played";
    let dir = Path::new(env!("CARGO_TARGET_TMPDIR")).join(out);
    let run = realo([
        "run".into(),
        common::graph("late_fusion"),
        "--mode".into(),
        "virtual".into(),
        "--recorded-detections".into(),
        "--log".into(),
        short.to_string_lossy().into_owned(),
        "--out".into(),
        dir.to_string_lossy().into_owned(),
    ]);
    assert_eq!(run.status.code(), Some(3), "{}", text(&run.stderr));
    assert!(
        text(&run.stdout).contains("the log evaluated_911 is cut"),
        "{}",
        text(&run.stdout)
    );
    let output = realo(evaluate(&short, &recording(out, &short)));
    assert_eq!(output.status.code(), Some(3), "{}", text(&output.stderr));
}

#[test]
fn without_a_log_that_of_the_run_is_taken() {
    let log = log("911");
    run_virtual("evaluate_alone", "late_fusion", &log, &["--recorded-detections"]);
    let recording = recording("evaluate_alone", &log);
    let args = ["evaluate".into(), "--detections".into(), recording.clone()];
    let timing = recording.with_file_name("timing.json");
    let played_from = |path: Option<&Path>| {
        let mut document = common::json(&timing);
        document["log_path"] = path.map(|path| path.to_string_lossy()).into();
        fs::write(&timing, document.to_string()).expect("the file can be written");
    };
    played_from(Some(&log));
    assert_eq!(realo_ok(args.clone()), realo_ok(evaluate(&log, &recording)));
    played_from(Some(Path::new("/nowhere/evaluated_911.mcap")));
    let said = text(&realo(args.clone()).stderr);
    for part in ["recording.mcap", "/nowhere/evaluated_911.mcap", "realo evaluate LOG"] {
        assert!(said.contains(part), "no `{part}` in: {said}");
    }
    let lone = folder("evaluate_lone").join("recording.mcap");
    fs::copy(&recording, &lone).expect("the recording can be copied");
    let said = text(&realo(["evaluate".into(), "--detections".into(), lone]).stderr);
    assert!(
        said.contains("no finished run beside it") && said.contains("realo evaluate LOG"),
        "{said}"
    );
}

#[test]
fn compare_says_what_differs_and_takes_the_file_for_its_folder() {
    let logs = [log("911"), log("912")];
    let dirs = ["compare_one", "compare_other"].map(|out| Path::new(env!("CARGO_TARGET_TMPDIR")).join(out));
    run_virtual("compare_one", "late_fusion", &logs[0], &["--recorded-detections"]);
    run_virtual("compare_other", "no_fusion", &logs[1], &["--recorded-detections"]);
    let compare = |a: PathBuf, b: PathBuf| realo_ok(["compare".into(), a, b]);
    let table = compare(dirs[0].clone(), dirs[1].clone());
    assert_eq!(
        table.lines().next(),
        Some("note: logs differ: only compare_one has evaluated_911; only compare_other has evaluated_912"),
        "{table}"
    );
    assert_eq!(compare(dirs[0].join("result.json"), dirs[1].clone()), table);
    let same = compare(dirs[0].clone(), dirs[0].clone());
    assert!(!same.contains("differ:"), "{same}");
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
