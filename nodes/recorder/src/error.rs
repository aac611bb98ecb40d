use std::path::PathBuf;

use realo_schemas::{Header, Name};

/// Why a recorder could not go on.
#[derive(Debug, thiserror::Error)]
pub enum RecorderError {
    /// The recording is closed.
    #[error("a message after the recording was finished")]
    Finished,
    /// The log is closed.
    #[error("a message after the log was finished")]
    LogFinished,
    /// The log's folder cannot be made.
    #[error("setting `path`: {}: {}", .0.display(), .1)]
    Folder(PathBuf, #[source] std::io::Error),
    /// A report that no log has.
    #[error("a log takes no report of topic `{0}` ({1})")]
    Topic(Name, Box<Header>),
    /// A place on the Earth that is none.
    #[error("setting `like`: {}: `map_origin`: {}", .0.display(), .1)]
    Origin(PathBuf, String),
    /// Positions of a receiver in a map that is nowhere.
    #[error(
        "positions of a satellite receiver ({0}), and no place of the map on the Earth; name a log whose record has `map_origin` in `like`"
    )]
    NoOrigin(Box<Header>),
}
