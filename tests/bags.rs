//! Bags become logs that are played, with their truth or without any; logs that were exported and imported score as they did.

mod common;

use std::ffi::OsString;
use std::fs;
use std::path::Path;

use common::{counts, folder, lab_ok, realo, realo_ok, run_virtual, simulated};

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
