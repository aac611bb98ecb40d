//! Folders of data sets, as they are listed.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

use crate::ImportError;

/// A folder with its files and its folders.
#[derive(Default)]
pub struct Listed {
    /// Names.
    pub files: BTreeSet<String>,
    /// Paths, in order.
    pub folders: Vec<PathBuf>,
}

/// Lists a folder.
///
/// # Errors
/// One that cannot be read.
pub fn list(dir: &Path) -> Result<Listed, ImportError> {
    let mut listed = Listed::default();
    for entry in fs::read_dir(dir).map_err(ImportError::io(dir))? {
        let path = entry.map_err(ImportError::io(dir))?.path();
        let name = name_of(&path);
        match path.is_dir() {
            // `.git`, `__MACOSX` and the like.
            true if name.starts_with(['.', '_']) => {}
            true => listed.folders.push(path),
            false => drop(listed.files.insert(name)),
        }
    }
    listed.folders.sort();
    Ok(listed)
}

/// The number that a file's name is, and how it ends: `000068.yaml`, not `000068_camera0.png`.
pub fn frame_of(name: &str) -> Option<(u64, &str)> {
    let (stem, end) = name.rsplit_once('.')?;
    let is_number = !stem.is_empty() && stem.bytes().all(|byte| byte.is_ascii_digit());
    Some((stem.parse().ok().filter(|_| is_number)?, end))
}

/// The last part of a path.
pub fn name_of(path: &Path) -> String {
    path.file_name().unwrap_or_default().to_string_lossy().into_owned()
}

/// The name of the scene in a folder: its path below the data set's, else its own name.
pub fn scene_name(root: &Path, folder: &Path) -> String {
    let below = folder.strip_prefix(root).unwrap_or(folder).components();
    let names: Vec<String> = below
        .map(|part| part.as_os_str().to_string_lossy().into_owned())
        .collect();
    match names.is_empty() {
        true => name_of(&fs::canonicalize(folder).unwrap_or_else(|_| folder.into())),
        false => names.join("/"),
    }
}
