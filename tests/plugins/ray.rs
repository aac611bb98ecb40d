//! A sweep over the workers of a Ray cluster has the table of one machine.

use std::process::Command;

use crate::common::{REALO, graph, realo_ok, root, text};
use crate::log;

#[test]
fn a_sweep_over_two_workers_of_ray_is_that_of_one_machine() {
    let python = realo_host::python();
    let has_ray = Command::new(python).args(["-c", "import ray"]).output();
    if !has_ray.is_ok_and(|output| output.status.success()) {
        return skipped::skip("`python3 -m pip install ray` for examples/ray");
    }
    let log = log();
    let folder = tempfile::tempdir().expect("a folder");
    let [one, many] = ["one", "many"].map(|name| folder.path().join(name).to_string_lossy().into_owned());
    let (late, log) = (graph("late_fusion"), log.to_string_lossy().into_owned());
    let words = [
        &late,
        "--recorded-detections",
        "--ego",
        "cav1",
        "--log",
        &log,
        "--vary",
        "link.delay_ms=0,50,200",
    ];
    let alone = realo_ok([&["sweep"], &words[..], &["-o", &one]].concat());
    let driver = [&["examples/ray/sweep.py", "--shards", "3"], &words[..], &["-o", &many]].concat();
    let output = Command::new(python)
        .args(driver)
        .current_dir(root())
        .env("REALO_BIN", REALO)
        .env("COLUMNS", "400")
        .output()
        .expect("Python can be started");
    assert!(output.status.success(), "{}", text(&output.stderr));
    assert_eq!(text(&output.stdout), alone);
}
