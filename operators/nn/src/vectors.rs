//! Reads conformance vectors for tests, from `tests/data/conformance`.

use std::path::{Path, PathBuf};

use safetensors::{Dtype, SafeTensors};
use serde_json::Value;

/// The folder of vectors.
pub(crate) fn folder() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/data/conformance")
}

/// A file of tensors with its configuration.
pub(crate) struct Vector {
    bytes: Vec<u8>,
    /// Settings of the case.
    pub config: Value,
}

impl Vector {
    /// A vector.
    pub fn open(file: &str) -> Vector {
        let path = folder().join(file);
        let bytes = std::fs::read(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
        let (_, header) = SafeTensors::read_metadata(&bytes).unwrap();
        let config = &header.metadata().as_ref().unwrap()["config"];
        let config = serde_json::from_str(config).unwrap();
        Vector { bytes, config }
    }

    /// A tensor's numbers, row-major.
    pub fn f64(&self, name: &str) -> Vec<f64> {
        let parsed = SafeTensors::deserialize(&self.bytes).unwrap();
        let tensor = parsed.tensor(name).unwrap();
        let data = tensor.data();
        match tensor.dtype() {
            Dtype::F64 => each(data, f64::from_le_bytes),
            Dtype::F32 => each(data, |bytes| f64::from(f32::from_le_bytes(bytes))),
            Dtype::I64 => each(data, |bytes| i64::from_le_bytes(bytes) as f64),
            Dtype::I32 => each(data, |bytes| f64::from(i32::from_le_bytes(bytes))),
            Dtype::I8 => each(data, |bytes| f64::from(i8::from_le_bytes(bytes))),
            Dtype::U8 => each(data, |bytes| f64::from(u8::from_le_bytes(bytes))),
            other => panic!("{name} is {other:?}"),
        }
    }

    /// A tensor's numbers in single precision.
    pub fn f32(&self, name: &str) -> Vec<f32> {
        self.f64(name).into_iter().map(|value| value as f32).collect()
    }

    /// A tensor's numbers as rows of `N`.
    pub fn rows<const N: usize>(&self, name: &str) -> Vec<[f32; N]> {
        self.f32(name).as_chunks::<N>().0.to_vec()
    }

    /// A tensor's numbers as rows of `N`, in double precision.
    pub fn rows_f64<const N: usize>(&self, name: &str) -> Vec<[f64; N]> {
        self.f64(name).as_chunks::<N>().0.to_vec()
    }

    /// A tensor's shape.
    pub fn shape(&self, name: &str) -> Vec<usize> {
        let parsed = SafeTensors::deserialize(&self.bytes).unwrap();
        parsed.tensor(name).unwrap().shape().to_vec()
    }

    /// A number of the configuration.
    pub fn number(&self, key: &str) -> f64 {
        self.config[key]
            .as_f64()
            .unwrap_or_else(|| panic!("config has no number `{key}`"))
    }

    /// A list of numbers of the configuration.
    pub fn list<const N: usize>(&self, key: &str) -> [f64; N] {
        serde_json::from_value::<Vec<f64>>(self.config[key].clone())
            .unwrap()
            .try_into()
            .unwrap()
    }
}

/// Channels last of a `[n, channels, rows, columns]` tensor.
pub(crate) fn nhwc(values: &[f32], [n, channels, rows, columns]: [usize; 4]) -> Vec<f32> {
    let mut out = Vec::with_capacity(values.len());
    for sample in 0..n {
        for cell in 0..rows * columns {
            out.extend((0..channels).map(|channel| values[(sample * channels + channel) * rows * columns + cell]));
        }
    }
    out
}

/// Panics at the first number that is not within t + t |expected|.
pub(crate) fn assert_near(what: &str, found: &[f32], expected: &[f32], t: f32) {
    assert_eq!(found.len(), expected.len(), "{what}");
    for (i, (found, expected)) in found.iter().zip(expected).enumerate() {
        let near = (found - expected).abs() <= t + t * expected.abs();
        assert!(near, "{what}[{i}]: expected {expected}, found {found}");
    }
}

fn each<const N: usize>(data: &[u8], read: impl Fn([u8; N]) -> f64) -> Vec<f64> {
    data.as_chunks::<N>().0.iter().map(|bytes| read(*bytes)).collect()
}
