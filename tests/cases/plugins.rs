//! Stages of one's own, and settings in a word.

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use realo_operator::Registration;
use realo_operator::pipe::memory::Memory;
use realo_operator::pipe::words::Reply;
use realo_operator::pipe::{frame, hello};
use realo_schemas::{Boxes, Header, Kind, Message};

use crate::common::{self, machine};
use crate::scene::{Ran, SWEEP, SWEEPS, Scene, T0, run};

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
            "no node `fusion.fuse` (did you mean `fusion.fusion`?); the graph has: player, others.sense.sync",
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
    let named = settings["link"].as_str().unwrap_or_default();
    assert!(
        named.starts_with("radio-") && named.ends_with(",boxes.loss=0"),
        "with a hash of the file: {named}"
    );
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

/// A program in the place of the fusion that fails on these of its sets of messages, and answers others with no boxes: its
/// replies are written beforehand, for what is asked is known. After those of the scene each takes this long.
pub fn scripted(name: &str, seconds: &str, sweeps: i64, fails: impl Fn(i64) -> bool) -> PathBuf {
    let folder = common::folder(&format!("scripted-{name}"));
    let [hello_file, replies, rest, program] = ["hello", "replies", "rest", "plugin.sh"].map(|name| folder.join(name));
    let own = Registration::operator::<realo_fusion_boxes::FusionBoxes>();
    let words = hello::write(&own, &[], false).expect("it has ports");
    frame::write_first(&mut fs::File::create(&hello_file).expect("a file can be made"), &words).expect("it is written");
    let write = |file: &Path, all: &[Reply]| {
        let mut file = fs::File::create(file).expect("a file can be made");
        for reply in all {
            let parts = reply.to_parts().expect("a reply");
            frame::write(&mut file, &parts, &Memory::default(), false).expect("it is written");
        }
    };
    let answer = |sweep: i64| {
        let stamp = T0 + sweep * SWEEP;
        let header = Header::origin(&"".into(), &"car".into(), Kind::Boxes, sweep as u64, stamp, stamp);
        let boxes = ("proposals".to_string(), Message::new(header, Boxes::default()));
        let (error, sent) = match fails(sweep) {
            true => (Some(format!("no key 'score' in sweep {sweep}")), Vec::new()),
            false => (None, vec![boxes]),
        };
        // First the ego's boxes, then what was selected for them.
        let of_set = Reply {
            error,
            sent,
            ..Reply::default()
        };
        [Reply::default(), of_set]
    };
    write(&replies, &(0..sweeps).flat_map(answer).collect::<Vec<_>>());
    write(&rest, &[Reply::default()]);
    let script = format!(
        "#!/bin/sh\n{{ cat '{}' '{}'; while sleep {seconds}; do cat '{}'; done; }} &\nexec 1>&-\ncat > '{}'\nkill $!\n",
        hello_file.display(),
        replies.display(),
        rest.display(),
        folder.join("calls").display(),
    );
    fs::write(&program, script).expect("a file can be made");
    fs::set_permissions(&program, fs::Permissions::from_mode(0o755)).expect("it can be made a program");
    program
}

fn run_failing(name: &str, mode: &[&str], fails: impl Fn(i64) -> bool) -> Ran {
    let log = Scene::default().write(&format!("failing-{name}"));
    let text = format!("fusion.fusion=program {}", scripted(name, "0", SWEEPS, fails).display());
    run(
        "late_fusion",
        &log,
        &format!("failing-{name}"),
        &[mode, &["--replace", &text]].concat(),
    )
}

/// What the table says first.
fn first_note(ran: &Ran) -> String {
    ran.notes().lines().next().unwrap_or_default().to_string()
}

#[test]
fn a_stage_that_fails_on_its_messages_is_named_first_and_the_exit_code_says_so() {
    for (name, fails, count, code) in [
        ("all", Box::new(|_: i64| true) as Box<dyn Fn(i64) -> bool>, 20, 1),
        ("twelve", Box::new(|sweep| sweep < 12), 12, 3),
        ("one", Box::new(|sweep| sweep == 7), 1, 0),
    ] {
        let ran = run_failing(name, &["--offline"], fails);
        let note = first_note(&ran);
        let expected =
            format!("fusion.fusion (fusion-boxes) failed on {count} of 20 messages; the first: input `selections`, ");
        assert!(note.starts_with(&expected), "{note}: {ran:?}");
        assert!(
            note.contains("no key 'score' in sweep") && note.contains("correct the operator"),
            "{note}"
        );
        assert_eq!(ran.code, code, "{name}: {ran:?}");
        assert!(ran.out.contains(&expected), "the table says it too: {}", ran.out);
    }
}

#[test]
fn a_stage_that_fails_on_all_its_messages_fails_the_run_on_dora_too() {
    machine::decided(|| {
        let _share = machine::half();
        let ran = run_failing("dora", &["--rate", "0.5"], |_| true);
        let note = first_note(&ran);
        assert!(
            note.starts_with("fusion.fusion (fusion-boxes) failed on ") && note.contains("no key 'score'"),
            "{note}: {ran:?}"
        );
        assert_eq!(ran.code, 1, "{ran:?}");
    });
}

#[test]
fn the_doctor_measures_the_rate_of_a_graph() {
    let log = Scene::default().write("doctor").to_string_lossy().into_owned();
    let graph = common::graph("late_fusion");
    let doctor = |more: &[&str]| {
        let args = ["doctor", &graph, "--recorded-detections", "--log", &log];
        let output = common::realo(args.iter().chain(more));
        let said = said(&output);
        let line = said.lines().find(|line| line.contains(" rate: ")).map(String::from);
        line.unwrap_or_else(|| panic!("no rate in {said}"))
    };
    let said = doctor(&[]);
    assert!(
        said.contains("of 10.0 Hz") && said.contains("17 frames of car"),
        "{said}"
    );
    // A set of messages takes it four times as long as a frame may.
    let slow = format!(
        "fusion.fusion=program {}",
        scripted("slow", "0.2", 0, |_| false).display()
    );
    let said = doctor(&["--replace", &slow]);
    assert!(
        said.starts_with("note rate: this machine does ") && said.contains("of 10.0 Hz: play with `--rate 0."),
        "{said}"
    );
    // On a busy machine it takes longer.
    let taken = said.split_once("the slowest, `fusion.fusion`, takes ");
    let ms = taken.and_then(|(_, rest)| rest.split(' ').next()?.parse::<f64>().ok());
    assert!(ms.is_some_and(|ms| (400.0..20_000.0).contains(&ms)), "{said}");
}

#[test]
fn a_setting_that_is_there_twice_counts_as_the_last_one_with_a_note() {
    let log = Scene::default().write("twice");
    let all = [
        "--offline",
        "--set",
        "fusion.fusion.ego_boxes=true",
        "--set",
        "fusion.fusion.ego_boxes=false",
    ];
    let ran = run("late_fusion", &log, "twice", &all);
    let said = "--set fusion.fusion.ego_boxes is there more than once: the last one counts, false, not true";
    assert_eq!(ran.err.matches(said).count(), 1, "{}", ran.err);
    let result = ran.result.as_ref().expect("there is a result");
    assert_eq!(
        (&result["set"], ran.code),
        (&"fusion.fusion.ego_boxes=false".into(), 0),
        "{ran:?}"
    );
}
