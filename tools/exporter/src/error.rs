use std::io;
use std::path::{Path, PathBuf};

use realo_logs::LogError;

/// Why a log could not be exported.
#[derive(Debug, thiserror::Error)]
pub enum ExportError {
    /// A file or folder that cannot be written.
    #[error("cannot {action} `{}`: {reason}; {}", .path.display(), advice(.reason))]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// What was tried.
        action: &'static str,
        /// What the system said.
        reason: io::Error,
    },
    /// Writing failed midway.
    #[error("writing `{}` failed after {written} bytes of the export: {reason}; nothing of it was left: {}", .path.display(), advice(.reason))]
    Unfinished {
        /// The file.
        path: PathBuf,
        /// Bytes that were written before.
        written: u64,
        /// What the system said.
        reason: io::Error,
    },
    /// Something of somebody else is at the place of the output.
    #[error("refuse to overwrite `{}`: expected {expected}, found {found}; {next}", .path.display())]
    Occupied {
        /// The output.
        path: PathBuf,
        /// What may be there.
        expected: &'static str,
        /// What is there.
        found: String,
        /// What to do.
        next: &'static str,
    },
    /// A log that does not have what the layout needs.
    #[error("`{}`: {reason}", .log.display())]
    Unfit {
        /// The log.
        log: PathBuf,
        /// Topic, expected, found, and what to try.
        reason: String,
    },
    /// An option that cannot be taken.
    #[error("{0}")]
    Option(String),
    /// The log.
    #[error(transparent)]
    Log(#[from] LogError),
}

fn advice(reason: &io::Error) -> &'static str {
    match reason.kind() {
        io::ErrorKind::PermissionDenied => "look at the permissions of the folder, or choose another place",
        io::ErrorKind::NotFound => "correct the path",
        _ => "free space there, or choose another place",
    }
}

impl ExportError {
    pub(crate) fn io(path: &Path, action: &'static str) -> impl FnOnce(io::Error) -> ExportError {
        let path = path.to_path_buf();
        move |reason| ExportError::Io { path, action, reason }
    }

    pub(crate) fn unfit(log: &Path, reason: impl Into<String>) -> ExportError {
        ExportError::Unfit {
            log: log.into(),
            reason: reason.into(),
        }
    }
}
