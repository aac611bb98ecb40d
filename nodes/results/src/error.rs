use std::path::PathBuf;

use realo_schemas::{Header, Name};

/// Why results are not taken.
#[derive(Debug, thiserror::Error)]
pub enum ResultsError {
    /// The run's settings cannot be read.
    #[error("setting `run_settings`: {}: {error}", .file.display())]
    RunFile {
        /// Their file.
        file: PathBuf,
        /// What the system says.
        #[source]
        error: std::io::Error,
    },
    /// The run's settings are something else.
    #[error("setting `run_settings`: {}: expected the settings that `realo run` writes: {error}; run it again by `realo run`", .file.display())]
    RunSettings {
        /// Their file.
        file: PathBuf,
        /// What does not fit.
        #[source]
        error: serde_json::Error,
    },
    /// A report of something else.
    #[error("expected a report of topic `{expected}`, found `{found}` ({header})")]
    Topic {
        /// What comes on the port.
        expected: &'static str,
        /// What came.
        found: Name,
        /// With which header.
        header: Box<Header>,
    },
    /// Two evaluators.
    #[error("a second report of topic `evaluation`; a graph has one evaluator")]
    SecondEvaluation,
}
