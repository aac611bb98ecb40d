//! Plug-ins by other people: built as they stand, wired beside shipped operators, run under both drivers.

#[path = "plugins/build.rs"]
mod build;
mod common;
#[path = "plugins/guide.rs"]
mod guide;
#[path = "plugins/live.rs"]
mod live;
#[path = "plugins/maps.rs"]
mod maps;
#[path = "plugins/onnx.rs"]
mod onnx;
#[path = "plugins/python.rs"]
mod python;
#[path = "plugins/ray.rs"]
mod ray;
#[path = "plugins/torch.rs"]
mod torch;

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::sync::{RwLock, RwLockReadGuard, RwLockWriteGuard};

use build::fusion_nearest;
use common::machine::decided;
use common::{counts, folder, json, realo, realo_ok, root, simulated, text};
use serde_json::Value;

/// Sweeps of the agents lie at least 15 ms apart, so that no race decides which message is the newest.
fn log() -> PathBuf {
    let args = "--seed 911 --seconds 1 --phase spread --no-clouds --key-hz 10";
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
    assert!(frames.as_array().is_some_and(|frames| frames.len() == 10), "{frames}");
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
    let all = ["--mode", "virtual", "--set", "fusion.fusion.threshold=1"];
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
fn calls_that_are_measured_take_time_and_leave_a_profile_that_repeats() {
    let _alone = alone();
    let graph = shipped("late_fusion");
    let measured = run(
        "plugin_measured_virtual",
        &graph,
        &["--mode", "virtual", "--compute", "measured"],
    );
    assert_eq!(json(&measured.join("result.json"))["compute"], "measured");
    let profile = measured.join("compute.toml");
    let found = fs::read_to_string(&profile).expect("it leaves a profile");
    let begin = "# Median duration of each stage's calls in a run in virtual time that measured them";
    assert!(
        found.starts_with(begin) && found.contains("[\"fusion.fusion\"]"),
        "{found}"
    );
    let profile = profile.to_string_lossy();
    let again = ["plugin_measured_again", "plugin_measured_once_more"].map(|out| {
        let out = run(out, &graph, &["--mode", "virtual", "--compute", &profile]);
        fs::read(out.join("result.json")).expect("there is a result")
    });
    assert!(again[0] == again[1], "its times are the same on every run");

    let out = folder("plugin_measured_sweep").to_string_lossy().into_owned();
    let sweep = ["sweep", "late_fusion", "--vary", "compute=measured,paper", "-o", &out];
    let refused = realo(sweep);
    let said = text(&refused.stderr);
    assert!(
        !refused.status.success() && said.contains("give the sweep the compute.toml"),
        "{said}"
    );
}

#[test]
fn a_rust_fusion_gives_the_same_boxes_on_dora() {
    decided(rust_fusion_on_dora);
}

fn rust_fusion_on_dora() {
    fusion_nearest();
    let graph = example("fusion_nearest/late_nearest.yml");
    let expected = run("plugin_dora_virtual", &graph, &VIRTUAL);
    let _alone = alone();
    let found = run("plugin_dora", &graph, &["--rate", "0.1"]);
    assert_same(&found, &expected);
}

#[test]
fn the_examples_own_tests_pass() {
    build::cargo(&build::example(), &["test", "--release", "--lib"]);
}

const PROGRAM: &str = "target/release/fusion-nearest";

/// The example's graph, with other words.
fn changed(name: &str, changes: &[(&str, &str)]) -> String {
    let dir = folder(name).join("graph");
    fs::create_dir(&dir).expect("a folder can be made");
    for link in ["../models", "modules", "types", "bin"] {
        std::os::unix::fs::symlink(root().join("dataflows").join(link), dir.join(link)).expect("links can be made");
    }
    let read = |file: &str| fs::read_to_string(example(file)).expect("the example can be read");
    let mut text = read("fusion_nearest/late_nearest.yml");
    for (from, to) in changes {
        assert!(text.contains(from), "{from}");
        text = text.replace(from, to);
    }
    let path = dir.join("graph.yml");
    fs::write(&path, text).expect("the graph can be written");
    path.to_string_lossy().into_owned()
}

/// The example's graph, with a module of its own in which other words stand.
fn changed_module(name: &str, (from, to): (&str, &str), change: (&str, &str)) -> String {
    let graph = changed(name, &[change, ("modules/fuse.boxes.yml", "fuse.yml")]);
    let module = fs::read_to_string(root().join("dataflows/modules/fuse.boxes.yml")).expect("the module can be read");
    let (head, fusion) = module.split_once("id: fusion").expect("it has the stage");
    assert!(fusion.contains(from), "{from}");
    let module = format!("{head}id: fusion{}", fusion.replacen(from, to, 1));
    fs::write(Path::new(&graph).with_file_name("fuse.yml"), module).expect("the module can be written");
    graph
}

/// A graph whose fusion is a script; `$PLUGIN` in it stands for the example.
fn scripted(name: &str, script: &str) -> String {
    let graph = changed(name, &[(PROGRAM, "plugin.sh")]);
    let path = Path::new(&graph).with_file_name("plugin.sh");
    let plugin = format!("PLUGIN='{}'", fusion_nearest().display());
    fs::write(&path, format!("#!/bin/sh\n{plugin}\n{script}\n")).expect("the script can be written");
    fs::set_permissions(&path, fs::Permissions::from_mode(0o755)).expect("it can be made a program");
    graph
}

/// A run in virtual time that must fail by the stage's name, saying all of `expected`.
fn fails(graph: &str, expected: &[&str]) {
    fails_in(graph, &VIRTUAL, expected);
}

fn fails_in(graph: &str, mode: &[&str], expected: &[&str]) {
    let out = Path::new(graph).with_file_name(format!("out{}", mode.len()));
    let output = realo(run_args(&out, graph, mode));
    let said = text(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(said.contains("node `fusion.fusion`"), "{said}");
    for part in expected {
        assert!(said.contains(part), "no `{part}` in\n{said}");
    }
    assert!(!out.join("result.json").exists(), "no results of a run that failed");
}

#[test]
fn a_program_that_speaks_no_protocol_is_refused_by_name() {
    let exits = scripted("plugin_exits", "echo 'no licence' >&2; exit 3");
    fails(&exits, &["exit status: 3", "no licence", "realo_operator::run"]);
    let prints = scripted("plugin_prints", "echo 'hello, world'");
    fails(&prints, &["\"hell\"", "standard error"]);
    let missing = changed("plugin_missing", &[(PROGRAM, "no-such-program")]);
    fails(&missing, &["no program", "no-such-program"]);
    let output = realo(["validate", &missing]);
    assert_eq!(output.status.code(), Some(1));
    assert!(
        text(&output.stdout).contains("no-such-program"),
        "{}",
        text(&output.stdout)
    );
}

/// Hands on the first calls, then nothing more: the program's calls end within a frame.
const CUT: &str = "dd bs=1 count=30000 2>/dev/null | \"$PLUGIN\" \"$@\"";

#[test]
fn a_program_that_fails_in_mid_run_fails_it_with_its_code_and_words() {
    let dies = format!("{CUT}; echo 'out of memory' >&2; exit 9");
    let expected = ["exit status: 9", "the end of the stream", "out of memory"];
    fails(&scripted("plugin_dies", &dies), &expected);
    let hangs_up = format!("{CUT}; exec sleep 60 >&-");
    let expected = ["closed its standard output", "it was stopped"];
    fails(&scripted("plugin_hangs_up", &hangs_up), &expected);
    let babbles = format!("{CUT}; echo 'nonsense, nonsense'");
    fails(&scripted("plugin_babbles", &babbles), &["no reply", "\"nons\""]);
    let late = "\"$PLUGIN\" \"$@\"; exit 5";
    fails(&scripted("plugin_late", late), &["after its end", "exit status: 5"]);
}

#[test]
fn a_program_that_fails_in_mid_run_fails_it_on_dora_too() {
    let dies = format!("{CUT}; echo 'out of memory' >&2; exit 9");
    let dies = scripted("plugin_dies_on_dora", &dies);
    let hangs = scripted("plugin_hangs_on_dora", &format!("{CUT}; exec sleep 120"));
    let babbles = scripted("plugin_babbles_on_dora", &format!("{CUT}; echo 'nonsense, nonsense'"));
    let _alone = alone();
    fails_in(&dies, &[], &["exit status: 9", "before it answered a call"]);
    fails_in(&babbles, &[], &["no reply", "\"nons\""]);
    // Without an end the realtime limit of silence ends the run, long before the 10 minutes of virtual time.
    fails_in(&hangs, &[], &["no reply within 10 s", "it was stopped"]);
}

#[test]
fn a_program_runs_in_its_graphs_folder_under_both_drivers() {
    let script = "[ -f plugin.sh ] || exit 7\nexec \"$PLUGIN\" \"$@\"";
    let graph = scripted("plugin_folder", script);
    run("plugin_folder_virtual", &graph, &VIRTUAL);
    let _alone = alone();
    run("plugin_folder_dora", &graph, &[]);
}

#[test]
fn ports_and_arguments_that_do_not_fit_are_refused() {
    let program = fusion_nearest().to_string_lossy().into_owned();
    let at = (PROGRAM, program.as_str());
    let port = ("ego: _mod/ego, selections: bank", "ego: _mod/ego, chosen: bank");
    let graph = changed_module("plugin_port", port, at);
    fails(&graph, &["`chosen`", "ego, selections"]);
    let output = realo(["validate", &graph]);
    let said = text(&output.stdout);
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(said.contains("`fusion.fusion`, port `selections`"), "{said}");

    let types = ("proposals: realo/v1/Boxes }", "proposals: realo/v1/Report }");
    let output = realo(["validate", &changed_module("plugin_type", types, at)]);
    let said = text(&output.stdout);
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(
        said.contains("`fusion.fusion`, port `proposals`: expected `realo/v1/Boxes`"),
        "{said}"
    );

    let graph = changed("plugin_argument", &[(" threshold=0.15", " treshold=0.15"), at]);
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
    let Some(bin) = python::bin() else {
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
    decided(python_fusion_on_dora);
}

fn python_fusion_on_dora() {
    let Some(bin) = python::bin() else {
        return;
    };
    let _alone = alone();
    let found = run_python(&bin, "python_dora", &["--rate", "0.1"]);
    assert_alike(&found, &run("python_dora_shipped", &shipped("late_fusion"), &VIRTUAL));
}

#[test]
fn the_python_modules_own_tests_pass() {
    let Some(bin) = python::bin() else {
        return;
    };
    let tests = root().join("python/tests").to_string_lossy().into_owned();
    let args = ["-m", "unittest", "discover", "-s", &tests].map(String::from);
    let output = python::with(&bin, &bin.join("python").to_string_lossy(), &args);
    assert!(output.status.success(), "{}", text(&output.stderr));
}

/// Writes a plug-in in Python and has its own test pass; gives its program.
fn new_python(bin: &Path, kind: &str, name: &str) -> PathBuf {
    let mine = folder(&format!("new_{kind}")).join(name);
    realo_ok(["new", kind, &mine.to_string_lossy(), "--python"]);
    let args = ["-m", "unittest", "discover", "-s", &mine.to_string_lossy()].map(String::from);
    let output = python::with(bin, &bin.join("python").to_string_lossy(), &args);
    let said = text(&output.stderr);
    assert!(output.status.success() && said.contains("OK"), "{said}");
    mine.join(format!("{name}.py"))
}

#[test]
fn a_new_fusion_in_python_takes_a_stage_of_any_graph() {
    let Some(bin) = python::bin() else {
        return;
    };
    let program = new_python(&bin, "fusion", "my_fusion");
    let replace = format!("fusion.fusion=program {} min_score=0", program.display());
    let out = folder("new_fusion_run");
    let args = run_args(&out, "late_fusion", &["--mode", "virtual", "--replace", &replace]);
    let output = python::with(&bin, common::REALO, &args);
    assert!(output.status.success(), "{}", text(&output.stderr));
    assert_alike(&out, &run("new_fusion_shipped", &shipped("late_fusion"), &VIRTUAL));
    let result = json(&out.join("result.json"));
    assert_eq!(result["set"], "fusion.fusion=program my_fusion.py min_score=0");
    // Its ports do not fit where boxes are suppressed.
    let replace = format!("fusion.nms=program {}", program.display());
    let args = run_args(&out, "late_fusion", &["--mode", "virtual", "--replace", &replace]);
    let said = text(&python::with(&bin, common::REALO, &args).stderr);
    for part in [
        "it does not fit",
        "offers the inputs ego (Boxes), selections (Selection)",
        "the place has the inputs proposals (Boxes)",
    ] {
        assert!(said.contains(part), "no `{part}` in\n{said}");
    }
}

#[test]
fn boxes_of_a_python_stage_that_no_object_can_have_are_named() {
    let Some(bin) = python::bin() else {
        return;
    };
    let shipped = std::fs::read_to_string(example("python/fusion_boxes.py")).expect("the example");
    let absurd = shipped.replace(
        "        low = fused",
        "        fused[\"x\"][:1] = 1e30\n        low = fused",
    );
    assert_ne!(absurd, shipped);
    let program = folder("absurd_boxes").join("absurd.py");
    std::fs::write(&program, absurd).expect("the folder can be written");
    let replace = format!("fusion.fusion=program {}", program.display());
    let out = folder("absurd_boxes_run");
    let args = run_args(&out, "late_fusion", &["--mode", "virtual", "--replace", &replace]);
    let output = python::with(&bin, common::REALO, &args);
    assert!(output.status.success(), "{}", text(&output.stderr));
    let notes = json(&out.join("result.json"))["notes"].to_string();
    for part in [
        "boxes were not taken from the program of fusion.fusion, because no object can have such numbers (the first has a distance of \
         1.000e30 m)",
        "correct the program",
    ] {
        assert!(notes.contains(part), "no `{part}` in\n{notes}");
    }
}

#[test]
fn a_stage_is_replaced_on_dora_as_in_virtual_time() {
    decided(|| {
        let program = fusion_nearest();
        let replace = format!("fusion.fusion=program {} threshold=1", program.display());
        let expected = run(
            "replaced_virtual",
            "late_fusion",
            &["--mode", "virtual", "--replace", &replace],
        );
        let _alone = alone();
        let found = run(
            "replaced_on_dora",
            "late_fusion",
            &["--rate", "0.1", "--replace", &replace],
        );
        assert_same(&found, &expected);
    });
}

#[test]
fn a_new_detector_in_python_takes_two_stages_of_each_lane() {
    let Some(bin) = python::bin() else {
        return;
    };
    let program = new_python(&bin, "detector", "my_detector");
    let log = simulated("plugins_detector", &["--seed", "5", "--seconds", "1", "--key-hz", "10"]);
    let out = folder("new_detector_run");
    let replace = format!("ego.encoder+head,others.encoder+head=program {}", program.display());
    let log = log.to_string_lossy();
    let fixed = [
        "run",
        "late_fusion",
        "--mode",
        "virtual",
        "--ego",
        "cav1",
        "--agents",
        "cav1,cav2",
        "--log",
        &log,
        "--replace",
        &replace,
        "--out",
    ];
    let args: Vec<String> = fixed
        .iter()
        .map(|arg| arg.to_string())
        .chain([out.to_string_lossy().into_owned()])
        .collect();
    let output = python::with(&bin, common::REALO, &args);
    assert!(output.status.success(), "{}", text(&output.stderr));
    let found = counts(&json(&out.join("result.json")), "vehicle", "0.3");
    println!("vehicles, true of all: {} of {}", found.0, found.2);
    assert!(found.0 > 0, "it finds some: {found:?}");
}

#[test]
fn the_guide_can_be_followed_in_rust() {
    let mine = guide::folder("guide_rust", &["1. The crate", "2. The graph"]);
    fusion_nearest();
    guide::share_target(&mine);
    {
        let _compiling = compiling();
        let said = guide::shell(&mine, "1. The crate", None);
        assert!(said.contains("holds_what_every_fusion_owes_its_graph ... ok"), "{said}");
        assert!(!said.contains("Compiling dora"), "a plug-in never links dora: {said}");
    }
    let said = guide::shell(&mine, "2. The graph", None);
    assert!(said.contains("late_fill.yml: fine"), "{said}");
    let _alone = alone();
    let said = guide::shell(&mine, "3. Runs", None);
    assert!(said.contains("late_fusion") && said.contains("late_fill"), "{said}");
}

#[test]
fn the_guide_can_be_followed_in_python() {
    let Some(bin) = python::bin() else {
        return;
    };
    let mine = guide::folder("guide_python", &["In Python"]);
    let _alone = alone();
    let said = guide::shell(&mine, "In Python", Some(&bin));
    assert!(said.contains("late_fusion"), "{said}");
    let result = |out: &str| json(&mine.join(out).join("result.json"));
    let program = "fusion.fusion=program fusion_fill.py overlap=0.05";
    assert_eq!(result("virtual")["set"], program);
    assert!(result("virtual")["accuracy"].is_object() && result("realtime")["accuracy"].is_object());
}
