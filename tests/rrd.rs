//! `realo-lab export rrd`: a run as a recording of rerun, by Python.

mod common;

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::Command;

use common::{folder, lab, once, run_virtual, simulated, text};

const LOG: &str = "rrd_small";

fn log() -> PathBuf {
    let args = ["--seed", "917", "--seconds", "2", "--agents", "cav1,rsu1"];
    simulated(LOG, &args)
}

fn run() -> PathBuf {
    once("rrd_run", |_| {
        run_virtual(
            "rrd_run",
            "late_fusion",
            &log(),
            &["--recorded-detections", "--ego", "cav1"],
        );
    })
}

/// The exit code, and all that was said.
fn export(run: &Path, output: &Path, more: &[&str]) -> (Option<i32>, String) {
    let [run, output] = [run, output].map(|path| path.to_string_lossy().into_owned());
    let said = lab([&["export", "rrd", &run, "-o", &output][..], more].concat());
    (
        said.status.code(),
        format!("{}{}", text(&said.stdout), text(&said.stderr)),
    )
}

#[test]
fn a_python_without_rerun_is_an_error_that_says_how_to_install_it() {
    let home = folder("rrd_errors");
    let bare = home.join("bare-python");
    fs::write(
        &bare,
        "#!/bin/sh\necho \"ModuleNotFoundError: No module named 'rerun'\" >&2\nexit 1\n",
    )
    .expect("it can be written");
    fs::set_permissions(&bare, fs::Permissions::from_mode(0o755)).expect("it is ours");
    let (run, output) = (run(), home.join("run.rrd"));
    let bare = bare.to_string_lossy().into_owned();
    let (code, said) = export(&run, &output, &["--python", &bare]);
    assert_eq!(code, Some(1), "{said}");
    let install = format!("{bare} -m pip install 'rerun-sdk");
    assert!(
        said.contains("No module named 'rerun'") && said.contains(&install),
        "{said}"
    );
    let (code, said) = export(&run, &output, &["--python", "/no/such/python"]);
    assert!(
        code == Some(1) && said.contains("no such program") && said.contains("rerun-sdk"),
        "{said}"
    );
    assert!(!output.exists(), "nothing was written");
    let (code, said) = export(&home, &output, &[]);
    assert!(code == Some(1) && said.contains("recording.mcap"), "{said}");
    let (code, said) = export(&run, &home.join("run.mcap"), &[]);
    assert!(code != Some(0) && said.contains("rrd"), "{said}");
    fs::write(&output, "mine").expect("it can be written");
    let (code, said) = export(&run, &output, &["--python", &bare]);
    assert!(code == Some(1) && said.contains("refuse to overwrite"), "{said}");
    assert_eq!(fs::read_to_string(&output).expect("it is there"), "mine");
}

#[test]
fn rerun_has_every_pose_every_box_and_every_sweep() {
    let tried = Command::new("python3")
        .args(["-c", "import numpy, rerun; rerun.Boxes3D"])
        .output();
    if !tried.is_ok_and(|tried| tried.status.success()) {
        return skipped::skip("Python 3 with the package rerun-sdk as `python3`");
    }
    let output = folder("rrd_export").join("run.rrd");
    let log = log().to_string_lossy().into_owned();
    let (code, said) = export(&run(), &output, &["--log", &log]);
    assert_eq!(code, Some(0), "{said}");
    assert!(
        said.contains("40 sweeps with points") && !said.contains(" 0 boxes"),
        "{said}"
    );
    let stats = Command::new("python3")
        .args(["-m", "rerun", "rrd", "print"])
        .arg(&output)
        .output();
    let stats = stats.expect("it can be started");
    let printed = format!("{}{}", text(&stats.stdout), text(&stats.stderr));
    for entity in [
        "/map/cav1",
        "/map/rsu1",
        "/map/cav1/boxes",
        "/map/cav1/ground_truth",
        "/map/rsu1/points",
    ] {
        assert!(printed.contains(entity), "{entity}: {printed}");
    }
    // Of an earlier file nothing is left where it may be replaced.
    let (code, said) = export(&run(), &output, &["--force"]);
    assert!(code == Some(0) && said.contains("--log LOG adds"), "{said}");
}
