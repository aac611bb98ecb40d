//! What bytes stand for: the greatest result of every layer over some sweeps.

use std::collections::BTreeMap;

use crate::encoder::Pillarer;
use crate::layers::{Layers, MapId};
use crate::model::{Model, Precision};
use crate::network::{BevView, NetworkError, NetworkOptions, Section};
use crate::pillars::Points;
use crate::weights::Weights;

/// Looks at the maps of a network in f32, for [`Model::activations`].
pub struct Calibration {
    pillarer: Pillarer,
    canvas: String,
    /// The layers from the canvas to each map, by the key of the layer that makes it.
    sections: Vec<(String, Section)>,
    greatest: BTreeMap<String, f32>,
}

impl Calibration {
    /// Of a model, with no sweep looked at.
    ///
    /// # Errors
    /// Those of [`Section::new`].
    pub fn new(model: &Model, weights: &Weights) -> Result<Self, NetworkError> {
        let layers = Layers::of(model);
        let options = NetworkOptions {
            precision: Some(Precision::F32),
            ..NetworkOptions::default()
        };
        let read: Vec<(String, MapId)> = layers.read_in_bytes();
        let others = read.into_iter().filter(|(_, map)| *map != layers.canvas);
        let section = |(key, map)| Ok((key, Section::new(model, weights, options, [layers.canvas, map])?));
        Ok(Calibration {
            pillarer: Pillarer::new(model, weights),
            canvas: layers.key(layers.canvas),
            sections: others.map(section).collect::<Result<_, NetworkError>>()?,
            greatest: BTreeMap::new(),
        })
    }

    /// Looks at a sweep in the model's frame.
    ///
    /// # Errors
    /// Those of [`Section::run`].
    pub fn observe(&mut self, points: &Points) -> Result<(), NetworkError> {
        let (canvas, _) = self.pillarer.run(points);
        let cells = canvas.cells();
        let size = [canvas.rows(), canvas.columns(), canvas.channels()];
        note(&mut self.greatest, &self.canvas, &cells);
        let [rows, columns, channels] = size;
        let view = BevView {
            rows,
            columns,
            channels,
            data: &cells,
        };
        for (key, section) in &mut self.sections {
            let map = section.run(view)?;
            note(&mut self.greatest, key, &map.data);
        }
        Ok(())
    }

    /// The greatest result of each layer so far. A layer that never gave more than 0 counts as having given 1.
    pub fn activations(&self) -> BTreeMap<String, f32> {
        let greatest = self.greatest.iter();
        greatest
            .map(|(key, greatest)| (key.clone(), if *greatest > 0.0 { *greatest } else { 1.0 }))
            .collect()
    }
}

fn note(greatest: &mut BTreeMap<String, f32>, key: &str, numbers: &[f32]) {
    let found = numbers.iter().copied().fold(0.0, f32::max);
    let entry = greatest.entry(key.into()).or_insert(0.0);
    *entry = entry.max(found);
}
