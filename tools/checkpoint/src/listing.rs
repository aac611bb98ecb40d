//! What a file of weights holds, as a table.

use std::collections::HashMap;
use std::fmt;
use std::fs::File;
use std::io::{self, Read};
use std::path::{Path, PathBuf};

use realo_methods::Model;
use realo_nn::model::Architecture;
use realo_nn::weights::is_counter;
use safetensors::{SafeTensorError, SafeTensors};

use crate::checkpoint::{Checkpoint, ReadError};
use crate::convert::{fits, fitting};
use crate::shown;

/// A file of weights has at most so many bytes.
const MOST_BYTES: u64 = 1 << 31;

/// What a file of weights holds.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Listing {
    /// Its tensors in the order of the file.
    pub rows: Vec<Row>,
    /// Entries of the state dict that are no tensors.
    pub others: Vec<String>,
    /// The key under which the state dict was found, if not at the top.
    pub within: Option<String>,
    /// The epoch that it has.
    pub epoch: Option<i64>,
    /// The model that has these tensors, in words.
    pub model: Option<String>,
    /// The sentence that says why the model file beside it is not used, if there is one.
    pub not_beside: Option<String>,
}

/// A tensor.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Row {
    /// Name.
    pub name: String,
    /// Size of each dimension.
    pub shape: Vec<usize>,
    /// Type of its numbers.
    pub dtype: String,
}

/// Why a file was not listed.
#[derive(Debug, thiserror::Error)]
pub enum ListError {
    /// A checkpoint.
    #[error(transparent)]
    Checkpoint(#[from] ReadError),
    /// A safetensors file that cannot be read.
    #[error("{}: {error}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What failed.
        error: io::Error,
    },
    /// A file that is not safetensors.
    #[error("{}: {error}", path.display())]
    Safetensors {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        error: SafeTensorError,
    },
}

/// Lists a checkpoint of PyTorch, or a safetensors file by its ending.
///
/// # Errors
/// A file that cannot be read.
pub fn list(path: &Path) -> Result<Listing, ListError> {
    let mut listing = match path.extension().is_some_and(|ending| ending == "safetensors") {
        true => of_safetensors(path)?,
        false => of_checkpoint(&Checkpoint::open(path)?),
    };
    let weights = listing.rows.iter().filter(|row| !is_counter(&row.name));
    let shapes: HashMap<&str, &[usize]> = weights.map(|row| (&*row.name, &*row.shape)).collect();
    let beside = path.with_extension("toml");
    let (own, not_beside) = match Model::read(&beside) {
        Ok(model) if fits(&model, &shapes) => (Some(model), None),
        Ok(model) => (
            None,
            Some(format!(
                "the model file beside it, {}, is for other tensors: those of `{}`",
                beside.display(),
                model.name
            )),
        ),
        Err(error) if beside.exists() => (None, Some(format!("the model file beside it cannot be read: {error}"))),
        Err(_) => (None, None),
    };
    let model = match own {
        Some(model) => Some(format!("those of model `{}`, {}", model.name, beside.display())),
        None => fitting(&shapes).map(|model| {
            let compression = model.arch.sharing().map_or(0, |sharing| sharing.compression);
            let compressor = match compression {
                0 => String::new(),
                times => format!(", compression {times}"),
            };
            format!("those of --arch {} at V2X-Real's full size{compressor}", model.arch)
        }),
    };
    (listing.model, listing.not_beside) = (model, not_beside);
    Ok(listing)
}

fn of_checkpoint(checkpoint: &Checkpoint) -> Listing {
    let row = |(name, shape, dtype): (&str, &[usize], crate::Dtype)| Row {
        name: name.into(),
        shape: shape.into(),
        dtype: dtype.to_string(),
    };
    Listing {
        rows: checkpoint.tensors().map(row).collect(),
        others: checkpoint.others().to_vec(),
        within: checkpoint.within().map(str::to_string),
        epoch: checkpoint.epoch(),
        model: None,
        not_beside: None,
    }
}

fn of_safetensors(path: &Path) -> Result<Listing, ListError> {
    let read = || -> io::Result<Vec<u8>> {
        let mut bytes = Vec::new();
        File::open(path)?.take(MOST_BYTES + 1).read_to_end(&mut bytes)?;
        match bytes.len() as u64 > MOST_BYTES {
            true => Err(io::Error::other(
                "expected at most 2 GiB of weights, found more; list its parts one by one",
            )),
            false => Ok(bytes),
        }
    };
    let bytes = read().map_err(|error| ListError::Io {
        path: path.into(),
        error,
    })?;
    let (_, header) = SafeTensors::read_metadata(&bytes).map_err(|error| ListError::Safetensors {
        path: path.into(),
        error,
    })?;
    let mut tensors: Vec<_> = header.tensors().into_iter().collect();
    tensors.sort_by_key(|(_, info)| info.data_offsets);
    let row = |(name, info): (String, &safetensors::tensor::TensorInfo)| Row {
        name,
        shape: info.shape.clone(),
        dtype: format!("{:?}", info.dtype),
    };
    Ok(Listing {
        rows: tensors.into_iter().map(row).collect(),
        others: Vec::new(),
        within: None,
        epoch: None,
        model: None,
        not_beside: None,
    })
}

impl fmt::Display for Listing {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let rows: Vec<[String; 3]> = self
            .rows
            .iter()
            .map(|row| [shown(&row.name), format!("{:?}", row.shape), row.dtype.clone()])
            .collect();
        let width = |column: usize| rows.iter().map(|row| row[column].chars().count()).max().unwrap_or(0);
        let [names, shapes] = [width(0), width(1)];
        for [name, shape, dtype] in &rows {
            writeln!(f, "{name:names$}  {shape:shapes$}  {dtype}")?;
        }
        for name in &self.others {
            writeln!(f, "{:names$}  no tensor", shown(name))?;
        }
        let counters = self.rows.iter().filter(|row| is_counter(&row.name)).count();
        let weights = self.rows.iter().filter(|row| !is_counter(&row.name));
        let numbers = weights.fold(0usize, |sum, row| {
            let count = row.shape.iter().fold(1usize, |count, size| count.saturating_mul(*size));
            sum.saturating_add(count)
        });
        let tensors = self.rows.len() - counters;
        write!(
            f,
            "{tensors} tensors with {numbers} numbers; {counters} more count batches of the training and are not used"
        )?;
        if let Some(within) = &self.within {
            write!(f, ", under `{within}`")?;
        }
        if let Some(epoch) = self.epoch {
            write!(f, ", epoch {epoch}")?;
        }
        match (&self.model, &self.not_beside) {
            (Some(model), _) => write!(f, "\nnames and shapes are {model}")?,
            (None, Some(_)) => write!(f, "\nnames and shapes are those of no network of V2X-Real at full size")?,
            (None, None) => write!(
                f,
                "\nnames and shapes are those of no network of V2X-Real at full size, and no model file lies beside it"
            )?,
        }
        match &self.not_beside {
            Some(sentence) => write!(f, "\n{sentence}"),
            None => Ok(()),
        }
    }
}
