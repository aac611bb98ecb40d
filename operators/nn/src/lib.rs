//! What the networks compute besides their layers, as V2X-Real does: [`anchors`] and [`points`].

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
