//! Many logs, long recordings, more agents than a model takes.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Output;
use std::time::SystemTime;

use realo_logs::{AgentInfo, AgentKind, LogInfo, LogWriter};
use realo_schemas::{AgentState, Nanos, PointCloud, Pose, PoseStatus};
use serde_json::Value;

use crate::common::{self, folder, json, realo, text};
use crate::scene::{SWEEP, Scene, T0};

/// Three logs of the scene, with other poses each.
fn logs(test: &str) -> Vec<PathBuf> {
    let to = folder(&format!("{test}-logs"));
    let write = |(name, pose_hz): (&str, [i64; 2])| {
        let scene = Scene {
            pose_hz,
            ..Scene::default()
        };
        let path = to.join(format!("{name}.mcap"));
        fs::copy(scene.write(test), &path).expect("the folder can be written");
        path
    };
    [("one", [20, 20]), ("two", [40, 20]), ("three", [20, 40])]
        .map(write)
        .to_vec()
}

fn run(logs: &[PathBuf], out: &Path, more: &[&str]) -> Output {
    let mut args: Vec<String> = [
        "run",
        &common::graph("late_fusion"),
        "--recorded-detections",
        "--offline",
    ]
    .map(String::from)
    .to_vec();
    args.extend(["--ego".into(), "car".into(), "--out".into(), out.display().to_string()]);
    for log in logs {
        args.extend(["--log".into(), log.display().to_string()]);
    }
    args.extend(more.iter().map(|more| more.to_string()));
    realo(args)
}

fn notes(result: &Value) -> String {
    result["notes"].to_string()
}

#[test]
fn logs_that_cannot_be_played_do_not_take_the_table_of_the_others() {
    let logs = logs("growth-batch");
    let bytes = fs::read(&logs[1]).expect("a log");
    fs::write(&logs[1], &bytes[..bytes.len() / 50]).expect("the folder can be written");
    let junk = logs[1].with_file_name("junk.mcap");
    fs::write(&junk, "this is no log").expect("the folder can be written");
    let all = [logs.clone(), vec![junk.clone()]].concat();
    let out = folder("growth-batch-out");
    let output = run(&all, &out, &[]);
    let said = text(&output.stderr);
    assert_eq!(output.status.code(), Some(3), "{said}");
    for named in ["not played: ", "two", "junk.mcap"] {
        assert!(said.contains(named), "`{named}` in {said}");
    }
    let result = json(&out.join("result.json"));
    assert_eq!(
        (&result["runs"], &result["logs"]),
        (&2.into(), &serde_json::json!(["one", "three"]))
    );
    let said = notes(&result);
    assert!(
        said.contains("could not be played") && said.contains("junk") && said.contains("two"),
        "{said}"
    );
    assert!(
        text(&output.stdout).contains("could not be played"),
        "the table says so"
    );

    // None that can be played is an error, and nothing is left behind.
    let out = out.with_file_name("growth-batch-none");
    let _ = fs::remove_dir_all(&out);
    let output = run(&[logs[1].clone(), junk], &out, &[]);
    let said = text(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(
        said.contains("all 2 runs failed") && said.contains("junk.mcap"),
        "{said}"
    );
    assert!(!out.join("result.json").exists());

    // What no log can help is said at once.
    let output = run(&logs, &out, &["--set", "fusion.fusion.overlaps=0.2"]);
    assert_eq!(output.status.code(), Some(1));
    assert!(
        text(&output.stderr).contains("overlaps") && !out.exists(),
        "{}",
        text(&output.stderr)
    );
}

/// When a file was written, and its content.
fn state(file: &Path) -> (SystemTime, Vec<u8>) {
    let written = fs::metadata(file).and_then(|metadata| metadata.modified());
    (
        written.expect("the file is there"),
        fs::read(file).expect("the file can be read"),
    )
}

#[test]
fn a_batch_that_was_killed_goes_on_where_it_was() {
    let logs = logs("growth-resume");
    let out = folder("growth-resume-out");
    let folder = |log: &str| out.join(log).join("car");
    assert!(run(&logs, &out, &[]).status.success());
    let whole = json(&out.join("result.json"));
    // As a run leaves it that is killed in its last log: that one's and the table's files are missing.
    for gone in [out.join("result.json"), folder("three").join("result.json")] {
        fs::remove_file(gone).expect("the file is there");
    }
    let kept: Vec<_> = ["one", "two"].map(|log| folder(log).join("result.json")).to_vec();
    let before: Vec<_> = kept.iter().map(|file| state(file)).collect();
    let recorded = state(&folder("one").join("recording.mcap"));
    let output = run(&logs, &out, &["--resume"]);
    let said = text(&output.stderr);
    assert!(
        output.status.success() && said.contains("2 of 3 runs are complete"),
        "{said}"
    );
    assert_eq!(kept.iter().map(|file| state(file)).collect::<Vec<_>>(), before);
    assert_eq!(state(&folder("one").join("recording.mcap")), recorded);
    assert_eq!(json(&out.join("result.json")), whole, "the table of all three");

    // Another setting is another run.
    let output = run(&logs, &out, &["--resume", "--set", "fusion.nms.vote=0.2"]);
    let said = text(&output.stderr);
    assert!(
        output.status.success() && said.contains("0 of 3 runs are complete"),
        "{said}"
    );
    assert!(said.contains("run again, because"), "{said}");
    assert_ne!(state(&kept[0]), before[0]);

    // Another log of the same name, too; and nothing is taken where nobody asks for it.
    fs::copy(
        Scene {
            class: |_| "Pedestrian",
            ..Scene::default()
        }
        .write("growth-resume-b"),
        &logs[0],
    )
    .expect("a log");
    let output = run(&logs, &out, &["--resume", "--set", "fusion.nms.vote=0.2"]);
    assert!(
        text(&output.stderr).contains("2 of 3 runs are complete"),
        "{}",
        text(&output.stderr)
    );
    let before = state(&kept[1]);
    assert!(run(&logs, &out, &["--set", "fusion.nms.vote=0.2"]).status.success());
    assert_ne!(state(&kept[1]).0, before.0);
}

/// The ego at the origin, and others that stand ahead of it, m.
fn crowd(name: &str, others: &[(&str, f64)]) -> PathBuf {
    let path = folder(&format!("{name}-log")).join(format!("{name}.mcap"));
    let agent = |name: &str| AgentInfo {
        name: name.into(),
        kind: AgentKind::Vehicle,
        footprint: None,
        sensor: String::new(),
        sensor_position: None,
    };
    let all: Vec<(&str, f64)> = [&[("car", 0.0)], others].concat();
    let info = LogInfo::new("a crowd", all.iter().map(|(name, _)| agent(name)).collect());
    let mut log = LogWriter::create(&path, &info).expect("the log is created");
    let cloud = || {
        let ring = |k: usize| (k as f32 * 0.1).sin_cos();
        let axis = |of: fn((f32, f32)) -> f32| (0..60).map(|k| 9.0 * of(ring(k))).collect::<Vec<f32>>();
        PointCloud::new(
            axis(|(sin, _)| sin),
            axis(|(_, cos)| cos),
            vec![0.5_f32; 60],
            vec![9_u8; 60],
            vec![0_i32; 60],
            vec![0_u16; 60],
        )
        .expect("columns of one length")
    };
    for step in -4i64..12 {
        let stamp: Nanos = T0 + step * SWEEP / 2;
        for (agent, x) in &all {
            let state = AgentState {
                map_from_body: Pose::from_parts([*x, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0])
                    .expect("a pose")
                    .map_from_frame,
                covariance: None,
                velocity: None,
                angular_rate: None,
                status: PoseStatus::Recorded,
            };
            log.pose(agent, stamp, stamp, &state).expect("a pose is written");
        }
        if (0..6).contains(&step) && step % 2 == 0 {
            for (agent, _) in &all {
                log.cloud(agent, stamp, stamp + SWEEP / 2, &cloud())
                    .expect("a sweep is written");
            }
        }
    }
    log.finish().expect("the log is finished");
    path
}

#[test]
fn of_more_collaborators_than_a_model_takes_the_nearest_are_fused() {
    let log = crowd(
        "growth-crowd",
        &[
            ("cav1", 60.0),
            ("cav2", -50.0),
            ("cav3", 35.0),
            ("rsu1", -9.0),
            ("rsu2", 20.0),
        ],
    );
    for project in ["receiver", "sender"] {
        let args = ["--offline", "--ego", "car", "--project", project];
        let result = common::run_virtual(&format!("growth-nearest-{project}"), "attfuse", &log, &args);
        let used = |agent: &str| {
            result["links"][format!("{agent}-car")]["features"]["used"]
                .as_u64()
                .unwrap_or(0)
        };
        let fused: Vec<bool> = ["cav1", "cav2", "cav3", "rsu1", "rsu2"]
            .map(|agent| used(agent) > 0)
            .to_vec();
        assert_eq!(
            fused,
            [false, false, true, true, true],
            "{project}: {}",
            result["links"]
        );
    }
}

#[test]
fn what_nobody_can_fuse_is_not_computed_and_scores_stay_the_same() {
    let log = common::simulated(
        "growth-several",
        &["--seed", "911", "--vehicles", "3", "--roadside", "1", "--seconds", "1"],
    );
    let run = |name: &str, more: &[&str]| {
        let args = [&["--ego", "cav1", "--set", "fusion.fusion.max_collaborators=1"], more].concat();
        common::run_virtual(&format!("growth-far-{name}"), "attfuse", &log, &args)
    };
    let (less, all) = (run("less", &[]), run("all", &["--set", "player.fused_at_most=null"]));
    for same in ["accuracy", "accuracy_seen", "frames", "age_ms"] {
        assert_eq!(less[same], all[same], "{same}");
    }
    let said = |result: &Value, words: &str| notes(result).contains(words);
    assert!(
        said(&less, "not computed") && !said(&all, "not computed"),
        "{}",
        notes(&less)
    );
    assert!(said(&all, "beyond the collaborators"), "{}", notes(&all));
    let sum = |result: &Value, term: &str| -> u64 {
        let links = result["links"].as_object().expect("links");
        let features = links.values().filter_map(|kinds| kinds["features"][term].as_u64());
        features.sum()
    };
    assert_eq!(sum(&less, "used"), sum(&all, "used"));
    let counters = less["nodes"]["player"]["counters"].as_object().expect("counters");
    let left_out: u64 = counters
        .iter()
        .filter(|(name, _)| name.starts_with("too_far"))
        .filter_map(|(_, n)| n.as_u64())
        .sum();
    assert!(left_out > 0, "{counters:?}");
    assert!(sum(&all, "sent") - sum(&less, "sent") <= left_out);
    assert!(sum(&all, "over_limit") > sum(&less, "over_limit"));
}
