//! Which runs are there already, and what a run is known by.

use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::Path;

use eyre::{Result, WrapErr};
use realo_graph::FlatGraph;
use realo_results::{RESULT_FILE, Told};
use sha2::{Digest, Sha256};

use super::folders;
use super::prepare::{Cell, TOLD};

/// Of a log so many bytes are looked at, at its beginning and at its end, where MCAP keeps its index and counts.
const ENDS: u64 = 1 << 16;

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
pub fn earlier(cell: &Cell) -> Earlier {
    folders::recover(&cell.out);
    let complete = cell.out.join(RESULT_FILE).exists()
        && realo_results::read_run(&cell.out).is_ok_and(|run| run.result.complete && run.result.ended_by.is_none());
    if !complete {
        return Earlier::None;
    }
    let told = std::fs::read(cell.out.join(TOLD)).ok();
    let told = told.and_then(|text| serde_json::from_slice::<Told>(&text).ok());
    match told.is_some_and(|told| told.fingerprint == cell.fingerprint()) {
        true => Earlier::Same,
        false => Earlier::Other,
    }
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
        for (port, input) in &node.inputs {
            add(&format!("{port} {}", input.source));
        }
        add(&format!("{:?}", node.env));
    }
    add(&ends(log).wrap_err_with(|| log.display().to_string())?);
    Ok(hex(&hash.finalize()))
}

/// A hash of a file; `None` where there is none.
fn content(path: &Path) -> Option<String> {
    if !path.is_file() {
        return None;
    }
    std::fs::read(path).ok().map(|bytes| hex(&Sha256::digest(bytes)))
}

/// A log by its length and its two ends: logs are too long to be read for this.
fn ends(log: &Path) -> Result<String> {
    let mut file = File::open(log)?;
    let length = file.metadata()?.len();
    let mut hash = Sha256::new();
    hash.update(length.to_le_bytes());
    for from in [0, length.saturating_sub(ENDS)] {
        let mut bytes = Vec::new();
        file.seek(SeekFrom::Start(from))?;
        (&mut file).take(ENDS).read_to_end(&mut bytes)?;
        hash.update(bytes);
    }
    Ok(hex(&hash.finalize()))
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
