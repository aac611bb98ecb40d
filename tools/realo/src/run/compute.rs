//! The compute profile of a realtime run: what its stages really took.

use std::path::Path;

use eyre::Result;
use realo_results::Run;

/// Writes `compute.toml`: the median duration of each node's calls.
pub fn write(dir: &Path, run: &Run) -> Result<()> {
    let profile = run.timing.compute_profile();
    let head =
        "# Median duration of each node's calls in a realtime run, ns. For `realo run --mode virtual --compute`.\n";
    std::fs::write(dir.join("compute.toml"), format!("{head}{}", profile.to_toml()))?;
    Ok(())
}
