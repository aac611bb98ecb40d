//! How results name the files that decide a run: without their folders, with a hash of what they hold, so that two files of
//! one name are told apart.

use std::collections::{BTreeMap, VecDeque};
use std::fs;
use std::path::{Path, PathBuf};

use eyre::Result;
use realo_graph::{FlatGraph, Setting};
use sha2::{Digest, Sha256};

/// Digits of a hash.
pub const DIGITS: usize = 8;
/// Modules of a program, and folders that are searched for them, at most.
const MODULES: usize = 200;

/// A name with a hash of files behind it; the name alone without a file that can be read.
fn with_hash(name: &str, files: &[PathBuf]) -> String {
    let mut hash = Sha256::new();
    for file in files {
        let Ok(bytes) = fs::read(file) else { return name.into() };
        hash.update((bytes.len() as u64).to_le_bytes());
        hash.update(bytes);
    }
    if files.is_empty() {
        return name.into();
    }
    format!("{name}-{}", digits(hash))
}

/// The first digits of a hash, hexadecimal.
pub fn digits(hash: Sha256) -> String {
    let all = hash.finalize();
    all.iter().take(DIGITS / 2).map(|byte| format!("{byte:02x}")).collect()
}

/// A file: `radio.toml-1a2b3c4d`.
pub fn file(path: &Path) -> String {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    with_hash(&name, &[path.into()])
}

/// A profile in a file, without its ending; one that is built in by its name alone.
pub fn profile(path: &Path) -> String {
    let name = path.file_stem().unwrap_or_default().to_string_lossy();
    match path.is_file() {
        true => with_hash(&name, &[path.into()]),
        false => name.into_owned(),
    }
}

/// A link: its file, with the trace that the file names, and the settings behind it.
pub fn link(text: &str) -> String {
    let files = realo_stages::link::files(text);
    realo_stages::link::with_base(&realo_stages::link::in_words(text), |name| with_hash(name, &files))
}

/// A change by hand as results tell it: the argument and its value, a file by its name and a hash, for results hold no path.
pub fn change(setting: &Setting) -> (String, String) {
    let path = Path::new(&setting.value);
    // The last dot of an address may stand before its port: `tcp/10.0.0.1:7447`.
    let has_ending = |path: &Path| {
        path.extension()
            .is_some_and(|kind| !kind.to_string_lossy().contains(':'))
    };
    let is_path = path.is_absolute() || (path.components().count() > 1 && has_ending(path));
    let name = path.file_name().filter(|_| is_path);
    let value = name.map_or(setting.value.clone(), |name| match path.is_file() {
        true => file(path),
        false => name.to_string_lossy().into_owned(),
    });
    (format!("{}.{}", setting.node, setting.key), value)
}

/// The name of something built in as it is, a file absolute: nodes start in another folder than the user.
pub fn name_or_file(text: &str) -> Result<String> {
    if Path::new(text).components().count() == 1 && Path::new(text).extension().is_none() {
        return Ok(text.into());
    }
    Ok(std::path::absolute(text)?.to_string_lossy().into_owned())
}

/// The plug-ins of a graph, each behind its stage; a program in Python with the modules beside it.
pub fn programs(graph: &FlatGraph) -> String {
    let folder = graph.file.parent().unwrap_or(Path::new("/"));
    let named = graph.nodes.iter().filter_map(|node| {
        let path = folder.join(node.program()?);
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        let files: Vec<PathBuf> = std::iter::once(path.clone()).chain(modules(&path)).collect();
        Some((&node.id, with_hash(&name, &files)))
    });
    let named: BTreeMap<&String, String> = named.collect();
    let named: Vec<String> = named.iter().map(|(id, name)| format!("{id}={name}")).collect();
    named.join(", ")
}

/// What a program in Python may import from its folder and those below it, the nearest first; it itself is among them.
/// Nothing of other programs.
pub fn modules(program: &Path) -> Vec<PathBuf> {
    let is_python = |path: &Path| path.extension().is_some_and(|kind| kind == "py");
    let mut found = Vec::new();
    let first = program.parent().filter(|_| is_python(program));
    let mut folders: VecDeque<PathBuf> = first.map(PathBuf::from).into_iter().collect();
    for _ in 0..MODULES {
        let Some(folder) = folders.pop_front() else { break };
        let entries = fs::read_dir(&folder).into_iter().flatten().flatten();
        let mut paths: Vec<PathBuf> = entries.map(|entry| entry.path()).collect();
        paths.sort();
        for path in paths {
            // A link to a folder may lead back.
            let is_folder = path.is_dir() && !path.is_symlink();
            if is_folder && is_package(&path) {
                folders.push_back(path);
            } else if is_python(&path) && path.is_file() {
                found.push(path);
            }
        }
    }
    found.truncate(MODULES);
    found
}

/// Whether a folder may be one of modules: neither compiled ones, nor those of an environment.
fn is_package(folder: &Path) -> bool {
    let name = folder.file_name().unwrap_or_default().to_string_lossy();
    !name.contains('.') && name != "__pycache__" && !folder.join("pyvenv.cfg").exists()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_of_one_name_are_told_apart_by_what_they_hold() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str, text: &str| {
            let path = folder.path().join(name);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(&path, text).unwrap();
            path
        };
        let [a, b] = [("a/radio.toml", "[default]"), ("b/radio.toml", "")].map(|(name, text)| at(name, text));
        assert_ne!(file(&a), file(&b));
        assert_eq!(file(&a).len(), "radio.toml-".len() + DIGITS);
        assert!(profile(&a).starts_with("radio-") && profile(&a) != profile(&b));
        assert_eq!(profile(Path::new("paper")), "paper");
        let changed = |path: &Path| link(&format!("{},loss=0.1", path.display()));
        assert!(
            changed(&a).starts_with("radio-") && changed(&a).ends_with(",loss=0.1"),
            "{}",
            changed(&a)
        );
        assert_ne!(changed(&a), changed(&b));
        for named in ["paper", "perfect", "paper,loss=0.1", "delay_ms=90,loss=0.1"] {
            assert_eq!(link(named), named);
        }
        let traced = at("c/radio.toml", "[channel]\ntrace = \"way.csv\"");
        at("c/way.csv", "one");
        let first = link(&traced.to_string_lossy());
        at("c/way.csv", "other");
        assert_ne!(first, link(&traced.to_string_lossy()), "the trace");
    }

    #[test]
    fn modules_lie_beside_a_program_and_in_packages_below() {
        let folder = tempfile::tempdir().unwrap();
        for path in [
            "mine.py",
            "maths.py",
            "notes.md",
            "package/__init__.py",
            "package/deep/more.py",
            "__pycache__/old.py",
            ".git/hook.py",
            "venv/lib/site.py",
            "venv/pyvenv.cfg",
        ] {
            let path = folder.path().join(path);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, "").unwrap();
        }
        let found = modules(&folder.path().join("mine.py"));
        let found: Vec<_> = found
            .iter()
            .map(|path| path.strip_prefix(folder.path()).unwrap())
            .collect();
        let expected = ["maths.py", "mine.py", "package/__init__.py", "package/deep/more.py"];
        assert_eq!(found, expected.map(Path::new));
        assert!(modules(&folder.path().join("mine.sh")).is_empty());
    }

    #[test]
    fn results_tell_addresses_whole_and_files_by_their_names() {
        for (value, expected) in [
            ("tcp/127.0.0.1:7447", "tcp/127.0.0.1:7447"),
            ("tls/rsu1.local:7447", "tls/rsu1.local:7447"),
            ("tcp/10.0.0.1:7447,tcp/[::1]:7447", "tcp/10.0.0.1:7447,tcp/[::1]:7447"),
            ("north/crossing", "north/crossing"),
            ("/home/me/keys/cav1.key", "cav1.key"),
            ("/home/me/models", "models"),
            ("models/attfuse.toml", "attfuse.toml"),
            ("0.5", "0.5"),
        ] {
            let setting: Setting = format!("v2x.connect={value}").parse().unwrap();
            let reported = change(&setting);
            assert_eq!(reported, ("v2x.connect".to_string(), expected.to_string()));
        }
    }
}
