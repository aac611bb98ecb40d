use std::collections::BTreeMap;

use realo_methods::Model;
use realo_methods::{full, methods};
use realo_nn::layers::Layers;
use serde::Deserialize;

use crate::Kind;
use crate::vector::Vector;

pub(crate) const KINDS: &[Kind] = &[Kind::new(&["class", "config", "overrides", "entries"], keys)];

/// Keys and shapes of a network of the reference.
#[derive(Deserialize)]
struct Document {
    class: String,
    config: String,
    overrides: Overrides,
    grid_size_xyz: [usize; 3],
    feature_map_hw: [usize; 2],
    trainable_parameters: usize,
    entries: Vec<Entry>,
}

#[derive(Deserialize)]
struct Overrides {
    #[serde(default)]
    compression: usize,
}

#[derive(Deserialize)]
struct Entry {
    key: String,
    shape: Vec<usize>,
}

/// Class of the reference's detector of one agent.
const ALONE: &str = "PointPillar";

/// The shipped model of a network of the reference, by its class and its configuration's name.
fn shipped(document: &Document) -> Result<Model, String> {
    let class = &*document.class;
    let name = match methods().iter().find(|method| method.reference == Some(class)) {
        Some(method) => format!("full-{}", method.name),
        None if class != ALONE => return Err(format!("class `{class}`: no shipped model is of it")),
        None if document.config.contains("late") => "full-late".into(),
        None => "full".into(),
    };
    let mut model = full::model(&name).ok_or_else(|| format!("no model `{name}` is built in"))?;
    model.arch.set_compression(document.overrides.compression);
    model.validate().map_err(|error| error.to_string())?;
    Ok(model)
}

fn keys(vector: &Vector) -> Result<(), String> {
    let document: Document = vector.json(None)?;
    let model = shipped(&document)?;
    let layers = Layers::of(&model);
    let grid = [model.grid.columns(), model.grid.rows(), 1];
    if (grid, model.map_size()) != (document.grid_size_xyz, document.feature_map_hw) {
        let (found, map) = (grid, model.map_size());
        let expected = (document.grid_size_xyz, document.feature_map_hw);
        return Err(format!("expected grid and map {expected:?}, found {:?}", (found, map)));
    }
    let counters = |entry: &&Entry| !entry.key.ends_with(".num_batches_tracked");
    let expected = document.entries.iter().filter(counters);
    let expected: BTreeMap<&str, &[usize]> = expected.map(|entry| (&*entry.key, &*entry.shape)).collect();
    let tensors: Vec<_> = layers.tensors().collect();
    let found: BTreeMap<&str, &[usize]> = tensors.iter().map(|tensor| (&*tensor.key, &*tensor.shape)).collect();
    let differs = |key: &&str| expected.get(*key) != found.get(*key);
    if let Some(key) = expected.keys().chain(found.keys()).copied().find(differs) {
        return Err(format!(
            "`{key}`: expected {:?}, found {:?}",
            expected.get(key),
            found.get(key)
        ));
    }
    let trained = tensors.iter().filter(|tensor| tensor.role.is_trained());
    let trained: usize = trained.map(|tensor| tensor.count()).sum();
    match trained == document.trainable_parameters {
        true => Ok(()),
        false => Err(format!(
            "expected {} trainable parameters, found {trained}",
            document.trainable_parameters
        )),
    }
}
