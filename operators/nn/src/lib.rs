//! The networks: model files and weights, pillars, convolutions, anchors, targets, loss and decoding.
//!
//! # Architectures
//!
//! A network is described once, as a list of layers ([`layers::Layers`]): which tensors a layer has, which maps it reads,
//! which one it makes. The names and shapes that a file of weights must have, the plan of inference, the plan of training
//! and the sizes of maps are all read from that list; nothing else knows an order of layers.
//!
//! Another architecture needs
//! - a file `arch/<name>.rs` that puts its layers together, out of those of `arch/pointpillars.rs` where it shares them,
//!   checks what does not fit, and holds the settings that only it has;
//! - its variant of [`arch::Arch`] in `arch/mod.rs`, which makes it a model's `[arch]`;
//! - if it computes what no layer here does: a variant of [`layers::Layer`] with its tensors, its kernel in `part.rs` and,
//!   if it is to be trained, its operation in `tools/training/src/network.rs`. The compiler names these places;
//! - if it fuses in a way of its own: a variant of [`layers::Fusion`] with its tensors, and a file with its kernel, as
//!   `fuse.rs` (cell by cell), `transformer/` and `messages.rs` are.
//!
//! Weights, loading, the operators, training's loop and checkpoints stay as they are.

// Tests may compare with the system's functions.
#![cfg_attr(test, allow(clippy::disallowed_methods))]

pub mod anchors;
pub mod arch;
pub mod calibration;
pub mod canvas;
mod cells;
pub mod conv;
pub mod decode;
pub mod filler;
pub mod full;
pub mod fuse;
pub mod layers;
mod load;
pub mod loss;
mod math;
pub mod messages;
pub mod model;
pub mod network;
mod part;
pub mod pillar_net;
mod pillarer;
pub mod pillars;
mod simd;
pub mod targets;
#[cfg(test)]
mod testing;
pub mod transformer;
#[cfg(test)]
mod vectors;
pub mod weights;
pub use load::{AUTO, Kernels, LoadError, Loaded, ReadError, load};
pub use pillarer::Pillarer;
