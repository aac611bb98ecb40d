//! Bags become logs that are played, with their truth or without any.

mod common;

use std::fs;

use common::{counts, folder, lab_ok, realo_ok, run_virtual, simulated};

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
