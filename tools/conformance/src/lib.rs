//! Runs conformance vectors (inputs and expected outputs of the reference implementation) through the code that the
//! graphs run: the geometry of `realo-schemas`, `realo-nms`, `realo-nn`, `realo-evaluator`.
//!
//! A folder of vectors has a `manifest.json` that lists its files with tolerance and configuration.

mod boxes;
mod evaluation;
mod iou_nms;
mod loss;
mod network;
mod pillars;
mod postprocess;
mod targets;
mod vector;

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
    let case = |entry: Entry| {
        let status = status(&Vector { dir, entry: &entry });
        CaseResult {
            file: entry.file,
            status,
        }
    };
    manifest.files.into_iter().map(case).collect()
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

fn status(vector: &Vector) -> Status {
    match check_of(&vector.entry.file) {
        Ok(check) => match check(vector) {
            Ok(()) => Status::Passed,
            Err(difference) => Status::Failed(difference),
        },
        Err(reason) => Status::NotSupported(reason),
    }
}

fn check_of(file: &str) -> Result<Check, String> {
    let (folder, name) = file.split_once('/').unwrap_or(("", file));
    let name = name.split('.').next().unwrap_or(name);
    let check = match folder {
        "boxes" => boxes::check(name),
        "iou_nms" => iou_nms::check(name),
        "evaluation" => evaluation::check(name),
        "pillars" => pillars::check(name),
        "targets" => targets::check(name),
        "loss" => loss::check(name),
        "postprocess" => postprocess::check(name),
        "network" => network::check(name),
        "model" => network::check_model(name),
        _ => return Err(format!("no part of this version computes `{folder}`")),
    };
    check.ok_or_else(|| format!("there is no check for `{name}` of `{folder}`"))
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

    #[test]
    fn says_what_it_has_no_check_for() {
        assert!(check_of("boxes/corners.safetensors").is_ok());
        assert!(check_of("boxes/other.json").unwrap_err().contains("`other` of `boxes`"));
        assert!(
            check_of("model/attfuse.safetensors")
                .unwrap_err()
                .contains("`attfuse` of `model`")
        );
        assert!(check_of("dataset/other.json").unwrap_err().contains("`dataset`"));
        assert!(check_of("loose.json").is_err());
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
        let entries = files
            .map(|file| format!(r#"{{"file": "{file}", "tolerance": 1e-9, "config": {{}}}}"#))
            .join(",");
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
