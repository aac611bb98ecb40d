//! What is missing or damaged, all of it, by cause.

use std::collections::{BTreeMap, BTreeSet};
use std::io::ErrorKind;
use std::path::Path;

use crate::ImportError;
use crate::files::EMPTY;

/// A file that cannot be used, with what it should have been.
pub struct Fault {
    /// What its content is, if it is damaged.
    pub kind: FileKind,
    /// What is wrong with it.
    pub error: ImportError,
}

/// What a file of the data set holds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FileKind {
    /// Points.
    Cloud,
    /// Labels of a side or of both.
    Labels,
    /// Where a sensor is, and what a camera sees.
    Calibration,
    /// Where an agent is.
    Pose,
    /// All of these in one file, which is no such file.
    Arrays,
}

impl FileKind {
    fn damaged(self) -> &'static str {
        match self {
            FileKind::Cloud => "damaged cloud",
            FileKind::Labels => "damaged labels",
            FileKind::Calibration => "damaged calibration",
            FileKind::Pose => "damaged pose",
            FileKind::Arrays => "damaged arrays",
        }
    }
}

/// Faults of one sweep.
#[derive(Default)]
pub struct FaultsOfSweep(pub Vec<Fault>);

impl FaultsOfSweep {
    /// Gives what was read, or keeps the fault.
    pub fn keep<T>(&mut self, kind: FileKind, read: Result<T, ImportError>) -> Option<T> {
        read.map_err(|error| self.0.push(Fault { kind, error })).ok()
    }

    /// What was read where nothing was at fault.
    pub fn or<T>(self, read: Option<T>) -> Result<T, FaultsOfSweep> {
        match read {
            Some(read) if self.0.is_empty() => Ok(read),
            _ => Err(self),
        }
    }

    /// The first fault.
    pub fn first(self) -> Option<ImportError> {
        self.0.into_iter().next().map(|fault| fault.error)
    }
}

/// All that is missing or damaged in a data set.
#[derive(Clone, Default)]
pub struct Faults {
    /// Names by cause, each once.
    pub by_cause: BTreeMap<String, Vec<String>>,
    seen: BTreeSet<(String, String)>,
}

impl Faults {
    /// Adds a name to those of a cause.
    pub fn add(&mut self, cause: impl Into<String>, name: impl Into<String>) {
        let (cause, name) = (cause.into(), name.into());
        if self.seen.insert((cause.clone(), name.clone())) {
            self.by_cause.entry(cause).or_default().push(name);
        }
    }

    /// Adds all of others.
    pub fn append(&mut self, others: Faults) {
        for (cause, names) in others.by_cause {
            names.into_iter().for_each(|name| self.add(cause.as_str(), name));
        }
    }

    /// Whether a cause has this name.
    pub fn contains(&self, cause: &str, name: &str) -> bool {
        self.seen.contains(&(cause.to_string(), name.to_string()))
    }

    /// Adds the faults of a sweep in the data set `dir`.
    pub fn extend(&mut self, dir: &Path, faults: FaultsOfSweep) {
        for Fault { kind, error } in faults.0 {
            let name = |path: &Path| path.strip_prefix(dir).unwrap_or(path).display().to_string();
            match &error {
                ImportError::Io { path, reason } => self.add(cause(reason), name(path)),
                ImportError::Content { path, reason } => {
                    self.add(kind.damaged(), format!("{}: {reason}", name(path)));
                }
                other => self.add(kind.damaged(), other.to_string()),
            }
        }
    }

    /// A line each.
    pub fn listed(&self) -> String {
        listed(&self.by_cause)
    }
}

/// Why a file cannot be read, without its name.
fn cause(reason: &std::io::Error) -> String {
    match reason.kind() {
        ErrorKind::NotFound => "no such file".into(),
        ErrorKind::IsADirectory => "a folder, expected a file".into(),
        ErrorKind::UnexpectedEof => EMPTY.into(),
        _ => reason.to_string(),
    }
}

/// Max files listed for each cause; of a data set on the wrong disk thousands are missing.
const LISTED: usize = 200;

/// Names by cause, a line each.
pub fn listed(by_cause: &BTreeMap<String, Vec<String>>) -> String {
    let mut text = Vec::new();
    for (cause, names) in by_cause {
        text.push(format!("  {} × {cause}", names.len()));
        text.extend(names.iter().take(LISTED).map(|name| format!("    {name}")));
        if names.len() > LISTED {
            text.push(format!("    and {} more", names.len() - LISTED));
        }
    }
    text.join("\n")
}
