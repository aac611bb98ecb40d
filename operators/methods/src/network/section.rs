//! A part of a network by itself.

use std::sync::{Arc, Mutex};

use realo_kernels::bev::{BevMap, BevView};
use realo_kernels::conv::{Pool, lock};
use realo_nn::layers::{Layers, MapId, MapSize};
use realo_nn::weights::Weights;

use super::checks::{map_of, plain};
use super::engine::Parts;
use super::error::NetworkError;
use super::options::{NetworkOptions, choose};
use super::part::{Outcome, Runner};
use crate::arch::Model;

/// The layers from one map of a network to another, by themselves.
pub struct Section {
    name: String,
    from: MapSize,
    to: MapSize,
    running: Box<dyn Runner>,
    pool: Arc<Mutex<Pool>>,
}

impl Section {
    /// The layers between two maps of a model.
    ///
    /// # Errors
    /// As [`Network::new`].
    ///
    /// # Panics
    /// If the second map does not follow from the first by convolutions.
    pub fn new(
        model: &Model,
        weights: &Weights,
        options: NetworkOptions,
        ends: [MapId; 2],
    ) -> Result<Self, NetworkError> {
        let pool = Arc::new(Mutex::new(Pool::new(options.threads)));
        Section::on(pool, model, weights, options, ends)
    }

    /// As [`Section::new`], on threads that others use too.
    pub(crate) fn on(
        pool: Arc<Mutex<Pool>>,
        model: &Model,
        weights: &Weights,
        options: NetworkOptions,
        ends: [MapId; 2],
    ) -> Result<Self, NetworkError> {
        model.validate()?;
        let (layers, choice) = (Layers::of(model), choose(model, &options)?);
        let parts = Parts {
            layers: &layers,
            weights,
            isa: choice.isa,
            activations: &model.activations,
        };
        Ok(Section {
            name: model.name.clone(),
            from: layers.size(ends[0]),
            to: layers.size(ends[1]),
            running: parts.engine(choice.precision, ends, Outcome::Single).running(),
            pool,
        })
    }

    /// The map that follows from another.
    ///
    /// # Errors
    /// [`NetworkError::Shape`] if the map is not of the model's size, [`NetworkError::Length`] if it is not of its own.
    pub fn run<'a>(&mut self, map: impl Into<BevView<'a>>) -> Result<BevMap, NetworkError> {
        let view = plain(&self.name, map.into(), self.from)?;
        let mut pool = lock(&self.pool);
        let data = self.running.run(&mut pool, view).to_f32(&mut pool);
        Ok(map_of(self.to, data))
    }
}
