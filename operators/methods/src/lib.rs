//! Methods of fusion, a folder each, and the networks that run with them.
//!
//! A method is how the maps of several agents become one. Its folder holds all of it: settings and what they must fit, tensors,
//! the kernel, the operation on candle's tensors that gradients lead back through, and what training begins with. It
//! implements [`Method`] on its settings, and is known by its line in [`METHODS`].
//!
//! [`network`] runs a model on this processor, `candle` on candle's devices.

// Tests may compare with the system's functions.
#![cfg_attr(test, allow(clippy::disallowed_methods))]

mod arch;
pub mod attfuse;
#[cfg(feature = "candle")]
pub mod candle;
pub mod detect;
pub mod fcooper;
pub mod full;
pub mod method;
pub mod network;
#[cfg(feature = "candle")]
pub mod tensors;
pub mod v2vnet;
pub mod v2xvit;

#[cfg(test)]
mod by_cell_tests;
#[cfg(test)]
#[allow(dead_code, reason = "another crate's tests share it")]
#[path = "../../nn/src/testing.rs"]
mod testing;
#[cfg(test)]
#[allow(dead_code, reason = "another crate's tests share it")]
#[path = "../../nn/src/vectors.rs"]
mod vectors;

pub use arch::{AnyMethod, Arch, Entry, METHODS, Model, add, methods};
pub use method::Method;
pub use network::{AUTO, Kernels, LoadError, Loaded, Pillarer, load};

// What the tests that crates share know by these names.
#[cfg(test)]
use realo_nn::{filler, layers, model, weights};
