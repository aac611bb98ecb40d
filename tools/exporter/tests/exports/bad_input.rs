//! Logs that lack something, and places that are taken.

use std::fs;
use std::path::Path;

use crate::reading::try_export;
use crate::world::MadeUp;

/// Layouts that need boxes.
const LABELLED: [&str; 2] = ["opv2v", "kitti"];

fn entries(dir: &Path) -> Vec<String> {
    let entries = fs::read_dir(dir).unwrap().map(|entry| entry.unwrap().file_name());
    entries.map(|name| name.to_string_lossy().into_owned()).collect()
}

#[test]
fn what_a_log_lacks_is_named_and_nothing_is_left() {
    for kind in LABELLED {
        let dir = tempfile::tempdir().unwrap();
        let out = dir.path().join("out");
        let cases = [
            (
                MadeUp {
                    clouds: false,
                    ..MadeUp::default()
                },
                &[][..],
                "made_up.mcap`: topic `/AGENT/points`: expected clouds of at least one of the agents car, found none",
            ),
            (
                MadeUp {
                    truth: false,
                    ..MadeUp::default()
                },
                &[],
                "made_up.mcap`: topic `/car/ground_truth`: expected boxes of at least one agent, found none; add ground truth",
            ),
            (
                MadeUp::default(),
                &[("labels", "own")],
                "topic `/car/own_labels`: expected boxes of at least one agent, found none; take --labels truth",
            ),
            (
                MadeUp::default(),
                &[("height", "tall")],
                "--height: expected 0 to 50 m, found `tall`",
            ),
        ];
        for (log, set, expected) in cases {
            let error = try_export(kind, &log.write(dir.path()), &out, set, false).unwrap_err();
            assert!(error.contains(expected), "{error}");
            assert_eq!(entries(dir.path()), ["made_up.mcap"]);
        }
        let agent = if kind == "kitti" { "agent" } else { "agents" };
        let error = try_export(
            kind,
            &MadeUp::default().write(dir.path()),
            &out,
            &[(agent, "bus")],
            false,
        )
        .unwrap_err();
        assert!(error.contains("has no agent `bus`; it has: car"), "{error}");
    }
}

#[test]
fn a_folder_that_is_not_empty_is_refused() {
    for kind in ["opv2v", "kitti", "rosbag2"] {
        let dir = tempfile::tempdir().unwrap();
        let (log, out) = (MadeUp::default().write(dir.path()), dir.path().join("out"));
        fs::create_dir(&out).unwrap();
        try_export(kind, &log, &out, &[], false).unwrap();
        let error = try_export(kind, &log, &out, &[], false).unwrap_err();
        assert!(
            error.contains("refuse to overwrite") && error.contains("--force"),
            "{error}"
        );
        try_export(kind, &log, &out, &[], true).unwrap();
        fs::write(out.join("notes.txt"), "mine").unwrap();
        let error = try_export(kind, &log, &out, &[], true).unwrap_err();
        assert!(
            error.contains("notes.txt") && error.contains("move that file away"),
            "{error}"
        );
        assert_eq!(fs::read_to_string(out.join("notes.txt")).unwrap(), "mine");
    }
}
