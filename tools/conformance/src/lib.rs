//! Runs conformance vectors (inputs and expected outputs of the reference implementation) through the code that the
//! graphs run: the geometry of `realo-schemas`, `realo-nms`, `realo-nn`, `realo-scoring`, the noise of `realo-localization`, the
//! delays of `realo-link`; and frames of data sets through `realo-importer`, the player's plan and the feature bank.
//!
//! A folder of vectors has a `manifest.json` that lists its files with tolerance, configuration, and the tensors of a
//! safetensors file or the keys of a JSON document. Those alone decide which check a vector goes through, whatever its
//! name and size.

mod boxes;
mod dataset;
mod evaluation;
mod fusion;
mod iou_nms;
mod keys;
mod loss;
mod network;
mod noise;
mod parts;
mod pillars;
mod postprocess;
mod reference;
mod targets;
mod vector;
mod warps;

use std::fmt;
use std::path::Path;

use serde::{Deserialize, Serialize};

pub use vector::Entry;
use vector::Vector;

/// What became of one vector.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct CaseResult {
    /// Its file, below the folder of vectors.
    pub file: String,
    /// What became of it.
    #[serde(flatten)]
    pub status: Status,
}

/// What became of a vector.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(tag = "status", content = "detail", rename_all = "snake_case")]
pub enum Status {
    /// Everything expected was found.
    Passed,
    /// The first difference, or what could not be read.
    Failed(String),
    /// Why there is no check for it.
    NotSupported(String),
}

impl fmt::Display for CaseResult {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match &self.status {
            Status::Passed => write!(f, "{}: passed", self.file),
            Status::Failed(difference) => write!(f, "{}: failed: {difference}", self.file),
            Status::NotSupported(reason) => write!(f, "{}: not supported: {reason}", self.file),
        }
    }
}

#[derive(Deserialize)]
struct Manifest {
    files: Vec<Entry>,
}

/// Runs every vector that the manifest of `dir` lists, in its order. A vector that cannot be read is a failed case, a
/// manifest that cannot be read the only one.
pub fn run(dir: &Path) -> Vec<CaseResult> {
    let manifest = match manifest(dir) {
        Ok(manifest) => manifest,
        Err(reason) => {
            return vec![CaseResult {
                file: MANIFEST.into(),
                status: Status::Failed(reason),
            }];
        }
    };
    let all = &manifest.files[..];
    let case = |entry: &Entry| CaseResult {
        file: entry.file.clone(),
        status: status(&Vector { dir, entry, all }),
    };
    all.iter().map(case).collect()
}

const MANIFEST: &str = "manifest.json";

fn manifest(dir: &Path) -> Result<Manifest, String> {
    let file = dir.join(MANIFEST);
    let text = std::fs::read_to_string(&file).map_err(|error| {
        format!(
            "{}: {error}; give the folder that holds the vectors' {MANIFEST}",
            file.display()
        )
    })?;
    serde_json::from_str(&text).map_err(|error| format!("{}: {error}", file.display()))
}

type Check = fn(&Vector) -> Result<(), String>;

/// Vectors that one check reads.
struct Kind {
    /// Tensors or keys that they have.
    with: &'static [&'static str],
    /// Those that they have not.
    without: &'static [&'static str],
    check: Check,
}

impl Kind {
    const fn new(with: &'static [&'static str], check: Check) -> Self {
        let without = &[];
        Kind { with, without, check }
    }

    const fn without(mut self, names: &'static [&'static str]) -> Self {
        self.without = names;
        self
    }

    fn takes(&self, entry: &Entry) -> bool {
        self.with.iter().all(|name| entry.has(name)) && !self.without.iter().any(|name| entry.has(name))
    }
}

/// All kinds; no two take the same vector.
const KINDS: [&[Kind]; 14] = [
    boxes::KINDS,
    dataset::KINDS,
    iou_nms::KINDS,
    evaluation::KINDS,
    pillars::KINDS,
    targets::KINDS,
    loss::KINDS,
    postprocess::KINDS,
    network::KINDS,
    fusion::KINDS,
    warps::KINDS,
    parts::KINDS,
    noise::KINDS,
    keys::KINDS,
];

fn status(vector: &Vector) -> Status {
    match check_of(vector) {
        Ok(check) => match check(vector) {
            Ok(()) => Status::Passed,
            Err(difference) => Status::Failed(difference),
        },
        Err(reason) => Status::NotSupported(reason),
    }
}

fn check_of(vector: &Vector) -> Result<Check, String> {
    let entry = vector.entry;
    let mut kinds = KINDS.into_iter().flatten();
    if let Some(kind) = kinds.find(|kind| kind.takes(entry)) {
        return Ok(kind.check);
    }
    // Its keys are names of networks.
    if entry.tensors.is_empty() && boxes::holds_samples(vector) {
        return Ok(boxes::anchor_samples);
    }
    let of = |begin: &str| {
        let names = entry.tensors.keys().filter(|name| name.starts_with(begin));
        names.map(|name| format!("`{name}`")).collect::<Vec<_>>().join(", ")
    };
    Err(match entry.tensors.is_empty() {
        true => format!("no check reads a document of {:?}", entry.keys),
        false => format!("no check makes {} of {}", of("out."), of("in.")),
    })
}

/// The exit code of a run: 0 if all passed, 1 if one failed or none ran, 3 if some are not supported.
pub fn exit_code(results: &[CaseResult]) -> u8 {
    let passed = results.iter().filter(|result| result.status == Status::Passed).count();
    let failed = results.iter().any(|result| matches!(result.status, Status::Failed(_)));
    match (failed, passed) {
        (true, _) | (_, 0) => 1,
        (false, passed) if passed < results.len() => 3,
        _ => 0,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exit_codes_tell_failed_from_not_supported() {
        let case = |status: &Status| CaseResult {
            file: "a".into(),
            status: status.clone(),
        };
        let (passed, failed) = (Status::Passed, Status::Failed("1".into()));
        let unsupported = Status::NotSupported("2".into());
        let code = |list: &[&Status]| exit_code(&list.iter().map(|status| case(status)).collect::<Vec<_>>());
        assert_eq!(code(&[]), 1);
        assert_eq!(code(&[&unsupported]), 1);
        assert_eq!(code(&[&passed, &passed]), 0);
        assert_eq!(code(&[&passed, &unsupported]), 3);
        assert_eq!(code(&[&passed, &failed, &unsupported]), 1);
    }

    fn entry(json: &str) -> Entry {
        serde_json::from_str(json).unwrap()
    }

    #[test]
    fn says_what_it_has_no_check_for() {
        let reason = |json: &str| {
            let entry = entry(json);
            let (dir, all) = (Path::new("nowhere"), &[][..]);
            let vector = Vector {
                dir,
                entry: &entry,
                all,
            };
            check_of(&vector).err()
        };
        let tensors = r#"{"file": "a", "tolerance": 0, "tensors": {"in.x": 1, "in.psm": 1, "out.corners": 1}}"#;
        assert_eq!(
            reason(tensors).unwrap(),
            "no check makes `out.corners` of `in.psm`, `in.x`"
        );
        assert!(reason(&tensors.replace("in.x", "in.rm")).is_none());
        let keys = r#"{"file": "a", "tolerance": 0, "keys": ["entries"]}"#;
        assert_eq!(reason(keys).unwrap(), r#"no check reads a document of ["entries"]"#);
        assert!(reason(&keys.replace("entries", "curves")).is_none());
        // Networks of one agent have no fused map, and go through a check of their own.
        let whole = r#"{"file": "a", "tolerance": 0, "tensors":
            {"in.points": 1, "out.psm": 1, "out.rm": 1, "param.cls_head.weight": 1}}"#;
        assert!(reason(whole).is_none());
        let fused = whole.replace("{\"in", "{\"mid.fused\": 1, \"in");
        assert!(reason(&fused).is_none());
        assert!(reason(&fused.replace("\"out.psm\": 1, ", "")).is_some());
    }

    #[test]
    fn a_vector_has_one_check_at_most() {
        let text = std::fs::read(concat!(
            env!("CARGO_MANIFEST_DIR"),
            "/../../tests/data/conformance/manifest.json"
        ));
        let manifest: Manifest = serde_json::from_slice(&text.unwrap()).unwrap();
        for entry in &manifest.files {
            let kinds = KINDS.into_iter().flatten().filter(|kind| kind.takes(entry)).count();
            assert!(kinds <= 1, "{} has {kinds}", entry.file);
        }
    }

    #[test]
    fn a_folder_without_vectors_has_failed() {
        let dir = tempfile::tempdir().unwrap();
        for (text, expected) in [(None, "give the folder"), (Some("{\"files\": 3}"), "invalid type")] {
            text.iter()
                .for_each(|text| std::fs::write(dir.path().join(MANIFEST), text).unwrap());
            let results = run(dir.path());
            assert_eq!((results.len(), exit_code(&results)), (1, 1));
            assert!(results[0].to_string().contains(expected), "{}", results[0]);
        }
    }

    #[test]
    fn a_vector_that_cannot_be_read_or_differs_has_failed() {
        let dir = tempfile::tempdir().unwrap();
        std::fs::create_dir(dir.path().join("boxes")).unwrap();
        std::fs::create_dir(dir.path().join("evaluation")).unwrap();
        std::fs::write(dir.path().join("boxes/encode.safetensors"), b"not a tensor file").unwrap();
        let curve =
            r#"{"curves": [{"tp": [1, 0], "gt": 2, "ap": 0.75, "mrec": [0, 0.5, 0.5, 1], "mpre": [1, 1, 0.5, 0]}]}"#;
        std::fs::write(dir.path().join("evaluation/ap_curves.json"), curve).unwrap();
        let files = [
            "boxes/encode.safetensors",
            "boxes/decode.safetensors",
            "evaluation/ap_curves.json",
        ];
        let names = [
            r#""tensors": {"in.anchors": 1, "in.boxes_hwl": 1, "out.deltas": 1}"#,
            r#""keys": ["curves"]"#,
        ];
        let entries = [0, 0, 1].map(|i| names[i]).into_iter().zip(files);
        let entries =
            entries.map(|(names, file)| format!(r#"{{"file": "{file}", "tolerance": 1e-9, "config": {{}}, {names}}}"#));
        let entries = entries.collect::<Vec<_>>().join(",");
        std::fs::write(dir.path().join("manifest.json"), format!(r#"{{"files": [{entries}]}}"#)).unwrap();
        let results = run(dir.path());
        assert_eq!(exit_code(&results), 1);
        let difference = |i: usize| match &results[i].status {
            Status::Failed(difference) => difference.clone(),
            other => panic!("{other:?}"),
        };
        assert!(difference(0).contains("safetensors"), "{}", difference(0));
        assert!(difference(1).contains("decode.safetensors"), "{}", difference(1));
        assert!(difference(2).contains("expected 0.75, found 0.5"), "{}", difference(2));
        assert_eq!(
            results[2].to_string(),
            format!("evaluation/ap_curves.json: failed: {}", difference(2))
        );
    }
}
