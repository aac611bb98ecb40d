//! Checkpoints that PyTorch wrote, from `realo-lab checkpoint convert` to boxes.

mod common;

use std::path::{Path, PathBuf};

use common::machine::decided;
use common::{folder, graph, json, lab, lab_said, realo, realo_ok, root, run_virtual, simulated, text};
use serde_json::Value;

fn data(name: &str) -> String {
    let path = root().join("tools/checkpoint/tests/data").join(name);
    path.to_string_lossy().into_owned()
}

/// Two vehicles, a second.
fn log() -> PathBuf {
    simulated(
        "checkpoints",
        &[
            "--seed",
            "911",
            "--seconds",
            "1",
            "--agents",
            "cav1,cav2",
            "--key-hz",
            "10",
        ],
    )
}

/// Converts a fixture of PyTorch's and returns its model file, and what was said.
fn converted(dir: &Path, checkpoint: &str, model: &str) -> (String, String) {
    let output = dir.join(format!("{checkpoint}.safetensors"));
    let said = lab_said([
        "checkpoint",
        "convert",
        &data(&format!("{checkpoint}.pth")),
        "--model",
        &data(&format!("{model}.toml")),
        "-o",
        &output.to_string_lossy(),
    ]);
    let model = output.with_extension("toml");
    assert!(model.exists(), "{said}");
    (model.to_string_lossy().into_owned(), said)
}

fn used(result: &Value) -> u64 {
    let features = &result["links"]["cav2-cav1"]["features"];
    features["used"].as_u64().unwrap_or_else(|| panic!("{features}"))
}

fn boxes(run: &str) -> usize {
    let recording = Path::new(env!("CARGO_TARGET_TMPDIR"))
        .join(run)
        .join("checkpoints/cav1/recording.mcap");
    let messages = realo_recorder::read_boxes(recording).expect("the recording can be read");
    let boxes = messages
        .into_iter()
        .map(|message| message.into_parts::<realo_schemas::Boxes>().expect("boxes").1.0);
    boxes.map(|boxes| boxes.len()).sum()
}

#[test]
fn a_checkpoint_runs_in_the_graph_of_its_network() {
    let dir = folder("checkpoints_converted");
    for (checkpoint, model, name) in [
        ("nested", "small-attfuse", "attfuse"),
        ("v2xvit", "small-v2xvit", "v2xvit"),
    ] {
        let (file, said) = converted(&dir, checkpoint, model);
        let command = format!("realo run dataflows/{name}.yml --offline --project sender --model {file}");
        assert!(said.contains(&command), "{said}");
        let out = format!("checkpoints_{name}");
        let args = ["--offline", "--ego", "cav1", "--project", "sender", "--model", &file];
        let result = run_virtual(&out, name, &log(), &args);
        assert!(used(&result) >= 8, "{}", result["links"]);
        assert!(boxes(&out) > 20, "{name} finds {}", boxes(&out));
        assert!(
            result["model"]
                .as_str()
                .is_some_and(|model| model.starts_with(&format!("{checkpoint}-"))),
            "{}",
            result["model"]
        );
    }
}

#[test]
fn v2xvit_runs_on_dora() {
    decided(v2xvit_on_dora);
}

fn v2xvit_on_dora() {
    let (file, _) = converted(&folder("checkpoints_realtime_model"), "v2xvit", "small-v2xvit");
    let out = folder("checkpoints_realtime");
    realo_ok([
        "run",
        &graph("v2xvit"),
        "--log",
        &log().to_string_lossy(),
        "--ego",
        "cav1",
        "--rate",
        "0.2",
        "--model",
        &file,
        "--out",
        &out.to_string_lossy(),
    ]);
    let result = json(&out.join("result.json"));
    assert_eq!(result["complete"], true);
    assert!(used(&result) >= 5, "{}", result["links"]);
}

#[test]
fn a_graph_without_weights_is_refused_before_it_starts() {
    let (out, log) = (folder("checkpoints_bare").join("out"), log());
    let (out_text, log) = (out.to_string_lossy(), log.to_string_lossy());
    let model = root().join("models/full-v2xvit.toml");
    let model = model.to_string_lossy();
    let run = ["run", &graph("v2xvit"), "--offline", "--model", &model];
    let output = realo(run.into_iter().chain(["--log", &log, "--out", &out_text]));
    let said = text(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{said}");
    for part in [
        "full-v2xvit.toml: this model has no weights",
        "full-v2xvit.safetensors is not there",
        "realo-lab checkpoint convert",
        "--model FILE",
    ] {
        assert!(said.contains(part), "{part}: {said}");
    }
    assert!(!out.exists(), "nothing is left of a run that did not start");
}

#[test]
fn a_checkpoint_of_another_network_is_refused_and_leaves_nothing() {
    let dir = folder("checkpoints_refused");
    let output = dir.join("m.safetensors");
    let output_text = output.to_string_lossy();
    let plain = data("plain.pth");
    let (bad, missing) = (data("command.pth"), data("nowhere.pth"));
    let cases: [(&[&str], &[&str]); 5] = [
        (
            &[&plain, "--arch", "attfuse"],
            &["not the weights of model `full-attfuse`", "--model FILE.toml"],
        ),
        (&[&bad, "--arch", "attfuse"], &["`posix.system`"]),
        (&[&missing, "--arch", "attfuse"], &["nowhere.pth"]),
        (&[&plain, "--arch", "second"], &["second", "attfuse"]),
        (&[&plain], &["--arch"]),
    ];
    for (args, named) in cases {
        let all = [&["checkpoint", "convert", "-o", &output_text], args].concat();
        let output = lab(all);
        let said = text(&output.stderr);
        assert!(
            !output.status.success() && named.iter().all(|part| said.contains(part)),
            "{args:?}: {said}"
        );
    }
    assert_eq!(std::fs::read_dir(&dir).expect("the folder").count(), 0);
    assert!(!root().join("ran").exists());
}

#[test]
fn tensors_are_listed_with_shape_type_and_epoch() {
    let said = lab_said(["checkpoint", "show", &data("nested.pth")]);
    for part in [
        "cls_head.weight                                   [8, 8, 1, 1]   float32",
        "num_batches_tracked",
        "26 tensors with 836 numbers; 4 more count batches of the training and are not used, under `model_state_dict`, epoch 30",
    ] {
        assert!(said.contains(part), "{part}: {said}");
    }
    let said = lab_said([
        "checkpoint",
        "show",
        &root().join("models/lite.safetensors").to_string_lossy(),
    ]);
    assert!(said.contains("names and shapes are those of model `lite`"), "{said}");
}

#[test]
fn a_model_file_beside_that_is_not_of_the_tensors_is_named() {
    let dir = folder("checkpoint_beside");
    let file = dir.join("nested.pth");
    std::fs::copy(data("nested.pth"), &file).expect("the checkpoint can be copied");
    let beside = file.with_extension("toml");
    let show = || lab_said(["checkpoint", "show", &file.to_string_lossy()]);
    let without = show();
    assert!(!without.contains("the model file beside it"), "{without}");
    std::fs::write(&beside, "name = 7").expect("it can be written");
    let said = show();
    assert!(
        said.contains("the model file beside it cannot be read: ") && said.contains("nested.toml"),
        "{said}"
    );
    std::fs::copy(root().join("models/lite.toml"), &beside).expect("it can be copied");
    let said = show();
    assert!(
        said.contains("nested.toml, is for other tensors: those of `lite`"),
        "{said}"
    );
}
