//! The networks: model files and weights, pillars, convolutions, anchors, targets, loss and decoding.

pub mod anchors;
pub mod canvas;
pub mod conv;
pub mod decode;
mod load;
pub mod loss;
pub mod model;
pub mod network;
pub mod pillar_net;
pub mod pillars;
pub mod points;
mod simd;
pub mod targets;
#[cfg(test)]
mod testing;
#[cfg(test)]
mod vectors;
pub mod weights;
pub use load::{LoadError, Loaded, load};
