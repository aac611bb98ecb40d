//! Vectors made in tests.
#![allow(dead_code)]

use std::collections::BTreeMap;
use std::fs;

use realo_conformance::{CaseResult, Status, run};
use safetensors::Dtype;
use safetensors::tensor::TensorView;
use serde_json::{Value, json};

/// Vectors that did not pass.
pub fn not_passed(results: &[CaseResult]) -> Vec<String> {
    let results = results.iter().filter(|result| result.status != Status::Passed);
    results.map(|result| result.to_string()).collect()
}

/// Vectors that are made from the definitions.
#[derive(Default)]
pub struct Made {
    pub files: Vec<Value>,
    pub contents: BTreeMap<String, Vec<u8>>,
    /// Whether a number of each result is changed.
    pub wrong: bool,
}

impl Made {
    pub fn tensors(&mut self, file: &str, tolerance: f64, config: Value, tensors: &[(&str, Vec<usize>, Vec<f64>)]) {
        let bytes: Vec<(&str, Vec<usize>, Vec<u8>)> = tensors
            .iter()
            .map(|(name, shape, data)| {
                let changed = (self.wrong && name.starts_with("out.")).then_some(data.len() / 2);
                let value = |(index, value): (usize, &f64)| if Some(index) == changed { value + 0.5 } else { *value };
                let bytes = data.iter().enumerate().map(value).flat_map(f64::to_le_bytes).collect();
                (*name, shape.clone(), bytes)
            })
            .collect();
        let views = bytes.iter().map(|(name, shape, data)| {
            let view = TensorView::new(Dtype::F64, shape.clone(), data);
            (*name, view.unwrap_or_else(|error| panic!("{name}: {error}")))
        });
        self.contents
            .insert(file.into(), safetensors::serialize(views, None).unwrap());
        let names: BTreeMap<&str, Value> = tensors
            .iter()
            .map(|(name, shape, _)| (*name, json!(["float64", shape])))
            .collect();
        self.files
            .push(json!({"file": file, "tolerance": tolerance, "config": config, "tensors": names}));
    }

    pub fn run(&self) -> Vec<CaseResult> {
        let dir = tempfile::tempdir().unwrap();
        for (file, bytes) in &self.contents {
            fs::write(dir.path().join(file), bytes).unwrap();
        }
        fs::write(
            dir.path().join("manifest.json"),
            json!({"files": self.files}).to_string(),
        )
        .unwrap();
        run(dir.path())
    }
}

/// Numbers in [-1, 1) without a pattern.
pub fn noise(seed: u64, count: usize) -> Vec<f64> {
    let mut state = seed;
    let mut next = || {
        state = state
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1_442_695_040_888_963_407);
        // As many digits as an f32 has.
        (state >> 40) as f64 / f64::from(1u32 << 23) - 1.0
    };
    (0..count).map(|_| next()).collect()
}
