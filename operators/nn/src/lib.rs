//! What a network is: its model file, grid and anchors, its list of layers, its weights, and how heads become detections.
//!
//! A network is described once, as a list of layers ([`layers::Layers`]): which tensors a layer has, which maps it reads,
//! which one it makes. The names and shapes that a file of weights must have, the plan of inference, the plan of training
//! and the sizes of maps are all read from that list; nothing else knows an order of layers.
//!
//! Nothing here computes a network or knows a method of fusion: a [`model::Model`] is one of any
//! [`model::Architecture`].

// Tests may compare with the system's functions.
#![cfg_attr(test, allow(clippy::disallowed_methods))]

pub mod anchors;
pub mod bounded;
pub mod decode;
pub mod filler;
pub mod layers;
pub mod model;
pub mod tensors;
#[cfg(test)]
#[allow(dead_code, reason = "another crate's tests share it")]
mod testing;
#[cfg(test)]
mod vectors;
pub mod weights;

/// The model of tests: of a single agent.
#[cfg(test)]
type Model = model::Model<Alone>;

/// Agents share no maps.
#[cfg(test)]
#[derive(Clone, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize)]
struct Alone {}

#[cfg(test)]
impl model::Architecture for Alone {
    fn sharing(&self) -> Option<model::Sharing> {
        None
    }

    fn check(&self, _: layers::MapSize, _: &mut model::Problems) {}

    fn tensors(&self, _: usize) -> Vec<tensors::TensorSpec> {
        Vec::new()
    }
}
