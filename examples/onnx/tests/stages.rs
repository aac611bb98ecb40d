//! Stages over small files: what they compute, beside the same computed here, and what they refuse.

mod common;

use std::path::{Path, PathBuf};

use common::{File, Kind};
use realo_engine::testkit::FusionCase;
use realo_onnx::{Detector, Encoder, Fusion, Head};
use realo_operator::{Built, Outputs, PortId, Registration};
use realo_schemas::{Boxes, DType, FeatureMap, Header, Kind as Of, Message, PointCloud, Pose};

/// Rows and columns of the maps of these files.
const SIZE: [usize; 2] = [4, 6];

fn folder() -> tempfile::TempDir {
    tempfile::tempdir().expect("a folder can be made")
}

fn args(model: &Path, more: &[&str]) -> Vec<String> {
    let first = format!("model={}", model.display());
    std::iter::once(first)
        .chain(more.iter().map(|arg| arg.to_string()))
        .collect()
}

fn built<O: realo_operator::Operator + Send + 'static>(args: &[String]) -> Result<Built, String> {
    (Registration::operator::<O>().build)(args).map_err(|error| error.to_string())
}

/// What a stage sends for a message, or why it does not, and its counters.
fn asked(stage: &mut Built, message: Message) -> Result<(Vec<Message>, Outputs), String> {
    let Built::Operator(stage) = stage else {
        panic!("it is an operator");
    };
    let mut out = Outputs::at(0);
    stage
        .on_input(PortId(0), message, &mut out)
        .map_err(|error| error.to_string())?;
    let sent = out.take_sent().into_iter().map(|(_, message)| message).collect();
    Ok((sent, out))
}

fn header(agent: &str, kind: Of) -> Header {
    let mut header = Header::origin(&"run".into(), &agent.into(), kind, 0, 50, 80);
    header.pose = Pose::from_parts([0.0; 3], [0.0, 0.0, 0.0, 1.0]);
    header
}

fn sweep(points: &[[f32; 3]]) -> Message {
    let axis = |axis: usize| points.iter().map(|point| point[axis]).collect::<Vec<f32>>();
    let n = points.len();
    let cloud = PointCloud::new(axis(0), axis(1), axis(2), vec![51; n], vec![0; n], vec![0; n]);
    Message::new(header("cav1", Of::Points), cloud.expect("columns of one length"))
}

fn map(channels: usize, number: impl Fn(usize) -> f32) -> FeatureMap {
    let [rows, columns] = SIZE;
    let one = FeatureMap {
        rows: rows as u32,
        columns: columns as u32,
        channels: channels as u32,
        cell: 1.0,
        origin: [-3.0, -2.0],
        dtype: DType::F32,
        data: Vec::<u8>::new().into(),
        model: "onnx-1".into(),
        confidence: None,
    };
    one.with_numbers((0..rows * columns * channels).map(number).collect())
}

/// Every cell has the mean of all points.
fn of_points(folder: &Path) -> PathBuf {
    let file = File::default().input("points", Kind::Float, &["n", "4"]);
    let file = file.whole("shape", &[1, 4, 1, 1]).whole("size", &[1, 4, 4, 6]);
    let file = file.node("ReduceMean", &["points"], "mean", &[("axes", &[0])]);
    let file = file.node("Reshape", &["mean", "shape"], "one", &[]);
    let file = file.node("Expand", &["one", "size"], "features", &[]);
    file.output("features", Kind::Float, &["1", "4", "4", "6"])
        .write(folder, "points.onnx")
}

const GRID: [&str; 2] = ["range=-3,-2,-1,3,2,1", "cell=1"];

#[test]
fn an_encoder_of_points_gets_those_in_its_grid() {
    let folder = folder();
    let file = of_points(folder.path());
    let mut stage = built::<Encoder>(&args(&file, &[GRID[0], GRID[1], "role=encoder", "intensity=true"])).unwrap();
    let points = [[1.0, 1.5, 0.5], [-2.0, 0.5, 0.0], [9.0, 0.0, 0.0], [f32::NAN, 0.0, 0.0]];
    let (sent, out) = asked(&mut stage, sweep(&points)).unwrap();
    assert_eq!(out.counted("out_of_range_points"), 2);
    let expected = map(4, |at| [-0.5, 1.0, 0.25, 0.2][at % 4]);
    assert_eq!(sent.len(), 2, "`own` and `features`");
    for message in sent {
        let (header, found): (Header, FeatureMap) = message.into_parts().unwrap();
        assert_eq!((header.kind, header.stamp), (Of::Features, 50));
        assert!(found.model.starts_with("onnx-"));
        assert_eq!(
            (found.origin, found.cell, found.size()),
            (expected.origin, 1.0, [4, 6, 4])
        );
        assert_eq!(found.numbers().unwrap(), expected.numbers().unwrap());
    }
    let lowered = args(&file, &[GRID[0], GRID[1], "lidar_height=0.5", "send=own"]);
    let (sent, _) = asked(&mut built::<Encoder>(&lowered).unwrap(), sweep(&points[..2])).unwrap();
    let found: FeatureMap = sent[0].clone().into_parts().unwrap().1;
    assert_eq!(
        (sent.len(), &found.numbers().unwrap()[..4]),
        (1, &[-0.5, 1.0, -0.25, 0.0][..])
    );
}

/// In the cell of each pillar: the sum of its points, and in the last channel their number.
fn of_pillars(folder: &Path) -> PathBuf {
    let file = File::default().input("voxels", Kind::Float, &["pillars", "3", "4"]);
    let file = file.input("voxel_coords", Kind::Int64, &["pillars", "4"]);
    let file = file.input("voxel_num_points", Kind::Int32, &["pillars"]);
    let file = file
        .whole("canvas", &[4, 6, 5])
        .whole("two", &[2])
        .whole("four", &[4])
        .whole("last", &[-1]);
    let file = file
        .whole("column", &[-1, 1])
        .whole("first", &[0])
        .whole("batched", &[1, 5, 4, 6]);
    let file = file.node("ConstantOfShape", &["canvas"], "zeros", &[]);
    let file = file
        .node("ReduceSum", &["voxels", "axis1"], "sums", &[("keepdims", &[0])])
        .whole("axis1", &[1]);
    let file = file.node("Cast", &["voxel_num_points"], "floats", &[("to", &[1])]);
    let file = file.node("Reshape", &["floats", "column"], "counts", &[]);
    let file = file.node("Concat", &["sums", "counts"], "numbers", &[("axis", &[1])]);
    let file = file
        .node("Slice", &["voxel_coords", "two", "four", "last_axis"], "places", &[])
        .whole("last_axis", &[1]);
    let file = file.node("ScatterND", &["zeros", "places", "numbers"], "filled", &[]);
    let file = file.node("Transpose", &["filled"], "planes", &[("perm", &[2, 0, 1])]);
    let file = file.node("Reshape", &["planes", "batched"], "features", &[]);
    file.output("features", Kind::Float, &["1", "5", "4", "6"])
        .write(folder, "pillars.onnx")
}

#[test]
fn an_encoder_of_pillars_gets_points_coordinates_and_counts() {
    let folder = folder();
    let file = of_pillars(folder.path());
    let mut stage = built::<Encoder>(&args(&file, &[GRID[0], GRID[1], "max_points=3", "send=own"])).unwrap();
    let near = [-0.5, 1.5, 0.5];
    let (sent, out) = asked(&mut stage, sweep(&[near, [2.5, -1.5, 0.25], near, near, near])).unwrap();
    assert_eq!(out.counted("over_points"), 1);
    let found: FeatureMap = sent[0].clone().into_parts().unwrap().1;
    let expected = map(5, |at| match at / 5 {
        5 => [2.5, -1.5, 0.25, 0.0, 1.0][at % 5],
        20 => [-1.5, 4.5, 1.5, 0.0, 3.0][at % 5],
        _ => 0.0,
    });
    assert_eq!(found.numbers().unwrap(), expected.numbers().unwrap());

    // A sweep without a point is one all the same.
    let (sent, out) = asked(&mut stage, sweep(&[])).unwrap();
    let found: FeatureMap = sent[0].clone().into_parts().unwrap().1;
    assert!(found.numbers().unwrap().iter().all(|number| *number == 0.0));
    assert_eq!(out.counted("empty_sweeps"), 1);
}

/// The sum over agents where they are.
fn of_maps(folder: &Path, agents: &str, with_mask: bool) -> PathBuf {
    let file = File::default().input("maps", Kind::Float, &[agents, "2", "4", "6"]);
    let file = match with_mask {
        true => file
            .input("mask", Kind::Bool, &[agents, "4", "6"])
            .node("Cast", &["mask"], "shares", &[("to", &[1])])
            .node("Unsqueeze", &["shares", "one"], "wide", &[])
            .node("Mul", &["maps", "wide"], "there", &[]),
        false => file.node("Identity", &["maps"], "there", &[]),
    };
    let file = file.whole("one", &[1]).whole("zero", &[0]);
    let file = file.node("ReduceSum", &["there", "zero"], "features", &[("keepdims", &[1])]);
    file.output("features", Kind::Float, &["1", "2", "4", "6"])
        .write(folder, "fusion.onnx")
}

fn message(agent: &str, ahead: f64, number: impl Fn(usize) -> f32) -> Message {
    let mut header = header(agent, Of::Features);
    header.pose = Pose::from_parts([ahead, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]);
    Message::new(header, map(2, number))
}

#[test]
fn a_fusion_holds_what_every_fusion_owes_its_graph() {
    for agents in ["agents", "3"] {
        let folder = folder();
        let file = of_maps(folder.path(), agents, true);
        let ego = message("cav1", 0.0, |at| at as f32);
        let case = FusionCase {
            args: args(&file, &[]),
            alone: ego.payload.clone(),
            entries: vec![
                message("cav2", 1.0, |_| 0.25),
                message("rsu1", -0.5, |at| at as f32 / 8.0),
            ],
            ego,
        };
        case.check::<Fusion>();
    }
}

#[test]
fn a_fusion_gets_maps_in_the_egos_cells_and_where_they_are_there() {
    let folder = folder();
    let file = of_maps(folder.path(), "agents", true);
    let Built::Operator(mut stage) = built::<Fusion>(&args(&file, &[])).unwrap() else {
        panic!("it is an operator");
    };
    let ego = message("cav1", 0.0, |_| 1.0);
    let selection = realo_schemas::Selection {
        query: 0,
        entries: vec![message("cav2", 2.0, |at| at as f32)],
    };
    let selection = Message::new(ego.header.clone(), selection);
    let mut out = Outputs::at(0);
    stage.on_input(PortId(0), ego, &mut out).unwrap();
    stage.on_input(PortId(1), selection, &mut out).unwrap();
    let found: FeatureMap = out.take_sent().remove(0).1.into_parts().unwrap().1;
    // Two metres ahead: its first column is the ego's third.
    let expected = map(2, |at| match at / 2 % 6 {
        column if column >= 2 => 1.0 + (at - 4) as f32,
        _ => 1.0,
    });
    assert_eq!(found.numbers().unwrap(), expected.numbers().unwrap());
}

/// Each cell's eight channels are a box and its score, before the sigmoid.
fn of_features(folder: &Path, channels: &str, classes: &str) -> PathBuf {
    let file = File::default().input("features", Kind::Float, &["1", channels, "rows", "columns"]);
    let file = file
        .whole("rows8", &[-1, 8])
        .whole("zero", &[0])
        .whole("seven", &[7])
        .whole("eight", &[8])
        .whole("axis", &[1]);
    let file = file.node("Transpose", &["features"], "cells", &[("perm", &[0, 2, 3, 1])]);
    let file = file.node("Reshape", &["cells", "rows8"], "rows", &[]);
    let file = file.node("Slice", &["rows", "zero", "seven", "axis"], "boxes", &[]);
    let file = file.node("Slice", &["rows", "seven", "eight", "axis"], "logits", &[]);
    let file = file.node("Sigmoid", &["logits"], "scores", &[]);
    let file = file.output("boxes", Kind::Float, &["n", "7"]);
    file.output("scores", Kind::Float, &["n", classes])
        .write(folder, "head.onnx")
}

#[test]
fn a_head_gives_boxes_best_first() {
    let folder = folder();
    let file = of_features(folder.path(), "8", "1");
    let one = [1.0, 2.0, 0.5, 4.0, 2.0, 1.5, 7.0, 1.0];
    let two = [-1.0, 0.0, 0.5, 4.5, 1.9, 1.6, 0.5, 2.0];
    let features = |row: usize, at: usize| match row {
        3 => one[at],
        7 => two[at],
        // No object is without a length.
        9 => [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 3.0][at],
        _ => -9.0,
    };
    let message = Message::new(header("cav1", Of::Features), map(8, |at| features(at / 8, at % 8)));
    let mut stage = built::<Head>(&args(&file, &["classes=Car", "score_threshold=0.2"])).unwrap();
    let (sent, out) = asked(&mut stage, message.clone()).unwrap();
    let Boxes(found) = sent[0].clone().into_parts().unwrap().1;
    assert_eq!((found.len(), out.counted("invalid_boxes")), (2, 1));
    assert_eq!(
        (found[0].center, found[0].length, &*found[0].class),
        ([-1.0, 0.0, 0.5], 4.5, "Car")
    );
    assert!((found[0].score - 0.880_797).abs() < 1e-5 && (found[1].yaw - (7.0 - std::f64::consts::TAU)).abs() < 1e-6);

    let other = args(
        &file,
        &["classes=Car", "score_threshold=0.2", "order=hwl", "lidar_height=1.5"],
    );
    let (sent, _) = asked(&mut built::<Head>(&other).unwrap(), message).unwrap();
    let Boxes(found) = sent[0].clone().into_parts().unwrap().1;
    let of = |object: &realo_schemas::Box3| [object.center[2], object.length, object.width, object.height];
    assert_eq!(of(&found[1]), [2.0, 1.5, 2.0, 4.0]);
}

/// Why a stage is not made of a file.
fn refused<O: realo_operator::Operator + Send + 'static>(model: &Path, more: &[&str]) -> String {
    built::<O>(&args(model, more)).map(drop).expect_err("it is refused")
}

fn assert_all(cases: &[(String, &[&str])]) {
    for (error, expected) in cases {
        assert!(
            expected.iter().all(|words| error.contains(words)),
            "{error}\nexpected {expected:?}"
        );
    }
}

#[test]
fn a_file_that_was_loaded_for_its_sizes_is_not_loaded_again() {
    let folder = folder();
    let file = of_features(folder.path(), "8", "1");
    let args = args(&file, &["classes=Car"]);
    let sizes = (Registration::operator::<Head>().maps)(&args);
    assert_eq!(sizes[0].0, "features");
    std::fs::remove_file(&file).unwrap();
    built::<Head>(&args).unwrap();
    let error = built::<Head>(&args).map(drop).unwrap_err();
    assert!(error.contains("cannot be read"), "{error}");
}

#[test]
fn what_is_not_a_file_of_onnx_is_refused() {
    let folder = folder();
    let at = |name: &str| folder.path().join(name);
    let head = |name: &str, bytes: &[u8]| {
        std::fs::write(at(name), bytes).unwrap();
        refused::<Head>(&at(name), &[])
    };
    assert_all(&[
        (
            refused::<Head>(&at("none.onnx"), &[]),
            &["none.onnx", "cannot be read", "relative to the graph's folder"],
        ),
        (refused::<Head>(folder.path(), &[]), &["found a folder"]),
        (
            head("p.onnx", b"version https://git-lfs.github.com/spec/v1\n"),
            &["git lfs pull"],
        ),
        (
            head("empty.onnx", b""),
            &["found an empty file; export the network anew"],
        ),
        (head("t.onnx", b"PK\x03\x04torch"), &["torch.onnx.export"]),
        (
            {
                let file = File::default().input("features", Kind::Float, &["1", "8", "r", "c"]);
                let file = file.node("GridSampleOfMine", &["features"], "boxes", &[]);
                let path = file
                    .output("boxes", Kind::Float, &["n", "7"])
                    .write(folder.path(), "unknown.onnx");
                refused::<Head>(&path, &[])
            },
            &[
                "unknown.onnx: expected operators of ONNX that the runtime rten computes, found node `boxes`: GridSampleOfMine operator",
                "export with another `opset_version`",
            ],
        ),
        (
            head("n.onnx", b"\xff\xff\xff\xff nothing"),
            &["n.onnx", "cannot be read as ONNX"],
        ),
        (head("net.txt", b"text"), &["ends in .onnx"]),
    ]);
}

#[test]
fn outputs_and_names_are_checked_when_a_file_is_loaded() {
    let folder = folder();
    let file = of_features(folder.path(), "8", "1");
    let head = |more: &[&str]| refused::<Head>(&file, more);
    assert_all(&[
        (
            head(&[]),
            &[
                "outputs: expected `scores` [boxes, classes]",
                "3 numbers a box",
                "found 1",
            ],
        ),
        (
            head(&["classes=Car", "names=features:x"]),
            &[
                "inputs: expected `features`",
                "under the name `x`",
                "the file has `features`",
            ],
        ),
        (
            head(&["classes=Car", "names=feature:x"]),
            &["expected one of features, boxes, scores", "`feature`"],
        ),
        (
            head(&["classes=Car", "names=features"]),
            &["expected `ours:theirs`, found `features`"],
        ),
    ]);
}

#[test]
fn inputs_and_sizes_are_checked_when_a_file_is_loaded() {
    let folder = folder();
    let head = of_features(folder.path(), "8", "1");
    let fixed = File::default().input("points", Kind::Float, &["100", "4"]);
    let fixed = fixed.whole("shape", &[1, 1, 100, 4]);
    let fixed = fixed.node("Reshape", &["points", "shape"], "features", &[]);
    let fixed = fixed
        .output("features", Kind::Float, &["1", "1", "100", "4"])
        .write(folder.path(), "fixed.onnx");
    let pillars = of_pillars(folder.path());
    assert_all(&[
        (
            refused::<Encoder>(&head, &[]),
            &["inputs: expected no other than `points`", "found `features`"],
        ),
        (
            refused::<Encoder>(&fixed, &[]),
            &["for any number of points", "for 100", "dynamic dimension"],
        ),
        (
            refused::<Encoder>(&pillars, &[]),
            &["expected `max_points=3`", "found 32"],
        ),
        (
            refused::<Encoder>(&pillars, &["range=3,0,0,-3,1,1"]),
            &["setting `range`"],
        ),
        (
            refused::<Fusion>(&of_maps(folder.path(), "3", false), &[]),
            &["`mask`", "for exactly 3"],
        ),
        (
            refused::<Detector>(&pillars, &[]),
            &["outputs: expected `boxes` [boxes, 7]", "the file has `features`"],
        ),
    ]);
}

#[test]
fn types_and_dimensions_are_checked_when_a_file_is_loaded() {
    let folder = folder();
    let wrong = File::default().input("features", Kind::Int64, &["1", "8", "4", "6"]);
    let wrong = wrong
        .node("Identity", &["features"], "boxes", &[])
        .output("boxes", Kind::Int64, &["n", "7"]);
    let flat = File::default().input("features", Kind::Float, &["8", "6"]);
    let flat = flat
        .node("Identity", &["features"], "boxes", &[])
        .output("boxes", Kind::Float, &["8", "6"]);
    assert_all(&[
        (
            refused::<Head>(&wrong.write(folder.path(), "wrong.onnx"), &[]),
            &["`features`", "another type", "of int32 or int64"],
        ),
        (
            refused::<Head>(&flat.write(folder.path(), "flat.onnx"), &[]),
            &["found it as [8, 6]"],
        ),
    ]);
}

#[test]
fn maps_name_the_weights_that_are_beside_their_file() {
    let folder = folder();
    let file = File::default().input("points", Kind::Float, &["n", "4"]);
    let file = file.whole("shape", &[1, 4, 1, 1]).whole("size", &[1, 4, 4, 6]);
    let file = file.elsewhere("weights", &[4], "weights.data");
    let file = file.node("ReduceMean", &["points"], "mean", &[("axes", &[0])]);
    let file = file.node("Mul", &["mean", "weights"], "weighted", &[]);
    let file = file.node("Reshape", &["weighted", "shape"], "one", &[]);
    let file = file.node("Expand", &["one", "size"], "features", &[]);
    let file = file.output("features", Kind::Float, &["1", "4", "4", "6"]);
    let file = file.write(folder.path(), "weighted.onnx");
    let encoded = |weights: [f32; 4]| {
        std::fs::write(
            folder.path().join("weights.data"),
            weights.map(f32::to_le_bytes).concat(),
        )
        .unwrap();
        let mut stage = built::<Encoder>(&args(&file, &[GRID[0], GRID[1], "send=own"])).unwrap();
        let (sent, _) = asked(&mut stage, sweep(&[[1.0, 1.5, 0.5]])).unwrap();
        let found: FeatureMap = sent[0].clone().into_parts().unwrap().1;
        (found.model.clone(), found.numbers().unwrap()[..3].to_vec())
    };
    let (one, two) = (encoded([1.0; 4]), encoded([2.0; 4]));
    assert_eq!(
        (one.1.as_slice(), two.1.as_slice()),
        (&[1.0, 1.5, 0.5][..], &[2.0, 3.0, 1.0][..])
    );
    assert_ne!(one.0, two.0, "other weights are another model");
    assert_eq!(one, encoded([1.0; 4]));
    std::fs::remove_file(folder.path().join("weights.data")).unwrap();
    let error = refused::<Encoder>(&file, &GRID);
    assert!(
        error.contains("weighted.onnx") && error.contains("weights.data"),
        "{error}"
    );
}

#[test]
fn boxes_whose_scores_are_not_numbers_are_counted() {
    let folder = folder();
    let file = of_features(folder.path(), "8", "1");
    let features = |row: usize, at: usize| match (row, at) {
        (3 | 7, 7) => f32::NAN,
        (3 | 7 | 9, at) => [1.0, 2.0, 0.5, 4.0, 2.0, 1.5, 0.0, 1.0][at],
        _ => -9.0,
    };
    let message = Message::new(header("cav1", Of::Features), map(8, |at| features(at / 8, at % 8)));
    let mut stage = built::<Head>(&args(&file, &["classes=Car", "score_threshold=0.2"])).unwrap();
    let (sent, out) = asked(&mut stage, message).unwrap();
    let Boxes(found) = sent[0].clone().into_parts().unwrap().1;
    assert_eq!((found.len(), out.counted("invalid_boxes")), (1, 2));
}

#[test]
fn a_map_of_other_channels_is_refused_with_what_was_expected() {
    let folder = folder();
    let file = of_features(folder.path(), "8", "1");
    let mut stage = built::<Head>(&args(&file, &["classes=Car"])).unwrap();
    let message = Message::new(header("cav1", Of::Features), map(2, |_| 0.0));
    let error = asked(&mut stage, message).map(drop).unwrap_err();
    assert!(
        error.contains("head.onnx") && error.contains("cannot compute"),
        "{error}"
    );
}

#[test]
fn sizes_that_a_file_fixes_are_known_before_a_run() {
    let folder = folder();
    let head = of_features(folder.path(), "8", "1");
    let maps = (Registration::operator::<Head>().maps)(&args(&head, &["role=head", "classes=Car"]));
    let [(port, map)] = &maps[..] else { panic!("{maps:?}") };
    assert_eq!((*port, map.size), ("features", [None, None, Some(8)]));
    assert_eq!(map.by, format!("{}, input `features`", head.display()));
    let fusion = of_maps(folder.path(), "agents", false);
    let maps = (Registration::operator::<Fusion>().maps)(&args(&fusion, &["role=fusion"]));
    let sizes: Vec<_> = maps.iter().map(|(port, map)| (*port, map.size)).collect();
    let all = [Some(4), Some(6), Some(2)];
    assert_eq!(sizes, [("ego", all), ("selections", all), ("features", all)]);
    assert_eq!(maps[2].1.differs(&map.clone()), Some(("channels", 2, 8)), "{maps:?}");
    let none = (Registration::operator::<Head>().maps)(&args(Path::new("nowhere.onnx"), &["role=head"]));
    assert!(none.is_empty(), "{none:?}");
}

#[test]
fn a_detector_goes_from_points_to_boxes() {
    let folder = folder();
    let file = File::default().input("points", Kind::Float, &["n", "4"]);
    // Each point is a box around itself: its last number, the intensity, is the score.
    let file = file
        .whole("zero", &[0])
        .whole("three", &[3])
        .whole("four", &[4])
        .whole("axis", &[1]);
    let file = file.node("Slice", &["points", "zero", "three", "axis"], "centers", &[]);
    let file = file.node("Slice", &["points", "three", "four", "axis"], "scores", &[]);
    let file = file.node(
        "Concat",
        &["centers", "scores", "scores", "scores", "scores"],
        "boxes",
        &[("axis", &[1])],
    );
    let file = file
        .output("boxes", Kind::Float, &["n", "7"])
        .output("scores", Kind::Float, &["n", "1"]);
    let file = file.write(folder.path(), "detector.onnx");
    let more = [GRID[0], GRID[1], "classes=Car", "intensity=true", "role=detector"];
    let mut stage = built::<Detector>(&args(&file, &more)).unwrap();
    let (sent, _) = asked(&mut stage, sweep(&[[1.0, 1.5, 0.5], [2.0, 0.0, 0.0]])).unwrap();
    let Boxes(found) = sent[0].clone().into_parts().unwrap().1;
    assert_eq!(
        found.iter().map(|object| object.center).collect::<Vec<_>>(),
        [[1.0, 1.5, 0.5], [2.0, 0.0, 0.0]]
    );
    assert!(
        found
            .iter()
            .all(|object| (object.length - 0.2).abs() < 1e-6 && object.score == 0.2)
    );
}

#[test]
fn damaged_files_are_read_or_refused() {
    let folder = folder();
    let sound = std::fs::read(of_features(folder.path(), "8", "1")).unwrap();
    let path = folder.path().join("damaged.onnx");
    let message = Message::new(header("cav1", Of::Features), map(8, |at| at as f32 / 100.0));
    let (mut taken, mut refused) = (0, 0);
    for case in 0..damage::cases(2000) {
        let mut bytes = sound.clone();
        damage::Draw::new(case).damage(&mut bytes);
        std::fs::write(&path, bytes).unwrap();
        match built::<Head>(&args(&path, &["classes=Car", "threads=1"])) {
            Ok(mut stage) => {
                taken += 1;
                let _ = asked(&mut stage, message.clone());
            }
            Err(error) => {
                refused += 1;
                assert!(error.contains("damaged.onnx"), "case {case}: {error}");
            }
        }
    }
    assert!(taken > 20 && refused > 1000, "{taken} taken, {refused} refused");
}
