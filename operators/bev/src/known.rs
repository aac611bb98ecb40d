//! Sizes of a model's BEV maps, before it is loaded.

use std::path::Path;

use realo_methods::Model;
use realo_nn::layers::{Layers, MapId};
use realo_operator::KnownMap;

/// The size of a map of the model in a file; `None` where the file is not a model, which loading it says.
pub fn known_map(model: &Path, of: impl Fn(&Layers) -> MapId) -> Option<KnownMap> {
    let read = Model::read(model).ok()?;
    let layers = Layers::of(&read);
    Some(KnownMap {
        size: layers.size(of(&layers)).map(|count| u32::try_from(count).ok()),
        by: model.display().to_string(),
    })
}
