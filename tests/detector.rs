//! Graphs with a detector: a small network with made-up weights, whose boxes are known to be the same in every graph that
//! sees the same points.

mod common;

use std::collections::HashMap;
use std::fs;
use std::path::{Path, PathBuf};

use common::{folder, graph, once, realo, root, run_virtual, simulated, text};
use realo_methods::Model;
use realo_nn::weights::expected;
use realo_schemas::{Box3, Boxes};
use safetensors::Dtype;
use safetensors::tensor::TensorView;

const MODEL: &str = r#"
name = "small"
frame = "body"
precision = "f32"
rotations = [0.0, 1.57]
score_threshold = 0.35
classes = [
  { name = "vehicle", length = 3.9, width = 1.6, height = 1.56, z = 0.78, matched = 0.6, unmatched = 0.45 },
  { name = "pedestrian", length = 0.8, width = 0.6, height = 1.73, z = 0.865, matched = 0.5, unmatched = 0.35 },
]
grid = { x = [-51.2, 51.2], y = [-25.6, 25.6], z = [-3.0, 5.0], cell = 0.8 }
pillars = { channels = 8, points = 32, pillars = 20000, empty_slots = false, intensity = false }
backbone = { layers = [1], strides = [2], channels = [8], up_strides = [1], up_channels = [8] }
"#;

/// A model file with weights that an integer hash made.
fn model() -> PathBuf {
    let path = once("small.toml", |path| {
        fs::write(path, MODEL).expect("the model can be written");
        let model = Model::read(path).expect("the model is sound");
        let tensors: Vec<(String, Vec<usize>, Vec<u8>)> = expected(&model)
            .into_iter()
            .map(|(key, shape)| {
                let count = shape.iter().product::<usize>() as u64;
                let weight = |i: u64| made_up(&key, i);
                let bytes = (0..count).flat_map(|i| weight(i).to_le_bytes()).collect();
                (key, shape, bytes)
            })
            .collect();
        let views = tensors.iter().map(|(key, shape, bytes)| {
            let view = TensorView::new(Dtype::F32, shape.clone(), bytes).expect("as many bytes as the shape says");
            (key.as_str(), view)
        });
        let views: HashMap<&str, TensorView> = views.collect();
        safetensors::serialize_to_file(views, None, &model.weights_beside(path)[0])
            .expect("the weights can be written");
    });
    assert!(path.with_extension("safetensors").exists());
    path
}

fn made_up(key: &str, i: u64) -> f32 {
    let seed = key
        .bytes()
        .fold(i, |sum, byte| sum.wrapping_mul(0x100_0000_01b3) ^ u64::from(byte));
    let unit = (seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) >> 40) as f32 / (1u64 << 24) as f32;
    match key {
        key if key.ends_with("running_var") => 0.5 + unit,
        key if key.ends_with("norm.weight") => 0.5 + unit,
        "cls_head.bias" => -0.7,
        _ => (unit - 0.5) * 0.8,
    }
}

/// Two vehicles and a roadside unit, half a second.
fn log() -> PathBuf {
    simulated(
        "detector",
        &[
            "--seed",
            "908",
            "--seconds",
            "0.5",
            "--agents",
            "cav1,cav2,rsu1",
            "--key-hz",
            "10",
        ],
    )
}

/// The final boxes of each frame of a run.
fn recorded(out: &str) -> Vec<Vec<Box3>> {
    let recording = Path::new(env!("CARGO_TARGET_TMPDIR"))
        .join(out)
        .join("detector/cav1/recording.mcap");
    let messages = realo_recorder::read_boxes(recording).expect("the recording can be read");
    let boxes = messages
        .into_iter()
        .map(|message| message.into_parts::<Boxes>().expect("boxes").1.0);
    boxes.collect()
}

fn count(frames: &[Vec<Box3>]) -> usize {
    frames.iter().map(Vec::len).sum()
}

fn run(out: &str, name: &str, args: &[&str]) -> serde_json::Value {
    let model = model();
    let model = model.to_string_lossy();
    let all = [&["--model", &model, "--ego", "cav1"][..], args].concat();
    run_virtual(out, name, &log(), &all)
}

#[test]
fn early_fusion_without_collaborators_is_no_fusion() {
    run("detector_alone", "no_fusion", &["--offline"]);
    run(
        "detector_early_alone",
        "early_fusion",
        &["--offline", "--agents", "cav1"],
    );
    let (alone, early) = (recorded("detector_alone"), recorded("detector_early_alone"));
    assert_eq!(alone.len(), 5);
    assert_eq!(alone, early);
    assert!(count(&alone) > 20, "made-up weights find something: {}", count(&alone));
}

/// The same model and weights, with a fusion.
fn fusing(kind: &str) -> String {
    let base = model();
    let path = once(&format!("small-{kind}.toml"), |path| {
        let text = format!(
            "extends = \"small.toml\"\nname = \"small-{kind}\"\nweights = \"small\"\n[arch]\nkind = \"{kind}\"\nagents = 3\n"
        );
        fs::write(path, text).expect("the model can be written");
    });
    assert_eq!(base.parent(), path.parent());
    path.to_string_lossy().into_owned()
}

fn run_fusing(out: &str, name: &str, args: &[&str]) -> serde_json::Value {
    let model = fusing(name);
    let all = [&["--model", &model, "--ego", "cav1", "--offline"][..], args].concat();
    run_virtual(out, name, &log(), &all)
}

#[test]
fn fusion_of_features_without_collaborators_is_no_fusion() {
    run("detector_alone_3", "no_fusion", &["--offline"]);
    for name in ["attfuse", "fcooper"] {
        let out = format!("detector_{name}_alone");
        run_fusing(&out, name, &["--agents", "cav1"]);
        assert_eq!(recorded("detector_alone_3"), recorded(&out), "{name}");
    }
}

#[test]
fn features_of_collaborators_are_fused_and_their_bytes_counted() {
    run("detector_alone_4", "no_fusion", &["--offline"]);
    let mut all = vec![recorded("detector_alone_4")];
    for name in ["attfuse", "fcooper"] {
        for project in ["receiver", "sender"] {
            let out = format!("detector_{name}_{project}");
            let plain = ["others.sender.elements=f32", "others.sender.zstd=null"];
            let args = ["--project", project, "--set", plain[0], "--set", plain[1]];
            let result = run_fusing(&out, name, &args);
            assert_eq!(result["project"], project);
            let features = &result["links"]["cav2-cav1"]["features"];
            assert_eq!(features["used"], 5, "{name} {project}: {features}");
            // 32 rows, 64 columns, 8 channels of f32.
            let bytes = features["bytes"].as_u64().expect("bytes") / features["sent"].as_u64().expect("a count");
            assert!((65_536..66_000).contains(&bytes), "{bytes}");
            let boxes = recorded(&out);
            assert!(!all.contains(&boxes), "{name} {project} gives boxes of its own");
            all.push(boxes);
        }
    }
}

#[test]
fn merged_clouds_are_seen_and_their_bytes_counted() {
    run("detector_alone_2", "no_fusion", &["--offline"]);
    let result = run("detector_early", "early_fusion", &["--offline"]);
    assert_ne!(recorded("detector_alone_2"), recorded("detector_early"));
    let points = &result["links"]["cav2-cav1"]["points"];
    assert_eq!((&points["sent"], &points["used"]), (&5.into(), &5.into()), "{points}");
    assert!(points["bytes"].as_u64().expect("bytes") > 5_000_000, "{points}");
}

#[test]
fn the_sender_projects_with_the_newest_state_that_has_arrived() {
    let receiver = run("detector_receiver", "early_fusion", &["--offline"]);
    let sender = run("detector_sender", "early_fusion", &["--offline", "--project", "sender"]);
    let used = |result: &serde_json::Value| {
        result["links"]["cav2-cav1"]["points"]["used"]
            .as_u64()
            .expect("a count")
    };
    for (result, project) in [(&sender, "sender"), (&receiver, "receiver")] {
        assert_eq!(result["project"], project);
        let model = result["model"].as_str().expect("a text");
        assert!(model.starts_with("small-"), "{model}");
    }
    // Offline a sweep waits for the ego's state.
    assert_eq!((used(&sender), used(&receiver)), (5, 5));
    let (a, b) = (
        count(&recorded("detector_receiver")),
        count(&recorded("detector_sender")),
    );
    assert!(
        a > 0 && a.abs_diff(b) * 5 <= a,
        "{a} boxes, {b} when the sender projects"
    );

    let late = run(
        "detector_paper",
        "early_fusion",
        &["--link", "paper", "--project", "sender"],
    );
    let encoder = &late["nodes"]["others.projector"]["counters"];
    assert!(
        encoder["no_ego_state"].as_u64() > Some(0),
        "nothing is sent before the first state: {encoder}"
    );
}

/// Where all points arrive, hybrid fusion gives what early fusion gives; where none does, what late fusion gives.
#[test]
fn hybrid_fusion_takes_the_boxes_of_those_whose_points_did_not_arrive() {
    let lossy = folder("hybrid_profile").join("points_lost.toml");
    fs::write(&lossy, "about = \"no points arrive\"\n[kinds.points]\nloss = 1\n").expect("the profile can be written");
    let lossy = lossy.to_string_lossy().into_owned();
    let fates = |result: &serde_json::Value, kind: &str| {
        let books = &result["links"]["cav2-cav1"][kind];
        ["sent", "used", "superseded", "lost", "unaccounted"].map(|fate| books[fate].as_u64().unwrap_or(0))
    };
    run("hybrid_early", "early_fusion", &["--offline"]);
    let all = run("hybrid_all", "hybrid_fusion", &["--offline"]);
    assert_eq!(recorded("hybrid_all"), recorded("hybrid_early"));
    assert_eq!(
        (fates(&all, "points"), fates(&all, "boxes")),
        ([5, 5, 0, 0, 0], [5, 0, 5, 0, 0])
    );

    run("hybrid_late", "late_fusion", &["--link", &lossy]);
    let none = run("hybrid_none", "hybrid_fusion", &["--link", &lossy]);
    assert_eq!(recorded("hybrid_none"), recorded("hybrid_late"));
    assert_ne!(recorded("hybrid_none"), recorded("hybrid_all"));
    // The first sweep is measured before the link knows where the ego is.
    assert_eq!(
        (fates(&none, "points"), fates(&none, "boxes")),
        ([4, 0, 0, 4, 0], [4, 4, 0, 0, 0])
    );
}

#[test]
fn late_fusion_detects_in_both_lanes() {
    let protocol = root().join("operators/scoring/protocols/default.yml");
    assert!(protocol.is_file(), "{}", protocol.display());
    let set = format!("score.evaluator.protocol={}", protocol.display());
    let changes = ["--set", "fusion.nms.threshold=0.2", "--set", &set];
    let result = run("detector_late", "late_fusion", &[&["--offline"], &changes[..]].concat());
    let set = result["set"].as_str().expect("a text");
    let begin = "fusion.nms.threshold=0.2, score.evaluator.protocol=default.yml-";
    assert!(
        set.starts_with(begin) && !set.contains('/'),
        "a result holds no path: {set}"
    );
    assert_eq!(result["links"]["rsu1-cav1"]["boxes"]["used"], 5);
    assert_eq!(result["nodes"]["others.head"]["operator"], "detection-head");
    assert_eq!(result["nodes"]["ego.head"]["operator"], "detection-head");
}

#[test]
fn what_does_not_fit_is_refused_by_name() {
    let log = log();
    let log = log.to_string_lossy();
    let dir = folder("detector_bad");
    let bare = dir.join("bare.toml");
    fs::write(&bare, MODEL.replace("small", "bare")).expect("a file");
    let wider = dir.join("small.toml");
    fs::write(&wider, MODEL.replace("channels = [8]", "channels = [16]")).expect("a file");
    fs::copy(model().with_extension("safetensors"), dir.join("small.safetensors")).expect("a copy");
    let lidar = dir.join("lidar.toml");
    fs::write(&lidar, MODEL.replace("frame = \"body\"", "frame = \"lidar\"")).expect("a file");
    let (bare, wider, lidar) = (bare.to_string_lossy(), wider.to_string_lossy(), lidar.to_string_lossy());
    let (single, attfuse) = (model().to_string_lossy().into_owned(), fusing("attfuse"));
    let other = format!("others.encoder.model={single}");
    let cases: [(&[&str], &[&str]); 8] = [
        (&["early_fusion", "--model", "nowhere.toml"], &["nowhere.toml"]),
        (&["early_fusion", "--model", &bare], &["bare.safetensors"]),
        (
            &["early_fusion", "--model", &wider],
            &["detector_bad/small.safetensors", "backbone.blocks.0.1.weight", "16"],
        ),
        (
            &["no_fusion", "--model", &lidar],
            &["lidar.toml", "`lidar_height`", "\"body\""],
        ),
        (
            &["late_fusion", "--model", &wider, "--recorded-detections"],
            &["--model", "no node that runs a network", "drop --model"],
        ),
        (
            &["attfuse", "--model", &single],
            &["small.toml", "`arch`", "found `pointpillars`"],
        ),
        (
            &["attfuse", "--model", &attfuse, "--set", &other],
            &["`fusion.fusion`", "`others.encoder`", "small.toml", "name one in both"],
        ),
        (&["late_fusion", "--project", "sender"], &["--project", "projector"]),
    ];
    for (args, named) in cases {
        let file = graph(args[0]);
        let args = [&["run", &file, "--mode", "virtual", "--log", &log][..], &args[1..]].concat();
        let output = realo(args.clone());
        let said = text(&output.stderr);
        assert_eq!(output.status.code(), Some(1), "{args:?}: {said}");
        assert!(named.iter().all(|name| said.contains(name)), "{args:?}: {said}");
    }
}
