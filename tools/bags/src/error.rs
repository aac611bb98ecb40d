use std::io;
use std::path::{Path, PathBuf};

use realo_logs::LogError;

/// Why a bag, or a file that says how to read it, cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum BagError {
    /// A file that is not there or cannot be read.
    #[error("cannot read `{}`: {reason}", .path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        reason: io::Error,
    },
    /// A file that does not hold what it must.
    #[error("`{}`: {reason}", .path.display())]
    Content {
        /// The file.
        path: PathBuf,
        /// Field, expected and found, and what to try.
        reason: String,
    },
    /// An MCAP file.
    #[error(transparent)]
    Mcap(#[from] LogError),
}

impl BagError {
    pub(crate) fn io(path: &Path) -> impl FnOnce(io::Error) -> BagError {
        let path = path.to_path_buf();
        move |reason| BagError::Io { path, reason }
    }

    pub(crate) fn content(path: &Path, reason: impl ToString) -> BagError {
        BagError::Content {
            path: path.into(),
            reason: reason.to_string(),
        }
    }
}
