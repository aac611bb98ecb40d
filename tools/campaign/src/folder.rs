//! A plan in a folder, with the results beside it.

use std::collections::BTreeMap;
use std::fs::{self, File, TryLockError};
use std::io::{ErrorKind, Write};
use std::path::{Path, PathBuf};

use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use crate::plan::{SCHEMA, VERSION};
use crate::{Item, Plan};

/// The plan's file.
pub const PLAN_FILE: &str = "plan.json";
/// The file in the folder of an item that says that it is done; written last.
pub const RECORD_FILE: &str = "done.json";
/// The file that is locked while somebody works in the folder.
const LOCK_FILE: &str = ".lock";
/// Where the folders of items are.
const RUNS: &str = "runs";
/// Where items are made again while what is there of them stays.
const ANEW: &str = "anew";
/// What the name of a folder ends with that is about to be replaced.
const BEFORE: &str = "before";

/// What cannot be done with a folder.
#[derive(Debug, thiserror::Error)]
pub enum FolderError {
    /// The folder of another plan.
    #[error("{folder} is of another plan; {difference}; choose another folder, or the same values")]
    Other {
        /// The folder.
        folder: PathBuf,
        /// The value that differs.
        difference: String,
    },
    /// A folder in which another program works.
    #[error("{folder}: another command is at work in it; wait until that has ended, or choose another folder")]
    Busy {
        /// The folder.
        folder: PathBuf,
    },
    /// A folder without a plan.
    #[error("{folder}: expected the folder of a plan, found no {PLAN_FILE} in it")]
    NoPlan {
        /// The folder.
        folder: PathBuf,
    },
    /// A result that was made of something else.
    #[error(
        "{folder}: run `{key}` was made of something else; {difference}; run that shard again with what this folder has"
    )]
    Changed {
        /// The folder.
        folder: PathBuf,
        /// The run.
        key: String,
        /// What differs.
        difference: String,
    },
    /// A file that is not ours.
    #[error("{file}: {reason}; it is not of realo or damaged: choose another folder, or remove it")]
    Foreign {
        /// The file.
        file: PathBuf,
        /// What is wrong.
        reason: String,
    },
    /// The system refuses.
    #[error("{file}: cannot be {what}: {reason}{hint}")]
    System {
        /// The file.
        file: PathBuf,
        /// `read` or `written`.
        what: &'static str,
        /// Why.
        reason: std::io::Error,
        /// What helps.
        hint: &'static str,
    },
}

/// What is there of an item.
#[derive(Clone, Debug, PartialEq)]
pub enum Earlier<T> {
    /// Its result.
    Done(T),
    /// A result that was made of something else: the part that differs.
    Changed(String),
    /// Nothing.
    None,
}

#[derive(Serialize, Deserialize)]
struct Record<T> {
    schema: String,
    version: u32,
    key: String,
    parts: BTreeMap<String, String>,
    result: T,
}

/// A folder with a plan.
#[derive(Debug)]
pub struct Folder {
    path: PathBuf,
    /// Locked as long as this value lives.
    _lock: Option<File>,
}

impl Folder {
    /// The folder of this plan; made where it is not there. Items whose digests have changed since are [`Earlier::Changed`].
    ///
    /// # Errors
    /// [`FolderError::Busy`]; [`FolderError::Other`] with the value that differs; a file that is not ours; a system that refuses.
    pub fn open(path: &Path, plan: &Plan) -> Result<Self, FolderError> {
        fs::create_dir_all(path).map_err(|reason| unwritable(path, reason))?;
        let folder = Folder {
            path: path.into(),
            _lock: Some(locked(path)?),
        };
        if path.join(PLAN_FILE).exists() {
            folder.expect(plan)?;
        }
        write(&path.join(PLAN_FILE), plan)?;
        Ok(folder)
    }

    /// The folder of a shard of this plan, which stays as it is.
    ///
    /// # Errors
    /// As [`Folder::open`]; [`FolderError::NoPlan`].
    pub fn of_shard(path: &Path, plan: &Plan) -> Result<Self, FolderError> {
        if !path.join(PLAN_FILE).exists() {
            return Err(FolderError::NoPlan { folder: path.into() });
        }
        let folder = Folder {
            path: path.into(),
            _lock: None,
        };
        folder.expect(plan)?;
        Ok(folder)
    }

    fn expect(&self, plan: &Plan) -> Result<(), FolderError> {
        let known: Plan = read(&self.path.join(PLAN_FILE))?;
        match plan.difference(&known) {
            None => Ok(()),
            Some(difference) => Err(FolderError::Other {
                folder: self.path.clone(),
                difference,
            }),
        }
    }

    /// Where the files of an item are.
    pub fn of(&self, item: &Item) -> PathBuf {
        self.path.join(RUNS).join(&item.key)
    }

    /// What is there of an item.
    ///
    /// # Errors
    /// A record that cannot be read.
    pub fn earlier<T: DeserializeOwned>(&self, item: &Item) -> Result<Earlier<T>, FolderError> {
        let file = self.of(item).join(RECORD_FILE);
        if !file.exists() {
            return Ok(Earlier::None);
        }
        let record: Record<T> = read(&file)?;
        Ok(match item.difference(&record.parts) {
            None => Earlier::Done(record.result),
            Some(difference) => Earlier::Changed(difference),
        })
    }

    /// Makes the folder of an item, which is not done from now on.
    ///
    /// # Errors
    /// A system that refuses.
    pub fn begin(&self, item: &Item) -> Result<PathBuf, FolderError> {
        let folder = self.of(item);
        fs::create_dir_all(&folder).map_err(|reason| unwritable(&folder, reason))?;
        match fs::remove_file(folder.join(RECORD_FILE)) {
            Err(reason) if reason.kind() != ErrorKind::NotFound => Err(unwritable(&folder, reason)),
            _ => Ok(folder),
        }
    }

    /// An item is done: its record is written at once or not at all.
    ///
    /// # Errors
    /// A system that refuses.
    pub fn finish<T: Serialize>(&self, item: &Item, result: &T) -> Result<(), FolderError> {
        write(&self.of(item).join(RECORD_FILE), &record(item, result))
    }

    /// Makes an empty folder in which an item is made again; what is there of it stays until [`Folder::replace`].
    ///
    /// # Errors
    /// A system that refuses.
    pub fn begin_anew(&self, item: &Item) -> Result<PathBuf, FolderError> {
        let folder = self.anew(item);
        remove(&folder)?;
        fs::create_dir_all(&folder).map_err(|reason| unwritable(&folder, reason))?;
        Ok(folder)
    }

    /// An item is made again: its new folder, with its record, takes the place of the one before.
    ///
    /// # Errors
    /// A system that refuses.
    pub fn replace<T: Serialize>(&self, item: &Item, result: &T) -> Result<(), FolderError> {
        let (to, made) = (self.of(item), self.anew(item));
        write(&made.join(RECORD_FILE), &record(item, result))?;
        let before = made.with_added_extension(BEFORE);
        remove(&before)?;
        let moved = |from: &Path, to: &Path| match fs::rename(from, to) {
            Err(reason) if reason.kind() != ErrorKind::NotFound => Err(unwritable(to, reason)),
            _ => Ok(()),
        };
        moved(&to, &before)?;
        let parent = to.parent().unwrap_or(&self.path);
        fs::create_dir_all(parent).map_err(|reason| unwritable(parent, reason))?;
        fs::rename(&made, &to).map_err(|reason| unwritable(&to, reason))?;
        remove(&before)?;
        // Folders in which other items are made stay.
        let empty = made.ancestors().skip(1).take_while(|folder| *folder != self.path);
        let _ = empty.map(fs::remove_dir).try_for_each(|removed| removed);
        Ok(())
    }

    fn anew(&self, item: &Item) -> PathBuf {
        self.path.join(ANEW).join(&item.key)
    }

    /// Refuses shards whose results were made of something else, where neither the folder at `path`, which need not be there, nor a
    /// shard before has those. Nothing is written.
    ///
    /// # Errors
    /// [`FolderError::Changed`]; a record that cannot be read.
    pub fn refuse_changed(path: &Path, shards: &[Folder], plan: &Plan) -> Result<(), FolderError> {
        let here = Folder {
            path: path.into(),
            _lock: None,
        };
        for item in &plan.items {
            let mut is_done = matches!(here.earlier::<serde_json::Value>(item)?, Earlier::Done(_));
            for shard in shards {
                match shard.earlier::<serde_json::Value>(item)? {
                    Earlier::Done(_) => is_done = true,
                    Earlier::Changed(difference) if !is_done => return Err(shard.changed(item, difference)),
                    Earlier::Changed(_) | Earlier::None => {}
                }
            }
        }
        Ok(())
    }

    fn changed(&self, item: &Item, difference: String) -> FolderError {
        FolderError::Changed {
            folder: self.path.clone(),
            key: item.key.clone(),
            difference,
        }
    }

    /// Takes over what shards have done of the plan and this folder lacks; gives how many items those were.
    ///
    /// # Errors
    /// [`FolderError::Other`] or [`FolderError::Changed`] before anything is taken of that shard.
    pub fn merge(&self, shard: &Folder, plan: &Plan) -> Result<usize, FolderError> {
        let mut wanted = Vec::new();
        for item in &plan.items {
            let has = |folder: &Folder| folder.earlier::<serde_json::Value>(item);
            match (has(self)?, has(shard)?) {
                (Earlier::Done(_), _) | (_, Earlier::None) => {}
                (_, Earlier::Done(_)) => wanted.push(item),
                (_, Earlier::Changed(difference)) => return Err(shard.changed(item, difference)),
            }
        }
        for item in &wanted {
            let to = self.begin(item)?;
            copy(&shard.of(item), &to)?;
        }
        Ok(wanted.len())
    }
}

/// What says that an item is done.
fn record<T>(item: &Item, result: T) -> Record<T> {
    Record {
        schema: SCHEMA.into(),
        version: VERSION,
        key: item.key.clone(),
        parts: item.parts.clone(),
        result,
    }
}

/// Removes a folder, if it is there.
fn remove(folder: &Path) -> Result<(), FolderError> {
    match fs::remove_dir_all(folder) {
        Err(reason) if reason.kind() != ErrorKind::NotFound => Err(unwritable(folder, reason)),
        _ => Ok(()),
    }
}

/// The folder's lock, which a program holds until it ends, however it ends.
fn locked(folder: &Path) -> Result<File, FolderError> {
    let path = folder.join(LOCK_FILE);
    let file = File::options().create(true).append(true).open(&path);
    let file = file.map_err(|reason| unwritable(&path, reason))?;
    match file.try_lock() {
        Ok(()) => Ok(file),
        Err(TryLockError::WouldBlock) => Err(FolderError::Busy { folder: folder.into() }),
        Err(TryLockError::Error(reason)) => Err(unwritable(&path, reason)),
    }
}

/// Copies the files of a folder, the record last.
fn copy(from: &Path, to: &Path) -> Result<(), FolderError> {
    let entries = fs::read_dir(from).map_err(|reason| unreadable(from, reason))?;
    let mut files: Vec<PathBuf> = entries.flatten().map(|entry| entry.path()).collect();
    files.retain(|file| file.is_file());
    files.sort_by_key(|file| (file.ends_with(RECORD_FILE), file.clone()));
    for file in files {
        let name = file.file_name().unwrap_or_default();
        let partial = to.join(format!("{}.partial", name.to_string_lossy()));
        let copied = fs::copy(&file, &partial).and_then(|_| fs::rename(&partial, to.join(name)));
        copied.map_err(|reason| unwritable(&to.join(name), reason))?;
    }
    Ok(())
}

fn write<T: Serialize>(file: &Path, document: &T) -> Result<(), FolderError> {
    let partial = file.with_extension(format!("json.{}.partial", std::process::id()));
    let written = serde_json::to_vec_pretty(document)
        .map_err(std::io::Error::from)
        .and_then(|text| {
            let mut open = File::create(&partial)?;
            open.write_all(&text)?;
            open.sync_all()
        })
        .and_then(|()| fs::rename(&partial, file));
    written.map_err(|reason| {
        // The first error is the one that matters; the file is of no use.
        let _ = fs::remove_file(&partial);
        unwritable(file, reason)
    })
}

fn read<T: DeserializeOwned>(file: &Path) -> Result<T, FolderError> {
    #[derive(Deserialize)]
    struct Head {
        schema: String,
        version: u32,
    }
    let text = fs::read(file).map_err(|reason| unreadable(file, reason))?;
    let foreign = |reason: String| FolderError::Foreign {
        file: file.into(),
        reason,
    };
    let head: Head = serde_json::from_slice(&text).map_err(|error| foreign(error.to_string()))?;
    if (head.schema.as_str(), head.version) != (SCHEMA, VERSION) {
        let (schema, version) = (head.schema, head.version);
        return Err(foreign(format!(
            "expected {SCHEMA} version {VERSION}, found {schema} version {version}"
        )));
    }
    serde_json::from_slice(&text).map_err(|error| foreign(error.to_string()))
}

fn unreadable(file: &Path, reason: std::io::Error) -> FolderError {
    FolderError::System {
        file: file.into(),
        what: "read",
        reason,
        hint: "",
    }
}

fn unwritable(file: &Path, reason: std::io::Error) -> FolderError {
    let hint = match reason.kind() {
        ErrorKind::StorageFull | ErrorKind::QuotaExceeded => {
            "; free some space and run the same command again: what is done stays"
        }
        ErrorKind::PermissionDenied | ErrorKind::ReadOnlyFilesystem => "; choose another folder",
        ErrorKind::NotADirectory | ErrorKind::AlreadyExists => "; a file is where a folder is needed",
        _ => "",
    };
    FolderError::System {
        file: file.into(),
        what: "written",
        reason,
        hint,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plan::tests::{item, plan};

    fn done(folder: &Folder, plan: &Plan) -> Vec<Earlier<u32>> {
        plan.items.iter().map(|item| folder.earlier(item).unwrap()).collect()
    }

    #[test]
    fn what_is_done_is_known_again_and_what_has_changed_is_named() {
        let here = tempfile::tempdir().unwrap();
        let mut plan = plan("0,50", &["late/0", "late/50", "late/100"]);
        let folder = Folder::open(here.path(), &plan).unwrap();
        for (item, result) in plan.items.iter().zip([7, 8]) {
            folder.begin(item).unwrap();
            folder.finish(item, &result).unwrap();
        }
        plan.items[1] = item("late/50", "another log");
        let error = Folder::open(here.path(), &plan).unwrap_err();
        assert!(matches!(error, FolderError::Busy { .. }), "{error}");
        drop(folder);
        let folder = Folder::open(here.path(), &plan).unwrap();
        let found = done(&folder, &plan);
        assert_eq!((&found[0], &found[2]), (&Earlier::Done(7), &Earlier::None));
        assert!(
            matches!(&found[1], Earlier::Changed(part) if part.starts_with("log: ")),
            "{found:?}"
        );
        folder.begin(&plan.items[0]).unwrap();
        assert_eq!(done(&folder, &plan)[0], Earlier::None, "it runs again");
    }

    #[test]
    fn what_is_made_again_replaces_what_was_there_only_once_it_is_done() {
        let here = tempfile::tempdir().unwrap();
        let plan = plan("0,50", &["late/0", "late/50"]);
        let folder = Folder::open(here.path(), &plan).unwrap();
        let item = &plan.items[0];
        fs::write(folder.begin(item).unwrap().join("a"), "old").unwrap();
        folder.finish(item, &7).unwrap();
        let made = folder.begin_anew(item).unwrap();
        fs::write(made.join("half"), "").unwrap();
        assert_eq!(done(&folder, &plan)[0], Earlier::Done(7));
        let again = folder.begin_anew(item).unwrap();
        assert!(again == made && !made.join("half").exists());
        fs::write(made.join("b"), "new").unwrap();
        folder.replace(item, &8).unwrap();
        folder.begin_anew(&plan.items[1]).unwrap();
        folder.replace(&plan.items[1], &9).unwrap();
        assert_eq!(done(&folder, &plan), [Earlier::Done(8), Earlier::Done(9)]);
        let at = folder.of(item);
        assert!(at.join("b").exists() && !at.join("a").exists());
        assert!(!here.path().join(ANEW).exists(), "nothing is left over");
    }

    #[test]
    fn a_folder_of_another_plan_is_refused_with_the_value() {
        let here = tempfile::tempdir().unwrap();
        Folder::open(here.path(), &plan("0,50", &["a"])).unwrap();
        let error = Folder::open(here.path(), &plan("0,60", &["a"]))
            .unwrap_err()
            .to_string();
        assert!(
            error.contains("--vary link.delay_ms: `0,60` here, `0,50` there"),
            "{error}"
        );
        fs::write(here.path().join(PLAN_FILE), "{\"schema\": \"mine\", \"version\": 3}").unwrap();
        let error = Folder::open(here.path(), &plan("0,50", &["a"]))
            .unwrap_err()
            .to_string();
        assert!(
            error.contains("plan.json") && error.contains("found mine version 3"),
            "{error}"
        );
        let empty = tempfile::tempdir().unwrap();
        let error = Folder::of_shard(empty.path(), &plan("0", &["a"])).unwrap_err();
        assert!(matches!(error, FolderError::NoPlan { .. }));
    }

    #[test]
    fn shards_come_together_and_one_of_other_logs_is_refused() {
        let folders = [
            tempfile::tempdir().unwrap(),
            tempfile::tempdir().unwrap(),
            tempfile::tempdir().unwrap(),
        ];
        let plan = plan("0,50", &["a", "b", "c"]);
        let [here, one, two] = folders
            .each_ref()
            .map(|folder| Folder::open(folder.path(), &plan).unwrap());
        for (folder, at) in [(&one, 0), (&one, 1), (&two, 2)] {
            let item = &plan.items[at];
            fs::write(folder.begin(item).unwrap().join("result.json"), at.to_string()).unwrap();
            folder.finish(item, &at).unwrap();
        }
        assert_eq!(
            (here.merge(&one, &plan).unwrap(), here.merge(&one, &plan).unwrap()),
            (2, 0)
        );
        let mut other = plan.clone();
        other.items[2] = item("c", "another log");
        let nowhere = here.path.join("nowhere");
        let refused = |shards: &[Folder], plan: &Plan| Folder::refuse_changed(&nowhere, shards, plan);
        let error = refused(std::slice::from_ref(&two), &other).unwrap_err().to_string();
        assert!(error.contains("`c`") && error.contains("log: "), "{error}");
        refused(std::slice::from_ref(&two), &plan).unwrap();
        assert!(!nowhere.exists());
        let error = here.merge(&two, &other).unwrap_err().to_string();
        assert!(error.contains("`c`") && error.contains("log: "), "{error}");
        assert_eq!(here.merge(&two, &plan).unwrap(), 1);
        assert_eq!(
            done(&here, &plan),
            [Earlier::Done(0), Earlier::Done(1), Earlier::Done(2)]
        );
        let text = fs::read_to_string(here.of(&plan.items[2]).join("result.json")).unwrap();
        assert_eq!(text, "2");
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn a_full_disk_leaves_no_record_and_says_what_helps() {
        let here = tempfile::tempdir().unwrap();
        let plan = plan("0", &["a"]);
        let folder = Folder::open(here.path(), &plan).unwrap();
        let record = folder.begin(&plan.items[0]).unwrap().join(RECORD_FILE);
        let partial = record.with_extension(format!("json.{}.partial", std::process::id()));
        std::os::unix::fs::symlink("/dev/full", &partial).unwrap();
        let error = folder.finish(&plan.items[0], &1).unwrap_err().to_string();
        assert!(
            error.contains("done.json") && error.contains("free some space"),
            "{error}"
        );
        assert_eq!(done(&folder, &plan), [Earlier::None]);
    }
}
