//! The demo log, for graphs that play it.

use std::path::{Path, PathBuf};

use eyre::Result;
pub use realo_cli::demo::FILE;
use realo_graph::FlatNode;

use crate::run::argument;

/// Makes the demo log at `path` unless it is there.
///
/// # Errors
/// Why it could not be written; a build without the feature `demo`, which has no simulator.
pub fn make(path: &Path) -> Result<()> {
    realo_cli::demo::make(path, write)
}

#[cfg(feature = "demo")]
fn write(path: &Path) -> Result<()> {
    use realo_cli::{Progress, unfinished};

    unfinished::note(path);
    let progress = Progress::new("simulating", "sweeps", Some(0.0));
    realo_simulator::write_log(&realo_simulator::Options::demo(), path, |far| match far.sweeps {
        0 => progress.begin(0.0, far.of as f64),
        sweeps => progress.set(sweeps as f64),
    })?;
    unfinished::done(path);
    progress.finish();
    Ok(())
}

#[cfg(not(feature = "demo"))]
fn write(path: &Path) -> Result<()> {
    eyre::bail!(
        "this program was built without the feature `demo`: make the log by `cargo run --release -p realo-lab -- simulate --seed 900 \
         --seconds 10 --agents cav1,cav2,rsu1 -o {}`, or name one (--log)",
        realo_logs::shell::word(path)
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
