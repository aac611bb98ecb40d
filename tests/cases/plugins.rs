//! Stages of one's own, and settings in a word.

use std::fs;
use std::path::Path;
use std::process::{Command, Output};

use crate::common;
use crate::scene::{Scene, run};

/// Runs `realo` from another folder.
fn from(folder: &Path, args: &[&str]) -> Output {
    let mut command = Command::new(common::REALO);
    command.args(args).current_dir(folder);
    command.output().expect("realo can be started")
}

fn said(output: &Output) -> String {
    common::text(&output.stdout) + &common::text(&output.stderr)
}

fn fails(output: &Output, expected: &[&str]) {
    let said = said(output);
    assert_eq!(output.status.code(), Some(1), "{said}");
    for part in expected {
        assert!(said.contains(part), "no `{part}` in\n{said}");
    }
}

#[test]
fn a_graph_goes_by_its_name_from_any_folder() {
    let log = Scene::default().write("by-name");
    let folder = common::folder("graphs-by-name");
    let log = log.to_string_lossy();
    let args = |graph| {
        [
            "run",
            graph,
            "--offline",
            "--recorded-detections",
            "--ego",
            "car",
            "--log",
            &log,
        ]
    };
    let output = from(&folder, &args("late_fusion"));
    assert!(output.status.success(), "{}", said(&output));
    let file = common::graph("late_fusion");
    assert!(
        said(&output).contains(&format!("late_fusion is {file}")),
        "{}",
        said(&output)
    );
    assert!(folder.join("out/late_fusion/result.json").exists());
    fails(
        &from(&folder, &args("late_fuson")),
        &["did you mean `late_fusion`?", "v2xvit"],
    );
    fails(
        &from(&folder, &args("graphs/late_fusion.yml")),
        &["did you mean `late_fusion`?"],
    );
    // What lies here goes first.
    fs::write(folder.join("late_fusion.yml"), "nodes: 3").expect("the folder can be written");
    fails(
        &from(&folder, &args("late_fusion")),
        &["late_fusion is late_fusion.yml", "nodes"],
    );
}

#[test]
fn a_stage_gives_way_to_another_in_a_word() {
    let log = Scene::default().write("replace");
    let text = "fusion.fusion=operator fusion-boxes ego_boxes=false";
    let ran = run("late_fusion", &log, "replace", &["--offline", "--replace", text]);
    // The mast's boxes alone: 4 of 8.
    assert_eq!((ran.ap("0.5"), ran.code), (0.5, 0), "{ran:?}");
    let settings = ran.result.as_ref().expect("there is a result");
    let expected = "fusion.fusion=operator fusion-boxes ego_boxes=false";
    assert_eq!(settings["set"], expected);
    for (text, expected) in [
        (
            "fusion.fuse=operator nms",
            "no node `fusion.fuse` (did you mean `fusion.fusion`?); the graph has: player, ego.sense.sync",
        ),
        (
            "fusion.fusion=operator nms",
            "the place has the inputs ego (Boxes), selections (Selection)",
        ),
        ("fusion.fusion=program no_such.py", "no program"),
        ("fusion.fusion=fuse.py", "without the word `program`"),
        (
            "score.results=operator nms",
            "expected an operator or a program to replace",
        ),
    ] {
        let ran = run("late_fusion", &log, "replace-wrong", &["--offline", "--replace", text]);
        assert!(ran.code == 1 && ran.result.is_none(), "{text}: {ran:?}");
        assert!(ran.err.contains(expected), "{text}: {}", ran.err);
    }
    let graph = common::graph("late_fusion");
    let validated = common::realo([
        "validate",
        &graph,
        "--no-start",
        "--replace",
        "fusion.fusion=operator nms",
    ]);
    fails(&validated, &["it does not fit"]);
}

#[test]
fn a_link_is_set_in_a_word() {
    let log = Scene::default().write("link");
    let lost = ["--mode", "virtual", "--link", "delay_ms=10,loss=1"];
    let ran = run("late_fusion", &log, "link", &lost);
    assert_eq!(ran.ap("0.5"), 0.5, "nothing arrives: {ran:?}");
    let settings = ran.result.as_ref().expect("there is a result");
    assert_eq!(settings["link"], "delay_ms=10,loss=1");
    let file = common::folder("link-in-a-word").join("radio.toml");
    fs::write(&file, "[default]\nloss = 1").expect("the folder can be written");
    let changed = format!("{},boxes.loss=0", file.display());
    let ran = run(
        "late_fusion",
        &log,
        "link-changed",
        &["--mode", "virtual", "--link", &changed],
    );
    assert!(ran.ap("0.5") > 0.9, "boxes arrive: {ran:?}");
    let settings = ran.result.as_ref().expect("there is a result");
    assert_eq!(settings["link"], "radio,boxes.loss=0");
    let wrong = ["--mode", "virtual", "--link", "dely_ms=100"];
    let ran = run("late_fusion", &log, "link-wrong", &wrong);
    assert!(ran.code == 1 && ran.err.contains("did you mean `delay_ms`?"), "{ran:?}");
}

#[test]
fn a_new_plug_in_is_written_once() {
    let folder = common::folder("new-plug-ins");
    let output = from(&folder, &["new", "fusion", "my-fusion"]);
    assert!(output.status.success(), "{}", said(&output));
    let said_of_it = said(&output);
    for part in [
        "cargo test --release --manifest-path my-fusion/Cargo.toml",
        "--replace fusion.fusion=",
    ] {
        assert!(said_of_it.contains(part), "no `{part}` in\n{said_of_it}");
    }
    let cargo = fs::read_to_string(folder.join("my-fusion/Cargo.toml")).expect("there is one");
    let operator = common::root().join("operators/operator");
    assert!(cargo.contains(&format!("path = \"{}\"", operator.display())), "{cargo}");
    fails(&from(&folder, &["new", "fusion", "my-fusion"]), &["is not overwritten"]);
    fails(
        &from(&folder, &["new", "fusion", "My Fusion"]),
        &["a name of small letters"],
    );
    fails(&from(&folder, &["new", "detector", "mine"]), &["--python"]);
}
