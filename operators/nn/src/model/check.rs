//! Whether a model fits together.

use std::collections::BTreeSet;
use std::ops::RangeInclusive;

use super::architecture::Architecture;
use super::detector;
use super::error::ModelError;
use super::precision::Precision;
use super::problems::Problems;
use super::settings::{Backbone, Frame, Grid, Model};
use crate::layers::Layers;

// Bounds that keep a damaged file from asking for all memory; real networks stay far below.
const MOST_CHANNELS: usize = 4096;
const MOST_CELLS: usize = 1 << 24;
const MOST_NUMBERS: usize = 1 << 28;
/// Results of layers beyond which nothing sensible was calibrated.
const ACTIVATIONS: RangeInclusive<f32> = 1e-6..=1e6;
/// Products of 255 steps and a weight of 64 that 32 bits hold.
const MOST_BYTE_PRODUCTS: usize = i32::MAX as usize / (255 * 64);

/// No LiDAR of an agent stands higher above its ground, m.
const HIGHEST: f64 = 100.0;

impl<A: Architecture> Model<A> {
    /// Whether the parts fit together.
    ///
    /// # Errors
    /// [`ModelError::Invalid`] with everything that does not.
    pub fn validate(&self) -> Result<(), ModelError> {
        let mut problems = Problems::default();
        self.check_names(&mut problems);
        self.check_height(&mut problems);
        self.check_anchors(&mut problems);
        self.check_pillars(&mut problems);
        let grid_fits = self.check_grid(&mut problems);
        if self.check_backbone(&mut problems) && grid_fits {
            detector::check(self, &mut problems);
        }
        if problems.0.is_empty() {
            let numbers = Layers::of(self).numbers();
            problems.require(numbers <= MOST_NUMBERS, || {
                format!("grid, pillars, backbone, shrink, refine: expected maps of at most {MOST_NUMBERS} numbers in all, found {numbers}")
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
            ("compressor", self.compressor.as_ref()),
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
        let compresses = self.arch.sharing().is_some_and(|sharing| sharing.compression != 0);
        problems.require(self.compressor.is_none() || compresses, || {
            "compressor: expected only with an arch.compression above 0, found none".into()
        });
        for (key, name) in [("encoder", &self.encoder), ("compressor", &self.compressor)] {
            problems.require(name.as_deref() != Some(own), || {
                format!("{key}: expected another file than the model's own weights, found `{own}`")
            });
        }
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
                "activations: expected the max result of layer `{key}`, which int8 needs, found none; `realo-lab quantize` finds it"
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
        for (name, layers) in [("shrink", &self.shrink), ("refine", &self.refine)] {
            problems.within(&format!("{name} (how many)"), layers.len(), 0, 8);
            for (index, layer) in layers.iter().enumerate() {
                problems.within(&format!("{name}[{index}].channels"), layer.channels, 1, MOST_CHANNELS);
                problems.require([1, 3].contains(&layer.kernel), || {
                    format!("{name}[{index}].kernel: expected 1 or 3, found {}", layer.kernel)
                });
            }
        }
        problems.0.len() == before
    }
}
