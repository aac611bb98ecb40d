//! The module `realo._realo`: what the Python package `realo` takes from Rust.
//!
//! Data cross as Arrow: messages as the rows of [`realo_schemas::wire`], which are what plug-ins exchange too, tables as record
//! batches, documents as JSON. What is checked here names the argument; the package checks shapes before.

mod boxes;
mod evaluation;
mod log;
mod messages;
mod run;

use std::fmt::Display;

use arrow_array::{Array, RecordBatch};
use arrow_data::ArrayData;
use arrow_pyarrow::PyArrowType;
use pyo3::exceptions::{PyFileNotFoundError, PyValueError};
use pyo3::prelude::*;
use realo_logs::LogError;
use realo_schemas::{Message, wire};

/// A message as Python gets it.
type Row = PyArrowType<ArrayData>;
/// A table as Python gets it.
type Columns = PyArrowType<RecordBatch>;

fn row(message: &Message) -> Row {
    PyArrowType(wire::to_arrow(message).to_data())
}

/// A refused value, by the name of its argument.
fn refused(argument: &str, reason: impl Display) -> PyErr {
    PyValueError::new_err(format!("`{argument}`: {reason}"))
}

/// A file that cannot be read. One that is not there is what Python calls it.
fn unreadable(argument: &str, error: &LogError) -> PyErr {
    match error {
        LogError::Io { reason, .. } if reason.kind() == std::io::ErrorKind::NotFound => {
            PyFileNotFoundError::new_err(format!("`{argument}`: {error}"))
        }
        _ => refused(argument, error),
    }
}

/// Logs, results, the evaluator and geometry of realo.
#[pymodule]
mod _realo {
    #[pymodule_export]
    use crate::boxes::{corners, iou, nms, transform};
    #[pymodule_export]
    use crate::evaluation::{classes_of, evaluate};
    #[pymodule_export]
    use crate::log::LogFile;
    #[pymodule_export]
    use crate::messages::{Messages, recorded};
    #[pymodule_export]
    use crate::run::{RunFiles, pool, shown};
}
