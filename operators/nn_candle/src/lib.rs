//! The networks on candle's tensors, on any of its devices: what the kernels of `realo_nn` are held against, what training
//! leads gradients back through, and the way to a GPU.
//!
//! A [`Network`] computes what the model's list of layers says, from the canvas on; the pillar layer stays with
//! [`realo_nn::Pillarer`]. Every fusion is a function of [`Tensors`], the weights by their keys, so that variables of a
//! training can stand in for them. An [`Engine`] is a network between maps on the host, as operators run it; a [`Copier`] brings
//! them there.

mod cells;
mod convolution;
mod copier;
mod engine;
mod messages;
mod network;
mod ops;
mod tensors;
pub mod transformer;
mod warp;

pub use copier::{Copied, Copier, Taken};
pub use engine::Engine;
pub use network::{Agent, Error, Network};
pub use tensors::Tensors;
pub use warp::Placed;
