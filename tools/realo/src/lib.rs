//! The one binary of realo: it hosts every shipped operator and node, and prepares, starts and checks runs.
//!
//! One file for each subcommand. Perception happens in the graph's stages, never here.

pub mod bench;
pub mod checkpoint;
mod command;
pub mod compare;
pub mod conformance;
pub mod demo;
mod doctor;
mod emulate;
pub mod evaluate;
mod fit;
pub mod host;
pub mod import;
pub mod info;
mod keys;
mod latency;
pub mod merge;
mod new;
pub mod operators;
mod output;
pub mod paper;
pub mod precompute;
mod progress;
mod quantize;
mod registry;
pub mod render;
mod roles;
pub mod run;
pub mod simulate;
mod stages;
mod statistics;
mod tables;
pub mod train;
mod truth_reader;
mod unfinished;
pub mod validate;

pub use command::main_with;
pub use registry::registry;

/// How a command ended, beyond success and failure.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Outcome {
    /// All is well.
    Complete,
    /// Something failed, and was reported.
    Failed,
    /// Done as far as possible; the rest was reported.
    Partial,
    /// A signal ended it: its number.
    Ended(u8),
}

impl Outcome {
    /// 0, 1 or 3; 128 and the number of a signal.
    pub fn exit_code(self) -> u8 {
        match self {
            Outcome::Complete => 0,
            Outcome::Failed => 1,
            Outcome::Partial => 3,
            Outcome::Ended(signal) => 128 + signal,
        }
    }
}
