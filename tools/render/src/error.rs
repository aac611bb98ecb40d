use std::path::PathBuf;

use realo_logs::LogError;
use realo_results::FilesError;
use realo_schemas::UnexpectedPayload;
use realo_scoring::{EvaluationError, ProtocolError};

/// Why there is no picture.
#[derive(Debug, thiserror::Error)]
pub enum RenderError {
    /// The folder of the run.
    #[error(transparent)]
    Run(#[from] FilesError),
    /// A log or a recording.
    #[error(transparent)]
    Log(#[from] LogError),
    /// A message of the recording that is not what its topic says.
    #[error(transparent)]
    Message(#[from] UnexpectedPayload),
    /// Boxes and truth that cannot be compared.
    #[error(transparent)]
    Evaluation(#[from] EvaluationError),
    /// The protocol of the log.
    #[error(transparent)]
    Protocol(#[from] ProtocolError),
    /// A run that recorded nothing.
    #[error(
        "{}: expected the recording of a run, found none; {mend}",
        .file.display()
    )]
    NoRecording {
        /// Where it should be.
        file: PathBuf,
        /// The next thing to try.
        mend: &'static str,
    },
    /// No frame answers the question.
    #[error("{}: no {asked}; there are: {there}", .run.display())]
    NoFrame {
        /// The folder of the run.
        run: PathBuf,
        /// What was asked for.
        asked: String,
        /// What there is.
        there: String,
    },
    /// Runs that were seen by different vehicles.
    #[error("no ego is in all runs ({there}): draw them one by one")]
    NoCommonEgo {
        /// The egos of each.
        there: String,
    },
    /// The log is not where logs usually are.
    #[error("the log `{name}` of this run is not here (looked for {tried}); say where it is with --log")]
    NoLog {
        /// Its name.
        name: String,
        /// The paths.
        tried: String,
    },
    /// A log of another run.
    #[error(
        "{}: expected the log `{name}` of this run, but {reason}; give the log that was played with --log",
        .log.display()
    )]
    OtherLog {
        /// The log.
        log: PathBuf,
        /// The name that the run knows.
        name: String,
        /// What differs.
        reason: String,
    },
    /// A file that is neither a drawing nor pixels.
    #[error("{}: expected a file name that ends in .svg or .png, found {found}", .file.display())]
    Ending {
        /// The file.
        file: PathBuf,
        /// Its ending.
        found: String,
    },
    /// The system refuses.
    #[error("{}: cannot be written: {reason}; choose another place with -o", .file.display())]
    Write {
        /// The file.
        file: PathBuf,
        /// Why.
        reason: std::io::Error,
    },
}
