//! Commands of the workbench as a user meets them: outputs, signals, bad values.

mod common;
#[path = "cases/scene.rs"]
mod scene;

use std::fs;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use common::{LAB, folder, hangups_are_ignored, kill, lab, root, text, until};
use scene::Scene;

fn workbench() -> Command {
    Command::new(LAB.expect("a test of the package `realo-lab`"))
}

#[test]
fn writing_that_fails_says_what_happened_and_what_is_left() {
    let log = common::simulated("workbench-short-files", &["--seed", "1", "--seconds", "2"]);
    let log = log.to_string_lossy();
    let folder = folder("workbench-short-files-out");
    let out = folder.join("out.mcap");
    let out = out.to_string_lossy();
    for args in [
        &["simulate", "--seed", "1", "--seconds", "2", "-o", &*out][..],
        &["import", "log", &log, "-o", &out],
        &["export", "opv2v", &log, "-o", &out],
        &["export", "kitti", &log, "-o", &out, "--agent", "cav1"],
        &["export", "rosbag2", &log, "-o", &out],
    ] {
        // The signal that a long file gives is ignored, so that writing fails as on a full disk.
        let output = Command::new("sh")
            .args([
                "-c",
                "trap '' XFSZ; ulimit -f 100; exec \"$0\" \"$@\"",
                LAB.expect("the workbench"),
            ])
            .args(args)
            .current_dir(root())
            .output()
            .expect("there is a shell");
        let said = text(&output.stderr);
        assert_eq!(output.status.code(), Some(1), "{args:?}: {said}");
        for part in ["out.mcap", "File too large", "nothing of it was left"] {
            assert!(said.contains(part), "{args:?}: {part} is not in {said}");
        }
        assert_eq!(fs::read_dir(&folder).expect("a folder").count(), 0, "{args:?}: {said}");
    }
}

#[test]
fn a_file_that_realo_did_not_write_is_not_replaced() {
    const NOTES: &str = "what I must not forget";
    let mcap = folder("workbench-foreign").join("notes.mcap");
    fs::write(&mcap, NOTES).expect("the folder can be written");
    let log = Scene::default().write("workbench-foreign-log").display().to_string();
    let to = mcap.display().to_string();
    for command in [
        &["simulate", "--seed", "1", "--seconds", "1", "-o", &to][..],
        &["import", "log", &log, "-o", &to],
    ] {
        let output = lab(command);
        let said = text(&output.stderr);
        assert_eq!(output.status.code(), Some(1), "{command:?}: {said}");
        assert!(
            said.contains("refuse to overwrite") && said.contains("notes."),
            "{command:?}: {said}"
        );
    }
    assert_eq!(fs::read_to_string(&mcap).ok().as_deref(), Some(NOTES));
    let forced = ["import", "log", &log, "--level", "none", "-o", &to, "--force"];
    let output = lab(forced);
    assert!(output.status.success(), "{}", text(&output.stderr));
    assert!(lab(&forced[..7]).status.success(), "a log is replaced by a log");
}

#[test]
fn messages_about_negative_numbers_have_the_range() {
    let simulate = ["simulate", "-o", "unused.mcap"];
    for (args, expected) in [
        (
            &["--seed", "1", "--seconds", "1", "--rain", "-3"][..],
            "[0, 300], found -3",
        ),
        (&["--seed", "1", "--seconds", "-1"], "found -1"),
        (
            &["--seed", "-1", "--seconds", "1"],
            "invalid value '-1' for '--seed <SEED>'",
        ),
    ] {
        let output = lab(simulate.iter().chain(args));
        let said = text(&output.stderr);
        assert!(!output.status.success() && said.contains(expected), "{args:?}: {said}");
    }
}

#[test]
fn a_command_of_the_car_is_named() {
    let output = lab(["run", "dataflows/late_fusion.yml"]);
    let said = text(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{said}");
    assert!(
        said.contains("realo-lab: `run` is a command of `realo`: run it: "),
        "{said}"
    );
}

/// Files whose names end so.
fn unfinished(folder: &Path) -> Vec<PathBuf> {
    let entries = fs::read_dir(folder).expect("a folder").flatten();
    let paths = entries.map(|entry| entry.path());
    paths
        .filter(|path| path.extension().is_some_and(|kind| kind == "partial"))
        .collect()
}

#[test]
fn a_signal_leaves_nothing_of_a_log_that_is_written() {
    for (signal, code) in [("INT", 130), ("TERM", 143), ("HUP", 129)] {
        if signal == "HUP" && hangups_are_ignored() {
            skipped::skip("a process that inherits SIGHUP as `nohup` leaves it, ignored, is not ended by it");
            continue;
        }
        let folder = folder(&format!("workbench-partial-{signal}"));
        let out = folder.join("out.mcap");
        let mut command = workbench();
        command
            .args(["simulate", "--seed", "1", "--seconds", "600", "-o"])
            .arg(&out);
        let child = command.stdout(Stdio::null()).stderr(Stdio::piped()).spawn();
        let child = child.expect("the workbench can be started");
        until("it writes", || !unfinished(&folder).is_empty());
        kill(child.id(), signal);
        let ended = child.wait_with_output().expect("it was started");
        let said = text(&ended.stderr);
        assert_eq!(ended.status.code(), Some(code), "{said}");
        assert!(said.contains("out.mcap was complete; nothing of it was left"), "{said}");
        assert_eq!(fs::read_dir(&folder).expect("a folder").count(), 0, "{said}");
    }
}

#[test]
fn a_signal_ends_a_training_after_its_step_with_weights_to_go_on_from() {
    // All classes of the model must be there.
    let scene = Scene {
        class: |index| ["Car", "Pedestrian", "Truck"][index % 3],
        ..Scene::default()
    };
    let log = scene.write("workbench-training");
    let (out, frames) = (folder("workbench-training-out"), folder("workbench-training-frames"));
    let train = |more: &[&str]| {
        let mut command = workbench();
        command.args(["train", "lite", "--threads", "1", "--batch", "1", "--log"]);
        command.arg(&log).arg("--out").arg(&out).arg("--cache").arg(&frames);
        command.args(more).current_dir(root()).stdin(Stdio::null());
        command.stdout(Stdio::piped()).stderr(Stdio::piped());
        command.spawn().expect("the workbench can be started")
    };
    let mut child = train(&["--steps", "100000"]);
    let errors = BufReader::new(child.stderr.take().expect("a pipe"));
    let mut said = Vec::new();
    for line in errors.lines().map(|line| line.expect("text")) {
        if line.contains("training: ") && said.iter().all(|known: &String| !known.contains("training: ")) {
            kill(child.id(), "INT");
        }
        said.push(line);
    }
    assert_eq!(child.wait().expect("it was started").code(), Some(130), "{said:?}");
    let last = said.last().expect("it has said something");
    assert!(
        last.contains("ended by Ctrl-C; --resume goes on from there"),
        "{said:?}"
    );
    let steps = || {
        fs::read_to_string(out.join("curve.csv"))
            .expect("the curve so far")
            .lines()
            .count()
    };
    let before = steps();
    assert!(out.join("checkpoint.safetensors").exists() && before > 1);
    let resumed = train(&["--steps", "100000", "--resume", "--minutes", "0.03"]);
    let resumed = resumed.wait_with_output().expect("it was started");
    // Its steps are not done yet.
    assert_eq!(resumed.status.code(), Some(3), "{}", text(&resumed.stderr));
    assert!(steps() > before, "{before} steps");
}

#[test]
fn a_recipe_is_made_installed_and_its_card_scores_to_the_digit() {
    let out = folder("workbench-recipe");
    let at = |name: &str| out.join(name);
    let small = root().join("tools/training/tests/small.toml");
    fs::copy(&small, at("small.toml")).expect("a model file");
    let stages = r#"
[[stage]]
name = "first"
model = "small.toml"
steps = 3
seeds = "0..2"
per_seed = 1

[[stage]]
name = "second"
model = "small.toml"
from = "first"
steps = 2
seeds = "0..2"
per_seed = 1
card = { about = "A small detector.", limits = ["It finds nothing."] }
"#;
    fs::write(at("small.recipe.toml"), stages).expect("the folder can be written");
    let run = |words: &[&str]| {
        let mut command = workbench();
        command.args(words).current_dir(&out).stdin(Stdio::null());
        let output = command.output().expect("the workbench can be started");
        (output.status.code(), text(&output.stdout), text(&output.stderr))
    };
    let (code, said, _) = run(&["train", "small.recipe.toml", "--plan"]);
    assert_eq!(code, Some(0));
    for part in [
        "first: 0 of 3 steps",
        "second: 0 of 2 steps",
        "all: 1 min on this machine",
    ] {
        assert!(said.contains(part), "{part} is not in {said}");
    }
    let (code, _, errors) = run(&["train", "small.recipe.toml", "--steps", "9"]);
    assert!(
        code == Some(1) && errors.contains("small.recipe.toml: --steps is for the stages"),
        "{errors}"
    );
    let (code, said, errors) = run(&["train", "small.recipe.toml", "--install"]);
    assert_eq!(code, Some(0), "{said}\n{errors}");
    let card = fs::read_to_string(at("small.md")).expect("a card");
    for part in [
        "A small detector.",
        "`small.safetensors`, sha256",
        "| second | first | 2 × 2 |",
        "- It finds nothing.",
    ] {
        assert!(card.contains(part), "{part} is not in {card}");
    }
    assert!(at("small.safetensors").exists() && at("small.svg").exists());
    let (code, said, errors) = run(&["score", "small.toml", "--check"]);
    assert_eq!((code, said.trim()), (Some(0), "small.md: the same digits"), "{errors}");
    fs::write(at("small.md"), card.replace("| mean | |", "| mean | 9 |")).expect("a card");
    let (code, said, _) = run(&["score", "small.toml", "--check"]);
    assert!(
        code == Some(1)
            && said.contains("expected the table of its card")
            && said.contains("mean, IoU: expected `9`, found nothing"),
        "{said}"
    );
    let (_, said, _) = run(&["train", "small.recipe.toml"]);
    assert!(
        said.contains("first: there already") && said.contains("second: there already"),
        "{said}"
    );
}

#[test]
fn each_program_names_itself_and_the_other_one_s_commands() {
    let output = lab(["simulate", "--seed", "1", "--seconds", "0", "-o", "x.mcap"]);
    let said = text(&output.stderr);
    assert!(!output.status.success() && said.starts_with("realo-lab: "), "{said}");
    let said = text(&lab(["rn", "late_fusion"]).stderr);
    let line = said.strip_prefix("realo-lab: there is no command `rn`; `realo` has `run`: run it: ");
    assert!(
        line.is_some_and(|line| line.ends_with("realo run late_fusion\n")),
        "{said}"
    );
    let said = text(&common::realo(["simulate", "--help"]).stderr);
    let line = said.strip_prefix("realo: `simulate` is a command of `realo-lab`: run it: ");
    assert!(
        line.is_some_and(|line| line.ends_with("realo-lab simulate --help\n")),
        "{said}"
    );
}
