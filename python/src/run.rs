//! Results of runs.

use std::path::PathBuf;
use std::sync::Arc;

use arrow_array::{ArrayRef, Float32Array, Float64Array, Int64Array, StringArray, UInt64Array};
use pyo3::exceptions::PyFileNotFoundError;
use pyo3::prelude::*;
use realo_report::{Format, Options};
use realo_results::scoring::{Evaluation, Outline, Protocol, frame_scores};
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
        py.detach(|| write_run(&folder, &self.run)).map_err(|error| refused("folder", error))
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
        let scores = py.detach(|| Ok::<_, PyErr>(frame_scores(self.evaluation()?)))?;
        let rows = scores.iter().flat_map(|frame| {
            let classes = frame.counts.iter();
            classes.flat_map(move |(class, ious)| ious.iter().map(move |(iou, counts)| (frame, class, iou, counts)))
        });
        let rows: Vec<_> = rows.collect();
        let texts = |of: fn(&(_, _, _, _)) -> String| Arc::new(StringArray::from_iter_values(rows.iter().map(of)));
        let iou = rows.iter().map(|(_, _, iou, _)| iou.parse().unwrap_or(f64::NAN));
        let counts = |of: fn(&realo_results::scoring::Counts) -> u64| {
            Arc::new(UInt64Array::from_iter_values(rows.iter().map(|(.., counts)| of(counts))))
        };
        table([
            ("log", texts(|(frame, ..)| frame.scene.clone()) as ArrayRef),
            ("ego", texts(|(frame, ..)| frame.ego.clone())),
            ("seq", Arc::new(UInt64Array::from_iter_values(rows.iter().map(|row| row.0.seq)))),
            ("stamp", Arc::new(Int64Array::from_iter_values(rows.iter().map(|row| row.0.stamp)))),
            ("class", texts(|(_, class, ..)| class.to_string())),
            ("iou", Arc::new(Float64Array::from_iter_values(iou))),
            ("true", counts(|counts| counts.true_positives)),
            ("false", counts(|counts| counts.false_positives)),
            ("objects", counts(|counts| counts.total)),
        ])
    }

    /// The boxes that were scored: detections, or objects, for which `score` is 1. Extents, m, and headings are as they were rounded.
    fn scored(&self, detections: bool) -> PyResult<Columns> {
        let evaluation = self.evaluation()?;
        let mut rows: Vec<(&str, &str, u64, i64, u8, f32, Outline)> = Vec::new();
        for scene in &evaluation.scenes {
            for frame in &scene.frames {
                let row = |class, score, outline| (&*scene.name, &*scene.ego, frame.seq, frame.stamp, class, score, outline);
                match detections {
                    true => rows.extend(frame.detections.iter().map(|d| row(d.class, d.score, d.outline))),
                    false => rows.extend(frame.truths.iter().map(|t| row(t.class, 1.0, t.outline))),
                }
            }
        }
        let classes = &evaluation.protocol.classes;
        let names = rows.iter().map(|row| &*classes[usize::from(row.4)].name);
        let numbers = |of: fn(&Outline) -> f64| Arc::new(Float64Array::from_iter_values(rows.iter().map(|row| of(&row.6))));
        table([
            ("log", Arc::new(StringArray::from_iter_values(rows.iter().map(|row| row.0))) as ArrayRef),
            ("ego", Arc::new(StringArray::from_iter_values(rows.iter().map(|row| row.1)))),
            ("seq", Arc::new(UInt64Array::from_iter_values(rows.iter().map(|row| row.2)))),
            ("stamp", Arc::new(Int64Array::from_iter_values(rows.iter().map(|row| row.3)))),
            ("class", Arc::new(StringArray::from_iter_values(names))),
            ("score", Arc::new(Float32Array::from_iter_values(rows.iter().map(|row| row.5)))),
            ("x", numbers(|outline| outline.center_m()[0])),
            ("y", numbers(|outline| outline.center_m()[1])),
            ("length", numbers(|outline| f64::from(outline.length) * 1e-6)),
            ("width", numbers(|outline| f64::from(outline.width) * 1e-6)),
            ("yaw", numbers(|outline| f64::from(outline.yaw) * 1e-8)),
        ])
    }

    /// IoUs of the protocol, as results name them.
    fn ious(&self) -> PyResult<Vec<String>> {
        let protocol = &self.evaluation()?.protocol;
        Ok(protocol.ious.iter().map(|iou| Protocol::iou_key(*iou)).collect())
    }
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
pub fn shown(names: Vec<String>, runs: Vec<PyRef<RunFiles>>, format: &str, full: bool, width: usize) -> PyResult<String> {
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
        return Err(refused("names", format!("expected {} names, one a run, found {}", runs.len(), names.len())));
    }
    let runs: Vec<(&str, &Run)> = names.iter().map(String::as_str).zip(runs.iter().map(|run| &run.run)).collect();
    Ok(realo_report::shown(&runs, &Options { format, full, width }))
}
