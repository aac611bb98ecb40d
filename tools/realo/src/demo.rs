//! The demo log: made once, under a lock, when a graph needs it.

use std::fs::{self, File};
use std::path::{Path, PathBuf};

use eyre::{Result, WrapErr};
use realo_graph::FlatNode;
use realo_simulator::Options;

use crate::run::argument;

/// Where the demo log lies below the folder of a target.
pub const FILE: &str = "realo/demo.mcap";

/// What is simulated for the demo log: two vehicles and a roadside unit at an intersection.
pub fn options() -> Options {
    Options {
        seed: 900,
        seconds: 10.0,
        agents: ["cav1", "cav2", "rsu1"].map(String::from).to_vec(),
        ..Options::default()
    }
}

/// Makes the demo log at `path` unless it is there; of several processes one makes it and the others wait.
///
/// # Errors
/// Why it could not be written.
pub fn make(path: &Path) -> Result<()> {
    if path.exists() {
        return Ok(());
    }
    let folder = path.parent().unwrap_or(Path::new("."));
    fs::create_dir_all(folder).wrap_err_with(|| no_demo(folder))?;
    let lock_path = path.with_extension("lock");
    let lock = File::create(&lock_path).wrap_err_with(|| no_demo(&lock_path))?;
    lock.lock().wrap_err_with(|| format!("{}: lock", lock_path.display()))?;
    if !path.exists() {
        eprintln!("realo: making the demo log {} (once)", path.display());
        crate::simulate::write(&options(), path)?;
    }
    Ok(())
}

fn no_demo(path: &Path) -> String {
    format!(
        "{}: the demo log cannot be made there; name a log of your own (--log), or make one with `realo simulate`",
        path.display()
    )
}

/// For a stage about to start: makes the log that it plays if that is the demo log and missing.
///
/// # Errors
/// As [`make`].
pub fn make_if_missing(stage: &FlatNode) -> Result<()> {
    let played = PathBuf::from(argument(stage, "log").unwrap_or_default());
    if played.ends_with(FILE) { make(&played) } else { Ok(()) }
}
