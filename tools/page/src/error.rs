use std::path::PathBuf;

use realo_logs::LogError;
use realo_render::RenderError;
use realo_results::FilesError;
use realo_schemas::UnexpectedPayload;
use realo_scoring::{EvaluationError, ProtocolError};

/// Why there is no page.
#[derive(Debug, thiserror::Error)]
pub enum PageError {
    /// The folder of a run.
    #[error(transparent)]
    Run(#[from] FilesError),
    /// Its recordings, or the log.
    #[error(transparent)]
    Render(#[from] RenderError),
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
    /// Runs over one log that were scored by different rules.
    #[error(transparent)]
    Protocols(Box<DifferentProtocols>),
    /// A recording that is not of the run beside whose results it lies.
    #[error(transparent)]
    OtherRecording(Box<OtherRecording>),
    /// None of several runs can be shown.
    #[error("none of {} runs can be shown:\n{}", .0.len(), .0.join("\n"))]
    NoRun(Vec<String>),
    /// More than a page may hold, though no sweep is left in the player.
    #[error(
        "the tables and charts of {runs} runs take {bytes} bytes, a page may have {most}; name fewer runs, or play the logs of a \
         graph in one command, which makes one run of them (`realo run GRAPH --log A.mcap --log B.mcap`)"
    )]
    TooLarge {
        /// How many runs.
        runs: usize,
        /// Their size.
        bytes: usize,
        /// The limit.
        most: usize,
    },
    /// The document cannot be written.
    #[error("the document of the page cannot be written: {0}")]
    Json(#[from] serde_json::Error),
}

/// Two runs over one log with one ego that were scored by different rules.
#[derive(Debug, thiserror::Error)]
#[error(
    "{first} was scored by the protocol `{first_protocol}`, {second} by `{second_protocol}`, both over the log `{log}` with \
     the ego `{ego}`; expected one protocol; make a report for each"
)]
pub struct DifferentProtocols {
    /// The first run.
    pub first: String,
    /// Its protocol.
    pub first_protocol: String,
    /// The other run.
    pub second: String,
    /// Its protocol.
    pub second_protocol: String,
    /// The log of both.
    pub log: String,
    /// The ego of both.
    pub ego: String,
}

/// A recording whose boxes are not those that the results beside it count.
#[derive(Debug, thiserror::Error)]
#[error(
    "{recording}: it is of another run: at sweep {seq} of `{ego}` the results beside it (`evaluation.json`) expect {expected}, \
     found {found}; put this run's own recording there, or run it again"
)]
pub struct OtherRecording {
    /// The recording.
    pub recording: PathBuf,
    /// The ego.
    pub ego: String,
    /// Number of the first sweep that differs.
    pub seq: u64,
    /// What the results have of it.
    pub expected: String,
    /// What the recording has of it.
    pub found: String,
}
