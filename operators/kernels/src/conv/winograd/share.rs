//! A worker's tiles: inputs to places, products of matrices at each place, products to outputs.
#![allow(unsafe_code)]

use super::places::{OUTPUTS, PLACES, POINTS, SIDE, TILES, place};
use super::points::{inputs_at_places, outputs_of_places};
use crate::conv::element::Element;
use crate::conv::map::View;
use crate::conv::pack::{Kernel, Packed, Share};
use crate::conv::tile::{Float, Load, Registers, Row, Store, Tile, check};

/// Biases of products, which have none.
static ZEROS: [f32; OUTPUTS] = [0.0; OUTPUTS];

/// A share, some tiles at a time, with `M` to read and write maps.
///
/// # Safety
/// The CPU has the instructions of `S` and `M`.
#[inline(always)]
pub(in crate::conv) unsafe fn share<S, M, O, const P: usize, const J: usize>(
    layer: &Packed<M::Element, O>,
    mut share: Share<M::Element, O>,
) where
    S: Float,
    M: Load + Store<O, Results = S::Register>,
    M::Element: Kernel<O>,
    O: Element,
{
    check(layer, &share, <Registers<S, P, J> as Row<f32, f32>>::BLOCK);
    assert_eq!(layer.side, SIDE, "side of a tile");
    assert!(S::LANES == M::LANES && layer.inputs.is_multiple_of(S::LANES) && layer.outputs.is_multiple_of(S::LANES));
    assert!(OUTPUTS.is_multiple_of(layer.block) && share.rows.start.is_multiple_of(SIDE));
    let across = share.columns.div_ceil(SIDE);
    let tiles = across * share.rows.len().div_ceil(SIDE);
    let (inputs, rest) = std::mem::take(&mut share.room).split_at_mut(PLACES * place(layer.inputs));
    let (products, edge) = rest.split_at_mut(PLACES * place(OUTPUTS));
    // The share's first row counts as 0.
    let corner = |tile: usize| [tile / across * SIDE, tile % across * SIDE];
    for first in (0..tiles).step_by(TILES) {
        let count = TILES.min(tiles - first);
        for tile in 0..count {
            let [row, column] = corner(first + tile);
            let at = [share.rows.start + row, column];
            // SAFETY: `tile` is less than `TILES`; the CPU has the instructions.
            unsafe {
                match Cells::inside(share.input, at) {
                    Some(cells) => cells.at_places::<S, M>(inputs, tile),
                    None => Cells::at_edge(share.input, at, edge).at_places::<S, S>(inputs, tile),
                }
            }
        }
        for output in (0..layer.outputs).step_by(OUTPUTS) {
            // SAFETY: `count` is at most `TILES`, tiles begin inside of the share; the CPU has the instructions.
            unsafe {
                multiply::<S, M::Element, O, P, J>(layer, output, inputs, products, count);
                for tile in 0..count {
                    write::<S, M, O>(layer, output, products, tile, &mut share, corner(first + tile));
                }
            }
        }
    }
}

/// The inputs of a tile, 6x6 cells.
struct Cells<'a, E> {
    data: &'a [E],
    /// Numbers from one row to the next.
    line: usize,
    /// Numbers of a cell.
    stored: usize,
}

impl<'a, E: Element> Cells<'a, E> {
    /// The cells where they lie, unless the map ends in the tile.
    fn inside(map: View<'a, E>, [row, column]: [usize; 2]) -> Option<Self> {
        (row + POINTS <= map.rows + 2 && column + POINTS <= map.columns + 2).then(|| Cells {
            data: &map.data[row * map.line() + column * map.stored..],
            line: map.line(),
            stored: map.stored,
        })
    }

    /// Writes the numbers of a tile at all places; `M` reads the cells.
    ///
    /// # Safety
    /// `tile` is less than [`TILES`], and the CPU has the instructions of `S` and `M`.
    #[inline(always)]
    unsafe fn at_places<S: Float, M: Load<Element = E, Results = S::Register>>(&self, inputs: &mut [f32], tile: usize) {
        let place = place(self.stored);
        let from = &self.data[..(POINTS - 1) * self.line + POINTS * self.stored];
        let to = &mut inputs[tile * self.stored..(PLACES - 1) * place + (tile + 1) * self.stored];
        for channel in (0..self.stored).step_by(S::LANES) {
            // SAFETY: a cell holds whole registers, and both slices end with the last cell that is read or written.
            unsafe {
                inputs_at_places::<S, M>(
                    from.as_ptr().add(channel),
                    [self.line, self.stored],
                    to.as_mut_ptr().add(channel),
                    place,
                );
            }
        }
    }
}

impl<'a> Cells<'a, f32> {
    /// The cells in `edge`, with zeros behind the map's border.
    fn at_edge<E: Element>(map: View<E>, [row, column]: [usize; 2], edge: &'a mut [f32]) -> Self {
        let (line, stored) = (POINTS * map.stored, map.stored);
        let [rows, columns] = [map.rows + 2 - row, map.columns + 2 - column].map(|cells| cells.min(POINTS));
        edge.fill(0.0);
        let data = &map.data[row * map.line() + column * stored..];
        for (from, to) in data.chunks(map.line()).zip(edge.chunks_exact_mut(line)).take(rows) {
            for (from, to) in from.iter().zip(to).take(columns * stored) {
                *to = from.to_f32();
            }
        }
        Cells {
            data: edge,
            line,
            stored,
        }
    }
}

/// Multiplies the inputs of so many tiles by the weights of up to [`OUTPUTS`] outputs, place by place.
///
/// # Safety
/// The layer has blocks of `Registers<S, P, J>`, and the CPU has the instructions of `S`.
#[inline(always)]
unsafe fn multiply<S: Float, E, O, const P: usize, const J: usize>(
    layer: &Packed<E, O>,
    first: usize,
    inputs: &[f32],
    products: &mut [f32],
    tiles: usize,
) {
    let Packed {
        inputs: channels,
        block,
        ..
    } = *layer;
    let size = channels * block;
    let end = (first + OUTPUTS).min(layer.bias.len());
    for at in 0..PLACES {
        let inputs = &inputs[at * place(channels)..][..tiles * channels];
        let products = &mut products[at * place(OUTPUTS)..][..tiles * OUTPUTS];
        for output in (first..end).step_by(block) {
            let tile = Tile::<f32, f32> {
                input: inputs.as_ptr(),
                line: 0,
                window: channels,
                taps: 1,
                run: channels,
                weights: layer.at_places[(output / block * PLACES + at) * size..][..size].as_ptr(),
                scale: ZEROS.as_ptr(),
                bias: ZEROS.as_ptr(),
                floor: f32::NEG_INFINITY,
                output: products[output - first..].as_mut_ptr(),
                cell: OUTPUTS,
                valid: block,
            };
            // SAFETY: windows are tiles: the slices hold their inputs, the block's weights and their products.
            unsafe { Registers::<S, P, J>::row(tile, tiles) };
        }
    }
}

/// Writes outputs `first..first + OUTPUTS`, as far as there are, of the tile where the share begins with `row` and `column`.
///
/// # Safety
/// [`check`] has passed, and the CPU has the instructions of `S` and `M`.
#[inline(always)]
unsafe fn write<S: Float, M: Store<O, Results = S::Register>, O>(
    layer: &Packed<M::Element, O>,
    first: usize,
    products: &[f32],
    tile: usize,
    share: &mut Share<M::Element, O>,
    [row, column]: [usize; 2],
) {
    let place = place(OUTPUTS);
    let outputs = (layer.outputs - first).min(OUTPUTS);
    let from = &products[tile * OUTPUTS..(PLACES - 1) * place + tile * OUTPUTS + outputs];
    let bias = &layer.bias[first..first + outputs];
    let [rows, columns] = [share.rows.len() - row, share.columns - column].map(|outputs| outputs.min(SIDE));
    let to = row * share.row + (1 + column) * share.cell + share.first + first;
    let last = (rows - 1) * share.row + (columns - 1) * share.cell;
    let to = &mut share.output[to..to + last + outputs];
    for output in (0..outputs).step_by(S::LANES) {
        // SAFETY: outputs come in whole registers, and the slices end with the last one that is read or written.
        unsafe {
            let tile = outputs_of_places::<S>(from.as_ptr().add(output), place);
            for (y, tile) in tile.into_iter().enumerate() {
                for (x, sum) in tile.into_iter().enumerate() {
                    if y < rows && x < columns {
                        let results = S::finish(sum, ZEROS.as_ptr(), bias.as_ptr().add(output), layer.floor);
                        M::store(results, to.as_mut_ptr().add(y * share.row + x * share.cell + output));
                    }
                }
            }
        }
    }
}
