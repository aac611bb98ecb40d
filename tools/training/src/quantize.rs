//! A model file for bytes: what they stand for, found on frames, and how much is lost by them.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use realo_methods::Model;
use realo_methods::network::calibration::Calibration;
use realo_methods::network::{Network, NetworkOptions};
use realo_methods::{Kernels, load};
use realo_nn::model::Precision;
use serde::Serialize;

use crate::TrainError;
use crate::data::{Frames, write_whole};
use crate::train::check_frames_suit;
use crate::validate::{Validation, each_scene, score_network};

/// What quantising came to.
#[derive(Clone, Debug)]
pub struct Quantized {
    /// The model file that was written.
    pub file: PathBuf,
    /// Sweeps that were looked at.
    pub sweeps: usize,
    /// How good the network is in f32.
    pub before: Validation,
    /// And in bytes.
    pub after: Validation,
}

/// The file beside a model's that says what bytes stand for.
#[derive(Serialize)]
struct QuantizedModel {
    extends: String,
    name: String,
    weights: String,
    precision: Precision,
    activations: BTreeMap<String, f32>,
}

/// Looks at the sweeps of some frames, writes a model file beside `file` that extends it with what bytes stand for, and
/// scores both on other frames.
///
/// # Errors
/// [`TrainError`] if model, weights or a frame cannot be had, or the file not written; a file that is there is replaced only
/// if `replace`.
pub fn quantize(
    file: &Path,
    replace: bool,
    frames: &Arc<dyn Frames>,
    validation: &Arc<dyn Frames>,
) -> Result<Quantized, TrainError> {
    let loaded = load(file, Kernels::auto(0))?;
    let (model, weights) = (&*loaded.model, &*loaded.weights);
    check_frames_suit(model)?;
    let name = format!("{}-int8", model.name);
    let path = file.with_file_name(format!("{name}.toml"));
    if !replace && path.exists() {
        return Err(TrainError::Exists { path });
    }
    let mut calibration = Calibration::new(model, weights)?;
    let mut sweeps = 0;
    each_scene(model, frames, |_, scene| {
        sweeps += 1;
        Ok(calibration.observe(&scene.points())?)
    })?;
    let quantized = Model {
        precision: Precision::Int8,
        activations: calibration.activations(),
        ..model.clone()
    };
    quantized.validate()?;
    let score = |model: &Model| {
        let network = Network::new(model, weights, NetworkOptions::default())?;
        score_network(model, weights, network, validation)
    };
    let single = Model {
        precision: Precision::F32,
        ..model.clone()
    };
    let (before, after) = (score(&single)?, score(&quantized)?);
    let written = QuantizedModel {
        extends: file.file_name().unwrap_or_default().to_string_lossy().into_owned(),
        name,
        weights: model.own_weights().into(),
        precision: Precision::Int8,
        activations: quantized.activations,
    };
    let text = toml::to_string(&written).expect("a model file is plain data");
    write_whole(&path, text.as_bytes())?;
    Ok(Quantized {
        file: path,
        sweeps,
        before,
        after,
    })
}
