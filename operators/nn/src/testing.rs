//! Models and weights for tests.

use std::collections::HashMap;
use std::io::Write;
use std::path::PathBuf;

use crate::model::{Backbone, Frame, Grid, Model, Precision, Shrink};
use crate::weights::{Tensor, expected};

/// The model that ships.
pub fn lite() -> Model {
    toml::from_str(include_str!("../../../models/lite.toml")).unwrap()
}

/// V2X-Real's network at full size, with shrink layers of (kernel, channels).
pub fn full(shrink: &[(usize, usize)]) -> Model {
    let mut model = lite();
    model.pillars.channels = 64;
    model.frame = Frame::Lidar;
    model.backbone = Backbone {
        layers: vec![3, 5, 8],
        strides: vec![2, 2, 2],
        channels: vec![64, 128, 256],
        up_strides: vec![1, 2, 4],
        up_channels: vec![128, 128, 128],
    };
    model.shrink = shrink
        .iter()
        .map(|(kernel, channels)| Shrink {
            kernel: *kernel,
            channels: *channels,
        })
        .collect();
    model
}

/// A small network on a map of `rows` x `columns` pillars, with odd channel counts if `odd`.
pub fn small(rows: usize, columns: usize, odd: bool) -> Model {
    let mut model = lite();
    let odd = usize::from(odd);
    model.precision = Precision::F32;
    model.grid = Grid {
        x: [0.0, columns as f64],
        y: [0.0, rows as f64],
        z: [-3.0, 5.0],
        cell: 1.0,
    };
    model.pillars.channels = 6 + odd;
    model.backbone = Backbone {
        layers: vec![1, 2],
        strides: vec![2, 2],
        channels: vec![8 + odd, 20 + odd],
        up_strides: vec![1, 2],
        up_channels: vec![4 + odd, 10],
    };
    model.shrink = vec![
        Shrink {
            kernel: 3,
            channels: 18 + odd,
        },
        Shrink {
            kernel: 1,
            channels: 34 + odd,
        },
    ];
    model
}

/// Numbers from -1 to 1 that depend on the seed alone.
pub struct Numbers(u64);

impl Numbers {
    pub fn new(seed: u64) -> Self {
        Numbers(seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1)
    }

    pub fn next(&mut self) -> f32 {
        self.0 = self
            .0
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 40) as f32 / (1u64 << 23) as f32 - 1.0
    }

    pub fn list(&mut self, length: usize) -> Vec<f32> {
        (0..length).map(|_| self.next()).collect()
    }
}

/// Tensors of a model; layers keep the size of what passes through them.
pub fn random_tensors(model: &Model, seed: u64) -> HashMap<String, Tensor> {
    let mut numbers = Numbers::new(seed);
    let tensor = |(key, shape): (String, Vec<usize>)| {
        let count: usize = shape.iter().product();
        let mut data = numbers.list(count);
        let inputs = if key.contains(".deblocks.") {
            shape[0]
        } else {
            count / shape[0]
        };
        let scale = (6.0 / inputs as f32).sqrt();
        for value in &mut data {
            match shape.len() {
                1 if key.ends_with("running_var") || key.ends_with("weight") => *value = 1.0 + 0.5 * *value,
                1 => *value *= 0.1,
                _ => *value *= scale,
            }
        }
        (key, Tensor { shape, data })
    };
    expected(model).into_iter().map(tensor).collect()
}

/// The folder of shared vectors; says loudly that a test is skipped where it is not at hand.
pub fn shared() -> Option<PathBuf> {
    let folder = std::env::var_os("REALO_SHARED").map(PathBuf::from);
    if folder.is_none() {
        // Past the capture of test output, so that nobody misses it.
        let _ = writeln!(
            std::io::stderr(),
            "SKIPPED: set REALO_SHARED to the folder that holds `conformance` to run this test"
        );
    }
    folder
}
