//! Pools the results of runs exactly and prints them side by side.
//!
//! - [`pool`]: several logs and egos as one run; scores come from the frames of all, not from means of scores.
//! - [`opening`]: the few numbers of each run that matter.
//! - [`shown`]: runs as text for a terminal, Markdown, CSV, LaTeX or JSON.
//! - [`differences`]: why runs should not be compared number by number.
//! - [`read_run`], [`write_run`]: folders of runs, see `docs/reference/results.md`.

mod cells;
mod columns;
mod differences;
mod foot;
mod formats;
mod graphs;
mod list;
mod opening;
mod pool;
mod sections;
mod settings;
mod table;
#[cfg(test)]
mod tests;
mod text;
mod words;

pub use differences::differences;
pub use foot::notes;
pub use opening::opening;
pub use pool::{PoolError, pool};
pub use realo_results::{FilesError, Run, read_run, write_run};
pub use settings::has_recorded_detections;

use serde_json::{Value, json as value};

/// How runs are shown.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Format {
    /// Text for a terminal.
    #[default]
    Text,
    /// A Markdown table.
    Markdown,
    /// Comma-separated values: numbers as they are, and all settings.
    Csv,
    /// A LaTeX `tabular`.
    Latex,
    /// All of `result.json` and `timing.json`.
    Json,
}

/// What is shown of runs, and how.
#[derive(Clone, Copy, Debug)]
pub struct Options {
    /// As what.
    pub format: Format,
    /// All rows, with a column for each run; else the main ones.
    pub full: bool,
    /// Columns of the terminal.
    pub width: usize,
}

impl Default for Options {
    /// The main rows, for a terminal of 80 columns.
    fn default() -> Self {
        Options {
            format: Format::Text,
            full: false,
            width: 80,
        }
    }
}

/// Runs with their names: as text side by side, from three runs on with a row for each.
pub fn shown(runs: &[(&str, &Run)], options: &Options) -> String {
    if options.format == Format::Json {
        return json(runs) + "\n";
    }
    let names: Vec<String> = runs.iter().map(|(name, _)| text::one_line(name)).collect();
    let runs: Vec<(&str, &Run)> = names
        .iter()
        .zip(runs)
        .map(|(name, (_, run))| (name.as_str(), *run))
        .collect();
    text::printable(&as_text(&runs, options))
}

fn as_text(runs: &[(&str, &Run)], options: &Options) -> String {
    match (options.format, options.full) {
        (Format::Json, _) => unreachable!("it is no table"),
        (Format::Text, false) if runs.len() > table::SIDE_BY_SIDE => list::list(runs, options.width),
        (Format::Text, _) => table::table(runs, options),
        (Format::Markdown, _) => formats::markdown(runs, options.full),
        (Format::Csv, _) => formats::csv(runs, options.full),
        (Format::Latex, _) => formats::latex(runs, options.full),
    }
}

/// All settings and numbers of runs as columns of a table for programs: the names of the columns, each with its values.
pub fn fields(runs: &[&Run]) -> Vec<(String, Vec<String>)> {
    let columns = columns::exact(runs).into_iter();
    let values = |column: &columns::Column| column.cells.iter().map(columns::Cell::exact).collect();
    columns.map(|column| (column.field.clone(), values(&column))).collect()
}

/// Runs with their names as a JSON document: `{"common": {…}, "differences": […], "runs": [{"name", "result", "timing"}]}`, the
/// last two as in `result.json` and `timing.json`, without the samples; `common` has what all runs were made with, and what all
/// that have such a thing share; `differences` as [`differences`] says them.
fn json(runs: &[(&str, &Run)]) -> String {
    let run = |(name, run): &(&str, &Run)| {
        let mut timing = serde_json::to_value(&run.timing).unwrap_or_default();
        if let Some(fields) = timing.as_object_mut() {
            fields.shift_remove("samples");
        }
        value!({"name": name, "result": run.result, "timing": timing})
    };
    let (common, differences) = (settings::common_fields(runs), differences(runs));
    let runs: Vec<Value> = runs.iter().map(run).collect();
    format!(
        "{:#}",
        value!({"common": common, "differences": differences, "runs": runs})
    )
}
