//! From points to the canvas: pillars and the pillar layer.

use std::sync::{Arc, Mutex};

use realo_kernels::canvas::Canvas;
use realo_kernels::conv::{Pool, lock};
use realo_nn::weights::Weights;

use super::running::Network;
use crate::arch::Model;
use crate::detect::pillar_net::PillarNet;
use crate::detect::pillars::{Dropped, Pillariser, Points};

/// From points to the canvas of a model; buffers serve one sweep after another.
pub struct Pillarer {
    pillariser: Pillariser,
    net: PillarNet,
    canvas: Canvas,
    intensity: bool,
    /// How far the model's frame lies above that of the points, m.
    height: f32,
    /// The points' z in the model's frame, where it is another one.
    lowered: Vec<f32>,
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
            height: model.height() as f32,
            lowered: Vec::new(),
            pool,
        }
    }

    /// Whether it looks at the points' intensity.
    pub fn wants_intensity(&self) -> bool {
        self.intensity
    }

    /// The canvas of points, and how many were left out. They are in the model's frame, or in the body frame where the model
    /// says how far its own lies above that ([`Model::height`]).
    pub fn run(&mut self, points: &Points) -> (&Canvas, Dropped) {
        let mut points = *points;
        if self.height != 0.0 {
            self.lowered.clear();
            self.lowered.extend(points.z.iter().map(|z| z - self.height));
            points.z = &self.lowered;
        }
        let pillars = self.pillariser.run(&points);
        self.net.run_on(pillars, &mut self.canvas, &mut lock(&self.pool));
        (&self.canvas, pillars.dropped)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{random_tensors, small};
    use realo_nn::anchors::Anchors;
    use realo_nn::model::Frame;

    #[test]
    fn a_model_of_the_lidars_frame_sees_points_and_tells_boxes_above_the_ground() {
        let body = small(8, 12, false);
        let mut lidar = body.clone();
        (lidar.frame, lidar.lidar_height) = (Frame::Lidar, Some(1.75));
        lidar.validate().unwrap();
        let weights = Weights::new(&body, random_tensors(&body, 7)).unwrap();
        let (x, y) = ([3.25, 3.5, 7.125, 0.5], [2.5, 2.25, 4.75, 7.5]);
        let canvas = |model: &Model, z: [f32; 4]| {
            let points = Points {
                x: &x,
                y: &y,
                z: &z,
                intensity: None,
            };
            let mut pillarer = Pillarer::new(model, &weights);
            let (canvas, dropped) = pillarer.run(&points);
            (canvas.clone(), dropped)
        };
        let z = [0.5, 0.25, 1.0, 6.5];
        let seen = canvas(&lidar, z);
        assert!(seen == canvas(&body, z.map(|z| z - 1.75)) && seen != canvas(&body, z));
        // 6.5 m above the ground is inside of a volume that ends 5 m above the LiDAR.
        assert_eq!((seen.1.out_of_range, canvas(&body, z).1.out_of_range), (0, 1));
        let [ours, theirs] = [&lidar, &body].map(|model| Anchors::of(model).get(0));
        assert_eq!((ours[2], &ours[3..]), (theirs[2] + 1.75, &theirs[3..]));
    }
}
