//! The folders of runs.

use std::fs;
use std::path::{Path, PathBuf};

use realo_results::FilesError;

use super::prepare::TOLD;

/// The folders that were made for runs. Those that hold nothing when it is dropped are taken away, so that a run that
/// fails before its first message leaves nothing behind.
#[derive(Default)]
pub(super) struct Folders {
    /// Outer ones before those in them.
    made: Vec<PathBuf>,
}

impl Folders {
    /// Makes a folder and takes away an earlier run's results.
    ///
    /// # Errors
    /// Files of those names that no run of realo wrote.
    pub fn claim(&mut self, folder: &Path) -> Result<(), FilesError> {
        let missing = folder
            .ancestors()
            .take_while(|folder| !folder.as_os_str().is_empty() && !folder.exists());
        let missing: Vec<PathBuf> = missing.map(Path::to_path_buf).collect();
        self.made.extend(missing.into_iter().rev());
        realo_results::claim(folder)
    }
}

impl Drop for Folders {
    fn drop(&mut self) {
        for folder in self.made.iter().rev() {
            let Ok(entries) = fs::read_dir(folder) else { continue };
            let names: Vec<_> = entries.flatten().map(|entry| entry.file_name()).collect();
            // What was to be told of a run that told nothing.
            if names.iter().all(|name| name == TOLD) {
                let _ = fs::remove_file(folder.join(TOLD));
                let _ = fs::remove_dir(folder);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_was_made_and_holds_nothing_is_taken_away() {
        let root = tempfile::tempdir().unwrap();
        let at = |path: &str| root.path().join(path);
        fs::create_dir(at("there")).unwrap();
        {
            let mut folders = Folders::default();
            for folder in ["there", "there/out/a", "there/out/b", "made/c/d", "made/e"] {
                folders.claim(&at(folder)).unwrap();
            }
            fs::write(at("made/c/d").join(TOLD), "{}").unwrap();
            fs::write(at("there/out/b/dora.log"), "it failed").unwrap();
        }
        assert!(at("there/out/b/dora.log").exists());
        for gone in ["there/out/a", "made"] {
            assert!(!at(gone).exists(), "{gone}");
        }
        drop(Folders::default().claim(&at("there")));
        assert!(at("there").exists(), "it was there before");
    }
}
