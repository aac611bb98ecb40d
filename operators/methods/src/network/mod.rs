//! The network from the canvas of pillars to the heads: backbone, shrink layers, heads, batch norm folded in.
//!
//! `encode` and `heads` split it at the BEV map, where agents share features; between them `fuse` makes one map of those of
//! several agents. `forward` runs a single agent's.

pub mod calibration;
mod checks;
mod core;
mod engine;
mod error;
mod heads;
mod load;
mod options;
mod part;
mod pillarer;
mod running;
mod section;

pub use checks::{check_agents, check_confidence, check_map, check_size};
pub use error::NetworkError;
pub use heads::Heads;
pub use load::{AUTO, Kernels, LoadError, Loaded, load};
pub use options::{Choice, NetworkOptions};
pub use pillarer::Pillarer;
pub use running::Network;
pub use section::Section;

#[cfg(test)]
mod byte_tests;
#[cfg(test)]
mod fusion_tests;
#[cfg(test)]
mod tests;
