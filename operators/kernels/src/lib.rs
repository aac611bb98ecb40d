//! What computes: convolutions and the threads that share them, warps of maps, functions that are the same on every processor.
//! Nothing here knows a model, a layer's name or a method.

// Tests may compare with the system's functions.
#![cfg_attr(test, allow(clippy::disallowed_methods))]

pub mod agents;
pub mod bev;
pub mod by_cell;
pub mod canvas;
pub mod cells;
pub mod conv;
pub mod math;
pub mod number;
pub mod simd;
pub mod warp;
