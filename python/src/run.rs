//! Results of runs.

use std::path::PathBuf;
use std::sync::Arc;

use arrow_array::types::{ArrowPrimitiveType, Float32Type, Float64Type, Int64Type, UInt64Type};
use arrow_array::{ArrayRef, PrimitiveArray, StringArray};
use pyo3::exceptions::PyFileNotFoundError;
use pyo3::prelude::*;
use realo_report::{Format, Options};
use realo_results::scoring::{Evaluation, Frame, Outline, Scene, frame_scores};
use realo_results::{FilesError, Run, read_run, write_run};

use crate::log::table;
use crate::{Columns, refused};

/// A run: what its folder holds.
#[pyclass(frozen, module = "realo._realo")]
pub struct RunFiles {
    run: Run,
}

impl RunFiles {
    pub fn of(run: Run) -> Self {
        RunFiles { run }
    }

    fn evaluation(&self) -> PyResult<&Evaluation> {
        let evaluation = self.run.samples.evaluation.as_ref();
        evaluation.ok_or_else(|| refused("run", "expected a run that was evaluated, found one without frames"))
    }
}

#[pymethods]
impl RunFiles {
    /// Reads the folder of a complete run.
    #[staticmethod]
    fn read(py: Python, folder: PathBuf) -> PyResult<Self> {
        let run = py.detach(|| read_run(&folder));
        run.map(RunFiles::of).map_err(|error| match &error {
            FilesError::NoFolder { .. } | FilesError::Incomplete { .. } => {
                PyFileNotFoundError::new_err(format!("`folder`: {error}"))
            }
            _ => refused("folder", error),
        })
    }

    /// Writes the folder of the run.
    fn write(&self, py: Python, folder: PathBuf) -> PyResult<()> {
        py.detach(|| write_run(&folder, &self.run))
            .map_err(|error| refused("folder", error))
    }

    /// `result.json`.
    fn result(&self) -> PyResult<String> {
        serde_json::to_string(&self.run.result).map_err(|error| refused("run", error))
    }

    /// `timing.json`.
    fn timing(&self) -> PyResult<String> {
        serde_json::to_string(&self.run.timing).map_err(|error| refused("run", error))
    }

    /// `evaluation.json`.
    fn samples(&self) -> PyResult<String> {
        serde_json::to_string(&self.run.samples).map_err(|error| refused("run", error))
    }

    /// True and false detections and objects of each scored frame, class and IoU.
    fn frames(&self, py: Python) -> PyResult<Columns> {
        let evaluation = self.evaluation()?;
        let scores = py.detach(|| frame_scores(evaluation));
        let mut rows = Vec::new();
        for frame in &scores {
            for (class, ious) in &frame.counts {
                rows.extend(ious.iter().map(|(iou, counts)| (frame, class, iou, counts)));
            }
        }
        table([
            ("log", texts(&rows, |row| &row.0.scene)),
            ("ego", texts(&rows, |row| &row.0.ego)),
            ("seq", numbers::<UInt64Type, _>(&rows, |row| row.0.seq)),
            ("stamp", numbers::<Int64Type, _>(&rows, |row| row.0.stamp)),
            ("class", texts(&rows, |row| row.1)),
            (
                "iou",
                numbers::<Float64Type, _>(&rows, |row| row.2.parse().unwrap_or(f64::NAN)),
            ),
            ("true", numbers::<UInt64Type, _>(&rows, |row| row.3.true_positives)),
            ("false", numbers::<UInt64Type, _>(&rows, |row| row.3.false_positives)),
            ("objects", numbers::<UInt64Type, _>(&rows, |row| row.3.total)),
        ])
    }

    /// The boxes that were scored: detections, or objects, whose score is 1. Places, extents and headings as they were rounded.
    fn scored(&self, detections: bool) -> PyResult<Columns> {
        let evaluation = self.evaluation()?;
        let mut rows: Vec<(&Scene, &Frame, u8, f32, Outline)> = Vec::new();
        for scene in &evaluation.scenes {
            for frame in &scene.frames {
                let row = |class, score, outline| (scene, frame, class, score, outline);
                match detections {
                    true => rows.extend(frame.detections.iter().map(|d| row(d.class, d.score, d.outline))),
                    false => rows.extend(frame.truths.iter().map(|t| row(t.class, 1.0, t.outline))),
                }
            }
        }
        let classes = &evaluation.protocol.classes;
        table([
            ("log", texts(&rows, |row| &row.0.name)),
            ("ego", texts(&rows, |row| &row.0.ego)),
            ("seq", numbers::<UInt64Type, _>(&rows, |row| row.1.seq)),
            ("stamp", numbers::<Int64Type, _>(&rows, |row| row.1.stamp)),
            ("class", texts(&rows, |row| &classes[usize::from(row.2)].name)),
            ("score", numbers::<Float32Type, _>(&rows, |row| row.3)),
            ("x", numbers::<Float64Type, _>(&rows, |row| row.4.center_m()[0])),
            ("y", numbers::<Float64Type, _>(&rows, |row| row.4.center_m()[1])),
            (
                "length",
                numbers::<Float64Type, _>(&rows, |row| f64::from(row.4.length) / 1e6),
            ),
            (
                "width",
                numbers::<Float64Type, _>(&rows, |row| f64::from(row.4.width) / 1e6),
            ),
            (
                "yaw",
                numbers::<Float64Type, _>(&rows, |row| f64::from(row.4.yaw) / 1e8),
            ),
        ])
    }
}

/// A column of texts.
fn texts<'a, R>(rows: &'a [R], of: impl Fn(&'a R) -> &'a str) -> ArrayRef {
    Arc::new(StringArray::from_iter_values(rows.iter().map(of)))
}

/// A column of numbers.
fn numbers<T: ArrowPrimitiveType, R>(rows: &[R], of: impl Fn(&R) -> T::Native) -> ArrayRef {
    Arc::new(PrimitiveArray::<T>::from_iter_values(rows.iter().map(of)))
}

/// Several runs of the same settings as one, scored over the frames of all.
#[pyfunction]
pub fn pool(runs: Vec<PyRef<RunFiles>>) -> PyResult<RunFiles> {
    let runs: Vec<Run> = runs.iter().map(|run| run.run.clone()).collect();
    let pooled = realo_report::pool(&runs).map_err(|error| refused("runs", error))?;
    Ok(RunFiles::of(pooled))
}

/// Runs with their names as `realo compare` prints them.
#[pyfunction]
pub fn shown(
    names: Vec<String>,
    runs: Vec<PyRef<RunFiles>>,
    format: &str,
    full: bool,
    width: usize,
) -> PyResult<String> {
    let format = match format {
        "table" => Format::Text,
        "md" => Format::Markdown,
        "csv" => Format::Csv,
        "latex" => Format::Latex,
        "json" => Format::Json,
        _ => {
            let reason = format!("expected table, md, csv, latex or json, found `{format}`");
            return Err(refused("format", reason));
        }
    };
    if names.len() != runs.len() {
        return Err(refused(
            "names",
            format!("expected {} names, one a run, found {}", runs.len(), names.len()),
        ));
    }
    let runs: Vec<(&str, &Run)> = names
        .iter()
        .map(String::as_str)
        .zip(runs.iter().map(|run| &run.run))
        .collect();
    Ok(realo_report::shown(&runs, &Options { format, full, width }))
}
