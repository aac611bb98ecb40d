//! Differentiable layers on the CPU, each a candle custom operation. Maps are
//! `[batch, rows + 2, columns + 2, channels]` f32 with a border of one zero cell, so that no kernel tests for edges.
//!
//! Work is cut by shape alone and partial sums are added in a fixed order: the bits do not depend on the number of
//! threads of rayon's current pool.

mod bias;
mod conv;
mod join;
mod map;
mod norm;
mod pillars;
mod pointwise;
mod product;
#[cfg(test)]
mod tests;

pub use bias::Bias;
pub use conv::Conv;
pub use join::{join, split};
pub(crate) use map::{MapShape, buffer, tensor, with_numbers};
pub use norm::{Moments, Norm, Statistics};
pub use pillars::{PillarBatch, PillarFrame, PillarLayer};
pub use pointwise::{Pointwise, WeightOrder};
pub use product::{Arithmetic, UnknownArithmetic};
