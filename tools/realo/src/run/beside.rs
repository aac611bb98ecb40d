//! Runs that were played before.

use std::path::{Path, PathBuf};

use realo_results::{RESULT_FILE, Run, read_run};

/// Folders beside a run's that are looked at for earlier runs.
const BESIDE: usize = 32;

/// Complete runs in the folders beside a run's, with their names. What cannot be read is none of this run's.
pub fn earlier(folder: &Path) -> Vec<(String, Run)> {
    let named = |path: PathBuf| Some((path.display().to_string(), read_run(&path).ok()?));
    folders(folder).into_iter().filter_map(named).collect()
}

/// Folders beside a run's that hold results.
pub fn folders(folder: &Path) -> Vec<PathBuf> {
    let beside = folder.parent().filter(|parent| !parent.as_os_str().is_empty());
    let Ok(entries) = std::fs::read_dir(beside.unwrap_or(Path::new("."))) else {
        return Vec::new();
    };
    let folders = entries.filter_map(|entry| Some(entry.ok()?.path()));
    let mut folders: Vec<PathBuf> = folders
        .filter(|path| path.file_name() != folder.file_name() && path.join(RESULT_FILE).is_file())
        .collect();
    folders.sort();
    folders.truncate(BESIDE);
    folders
}
