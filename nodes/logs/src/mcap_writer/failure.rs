//! Why a file could not be written.

use std::path::Path;

use crate::LogError;

/// Why writing stopped.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Failure {
    /// Length of the readable part, bytes.
    pub written: u64,
    /// What the system said.
    pub reason: String,
}

impl Failure {
    /// The failure to write a file, as an error of this crate.
    pub fn of(self, path: &Path) -> LogError {
        LogError::Write {
            path: path.into(),
            written: self.written,
            reason: self.reason,
        }
    }

    /// The failure to write a file that appears only when it is complete.
    pub fn of_unfinished(self, target: &Path) -> LogError {
        LogError::Unfinished {
            path: target.into(),
            written: self.written,
            reason: self.reason,
        }
    }
}
