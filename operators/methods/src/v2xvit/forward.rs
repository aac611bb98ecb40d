//! The feed-forward of cells.

use realo_kernels::cells::{Linear, line, line_mut};
use realo_kernels::conv::Map;
use realo_kernels::math::erf;
use realo_kernels::number::Number;
use realo_kernels::simd::dispatch;

use super::norm::Norm;
use super::tiles::{Tile, Worker};

pub struct Forward<E> {
    pub norm: Norm,
    pub wide: Linear<E>,
    pub back: Linear<E>,
}

impl<E: Number> Forward<E> {
    /// What is added to the cells of a tile; `rows` are its rows of the map.
    pub fn run(&self, tile: Tile, rows: &[f32], worker: &mut Worker<E>) -> Map<f32> {
        let normed = self.norm.run(tile, rows, worker);
        let made = worker.run(&self.wide, &normed);
        let mut active = worker.own(tile.cells(), made.channels);
        let stored = active.stored;
        gelu(line(&made), made.channels, stored, line_mut(&mut active));
        let given = worker.run(&self.back, &active);
        worker.keep_single([made]);
        worker.keep_own([normed, active]);
        given
    }
}

dispatch! {
    /// `to` has `stored` numbers for each cell of `channels`.
    pub fn gelu<E: Number>(from: &[f32], channels: usize, stored: usize, to: &mut [E]) {
        for (from, to) in from.chunks_exact(channels).zip(to.chunks_exact_mut(stored)) {
            for (from, to) in from.iter().zip(to) {
                *to = E::from_f32(0.5 * from * (1.0 + erf(from * std::f32::consts::FRAC_1_SQRT_2)));
            }
        }
    }
}
