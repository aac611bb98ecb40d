//! ONNX files as stages of a graph, without PyTorch: small files, which these tests write.

// The tests of `examples/onnx` use all of it.
#[allow(dead_code)]
#[path = "../../examples/onnx/tests/common/mod.rs"]
mod small;

use std::path::{Path, PathBuf};

use serde_json::Value;
use small::{File, Kind};

use crate::common::machine::decided;
use crate::common::{folder, json, realo, realo_ok, simulated, text};
use crate::{alone, build, example, shipped};

/// Sweeps with points, whose agents begin at least 15 ms apart: no race decides which message is the newest.
fn log() -> PathBuf {
    let args = "--seed 915 --seconds 1 --phase spread --key-hz 10 --agents cav1,cav2,rsu1";
    simulated("plugin_onnx", &args.split(' ').collect::<Vec<_>>())
}

/// The program of `examples/onnx`, which has a target folder, lock and step of CI of its own.
pub fn realo_onnx() -> Option<PathBuf> {
    let program = build::workspace_target().join("release/realo-onnx");
    if !program.is_file() {
        skipped::skip("`cargo build --release --manifest-path examples/onnx/Cargo.toml --target-dir target`");
        return None;
    }
    Some(program)
}

/// Every cell has a car at the mean of all points: x, y, z, length, width, height, yaw and a score before the sigmoid.
fn encoder(folder: &Path) {
    let file = File::default().input("points", Kind::Float, &["n", "4"]);
    let file = file.whole("rest", &[4, 2, 2, 0, 3]).whole("row", &[1, 5]);
    let file = file.whole("zero", &[0]).whole("three", &[3]).whole("axis", &[1]);
    let file = file.whole("shape", &[1, 8, 1, 1]).whole("size", &[1, 8, 25, 64]);
    let file = file.node("ReduceMean", &["points"], "mean", &[("axes", &[0])]);
    let file = file.node("Slice", &["mean", "zero", "three", "axis"], "place", &[]);
    let file = file.node("Cast", &["rest"], "floats", &[("to", &[1])]);
    let file = file.node("Reshape", &["floats", "row"], "fixed", &[]);
    let file = file.node("Concat", &["place", "fixed"], "cell", &[("axis", &[1])]);
    let file = file.node("Reshape", &["cell", "shape"], "one", &[]);
    let file = file.node("Expand", &["one", "size"], "features", &[]);
    file.output("features", Kind::Float, &["1", "8", "25", "64"])
        .write(folder, "encoder.onnx");
}

/// The max over agents.
fn fusion(folder: &Path) {
    let file = File::default().input("maps", Kind::Float, &["agents", "8", "25", "64"]);
    let file = file.node(
        "ReduceMax",
        &["maps"],
        "features",
        &[("axes", &[0]), ("keepdims", &[1])],
    );
    file.output("features", Kind::Float, &["1", "8", "25", "64"])
        .write(folder, "fusion.onnx");
}

/// A box for each cell; of as many channels.
fn head(folder: &Path, name: &str, channels: &str) {
    let file = File::default().input("features", Kind::Float, &["1", channels, "rows", "columns"]);
    let file = file.whole("rows8", &[-1, 8]).whole("axis", &[1]);
    let file = file.whole("zero", &[0]).whole("seven", &[7]).whole("eight", &[8]);
    let file = file.node("Transpose", &["features"], "cells", &[("perm", &[0, 2, 3, 1])]);
    let file = file.node("Reshape", &["cells", "rows8"], "rows", &[]);
    let file = file.node("Slice", &["rows", "zero", "seven", "axis"], "boxes", &[]);
    let file = file.node("Slice", &["rows", "seven", "eight", "axis"], "logits", &[]);
    let file = file.node("Sigmoid", &["logits"], "scores", &[]);
    let file = file.output("boxes", Kind::Float, &["n", "7"]);
    file.output("scores", Kind::Float, &["n", "1"]).write(folder, name);
}

/// The stages of the example's graph with files of a folder.
fn stages(program: &Path, files: &Path, head: &str) -> Vec<String> {
    let (program, files) = (program.display(), files.display());
    [
        format!("ego.encoder=program {program} role=encoder model={files}/encoder.onnx send=own"),
        format!("others.encoder=program {program} role=encoder model={files}/encoder.onnx send=features"),
        format!("fusion.fusion=program {program} role=fusion model={files}/fusion.onnx"),
        format!("fusion.head=program {program} role=head model={files}/{head} classes=vehicle"),
    ]
    .into_iter()
    .flat_map(|stage| ["--replace".into(), stage])
    .collect()
}

fn run(out: &Path, stages: &[String], more: &[&str]) -> [Value; 3] {
    let fixed = ["run", &example("onnx/onnx_attfuse.yml"), "--ego", "cav1"].map(String::from);
    let paths = [
        "--log".into(),
        log().display().to_string(),
        "--out".into(),
        out.display().to_string(),
    ];
    let more = more.iter().map(|word| word.to_string());
    realo_ok(fixed.into_iter().chain(paths).chain(stages.iter().cloned()).chain(more));
    let mut result = json(&out.join("result.json"));
    ["frames", "links", "accuracy"].map(|part| result[part].take())
}

#[test]
fn onnx_files_give_the_same_boxes_on_dora() {
    decided(onnx_on_dora);
}

fn onnx_on_dora() {
    let Some(program) = realo_onnx() else {
        return;
    };
    let files = folder("onnx_small");
    encoder(&files);
    fusion(&files);
    head(&files, "head.onnx", "8");
    let stages = stages(&program, &files, "head.onnx");
    let expected = run(&folder("onnx_small_virtual"), &stages, &["--mode", "virtual"]);
    let [frames, links, accuracy] = &expected;
    assert!(frames["processed"].as_u64() >= Some(9), "{frames}");
    let crossed = &links["rsu1-cav1"]["features"];
    assert!(crossed["used"].as_u64() > Some(0), "{crossed}");
    assert!(
        accuracy["sorted"]["counts"]["vehicle"]["0.3"]["total"].as_u64() > Some(0),
        "{accuracy}"
    );
    let _alone = alone();
    let found = run(&folder("onnx_small_dora"), &stages, &["--rate", "0.1"]);
    assert_eq!(found, expected);
}

#[test]
fn a_head_of_other_channels_than_its_maps_is_refused_before_the_run() {
    let Some(program) = realo_onnx() else {
        return;
    };
    let files = folder("onnx_unfit");
    encoder(&files);
    fusion(&files);
    head(&files, "wide.onnx", "16");
    let all = stages(&program, &files, "wide.onnx");
    let (fused, wide) = (files.join("fusion.onnx"), files.join("wide.onnx"));
    let expected = format!(
        "node `fusion.head`, port `features`: expected maps of 16 channels ({}, input `features`), found 8 channels from `fusion.fusion` \
         ({}, output `features`)",
        wide.display(),
        fused.display()
    );
    // realo's own fusion says as much of its model.
    let of_model = "found 64 channels from `fusion.fusion`";
    let cases = [
        (example("onnx/onnx_attfuse.yml"), &all[..], expected.as_str()),
        (shipped("attfuse"), &all[6..], of_model),
    ];
    for (graph, stages, expected) in cases {
        let log = log().display().to_string();
        let out = files.join("run").display().to_string();
        let run = ["run", &graph, "--offline", "--log", &log, "--out", &out].map(String::from);
        let validate = ["validate", &graph].map(String::from);
        for words in [&run[..], &validate] {
            let output = realo(words.iter().chain(stages));
            let said = format!("{}{}", text(&output.stdout), text(&output.stderr));
            assert!(!output.status.success() && said.contains(expected), "{words:?}: {said}");
        }
        assert!(!files.join("run/result.json").exists());
    }
}
