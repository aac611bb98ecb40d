//! What the commands of `realo` and `realo-lab` share.
//!
//! No command is here, and nothing of perception.

pub mod campaign;
mod choice;
pub mod demo;
pub mod find;
mod left_out;
mod machine;
mod output;
pub mod paper;
pub mod program;
mod progress;
mod reference;
pub mod signals;
pub mod unfinished;

pub use choice::one_of;
pub use left_out::report_left_out;
pub use machine::cpu;
pub use output::{Force, Output, expect_ending, write_whole};
pub use progress::Progress;
pub use reference::{HEAD, markdown};

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
