//! Bags become logs that are played, with their truth or without any; logs that were exported and imported score as they did.

mod common;

use std::ffi::OsString;
use std::fs;
use std::path::Path;
use std::process::Command;

use common::python::environment;
use common::{counts, folder, lab_ok, realo, realo_ok, root, run_virtual, simulated};
use realo_logs::{Log, Stream};

const AGENTS: [(&str, &str); 2] = [("cav1", "vehicle"), ("rsu1", "roadside")];

/// A map file for a log of realo, which is an MCAP file as those of others are.
fn map(with_truth: bool) -> String {
    let agent = |(name, kind): (&str, &str)| {
        let truth = if with_truth {
            format!("    truth: /{name}/ground_truth\n")
        } else {
            String::new()
        };
        format!(
            "  {name}:\n    kind: {kind}\n    clouds: /{name}/points\n    frame: {name}/body\n    height: 0\n    pose: /{name}/pose\n    \
             detections: /{name}/detections\n{truth}"
        )
    };
    format!("agents:\n{}", AGENTS.map(agent).concat())
}

#[test]
fn a_bag_is_played_with_its_truth_or_without_any() {
    let bag = simulated("bags", &["--seconds", "1", "--agents", "cav1,rsu1", "--seed", "911"]);
    let args = ["--recorded-detections", "--ego", "cav1"];
    let original = run_virtual("bags_original", "late_fusion", &bag, &args);
    let dir = folder("bags");
    let file = dir.join("my.yml");
    for with_truth in [true, false] {
        fs::write(&file, map(with_truth)).expect("it can be written");
        let log = dir.join(format!("truth_{with_truth}.mcap"));
        let words = ["import", "bag"].iter().map(|word| word.as_ref());
        lab_ok(words.chain([
            bag.as_os_str(),
            "--map".as_ref(),
            file.as_os_str(),
            "-o".as_ref(),
            log.as_os_str(),
        ]));
        let said = common::text(&realo([Path::new("info"), &log]).stdout);
        assert_eq!(
            said.contains("  no truth  no agent has ground truth"),
            !with_truth,
            "{said}"
        );
        let result = run_virtual(&format!("bags_{with_truth}"), "late_fusion", &log, &args);
        for key in ["total", "processed"] {
            assert_eq!(result["frames"][key], original["frames"][key], "{key}");
        }
        let sent = |result: &serde_json::Value| result["links"]["rsu1-cav1"]["boxes"]["sent"].clone();
        assert_eq!(sent(&result), sent(&original));
        assert!(result["age_ms"]["p50"].is_number(), "{}", result["age_ms"]);
        match with_truth {
            // All sweeps with truth are scored; of a simulated log only some are.
            true => {
                let (found, _, of) = counts(&result, "vehicle", "0.5");
                assert_eq!(result["frames"]["key"], result["frames"]["total"]);
                assert!(
                    10 * found >= 9 * of && of > counts(&original, "vehicle", "0.5").2,
                    "{found} of {of}"
                );
            }
            false => assert_eq!(result["frames"]["key"], 0),
        }
    }
}

#[test]
fn topics_of_a_real_bag_are_listed_by_type() {
    let Some(bags) = skipped::shared("data/rosbag1") else {
        return;
    };
    let said = realo_ok(["info".into(), bags.join("example-bz2.bag").into_os_string()]);
    for part in [
        "bag of ROS 1, 8647 messages",
        "tf2_msgs/TFMessage",
        "turtlesim/Pose (not read)",
        "turtle1",
    ] {
        assert!(said.contains(part), "{said}");
    }
}

/// A bag as a recorder of others writes it: each cloud has the points of `recorders.py`, and the pose beside it.
fn recorded(python: &Path, recorder: &str, compression: &str) {
    let dir = folder(&format!("recorded_{recorder}_{compression}"));
    let [bag, map, log] = ["recorded.bag", "map.yml", "log.mcap"].map(|name| dir.join(name));
    let script = root().join("tests/bags/recorders.py");
    let wrote = Command::new(python)
        .arg(script)
        .args([recorder, compression])
        .arg(&bag)
        .output();
    let wrote = wrote.expect("it was there before");
    assert!(
        wrote.status.success(),
        "{recorder}, {compression}: {}",
        common::text(&wrote.stderr)
    );
    let agent = "    clouds: /points\n    frame: base_link\n    height: 0\n    pose: /odom\n";
    fs::write(&map, format!("agents:\n  car:\n{agent}")).expect("it can be written");
    let words = ["import", "bag"].iter().map(|word| word.as_ref());
    lab_ok(words.chain([
        bag.as_os_str(),
        "--map".as_ref(),
        map.as_os_str(),
        "-o".as_ref(),
        log.as_os_str(),
    ]));
    let log = Log::open(&log).expect("a log");
    let (mut sweeps, mut poses) = (0, 0);
    let mut reader = log
        .read_all(&[("car", Stream::Points), ("car", Stream::Pose)])
        .expect("a log");
    while let Some(entry) = reader.next().expect("an entry") {
        let sweep = (entry.stamp() - 1_600_000_000_000_000_000) / 100_000_000;
        if entry.stream == Stream::Pose {
            assert_eq!(
                entry.pose().expect("a pose").map_from_body.translation.x,
                2.0 * sweep as f64
            );
            poses += 1;
            continue;
        }
        let cloud = entry.cloud().expect("a cloud");
        let place = |i: i64| [(i * 37 + sweep) % 2003, (i * 53) % 1009, i % 64].map(|number| number as f32);
        let expected = (0..1000)
            .map(|i| (place(i), i % 256))
            .map(|([x, y, z], i)| ([x / 16.0 - 60.0, y / 16.0 - 30.0, z / 32.0], i as u8));
        let found = (0..cloud.len()).map(|i| ([cloud.x[i], cloud.y[i], cloud.z[i]], cloud.intensity[i]));
        assert!(found.eq(expected), "{recorder}, {compression}: sweep {sweep}");
        sweeps += 1;
    }
    assert_eq!((sweeps, poses), (12, 12), "{recorder}, {compression}");
}

#[test]
fn bags_of_the_recorder_of_ros_1_have_their_points() {
    let has = |python: &&str| {
        let tried = Command::new(python)
            .args(["-c", "import rosbag, sensor_msgs.msg, nav_msgs.msg"])
            .output();
        tried.is_ok_and(|output| output.status.success())
    };
    let Some(python) = ["python3", "/usr/bin/python3"].iter().find(|python| has(python)) else {
        skipped::skip(
            "the recorder of ROS 1: on Debian, apt-get install python3-rosbag python3-sensor-msgs python3-nav-msgs",
        );
        return;
    };
    for compression in ["none", "bz2", "lz4"] {
        recorded(Path::new(python), "rosbag", compression);
    }
}

#[test]
fn bags_of_the_package_rosbags_have_their_points() {
    let home = Path::new(env!("CARGO_TARGET_TMPDIR")).join("rosbags_python");
    let Some(programs) = environment(&home, &["rosbags==0.11.9"], "rosbags.rosbag2") else {
        return;
    };
    let python = programs.join("python");
    for compression in ["none", "bz2", "lz4"] {
        recorded(&python, "rosbags1", compression);
    }
    for storage in ["sqlite3", "mcap"] {
        for compression in ["none", "file", "message"] {
            recorded(&python, &format!("rosbags2-{storage}"), compression);
        }
    }
}

#[test]
fn a_scene_that_was_exported_and_imported_scores_as_its_log() {
    let log = simulated(
        "round_trip",
        &["--seconds", "2", "--agents", "cav1,cav2,rsu1", "--seed", "913"],
    );
    let dir = folder("round_trip_files");
    let (scene, back) = (dir.join("scene"), dir.join("back.mcap"));
    let command = |words: &[&str], from: &Path, to: &Path| {
        let words = words.iter().map(OsString::from);
        lab_ok(words.chain([from.into(), "-o".into(), to.into()]));
    };
    // Times of points and all poses: each run removes the motion during sweeps itself.
    command(&["export", "opv2v", "--motion", "kept"], &log, &scene);
    let words = fs::read_to_string(scene.join("realo_export.json")).expect("the export says what it is");
    assert!(words.contains("opv2v"), "{words}");
    command(&["import", "opv2v"], &scene, &back);
    for graph in ["late_fusion", "no_fusion"] {
        // Heights over the LiDAR are rounded once more; what that changes is the same on every machine.
        let args = ["--offline", "--isa", "portable"];
        let before = run_virtual(&format!("round_trip_{graph}"), graph, &log, &args);
        let after = run_virtual(&format!("round_trip_{graph}_back"), graph, &back, &args);
        for protocol in ["sorted", "v2x-real"] {
            let map = &before["accuracy"][protocol]["mAP"]["0.5"];
            assert!(map.as_f64() > Some(0.3), "{graph}: {protocol}: {map}");
        }
        for key in ["frames", "accuracy"] {
            assert_eq!(after[key], before[key], "{graph}: {key}");
        }
    }
}
