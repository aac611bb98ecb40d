//! The networks: model files and weights, pillars, convolutions, anchors, targets, loss and decoding.

pub mod anchors;
pub mod arch;
pub mod canvas;
pub mod conv;
pub mod decode;
mod encoder;
pub mod layers;
mod load;
pub mod loss;
pub mod model;
pub mod network;
mod part;
pub mod pillar_net;
pub mod pillars;
mod simd;
pub mod targets;
#[cfg(test)]
mod testing;
#[cfg(test)]
mod vectors;
pub mod weights;
pub use encoder::{Encoder, Pillarer};
pub use load::{LoadError, Loaded, ReadError, load};
