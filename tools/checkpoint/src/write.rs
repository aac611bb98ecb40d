//! A converted model as two files: weights, and the model file beside them.

use std::fs::{self, File};
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use realo_methods::Model;
use realo_nn::model::ModelError;
use realo_nn::weights::{expected, sha256};
use safetensors::Dtype;
use safetensors::tensor::TensorView;

use crate::convert::Converted;

/// What was written.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Written {
    /// The weights.
    pub weights: PathBuf,
    /// The model file to run.
    pub model: PathBuf,
    /// Whether the model file was there, and stayed as it is.
    pub model_was_there: bool,
    /// Tensors and the numbers in them.
    pub tensors: [usize; 2],
}

/// Why nothing was written.
#[derive(Debug, thiserror::Error)]
pub enum WriteError {
    /// Not a name of weights.
    #[error("{}: expected a file name that ends in .safetensors", .0.display())]
    Name(PathBuf),
    /// Not a name of a model.
    #[error("{}: its name becomes the model's: {error}", path.display())]
    Model {
        /// The weights to be written.
        path: PathBuf,
        /// What is wrong with the name.
        error: Box<ModelError>,
    },
    /// There is something.
    #[error("{}: is there already: name another file, or say --force to replace it", .0.display())]
    Exists(PathBuf),
    /// A file that cannot be written.
    #[error(
        "cannot write {}: {error}; nothing of it was left, and a file that was there before stays as it was{}; free space there, or \
         name another place",
        path.display(),
        beside(written.as_deref())
    )]
    Io {
        /// The file.
        path: PathBuf,
        /// What failed.
        error: io::Error,
        /// The weights, which were written before it.
        written: Option<PathBuf>,
    },
}

impl WriteError {
    /// The same, of a file that was to follow these weights.
    fn after(self, weights: &Path) -> Self {
        match self {
            WriteError::Io { path, error, .. } => WriteError::Io {
                path,
                error,
                written: Some(weights.into()),
            },
            other => other,
        }
    }
}

/// Writes weights to `output` and beside them, under the same name, a model file that depends on no other. Where `output` are
/// the weights that `model_file`, from which the model came, asks for, that one stays as it is.
///
/// A file that is there is only replaced with `force`; a kill or a full disk leaves the one before.
///
/// # Errors
/// [`WriteError`]; nothing is replaced then, but for the weights where the model file cannot be written.
pub fn write(
    converted: &Converted,
    output: &Path,
    model_file: Option<&Path>,
    force: bool,
) -> Result<Written, WriteError> {
    let name = output.file_stem().and_then(|stem| stem.to_str());
    let name = name.filter(|_| output.extension().is_some_and(|ending| ending == "safetensors"));
    let name = name.ok_or_else(|| WriteError::Name(output.into()))?;
    let asked_for = |file: &&Path| same(&converted.model.weights_beside(file)[0], output);
    let kept = model_file.filter(asked_for);
    let model = kept.map_or_else(|| output.with_extension("toml"), Path::to_path_buf);

    let new = [Some(output), (kept.is_none()).then_some(&*model)];
    if let Some(there) = new.into_iter().flatten().find(|path| !force && path.exists()) {
        return Err(WriteError::Exists(there.into()));
    }
    let (bytes, tensors) = serialized(converted);
    let text = match kept {
        None => Some(text(converted, name, output, &bytes)?),
        Some(_) => None,
    };
    write_whole(output, &bytes)?;
    if let Some(text) = &text {
        write_whole(&model, text.as_bytes()).map_err(|error| error.after(output))?;
    }
    Ok(Written {
        weights: output.into(),
        model,
        model_was_there: kept.is_some(),
        tensors,
    })
}

/// Whether two paths are one file in one folder, which need not be there.
fn same(a: &Path, b: &Path) -> bool {
    let folder = |path: &Path| {
        let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty());
        folder.unwrap_or(Path::new(".")).canonicalize().ok()
    };
    a.file_name() == b.file_name() && folder(a).is_some() && folder(a) == folder(b)
}

fn text(converted: &Converted, name: &str, output: &Path, weights: &[u8]) -> Result<String, WriteError> {
    let model = Model {
        name: name.into(),
        weights: None,
        encoder: None,
        compressor: None,
        sha256: [(name.into(), sha256(weights))].into(),
        ..converted.model.clone()
    };
    model.validate().map_err(|error| WriteError::Model {
        path: output.into(),
        error: Box::new(error),
    })?;
    let settings = toml::to_string(&model).expect("a model is plain data");
    let (of, origin) = (&converted.model.name, &converted.origin);
    Ok(format!(
        "# Weights of {origin}.\n# Grid, anchors and thresholds, which no checkpoint tells, are those of `{of}`.\n{settings}"
    ))
}

/// The weights as a file, and how many tensors and numbers there are.
fn serialized(converted: &Converted) -> (Vec<u8>, [usize; 2]) {
    let tensors: Vec<(String, Vec<usize>, Vec<u8>)> = expected(&converted.model)
        .into_iter()
        .map(|(key, shape)| {
            let numbers = converted.weights.tensor(&key).iter();
            let bytes = numbers.flat_map(|number| number.to_le_bytes()).collect();
            (key, shape, bytes)
        })
        .collect();
    let views = tensors.iter().map(|(key, shape, bytes)| {
        let view = TensorView::new(Dtype::F32, shape.clone(), bytes).expect("bytes of the tensor's shape");
        (key.as_str(), view)
    });
    let numbers = tensors.iter().map(|(.., bytes)| bytes.len() / 4).sum();
    let file = safetensors::serialize(views, None).expect("views that were checked");
    (file, [tensors.len(), numbers])
}

fn write_whole(path: &Path, bytes: &[u8]) -> Result<(), WriteError> {
    let part = path.with_added_extension("part");
    let write = || {
        let mut file = File::create(&part)?;
        file.write_all(bytes)?;
        file.sync_all()?;
        fs::rename(&part, path)
    };
    write().map_err(|error| {
        // What could not be finished is of no use; that it cannot be removed either changes nothing.
        let _ = fs::remove_file(&part);
        WriteError::Io {
            path: path.into(),
            error,
            written: None,
        }
    })
}

/// The weights that stay where the model file beside them could not be written.
fn beside(written: Option<&Path>) -> String {
    written.map_or_else(String::new, |weights| {
        format!("; the weights are in {}, without a model file", weights.display())
    })
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::symlink;

    use super::*;

    #[test]
    fn a_full_disk_leaves_what_was_there_and_says_so() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("mine.safetensors");
        fs::write(&path, "the weights before").unwrap();
        symlink("/dev/full", folder.path().join("mine.safetensors.part")).unwrap();
        let error = write_whole(&path, b"other weights").unwrap_err();
        let said = error.to_string();
        for part in [
            "mine.safetensors",
            "No space left",
            "stays as it was",
            "free space there",
        ] {
            assert!(said.contains(part), "{part} is not in {said}");
        }
        assert_eq!(fs::read(&path).unwrap(), b"the weights before");
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1, "the part is gone");
        let model = error.after(&path).to_string();
        assert!(model.contains("without a model file"), "{model}");
    }
}
