//! What training aims at: the targets of anchors, and the loss of heads against them.

// Tests may compare with the system's functions.
#![cfg_attr(test, allow(clippy::disallowed_methods))]

pub mod loss;
pub mod targets;
#[cfg(test)]
#[allow(dead_code, reason = "another crate's tests share it")]
#[path = "../../../operators/nn/src/vectors.rs"]
mod vectors;
