//! Where a graph's files lie.

use std::path::{Component, Path, PathBuf};

use super::GraphError;

/// The path from the root, `.` and `..` resolved by name alone.
pub(super) fn absolute(path: &Path) -> Result<PathBuf, GraphError> {
    std::path::absolute(path)
        .map(|path| normalized(&path))
        .map_err(GraphError::read(path))
}

/// The path without `.` and `..`, resolved by name alone (no link is followed), as dora does.
pub fn normalized(path: &Path) -> PathBuf {
    let mut out = PathBuf::new();
    for component in path.components() {
        match component {
            Component::CurDir => {}
            Component::ParentDir => {
                out.pop();
            }
            other => out.push(other),
        }
    }
    out
}

/// Whether `path` names something other than a file: dora's `dynamic` and `shell` nodes, or an address.
fn is_special(path: &str) -> bool {
    path == "dynamic" || path == "shell" || path.contains("://")
}

/// A module node's `path` as the graph in `root` would write it.
pub(super) fn from_module(path: &str, module_dir: &Path, root: &Path) -> Result<String, String> {
    if is_special(path) || Path::new(path).is_absolute() {
        return Ok(path.to_string());
    }
    let resolved = normalized(&module_dir.join(path));
    match resolved.strip_prefix(root) {
        Ok(inside) => Ok(inside.to_string_lossy().into_owned()),
        Err(_) => Err(format!(
            "its path `{path}` leaves the graph's folder (it is {}), which dora refuses within modules; \
             name a link inside the folder, as `../bin/realo`",
            resolved.display()
        )),
    }
}

/// The file that a node of a graph in `root` runs; a bare name that is not in the folder is left to the system's search.
pub(super) fn of_node(path: &str, root: &Path) -> PathBuf {
    let joined = normalized(&root.join(path));
    let bare = !path.contains('/') && !joined.exists();
    if is_special(path) || bare {
        PathBuf::from(path)
    } else {
        joined
    }
}

/// A module's file and folder, as dora resolves and confines them.
pub(super) struct ModuleFile {
    /// The file without symbolic links; names a module in cycles.
    pub canonical: PathBuf,
    /// The folder that the module's own paths start from.
    pub folder: PathBuf,
}

/// Finds a module's file, which must lie in the graph's folder or in a folder that a link there names.
pub(super) fn module(module: &str, base: &Path, root: &Path) -> Result<ModuleFile, String> {
    if Path::new(module).is_absolute() {
        return Err(format!(
            "its file `{module}` must be given relative to the file that uses it"
        ));
    }
    let escapes = || format!("its file `{module}` lies outside the graph's folder {}", root.display());
    let named = normalized(&base.join(module));
    let missing = |error: std::io::Error| format!("its file {}: {error}", named.display());
    let canonical = base.join(module).canonicalize().map_err(missing)?;
    let same_by_name = named.canonicalize().ok().as_ref() == Some(&canonical);
    if !named.starts_with(root) || !same_by_name {
        return Err(escapes());
    }
    let real_root = root.canonicalize().map_err(missing)?;
    let linked = first_link(module, base);
    if !canonical.starts_with(&real_root) && !linked.is_some_and(|target| canonical.starts_with(target)) {
        return Err(escapes());
    }
    let folder = named.parent().map(Path::to_path_buf).unwrap_or_default();
    Ok(ModuleFile { canonical, folder })
}

/// Finds the file of a module that `realo host` runs, wherever it lies.
pub(super) fn hosted_module(module: &str, base: &Path) -> Result<ModuleFile, String> {
    let named = normalized(&base.join(module));
    let canonical = named
        .canonicalize()
        .map_err(|error| format!("its file {}: {error}", named.display()))?;
    let folder = named.parent().map(Path::to_path_buf).unwrap_or_default();
    Ok(ModuleFile { canonical, folder })
}

/// What the first symbolic link along the way names.
fn first_link(module: &str, base: &Path) -> Option<PathBuf> {
    let mut current = base.to_path_buf();
    for component in Path::new(module).components() {
        match component {
            Component::Normal(name) => {
                current.push(name);
                if current.is_symlink() {
                    return current.canonicalize().ok();
                }
            }
            Component::ParentDir => {
                current.pop();
            }
            _ => {}
        }
    }
    None
}
