//! The files of a run's folder.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::io::{ErrorKind, Write};
use std::path::{Path, PathBuf};

use realo_schemas::report::Phase;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::localization::TUM;
use crate::result::RESULT;
use crate::run::SAMPLES;
use crate::timing::TIMING;
use crate::{Run, RunResult, VERSION};

/// The file that is written last: a folder that has it holds a complete run.
pub const RESULT_FILE: &str = "result.json";
const TIMING_FILE: &str = "timing.json";
const SAMPLES_FILE: &str = "evaluation.json";
/// Folder of traces, one for each agent on another machine.
const CHANNELS: &str = "channels";
/// Folders of trajectories of agents that estimated their poses: as they said, and as it was.
const TRAJECTORIES: &str = "trajectories";
const TRUE_TRAJECTORIES: &str = "trajectories/truth";
/// In the order in which they are removed; written the other way round, so that a result is never without the others.
const FILES: [(&str, &str); 3] = [(RESULT_FILE, RESULT), (TIMING_FILE, TIMING), (SAMPLES_FILE, SAMPLES)];

/// Why a run's folder cannot be read or written.
#[derive(Debug, thiserror::Error)]
pub enum FilesError {
    /// No such folder.
    #[error("{folder}: no such folder; expected the folder of a run, as `realo run --out` writes it")]
    NoFolder {
        /// As it was asked for.
        folder: PathBuf,
    },
    /// A file that is none of a run.
    #[error("{file}: expected the folder of a run or its `{RESULT_FILE}`, found a file of another name")]
    NoRunFile {
        /// As it was asked for.
        file: PathBuf,
    },
    /// A folder in which no run has come to its end.
    #[error(
        "{folder}: there is no `{RESULT_FILE}`: no run has come to its end here{hint}; expected the folder of a complete run"
    )]
    Incomplete {
        /// The folder.
        folder: PathBuf,
        /// What there is instead.
        hint: String,
    },
    /// A file of somebody else.
    #[error("{file}: expected a file of realo with \"schema\": \"{expected}\", found {found}")]
    Foreign {
        /// The file.
        file: PathBuf,
        /// The schema that it should name.
        expected: &'static str,
        /// What it is.
        found: String,
    },
    /// A folder with a file of somebody else is not written to.
    #[error("{file} is not of realo ({found}) and is not overwritten; choose another folder (setting `out`)")]
    Occupied {
        /// The file.
        file: PathBuf,
        /// What it is.
        found: String,
    },
    /// A file of another version.
    #[error("{file}: version {found}, this program reads version {VERSION}; read it with the release that wrote it")]
    Version {
        /// The file.
        file: PathBuf,
        /// Its version.
        found: Value,
    },
    /// A field that does not fit.
    #[error("{file}: {reason}; the file is damaged: run again")]
    Damaged {
        /// The file.
        file: PathBuf,
        /// The field and what was expected.
        reason: String,
    },
    /// The system refuses.
    #[error("{file}: cannot be read: {reason}")]
    Read {
        /// The file.
        file: PathBuf,
        /// Why.
        reason: std::io::Error,
    },
    /// The system refuses.
    #[error("{file}: cannot be written: {reason}{hint}")]
    Write {
        /// The file.
        file: PathBuf,
        /// Why.
        reason: std::io::Error,
        /// What helps.
        hint: &'static str,
    },
}

/// Reads the folder of a complete run; one of its three files names it too.
///
/// # Errors
/// [`FilesError`] names the file and what was expected.
pub fn read_run(folder: impl AsRef<Path>) -> Result<Run, FilesError> {
    let folder = &run_folder(folder.as_ref());
    if folder.is_file() {
        return Err(FilesError::NoRunFile { file: folder.into() });
    }
    if !folder.is_dir() {
        return Err(FilesError::NoFolder { folder: folder.into() });
    }
    if !folder.join(RESULT_FILE).exists() {
        return Err(FilesError::Incomplete {
            folder: folder.into(),
            hint: what_else(folder),
        });
    }
    Ok(Run {
        result: read(&folder.join(RESULT_FILE), RESULT)?,
        timing: read(&folder.join(TIMING_FILE), TIMING)?,
        samples: read(&folder.join(SAMPLES_FILE), SAMPLES)?,
    })
}

/// Which logs and egos a result is of.
#[derive(Debug, Deserialize)]
struct Played {
    logs: BTreeSet<String>,
    egos: BTreeSet<String>,
}

impl Played {
    /// By the result of a folder, whatever its version; `None` of a folder without one that can be read.
    fn of(folder: &Path) -> Option<Self> {
        let file = folder.join(RESULT_FILE);
        // Whoever opens a pipe waits for its other end.
        std::fs::metadata(&file).ok().filter(|found| found.is_file())?;
        serde_json::from_slice(&std::fs::read(file).ok()?).ok()
    }
}

/// Leaves of the folders of single runs those of which the result of a batch is the sum: a batch before it may have had other
/// logs and egos, whose folders are there still. All stay where `sum` has no result.
pub fn retain_parts(sum: &Path, singles: &mut Vec<PathBuf>) {
    let Some(sum) = Played::of(sum) else { return };
    singles.retain(|single| {
        Played::of(single).is_some_and(|own| own.logs.is_subset(&sum.logs) && own.egos.is_subset(&sum.egos))
    });
}

/// The folder that is meant by a path: that of a run's file, else the path itself.
pub fn run_folder(path: &Path) -> PathBuf {
    let is_of_run = path
        .file_name()
        .is_some_and(|name| FILES.iter().any(|(file, _)| name == *file));
    match path.parent() {
        Some(folder) if is_of_run && !path.is_dir() => match folder.as_os_str().is_empty() {
            true => ".".into(),
            false => folder.into(),
        },
        _ => path.into(),
    }
}

/// Folders below that hold a run, which may be the ones that were meant.
fn what_else(folder: &Path) -> String {
    let mut runs: Vec<String> = std::fs::read_dir(folder)
        .into_iter()
        .flatten()
        .flatten()
        .filter(|entry| entry.path().join(RESULT_FILE).exists())
        .map(|entry| entry.file_name().to_string_lossy().into_owned())
        .collect();
    runs.sort();
    match runs.is_empty() {
        true => String::new(),
        false => format!(" (there is one in: {})", runs.join(", ")),
    }
}

/// Writes a run's folder: each file at once or not at all, `result.json` last.
///
/// # Errors
/// [`FilesError`] names the file; nothing of somebody else is overwritten.
pub fn write_run(folder: impl AsRef<Path>, run: &Run) -> Result<(), FilesError> {
    write_run_with(folder.as_ref(), run, &Beside::default())
}

/// What else a run's folder has for other programs.
#[derive(Debug, Default)]
pub(crate) struct Beside {
    /// By agent on another machine, what its way was like: a trace that `link` replays.
    pub courses: BTreeMap<String, Vec<Phase>>,
    /// By agent, where it said that it was, and where it was: texts in TUM's form.
    pub trajectories: BTreeMap<String, [String; 2]>,
}

/// As [`write_run`], with files for other programs.
///
/// # Errors
/// As [`write_run`].
pub(crate) fn write_run_with(folder: &Path, run: &Run, beside: &Beside) -> Result<(), FilesError> {
    claim(folder)?;
    write(&folder.join(SAMPLES_FILE), &run.samples, false)?;
    write(&folder.join(TIMING_FILE), &run.timing, true)?;
    let courses = beside.courses.iter();
    let courses = courses.map(|(peer, course)| (format!("{peer}.csv"), Phase::trace(course)));
    write_texts(&folder.join(CHANNELS), courses)?;
    for (place, name) in [TRAJECTORIES, TRUE_TRAJECTORIES].into_iter().enumerate() {
        let texts = beside.trajectories.iter();
        let texts = texts.map(|(agent, texts)| (format!("{agent}.tum"), texts[place].clone()));
        write_texts(&folder.join(name), texts)?;
    }
    write(&folder.join(RESULT_FILE), &run.result, true)
}

/// Writes a run's `result.json` anew, at once or not at all.
///
/// # Errors
/// As [`write_run`].
pub fn write_result(folder: &Path, result: &RunResult) -> Result<(), FilesError> {
    write(&folder.join(RESULT_FILE), result, true)
}

/// Makes the folder and removes an earlier run's files from it, so that no result stands there until this one is written.
///
/// # Errors
/// [`FilesError`] if the folder cannot be made or holds files of these names that are not of realo.
pub fn claim(folder: &Path) -> Result<(), FilesError> {
    std::fs::create_dir_all(folder).map_err(|reason| refused(folder, reason))?;
    for file in earlier(folder)? {
        std::fs::remove_file(&file).map_err(|reason| refused(&file, reason))?;
    }
    Ok(())
}

/// Writes files of a folder, which is made if there are any.
fn write_texts(folder: &Path, texts: impl Iterator<Item = (String, String)>) -> Result<(), FilesError> {
    let mut texts = texts.peekable();
    if texts.peek().is_some() {
        std::fs::create_dir_all(folder).map_err(|reason| refused(folder, reason))?;
    }
    for (name, text) in texts {
        let path = folder.join(name);
        std::fs::write(&path, text).map_err(|reason| refused(&path, reason))?;
    }
    Ok(())
}

/// The files of an earlier run in a folder, `result.json` first, and its traces and trajectories below it.
///
/// # Errors
/// [`FilesError`] for files of these names that are not of realo.
pub fn earlier(folder: &Path) -> Result<Vec<PathBuf>, FilesError> {
    let present = FILES.iter().filter(|(name, _)| folder.join(name).exists());
    let files: Result<Vec<PathBuf>, FilesError> = present
        .map(|(name, schema)| {
            let file = folder.join(name);
            match read_any(&file, schema) {
                Ok(_) | Err(FilesError::Version { .. }) => Ok(file),
                Err(FilesError::Foreign { file, found, .. }) => Err(FilesError::Occupied { file, found }),
                Err(error) => Err(error),
            }
        })
        .collect();
    let below = [
        (CHANNELS, Phase::COLUMNS),
        (TRAJECTORIES, TUM),
        (TRUE_TRAJECTORIES, TUM),
    ];
    let texts = below
        .into_iter()
        .flat_map(|(name, begin)| texts_of(&folder.join(name), begin));
    Ok(files?.into_iter().chain(texts).collect())
}

/// The files of a folder that begin with a text.
fn texts_of(folder: &Path, begin: &str) -> Vec<PathBuf> {
    let has_begin = |path: &PathBuf| std::fs::read_to_string(path).is_ok_and(|text| text.starts_with(begin));
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    entries.map(|entry| entry.path()).filter(has_begin).collect()
}

fn refused(file: &Path, reason: std::io::Error) -> FilesError {
    let hint = match reason.kind() {
        ErrorKind::StorageFull | ErrorKind::QuotaExceeded => "; free some space or choose another disk (setting `out`)",
        ErrorKind::PermissionDenied | ErrorKind::ReadOnlyFilesystem => "; choose another folder (setting `out`)",
        ErrorKind::NotADirectory | ErrorKind::AlreadyExists => "; a file is where a folder is needed (setting `out`)",
        _ => "",
    };
    FilesError::Write {
        file: file.into(),
        reason,
        hint,
    }
}

fn write<T: Serialize>(file: &Path, document: &T, readable: bool) -> Result<(), FilesError> {
    let text = match readable {
        true => serde_json::to_vec_pretty(document),
        false => serde_json::to_vec(document),
    };
    let mut text = text.map_err(|error| refused(file, error.into()))?;
    text.push(b'\n');
    let partial = partial_of(file);
    let written = File::create(&partial)
        .and_then(|mut file| file.write_all(&text).and_then(|()| file.sync_all()))
        .and_then(|()| std::fs::rename(&partial, file));
    written.map_err(|reason| {
        // The first error is the one that matters; the file is of no use.
        let _ = std::fs::remove_file(&partial);
        refused(file, reason)
    })
}

/// Where a file is written before it takes its place: a name that nobody else uses.
fn partial_of(file: &Path) -> PathBuf {
    file.with_extension(format!("json.{}.partial", std::process::id()))
}

/// A file of the schema and version that this program knows.
fn read_any(file: &Path, schema: &'static str) -> Result<Vec<u8>, FilesError> {
    #[derive(serde::Deserialize)]
    struct Head {
        schema: Value,
        #[serde(default)]
        version: Value,
    }
    let foreign = |found: String| FilesError::Foreign {
        file: file.into(),
        expected: schema,
        found,
    };
    // Whoever opens a pipe waits for its other end.
    if std::fs::metadata(file).is_ok_and(|found| !found.is_file()) {
        return Err(foreign("a folder, pipe or device".into()));
    }
    let text = std::fs::read(file).map_err(|reason| FilesError::Read {
        file: file.into(),
        reason,
    })?;
    let head: Head = serde_json::from_slice(&text).map_err(|error| {
        foreign(match error.is_data() {
            true => "JSON without a schema".into(),
            false => format!("no JSON: {error}"),
        })
    })?;
    if head.schema != schema {
        return Err(foreign(format!("\"schema\": {}", head.schema)));
    }
    if head.version != VERSION {
        return Err(FilesError::Version {
            file: file.into(),
            found: head.version,
        });
    }
    Ok(text)
}

fn read<T: DeserializeOwned>(file: &Path, schema: &'static str) -> Result<T, FilesError> {
    let text = read_any(file, schema)?;
    serde_json::from_slice(&text).map_err(|error| FilesError::Damaged {
        file: file.into(),
        reason: error.to_string(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{RunResult, Samples, Settings, Timing};

    #[test]
    fn a_sum_is_of_the_folders_of_its_logs_and_egos() {
        let root = tempfile::tempdir().unwrap();
        let played = |folder: &str, logs: &[&str], ego: &str| {
            let folder = root.path().join(folder);
            std::fs::create_dir_all(&folder).unwrap();
            let text = serde_json::json!({ "logs": logs, "egos": [ego], "version": 0 }).to_string();
            std::fs::write(folder.join(RESULT_FILE), text).unwrap();
            folder
        };
        let singles = [
            played("a/car", &["a"], "car"),
            played("a/bus", &["a"], "bus"),
            played("old/car", &["old"], "car"),
            root.path().join("b/car"),
        ];
        let mut all = singles.to_vec();
        retain_parts(root.path(), &mut all);
        assert_eq!(all, singles, "there is no sum yet");
        played("", &["a", "b"], "car");
        retain_parts(root.path(), &mut all);
        assert_eq!(all, singles[..1]);
    }

    fn run(graph: &str) -> Run {
        let settings = Settings {
            graph: graph.into(),
            ..Settings::default()
        };
        Run {
            result: RunResult::new(settings),
            timing: Timing::default(),
            samples: Samples::default(),
        }
    }

    fn names(folder: &Path) -> Vec<String> {
        let entries = std::fs::read_dir(folder).unwrap();
        let mut names: Vec<_> = entries
            .map(|entry| entry.unwrap().file_name().into_string().unwrap())
            .collect();
        names.sort();
        names
    }

    #[test]
    fn a_file_of_a_run_names_its_folder() {
        let folder = tempfile::tempdir().unwrap();
        write_run(folder.path(), &run("one")).unwrap();
        for (file, _) in FILES {
            assert_eq!(read_run(folder.path().join(file)).unwrap(), run("one"), "{file}");
        }
        assert_eq!(run_folder(Path::new("result.json")), Path::new("."));
        assert_eq!(run_folder(Path::new("a/b")), Path::new("a/b"));
        // A folder may have any name.
        let odd = folder.path().join("odd/timing.json");
        write_run(&odd, &run("two")).unwrap();
        assert_eq!(read_run(&odd).unwrap(), run("two"));
        let other = folder.path().join("recording.mcap");
        std::fs::write(&other, "").unwrap();
        let error = read_run(&other).unwrap_err().to_string();
        assert!(
            error.contains("recording.mcap") && error.contains("`result.json`"),
            "{error}"
        );
        // The folder that lacks the file is named.
        let error = read_run(folder.path().join("gone/result.json"))
            .unwrap_err()
            .to_string();
        assert!(error.contains("gone: no such folder"), "{error}");
    }

    #[test]
    fn reads_what_it_wrote_and_replaces_an_earlier_run() {
        let folder = tempfile::tempdir().unwrap();
        let folder = folder.path().join("a/b");
        for graph in ["one", "two"] {
            write_run(&folder, &run(graph)).unwrap();
            assert_eq!(read_run(&folder).unwrap(), run(graph));
            assert_eq!(names(&folder), ["evaluation.json", "result.json", "timing.json"]);
        }
    }

    #[test]
    fn a_claimed_folder_holds_no_result() {
        let folder = tempfile::tempdir().unwrap();
        write_run(folder.path(), &run("one")).unwrap();
        std::fs::write(folder.path().join("detections.mcap"), "boxes").unwrap();
        claim(folder.path()).unwrap();
        assert_eq!(names(folder.path()), ["detections.mcap"]);
        let error = read_run(folder.path()).unwrap_err().to_string();
        assert!(error.contains("no run has come to its end"), "{error}");
    }

    #[test]
    fn refuses_folders_and_files_of_others() {
        let folder = tempfile::tempdir().unwrap();
        let error = read_run(folder.path().join("x")).unwrap_err().to_string();
        assert!(error.contains("no such folder"), "{error}");
        write_run(folder.path().join("cav1"), &run("one")).unwrap();
        let error = read_run(folder.path()).unwrap_err().to_string();
        assert!(error.contains("there is one in: cav1"), "{error}");

        let file = folder.path().join(RESULT_FILE);
        for (text, expected) in [
            ("{\"score\": 1}", "JSON without a schema"),
            ("{\"schema\": \"other\", \"version\": 2}", "found \"schema\": \"other\""),
            ("result", "no JSON"),
        ] {
            std::fs::write(&file, text).unwrap();
            let error = read_run(folder.path()).unwrap_err().to_string();
            assert!(error.contains(expected) && error.contains("realo/result"), "{error}");
            let error = write_run(folder.path(), &run("two")).unwrap_err().to_string();
            assert!(error.contains("not overwritten") && error.contains("`out`"), "{error}");
            assert_eq!(std::fs::read_to_string(&file).unwrap(), text);
        }
        std::fs::write(&file, "{\"schema\": \"realo/result\", \"version\": 99}").unwrap();
        let error = read_run(folder.path()).unwrap_err().to_string();
        assert!(error.contains("version 99"), "{error}");
        std::fs::write(&file, "{\"schema\": \"realo/result\", \"version\": 2}").unwrap();
        let error = read_run(folder.path()).unwrap_err().to_string();
        assert!(
            error.contains("result.json") && error.contains("missing field"),
            "{error}"
        );
    }

    #[test]
    fn a_file_in_the_way_of_the_folder_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("out");
        std::fs::write(&file, "").unwrap();
        let error = write_run(&file, &run("one")).unwrap_err().to_string();
        assert!(
            error.contains("out") && error.contains("a file is where a folder is needed"),
            "{error}"
        );
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn a_full_disk_leaves_no_result_and_says_so() {
        let folder = tempfile::tempdir().unwrap();
        let partial = partial_of(&folder.path().join(TIMING_FILE));
        std::os::unix::fs::symlink("/dev/full", &partial).unwrap();
        let error = write_run(folder.path(), &run("one")).unwrap_err().to_string();
        assert!(
            error.contains("timing.json") && error.contains("free some space"),
            "{error}"
        );
        assert_eq!(names(folder.path()), ["evaluation.json"]);
    }
}
