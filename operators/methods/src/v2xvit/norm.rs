//! The layer norm of cells.

use realo_kernels::cells::line_mut;
use realo_kernels::conv::Map;
use realo_kernels::math::{product, sum};
use realo_kernels::number::Number;
use realo_kernels::simd::dispatch;

use super::tiles::{Tile, Worker};

/// Added to the variance by every layer norm.
pub const LAYER_NORM_EPS: f32 = 1e-5;

pub struct Norm {
    pub weight: Vec<f32>,
    pub bias: Vec<f32>,
}

impl Norm {
    /// Of the cells of a tile; `rows` are its rows of the map.
    pub fn run<E: Number>(&self, tile: Tile, rows: &[f32], worker: &mut Worker<E>) -> Map<E> {
        let channels = self.weight.len();
        let mut to = worker.own(tile.cells(), channels);
        let stored = to.stored;
        let cells = line_mut(&mut to).chunks_exact_mut(tile.columns * stored);
        for (from, to) in tile.lines(rows, channels).zip(cells) {
            normalize(from, [&self.weight, &self.bias], stored, to);
        }
        to
    }
}

dispatch! {
    /// A layer norm of each cell, with its weights and biases; `to` has `stored` numbers for each cell.
    pub fn normalize<E: Number>(cells: &[f32], norm: [&[f32]; 2], stored: usize, to: &mut [E]) {
        let [weight, bias] = norm;
        let mut centered = vec![0.0; weight.len()];
        for (cell, to) in cells.chunks_exact(weight.len()).zip(to.chunks_exact_mut(stored)) {
            let mean = sum(cell) / cell.len() as f32;
            centered.iter_mut().zip(cell).for_each(|(to, from)| *to = from - mean);
            let factor = 1.0 / (product(&centered, &centered) / cell.len() as f32 + LAYER_NORM_EPS).sqrt();
            for (((to, from), weight), bias) in to.iter_mut().zip(&centered).zip(weight).zip(bias) {
                *to = E::from_f32(from * factor * weight + bias);
            }
        }
    }
}
