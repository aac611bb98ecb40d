//! What agents send, computed beforehand: the same as if they computed in the run, and refused where it would not be.

mod common;

use std::fs;
use std::path::{Path, PathBuf};

use common::machine::decided;
use common::{folder, graph, json, realo, realo_ok, simulated, text};
use serde_json::Value;

/// Two agents with clouds, whose sweeps lie far enough apart that no race decides which message is the newest.
fn log() -> PathBuf {
    let args = "--seed 912 --seconds 2 --phase spread --key-hz 10 --agents cav1,rsu1";
    simulated("precompute", &args.split(' ').collect::<Vec<_>>())
}

/// Three without, for their recorded detections.
fn recorded() -> PathBuf {
    let args = "--seed 913 --seconds 3 --phase spread --no-clouds --key-hz 10 --agents cav1,cav2,rsu1";
    simulated("precompute_recorded", &args.split(' ').collect::<Vec<_>>())
}

fn shown(path: &Path) -> String {
    path.to_string_lossy().into_owned()
}

/// The words of a command, paths among them.
fn words(args: &[&str], paths: &[(&str, &Path)]) -> Vec<String> {
    let paths = paths
        .iter()
        .flat_map(|(option, path)| [option.to_string(), shown(path)]);
    args.iter().map(|arg| arg.to_string()).chain(paths).collect()
}

fn precompute(log: &Path, graph_name: &str, args: &[&str], out: &Path) -> String {
    let (log, graph) = (shown(log), graph(graph_name));
    realo_ok(words(&[&["precompute", &log, &graph], args].concat(), &[("-o", out)]))
}

/// Runs a graph over a log and gives its result and what was detected, frame by frame.
fn run(graph_name: &str, log: &Path, args: &[&str], out: &Path) -> (Value, Value) {
    let graph = graph(graph_name);
    realo_ok(words(
        &[&["run", &graph], args].concat(),
        &[("--log", log), ("--out", out)],
    ));
    let mut samples = json(&out.join("evaluation.json"));
    let frames = samples["evaluation"]["scenes"][0]["frames"].take();
    (json(&out.join("result.json")), frames)
}

/// What a run says on standard error, which must fail.
fn refused(args: &[String]) -> String {
    let output = realo(args);
    assert_eq!(output.status.code(), Some(1), "{args:?}\n{}", text(&output.stdout));
    text(&output.stderr)
}

#[test]
fn a_run_that_plays_what_was_precomputed_comes_to_the_same() {
    let dir = folder("precompute_same");
    let profile = dir.join("slow.toml");
    let virtual_time = ["--mode", "virtual", "--ego", "cav1"];
    let cases = [
        ("attfuse", "others.encoder", "features", &[][..]),
        ("late_fusion", "others.head", "boxes", &[]),
        ("early_fusion", "others.sender", "points", &[]),
        ("fcooper", "others.encoder", "features", &["--project", "receiver"]),
    ];
    for (name, slow, kind, options) in cases {
        fs::write(&profile, format!("\"{slow}\" = 30_000_000\n")).expect("the profile can be written");
        let compute = shown(&profile);
        let compute = [options, &["--compute", &compute]].concat();
        let with = dir.join(format!("{name}.mcap"));
        let said = precompute(&log(), name, &[&compute[..], &["--ego", "cav1"]].concat(), &with);
        assert!(
            said.contains("rsu1: 20 packets") || said.contains("rsu1: 19 packets"),
            "{said}"
        );
        assert!(said.contains("30.0 ms after their sweeps"), "{said}");

        let computed = dir.join(format!("{name}_computed"));
        let (computed, frames) = run(name, &log(), &[&virtual_time, &compute[..]].concat(), &computed);
        let played = dir.join(format!("{name}_played"));
        let (played, played_frames) = run(name, &with, &[&virtual_time, options].concat(), &played);
        assert!(frames == played_frames, "{name}: the same boxes");
        for part in ["accuracy", "frames", "age_ms"] {
            assert_eq!(computed[part], played[part], "{name}: {part}");
        }
        assert_eq!(
            computed["links"]["rsu1-cav1"][kind], played["links"]["rsu1-cav1"][kind],
            "{name}"
        );
        assert!(played["links"]["rsu1-cav1"][kind]["used"].as_u64() > Some(0), "{name}");
        assert_eq!(played["precomputed"], "rsu1 (slow)", "{name}");
        assert_eq!(computed["precomputed"], "", "{name}");
        let stages = played["nodes"].as_object().expect("nodes");
        assert!(
            stages.contains_key("others.sense.sync") && !stages.contains_key(slow),
            "{name}"
        );
    }
}

#[test]
fn what_took_time_to_make_is_as_old_in_the_run() {
    let dir = folder("precompute_measured");
    let with = dir.join("log.mcap");
    precompute(&log(), "late_fusion", &["--agent", "rsu1"], &with);
    let info = realo_ok(["info", &shown(&with)]);
    assert!(info.contains("rsu1 by late_fusion with lite-"), "{info}");
    let args = ["--mode", "virtual", "--ego", "cav1"];
    let (played, _) = run("late_fusion", &with, &args, &dir.join("played"));
    let (computed, _) = run("late_fusion", &log(), &args, &dir.join("computed"));
    let age = |result: &Value| result["age_ms"]["max"].as_f64().expect("an age");
    assert!(
        age(&played) >= age(&computed),
        "{} {}",
        played["age_ms"],
        computed["age_ms"]
    );
    assert_eq!(played["precomputed"], "rsu1 (measured)");
    let table = realo_ok(["compare", &shown(&dir.join("played")), &shown(&dir.join("computed"))]);
    assert!(table.contains("rsu1 (measured)"), "{table}");
}

#[test]
fn agents_are_added_one_by_one_and_runs_of_all_egos_are_pooled() {
    let dir = folder("precompute_added");
    let (first, second) = (dir.join("first.mcap"), dir.join("second.mcap"));
    let detections = ["--recorded-detections"];
    precompute(
        &recorded(),
        "late_fusion",
        &[&detections[..], &["--ego", "cav1"]].concat(),
        &first,
    );
    let some = words(
        &[
            "run",
            &graph("late_fusion"),
            "--recorded-detections",
            "--mode",
            "virtual",
        ],
        &[("--log", &first), ("--out", &dir.join("some"))],
    );
    let missing = "no precomputed messages of cav1, which collaborates with cav2";
    let output = realo(&some);
    let said = text(&output.stderr);
    assert_eq!(output.status.code(), Some(3), "cav1 has been run: {said}");
    assert!(said.contains(missing), "{said}");
    let said = refused(&[some, ["--ego", "cav2"].map(String::from).to_vec()].concat());
    assert!(said.contains(missing), "{said}");
    precompute(
        &first,
        "late_fusion",
        &[&detections[..], &["--agent", "cav1"]].concat(),
        &second,
    );
    let args = ["--recorded-detections", "--mode", "virtual"];
    let (pooled, _) = run("late_fusion", &second, &args, &dir.join("pooled"));
    assert_eq!(pooled["precomputed"], "cav2, rsu1 (measured); cav1, rsu1 (measured)");
    assert_eq!(pooled["frames"]["total"], 60);

    // What another lane computed does not stay beside it.
    let third = dir.join("third.mcap");
    let other = ["--set", "others.nms.threshold=0.3", "--agent", "cav1"];
    let said = realo(words(
        &[
            &[
                "precompute",
                &shown(&second),
                &graph("late_fusion"),
                "--recorded-detections",
            ],
            &other[..],
        ]
        .concat(),
        &[("-o", &third)],
    ));
    assert!(
        text(&said.stderr).contains("computed otherwise and is left out"),
        "{}",
        text(&said.stderr)
    );
    let info = realo_ok(["info", &shown(&third)]);
    assert!(
        info.contains("/cav1/packets") && !info.contains("/rsu1/packets"),
        "{info}"
    );
}

#[test]
fn a_realtime_run_plays_what_was_precomputed() {
    decided(precomputed_on_dora);
}

fn precomputed_on_dora() {
    let dir = folder("precompute_realtime");
    let (profile, with) = (dir.join("none.toml"), dir.join("log.mcap"));
    fs::write(&profile, "\"others.nms\" = 0\n").expect("the profile can be written");
    let compute = shown(&profile);
    let args = ["--recorded-detections", "--ego", "cav1", "--compute", &compute];
    precompute(&recorded(), "late_fusion", &args, &with);
    let args = ["--recorded-detections", "--ego", "cav1"];
    let (expected, boxes) = run(
        "late_fusion",
        &with,
        &[&args[..], &["--mode", "virtual"]].concat(),
        &dir.join("virtual"),
    );
    let (found, found_boxes) = run(
        "late_fusion",
        &with,
        &[&args[..], &["--rate", "0.1"]].concat(),
        &dir.join("realtime"),
    );
    assert!(boxes == found_boxes, "the same boxes under both drivers");
    assert_eq!(expected["accuracy"], found["accuracy"]);
    assert_eq!(found["precomputed"], "cav2, rsu1 (none)");
    assert!(found["nodes"].get("others.sense.sync").is_some() && found["nodes"].get("others.sender").is_none());
}

#[test]
fn messages_that_this_run_would_not_make_are_refused() {
    let dir = folder("precompute_refused");
    let (with, out) = (dir.join("log.mcap"), dir.join("out"));
    let receiver = ["--project", "receiver"];
    let lane = [&["--ego", "cav1", "--isa", "portable"][..], &receiver].concat();
    precompute(&log(), "fcooper", &lane, &with);
    let run = |graph_name: &str, args: &[&str]| {
        let graph = graph(graph_name);
        let all = [&["run", &graph, "--ego", "cav1"], args].concat();
        refused(&words(&all, &[("--log", &with), ("--out", &out)]))
    };
    let virtually = ["--isa", "portable", "--mode", "virtual"];
    let portable = [&virtually[..], &receiver].concat();
    let with_model = [&portable[..], &["--model", "models/lite-attfuse.toml"]].concat();
    let model = run("fcooper", &with_model);
    assert!(
        model.contains("`others.encoder.model` = lite-fcooper-") && model.contains("here it is lite-attfuse-"),
        "{model}"
    );
    let other = run("attfuse", &portable);
    assert!(other.contains("do not fit") && other.contains("attfuse.yml"), "{other}");
    let kernels = run("fcooper", &[&["--mode", "virtual"][..], &receiver].concat());
    assert!(
        kernels.contains("`others.encoder.isa` = portable, here it is auto"),
        "{kernels}"
    );
    let deskew = run(
        "fcooper",
        &[&portable[..], &["--set", "others.sense.sync.deskew=false"]].concat(),
    );
    assert!(
        deskew.contains("`others.sense.sync.deskew` = true, here it is false"),
        "{deskew}"
    );
    let pose = run("fcooper", &[&portable[..], &["--set", "player.pose=true"]].concat());
    assert!(pose.contains("`player.pose` = recorded, here it is true"), "{pose}");
    // As the graph ships.
    let sender = run("fcooper", &virtually);
    assert!(
        sender.contains("`others.projector.project` = receiver, here it is sender"),
        "{sender}"
    );
    let offline = run("fcooper", &["--isa", "portable", "--offline"]);
    assert!(offline.contains("--offline does not play"), "{offline}");
    let passes = run("fcooper", &[&portable[..], &["--set", "player.repeat=2"]].concat());
    assert!(passes.contains("`repeat` must be 1, found 2"), "{passes}");
    assert!(!out.exists(), "nothing was started");

    // What has no part in the lane may change, and an ego alone needs nobody.
    let free = [
        &portable[..],
        &["--link", "paper", "--set", "fusion.bank.window_ms=300"],
    ]
    .concat();
    self::run(
        "fcooper",
        &with,
        &[&free[..], &["--ego", "cav1"]].concat(),
        &dir.join("free"),
    );
    self::run(
        "no_fusion",
        &with,
        &[&virtually[..], &["--ego", "cav1"]].concat(),
        &dir.join("alone"),
    );
}

#[test]
fn what_cannot_be_precomputed_is_refused_and_leaves_nothing() {
    let dir = folder("precompute_bad");
    let out = dir.join("new.mcap");
    let of = |log: &Path, graph_name: &str, args: &[&str], out: &Path| {
        let (log, graph) = (shown(log), graph(graph_name));
        refused(&words(&[&["precompute", &log, &graph], args].concat(), &[("-o", out)]))
    };
    let log = recorded();
    let late = |args: &[&str]| of(&log, "late_fusion", &[&["--recorded-detections"], args].concat(), &out);
    let nobody = late(&["--agent", "rsu7"]);
    assert!(nobody.contains("no agent `rsu7`; it has: cav1, cav2, rsu1"), "{nobody}");
    let everybody = late(&["--agent", "cav1,cav2,rsu1"]);
    assert!(
        everybody.contains("--agent: expected somebody of cav1, cav2, rsu1 left as the ego"),
        "{everybody}"
    );
    let stage = late(&["--set", "others.nsm.threshold=0.1"]);
    assert!(stage.contains("no node `others.nsm`"), "{stage}");
    let empty = of(&log, "late_fusion", &[], &out);
    assert!(empty.contains("a log without points"), "{empty}");
    let alone = of(&self::log(), "no_fusion", &[], &out);
    assert!(alone.contains("there is nothing to precompute"), "{alone}");
    let model = of(&self::log(), "attfuse", &["--model", "models/none.toml"], &out);
    assert!(model.contains("none.toml"), "{model}");

    let copy = dir.join("log.mcap");
    fs::copy(&log, &copy).expect("the log can be copied");
    let same = of(&copy, "late_fusion", &["--recorded-detections"], &copy);
    assert!(same.contains("it is the log that is read"), "{same}");
    assert_eq!(fs::read(&copy).ok(), fs::read(&log).ok(), "the log is as it was");
    let whole = fs::read(&log).expect("the log can be read");
    fs::write(&copy, &whole[..whole.len() / 2]).expect("the log can be cut");
    let cut = of(&copy, "late_fusion", &["--recorded-detections"], &out);
    assert!(cut.contains("precompute a log that is whole"), "{cut}");
    let nowhere = of(
        &log,
        "late_fusion",
        &["--recorded-detections"],
        &dir.join("none/new.mcap"),
    );
    assert!(nowhere.contains("none/new.mcap"), "{nowhere}");
    let left: Vec<_> = fs::read_dir(&dir).expect("the folder is there").collect();
    assert_eq!(left.len(), 1, "only the log: {left:?}");
}
