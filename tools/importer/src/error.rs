use std::io;
use std::path::{Path, PathBuf};

use realo_bags::BagError;
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
    /// Lists of a data set that cannot be read, all of them.
    #[error(
        "`{}`: its lists cannot be read:\n{reasons}\nmend them, and see whether DIR is `{root}`",
        .path.display()
    )]
    Lists {
        /// The data set.
        path: PathBuf,
        /// What its folder is called.
        root: &'static str,
        /// A line each.
        reasons: String,
    },
    /// Files and entries that are missing or damaged, all of them.
    #[error(
        "`{}`: {incomplete} of {pairs} pairs are incomplete; missing or damaged:\n{missing}\n{}",
        .path.display(), advice(*.some)
    )]
    Incomplete {
        /// The data set.
        path: PathBuf,
        /// Pairs of which something is missing or damaged.
        incomplete: usize,
        /// All pairs.
        pairs: usize,
        /// A line each.
        missing: String,
        /// Whether pairs are complete.
        some: bool,
    },
    /// Files of frames that are missing or damaged, all of them.
    #[error(
        "`{}`: {incomplete} of {frames} frames are incomplete; missing or damaged:\n{missing}\n{}{}",
        .path.display(), frames_advice(*.some), logs(.written)
    )]
    IncompleteFrames {
        /// The data set.
        path: PathBuf,
        /// Frames of which something is missing or damaged.
        incomplete: usize,
        /// All frames.
        frames: usize,
        /// A line each.
        missing: String,
        /// Whether frames are complete.
        some: bool,
        /// Logs of complete scenes, which were written.
        written: Vec<String>,
    },
    /// An import that failed, where a data set is near.
    #[error("{error}\n{hint}")]
    Hinted {
        /// Why it failed.
        error: Box<ImportError>,
        /// What to try.
        hint: String,
    },
    /// An option that cannot be taken.
    #[error("{0}")]
    Option(String),
    /// A bag, or its map file.
    #[error(transparent)]
    Bag(#[from] BagError),
    /// The log.
    #[error(transparent)]
    Log(#[from] LogError),
}

fn advice(some_are_complete: bool) -> &'static str {
    match some_are_complete {
        true => "add what is missing, replace what is damaged, or leave these pairs out with --skip-incomplete",
        false => {
            "no pair is complete: add what is missing, replace what is damaged, and see whether DIR is `cooperative-vehicle-infrastructure`"
        }
    }
}

fn frames_advice(some_are_complete: bool) -> &'static str {
    match some_are_complete {
        true => "add what is missing, replace what is damaged, or leave these frames out with --skip-incomplete",
        false => {
            "no frame is complete: add what is missing, replace what is damaged, and see whether this is the data set's folder"
        }
    }
}

fn logs(written: &[String]) -> String {
    match written {
        [] => String::new(),
        written => format!("; written: {}", written.join(", ")),
    }
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

    pub(crate) fn with_hint(self, hint: String) -> ImportError {
        ImportError::Hinted {
            error: Box::new(self),
            hint,
        }
    }

    /// The same of what else is known of the files that were read.
    pub(crate) fn with_notes(mut self, notes: &[String]) -> ImportError {
        if let ImportError::Content { reason, .. } = &mut self {
            for note in notes {
                reason.push_str("\nnote: ");
                reason.push_str(&realo_bags::printable(note));
            }
        }
        self
    }
}
