//! Bad input gets a clear error, and nothing that is there is lost.

mod common;

use std::fs;

use common::{folder, graph, json, realo, simulated, text};

fn small() -> std::path::PathBuf {
    simulated(
        "small",
        &[
            "--seed",
            "906",
            "--seconds",
            "4",
            "--no-clouds",
            "--agents",
            "cav1,rsu1",
            "--key-hz",
            "10",
        ],
    )
}

/// What `realo run` of late fusion says: exit code, standard error.
fn run(args: &[&str]) -> (Option<i32>, String) {
    let output = realo([&["run", &graph("late_fusion"), "--mode", "virtual"][..], args].concat());
    (output.status.code(), text(&output.stderr))
}

#[test]
fn a_cut_log_is_played_up_to_the_cut_and_reported() {
    let dir = folder("cut");
    let whole = fs::read(small()).expect("the log can be read");
    let cut = dir.join("cut.mcap");
    fs::write(&cut, &whole[..whole.len() * 6 / 10]).expect("the log can be written");
    let out = dir.join("out");
    let (code, said) = run(&["--log", &cut.to_string_lossy(), "--out", &out.to_string_lossy()]);
    assert_eq!(code, Some(3), "{said}");
    assert!(said.contains("cut.mcap"), "{said}");
    let frames = json(&out.join("result.json"))["frames"]["processed"]
        .as_u64()
        .expect("frames.processed");
    assert!((10..40).contains(&frames), "{frames} of 40 sweeps before the cut");
}

#[test]
fn what_the_log_does_not_have_is_named_with_what_it_has() {
    let log = small();
    let log = log.to_string_lossy();
    let cases: [(&[&str], &[&str]); 6] = [
        (&["--log", &log, "--ego", "cav7"], &["cav7", "cav1", "rsu1"]),
        (&["--log", &log, "--agents", "cav1,bus"], &["bus", "rsu1"]),
        (
            &["--log", &log, "--coop", "v2v", "--ego", "rsu1"],
            &["rsu1", "v2v", "cav1"],
        ),
        (&["--log", &log, "--set", "bank.windowms=3"], &["windowms", "window_ms"]),
        (&["--log", &log, "--set", "bnak.window_ms=3"], &["bnak", "bank"]),
        (&["--log", "nowhere.mcap"], &["nowhere.mcap"]),
    ];
    for (args, named) in cases {
        let (code, said) = run(args);
        assert_eq!(code, Some(1), "{args:?}: {said}");
        assert!(named.iter().all(|name| said.contains(name)), "{args:?}: {said}");
    }
}

#[test]
fn an_ego_without_collaborators_runs_alone_and_says_so() {
    let out = folder("alone");
    let (code, said) = run(&[
        "--log",
        &small().to_string_lossy(),
        "--coop",
        "v2v",
        "--out",
        &out.to_string_lossy(),
    ]);
    assert_eq!(code, Some(0), "{said}");
    assert!(said.contains("runs alone"), "{said}");
    assert_eq!(json(&out.join("result.json"))["frames"]["processed"], 40);
}

#[test]
fn options_that_exclude_each_other_are_refused() {
    for args in [
        &["--offline", "--mode", "realtime"][..],
        &["--offline", "--link", "paper"],
        &["--mode", "virtual", "--rate", "2"],
    ] {
        let output = realo([&["run", &graph("late_fusion")][..], args].concat());
        assert_eq!(output.status.code(), Some(1), "{args:?}");
        assert!(
            text(&output.stderr).contains("drop") || text(&output.stderr).contains("--rate"),
            "{args:?}"
        );
    }
}
