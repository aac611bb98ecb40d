//! Plug-ins by other people: built as they stand, wired beside shipped operators, run under both drivers.

#[path = "plugins/build.rs"]
mod build;
mod common;
#[path = "plugins/guide.rs"]
mod guide;
#[path = "plugins/python.rs"]
mod python;

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::sync::{RwLock, RwLockReadGuard, RwLockWriteGuard};

use build::fusion_nearest;
use common::{counts, folder, json, realo, realo_ok, root, simulated, text};
use serde_json::Value;

/// Sweeps of the agents lie at least 15 ms apart, so that no race decides which message is the newest.
fn log() -> PathBuf {
    let args = "--seed 911 --seconds 3 --phase spread --no-clouds --key-hz 10";
    simulated("plugins", &args.split(' ').collect::<Vec<_>>())
}

fn example(graph: &str) -> String {
    root().join("examples").join(graph).to_string_lossy().into_owned()
}

fn shipped(graph: &str) -> String {
    common::graph(graph)
}

/// Runs on dora share the machine's cores neither with each other nor with a compiler: compilers share, runs do not.
static CORES: RwLock<()> = RwLock::new(());

fn alone() -> RwLockWriteGuard<'static, ()> {
    CORES.write().unwrap_or_else(|poisoned| poisoned.into_inner())
}

fn compiling() -> RwLockReadGuard<'static, ()> {
    CORES.read().unwrap_or_else(|poisoned| poisoned.into_inner())
}

/// Runs a graph over the log for one ego and gives its folder.
fn run(out: &str, graph: &str, args: &[&str]) -> PathBuf {
    let out = folder(out);
    realo_ok(run_args(&out, graph, args));
    out
}

fn run_args(out: &Path, graph: &str, args: &[&str]) -> Vec<String> {
    let (log, out) = (log(), out.to_string_lossy().into_owned());
    let fixed = [
        "run",
        graph,
        "--recorded-detections",
        "--ego",
        "cav1",
        "--log",
        &log.to_string_lossy(),
        "--out",
        &out,
    ]
    .map(String::from);
    fixed
        .into_iter()
        .chain(args.iter().map(|arg| arg.to_string()))
        .collect()
}

const VIRTUAL: [&str; 2] = ["--mode", "virtual"];

/// What was scored and what became of every message: the parts of a result that do not name the graph.
fn outcome(out: &Path) -> [Value; 4] {
    let mut result = json(&out.join("result.json"));
    let mut samples = json(&out.join("evaluation.json"));
    let frames = samples["evaluation"]["scenes"][0]["frames"].take();
    assert!(frames.as_array().is_some_and(|frames| frames.len() == 30), "{frames}");
    [
        result["accuracy"].take(),
        result["links"].take(),
        result["frames"].take(),
        frames,
    ]
}

fn assert_same(a: &Path, b: &Path) {
    for (a, b) in outcome(a).iter().zip(&outcome(b)) {
        assert!(a == b, "expected the same outcome, found\n{a}\n{b}");
    }
}

#[test]
fn a_rust_fusion_of_its_own_runs_beside_shipped_operators() {
    fusion_nearest();
    let graph = example("fusion_nearest/late_nearest.yml");
    let said = realo_ok(["validate", &graph]);
    assert!(said.contains("fine"), "{said}");

    let expected = run("plugin_shipped", &shipped("late_fusion"), &VIRTUAL);
    let all = ["--mode", "virtual", "--set", "fusion.threshold=1"];
    let first = run("plugin_all", &graph, &all);
    assert_same(&first, &expected);
    let again = run("plugin_again", &graph, &all);
    let bytes = |out: &Path| fs::read(out.join("result.json")).expect("there is a result");
    assert!(
        bytes(&first) == bytes(&again),
        "virtual time gives the same bits on every run"
    );

    let nearest = json(&run("plugin_nearest", &graph, &VIRTUAL).join("result.json"));
    let alone = json(&run("plugin_none", &shipped("no_fusion"), &VIRTUAL).join("result.json"));
    let (nearest, alone) = (counts(&nearest, "vehicle", "0.3"), counts(&alone, "vehicle", "0.3"));
    println!(
        "vehicles, true of all: nearest {} of {}, alone {} of {}",
        nearest.0, nearest.2, alone.0, alone.2
    );
    assert!(nearest.0 > alone.0, "cooperation finds more: {nearest:?} {alone:?}");
}

#[test]
fn a_rust_fusion_gives_the_same_boxes_on_dora() {
    fusion_nearest();
    let graph = example("fusion_nearest/late_nearest.yml");
    let expected = run("plugin_dora_virtual", &graph, &VIRTUAL);
    let _alone = alone();
    let found = run("plugin_dora", &graph, &["--rate", "0.1"]);
    assert_same(&found, &expected);
}

#[test]
fn the_examples_own_tests_pass() {
    build::cargo(&build::example(), &["test", "--lib"]);
}

/// The example's graph with other words in it.
fn changed(name: &str, changes: &[(&str, &str)]) -> String {
    fusion_nearest();
    let dir = folder(name).join("graph");
    fs::create_dir(&dir).expect("a folder can be made");
    for link in ["../models", "modules", "types", "bin"] {
        std::os::unix::fs::symlink(root().join("dataflows").join(link), dir.join(link)).expect("links can be made");
    }
    let mut graph = fs::read_to_string(example("fusion_nearest/late_nearest.yml")).expect("the graph can be read");
    for (from, to) in changes {
        assert!(graph.contains(from), "{from}");
        graph = graph.replace(from, to);
    }
    let path = dir.join("graph.yml");
    fs::write(&path, graph).expect("the graph can be written");
    path.to_string_lossy().into_owned()
}

const PROGRAM: &str = "../../target/release/fusion-nearest";

/// A graph whose fusion is a script; `$PLUGIN` in it stands for the example.
fn scripted(name: &str, script: &str) -> String {
    let graph = changed(name, &[(PROGRAM, "./plugin.sh")]);
    let path = Path::new(&graph).with_file_name("plugin.sh");
    let plugin = format!("PLUGIN='{}'", fusion_nearest().display());
    fs::write(&path, format!("#!/bin/sh\n{plugin}\n{script}\n")).expect("the script can be written");
    fs::set_permissions(&path, fs::Permissions::from_mode(0o755)).expect("it can be made a program");
    graph
}

/// A run in virtual time that must fail by the node's name, saying all of `expected`.
fn fails(graph: &str, expected: &[&str]) {
    let out = Path::new(graph).with_file_name("out");
    let output = realo(run_args(&out, graph, &VIRTUAL));
    let said = text(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(said.contains("node `fusion`"), "{said}");
    for part in expected {
        assert!(said.contains(part), "no `{part}` in\n{said}");
    }
    assert!(!out.join("result.json").exists(), "no results of a run that failed");
}

#[test]
fn a_program_that_speaks_no_protocol_is_refused_by_name() {
    let exits = scripted("plugin_exits", "echo 'no licence' >&2; exit 3");
    fails(
        &exits,
        &["exit status: 3", "no licence", "run any other graph in realtime"],
    );
    fails(
        &scripted("plugin_prints", "echo 'hello, world'"),
        &["\"hell\"", "standard error"],
    );
    let missing = changed("plugin_missing", &[(PROGRAM, "./no-such-program")]);
    fails(&missing, &["cannot start", "no-such-program"]);
    let said = realo_ok(["validate", &missing]);
    assert!(
        said.contains("cannot start"),
        "dora may find it, a note is enough: {said}"
    );
}

#[test]
fn a_program_that_fails_in_mid_run_fails_it_with_its_code_and_words() {
    // The program's calls end within a frame; what the script does then is its failure.
    let cut = "dd bs=1 count=30000 2>/dev/null | \"$PLUGIN\" \"$@\"";
    let dies = format!("{cut}; echo 'out of memory' >&2; exit 9");
    fails(
        &scripted("plugin_dies", &dies),
        &["exit status: 9", "the end of the stream", "out of memory"],
    );
    let hangs_up = format!("{cut}; exec sleep 60 >&-");
    fails(
        &scripted("plugin_hangs_up", &hangs_up),
        &["closed its standard output", "it was stopped"],
    );
    let babbles = format!("{cut}; echo 'nonsense, nonsense'");
    fails(&scripted("plugin_babbles", &babbles), &["no reply", "\"nons\""]);
    let late = "\"$PLUGIN\" \"$@\"; exit 5";
    fails(&scripted("plugin_late", late), &["after its end", "exit status: 5"]);
}

#[test]
fn ports_and_arguments_that_do_not_fit_are_refused() {
    let changes = [(
        "      selections: { source: bank/selections",
        "      chosen: { source: bank/selections",
    )];
    let types = (
        "ego: realo/v1/Boxes, selections: realo/v1/Selection",
        "ego: realo/v1/Boxes, chosen: realo/v1/Selection",
    );
    let graph = changed(
        "plugin_port",
        &[changes[0], types, (PROGRAM, &fusion_nearest().to_string_lossy())],
    );
    fails(&graph, &["port `chosen`", "`fusion-nearest`: ego, selections"]);
    let output = realo(["validate", &graph]);
    let said = text(&output.stdout);
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(
        said.contains("error: node `fusion`, port `selections`: expected a wire"),
        "{said}"
    );

    let types = (
        "{ boxes: realo/v1/Boxes, report: realo/v1/Report }",
        "{ boxes: realo/v1/Report, report: realo/v1/Report }",
    );
    let graph = changed("plugin_type", &[types, (PROGRAM, &fusion_nearest().to_string_lossy())]);
    let output = realo(["validate", &graph]);
    let said = text(&output.stdout);
    assert!(
        said.contains("node `fusion`, port `boxes`: expected `realo/v1/Boxes`"),
        "{said}"
    );

    let threshold = ("args: threshold=0.15\n", "args: treshold=0.15\n");
    let graph = changed(
        "plugin_argument",
        &[threshold, (PROGRAM, &fusion_nearest().to_string_lossy())],
    );
    fails(&graph, &["did you mean `threshold`?", "exit status: 1"]);
}

/// Runs the Python example's graph, which must succeed.
fn run_python(bin: &Path, out: &str, args: &[&str]) -> PathBuf {
    let out = folder(out);
    let output = python::with(
        bin,
        common::REALO,
        &run_args(&out, &example("python/late_python.yml"), args),
    );
    assert!(
        output.status.success(),
        "{}\n{}",
        text(&output.stdout),
        text(&output.stderr)
    );
    out
}

/// Whether two documents differ in nothing but the last digits of numbers.
fn alike(a: &Value, b: &Value) -> bool {
    match (a, b) {
        (Value::Array(a), Value::Array(b)) => a.len() == b.len() && a.iter().zip(b).all(|(a, b)| alike(a, b)),
        (Value::Object(a), Value::Object(b)) => {
            a.len() == b.len() && a.iter().all(|(key, a)| b.get(key).is_some_and(|b| alike(a, b)))
        }
        (Value::Number(a), Value::Number(b)) => match (a.as_f64(), b.as_f64()) {
            (Some(a), Some(b)) => (a - b).abs() <= 1e-6 * (1.0 + a.abs()),
            _ => a == b,
        },
        _ => a == b,
    }
}

/// Python's arithmetic may round the last digit otherwise than Rust's.
fn assert_alike(a: &Path, b: &Path) {
    for (a, b) in outcome(a).iter().zip(&outcome(b)) {
        assert!(alike(a, b), "expected the same outcome, found\n{a}\n{b}");
    }
}

#[test]
fn a_python_fusion_runs_beside_shipped_operators_in_virtual_time() {
    let Some(bin) = python::bin("a_python_fusion_runs_beside_shipped_operators_in_virtual_time") else {
        return;
    };
    let validate = ["validate".to_string(), example("python/late_python.yml")];
    let output = python::with(&bin, common::REALO, &validate);
    assert!(
        text(&output.stdout).contains("fine"),
        "{}{}",
        text(&output.stdout),
        text(&output.stderr)
    );
    let first = run_python(&bin, "python_virtual", &VIRTUAL);
    assert_alike(&first, &run("python_shipped", &shipped("late_fusion"), &VIRTUAL));
    let again = run_python(&bin, "python_again", &VIRTUAL);
    let bytes = |out: &Path| fs::read(out.join("result.json")).expect("there is a result");
    assert!(
        bytes(&first) == bytes(&again),
        "virtual time gives the same bits on every run"
    );
}

#[test]
fn a_python_fusion_gives_the_same_boxes_on_dora() {
    let Some(bin) = python::bin("a_python_fusion_gives_the_same_boxes_on_dora") else {
        return;
    };
    let _alone = alone();
    let found = run_python(&bin, "python_dora", &["--rate", "0.1"]);
    assert_alike(&found, &run("python_dora_shipped", &shipped("late_fusion"), &VIRTUAL));
}

#[test]
fn the_python_modules_own_tests_pass() {
    let Some(bin) = python::bin("the_python_modules_own_tests_pass") else {
        return;
    };
    let tests = root().join("python/tests").to_string_lossy().into_owned();
    let args = ["-m", "unittest", "discover", "-s", &tests].map(String::from);
    let output = python::with(&bin, &bin.join("python").to_string_lossy(), &args);
    assert!(output.status.success(), "{}", text(&output.stderr));
}

#[test]
fn the_guide_to_a_fusion_of_ones_own_can_be_followed() {
    let mine = guide::folder();
    build::cargo(&mine, &["test"]);
    build::cargo(&mine, &["build"]);
    let said = guide::shell(&mine, "## 2. The graph", |_| true);
    assert!(said.contains("late_fill.yml: fine"), "{said}");
    // Runs on dora are tested above.
    let said = guide::shell(&mine, "## 3. Runs", |line| !line.contains("in realtime"));
    assert!(said.contains("late_fusion") && said.contains("late_fill"), "{said}");
    println!("{said}");
}
