//! Where a file that was cut ends.

use realo_schemas::{Nanos, to_seconds};
use serde::Serialize;

/// Where a cut file ends.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Truncation {
    /// Length of the readable part, bytes.
    pub at_byte: u64,
    /// Length of the file.
    pub file_bytes: u64,
    /// What follows the readable part.
    pub reason: String,
    /// Log time before which no message is missing, ns; `None` if none is left.
    pub complete_until: Option<Nanos>,
    /// When the log was to end, where it says so, ns.
    pub expected_end: Option<Nanos>,
}

impl std::fmt::Display for Truncation {
    fn fmt(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
        write!(
            f,
            "cut at byte {} of {} ({})",
            self.at_byte, self.file_bytes, self.reason
        )?;
        match (self.complete_until, self.expected_end) {
            (Some(until), Some(end)) => {
                let missing = to_seconds(end.saturating_sub(until)).max(0.0);
                write!(f, "; the last {missing:.3} s are missing")
            }
            (Some(until), None) => write!(f, "; from {:.3} s on messages are missing", to_seconds(until)),
            (None, _) => write!(f, "; no message is left"),
        }
    }
}
