//! Bags become logs that are played, with their truth or without any; logs that were exported and imported score as they did.

mod common;

use std::ffi::OsString;
use std::fs;

use common::{counts, folder, lab_ok, realo_ok, run_virtual, simulated};

const AGENTS: [(&str, &str); 2] = [("cav1", "vehicle"), ("rsu1", "roadside")];

/// The outline in which both vehicles of the test below have theirs, as the export of their log says it.
const OUTLINE: &str = "-1.617,2.617,-0.904,0.904";

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
    let (scene, back) = (dir.join("2026_01_01_00_00_00"), dir.join("back.mcap"));
    let export = ["export", "opv2v"].map(OsString::from);
    lab_ok(
        export
            .into_iter()
            .chain([log.clone().into(), "-o".into(), scene.clone().into()]),
    );
    let words = fs::read_to_string(scene.join("realo_export.json")).expect("the export says what it is");
    assert!(words.contains("opv2v"), "{words}");
    let import = ["import", "opv2v"].map(OsString::from);
    let outline = ["--footprint", OUTLINE].map(OsString::from);
    lab_ok(
        import
            .into_iter()
            .chain([scene.into(), "-o".into(), back.clone().into()])
            .chain(outline),
    );
    for graph in ["late_fusion", "no_fusion"] {
        let before = run_virtual(&format!("round_trip_{graph}"), graph, &log, &["--offline"]);
        let after = run_virtual(&format!("round_trip_{graph}_back"), graph, &back, &["--offline"]);
        for key in ["total", "processed", "key"] {
            assert_eq!(after["frames"][key], before["frames"][key], "{graph}: {key}");
        }
        // Truth, key frames and points on objects are the same. Of scores a few detections are in another order.
        for class in ["vehicle", "pedestrian", "truck"] {
            for iou in ["0.3", "0.5"] {
                let [(found, _, of), (again, _, of_again)] = [&before, &after].map(|result| counts(result, class, iou));
                assert_eq!(of_again, of, "{graph}: {class}");
                assert!(
                    found.abs_diff(again) <= 1,
                    "{graph}: {class}: {found} and {again} of {of}"
                );
            }
        }
        let map = |result: &serde_json::Value| result["accuracy"]["sorted"]["mAP"]["0.5"].as_f64().expect("an mAP");
        assert!(
            (map(&before) - map(&after)).abs() < 0.005,
            "{graph}: {} and {}",
            map(&before),
            map(&after)
        );
    }
}
