//! Which runs are there already, and what a run is known by.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};
use std::time::SystemTime;

use eyre::{Result, WrapErr, bail};
use realo_cli::Progress;
use realo_graph::FlatGraph;
use realo_logs::McapFile;
use realo_results::{FilesError, RESULT_FILE, RunSettings};
use sha2::{Digest, Sha256};

use super::prepare::{RunPlan, SETTINGS_FILE};
use super::{folders, named};

/// What is read of a log at once, bytes.
const BLOCK: usize = 1 << 20;
/// Reading a log of so many bytes may take long.
const LONG: u64 = 1 << 30;

/// What a folder holds of a run.
pub enum Earlier {
    /// No complete run.
    None,
    /// The same run, complete.
    Same,
    /// A complete run of something else.
    Other,
}

/// What the folder of a run holds. What a killed run put aside there is put back first.
///
/// # Errors
/// Results of another version, which a run would replace.
pub fn earlier(plan: &RunPlan) -> Result<Earlier> {
    folders::recover(&plan.out);
    let complete = match plan
        .out
        .join(RESULT_FILE)
        .exists()
        .then(|| realo_results::read_run(&plan.out))
    {
        Some(Err(error @ FilesError::Version { .. })) => {
            bail!("--resume: {error}; or drop --resume, which replaces these results, or choose another --out")
        }
        Some(Ok(run)) => run.result.complete && run.result.ended_by.is_none(),
        _ => false,
    };
    let is_whole = |path: &PathBuf| McapFile::open(path).is_ok_and(|file| file.truncation().is_none());
    if !complete || !plan.recordings().iter().all(is_whole) {
        return Ok(Earlier::None);
    }
    match is_of(&plan.out, plan.fingerprint()) {
        true => Ok(Earlier::Same),
        false => Ok(Earlier::Other),
    }
}

/// Whether a folder has the complete results of the run of a fingerprint.
pub fn is_in(folder: &Path, fingerprint: &str) -> bool {
    let whole = |run: realo_results::Run| run.result.complete && run.result.ended_by.is_none();
    is_of(folder, fingerprint) && realo_results::read_run(folder).is_ok_and(whole)
}

/// Whether the last run that was prepared in a folder has a fingerprint.
fn is_of(folder: &Path, fingerprint: &str) -> bool {
    let reported = std::fs::read(folder.join(SETTINGS_FILE)).ok();
    let reported = reported.and_then(|text| serde_json::from_slice::<RunSettings>(&text).ok());
    reported.is_some_and(|reported| reported.fingerprint == fingerprint)
}

/// A hash of what decides a run: the stages, their arguments and wires, the files that arguments name, the log, what else
/// is `decided` of it, and the version of this program. Where the results and the log lie does not matter, so that runs of
/// several machines can be brought together.
///
/// # Errors
/// A log that cannot be read.
pub fn fingerprint(graph: &FlatGraph, log: &Path, out: &Path, decided: &[String]) -> Result<String> {
    let mut hash = Sha256::new();
    let mut add = |text: &str| {
        hash.update((text.len() as u64).to_le_bytes());
        hash.update(text.as_bytes());
    };
    add(env!("CARGO_PKG_VERSION"));
    decided.iter().for_each(|text| add(text));
    let folder = graph.file.parent().unwrap_or(Path::new("/"));
    let [log_text, out_text] = [log, out].map(|path| path.to_string_lossy().into_owned());
    for node in &graph.nodes {
        add(&node.id);
        for argument in &node.args {
            let (key, value) = argument.split_once('=').unwrap_or(("", argument));
            add(key);
            if value == log_text {
                add("the log");
                continue;
            }
            // What lies among the results comes of the run.
            match content(&folder.join(value)).filter(|_| !value.starts_with(&out_text)) {
                Some(content) => add(&content),
                None => add(&value.replace(&out_text, "the results")),
            }
        }
        let program = node.program().map(|program| folder.join(program));
        for module in program.iter().flat_map(|program| named::modules(program)) {
            let name = module
                .strip_prefix(folder)
                .unwrap_or(&module)
                .to_string_lossy()
                .into_owned();
            add(&name);
            add(&content(&module).unwrap_or_default());
        }
        for (port, input) in &node.inputs {
            add(&format!("{port} {}", input.source));
        }
        add(&serde_json::to_string(&node.env).wrap_err_with(|| format!("node `{}`: env", node.id))?);
    }
    add(&log_content(log).wrap_err_with(|| log.display().to_string())?);
    Ok(hex(&hash.finalize()))
}

/// A hash of a file; `None` where there is none.
fn content(path: &Path) -> Option<String> {
    if !path.is_file() {
        return None;
    }
    std::fs::read(path).ok().map(|bytes| hex(&Sha256::digest(bytes)))
}

/// A hash of a log, which is read once for all runs over it.
pub fn log_content(log: &Path) -> Result<String> {
    static KNOWN: Mutex<BTreeMap<(PathBuf, u64, SystemTime), String>> = Mutex::new(BTreeMap::new());
    let about = log.metadata()?;
    let version = (log.canonicalize()?, about.len(), about.modified()?);
    let known = || KNOWN.lock().unwrap_or_else(PoisonError::into_inner);
    let found = known().get(&version).cloned();
    if let Some(found) = found {
        return Ok(found);
    }
    let hash = hash_of(log)?;
    known().insert(version, hash.clone());
    Ok(hash)
}

fn hash_of(log: &Path) -> Result<String> {
    let mut file = File::open(log)?;
    let length = file.metadata()?.len();
    let progress = (length > LONG).then(|| {
        let name = log.file_name().unwrap_or_default().to_string_lossy();
        Progress::new(format!("reading {name}"), "MB", Some(length as f64 / 1e6))
    });
    let mut hash = blake3::Hasher::new();
    let mut block = vec![0; BLOCK];
    loop {
        let read = file.read(&mut block)?;
        if read == 0 {
            break;
        }
        hash.update(&block[..read]);
        if let Some(progress) = &progress {
            progress.add(read as f64 / 1e6);
        }
    }
    Ok(hex(hash.finalize().as_bytes()))
}

fn hex(bytes: &[u8]) -> String {
    bytes[..16].iter().map(|byte| format!("{byte:02x}")).collect()
}

#[cfg(test)]
mod tests {
    use std::path::PathBuf;

    use super::*;

    fn print(graph: &FlatGraph, folder: &Path, out: &str) -> String {
        fingerprint(graph, &folder.join("log.mcap"), Path::new(out), &["mode".into()]).unwrap()
    }

    #[test]
    fn a_log_is_known_by_all_its_bytes_and_not_by_its_name_or_time() {
        let folder = tempfile::tempdir().unwrap();
        let hash = |name: &str, bytes: &[u8]| {
            let path = folder.path().join(name);
            std::fs::write(&path, bytes).unwrap();
            log_content(&path).unwrap()
        };
        let mut bytes = vec![7; 3 * BLOCK + 5];
        let first = hash("a.mcap", &bytes);
        assert_eq!(first, hash("copy.mcap", &bytes));
        // Neither its length nor its ends.
        bytes[BLOCK + BLOCK / 2] ^= 1;
        assert_ne!(first, hash("changed.mcap", &bytes));
    }

    #[test]
    fn a_run_is_known_by_the_modules_of_its_programs() {
        let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
        let mut graph = FlatGraph::load(&root.join("dataflows/late_fusion.yml")).unwrap();
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        for name in ["log.mcap", "mine.py", "maths.py"] {
            std::fs::write(at(name), "a").unwrap();
        }
        let text = format!("fusion.fusion=program {}", at("mine.py").display());
        graph.replace(&text.parse().unwrap()).unwrap();
        let print = || print(&graph, folder.path(), "/a");
        let first = print();
        std::fs::write(at("notes.md"), "b").unwrap();
        assert_eq!(first, print(), "it imports no notes");
        std::fs::write(at("maths.py"), "b").unwrap();
        assert_ne!(first, print(), "a module beside it");
    }

    #[test]
    fn a_run_is_known_by_all_that_decides_it_and_not_by_its_place() {
        let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
        let load = || FlatGraph::load(&root.join("dataflows/late_fusion.yml")).unwrap();
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| -> PathBuf { folder.path().join(name) };
        std::fs::write(at("log.mcap"), vec![7; 300_000]).unwrap();
        std::fs::write(at("profile.toml"), "a").unwrap();
        let graph = |out: &str, link: &str| {
            let mut graph = load();
            graph.set("score.results", "out", out).unwrap();
            graph.set("player", "log", &at("log.mcap").to_string_lossy()).unwrap();
            graph.set("v2x.link", "profile", link).unwrap();
            graph
        };
        let profile = at("profile.toml").to_string_lossy().into_owned();
        let first = print(&graph("/a/b", &profile), folder.path(), "/a/b");
        assert_eq!(first, print(&graph("/c", &profile), folder.path(), "/c"), "elsewhere");
        assert_ne!(
            first,
            print(&graph("/a/b", "perfect"), folder.path(), "/a/b"),
            "an argument"
        );
        let inside = graph(&folder.path().to_string_lossy(), "perfect");
        let within = |graph: &FlatGraph| {
            let out = folder.path().join("out");
            let mut graph = graph.clone();
            let recording = out.join("recording.mcap");
            graph
                .set("score.recorder", "path", &recording.to_string_lossy())
                .unwrap();
            print(&graph, folder.path(), &out.to_string_lossy())
        };
        let empty = within(&inside);
        std::fs::create_dir(at("out")).unwrap();
        std::fs::write(at("out/recording.mcap"), "boxes").unwrap();
        assert_eq!(empty, within(&inside), "what a run leaves does not decide it");
        std::fs::write(at("profile.toml"), "b").unwrap();
        let second = print(&graph("/a/b", &profile), folder.path(), "/a/b");
        assert_ne!(first, second, "a file that an argument names");
        std::fs::write(at("log.mcap"), vec![7; 300_001]).unwrap();
        assert_ne!(
            second,
            print(&graph("/a/b", &profile), folder.path(), "/a/b"),
            "the log"
        );
        let gone = fingerprint(&load(), &at("gone.mcap"), Path::new("/a"), &[]);
        assert!(gone.unwrap_err().to_string().contains("gone.mcap"));
    }
}
