//! Networks on candle's tensors, on any of its devices: what the kernels are held against, and the way to a GPU.
//!
//! A [`Network`] computes what the model's list of layers says, from the canvas on; the pillar layer stays with
//! [`Pillarer`](crate::Pillarer). An [`Engine`] is a network between maps on the host, as operators run it; a [`Copier`] brings
//! them there.

mod convolution;
mod copier;
mod engine;
mod network;

pub use copier::{Copied, Copier, Elements, Taken};
pub use engine::{Engine, Watch};
pub use network::{Error, Network};
