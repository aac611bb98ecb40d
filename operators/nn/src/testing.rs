//! Models and weights for tests.

use std::collections::HashMap;
use std::path::Path;

use safetensors::Dtype;
use safetensors::tensor::TensorView;

use crate::Model;
#[allow(unused_imports)]
pub use crate::filler::Numbers;
pub(crate) use crate::filler::tensors as random_tensors_of;
use crate::layers::Layers;
use crate::model::{Backbone, Frame, Grid, Precision, Shrink};
use crate::weights::Tensor;

/// The model that ships.
pub fn lite() -> Model {
    let model: Model = toml::from_str(include_str!("../../../models/lite.toml")).unwrap();
    // Tests have weights of their own.
    Model {
        sha256: Default::default(),
        ..model
    }
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

/// Tensors of a model.
pub fn random_tensors(model: &Model, seed: u64) -> HashMap<String, Tensor> {
    random_tensors_of(&Layers::of(model), seed)
}

/// Writes a model file with the weights of a seed beside it.
pub fn write(folder: &Path, model: &Model, seed: u64) {
    let path = folder.join(format!("{}.toml", model.name));
    std::fs::write(&path, toml::to_string(model).unwrap()).unwrap();
    std::fs::write(&model.weights_beside(&path)[0], file_of(model, seed)).unwrap();
}

/// A file of the weights of a seed.
pub fn file_of(model: &Model, seed: u64) -> Vec<u8> {
    let tensors = random_tensors(model, seed);
    let bytes = |tensor: &Tensor| {
        tensor
            .data
            .iter()
            .flat_map(|value| value.to_le_bytes())
            .collect::<Vec<u8>>()
    };
    let all: Vec<_> = tensors
        .iter()
        .map(|(key, tensor)| (key, &tensor.shape, bytes(tensor)))
        .collect();
    let views = all
        .iter()
        .map(|(key, shape, bytes)| (key, TensorView::new(Dtype::F32, shape.to_vec(), bytes).unwrap()));
    safetensors::serialize(views, None).unwrap()
}

/// The grid of a vector's `range`, with cells of 0.4 m.
pub fn grid_of(vector: &crate::vectors::Vector) -> Grid {
    let [x0, y0, z0, x1, y1, z1] = vector.list("range");
    Grid {
        x: [x0, x1],
        y: [y0, y1],
        z: [z0, z1],
        cell: 0.4,
    }
}
