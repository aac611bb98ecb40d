//! The demo log: made once, under a lock, when a graph needs it.

use std::fs::{self, File};
use std::path::Path;

use crate::program;
use eyre::{Result, WrapErr};

/// Where the demo log lies below the folder of a target.
pub const FILE: &str = "realo/demo.mcap";

/// Makes the demo log at `path` by `write` unless it is there; of several processes one makes it and the others wait.
///
/// # Errors
/// Why it could not be written.
pub fn make(path: &Path, write: impl FnOnce(&Path) -> Result<()>) -> Result<()> {
    if path.exists() {
        return Ok(());
    }
    let folder = path.parent().unwrap_or(Path::new("."));
    fs::create_dir_all(folder).wrap_err_with(|| no_demo(folder))?;
    let lock_path = path.with_extension("lock");
    let lock = File::create(&lock_path).wrap_err_with(|| no_demo(&lock_path))?;
    lock.lock().wrap_err_with(|| format!("{}: lock", lock_path.display()))?;
    if !path.exists() {
        eprintln!("{}: making the demo log {} (once)", program::name(), path.display());
        write(path)?;
    }
    Ok(())
}

fn no_demo(path: &Path) -> String {
    format!(
        "{}: the demo log cannot be made there; name a log of your own (--log), or make one with `realo-lab simulate`",
        path.display()
    )
}
