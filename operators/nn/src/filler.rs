//! Weights that nobody has trained, for tests and measurements: layers keep the size of what passes through them.

use std::collections::HashMap;

use crate::layers::Layers;
use crate::model::{Architecture, Model};
use crate::tensors::{Role, TensorSpec};
use crate::weights::{Tensor, Weights};

/// Numbers from -1 to 1 that depend on the seed alone.
pub struct Numbers(u64);

impl Numbers {
    /// Those of a seed.
    pub fn new(seed: u64) -> Self {
        Numbers(seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1)
    }

    /// The next one.
    pub fn draw(&mut self) -> f32 {
        self.0 = self
            .0
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 40) as f32 / (1u64 << 23) as f32 - 1.0
    }

    /// So many.
    pub fn list(&mut self, length: usize) -> Vec<f32> {
        (0..length).map(|_| self.draw()).collect()
    }
}

/// Weights of a model.
///
/// # Panics
/// If the model does not fit together.
pub fn weights<A: Architecture>(model: &Model<A>, seed: u64) -> Weights {
    Weights::new(model, tensors(&Layers::of(model), seed)).expect("tensors of the model's own layers")
}

/// Tensors of layers.
pub fn tensors(layers: &Layers, seed: u64) -> HashMap<String, Tensor> {
    let mut numbers = Numbers::new(seed);
    let tensor = |spec: TensorSpec| {
        let mut data = numbers.list(spec.count());
        for value in &mut data {
            match spec.role {
                Role::NormWeight | Role::RunningVariance => *value = 1.0 + 0.5 * *value,
                Role::Bias | Role::NormBias | Role::RunningMean => *value *= 0.1,
                Role::Delays => *value *= (6.0 / spec.shape[1] as f32).sqrt(),
                Role::Weight { fan_in } => *value *= (6.0 / fan_in as f32).sqrt(),
            }
        }
        let shape = spec.shape;
        (spec.key, Tensor { shape, data })
    };
    layers.tensors().map(tensor).collect()
}
