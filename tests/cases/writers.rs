//! Writers whose file cannot grow.

use std::path::Path;
use std::process::{Command, Output};

use crate::common;

/// Runs `realo` where no file may become longer than 50 to 100 kB (a shell's blocks differ): writing fails as on a full disk.
fn with_short_files(args: &[&str]) -> Output {
    // The signal that a long file gives is ignored, so that writing fails.
    Command::new("sh")
        .args(["-c", "trap '' XFSZ; ulimit -f 100; exec \"$0\" \"$@\"", common::REALO])
        .args(args)
        .current_dir(common::root())
        .output()
        .expect("there is a shell")
}

fn names(folder: &Path) -> Vec<String> {
    let entries = std::fs::read_dir(folder).expect("a folder");
    let names = entries.map(|entry| entry.expect("an entry").file_name().to_string_lossy().into_owned());
    names.collect()
}

#[test]
fn writing_that_fails_says_what_happened_and_what_is_left() {
    let log = common::simulated("short-files", &["--seed", "1", "--seconds", "2"]);
    let log = log.to_string_lossy();
    let folder = common::folder("short-files-out");
    let out = folder.join("out.mcap");
    let out = out.to_string_lossy();
    let output = with_short_files(&[
        "precompute",
        &log,
        "dataflows/early_fusion.yml",
        "--ego",
        "cav1",
        "-o",
        &out,
    ]);
    let said = common::text(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{said}");
    for part in ["out.mcap", "File too large", "nothing of it was left"] {
        assert!(said.contains(part), "{part} is not in {said}");
    }
    assert_eq!(names(&folder), Vec::<String>::new(), "{said}");
}

#[test]
fn a_recording_that_cannot_be_written_stays_readable_up_to_there() {
    let log = common::simulated("short-files", &["--seed", "1", "--seconds", "2"]);
    let folder = common::folder("short-recording");
    let run = with_short_files(&[
        "run",
        "dataflows/late_fusion.yml",
        "--recorded-detections",
        "--offline",
        "--ego",
        "cav1",
        "--log",
        &log.to_string_lossy(),
        "--out",
        &folder.to_string_lossy(),
    ]);
    let said = common::text(&run.stderr);
    assert_eq!(run.status.code(), Some(1), "{said}");
    assert!(
        said.contains("recording.mcap") && said.contains("what was written stays readable"),
        "{said}"
    );
}
