//! Folders of data sets, as they are listed.

use std::cell::RefCell;
use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};
use std::rc::Rc;

use crate::ImportError;

/// A folder with its files and its folders.
#[derive(Default)]
pub struct Listed {
    /// Names.
    pub files: BTreeSet<String>,
    /// Paths, in order.
    pub folders: Vec<PathBuf>,
}

/// What is called with the number of folders that were listed.
type Look = Box<dyn FnMut(u64)>;

/// What is known of folders while a data set is looked at.
struct Known {
    folders: BTreeMap<PathBuf, Rc<Listed>>,
    /// How many were read.
    read: u64,
    look: Look,
}

thread_local! {
    /// Of the innermost [`FolderMemory`] that is there: kinds look at the same folders one after another.
    static KNOWN: RefCell<Option<Known>> = const { RefCell::new(None) };
}

/// While it lives, this thread reads each folder once: what kinds of data sets ask of it, and what the import then finds in it.
#[must_use = "folders are forgotten where it is dropped"]
pub struct FolderMemory {
    is_outer: bool,
}

impl FolderMemory {
    /// From now on; `look` is called with how many folders were read so far. Within another memory, that one goes on.
    pub fn new(look: impl FnMut(u64) + 'static) -> Self {
        KNOWN.with_borrow_mut(|known| {
            let is_outer = known.is_none();
            known.get_or_insert_with(|| Known {
                folders: BTreeMap::new(),
                read: 0,
                look: Box::new(look),
            });
            FolderMemory { is_outer }
        })
    }

    /// How many folders were read.
    pub fn read(&self) -> u64 {
        KNOWN.with_borrow(|known| known.as_ref().map_or(0, |known| known.read))
    }
}

impl Drop for FolderMemory {
    fn drop(&mut self) {
        if self.is_outer {
            KNOWN.set(None);
        }
    }
}

/// Lists a folder, as it was when it was read where a [`FolderMemory`] knows it.
///
/// # Errors
/// One that cannot be read.
pub fn list(dir: &Path) -> Result<Rc<Listed>, ImportError> {
    if let Some(listed) = KNOWN.with_borrow(|known| known.as_ref()?.folders.get(dir).cloned()) {
        return Ok(listed);
    }
    let listed = Rc::new(read(dir)?);
    KNOWN.with_borrow_mut(|known| {
        if let Some(known) = known {
            known.read += 1;
            (known.look)(known.read);
            known.folders.insert(dir.into(), listed.clone());
        }
    });
    Ok(listed)
}

fn read(dir: &Path) -> Result<Listed, ImportError> {
    let mut listed = Listed::default();
    for entry in fs::read_dir(dir).map_err(ImportError::io(dir))? {
        let entry = entry.map_err(ImportError::io(dir))?;
        let (path, kind) = (entry.path(), entry.file_type().map_err(ImportError::io(dir))?);
        let name = name_of(&path);
        // Only of a link the system must be asked once more.
        match kind.is_dir() || (kind.is_symlink() && path.is_dir()) {
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
