//! Plug-ins that fuse BEV maps, beside the shipped encoder and head.

use std::fs;
use std::path::{Path, PathBuf};

use serde_json::Value;

use crate::common::{self, counts, folder, json, realo_ok, simulated, text};
use crate::{VIRTUAL, alone, build, example, python, shipped};

/// Sweeps with points, which lie far enough apart that no race decides which message is the newest.
fn log() -> PathBuf {
    let args = "--seed 914 --seconds 1 --phase spread --key-hz 10 --agents cav1,rsu1";
    simulated("plugin_maps", &args.split(' ').collect::<Vec<_>>())
}

fn run_args(out: &Path, graph: &str, args: &[&str]) -> Vec<String> {
    let (log, out) = (log(), out.to_string_lossy().into_owned());
    let log = log.to_string_lossy().into_owned();
    // Maps go together where they are made in one frame, for the detector was trained for one agent alone.
    let fixed = [
        "run",
        graph,
        "--project",
        "sender",
        "--ego",
        "cav1",
        "--log",
        &log,
        "--out",
        &out,
    ];
    fixed.iter().chain(args).map(|arg| arg.to_string()).collect()
}

fn run(out: &str, graph: &str, args: &[&str]) -> PathBuf {
    let out = folder(out);
    realo_ok(run_args(&out, graph, args));
    out
}

/// The example's program, where its graph looks for it.
fn built() -> String {
    build::built("fusion_mean", "fusion-mean");
    example("fusion_mean/fusion_mean.yml")
}

fn result(out: &Path) -> Value {
    json(&out.join("result.json"))
}

fn frames(out: &Path) -> Value {
    json(&out.join("evaluation.json"))["evaluation"]["scenes"][0]["frames"].take()
}

#[test]
fn a_rust_fusion_of_maps_runs_beside_the_shipped_head() {
    let graph = built();
    let said = realo_ok(["validate", &graph]);
    assert!(said.contains("fine"), "{said}");
    let first = run("maps_rust", &graph, &VIRTUAL);
    let again = run("maps_again", &graph, &VIRTUAL);
    let bytes = |out: &Path| fs::read(out.join("result.json")).expect("there is a result");
    assert!(
        bytes(&first) == bytes(&again),
        "virtual time gives the same bits on every run"
    );

    let all_alike = ["--mode", "virtual", "--set", "fusion.fusion.power=0"];
    assert!(
        frames(&run("maps_alike", &graph, &all_alike)) != frames(&first),
        "its argument reaches it"
    );
    let none = folder("maps_none");
    let no_fusion = run_args(&none, &shipped("no_fusion"), &VIRTUAL);
    realo_ok(
        no_fusion
            .iter()
            .filter(|arg| !["--project", "sender"].contains(&arg.as_str())),
    );
    let (fused, alone) = (
        counts(&result(&first), "vehicle", "0.3"),
        counts(&result(&none), "vehicle", "0.3"),
    );
    println!("vehicles, true, false and all: mean {fused:?}, alone {alone:?}");
    assert!(fused.0 > alone.0, "cooperation finds more: {fused:?} {alone:?}");
    assert!(result(&first)["links"]["rsu1-cav1"]["features"]["used"].as_u64() > Some(5));
}

#[test]
fn a_rust_fusion_of_maps_comes_to_the_same_on_dora() {
    let graph = built();
    let expected = run("maps_dora_virtual", &graph, &VIRTUAL);
    let _alone = alone();
    // A machine that lets a pose wait for 20 ms makes sync go on without it.
    let same = (0..3).any(|_| {
        let found = run("maps_dora", &graph, &["--rate", "0.1"]);
        let features = |out: &Path| result(out)["links"]["rsu1-cav1"]["features"].clone();
        assert_eq!(features(&found), features(&expected));
        frames(&found) == frames(&expected)
    });
    assert!(same, "the boxes of every frame are those of virtual time");
}

#[test]
fn a_rust_fusion_of_maps_takes_what_was_precomputed() {
    let graph = built();
    let dir = folder("maps_precomputed");
    let (profile, with) = (dir.join("none.toml"), dir.join("log.mcap"));
    fs::write(&profile, "\"others.encoder\" = 0\n").expect("the profile can be written");
    let text = |path: &Path| path.to_string_lossy().into_owned();
    let options = ["--project", "sender", "--ego", "cav1"];
    let files = [
        text(&log()),
        graph.clone(),
        "--compute".into(),
        text(&profile),
        "-o".into(),
        text(&with),
    ];
    let words = ["precompute"].iter().chain(&options).map(|word| word.to_string());
    realo_ok(words.chain(files));
    let out = dir.join("out");
    realo_ok(
        [
            &["run", &graph, "--log", &text(&with), "--out", &text(&out)][..],
            &options,
            &VIRTUAL,
        ]
        .concat(),
    );
    assert!(
        frames(&out) == frames(&run("maps_computed", &graph, &VIRTUAL)),
        "the same boxes"
    );
}

#[test]
fn the_examples_own_tests_of_maps_pass() {
    build::cargo(&build::example_named("fusion_mean"), &["test", "--release", "--lib"]);
}

/// Whether all scores lie so near each other.
fn alike(found: &Value, expected: &Value, within: f64) {
    for class in ["vehicle", "pedestrian", "truck"] {
        for iou in ["0.3", "0.5"] {
            let score = |result: &Value| {
                result["accuracy"]["sorted"]["AP"][class][iou]
                    .as_f64()
                    .expect("a score")
            };
            let (found, expected) = (score(found), score(expected));
            assert!(
                (found - expected).abs() < within,
                "{class} at {iou}: {found}, expected {expected}"
            );
        }
    }
}

fn run_python(bin: &Path, out: &str, args: &[&str]) -> PathBuf {
    let out = folder(out);
    let words = run_args(&out, &example("python/mean_python.yml"), args);
    let output = python::with(bin, common::REALO, &words);
    assert!(
        output.status.success(),
        "{}\n{}",
        text(&output.stdout),
        text(&output.stderr)
    );
    out
}

#[test]
fn a_python_fusion_of_maps_finds_what_the_rust_one_finds() {
    let Some(bin) = python::bin() else {
        return;
    };
    let portable = ["--mode", "virtual", "--isa", "portable"];
    let found = result(&run_python(&bin, "maps_python", &portable));
    let expected = result(&run("maps_python_rust", &built(), &portable));
    // The order of sums differs, so that a box may be found at another digit.
    alike(&found, &expected, 0.01);
    assert_eq!(found["links"], expected["links"]);
}

#[test]
fn a_python_fusion_of_maps_runs_on_dora() {
    let Some(bin) = python::bin() else {
        return;
    };
    let _alone = alone();
    let found = result(&run_python(&bin, "maps_python_dora", &["--rate", "0.1"]));
    assert!(
        found["links"]["rsu1-cav1"]["features"]["used"].as_u64() > Some(5),
        "{}",
        found["links"]
    );
    assert!(counts(&found, "vehicle", "0.3").0 > 0);
}
