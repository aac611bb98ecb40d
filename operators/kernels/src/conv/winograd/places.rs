//! Places of a tile, the weights at them, and the room that a worker needs for them.

use std::f64::consts::{FRAC_1_SQRT_2, SQRT_2};

use crate::conv::convolution::Convolution;

/// Rows and columns of outputs of a tile.
pub const SIDE: usize = 4;
/// Rows and columns of inputs of a tile, and points.
pub const POINTS: usize = SIDE + 2;
/// A point for the rows and one for the columns.
pub const PLACES: usize = POINTS * POINTS;

/// `G`: powers of each point, divided by the product of its distances from the other finite ones.
const WEIGHTS: [[f64; 3]; POINTS] = [
    [1.0, 0.0, 0.0],
    [-2.0 / 3.0, -2.0 / 3.0 * FRAC_1_SQRT_2, -1.0 / 3.0],
    [-2.0 / 3.0, 2.0 / 3.0 * FRAC_1_SQRT_2, -1.0 / 3.0],
    [1.0 / 6.0, 1.0 / 6.0 * SQRT_2, 1.0 / 3.0],
    [1.0 / 6.0, -1.0 / 6.0 * SQRT_2, 1.0 / 3.0],
    [0.0, 0.0, 1.0],
];

/// Channels come in whole registers of all instructions.
pub const MOST_LANES: usize = 16;

/// Whether a convolution is faster by tiles.
pub fn suits(layer: &Convolution) -> bool {
    (layer.kernel, layer.stride, layer.transposed) == (3, 1, false)
        && [layer.inputs, layer.outputs]
            .iter()
            .all(|channels| channels.is_multiple_of(MOST_LANES))
}

/// Tiles that are multiplied together: enough to use each weight often, few enough for a core's second cache.
pub const TILES: usize = 24;
/// Outputs whose products are made before they are written: one block or more.
pub const OUTPUTS: usize = 64;

/// Numbers from one place to the next. Powers of two would put all places of a tile into the same lines of the first cache.
pub const fn place(channels: usize) -> usize {
    TILES * channels + MOST_LANES
}

/// Numbers that a worker needs beside its maps, for cells of so many numbers of at most 4 bytes.
pub fn room(stored: usize) -> usize {
    PLACES * (place(stored) + place(OUTPUTS) + stored)
}

/// `G g Gᵀ`: the convolution with weights `[outputs, inputs, 6, 6]`, computed in f64.
pub fn at_places(layer: &Convolution) -> Convolution {
    let mut weights = Vec::with_capacity(layer.outputs * layer.inputs * PLACES);
    for window in layer.weights.chunks_exact(9) {
        for place in 0..PLACES {
            let (row, column) = (WEIGHTS[place / POINTS], WEIGHTS[place % POINTS]);
            let taps = (0..9).map(|tap| row[tap / 3] * column[tap % 3] * f64::from(window[tap]));
            weights.push(taps.sum::<f64>() as f32);
        }
    }
    Convolution {
        kernel: POINTS,
        weights,
        bias: layer.bias.clone(),
        ..*layer
    }
}
