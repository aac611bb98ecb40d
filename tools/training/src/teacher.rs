//! A detector that sees the points of all agents in one cloud, and whose map of them is an example for the map that a fusion makes
//! (Li et al., Learning Distilled Collaboration Graph for Multi-Agent Perception, 2021).

use std::collections::HashMap;
use std::collections::hash_map::Entry;
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};

use realo_kernels::agents::Agent;
use realo_kernels::bev::BevMap;
use realo_methods::network::{Network, NetworkOptions};
use realo_methods::{Kernels, Model, Pillarer, load};
use realo_nn::layers::Layers;
use realo_nn::model::Grid;
use realo_nn::weights::Weights;

use crate::TrainError;
use crate::data::Scene;

/// How much a cell counts in which a detector is sure that nothing is: there are a hundred of these for each cell of an object.
pub(crate) const FLOOR: f32 = 0.01;

/// Weight of the lesson's loss beside those of scores and boxes.
const WEIGHT: f64 = 4.0;

/// A detector with its weights, for grids of any size.
pub struct Teacher {
    model: Model,
    weights: Arc<Weights>,
    identity: String,
    /// By rows and columns of the grid.
    networks: Mutex<HashMap<[usize; 2], Network>>,
}

/// The map that a sample's fused one should be like.
#[derive(Clone, Debug)]
pub struct Lesson {
    map: BevMap,
    /// How much each cell counts, 1 in all.
    shares: Vec<f32>,
}

impl Teacher {
    /// That of a model file, for a student.
    ///
    /// # Errors
    /// [`TrainError`] if it cannot be loaded, or the maps that its heads read are not as the student's.
    pub fn of(file: &Path, student: &Model) -> Result<Self, TrainError> {
        let loaded = load(file, Kernels::auto(1))?;
        let size = |model: &Model| {
            let layers = Layers::of(&Model {
                grid: student.grid,
                ..model.clone()
            });
            layers.size(layers.fused)
        };
        let [expected, found] = [student, &loaded.model].map(size);
        let cells = [student.grid.cell, loaded.model.grid.cell];
        if expected != found || cells[0] != cells[1] {
            return Err(TrainError::OtherMaps {
                model: student.name.clone(),
                from: file.into(),
                differences: format!(
                    "rows, columns, channels and cell of the map that the heads read: expected {expected:?} and {} m, found {found:?} and {} m",
                    cells[0], cells[1]
                ),
            });
        }
        Ok(Teacher {
            model: Model::clone(&loaded.model),
            weights: loaded.weights,
            identity: loaded.identity,
            networks: Mutex::default(),
        })
    }

    /// Name and digest of file and weights.
    pub fn identity(&self) -> &str {
        &self.identity
    }

    /// What it makes of all points of a scene on a grid.
    ///
    /// # Errors
    /// [`TrainError::Network`].
    pub(crate) fn lesson(&self, scene: &Scene, grid: &Grid) -> Result<Lesson, TrainError> {
        let mut networks = self.networks.lock().unwrap_or_else(PoisonError::into_inner);
        // Cells are where they are in the scene.
        let model = Model {
            grid: *grid,
            ..self.model.clone()
        };
        let network = match networks.entry([grid.rows(), grid.columns()]) {
            Entry::Occupied(there) => there.into_mut(),
            Entry::Vacant(free) => {
                let options = NetworkOptions {
                    threads: 1,
                    ..NetworkOptions::default()
                };
                free.insert(Network::new(&model, &self.weights, options)?)
            }
        };
        let mut pillarer = Pillarer::beside(network, &model, &self.weights);
        let (canvas, _) = pillarer.run(&scene.points());
        let mut map = network.encode(canvas)?;
        if model.arch.fuses() {
            map = network.fuse(&[Agent::beside(&map)])?;
        }
        let mut shares = network.heads(&map)?.confidence();
        let all: f32 = shares.iter().map(|share| share + FLOOR).sum();
        shares.iter_mut().for_each(|share| *share = (*share + FLOOR) / all);
        Ok(Lesson { map, shares })
    }
}

impl Lesson {
    /// The loss of a map, `[rows, columns, channels]`, of a batch of `batch`; `gradient` is overwritten with its derivative. It is
    /// the squared difference as a share of the teacher's own squared numbers, each cell as it counts.
    pub(crate) fn loss(&self, found: &[f32], batch: usize, gradient: &mut [f32]) -> f64 {
        let channels = self.map.channels;
        let size: f64 = self
            .map
            .data
            .chunks_exact(channels)
            .zip(&self.shares)
            .map(|(cell, share)| f64::from(*share) * cell.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>())
            .sum();
        let scale = WEIGHT / (size.max(1e-6) * batch as f64);
        let mut loss = 0.0;
        let numbers = found.chunks_exact(channels).zip(self.map.data.chunks_exact(channels));
        let numbers = numbers.zip(gradient.chunks_exact_mut(channels)).zip(&self.shares);
        for (((found, wanted), gradient), share) in numbers {
            let weight = scale as f32 * share;
            for ((found, wanted), gradient) in found.iter().zip(wanted).zip(gradient) {
                let off = found - wanted;
                loss += f64::from(weight * off * off);
                *gradient = 2.0 * weight * off;
            }
        }
        loss
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_lesson_is_a_share_of_what_the_teacher_has_and_its_gradient_the_slope() {
        let map = BevMap {
            rows: 1,
            columns: 2,
            channels: 2,
            data: vec![1.0, 2.0, -1.0, 0.5],
        };
        let lesson = Lesson {
            map: map.clone(),
            shares: vec![0.75, 0.25],
        };
        let loss = |found: &[f32]| lesson.loss(found, 1, &mut [0.0; 4]);
        assert_eq!(loss(&map.data), 0.0);
        assert!((loss(&[0.0; 4]) - WEIGHT).abs() < 1e-6, "nothing is off by all of it");
        let found = [0.5, 2.5, 0.0, 0.0];
        let mut gradient = [9.0; 4];
        lesson.loss(&found, 1, &mut gradient);
        for (index, gradient) in gradient.iter().enumerate() {
            let at = |step: f32| {
                let mut moved = found;
                moved[index] += step;
                loss(&moved)
            };
            let slope = (at(1e-2) - at(-1e-2)) / 2e-2;
            assert!(
                (slope - f64::from(*gradient)).abs() < 1e-3,
                "{index}: {slope} {gradient}"
            );
        }
        let mut halved = [0.0; 4];
        assert!((lesson.loss(&found, 2, &mut halved) * 2.0 - loss(&found)).abs() < 1e-6);
    }
}
