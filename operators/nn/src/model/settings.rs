//! What a model file says.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::architecture::Architecture;
use super::error::ModelError;
use super::precision::Precision;

/// A detector on pillars, with the settings that all architectures share.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, bound = "A: Architecture")]
pub struct Model<A> {
    /// Name, also the stem of the file of weights: lower-case letters, digits, `-`, `_`.
    pub name: String,
    /// Stem of the file of weights where it is another model's.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub weights: Option<String>,
    /// Stem of another file, of which the encoder's tensors are taken that the file of weights lacks: that of the detector behind whose
    /// encoder a fusion learned.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub encoder: Option<String>,
    /// Stem of another file, of which the compressor's tensors are taken that the file of weights lacks: that of a fusion whose compressor
    /// serves others behind the same encoder.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub compressor: Option<String>,
    /// SHA-256 of files of weights by their stems, in hexadecimal digits; weights that are named here are checked when they
    /// are loaded.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub sha256: BTreeMap<String, String>,
    /// Frame of the points and the anchors as the network knows them.
    pub frame: Frame,
    /// For `frame = "lidar"`: how far above the ground the LiDAR stood in training, m. Graphs need it, to bring points from
    /// the agents' body frame to the model's, and boxes back.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub lidar_height: Option<f64>,
    /// Arithmetic of inference, where the CPU has it.
    pub precision: Precision,
    /// Headings of the anchors, rad.
    pub rotations: Vec<f64>,
    /// What decides in training which anchors an object has.
    #[serde(default, skip_serializing_if = "Matching::is_default")]
    pub matching: Matching,
    /// Detections score more than this, 0 to 1.
    pub score_threshold: f32,
    /// How the layers are put together; a PointPillars detector if the file does not say.
    #[serde(default, skip_serializing_if = "is_default")]
    pub arch: A,
    /// Classes in the order of the head's scores, each with its anchor.
    pub classes: Vec<ClassAnchor>,
    /// The pillars' grid.
    pub grid: Grid,
    /// From points to pillars.
    pub pillars: PillarSettings,
    /// The convolutions from the canvas to the BEV map.
    pub backbone: Backbone,
    /// Convolutions with bias and ReLU after the backbone; none if empty.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub shrink: Vec<Shrink>,
    /// Convolutions with bias and ReLU before the heads, behind the fusion where there is one; none if empty.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub refine: Vec<Shrink>,
    /// The largest number that bytes keep of each layer's results, by the layer's key; for `precision = "int8"`.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub activations: BTreeMap<String, f32>,
}

/// Where the origin of a model's frame lies; x points forward, y left, z up.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Frame {
    /// The agent's body: the ground at z = 0.
    Body,
    /// Its LiDAR.
    Lidar,
}

/// How an object is laid beside anchors, which are in a few headings only.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Matching {
    /// By its upright hull, as V2X-Real does. A car that stands 13 degrees off the anchors' headings matches none well, one
    /// of 45 degrees not even nearly: but for the best, all anchors around it learn that there is nothing.
    #[default]
    Hull,
    /// Turned to the nearest of the anchors' headings.
    Turned,
}

impl Matching {
    fn is_default(&self) -> bool {
        *self == Matching::default()
    }
}

/// A class with its anchor and the overlaps that assign it to objects in training.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ClassAnchor {
    /// Super-class.
    pub name: String,
    /// Length, m.
    pub length: f64,
    /// Width, m.
    pub width: f64,
    /// Height, m.
    pub height: f64,
    /// Height of the centre in the model's frame, m.
    pub z: f64,
    /// An anchor with more IoU than this is positive.
    pub matched: f64,
    /// An anchor with less IoU than this with every object is negative.
    pub unmatched: f64,
}

/// The volume that the network sees, cut into pillars.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Grid {
    /// Range along x, m.
    pub x: [f64; 2],
    /// Range along y, m.
    pub y: [f64; 2],
    /// Range along z, m.
    pub z: [f64; 2],
    /// Side of a pillar, m.
    pub cell: f64,
}

impl Grid {
    /// Pillars along y.
    pub fn rows(&self) -> usize {
        self.count(self.y)
    }

    /// Pillars along x.
    pub fn columns(&self) -> usize {
        self.count(self.x)
    }

    fn count(&self, [from, to]: [f64; 2]) -> usize {
        ((to - from) / self.cell).round() as usize
    }
}

/// How points become pillars.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PillarSettings {
    /// Features of a pillar.
    pub channels: usize,
    /// Points that a pillar takes at most.
    pub points: usize,
    /// Pillars of a sweep at most.
    pub pillars: usize,
    /// Whether slots without a point take part in the maximum, as in V2X-Real.
    pub empty_slots: bool,
    /// Whether the points' intensity is seen; else it counts as 0. The layer has a weight for it in both cases.
    pub intensity: bool,
}

/// Blocks of 3x3 convolutions, each brought to one size and concatenated. All lists have an entry for each block.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Backbone {
    /// Convolutions of a block after its first.
    pub layers: Vec<usize>,
    /// Stride of a block's first convolution: 1 or 2.
    pub strides: Vec<usize>,
    /// Channels of a block.
    pub channels: Vec<usize>,
    /// Factor by which a block's map is enlarged.
    pub up_strides: Vec<usize>,
    /// Channels of the enlarged map.
    pub up_channels: Vec<usize>,
}

/// A convolution of stride 1 with bias and ReLU.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Shrink {
    /// Side of the kernel: 1 or 3.
    pub kernel: usize,
    /// Channels that it gives.
    pub channels: usize,
}

fn is_default<A: Architecture>(arch: &A) -> bool {
    *arch == A::default()
}

impl<A: Architecture> Model<A> {
    /// Refuses a model whose frame cannot be had from the agents' body frame, in which the graphs' sweeps are; `path` is for
    /// the error.
    ///
    /// # Errors
    /// [`ModelError::Frame`].
    pub fn check_frame(&self, path: &Path) -> Result<(), ModelError> {
        match (self.frame, self.lidar_height) {
            (Frame::Body, _) | (Frame::Lidar, Some(_)) => Ok(()),
            (Frame::Lidar, None) => Err(ModelError::Frame { path: path.into() }),
        }
    }

    /// How far the model's frame lies above the frame in which points come and boxes go, m: 0 where the two are the same.
    pub fn height(&self) -> f64 {
        self.lidar_height.unwrap_or(0.0)
    }

    /// Stem of the model's own file of weights.
    pub fn own_weights(&self) -> &str {
        self.weights.as_ref().unwrap_or(&self.name)
    }

    /// The files of weights that lie beside a model file: the model's own, and what holds its compressor and its encoder.
    pub fn weights_beside(&self, model_file: &Path) -> Vec<PathBuf> {
        let others = [&self.compressor, &self.encoder].into_iter().flatten();
        let stems = std::iter::once(self.own_weights()).chain(others.map(String::as_str));
        stems
            .map(|stem| model_file.with_file_name(format!("{stem}.safetensors")))
            .collect()
    }

    /// Anchors at a cell of the output map: (class, rotation).
    pub fn anchors(&self) -> usize {
        self.classes.len() * self.rotations.len()
    }

    /// Pillars along each side of a cell of the output map.
    pub fn stride(&self) -> usize {
        self.backbone.strides[0] / self.backbone.up_strides[0]
    }
}
