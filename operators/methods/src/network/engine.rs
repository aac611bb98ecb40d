//! Parts of a network that are ready to run, in the numbers of a choice.

use std::collections::BTreeMap;
use std::sync::Arc;

use realo_kernels::conv::{Bf16, Isa, U8};
use realo_nn::layers::{Layers, MapId};
use realo_nn::model::Precision;
use realo_nn::weights::Weights;

use super::part::{Outcome, Part, Runner, Running};

/// A part that is ready to run, without its maps.
pub(super) enum Engine {
    Single(Arc<Part<f32>>),
    Half(Arc<Part<Bf16>>),
    Bytes(Arc<Part<U8>>),
}

/// What parts are made of.
pub(super) struct Parts<'a> {
    pub layers: &'a Layers,
    pub weights: &'a Weights,
    pub isa: Isa,
    pub activations: &'a BTreeMap<String, f32>,
}

impl Parts<'_> {
    pub fn engine(&self, precision: Precision, ends: [MapId; 2], outcome: Outcome) -> Engine {
        let Parts {
            layers, weights, isa, ..
        } = *self;
        let one = |_| 1.0;
        match precision {
            Precision::F32 => Engine::Single(Arc::new(Part::new(layers, weights, isa, ends, outcome, one))),
            Precision::Bf16 => Engine::Half(Arc::new(Part::new(layers, weights, isa, ends, outcome, one))),
            Precision::Int8 => {
                let step_of = |map| self.byte_step(map);
                // The last map leaves as f32, which loses nothing more.
                Engine::Bytes(Arc::new(Part::new(
                    layers,
                    weights,
                    isa,
                    ends,
                    Outcome::Single,
                    step_of,
                )))
            }
        }
    }

    /// What 1 stands for where a map is kept in bytes.
    fn byte_step(&self, map: MapId) -> f32 {
        let members = self.layers.members(map).into_iter();
        let max = members.filter_map(|map| self.activations.get(&self.layers.key(map)));
        max.fold(0.0, |a, b| f32::max(a, *b)) / 255.0
    }
}

impl Engine {
    pub fn running(&self) -> Box<dyn Runner> {
        match self {
            Engine::Single(part) => Box::new(Running::new(Arc::clone(part))),
            Engine::Half(part) => Box::new(Running::new(Arc::clone(part))),
            Engine::Bytes(part) => Box::new(Running::new(Arc::clone(part))),
        }
    }
}
