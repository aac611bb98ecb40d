//! The car's program: it hosts every shipped operator and node, and prepares, starts and checks runs.
//!
//! One file for each subcommand. Perception happens in the graph's stages, never here; what makes logs, weights and
//! measurements is `realo-lab`.

mod command;
pub mod compare;
pub mod demo;
mod doctor;
pub mod evaluate;
mod fit;
pub mod graph;
pub mod host;
pub mod info;
mod keys;
mod latency;
mod map;
pub mod merge;
mod new;
pub mod operators;
#[cfg(test)]
mod paper_tests;
pub mod precompute;
mod registry;
pub mod render;
pub mod report;
mod roles;
pub mod run;
mod stages;
pub mod sweep;
mod tables;
mod truth_reader;
pub mod validate;

pub use command::{command_line, main_with};
pub use realo_cli::Outcome;
pub use registry::registry;
