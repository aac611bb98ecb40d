//! The loop nest that all instructions share, from the rows of a worker down to a tile of registers.
#![allow(unsafe_code)]

use std::marker::PhantomData;
use std::mem::MaybeUninit;
use std::ops::Range;

use super::element::Element;
use super::map::View;
use super::pack::{Kernel, Packed, Share};

/// The instructions that a tile needs, on registers of `LANES` outputs.
///
/// # Safety
/// The functions may only run where the CPU has the instructions. They are always inlined, into a function that enables
/// them.
pub(super) trait Simd {
    type Element: Element;
    type Sum: Copy;
    /// A unit of each lane's weights, or the same unit of the input in all lanes.
    type Units: Copy;
    /// Finished results, f32.
    type Results: Copy;
    const LANES: usize;

    unsafe fn zero() -> Self::Sum;
    /// `at`: `LANES` units, of any alignment.
    unsafe fn weights(at: *const Self::Element) -> Self::Units;
    /// `at`: one unit, of any alignment.
    unsafe fn broadcast(at: *const Self::Element) -> Self::Units;
    unsafe fn multiply_add(sum: Self::Sum, input: Self::Units, weights: Self::Units) -> Self::Sum;
    /// Adds `LANES` biases, after sums of steps are multiplied by `LANES` scales, and raises the result to `floor`; NaN stays
    /// NaN.
    unsafe fn finish(sum: Self::Sum, scale: *const f32, bias: *const f32, floor: f32) -> Self::Results;
}

/// Writes a register of results to `LANES` numbers of any alignment.
///
/// # Safety
/// As for [`Simd`].
pub(super) trait Store<O>: Simd {
    unsafe fn store(results: Self::Results, to: *mut O);
}

/// Reads a register of results from `LANES` numbers of any alignment, exactly.
///
/// # Safety
/// As for [`Simd`].
pub(super) trait Load: Simd {
    unsafe fn load(at: *const Self::Element) -> Self::Results;
}

/// Instructions on registers of f32 for everything.
///
/// # Safety
/// As for [`Simd`].
pub(super) trait Float:
    Store<f32>
    + Load
    + Simd<
        Element = f32,
        Sum = <Self as Float>::Register,
        Units = <Self as Float>::Register,
        Results = <Self as Float>::Register,
    >
{
    type Register: Copy;
}

impl<S, R: Copy> Float for S
where
    S: Store<f32> + Load + Simd<Element = f32, Sum = R, Units = R, Results = R>,
{
    type Register = R;
}

/// How neighbouring windows of a row are computed.
///
/// # Safety
/// As for [`Simd`].
pub(super) trait Row<E, O> {
    /// Outputs side by side.
    const BLOCK: usize;
    /// Windows that are best computed together.
    const WINDOWS: usize;

    /// # Safety
    /// So many windows and their outputs exist from the tile's on.
    unsafe fn row(tile: Tile<E, O>, windows: usize);
}

/// Tiles of `P` windows x `J` registers.
pub(super) struct Registers<S, const P: usize, const J: usize>(PhantomData<S>);

impl<S, O: Element, const P: usize, const J: usize> Row<S::Element, O> for Registers<S, P, J>
where
    S: Store<O>,
{
    const BLOCK: usize = J * S::LANES;
    const WINDOWS: usize = P;

    #[inline(always)]
    unsafe fn row(mut tile: Tile<S::Element, O>, mut windows: usize) {
        // SAFETY: the caller's promise; no step computes more windows than are left.
        unsafe {
            while windows >= P {
                tile.compute::<S, P, J>();
                tile.advance(P);
                windows -= P;
            }
            while windows >= 4 {
                tile.compute::<S, 4, J>();
                tile.advance(4);
                windows -= 4;
            }
            if windows >= 2 {
                tile.compute::<S, 2, J>();
                tile.advance(2);
                windows -= 2;
            }
            if windows == 1 {
                tile.compute::<S, 1, J>();
            }
        }
    }
}

/// Bytes of input that are read for every block of weights before the next ones follow. Windows of 3x3 share what they
/// read and go by whole rows that stay in a core's second cache; those of 1x1 by cells that stay in its first.
const ROWS_BYTES: usize = 192 << 10;
const CELLS_BYTES: usize = 16 << 10;

/// Most results of a tile.
const MOST_RESULTS: usize = 12 * 2 * 16;

/// A share, row by row.
///
/// # Safety
/// The CPU has the instructions of `R`.
#[inline(always)]
pub(super) unsafe fn share<R, E, O>(layer: &Packed<E, O>, mut share: Share<E, O>)
where
    R: Row<E, O>,
    E: Kernel<O>,
    O: Element,
{
    check(layer, &share, R::BLOCK);
    assert_eq!(layer.side, 1, "outputs that are computed as one");
    let count = layer.up * layer.up * layer.taps() * layer.stored() * layer.bias.len();
    assert_eq!(layer.weights.len(), count, "packed weights");
    let blocks = layer.bias.len() / layer.block;
    let size = layer.weights.len() / (layer.up * layer.up * blocks);
    let Range { start, end } = share.rows.clone();
    let cell = share.input.stored * layer.stride * size_of::<E>();
    let (rows, columns) = match layer.kernel {
        1 => (1, (CELLS_BYTES / cell).next_multiple_of(R::WINDOWS).max(R::WINDOWS)),
        _ => ((ROWS_BYTES / (cell * (share.columns + 2))).max(1), share.columns.max(1)),
    };
    for first_row in (start..end).step_by(rows) {
        for first_column in (0..share.columns).step_by(columns) {
            let columns = first_column..(first_column + columns).min(share.columns);
            for part in 0..layer.up * layer.up * blocks {
                let weights = &layer.weights[part * size..(part + 1) * size];
                for row in first_row..(first_row + rows).min(end) {
                    let at = Window {
                        row,
                        columns: columns.clone(),
                        cell: part / blocks,
                        block: part % blocks,
                    };
                    // SAFETY: `check` has found the share to fit the layer; the CPU has the instructions.
                    unsafe { windows::<R, E, O>(layer, &mut share, at, weights) };
                }
            }
        }
    }
}

/// Neighbouring windows of one row, for one block of outputs and one of the cells that an input cell becomes.
struct Window {
    row: usize,
    columns: Range<usize>,
    cell: usize,
    block: usize,
}

/// What the pointers of [`windows`] and of tiles rely on, beside the number of weights; `block`: outputs side by side.
pub(super) fn check<E, O>(layer: &Packed<E, O>, share: &Share<E, O>, block: usize)
where
    E: Kernel<O>,
    O: Element,
{
    let View {
        rows,
        columns,
        stored,
        border,
        data,
        ..
    } = share.input;
    assert!(block == layer.block && layer.bias.len().is_multiple_of(block));
    assert_eq!(layer.scales.len(), layer.bias.len(), "scales of a convolution");
    assert!(layer.bias.len() - layer.block < layer.outputs && layer.outputs <= layer.bias.len());
    assert_eq!(share.room.len(), layer.room(), "numbers of a worker's room");
    assert_eq!(stored, layer.stored(), "channels of an input map");
    assert_eq!(data.len(), share.input.numbers(), "numbers of an input map");
    assert!(share.rows.end <= layer.windows(rows) && share.columns == layer.windows(columns));
    assert!((layer.kernel, border) == (3, 1) || layer.kernel == 1 && border <= 1);
    assert_eq!(
        share.row,
        (share.columns * layer.up + 2) * share.cell,
        "numbers of an output row"
    );
    assert_eq!(
        share.output.len(),
        share.rows.len() * layer.up * share.row,
        "numbers of an output share"
    );
    assert!(share.first + layer.outputs <= share.cell, "channels of an output map");
}

/// # Safety
/// The CPU has the instructions of `R`, and [`check`] has passed with `row` in `share.rows`, `columns` in
/// `share.columns`, `cell` below `up²`, `block` one of the blocks, `weights` its part.
#[inline(always)]
unsafe fn windows<R, E, O>(layer: &Packed<E, O>, share: &mut Share<E, O>, at: Window, weights: &[E])
where
    R: Row<E, O>,
    E: Element,
    O: Element,
{
    let Window {
        row,
        columns,
        cell,
        block,
    } = at;
    let View {
        stored, border, data, ..
    } = share.input;
    let (up, first) = (layer.up, block * layer.block);
    let valid = (layer.outputs - first).min(layer.block);
    // A window of 3x3 begins in the border, one of 1x1 behind it.
    let border = if layer.kernel == 3 { 0 } else { border };
    let line = share.input.line();
    let input = &data[(row * layer.stride + border) * line + (columns.start * layer.stride + border) * stored..];
    let output_row = (row - share.rows.start) * up + cell / up;
    let output = &mut share.output[output_row * share.row..(output_row + 1) * share.row];
    let output = &mut output[(1 + columns.start * up + cell % up) * share.cell + share.first + first..];
    let tile = Tile::<E, O> {
        input: input.as_ptr(),
        line,
        window: layer.stride * stored,
        taps: layer.kernel,
        weights: weights.as_ptr(),
        scale: layer.scales[first..].as_ptr(),
        bias: layer.bias[first..].as_ptr(),
        floor: layer.floor,
        output: output.as_mut_ptr(),
        cell: up * share.cell,
        valid,
        run: layer.kernel * stored,
    };
    // SAFETY: window `w` of these columns reads `kernel` lines from `input + w * window`, `run` numbers each: since
    // `columns.start + w < windows(columns)` and with the border, the last one ends at or before the end of a line of the
    // map, and the last line at or before its end, since `row < windows(rows)`. It writes `valid` numbers from
    // `output + w * cell`, which are channels `first..first + valid` of cell `(columns.start + w) * up + cell % up` of this
    // row of the share, exclusively borrowed. `weights`, `scale` and `bias` hold whole blocks. All of it is what `check`
    // compared.
    unsafe { R::row(tile, columns.len()) };
}

/// Neighbouring windows and their block of outputs.
pub(super) struct Tile<E, O> {
    /// The first window's first number.
    pub input: *const E,
    /// Numbers from one line of a window to the next.
    pub line: usize,
    /// Numbers from one window to the next.
    pub window: usize,
    /// Lines of a window.
    pub taps: usize,
    /// Numbers of a line of a window: they are contiguous.
    pub run: usize,
    pub weights: *const E,
    pub scale: *const f32,
    pub bias: *const f32,
    pub floor: f32,
    /// The first window's first output.
    pub output: *mut O,
    /// Numbers from one window's outputs to the next one's.
    pub cell: usize,
    /// Outputs of the block that exist.
    pub valid: usize,
}

impl<E: Element, O: Element> Tile<E, O> {
    /// # Safety
    /// `P` windows and their outputs exist from here on, and the CPU has the instructions of `S`.
    #[inline(always)]
    unsafe fn compute<S, const P: usize, const J: usize>(&self)
    where
        S: Store<O, Element = E>,
    {
        // SAFETY: the caller's promise.
        unsafe {
            let mut sums = [[S::zero(); J]; P];
            let mut weights = self.weights;
            for tap in 0..self.taps {
                let line = self.input.add(tap * self.line);
                let mut at = 0;
                while at < self.run {
                    let mut lanes = [S::weights(weights); J];
                    for (j, lanes) in lanes.iter_mut().enumerate() {
                        *lanes = S::weights(weights.add(j * S::LANES * E::PER_UNIT));
                    }
                    weights = weights.add(J * S::LANES * E::PER_UNIT);
                    for (p, sums) in sums.iter_mut().enumerate() {
                        let unit = S::broadcast(line.add(p * self.window + at));
                        for (sum, lanes) in sums.iter_mut().zip(lanes) {
                            *sum = S::multiply_add(*sum, unit, lanes);
                        }
                    }
                    at += E::PER_UNIT;
                }
            }
            // Nothing but loops of constant length may touch the sums: indexed otherwise they would live in memory.
            self.write::<S, P, J>(&sums);
        }
    }

    /// Writes the results of as many windows as there are sums.
    ///
    /// # Safety
    /// Their outputs exist, and the CPU has the instructions of `S`.
    #[inline(always)]
    pub unsafe fn write<S, const P: usize, const J: usize>(&self, sums: &[[S::Sum; J]; P])
    where
        S: Store<O, Element = E>,
    {
        const { assert!(P * J * S::LANES <= MOST_RESULTS) };
        // SAFETY: the caller's promise.
        unsafe {
            if self.valid == J * S::LANES {
                self.finish::<S, P, J>(sums, self.output, self.cell);
            } else {
                let mut block = [const { MaybeUninit::<O>::uninit() }; MOST_RESULTS];
                let block = block.as_mut_ptr().cast::<O>();
                self.finish::<S, P, J>(sums, block, J * S::LANES);
                for p in 0..P {
                    let from = block.add(p * J * S::LANES);
                    std::ptr::copy_nonoverlapping(from, self.output.add(p * self.cell), self.valid);
                }
            }
        }
    }

    /// Writes whole blocks, `step` numbers apart.
    ///
    /// # Safety
    /// There is room for `P` of them, and the CPU has the instructions of `S`.
    #[inline(always)]
    unsafe fn finish<S, const P: usize, const J: usize>(&self, sums: &[[S::Sum; J]; P], output: *mut O, step: usize)
    where
        S: Store<O, Element = E>,
    {
        for (p, sums) in sums.iter().enumerate() {
            for (j, sum) in sums.iter().enumerate() {
                let first = j * S::LANES;
                // SAFETY: the caller's promise; biases fill whole blocks.
                unsafe {
                    let result = S::finish(*sum, self.scale.add(first), self.bias.add(first), self.floor);
                    S::store(result, output.add(p * step + first));
                }
            }
        }
    }

    /// # Safety
    /// At least `windows` windows and outputs exist from here on.
    #[inline(always)]
    pub unsafe fn advance(&mut self, windows: usize) {
        // `wrapping`: behind the last window the step may lead past the end of the map.
        self.input = self.input.wrapping_add(windows * self.window);
        self.output = self.output.wrapping_add(windows * self.cell);
    }

    /// Goes back to windows before.
    pub fn retreat(&mut self, windows: usize) {
        self.input = self.input.wrapping_sub(windows * self.window);
        self.output = self.output.wrapping_sub(windows * self.cell);
    }
}
