//! How many boxes a run found, whether or not there is truth to score them against.

use std::collections::BTreeMap;

use realo_schemas::Boxes;
use serde::{Deserialize, Serialize};

/// Boxes that the graph's last stage sent.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct FinalBoxes {
    /// Sweeps of the ego for which a list of boxes came, empty lists among them.
    pub frames: u64,
    /// Boxes of all lists.
    pub total: u64,
    /// Mean of them for each of these sweeps.
    pub per_frame: f64,
    /// Boxes by class, as the stage names it.
    pub by_class: BTreeMap<String, u64>,
}

impl FinalBoxes {
    /// Adds the list of a sweep.
    pub(crate) fn take(&mut self, boxes: &Boxes) {
        self.frames += 1;
        self.total += boxes.0.len() as u64;
        for object in &boxes.0 {
            match self.by_class.get_mut(&*object.class) {
                Some(count) => *count += 1,
                None => _ = self.by_class.insert(object.class.to_string(), 1),
            }
        }
        self.mean();
    }

    /// Adds the boxes of another run.
    pub fn add(&mut self, other: &FinalBoxes) {
        self.frames += other.frames;
        self.total += other.total;
        for (class, count) in &other.by_class {
            *self.by_class.entry(class.clone()).or_default() += count;
        }
        self.mean();
    }

    fn mean(&mut self) {
        self.per_frame = self.total as f64 / self.frames.max(1) as f64;
    }
}
