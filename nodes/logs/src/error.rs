use std::io;
use std::path::{Path, PathBuf};

use realo_schemas::{Nanos, to_seconds};

use crate::shell;

/// Tried with a file that is to be written.
pub(crate) const CREATE: &str = "create";

/// What helps where the file system refuses, as the end of a sentence.
fn advice(path: &Path, action: &str, reason: &io::Error) -> String {
    match (reason.kind(), path.parent()) {
        (io::ErrorKind::NotFound, Some(folder)) if action == CREATE => {
            let word = shell::word(folder);
            format!("; its folder is not there: `mkdir -p {word}` makes it, or correct the path")
        }
        (io::ErrorKind::NotFound, _) => {
            "; correct the path, or write a log there first (docs/reference/log-format.md)".into()
        }
        (io::ErrorKind::PermissionDenied, _) => "; look at the file's and the folder's permissions".into(),
        _ => String::new(),
    }
}

/// Why a log could not be written or read.
#[derive(Debug, thiserror::Error)]
pub enum LogError {
    /// The file system refused.
    #[error("cannot {action} `{}`: {reason}{}", .path.display(), advice(.path, .action, .reason))]
    Io {
        /// The file.
        path: PathBuf,
        /// What was tried.
        action: &'static str,
        /// What the system said.
        reason: io::Error,
    },
    /// Writing failed midway.
    #[error("writing `{}` failed after {written} bytes: {reason}; what was written stays readable", .path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// Length of the readable part.
        written: u64,
        /// What the system said.
        reason: String,
    },
    /// Writing failed midway of what appears only when it is complete.
    #[error(
        "writing `{}` failed after {written} bytes: {reason}; nothing of it was left: free space there, or choose another place",
        .path.display()
    )]
    Unfinished {
        /// The file that was to appear.
        path: PathBuf,
        /// Bytes that were written.
        written: u64,
        /// What the system said.
        reason: String,
    },
    /// A file of somebody else at the place of what is to be written.
    #[error(
        "refuse to overwrite `{}`: it is {found}; expected a log or a recording that realo wrote, or nothing. Choose another \
         path, or remove it first",
        .path.display()
    )]
    Foreign {
        /// The file.
        path: PathBuf,
        /// What it is.
        found: &'static str,
    },
    /// Not an MCAP file.
    #[error("`{}` is not an MCAP file: {reason}", .path.display())]
    NotMcap {
        /// The file.
        path: PathBuf,
        /// What was found instead.
        reason: String,
    },
    /// An MCAP file that is not of the expected sort.
    #[error(
        "`{}` is not a {expected}: it has no metadata record `{record}` (it has: {found}); {hint}",
        .path.display()
    )]
    NotRealo {
        /// The file.
        path: PathBuf,
        /// What was wanted.
        expected: &'static str,
        /// Name of the metadata record that it lacks.
        record: &'static str,
        /// Metadata records that it has.
        found: String,
        /// What to do.
        hint: String,
    },
    /// A metadata record that does not say what it must.
    #[error("`{}`: metadata `{field}`: {reason}", .path.display())]
    Metadata {
        /// The file.
        path: PathBuf,
        /// Key of the record.
        field: &'static str,
        /// Expected and found.
        reason: String,
    },
    /// Bytes that contradict the format.
    #[error("`{}` is damaged at byte {offset}: {reason}", .path.display())]
    Damaged {
        /// The file.
        path: PathBuf,
        /// Where.
        offset: u64,
        /// What is wrong.
        reason: String,
    },
    /// A file that goes on after its end.
    #[error("`{}` goes on after its end at byte {offset}: {reason}", .path.display())]
    GoesOn {
        /// The file.
        path: PathBuf,
        /// Where it ends.
        offset: u64,
        /// What follows, and what to do.
        reason: String,
    },
    /// An agent that the log does not have.
    #[error("`{}` has no agent `{agent}`; it has: {has}", .path.display())]
    MissingAgent {
        /// The file.
        path: PathBuf,
        /// The agent.
        agent: String,
        /// The agents that there are.
        has: String,
    },
    /// A topic that the log does not have.
    #[error("`{}` has no topic `{topic}`, which agent `{agent}` needs; topics there: {has}", .path.display())]
    MissingTopic {
        /// The file.
        path: PathBuf,
        /// Its agent.
        agent: String,
        /// The topic.
        topic: String,
        /// The topics of that agent, and those of no agent.
        has: String,
    },
    /// A message that cannot be read.
    #[error("message on `{topic}` at {:.3} s: {reason}", to_seconds(*.log_time))]
    Content {
        /// Its topic.
        topic: String,
        /// Its log time, ns.
        log_time: Nanos,
        /// Expected and found.
        reason: String,
    },
    /// A sweep that no transform brings to its agent's body frame at its time, while some do at other times.
    #[error("message on `{topic}` at {:.3} s: {reason}", to_seconds(*.log_time))]
    Unplaced {
        /// Its topic.
        topic: String,
        /// Its log time, ns.
        log_time: Nanos,
        /// Where the transforms are.
        reason: String,
    },
    /// Logs that cannot be one.
    #[error("the logs cannot be merged: {0}")]
    Merge(String),
    /// A log that is read and does not do for what is wanted.
    #[error("`{}`: {reason}", .path.display())]
    Unfit {
        /// The file.
        path: PathBuf,
        /// Expected and found.
        reason: String,
    },
    /// Something that cannot be put into a log.
    #[error("cannot write to `{}`: {reason}", .path.display())]
    Input {
        /// The file.
        path: PathBuf,
        /// Expected and found.
        reason: String,
    },
}

impl LogError {
    /// What was expected and found, without where.
    pub fn reason(&self) -> String {
        match self {
            LogError::Content { reason, .. } | LogError::Unplaced { reason, .. } => reason.clone(),
            error => error.to_string(),
        }
    }

    /// Renames the file in the error to the path that the caller gave.
    pub(crate) fn named(mut self, name: &Path) -> LogError {
        if let LogError::Io { path, .. } | LogError::Input { path, .. } = &mut self {
            *path = name.into();
        }
        self
    }

    pub(crate) fn io(path: &Path, action: &'static str) -> impl FnOnce(io::Error) -> LogError {
        let path = path.to_path_buf();
        move |reason| LogError::Io { path, action, reason }
    }

    pub(crate) fn damaged(path: &Path, offset: u64, reason: impl ToString) -> LogError {
        LogError::Damaged {
            path: path.to_path_buf(),
            offset,
            reason: reason.to_string(),
        }
    }

    pub(crate) fn input(path: &Path, reason: impl Into<String>) -> LogError {
        LogError::Input {
            path: path.to_path_buf(),
            reason: reason.into(),
        }
    }
}

#[cfg(test)]
mod tests {
    use crate::{AgentInfo, AgentKind, LogInfo, LogWriter};

    #[test]
    fn a_folder_that_is_not_there_is_named_with_the_command_that_makes_it() {
        let dir = tempfile::tempdir().unwrap();
        let folder = dir.path().join("no/such dir");
        let path = folder.join("x.mcap");
        let agent = AgentInfo {
            name: "cav1".into(),
            kind: AgentKind::Vehicle,
            footprint: None,
            sensor: String::new(),
            sensor_position: None,
        };
        let info = LogInfo::new("a test", vec![agent]);
        for created in [LogWriter::create_atomic(&path, &info), LogWriter::create(&path, &info)] {
            let error = created.err().unwrap().to_string();
            assert!(
                error.contains(&format!("cannot create `{}`: ", path.display())),
                "{error}"
            );
            assert!(
                error.contains(&format!("`mkdir -p '{}'` makes it", folder.display()))
                    && !error.contains("write a log"),
                "{error}"
            );
        }
        let error = crate::Log::open(&path).err().unwrap().to_string();
        assert!(
            error.contains("write a log there first") && !error.contains("mkdir"),
            "{error}"
        );
    }
}
