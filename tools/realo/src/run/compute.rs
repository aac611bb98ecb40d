//! The compute profile of a realtime run: what its stages really took.

use std::path::Path;

use eyre::Result;
use realo_host::ComputeProfile;
use realo_results::Run;

/// Writes `compute.toml`: the median duration of each stage's calls, by what triggered them.
pub fn write(dir: &Path, run: &Run) -> Result<()> {
    let profile = ComputeProfile::to_toml(&run.timing.compute_ns);
    let head =
        "# Median duration of each stage's calls in a realtime run, ns. For `realo run --mode virtual --compute`.\n";
    std::fs::write(dir.join("compute.toml"), format!("{head}{profile}"))?;
    Ok(())
}
