//! The way back through the feed-forward of cells.

use realo_kernels::cells::{line, line_mut};
use realo_kernels::conv::Map;
use realo_kernels::math::{erf, exp};
use realo_kernels::simd::dispatch;

use super::super::forward::{Forward, gelu};
use super::super::tiles::{Tile, Worker};
use super::layer::{LinearBack, NormBack};
use super::sums::Sums;

pub struct ForwardBack {
    pub norm: NormBack,
    pub wide: LinearBack,
    pub back: LinearBack,
}

impl ForwardBack {
    /// The gradient of a tile that a feed-forward read, from that of what it gave; without the sum of both.
    pub fn run(
        &self,
        forward: &Forward<f32>,
        (tile, map, gradient): (Tile, &Map<f32>, &Map<f32>),
        sums: &mut Sums,
        worker: &mut Worker<f32>,
    ) -> Map<f32> {
        let normed = forward.norm.run(tile.alone(), line(map), worker);
        let made = worker.run(&forward.wide, &normed);
        let mut active = worker.single(tile.cells(), made.channels);
        gelu(line(&made), made.channels, made.channels, line_mut(&mut active));
        let mut of_made = self.back.run(&active, gradient, sums, worker);
        gelu_back(line(&made), line_mut(&mut of_made));
        let of_normed = self.wide.run(&normed, &of_made, sums, worker);
        let of_map = self.norm.run(&forward.norm, map, &of_normed, sums, worker);
        worker.keep_single([made, active, of_made, of_normed]);
        worker.keep_own([normed]);
        of_map
    }
}

/// One part of the square root of two pi.
const DENSITY: f32 = 0.398_942_3;

dispatch! {
    /// Makes gradients of what the function gave those of what it read.
    fn gelu_back(from: &[f32], gradient: &mut [f32]) {
        for (from, gradient) in from.iter().zip(gradient) {
            let share = 0.5 * (1.0 + erf(from * std::f32::consts::FRAC_1_SQRT_2));
            *gradient *= share + from * DENSITY * exp(-0.5 * from * from);
        }
    }
}
