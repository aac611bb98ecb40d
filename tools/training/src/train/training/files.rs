//! Files that a training writes and locks.

use std::fs::{File, TryLockError};
use std::path::{Path, PathBuf};

use realo_nn::model::{Model, ModelFile};
use realo_nn::weights::sha256;

use super::Training;
use crate::TrainError;
use crate::checkpoint::{Checkpoint, write_weights};
use crate::data::write_whole;

/// Makes a folder, if it is not there, and keeps other trainings out of it.
pub(super) fn lock(folder: &Path) -> Result<File, TrainError> {
    let failed = |path: &Path, error| TrainError::Write {
        path: path.into(),
        error,
    };
    std::fs::create_dir_all(folder).map_err(|error| failed(folder, error))?;
    let path = folder.join("training.lock");
    // Whatever has that name is not emptied.
    let file = File::options().create(true).append(true).open(&path);
    let file = file.map_err(|error| failed(&path, error))?;
    match file.try_lock() {
        Ok(()) => Ok(file),
        Err(TryLockError::WouldBlock) => Err(TrainError::Busy { folder: folder.into() }),
        Err(TryLockError::Error(error)) => Err(failed(&path, error)),
    }
}

impl<'a> Training<'a> {
    /// The model file, and those that it extends, beside its weights, so that the folder can be given to `realo run --model`.
    pub(super) fn copy_model(&self, files: Vec<ModelFile>) -> Result<(), TrainError> {
        for (path, text) in files {
            // Sums are those of the weights that it began with.
            let text = without_sums(&text);
            let beside = self.options.output.join(path.file_name().unwrap_or_default());
            // A training that goes on may have been given its own copy.
            if !std::fs::read(&beside).is_ok_and(|there| there == text) {
                write_whole(&beside, &text)?;
            }
        }
        Ok(())
    }

    /// Adds the sums of the finished weights to the copy of the model file.
    pub(super) fn write_sums(&self) -> Result<(), TrainError> {
        let file = self
            .options
            .output
            .join(self.options.model.file_name().unwrap_or_default());
        let unreadable = |path: &Path| {
            let path = path.to_path_buf();
            move |error| TrainError::Write { path, error }
        };
        let mut text = without_sums(&std::fs::read(&file).map_err(unreadable(&file))?);
        text.extend(b"\n[sha256]   # of the files of weights, which are checked when they are loaded\n");
        for path in weights(&self.model, &self.options.output) {
            let sum = sha256(&std::fs::read(&path).map_err(unreadable(&path))?);
            let stem = path.file_stem().unwrap_or_default().to_string_lossy();
            text.extend(format!("{stem} = \"{sum}\"\n").into_bytes());
        }
        write_whole(&file, &text)
    }

    /// Whether weights beside the model file are what this training writes: a resumed one may be given its own copy of the model.
    pub(super) fn writes_beside_model(&self) -> bool {
        let found = |paths: Vec<PathBuf>| -> Vec<PathBuf> {
            let paths = paths.iter();
            paths.filter_map(|path| path.canonicalize().ok()).collect()
        };
        let own = found(weights(&self.model, &self.options.output));
        let beside = found(self.model.weights_beside(&self.options.model));
        beside.iter().any(|path| own.contains(path))
    }

    /// Writes everything; each file is replaced as a whole.
    pub(super) fn save(&self, state: &Checkpoint) -> Result<PathBuf, TrainError> {
        let output = |name: &str| self.options.output.join(name);
        if let (false, Some(point)) = (state.network.is_finite(), state.curve.points.last()) {
            return Err(TrainError::Diverged {
                step: point.step,
                loss: point.loss(),
            });
        }
        state.write(&self.checkpoint)?;
        let weights = weights(&self.model, &self.options.output);
        write_weights(&state.network, &weights)?;
        write_whole(&output("curve.csv"), state.curve.to_csv().as_bytes())?;
        write_whole(&output("curve.svg"), state.curve.to_svg().as_bytes())?;
        Ok(weights.into_iter().next().expect("a model has weights"))
    }
}

/// A model file without its table `sha256`, with all else as it was written.
pub(super) fn without_sums(text: &[u8]) -> Vec<u8> {
    let mut is_sums = false;
    let lines = text.split_inclusive(|byte| *byte == b'\n').filter(|line| {
        let line = line.trim_ascii();
        if line.starts_with(b"[") {
            is_sums = line.starts_with(b"[sha256]");
        }
        !is_sums
    });
    lines.flatten().copied().collect()
}

/// The files of weights that a model in a folder asks for.
pub(super) fn weights(model: &Model, folder: &Path) -> Vec<PathBuf> {
    model.weights_beside(&folder.join(&model.name))
}
