//! The vectors of this repository, always; all vectors of `$REALO_SHARED/conformance`, where they are at hand; the same
//! ones under other names; and some of other sizes, made here from the definitions.

mod common;

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

use common::{Made, noise, not_passed};
use realo_conformance::{CaseResult, Status, exit_code, run};
use serde_json::{Value, json};

fn own() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/data/conformance")
}

fn manifest(folder: &Path) -> Value {
    let path = folder.join("manifest.json");
    let text = fs::read(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    serde_json::from_slice(&text).unwrap()
}

fn count(results: &[CaseResult], folder: &str) -> usize {
    let of = results
        .iter()
        .filter(|result| result.file.starts_with(&format!("{folder}/")));
    of.filter(|result| result.status == Status::Passed).count()
}

/// How many vectors of a folder are checked: of the repository's, and of all.
const SUPPORTED: [(&str, [usize; 2]); 12] = [
    ("dataset", [4, 10]),
    ("boxes", [8, 8]),
    ("iou_nms", [6, 6]),
    ("evaluation", [6, 6]),
    ("pillars", [7, 7]),
    ("targets", [5, 5]),
    ("loss", [2, 2]),
    ("postprocess", [3, 3]),
    ("network", [15, 29]),
    ("noise", [1, 1]),
    ("model", [2, 8]),
    ("state_dict_keys", [2, 10]),
];

fn assert_supported(results: &[CaseResult], of: usize) {
    let failed: Vec<String> = not_passed(results)
        .into_iter()
        .filter(|line| line.contains("failed"))
        .collect();
    assert!(failed.is_empty(), "{}", failed.join("\n"));
    for (folder, expected) in SUPPORTED {
        assert_eq!(
            count(results, folder),
            expected[of],
            "{folder}: {:?}",
            not_passed(results)
        );
    }
}

#[test]
fn the_vectors_of_the_repository_pass() {
    let results = run(&own());
    assert_supported(&results, 0);
    assert_eq!(exit_code(&results), 0, "{}", not_passed(&results).join("\n"));
}

#[test]
fn every_file_of_the_repository_has_its_origin() {
    let origin = fs::read_to_string(own().join("ORIGIN")).unwrap();
    let reported: BTreeSet<&str> = origin
        .lines()
        .filter(|line| line.contains("; licence: "))
        .filter_map(|line| line.split_once(": source: ").map(|(file, _)| file))
        .collect();
    let mut listed: BTreeSet<String> = BTreeSet::from(["manifest.json".to_string()]);
    let manifest = manifest(&own());
    let files = manifest["files"].as_array().unwrap().iter();
    listed.extend(files.map(|entry| entry["file"].as_str().unwrap().to_string()));
    assert_eq!(reported, listed.iter().map(String::as_str).collect());
    let mut there = BTreeSet::from(["manifest.json".to_string()]);
    for folder in fs::read_dir(own())
        .unwrap()
        .flatten()
        .filter(|entry| entry.path().is_dir())
    {
        for file in fs::read_dir(folder.path()).unwrap().flatten() {
            let name = |name: std::ffi::OsString| name.into_string().unwrap();
            there.insert(format!("{}/{}", name(folder.file_name()), name(file.file_name())));
        }
    }
    assert_eq!(there, listed);
}

#[test]
fn all_vectors_pass() {
    let Some(dir) = skipped::shared("conformance") else {
        return;
    };
    let results = run(&dir);
    assert_supported(&results, 1);
    assert_eq!(exit_code(&results), 0, "{}", not_passed(&results).join("\n"));
}

/// Copies vectors under other names, all in one folder, and lists them in another order.
#[test]
fn names_do_not_matter() {
    let dir = tempfile::tempdir().unwrap();
    let mut files = manifest(&own())["files"].as_array().unwrap().clone();
    files.reverse();
    let name = |file: &str| {
        let (stem, ending) = file.rsplit_once('.').unwrap();
        let sum = stem
            .bytes()
            .fold(7u32, |sum, byte| sum.wrapping_mul(31) ^ u32::from(byte));
        format!("case-{sum:08x}.{ending}")
    };
    fs::create_dir(dir.path().join("any")).unwrap();
    for entry in &mut files {
        let old = entry["file"].as_str().unwrap().to_string();
        let new = format!("any/{}", name(&old));
        fs::copy(own().join(&old), dir.path().join(&new)).unwrap();
        entry["file"] = new.into();
        for key in ["result_file", "metadata_file"] {
            if let Some(beside) = entry["config"][key].as_str() {
                let folder = old.split_once('/').unwrap().0;
                entry["config"][key] = name(&format!("{folder}/{beside}")).into();
            }
        }
    }
    let expected: usize = SUPPORTED.iter().map(|(_, counts)| counts[0]).sum();
    fs::write(dir.path().join("manifest.json"), json!({"files": files}).to_string()).unwrap();
    let results = run(dir.path());
    assert_eq!(count(&results, "any"), expected, "{}", not_passed(&results).join("\n"));
}

const CLASSES: [([f64; 3], f64); 3] = [
    ([1.56, 1.6, 3.9], -1.78),
    ([1.73, 0.6, 0.8], -0.6),
    ([3.0, 3.0, 8.0], -1.78),
];

/// Anchors and deltas over a range of 16 x 8 m.
fn anchors(made: &mut Made) {
    let (rows, columns) = (10, 20);
    let center = |row: usize, column: usize| [-8.0 + 0.8 * (column as f64 + 0.5), -4.0 + 0.8 * (row as f64 + 0.5)];
    let anchor = |class: usize, row, column, turned: usize| {
        let ([h, w, l], z) = CLASSES[class];
        let [x, y] = center(row, column);
        [x, y, z, h, w, l, 1.57 * turned as f64]
    };
    let places = || (0..rows).flat_map(|row| (0..columns).map(move |column| (row, column)));
    let by_class: Vec<f64> = (0..3)
        .flat_map(|class| places().flat_map(move |(r, c)| [0, 1].map(|turned| anchor(class, r, c, turned))))
        .flatten()
        .collect();
    let config = json!({"range": [-8, -4, -15, 8, 4, 15]});
    made.tensors(
        "a.safetensors",
        1e-9,
        config,
        &[("out.anchors_chwr7", vec![3, rows, columns, 2, 7], by_class)],
    );

    let by_cell = places().flat_map(|(r, c)| (0..6).map(move |i| anchor(i / 2, r, c, i % 2)));
    let deltas = noise(5, 6 * rows * columns * 7);
    let decoded: Vec<f64> = by_cell
        .zip(deltas.chunks(7))
        .flat_map(|([x, y, z, h, w, l, yaw], d)| {
            let diagonal = (w * w + l * l).sqrt();
            let [h1, w1, l1] = [h * libm::exp(d[3]), w * libm::exp(d[4]), l * libm::exp(d[5])];
            [
                x + d[0] * diagonal,
                y + d[1] * diagonal,
                z + d[2] * h,
                h1,
                w1,
                l1,
                yaw + d[6],
            ]
        })
        .collect();
    let shape = vec![1, 6 * rows * columns, 7];
    made.tensors(
        "d.safetensors",
        1e-4,
        json!({}),
        &[("in.deltas", shape.clone(), deltas), ("out.boxes_hwl", shape, decoded)],
    );
}

/// A head of 5 channels on a map of 3 x 7 cells.
fn head(made: &mut Made) {
    let (channels, rows, columns) = (5, 3, 7);
    let map = noise(1, channels * rows * columns);
    let layer = |seed: u64, outputs: usize| (noise(seed, outputs * channels), noise(seed + 1, outputs));
    let run = |(weights, bias): &(Vec<f64>, Vec<f64>)| -> Vec<f64> {
        let of = |output: usize, cell: usize| -> f64 {
            let inputs =
                (0..channels).map(|input| weights[output * channels + input] * map[input * rows * columns + cell]);
            bias[output] + inputs.sum::<f64>()
        };
        (0..bias.len())
            .flat_map(|output| (0..rows * columns).map(move |cell| (output, cell)))
            .map(|(o, c)| of(o, c))
            .collect()
    };
    let (scores, deltas) = (layer(2, 18), layer(4, 42));
    let [psm, rm] = [run(&scores), run(&deltas)];
    let shape = |outputs: usize| vec![1, outputs, rows, columns];
    made.tensors(
        "h.safetensors",
        1e-5,
        json!({}),
        &[
            ("in.x", shape(channels), map.clone()),
            ("param.cls_head.weight", vec![18, channels, 1, 1], scores.0),
            ("param.cls_head.bias", vec![18], scores.1),
            ("param.reg_head.weight", vec![42, channels, 1, 1], deltas.0),
            ("param.reg_head.bias", vec![42], deltas.1),
            ("out.psm", shape(18), psm),
            ("out.rm", shape(42), rm),
        ],
    );
}

/// Seven squares of 2 m on a line, each half a metre further than the one before.
fn squares(made: &mut Made) {
    let count = 7;
    let corners: Vec<f64> = (0..count)
        .flat_map(|i| {
            let x = 0.5 * i as f64;
            let ground = [[x + 1.0, -1.0], [x + 1.0, 1.0], [x - 1.0, 1.0], [x - 1.0, -1.0]];
            (0..8).flat_map(move |corner| [ground[corner % 4][0], ground[corner % 4][1], (corner / 4) as f64])
        })
        .collect();
    let iou = |a: usize, b: usize| {
        let shared = 2.0 * (2.0 - 0.5 * a.abs_diff(b) as f64).max(0.0);
        shared / (8.0 - shared)
    };
    let matrix = (0..count).flat_map(|a| (0..count).map(move |b| iou(a, b))).collect();
    let scores = (0..count).map(|i| 0.9 - 0.1 * i as f64).collect();
    // 0.5: 1.5 m of 2 m shared are 0.6, 1 m are 1/3.
    let tensors = [
        ("in.corners", vec![count, 8, 3], corners),
        ("in.scores", vec![count], scores),
        ("out.iou", vec![count, count], matrix),
        ("out.keep_0.5", vec![4], vec![0.0, 2.0, 4.0, 6.0]),
        ("out.keep_0.01", vec![2], vec![0.0, 4.0]),
    ];
    made.tensors("s.safetensors", 1e-6, json!({}), &tensors);
}

#[test]
fn sizes_do_not_matter() {
    let mut made = Made::default();
    anchors(&mut made);
    head(&mut made);
    squares(&mut made);
    let results = made.run();
    assert_eq!(results.len(), 4);
    assert_eq!(exit_code(&results), 0, "{}", not_passed(&results).join("\n"));
}

#[test]
fn a_number_that_is_wrong_fails() {
    let mut made = Made::default();
    squares(&mut made);
    let mut changed = made.contents.remove("s.safetensors").unwrap();
    let end = changed.len() - 8;
    let value = f64::from_le_bytes(changed[end..].try_into().unwrap());
    changed[end..].copy_from_slice(&(value + 1.5).to_le_bytes());
    made.contents.insert("s.safetensors".into(), changed);
    assert_eq!(exit_code(&made.run()), 1);
}
