//! Networks of PyTorch as plug-ins, and the same as ONNX files: beside a plain script, and beside realo's own kernels.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::OnceLock;

use serde_json::Value;

use crate::common::machine::decided;
use crate::common::{self, folder, json, root, simulated, text};
use crate::onnx::realo_onnx;
use crate::{alone, example, python, shipped};

/// Sweeps with points of three agents.
fn log() -> PathBuf {
    let args = "--seed 914 --seconds 0.5 --phase spread --key-hz 10 --agents cav1,cav2,rsu1";
    simulated("plugin_torch", &args.split(' ').collect::<Vec<_>>())
}

/// The folder of a Python that has PyTorch besides what plug-ins need; without one the running test is left out.
fn with_torch() -> Option<PathBuf> {
    static FOUND: OnceLock<Option<PathBuf>> = OnceLock::new();
    let find = || {
        let tell = "import sys, numpy, pyarrow, safetensors, torch; print(sys.executable)";
        let output = Command::new("python3").args(["-c", tell]).output().ok()?;
        let program = PathBuf::from(text(&output.stdout).trim());
        output.status.success().then(|| program.parent().map(PathBuf::from))?
    };
    let found = FOUND.get_or_init(find).clone();
    if found.is_none() {
        skipped::skip("a `python3` on PATH with PyTorch: `python3 -m pip install torch safetensors numpy pyarrow`");
    }
    found
}

fn script(name: &str) -> String {
    example(&format!("python/{name}"))
}

const WEIGHTS: &str = "models/lite-attfuse.safetensors";

/// Runs a script of that Python, which must succeed; gives what it printed.
fn run_script(bin: &Path, args: &[&str]) -> String {
    let args: Vec<String> = args.iter().map(|arg| arg.to_string()).collect();
    let output = python::with(bin, "python3", &args);
    assert!(output.status.success(), "{args:?}: {}", text(&output.stderr));
    text(&output.stdout)
}

/// Runs a graph for one ego.
fn run(bin: &Path, out: &Path, graph: &str, args: &[&str]) {
    let (log, out) = (log(), out.to_string_lossy());
    let log = log.to_string_lossy();
    let fixed = ["run", graph, "--ego", "cav1", "--log", &log, "--out", &out];
    let words: Vec<String> = fixed.iter().chain(args).map(|arg| arg.to_string()).collect();
    let output = python::with(bin, common::REALO, &words);
    assert!(
        output.status.success(),
        "{}\n{}",
        text(&output.stdout),
        text(&output.stderr)
    );
}

/// A stage that keeps what goes into an input.
fn kept(input: &str, kind: &str, folder: &Path) -> String {
    format!(
        "{input}=program {} type={kind} out={}",
        script("keep_messages.py"),
        folder.display()
    )
}

/// Runs a graph offline and keeps what its head finds.
fn proposals(bin: &Path, name: &str, graph: &str, more: &[&str]) -> PathBuf {
    let out = folder(name);
    let boxes = out.join("boxes");
    let keep = kept("fusion.nms.proposals", "Boxes", &boxes);
    run(bin, &out, graph, &[&["--offline", "--replace", &keep], more].concat());
    boxes
}

/// How far boxes of two folders are apart.
fn compared(bin: &Path, found: &Path, expected: &Path) -> Value {
    let program = root().join("tests/plugins/compare_boxes.py");
    let [program, found, expected] = [&program, found, expected].map(|path| path.to_string_lossy().into_owned());
    let said = run_script(bin, &[&program, &found, &expected]);
    println!("{said}");
    serde_json::from_str(&said).expect("it prints JSON")
}

/// Every box of one has the other's within a centimetre and a thousandth, but such as are about as sure as the threshold.
fn assert_near(compared: &Value) {
    let number = |name: &str| compared[name].as_f64().expect("a number");
    assert!(number("boxes") > 50.0 && number("frames") >= 4.0, "{compared}");
    assert!(
        number("boxes_apart") < 0.01 && number("scores_apart") < 1e-3,
        "{compared}"
    );
    assert!(number("highest_alone") < 0.1 + 1e-3, "{compared}");
}

#[test]
fn torch_plugins_find_the_boxes_of_a_plain_script() {
    let Some(bin) = with_torch() else {
        return;
    };
    let clouds = folder("torch_clouds");
    let keep = ["ego.encoder.clouds", "others.encoder.clouds"].map(|input| kept(input, "PointCloud", &clouds));
    // What crosses the link is not rounded to bytes, which the script does not do.
    let exact = "others.sender.elements=f32";
    let more = ["--replace", &keep[0], "--replace", &keep[1], "--set", exact];
    let found = proposals(&bin, "torch_graph", &script("torch_attfuse.yml"), &more);

    let [plain, clouds] = [folder("torch_plain"), clouds].map(|path| path.to_string_lossy().into_owned());
    let checkpoint = format!("{clouds}/net.pth");
    let save = "import sys, torch; from safetensors.torch import load_file; torch.save({'state_dict': load_file(sys.argv[1])}, sys.argv[2])";
    run_script(&bin, &["-c", save, WEIGHTS, &checkpoint]);
    run_script(
        &bin,
        &[&script("torch_script.py"), &checkpoint, &clouds, "cav1", &plain],
    );
    let same = compared(&bin, &found, Path::new(&plain));
    assert_eq!(same["equal"], true, "{same}");
    assert_near(&same);
}

#[test]
fn torch_plugins_find_what_the_shipped_network_finds() {
    let Some(bin) = with_torch() else {
        return;
    };
    let found = proposals(&bin, "torch_beside", &script("torch_attfuse.yml"), &[]);
    let expected = proposals(&bin, "torch_shipped", &shipped("attfuse"), &["--precision", "f32"]);
    assert_near(&compared(&bin, &found, &expected));
    // Maps that differ in their last digits compress to other lengths.
    let links = |boxes: &Path| {
        let mut links = json(&boxes.with_file_name("result.json"))["links"].take();
        for link in links.as_object_mut().expect("links by name").values_mut() {
            let features = link.get_mut("features").and_then(Value::as_object_mut);
            features.map(|features| features.remove("bytes"));
        }
        links
    };
    assert_eq!(links(&found), links(&expected));
}

#[test]
fn weights_that_are_none_are_refused_before_the_first_message() {
    let Some(bin) = with_torch() else {
        return;
    };
    let dir = folder("torch_refused");
    let write = |name: &str, bytes: &[u8]| {
        std::fs::write(dir.join(name), bytes).expect("it can be written");
        dir.join(name).display().to_string()
    };
    let whole = format!("{}/whole.pth", dir.display());
    let save = "import sys, torch; torch.save(torch.nn.Linear(2, 2), sys.argv[1])";
    run_script(&bin, &["-c", save, &whole]);
    let other = format!("{}/other.pth", dir.display());
    let save = "import sys, torch; torch.save(torch.nn.Linear(2, 2).state_dict(), sys.argv[1])";
    run_script(&bin, &["-c", save, &other]);
    let cases = [
        (
            "nowhere.pth".into(),
            "setting `weights`: expected a file, found `nowhere.pth`",
        ),
        (
            write("p.pth", b"version https://git-lfs.github.com/spec/v1\n"),
            "git lfs pull",
        ),
        (write("text.pth", b"text"), "expected the state dict of a network"),
        (whole, "expected the state dict of a network"),
        (other, "its tensors are not those of the network"),
    ];
    for (weights, expected) in cases {
        let stage = format!("fusion.head=program {} weights={weights}", script("torch_head.py"));
        let words = ["validate", &shipped("attfuse"), "--replace", &stage].map(String::from);
        let output = python::with(&bin, common::REALO, &words);
        let said = text(&output.stderr);
        assert!(!output.status.success() && said.contains(expected), "{weights}: {said}");
    }
}

#[test]
fn the_time_that_torch_takes_is_charged_in_virtual_time() {
    let Some(bin) = with_torch() else {
        return;
    };
    let _alone = alone();
    let out = folder("torch_measured");
    run(
        &bin,
        &out,
        &script("torch_attfuse.yml"),
        &["--mode", "virtual", "--compute", "measured"],
    );
    let timing = json(&out.join("timing.json"));
    for stage in ["ego.encoder", "fusion.fusion", "fusion.head"] {
        let took = timing["compute_ns"][stage]
            .as_object()
            .expect("a stage that was called");
        // Convolutions of gigaflops, and a hop to another process, take longer than this on every machine.
        assert!(
            took.values().all(|took| took.as_i64() > Some(200_000)),
            "{stage}: {took:?}"
        );
    }
}

#[test]
fn torch_plugins_give_the_same_boxes_on_dora() {
    decided(torch_on_dora);
}

fn torch_on_dora() {
    let Some(bin) = with_torch() else {
        return;
    };
    let outcome = |out: &Path| {
        let mut result = json(&out.join("result.json"));
        ["frames", "links", "accuracy"].map(|part| result[part].take())
    };
    let graph = script("torch_attfuse.yml");
    let [expected, found] = ["torch_dora_virtual", "torch_dora"].map(folder);
    run(&bin, &expected, &graph, &["--mode", "virtual"]);
    let _alone = alone();
    // Slowly: no map is late because the network takes its time.
    run(&bin, &found, &graph, &["--rate", "0.05"]);
    assert_eq!(outcome(&found), outcome(&expected));
}

#[test]
fn onnx_files_exported_from_torch_find_what_torch_finds() {
    let (Some(bin), Some(program)) = (with_torch(), realo_onnx()) else {
        return;
    };
    let files = folder("onnx_files").to_string_lossy().into_owned();
    let has_exporter = python::with(&bin, "python3", &["-c".into(), "import onnx, onnxscript".into()]);
    if !has_exporter.status.success() {
        return skipped::skip("`python3 -m pip install onnx onnxscript`, by which PyTorch exports");
    }
    run_script(&bin, &[&script("torch_export.py"), WEIGHTS, &files]);
    let graph = example("onnx/onnx_attfuse.yml");
    let stage = |stage: &str, role: &str, more: &str| {
        let program = program.display();
        format!("{stage}=program {program} role={role} model={files}/{role}.onnx {more}")
    };
    let replaced = [
        stage("ego.encoder", "encoder", "send=own"),
        stage("others.encoder", "encoder", "send=features"),
        stage("fusion.fusion", "fusion", ""),
        stage("fusion.head", "head", ""),
    ];
    let more: Vec<&str> = replaced.iter().flat_map(|one| ["--replace", one]).collect();
    let found = proposals(&bin, "onnx_graph", &graph, &more);
    let expected = proposals(&bin, "onnx_torch", &script("torch_attfuse.yml"), &[]);
    assert_near(&compared(&bin, &found, &expected));
}
