//! Pools the results of runs exactly and prints them side by side.
//!
//! - [`pool`]: several logs and egos as one run; scores come from the frames of all, not from means of scores.
//! - [`table`]: runs side by side, for a terminal of 100 columns.
//! - [`differences`]: why runs should not be compared number by number.
//! - [`json`]: the same for scripts.
//! - [`read_run`], [`write_run`]: folders of runs, see `docs/results.md`.

mod cells;
mod differences;
mod pool;
mod sections;
mod table;
#[cfg(test)]
mod tests;

pub use differences::differences;
pub use pool::{PoolError, pool};
pub use realo_results::{FilesError, Run, read_run, write_run};
pub use table::table;

use serde_json::{Value, json as value};

/// Runs with their names as a JSON document: `{"differences": […], "runs": [{"name", "result", "timing"}]}`, the last two
/// as in `result.json` and `timing.json`, without the samples; the first as [`differences`] says them.
pub fn json(runs: &[(&str, &Run)]) -> String {
    let run = |(name, run): &(&str, &Run)| {
        let mut timing = serde_json::to_value(&run.timing).unwrap_or_default();
        if let Some(fields) = timing.as_object_mut() {
            fields.shift_remove("samples");
        }
        value!({"name": name, "result": run.result, "timing": timing})
    };
    let differences = differences(runs);
    let runs: Vec<Value> = runs.iter().map(run).collect();
    format!("{:#}", value!({"differences": differences, "runs": runs}))
}
