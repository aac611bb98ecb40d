//! Puts what a stage made beside a recipe.

use std::fs;
use std::path::{Path, PathBuf};

use realo_methods::Model;
use realo_nn::layers::Layers;
use realo_nn::weights::Weights;

use super::Made;
use crate::TrainError;
use crate::train::write_sums;

/// Puts files of a finished stage into a folder under other names, and into its model file the sums of the weights that lie there.
///
/// # Errors
/// [`TrainError`] if the encoder is another file's and that file in the folder has other numbers; files that cannot be read or written.
pub fn install(made: &Made, files: &[(PathBuf, String)], folder: &Path) -> Result<(), TrainError> {
    let model = Model::read(&made.file)?;
    check_encoder(made, &model, folder)?;
    for (from, name) in files {
        let to = folder.join(name);
        // A file that is replaced as a whole is never half there.
        let part = to.with_extension("part");
        let copied = fs::copy(from, &part).and_then(|_| fs::rename(&part, &to));
        copied.map_err(|error| TrainError::Write { path: to, error })?;
    }
    write_sums(&made.file, &model, folder)
}

/// Refuses an encoder in the folder that is not the one behind which the stage learned.
fn check_encoder(made: &Made, model: &Model, folder: &Path) -> Result<(), TrainError> {
    let [own, encoder] = [made.file.parent().unwrap_or(Path::new("")), folder]
        .map(|folder| model.weights_beside(&folder.join(&model.name)));
    let Some(there) = encoder.get(1) else { return Ok(()) };
    let learned = Weights::read(&own, model)?;
    // The encoder's file in the folder has more than the encoder, so its sum is another.
    let unchecked = Model {
        sha256: Default::default(),
        ..model.clone()
    };
    let installed = Weights::read(&[&own[0], there], &unchecked)?;
    let mut tensors = Layers::of(model)
        .tensors()
        .map(|spec| spec.key)
        .collect::<Vec<_>>()
        .into_iter();
    match tensors.find(|key| learned.find(key) != installed.find(key)) {
        None => Ok(()),
        Some(key) => Err(TrainError::OtherMaps {
            model: model.name.clone(),
            from: there.clone(),
            differences: format!(
                "expected the encoder that `{}` learned behind, found another `{key}`: install the recipe that made that encoder",
                model.name
            ),
        }),
    }
}
