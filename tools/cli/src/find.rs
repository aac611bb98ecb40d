//! The files of graphs and models that are given by their names.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

use crate::program;
use eyre::{Result, bail};
use realo_operator::config::nearest_name;

/// Graphs of which it was said which file their names stand for: once is enough.
static SAID: Mutex<BTreeSet<PathBuf>> = Mutex::new(BTreeSet::new());

/// The file of a graph: the path as it is, or, of a name without a folder, `NAME.yml` here, then that of the shipped
/// graphs. Says which file a name stands for.
///
/// # Errors
/// Neither; with the nearest name, and those of all shipped graphs.
pub fn graph(path: &Path) -> Result<PathBuf> {
    if path.exists() && !path.is_dir() {
        return Ok(path.into());
    }
    let found = named(path, &folders(), GRAPHS);
    match found {
        Some(found) => {
            let is_new = SAID
                .lock()
                .unwrap_or_else(PoisonError::into_inner)
                .insert(found.clone());
            if is_new {
                eprintln!("{}: {} is {}", program::name(), path.display(), found.display());
            }
            Ok(found)
        }
        None => bail!("{}", unknown(path, &folders(), GRAPHS)),
    }
}

/// The model file: the path as it is, or, of a name without a folder, `NAME.toml` here, then that of the shipped models.
///
/// # Errors
/// Neither; with the nearest name, and those of all shipped models.
pub fn model(path: &Path) -> Result<PathBuf> {
    if path.exists() && !path.is_dir() {
        return Ok(path.into());
    }
    let beside = |graphs: PathBuf| graphs.with_file_name("models");
    let folders: Vec<PathBuf> = folders().into_iter().map(beside).collect();
    match named(path, &folders, MODELS) {
        Some(found) => Ok(found),
        None => bail!("{}", unknown(path, &folders, MODELS)),
    }
}

/// What a name stands for.
#[derive(Clone, Copy)]
struct Shipped {
    /// The file, in words.
    file: &'static str,
    /// All that ship, in words.
    all: &'static str,
    /// How file names end, the usual one first.
    endings: &'static [&'static str],
}

const GRAPHS: Shipped = Shipped {
    file: "the file of a graph",
    all: "shipped graphs",
    endings: &["yml", "yaml"],
};

const MODELS: Shipped = Shipped {
    file: "a model file",
    all: "shipped models",
    endings: &["toml"],
};

/// The checkout whose graphs are meant by their names.
pub fn checkout() -> Option<PathBuf> {
    let folder = folders().into_iter().next()?;
    Some(folder.parent()?.to_path_buf())
}

/// Where shipped graphs may be: in the checkout that this program lies in, the one of the current folder, and the one that
/// it was built from.
fn folders() -> Vec<PathBuf> {
    let above = |path: PathBuf| path.ancestors().map(Path::to_path_buf).collect::<Vec<_>>();
    let program = std::env::current_exe().and_then(|path| path.canonicalize());
    let here = std::env::current_dir();
    let built = Path::new(env!("CARGO_MANIFEST_DIR")).to_path_buf();
    let all = [program.ok(), here.ok(), Some(built)];
    let all = all.into_iter().flatten().flat_map(above);
    let mut folders: Vec<PathBuf> = Vec::new();
    for folder in all.map(|folder| folder.join("dataflows")) {
        if folder.join("modules").is_dir() && !folders.contains(&folder) {
            folders.push(folder);
        }
    }
    folders
}

/// The file of a name without a folder.
fn named(path: &Path, folders: &[PathBuf], shipped: Shipped) -> Option<PathBuf> {
    if path.components().count() != 1 {
        return None;
    }
    let name = path.to_str()?;
    let endings = shipped.endings.iter().map(|ending| format!("{name}.{ending}"));
    let names: Vec<String> = std::iter::once(name.to_string()).chain(endings).collect();
    let here = std::iter::once(Path::new(""));
    let mut all = here.chain(folders.iter().map(PathBuf::as_path));
    all.find_map(|folder| {
        let files = names.iter().map(|name| folder.join(name));
        files.into_iter().find(|file| file.is_file())
    })
}

/// Names of the graphs or models in a folder.
fn names_in(folder: &Path, shipped: Shipped) -> Vec<String> {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    let files = entries.map(|entry| entry.path()).filter(|path| path.is_file());
    let named = files.filter(|path| path.extension().is_some_and(|ending| ending == shipped.endings[0]));
    let mut names: Vec<String> = named
        .filter_map(|path| Some(path.file_stem()?.to_str()?.to_string()))
        // It lies beside the models that it makes.
        .filter(|name| !name.ends_with(".recipe"))
        .collect();
    names.sort();
    names
}

fn unknown(path: &Path, folders: &[PathBuf], kind: Shipped) -> String {
    let found = if path.is_dir() { "a folder" } else { "nothing there" };
    let shipped = folders.first().map(|folder| names_in(folder, kind)).unwrap_or_default();
    let name = path.with_extension("");
    let name = name.file_name().unwrap_or_default().to_string_lossy();
    let parent = path.parent().unwrap_or(Path::new(""));
    let beside = if parent.as_os_str().is_empty() {
        Path::new(".")
    } else {
        parent
    };
    let beside = names_in(beside, kind);
    let near = nearest_name(&name, beside.iter().map(String::as_str));
    let hint = match near {
        Some(near) => format!(
            " (did you mean `{}`?)",
            parent.join(format!("{near}.{}", kind.endings[0])).display()
        ),
        None => nearest_name(&name, shipped.iter().map(String::as_str))
            .map(|near| format!(" (did you mean `{near}`?)"))
            .unwrap_or_default(),
    };
    format!(
        "{}: expected {}, found {found}{hint}; {} go by their names: {}",
        path.display(),
        kind.file,
        kind.all,
        shipped.join(", ")
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_is_a_shipped_graph_and_a_wrong_one_gets_the_nearest() {
        let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../dataflows");
        let folders = [root.clone()];
        for name in ["late_fusion", "late_fusion.yml"] {
            assert_eq!(
                named(Path::new(name), &folders, GRAPHS),
                Some(root.join("late_fusion.yml"))
            );
        }
        assert_eq!(
            named(Path::new("x/late_fusion"), &folders, GRAPHS),
            None,
            "a path is a path"
        );
        for (path, expected) in [
            ("late_fuson", "(did you mean `late_fusion`?)"),
            ("dataflow/late_fusion.yml", "(did you mean `late_fusion`?)"),
            ("nothing_like_it", "shipped graphs go by their names: attfuse"),
        ] {
            let said = unknown(Path::new(path), &folders, GRAPHS);
            assert!(said.contains(expected), "{said}");
        }
        let beside = root.join("attfuze.yml");
        let said = unknown(&beside, &folders, GRAPHS);
        assert!(said.contains("dataflows/attfuse.yml`?)"), "{said}");
        assert!(unknown(&root, &folders, GRAPHS).contains("found a folder"));
    }

    #[test]
    fn a_name_is_a_shipped_model_and_a_path_is_a_path() {
        let shipped = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../models/lite.toml");
        let shipped = shipped.canonicalize().unwrap();
        for path in [Path::new("lite"), Path::new("lite.toml"), &shipped] {
            assert_eq!(model(path).unwrap().canonicalize().unwrap(), shipped);
        }
        let said = model(Path::new("lit")).unwrap_err().to_string();
        assert!(
            said.contains("(did you mean `lite`?)") && said.contains("lite-v2xvit"),
            "{said}"
        );
        let said = model(Path::new("nowhere/lite.toml")).unwrap_err().to_string();
        assert!(said.contains("expected a model file, found nothing there"), "{said}");
    }
}
