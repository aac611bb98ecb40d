//! The folder of an export: it appears when it is complete, and replaces nothing but an earlier export.

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use crate::ExportError;

/// The file that lists what an export wrote, so that nothing else is ever replaced.
pub const MANIFEST: &str = "realo_export.json";

#[derive(Serialize, Deserialize)]
struct Manifest {
    program: String,
    kind: String,
    log: String,
    /// Files with their sizes, bytes.
    files: BTreeMap<String, u64>,
}

/// Refuses a place where something of somebody else is; to be called before anything is written.
///
/// # Errors
/// A file; a folder that is not empty, unless `replace` is set and an export alone is in it.
pub fn check(path: &Path, replace: bool) -> Result<(), ExportError> {
    const EXPECTED: &str = "an empty folder, or nothing";
    let occupied = |found: String, next| ExportError::Occupied {
        path: path.into(),
        expected: EXPECTED,
        found,
        next,
    };
    match fs::symlink_metadata(path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(()),
        Err(error) => return Err(ExportError::io(path, "look at")(error)),
        Ok(found) if !found.is_dir() => {
            return Err(occupied(
                "a file or a link".into(),
                "choose another path, or remove it first",
            ));
        }
        Ok(_) => {}
    }
    let files = files_below(path)?;
    let Some((first, _)) = files.first_key_value() else {
        return Ok(());
    };
    let text = fs::read_to_string(path.join(MANIFEST)).ok();
    let Some(manifest) = text.and_then(|text| serde_json::from_str::<Manifest>(&text).ok()) else {
        let found = format!("{} files of another program, as `{first}`", files.len());
        return Err(occupied(found, "choose another path, or remove them first"));
    };
    let is_foreign = |(name, size): &(&String, &u64)| *name != MANIFEST && manifest.files.get(*name) != Some(*size);
    if let Some((name, _)) = files.iter().find(is_foreign) {
        let found = format!("an export of realo in which another program wrote or changed `{name}`");
        return Err(occupied(found, "choose another path, or move that file away"));
    }
    match replace {
        true => Ok(()),
        false => Err(occupied(
            format!("an export of realo, `{}` of {}", manifest.kind, manifest.log),
            "choose another path, or --force to replace it",
        )),
    }
}

/// Files below a folder with their sizes, by their paths in it; folders without any are not there.
fn files_below(root: &Path) -> Result<BTreeMap<String, u64>, ExportError> {
    let (mut found, mut folders) = (BTreeMap::new(), vec![root.to_path_buf()]);
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(&folder).map_err(ExportError::io(&folder, "look into"))? {
            let entry = entry.map_err(ExportError::io(&folder, "look into"))?;
            let path = entry.path();
            let about = fs::symlink_metadata(&path).map_err(ExportError::io(&path, "look at"))?;
            if about.is_dir() {
                folders.push(path);
                continue;
            }
            let below = path.strip_prefix(root).unwrap_or(&path);
            found.insert(below.to_string_lossy().into_owned(), about.len());
        }
    }
    Ok(found)
}

/// A folder that is written beside its place, and renamed when it is finished.
#[derive(Debug)]
pub struct Folder {
    target: PathBuf,
    partial: PathBuf,
    files: BTreeMap<String, u64>,
    written: u64,
    /// Whoever clears up leaves what somebody writes.
    _lock: Option<File>,
}

impl Folder {
    /// Begins to write.
    ///
    /// # Errors
    /// As [`check`]; a folder that cannot be made.
    pub fn create(target: &Path, replace: bool) -> Result<Self, ExportError> {
        check(target, replace)?;
        let target = std::path::absolute(target).map_err(ExportError::io(target, "find"))?;
        let partial = beside(&target, "partial");
        if partial.exists() {
            fs::remove_dir_all(&partial).map_err(ExportError::io(&partial, "remove"))?;
        }
        fs::create_dir_all(&partial).map_err(ExportError::io(&target, "create"))?;
        let lock = File::open(&partial).ok();
        let _ = lock.as_ref().map(File::try_lock);
        Ok(Folder {
            target,
            partial,
            files: BTreeMap::new(),
            written: 0,
            _lock: lock,
        })
    }

    /// Writes a file; `name` has `/` between its folders.
    ///
    /// # Errors
    /// Why writing failed; nothing is left of the export then.
    pub fn write(&mut self, name: &str, bytes: &[u8]) -> Result<(), ExportError> {
        let write = |path: &Path| {
            if let Some(folder) = path.parent() {
                fs::create_dir_all(folder)?;
            }
            let mut file = File::create(path)?;
            file.write_all(bytes)?;
            file.flush()
        };
        write(&self.partial.join(name)).map_err(|reason| self.failed(name, reason))?;
        self.note(name, bytes.len() as u64);
        Ok(())
    }

    /// A file that its user writes, and [`Folder::take`]s when it is written.
    ///
    /// # Errors
    /// Why it cannot be created.
    pub fn file(&self, name: &str) -> Result<File, ExportError> {
        File::create(self.partial.join(name)).map_err(|reason| self.failed(name, reason))
    }

    /// Takes a file up that its user has written.
    ///
    /// # Errors
    /// A file that is not there.
    pub fn take(&mut self, name: &str) -> Result<u64, ExportError> {
        let about = fs::metadata(self.partial.join(name)).map_err(|reason| self.failed(name, reason))?;
        self.note(name, about.len());
        Ok(about.len())
    }

    fn note(&mut self, name: &str, size: u64) {
        self.written += size;
        self.files.insert(name.into(), size);
    }

    /// Bytes that were written so far.
    pub fn written(&self) -> u64 {
        self.written
    }

    /// Why writing stopped.
    pub fn failed(&self, name: &str, reason: io::Error) -> ExportError {
        self.failed_behind(name, 0, reason)
    }

    /// Why writing a file stopped of which so many bytes were written.
    pub fn failed_behind(&self, name: &str, bytes: u64, reason: io::Error) -> ExportError {
        ExportError::Unfinished {
            path: self.target.join(name),
            written: self.written + bytes,
            reason,
        }
    }

    /// Puts the folder to its place, which an earlier export leaves.
    ///
    /// # Errors
    /// What came there meanwhile; why it cannot be renamed.
    pub fn finish(mut self, kind: &str, log: &Path, replace: bool) -> Result<(), ExportError> {
        let manifest = Manifest {
            program: realo_logs::program(),
            kind: kind.into(),
            log: log.display().to_string(),
            files: self.files.clone(),
        };
        let mut text = serde_json::to_string_pretty(&manifest).expect("names and numbers are plain data");
        text.push('\n');
        self.write(MANIFEST, text.as_bytes())?;
        check(&self.target, replace)?;
        let old = beside(&self.target, "old.partial");
        let is_there = self.target.exists();
        if is_there {
            fs::rename(&self.target, &old).map_err(ExportError::io(&self.target, "move away"))?;
        }
        if let Err(reason) = fs::rename(&self.partial, &self.target) {
            // The earlier export is better than none.
            let _ = fs::rename(&old, &self.target);
            return Err(ExportError::io(&self.target, "rename the export to")(reason));
        }
        match is_there {
            true => fs::remove_dir_all(&old).map_err(ExportError::io(&old, "remove")),
            false => Ok(()),
        }
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        // What was finished is not there any more.
        let _ = fs::remove_dir_all(&self.partial);
    }
}

fn beside(target: &Path, ending: &str) -> PathBuf {
    let name = target.file_name().unwrap_or_default().to_string_lossy();
    target.with_file_name(format!("{name}.{}.{ending}", std::process::id()))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn write(target: &Path, files: &[(&str, &str)], replace: bool) -> Result<(), ExportError> {
        let mut folder = Folder::create(target, replace)?;
        for (name, text) in files {
            folder.write(name, text.as_bytes())?;
        }
        folder.finish("test", Path::new("a.mcap"), replace)
    }

    #[test]
    fn a_folder_appears_when_it_is_complete() {
        let dir = tempfile::tempdir().unwrap();
        let target = dir.path().join("out");
        let mut folder = Folder::create(&target, false).unwrap();
        folder.write("a/b.txt", b"text").unwrap();
        assert!(!target.exists());
        drop(folder);
        assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 0, "nothing is left of it");
        write(&target, &[("a/b.txt", "text")], false).unwrap();
        assert_eq!(fs::read_to_string(target.join("a/b.txt")).unwrap(), "text");
        assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 1);
    }

    #[test]
    fn only_an_export_is_replaced_and_only_by_force() {
        let dir = tempfile::tempdir().unwrap();
        let target = dir.path().join("out");
        fs::create_dir(&target).unwrap();
        write(&target, &[("old.txt", "1")], false).unwrap();
        let error = write(&target, &[("new.txt", "2")], false).unwrap_err().to_string();
        assert!(
            error.contains("found an export of realo, `test` of a.mcap") && error.contains("--force"),
            "{error}"
        );
        write(&target, &[("new.txt", "2")], true).unwrap();
        assert!(!target.join("old.txt").exists() && target.join("new.txt").exists());
        for (name, text) in [("mine.txt", "what I must not forget"), ("new.txt", "changed")] {
            let before = fs::read(target.join(name)).ok();
            fs::write(target.join(name), text).unwrap();
            let error = write(&target, &[], true).unwrap_err().to_string();
            assert!(error.contains(name) && error.contains("another program"), "{error}");
            assert_eq!(fs::read_to_string(target.join(name)).unwrap(), text);
            match before {
                Some(before) => fs::write(target.join(name), before).unwrap(),
                None => fs::remove_file(target.join(name)).unwrap(),
            }
        }
    }

    #[test]
    fn what_others_wrote_is_never_replaced() {
        let dir = tempfile::tempdir().unwrap();
        let notes = dir.path().join("notes");
        fs::write(&notes, "mine").unwrap();
        let error = write(&notes, &[], true).unwrap_err().to_string();
        assert!(error.contains("found a file"), "{error}");
        let error = write(dir.path(), &[], true).unwrap_err().to_string();
        assert!(
            error.contains("found 1 files of another program, as `notes`"),
            "{error}"
        );
        assert_eq!(fs::read_to_string(&notes).unwrap(), "mine");
    }
}
