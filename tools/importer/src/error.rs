use std::io;
use std::path::{Path, PathBuf};

use realo_logs::LogError;

/// Why a dataset could not be imported.
#[derive(Debug, thiserror::Error)]
pub enum ImportError {
    /// A file that is not there or cannot be read.
    #[error("cannot read `{}`: {reason}", .path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        reason: io::Error,
    },
    /// A file that does not say what it must.
    #[error("`{}`: {reason}", .path.display())]
    Content {
        /// The file.
        path: PathBuf,
        /// Field, expected and found.
        reason: String,
    },
    /// The log.
    #[error(transparent)]
    Log(#[from] LogError),
}

impl ImportError {
    pub(crate) fn io(path: &Path) -> impl FnOnce(io::Error) -> ImportError {
        let path = path.to_path_buf();
        move |reason| ImportError::Io { path, reason }
    }

    pub(crate) fn content(path: &Path, reason: impl ToString) -> ImportError {
        ImportError::Content {
            path: path.into(),
            reason: reason.to_string(),
        }
    }
}
