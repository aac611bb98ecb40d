//! From points to the BEV map: pillars, pillar layer, backbone.

use std::sync::{Arc, Mutex};

use crate::canvas::Canvas;
use crate::conv::Pool;
use crate::load::{Loaded, lock};
use crate::model::Model;
use crate::network::{BevMap, Network, NetworkError};
use crate::pillar_net::PillarNet;
use crate::pillars::{Dropped, Pillariser, Points};
use crate::weights::Weights;

/// From points to the canvas of a model; buffers serve one sweep after another.
pub struct Pillarer {
    pillariser: Pillariser,
    net: PillarNet,
    canvas: Canvas,
    intensity: bool,
    pool: Arc<Mutex<Pool>>,
}

impl Pillarer {
    /// The first steps of a model, on the caller's thread.
    pub fn new(model: &Model, weights: &Weights) -> Self {
        Pillarer::on(Arc::new(Mutex::new(Pool::new(1))), model, weights)
    }

    /// The first steps of a model, on a network's threads.
    pub fn beside(network: &Network, model: &Model, weights: &Weights) -> Self {
        Pillarer::on(network.pool(), model, weights)
    }

    fn on(pool: Arc<Mutex<Pool>>, model: &Model, weights: &Weights) -> Self {
        let (grid, pillars) = (&model.grid, &model.pillars);
        Pillarer {
            pillariser: Pillariser::new(grid, pillars.points, pillars.pillars),
            net: PillarNet::of(model, weights),
            canvas: Canvas::new(grid.rows(), grid.columns(), pillars.channels),
            intensity: pillars.intensity,
            pool,
        }
    }

    /// Whether it looks at the points' intensity.
    pub fn wants_intensity(&self) -> bool {
        self.intensity
    }

    /// The canvas of points in the model's frame, and how many were left out.
    pub fn run(&mut self, points: &Points) -> (&Canvas, Dropped) {
        let pillars = self.pillariser.run(points);
        self.net.run_on(pillars, &mut self.canvas, &mut lock(&self.pool));
        (&self.canvas, pillars.dropped)
    }
}

/// From points to the BEV map of a model.
pub struct Encoder {
    pillarer: Pillarer,
    network: Network,
}

impl Encoder {
    /// The encoder of a model that was loaded.
    pub fn new(loaded: Loaded) -> Self {
        Encoder {
            pillarer: Pillarer::beside(&loaded.network, &loaded.model, &loaded.weights),
            network: loaded.network,
        }
    }

    /// Whether it looks at the points' intensity.
    pub fn wants_intensity(&self) -> bool {
        self.pillarer.wants_intensity()
    }

    /// The BEV map of points in the model's frame, and how many were left out.
    ///
    /// # Errors
    /// Those of [`Network::encode`].
    pub fn run(&mut self, points: &Points) -> Result<(BevMap, Dropped), NetworkError> {
        let (canvas, dropped) = self.pillarer.run(points);
        Ok((self.network.encode(canvas)?, dropped))
    }
}
