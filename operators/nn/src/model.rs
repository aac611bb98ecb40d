//! The typed model file: everything about a network that is not a weight.
//!
//! A model is `<name>.toml` beside `<name>.safetensors`, or beside what `weights` and `encoder` name (see
//! [`crate::weights`]). With `extends = "other.toml"` it says only what differs from the model of another file, key by key; `arch` as a whole.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};
use std::str::FromStr;

use serde::{Deserialize, Serialize};

use crate::arch::Arch;
use crate::layers::Layers;
use crate::load::{ReadError, read_bounded};

/// A detector on pillars, with the settings that all architectures share.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Model {
    /// Name, also the stem of the file of weights: lower-case letters, digits, `-`, `_`.
    pub name: String,
    /// Stem of the file of weights where it is another model's.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub weights: Option<String>,
    /// Stem of another file, of which the encoder's tensors are taken that the file of weights lacks: that of the detector behind whose
    /// encoder a fusion learned.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub encoder: Option<String>,
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
    #[serde(default, skip_serializing_if = "Arch::is_default")]
    pub arch: Arch,
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

/// Number type of maps and weights in the convolutions; sums of floating-point numbers are f32.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Precision {
    /// bfloat16.
    Bf16,
    /// Single precision.
    F32,
    /// Maps in bytes and weights in signed bytes, sums in whole numbers, from the canvas to the map that the fusion reads;
    /// fusion and heads in bf16, or f32 where the CPU has no products of bf16.
    Int8,
}

impl Precision {
    /// All.
    pub const ALL: [Precision; 3] = [Precision::Bf16, Precision::F32, Precision::Int8];
}

/// No number type has this name.
#[derive(Debug, thiserror::Error)]
#[error("expected one of {}, found `{name}`", Precision::ALL.map(|precision| precision.to_string()).join(", "), name = .0)]
pub struct UnknownPrecision(String);

impl FromStr for Precision {
    type Err = UnknownPrecision;

    fn from_str(name: &str) -> Result<Self, UnknownPrecision> {
        let named = Precision::ALL
            .into_iter()
            .find(|precision| precision.to_string() == name);
        named.ok_or_else(|| UnknownPrecision(name.into()))
    }
}

impl fmt::Display for Precision {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(match self {
            Precision::Bf16 => "bf16",
            Precision::F32 => "f32",
            Precision::Int8 => "int8",
        })
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

/// Why there is no model.
#[derive(Debug, thiserror::Error)]
pub enum ModelError {
    /// The file cannot be read.
    #[error("{}: {error}", path.display())]
    Read {
        /// The model file.
        path: PathBuf,
        /// What failed.
        error: ReadError,
    },
    /// It is not a model file.
    #[error("{}: {error}", path.display())]
    Syntax {
        /// The model file.
        path: PathBuf,
        /// Where and why.
        error: Box<toml::de::Error>,
    },
    /// What it extends.
    #[error("{}: `extends`: {reason}", path.display())]
    Extends {
        /// The model file.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
    /// It looks at points in a frame that nobody can bring them to.
    #[error(
        "{}: `lidar_height`: expected metres, found none: sweeps reach the network in the agent's body frame, on the ground; \
         say how far above it the LiDAR stood, or take a model of `frame = \"body\"`",
        path.display()
    )]
    Frame {
        /// The model file.
        path: PathBuf,
    },
    /// The model of a file.
    #[error("{}: {error}", path.display())]
    File {
        /// The model file.
        path: PathBuf,
        /// What is wrong with it.
        error: Box<ModelError>,
    },
    /// It describes no network that can be built.
    #[error("model `{name}` does not fit together: {}", problems.join("; "))]
    Invalid {
        /// The model's name.
        name: String,
        /// Everything that was found.
        problems: Vec<String>,
    },
}

impl Model {
    /// Reads and checks a model file.
    ///
    /// # Errors
    /// [`ModelError::Read`], [`ModelError::Syntax`], and [`ModelError::File`] with what [`Model::validate`] finds.
    pub fn read(path: &Path) -> Result<Model, ModelError> {
        Ok(Model::read_with_files(path)?.0)
    }

    /// A model of texts that are built in: what the first says, and the second where the first says nothing.
    ///
    /// # Errors
    /// Those of [`Model::parse`].
    pub fn of_texts(above: &str, below: &str) -> Result<Model, ModelError> {
        let path = Path::new("a model that is built in");
        let syntax = |error| ModelError::Syntax {
            path: path.into(),
            error: Box::new(error),
        };
        let mut above: toml::Table = toml::from_str(above).map_err(syntax)?;
        above.remove("extends");
        let table = over(toml::from_str(below).map_err(syntax)?, above);
        Model::checked(table.try_into().map_err(syntax)?, path)
    }

    /// Reads and checks a model file; beside the model the file and those that it extends, each with its bytes.
    ///
    /// # Errors
    /// As [`Model::read`], and [`ModelError::Extends`].
    pub fn read_with_files(path: &Path) -> Result<(Model, Vec<ModelFile>), ModelError> {
        let text = read_text(path)?;
        // Errors of a file that extends none tell the place in it.
        let Some(mut table) = extending(&text) else {
            return Ok((Model::parse(&text, path)?, vec![(path.into(), text)]));
        };
        let mut files = vec![(path.to_path_buf(), text)];
        let mut file = path.to_path_buf();
        while let Some(base) = table.remove("extends") {
            let wrong = |reason: String| ModelError::Extends {
                path: file.clone(),
                reason,
            };
            let base = base
                .as_str()
                .ok_or_else(|| wrong(format!("expected the name of a model file, found {base}")))?;
            if files.len() > MOST_EXTENDED {
                return Err(wrong(format!("more than {MOST_EXTENDED} files in a row")));
            }
            if Path::new(base).file_name() != Some(base.as_ref()) {
                return Err(wrong(format!(
                    "expected the name of a model file beside it, found `{base}`"
                )));
            }
            let next = file.with_file_name(base);
            let text = read_text(&next).map_err(|error| wrong(error.to_string()))?;
            file = next;
            let below = toml::from_slice(&text).map_err(|error| ModelError::Syntax {
                path: file.clone(),
                error: Box::new(error),
            })?;
            files.push((file.clone(), text));
            table = over(below, table);
        }
        let model = table.try_into().map_err(|error| ModelError::Syntax {
            path: path.into(),
            error: Box::new(error),
        })?;
        Model::checked(model, path).map(|model| (model, files))
    }

    /// Reads and checks the bytes of a model file; `path` is for errors.
    ///
    /// # Errors
    /// [`ModelError::Syntax`], and [`ModelError::File`] with what [`Model::validate`] finds.
    pub fn parse(bytes: &[u8], path: &Path) -> Result<Model, ModelError> {
        let model: Model = toml::from_slice(bytes).map_err(|error| ModelError::Syntax {
            path: path.into(),
            error: Box::new(error),
        })?;
        Model::checked(model, path)
    }

    fn checked(model: Model, path: &Path) -> Result<Model, ModelError> {
        model.validate().map_err(|error| ModelError::File {
            path: path.into(),
            error: Box::new(error),
        })?;
        Ok(model)
    }

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

    /// The files of weights that lie beside a model file: the model's own, and what holds its encoder.
    pub fn weights_beside(&self, model_file: &Path) -> Vec<PathBuf> {
        let stems = std::iter::once(self.own_weights()).chain(self.encoder.as_deref());
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

    /// Rows (along y) and columns (along x) of the BEV map and the heads.
    pub fn map_size(&self) -> [usize; 2] {
        let layers = Layers::of(self);
        let [rows, columns, _] = layers.size(layers.features);
        [rows, columns]
    }

    /// Channels of the BEV map that agents share.
    pub fn map_channels(&self) -> usize {
        let layers = Layers::of(self);
        layers.size(layers.features)[2]
    }

    /// Whether the parts fit together.
    ///
    /// # Errors
    /// [`ModelError::Invalid`] with everything that does not.
    pub fn validate(&self) -> Result<(), ModelError> {
        let mut problems = Problems(Vec::new());
        self.check_names(&mut problems);
        self.check_height(&mut problems);
        self.check_anchors(&mut problems);
        self.check_pillars(&mut problems);
        let grid_fits = self.check_grid(&mut problems);
        if self.check_backbone(&mut problems) && grid_fits {
            self.arch.check(self, &mut problems);
        }
        if problems.0.is_empty() {
            let numbers = Layers::of(self).numbers();
            problems.require(numbers <= MOST_NUMBERS, || {
                format!("grid, pillars, backbone, shrink: expected maps of at most {MOST_NUMBERS} numbers in all, found {numbers}")
            });
        }
        if problems.0.is_empty() && (self.precision == Precision::Int8 || !self.activations.is_empty()) {
            self.check_activations(&mut problems);
        }
        if problems.0.is_empty() {
            return Ok(());
        }
        Err(ModelError::Invalid {
            name: self.name.clone(),
            problems: problems.0,
        })
    }

    fn check_names(&self, problems: &mut Problems) {
        let plain = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '-' || c == '_';
        let names = [
            ("name", Some(&self.name)),
            ("weights", self.weights.as_ref()),
            ("encoder", self.encoder.as_ref()),
        ];
        for (key, name) in names {
            let fits = name.is_none_or(|name| !name.is_empty() && name.chars().all(plain));
            problems.require(fits, || {
                format!(
                    "{key}: expected lower-case letters, digits, `-`, `_`, found `{}`",
                    name.map_or("", |name| name)
                )
            });
        }
        let own = self.own_weights();
        problems.require(self.encoder.as_deref() != Some(own), || {
            format!("encoder: expected another file than the model's own weights, found `{own}`")
        });
        for (index, class) in self.classes.iter().enumerate() {
            problems.require(!class.name.is_empty(), || {
                format!("classes[{index}].name: expected a name, found none")
            });
            let first = self.classes.iter().position(|other| other.name == class.name);
            problems.require(first == Some(index), || {
                format!(
                    "classes[{index}].name: expected one that no other class has, found `{}` again",
                    class.name
                )
            });
        }
    }

    fn check_height(&self, problems: &mut Problems) {
        let Some(height) = self.lidar_height else {
            return;
        };
        problems.require(self.frame == Frame::Lidar, || {
            "lidar_height: expected only with frame = \"lidar\", found frame = \"body\"".into()
        });
        problems.require((0.0..=HIGHEST).contains(&height), || {
            format!("lidar_height: expected 0 to {HIGHEST} m, found {height}")
        });
    }

    fn check_anchors(&self, problems: &mut Problems) {
        problems.within("classes (how many)", self.classes.len(), 1, 64);
        problems.within("rotations (how many)", self.rotations.len(), 1, 16);
        problems.require(self.rotations.iter().all(|yaw| yaw.is_finite()), || {
            format!("rotations: expected finite angles, found {:?}", self.rotations)
        });
        problems.require((0.0..=1.0).contains(&self.score_threshold), || {
            format!("score_threshold: expected 0 to 1, found {}", self.score_threshold)
        });
        for class in &self.classes {
            let extent = [class.length, class.width, class.height];
            problems.require(extent.iter().all(|side| side.is_finite() && *side > 0.0), || {
                format!("class `{}`: expected positive extents, found {extent:?}", class.name)
            });
            problems.require(class.z.is_finite(), || {
                format!("class `{}`: expected a finite z, m, found {}", class.name, class.z)
            });
            let (unmatched, matched) = (class.unmatched, class.matched);
            problems.require(0.0 <= unmatched && unmatched <= matched && matched <= 1.0, || {
                format!(
                    "class `{}`: expected 0 <= unmatched <= matched <= 1, found {unmatched}, {matched}",
                    class.name
                )
            });
        }
    }

    fn check_pillars(&self, problems: &mut Problems) {
        problems.within("pillars.channels", self.pillars.channels, 1, MOST_CHANNELS);
        problems.within("pillars.points", self.pillars.points, 1, 65_536);
        problems.within("pillars.pillars", self.pillars.pillars, 1, MOST_CELLS);
    }

    fn check_grid(&self, problems: &mut Problems) -> bool {
        let before = problems.0.len();
        let Grid { x, y, z, cell } = self.grid;
        for (axis, [from, to]) in [("x", x), ("y", y), ("z", z)] {
            problems.require(from.is_finite() && to.is_finite() && from < to, || {
                format!("grid.{axis}: expected a range of metres, found [{from}, {to}]")
            });
        }
        problems.require(cell.is_finite() && cell > 0.0, || {
            format!("grid.cell: expected metres, found {cell}")
        });
        if problems.0.len() > before {
            return false;
        }
        for (axis, [from, to]) in [("x", x), ("y", y)] {
            let count = (to - from) / cell;
            problems.require((count - count.round()).abs() < 1e-3 && count.round() >= 1.0, || {
                format!("grid.{axis}: expected a whole number of cells of {cell} m, found {count}")
            });
            problems.require(count <= MOST_CELLS as f64, || {
                format!("grid.{axis}: expected at most {MOST_CELLS} cells of {cell} m, found {count}")
            });
        }
        let cells = ((x[1] - x[0]) / cell) * ((y[1] - y[0]) / cell);
        problems.require(cells <= MOST_CELLS as f64, || {
            format!("grid: expected at most {MOST_CELLS} cells of {cell} m, found {cells:.0}")
        });
        problems.0.len() == before
    }

    fn check_activations(&self, problems: &mut Problems) {
        let wanted = Layers::of(self).read_in_bytes();
        let wanted: BTreeSet<&str> = wanted.iter().map(|(key, _)| &**key).collect();
        for key in wanted.iter().filter(|key| !self.activations.contains_key(**key)) {
            problems.0.push(format!(
                "activations: expected the max result of layer `{key}`, which int8 needs, found none; `realo quantize` finds it"
            ));
        }
        for (key, max) in &self.activations {
            problems.require(wanted.contains(&**key), || {
                format!("activations: `{key}` is no layer whose results int8 layers read")
            });
            problems.require(ACTIVATIONS.contains(max), || {
                let [min, most] = [ACTIVATIONS.start(), ACTIVATIONS.end()];
                format!("activations: `{key}`: expected {min} to {most}, found {max}")
            });
        }
        for (key, products) in Layers::of(self).products_in_bytes() {
            problems.require(products <= MOST_BYTE_PRODUCTS, || {
                format!("layer `{key}`: sums of {products} products of bytes, expected at most {MOST_BYTE_PRODUCTS}")
            });
        }
    }

    fn check_backbone(&self, problems: &mut Problems) -> bool {
        let before = problems.0.len();
        let Backbone {
            layers,
            strides,
            channels,
            up_strides,
            up_channels,
        } = &self.backbone;
        problems.within("backbone.layers (how many)", layers.len(), 1, 8);
        for (key, list) in [
            ("strides", strides),
            ("channels", channels),
            ("up_strides", up_strides),
            ("up_channels", up_channels),
        ] {
            problems.require(list.len() == layers.len(), || {
                format!(
                    "backbone.{key}: expected {} entries as in layers, found {}",
                    layers.len(),
                    list.len()
                )
            });
        }
        problems.each_within("backbone.layers", layers, 0, 64);
        problems.each_within("backbone.strides", strides, 1, 2);
        problems.each_within("backbone.channels", channels, 1, MOST_CHANNELS);
        problems.each_within("backbone.up_strides", up_strides, 1, 16);
        problems.each_within("backbone.up_channels", up_channels, 1, MOST_CHANNELS);
        problems.within("shrink (how many)", self.shrink.len(), 0, 8);
        for (index, shrink) in self.shrink.iter().enumerate() {
            problems.within(&format!("shrink[{index}].channels"), shrink.channels, 1, MOST_CHANNELS);
            problems.require([1, 3].contains(&shrink.kernel), || {
                format!("shrink[{index}].kernel: expected 1 or 3, found {}", shrink.kernel)
            });
        }
        problems.0.len() == before
    }
}

// Bounds that keep a damaged file from asking for all memory; real networks stay far below.
const MOST_CHANNELS: usize = 4096;
const MOST_CELLS: usize = 1 << 24;
const MOST_NUMBERS: usize = 1 << 28;
const MOST_BYTES: u64 = 1 << 20;
/// Results of layers beyond which nothing sensible was calibrated.
const ACTIVATIONS: RangeInclusive<f32> = 1e-6..=1e6;
/// Products of 255 steps and a weight of 64 that 32 bits hold.
const MOST_BYTE_PRODUCTS: usize = i32::MAX as usize / (255 * 64);

/// No LiDAR of an agent stands higher above its ground, m.
const HIGHEST: f64 = 100.0;

/// Model files that extend each other, at most.
const MOST_EXTENDED: usize = 8;

/// What was found wrong with a model, a line each.
pub(crate) struct Problems(Vec<String>);

impl Problems {
    pub(crate) fn require(&mut self, holds: bool, problem: impl FnOnce() -> String) {
        if !holds {
            self.0.push(problem());
        }
    }

    pub(crate) fn within(&mut self, what: &str, found: usize, min: usize, most: usize) {
        self.require((min..=most).contains(&found), || {
            format!("{what}: expected {min} to {most}, found {found}")
        });
    }

    fn each_within(&mut self, what: &str, found: &[usize], min: usize, most: usize) {
        for (index, found) in found.iter().enumerate() {
            self.within(&format!("{what}[{index}]"), *found, min, most);
        }
    }
}

fn read_text(path: &Path) -> Result<Vec<u8>, ModelError> {
    read_bounded(path, MOST_BYTES).map_err(|error| ModelError::Read {
        path: path.into(),
        error,
    })
}

/// A model file, one that it extends or one of its weights, and its bytes.
pub type ModelFile = (PathBuf, Vec<u8>);

/// The table of a model file that extends another.
fn extending(text: &[u8]) -> Option<toml::Table> {
    let table: toml::Table = toml::from_slice(text).ok()?;
    table.contains_key("extends").then_some(table)
}

/// What `above` says, and what `below` says where it says nothing.
fn over(mut below: toml::Table, above: toml::Table) -> toml::Table {
    for (key, value) in above {
        let value = match (below.remove(&key), value) {
            (Some(toml::Value::Table(below)), toml::Value::Table(above)) if key != "arch" => {
                toml::Value::Table(over(below, above))
            }
            (_, value) => value,
        };
        below.insert(key, value);
    }
    below
}

#[cfg(test)]
mod tests {
    use super::*;

    const LITE: &str = include_str!("../../../models/lite.toml");

    fn lite() -> Model {
        toml::from_str(LITE).unwrap()
    }

    #[test]
    fn the_model_that_ships_is_valid_and_has_its_sizes() {
        let model = lite();
        model.validate().unwrap();
        assert_eq!((model.grid.rows(), model.grid.columns()), (200, 512));
        assert_eq!((model.map_size(), model.stride()), ([100, 256], 2));
        assert_eq!((model.map_channels(), model.anchors()), (64, 6));
        for class in &model.classes {
            assert_eq!(class.z, class.height / 2.0, "{}", class.name);
        }
    }

    #[test]
    fn a_model_survives_writing_and_reading() {
        let text = toml::to_string(&lite()).unwrap();
        assert_eq!(toml::from_str::<Model>(&text).unwrap(), lite());
    }

    #[test]
    fn finds_the_weights_beside_the_model_file() {
        let path = lite().weights_beside(Path::new("models/lite.toml"));
        assert_eq!(path, [Path::new("models/lite.safetensors")]);
    }

    #[test]
    fn a_model_that_extends_another_says_what_differs() {
        let dir = tempfile::tempdir().unwrap();
        let file = |name: &str, text: &str| {
            let path = dir.path().join(name);
            std::fs::write(&path, text).unwrap();
            path
        };
        file("base.toml", LITE);
        let middle = file(
            "middle.toml",
            "extends = \"base.toml\"\nname = \"middle\"\nweights = \"lite\"\n[arch]\nkind = \"attfuse\"\nagents = 3\n",
        );
        let top = file(
            "top.toml",
            "extends = \"middle.toml\"\n[pillars]\npoints = 16\n[arch]\nkind = \"fcooper\"\n",
        );
        let mut expected = lite();
        expected.name = "middle".into();
        expected.weights = Some("lite".into());
        expected.arch = Arch::AttFuse(crate::arch::Sharing {
            agents: 3,
            compression: 0,
        });
        assert_eq!(Model::read(&middle).unwrap(), expected);
        assert_eq!(expected.weights_beside(&middle), [dir.path().join("lite.safetensors")]);
        let beside = Model {
            encoder: Some("other".into()),
            ..expected.clone()
        };
        assert_eq!(
            beside.weights_beside(&middle),
            ["lite", "other"].map(|stem| dir.path().join(format!("{stem}.safetensors")))
        );
        expected.arch = Arch::FCooper(Default::default());
        expected.pillars.points = 16;
        let (model, files) = Model::read_with_files(&top).unwrap();
        let names: Vec<_> = files.iter().filter_map(|(file, _)| file.file_name()).collect();
        assert_eq!(model, expected);
        assert_eq!(names, ["top.toml", "middle.toml", "base.toml"]);

        let error = |text: &str| Model::read(&file("bad.toml", text)).unwrap_err().to_string();
        let cycle = error("extends = \"bad.toml\"");
        assert!(
            cycle.contains("bad.toml: `extends`: more than 8 files in a row"),
            "{cycle}"
        );
        assert!(error("extends = 3").contains("`extends`: expected the name of a model file, found 3"));
        assert!(error("extends = \"none.toml\"").contains("none.toml"));
        assert!(error("extends = \"../base.toml\"").contains("beside it, found `../base.toml`"));
        assert!(error("extends = \"base.toml\"\nwidth = 3").contains("unknown field `width`"));
        assert!(error("extends = \"base.toml\"\nweights = \"../x\"").contains("weights: expected lower-case"));
        assert!(error("extends = \"base.toml\"\nencoder = \"\"").contains("encoder: expected lower-case"));
        assert!(error("extends = \"base.toml\"\nencoder = \"lite\"").contains("encoder: expected another file"));
        assert!(
            error("extends = \"base.toml\"\n[arch]\nkind = \"attfuse\"\ncompression = 7")
                .contains("divisor of the map's 64")
        );
    }

    #[test]
    fn says_everything_that_does_not_fit() {
        type Change = fn(&mut Model);
        let cases: [(Change, &str); 14] = [
            (|m| m.name = "../lite".into(), "name: expected lower-case"),
            (|m| m.classes.clear(), "classes (how many): expected 1 to 64, found 0"),
            (
                |m| m.classes[1].name = "truck".into(),
                "classes[2].name: expected one that no other class has, found `truck` again",
            ),
            (
                |m| m.classes[0].width = f64::NAN,
                "class `vehicle`: expected positive extents",
            ),
            (
                |m| m.classes[2].unmatched = 0.7,
                "class `truck`: expected 0 <= unmatched",
            ),
            (|m| m.score_threshold = f32::NAN, "score_threshold"),
            (|m| m.grid.cell = 0.3, "grid.x: expected a whole number of cells"),
            (|m| m.grid.cell = 1e-300, "grid.x: expected at most "),
            (|m| m.grid.x = [5.0, -5.0], "grid.x: expected a range"),
            (|m| m.pillars.points = 0, "pillars.points: expected 1 to 65536, found 0"),
            (
                |m| m.backbone.strides = vec![2, 2],
                "backbone.strides: expected 3 entries",
            ),
            (
                |m| m.backbone.up_strides[2] = 2,
                "block 2: expected a map of 100x256 after enlarging, found 50x128",
            ),
            (|m| m.shrink[0].kernel = 5, "shrink[0].kernel: expected 1 or 3, found 5"),
            (
                |m| m.pillars.channels = 4096,
                "expected maps of at most 268435456 numbers in all, found",
            ),
        ];
        for (change, expected) in cases {
            let mut model = lite();
            change(&mut model);
            let error = model.validate().unwrap_err().to_string();
            assert!(error.contains(expected), "expected `{expected}` in: {error}");
        }
        let mut model = lite();
        model.pillars.points = 0;
        model.rotations.clear();
        let error = model.validate().unwrap_err().to_string();
        assert!(
            error.contains("pillars.points") && error.contains("rotations"),
            "{error}"
        );
    }

    #[test]
    fn refuses_files_that_are_no_models() {
        let dir = tempfile::tempdir().unwrap();
        let read = |text: String| {
            let path = dir.path().join("m.toml");
            std::fs::write(&path, text).unwrap();
            Model::read(&path).unwrap_err().to_string()
        };
        assert!(
            Model::read(&dir.path().join("none.toml"))
                .unwrap_err()
                .to_string()
                .contains("none.toml")
        );
        assert!(read("name = 3".into()).contains("m.toml"));
        assert!(read(LITE.replace("cell =", "cel =")).contains("unknown field `cel`"));
        assert!(read(LITE.replace("\"body\"", "\"map\"")).contains("unknown variant `map`"));
        assert!(read(LITE.replace("points = 32\n", "")).contains("missing field `points`"));
        assert!(read(LITE.replace("points = 32\n", "points = -1\n")).contains("invalid value"));
        assert!(read(LITE.replace("kernel = 1", "kernel = 2")).contains("expected 1 or 3, found 2"));
        let long = read(format!("{LITE}#{}", " ".repeat(MOST_BYTES as usize)));
        assert!(long.contains("m.toml: expected at most 1048576 bytes"), "{long}");
        let of = |arch: &str| LITE.replace("[grid]", &format!("[arch]\n{arch}\n\n[grid]"));
        assert!(read(of("kind = \"dream\"")).contains("unknown variant `dream`, expected one of `pointpillars`"));
        assert!(read(of("kind = \"pointpillars\"\nratio = 3")).contains("unknown field `ratio`"));
        let path = dir.path().join("m.toml");
        std::fs::write(&path, of("kind = \"pointpillars\"")).unwrap();
        assert_eq!(Model::read(&path).unwrap(), lite());
    }

    #[test]
    fn the_height_of_a_lidar_belongs_to_its_frame() {
        let with = |frame: &str, height: &str| {
            let text = LITE.replace(
                "frame = \"body\"",
                &format!("frame = \"{frame}\"\nlidar_height = {height}"),
            );
            Model::parse(text.as_bytes(), Path::new("m.toml"))
        };
        let model = with("lidar", "1.9").unwrap();
        assert_eq!(model.height(), 1.9);
        model.check_frame(Path::new("m.toml")).unwrap();
        for (frame, height, expected) in [
            ("body", "1.9", "only with frame = \"lidar\""),
            ("lidar", "-1.0", "expected 0 to 100 m, found -1"),
            ("lidar", "nan", "expected 0 to 100 m"),
        ] {
            let error = with(frame, height).unwrap_err().to_string();
            assert!(error.contains(expected), "{error}");
        }
        let none = LITE.replace("frame = \"body\"", "frame = \"lidar\"");
        let none = Model::parse(none.as_bytes(), Path::new("m.toml")).unwrap();
        let error = none.check_frame(Path::new("m.toml")).unwrap_err().to_string();
        assert!(error.starts_with("m.toml: `lidar_height`: expected metres"), "{error}");
    }
}
