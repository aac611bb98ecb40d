//! Checkpoints that PyTorch itself wrote, in the forms that training scripts give them (`write.py`).

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use realo_checkpoint::{Checkpoint, Converted, convert, list, write};
use realo_methods::Kernels;
use realo_methods::Model;
use realo_nn::weights::{Weights, expected};

fn portable() -> Kernels<'static> {
    Kernels {
        isa: "portable",
        ..Kernels::auto(1)
    }
}

fn data(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data").join(name)
}

fn model(name: &str) -> Model {
    Model::read(&data(&format!("{name}.toml"))).unwrap()
}

fn converted(name: &str, model: Model) -> Result<Converted, String> {
    let mut checkpoint = Checkpoint::open(&data(&format!("{name}.pth"))).map_err(|error| error.to_string())?;
    convert(&mut checkpoint, model).map_err(|error| error.to_string())
}

fn attfuse(name: &str) -> Weights {
    converted(name, model("small-attfuse"))
        .unwrap_or_else(|error| panic!("{error}"))
        .weights
}

fn refusal(name: &str, model: Model) -> String {
    converted(name, model).err().expect("refused")
}

/// The largest difference of a number from the plain checkpoint's.
fn difference(weights: &Weights) -> f32 {
    let plain = attfuse("plain");
    let keys = expected(&model("small-attfuse")).into_iter();
    let pairs = keys.flat_map(|(key, _)| {
        let both = plain.tensor(&key).iter().zip(weights.tensor(&key));
        both.map(|(a, b)| (a - b).abs()).collect::<Vec<f32>>()
    });
    pairs.fold(0.0, f32::max)
}

#[test]
fn numbers_are_those_that_another_reader_finds() {
    let theirs = candle_core::pickle::read_all(data("plain.pth")).unwrap();
    let theirs: HashMap<String, candle_core::Tensor> = theirs.into_iter().collect();
    let ours = attfuse("plain");
    for (key, shape) in expected(&model("small-attfuse")) {
        let tensor = &theirs[&key];
        assert_eq!(tensor.dims(), shape, "{key}");
        let numbers: Vec<f32> = tensor.flatten_all().unwrap().to_vec1().unwrap();
        assert_eq!(ours.tensor(&key), numbers, "{key}");
    }
    assert_eq!(theirs.len(), 26 + 4, "and the counters of batches");
}

#[test]
fn every_form_of_a_state_dict_gives_the_same_weights() {
    for name in [
        "parallel",
        "parameters",
        "nested",
        "legacy",
        "views",
        "big_endian",
        "double",
    ] {
        assert_eq!(difference(&attfuse(name)), 0.0, "{name}");
    }
    // 11 and 8 bits of numbers below 2.
    for (name, most) in [("half", 0.0005), ("bfloat16", 0.004)] {
        let found = difference(&attfuse(name));
        assert!(0.0 < found && found <= most, "{name}: {found}");
    }
}

#[test]
fn what_stands_beside_the_state_dict_is_reported() {
    let cases = [
        ("plain", None, None, 4),
        ("nested", Some("model_state_dict"), Some(30), 4),
        ("legacy", Some("state_dict"), Some(31), 0),
    ];
    for (name, within, epoch, counters) in cases {
        let checkpoint = Checkpoint::open(&data(&format!("{name}.pth"))).unwrap();
        assert_eq!((checkpoint.within(), checkpoint.epoch()), (within, epoch), "{name}");
        assert_eq!(checkpoint.tensors().count(), 26 + counters, "{name}");
    }
    let converted = converted("nested", model("small-attfuse")).ok().unwrap();
    assert_eq!(converted.origin, "nested.pth (epoch 30)");
}

#[test]
fn what_is_no_state_dict_or_not_the_models_is_refused_by_name() {
    let cases: [(&str, &[&str]); 8] = [
        ("command", &["`posix.system`", "nothing of it was run"]),
        (
            "whole_model",
            &["`torch.nn.modules.linear.Linear`", "model.state_dict()"],
        ),
        ("protocol4", &["protocol is not 2"]),
        ("empty", &["no tensor"]),
        ("repeated", &["[8]", "[0]", "more than once"]),
        (
            "nan",
            &[
                "`cls_head.bias`",
                "8 of 8 numbers are not finite",
                "names and shapes fit",
            ],
        ),
        ("whole", &["differences: 1", "`cls_head.weight`", "found int32"]),
        (
            "v2xvit",
            &[
                "`cls_head.bias` is not part",
                "--model FILE.toml",
                "realo checkpoint show",
            ],
        ),
    ];
    for (name, named) in cases {
        let said = refusal(name, model("small-attfuse"));
        assert!(said.contains(&format!("{name}.pth: ")), "{name}: {said}");
        for part in named
            .iter()
            .filter(|part| !(name == "v2xvit" && part.contains("cls_head")))
        {
            assert!(said.contains(part), "{name}: {said}");
        }
    }
    assert!(!Path::new("ran").exists(), "a checkpoint ran a command");
}

#[test]
fn every_difference_is_listed_up_to_forty() {
    let mut wide = model("small-attfuse");
    wide.shrink[0].channels = 12;
    let said = refusal("plain", wide);
    for part in [
        "not the weights of model `small-attfuse`; differences: 4",
        "`shrink_conv.layers.0.double_conv.0.weight`: expected shape [12, 8, 1, 1], found [8, 8, 1, 1]",
        "`reg_head.weight`: expected shape [28, 12, 1, 1], found [28, 8, 1, 1]",
    ] {
        assert!(said.contains(part), "{said}");
    }
    let said = refusal("v2xvit", model("small-attfuse"));
    assert!(
        said.contains("differences: 63") && said.contains("… and 23 more"),
        "{said}"
    );
}

#[test]
fn a_model_runs_from_what_was_written_and_nothing_is_replaced_unasked() {
    let dir = tempfile::tempdir().unwrap();
    let output = dir.path().join("mine.safetensors");
    let first = converted("nested", model("small-attfuse")).ok().unwrap();
    let written = write(&first, &output, None, false).unwrap();
    assert_eq!(
        (written.model, written.tensors),
        (dir.path().join("mine.toml"), [26, 836])
    );
    let loaded = realo_methods::load(&dir.path().join("mine.toml"), portable()).unwrap();
    assert_eq!(loaded.model.name, "mine");
    assert_eq!(difference(&loaded.weights), 0.0);
    let text = std::fs::read_to_string(dir.path().join("mine.toml")).unwrap();
    assert!(text.starts_with("# Weights of nested.pth (epoch 30).\n"), "{text}");
    let listed = list(&output).unwrap();
    assert_eq!(listed.rows.len(), 26);
    assert!(listed.to_string().contains("those of model `mine`"), "{listed}");

    let second = converted("half", model("small-attfuse")).ok().unwrap();
    let before = std::fs::read(&output).unwrap();
    let error = write(&second, &output, None, false).unwrap_err().to_string();
    assert!(
        error.contains("mine.safetensors: is there already") && error.contains("--force"),
        "{error}"
    );
    assert_eq!(std::fs::read(&output).unwrap(), before);
    std::fs::remove_file(&output).unwrap();
    let error = write(&second, &output, None, false).unwrap_err().to_string();
    assert!(error.contains("mine.toml: is there already"), "{error}");
    assert!(!output.exists());
    write(&second, &output, None, true).unwrap();
    assert!(std::fs::read(&output).unwrap() != before);

    for (name, expected) in [("Mine.safetensors", "lower-case letters"), ("mine.pth", ".safetensors")] {
        let error = write(&second, &dir.path().join(name), None, false)
            .unwrap_err()
            .to_string();
        assert!(error.contains(name) && error.contains(expected), "{error}");
    }
    let left = std::fs::read_dir(dir.path()).unwrap().count();
    assert_eq!(left, 2, "nothing else is left in the folder");
}

#[test]
fn a_model_file_that_asks_for_the_weights_stays_as_it_is() {
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("small-attfuse.toml");
    std::fs::copy(data("small-attfuse.toml"), &file).unwrap();
    let converted = converted("plain", Model::read(&file).unwrap()).ok().unwrap();
    let output = dir.path().join("small-attfuse.safetensors");
    let written = write(&converted, &output, Some(&file), false).unwrap();
    assert!(written.model_was_there && written.model == file);
    assert_eq!(
        std::fs::read(&file).unwrap(),
        std::fs::read(data("small-attfuse.toml")).unwrap()
    );
    realo_methods::load(&file, portable()).unwrap();
}

#[test]
fn a_transformer_with_its_compressor_is_converted() {
    let converted = converted("v2xvit", model("small-v2xvit")).unwrap_or_else(|error| panic!("{error}"));
    assert_eq!(expected(&converted.model).len(), 89);
    let table = converted.weights.tensor("fusion_net.encoder.rte.emb.emb.weight");
    assert_eq!(table.len(), 800);
}
