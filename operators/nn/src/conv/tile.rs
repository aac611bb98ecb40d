//! The loop nest that all instructions share, from the rows of a worker down to a tile of registers.
#![allow(unsafe_code)]

use std::ops::Range;

use super::pack::Packed;
use super::{Element, View};

/// Computes a share of a layer, on a CPU that has the instructions.
pub(crate) type Run<E, O> = unsafe fn(&Packed<E, O>, Share<E, O>);

/// The rows of one worker.
pub(crate) struct Share<'a, E, O> {
    pub input: View<'a, E>,
    /// Rows of windows (of input cells if the map is enlarged).
    pub rows: Range<usize>,
    /// Windows in a row.
    pub columns: usize,
    /// The rows of the output map that belong to `rows`, border columns included.
    pub output: &'a mut [O],
    /// Numbers of a row of the output map.
    pub row: usize,
    /// Numbers of a cell of the output map.
    pub cell: usize,
    /// The first channel to write.
    pub first: usize,
}

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
    const LANES: usize;

    unsafe fn zero() -> Self::Sum;
    /// `at`: `LANES` units, of any alignment.
    unsafe fn weights(at: *const Self::Element) -> Self::Units;
    /// `at`: one unit, of any alignment.
    unsafe fn broadcast(at: *const Self::Element) -> Self::Units;
    unsafe fn multiply_add(sum: Self::Sum, input: Self::Units, weights: Self::Units) -> Self::Sum;
    /// Adds `LANES` biases and raises the result to `floor`; NaN stays NaN.
    unsafe fn finish(sum: Self::Sum, bias: *const f32, floor: f32) -> Self::Sum;
}

/// Writes a register of results to `LANES` numbers of any alignment.
///
/// # Safety
/// As for [`Simd`].
pub(super) trait Store<O>: Simd {
    unsafe fn store(sum: Self::Sum, to: *mut O);
}

/// Rows that are computed before the next block of weights is read again.
const ROWS: usize = 4;

/// Most lanes of a register.
const MOST_LANES: usize = 16;

/// A share in tiles of `P` windows x `J` registers.
///
/// # Safety
/// The CPU has the instructions of `S`.
#[inline(always)]
pub(super) unsafe fn share<S, O, const P: usize, const J: usize>(
    layer: &Packed<S::Element, O>,
    mut share: Share<S::Element, O>,
) where
    S: Store<O>,
    S::Element: super::Kernel<O>,
    O: Element,
{
    check::<S, O, J>(layer, &share);
    let blocks = layer.bias.len() / layer.block;
    let size = layer.weights.len() / (layer.up * layer.up * blocks);
    let Range { start, end } = share.rows.clone();
    let mut first = start;
    while first < end {
        let last = (first + ROWS).min(end);
        for part in 0..layer.up * layer.up * blocks {
            let (cell, block) = (part / blocks, part % blocks);
            let weights = &layer.weights[part * size..(part + 1) * size];
            for row in first..last {
                // SAFETY: `check` has found the share to fit the layer; the CPU has the instructions.
                unsafe { windows::<S, O, P, J>(layer, &mut share, row, cell, block, weights) };
            }
        }
        first = last;
    }
}

/// What the pointers of [`windows`] rely on.
fn check<S, O, const J: usize>(layer: &Packed<S::Element, O>, share: &Share<S::Element, O>)
where
    S: Simd,
    S::Element: super::Kernel<O>,
    O: Element,
{
    let View {
        rows,
        columns,
        stored,
        data,
    } = share.input;
    assert!(J * S::LANES == layer.block && S::LANES <= MOST_LANES && layer.bias.len() % layer.block == 0);
    assert!(layer.bias.len() - layer.block < layer.outputs && layer.outputs <= layer.bias.len());
    let weights = layer.up * layer.up * layer.kernel * layer.kernel * stored * layer.bias.len();
    assert_eq!(layer.weights.len(), weights, "packed weights");
    assert_eq!(stored, layer.stored(), "channels of an input map");
    assert_eq!(
        data.len(),
        (rows + 2) * (columns + 2) * stored,
        "numbers of an input map"
    );
    assert!(share.rows.end <= layer.windows(rows) && share.columns == layer.windows(columns));
    assert!(layer.kernel == 3 || layer.kernel == 1);
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

/// The windows of one row, for one block of outputs and one of the cells that an input cell becomes.
///
/// # Safety
/// The CPU has the instructions of `S`, and [`check`] has passed with `row` in `share.rows`, `cell` below `up²`, `block`
/// one of the blocks, `weights` its part.
#[inline(always)]
unsafe fn windows<S, O, const P: usize, const J: usize>(
    layer: &Packed<S::Element, O>,
    share: &mut Share<S::Element, O>,
    row: usize,
    cell: usize,
    block: usize,
    weights: &[S::Element],
) where
    S: Store<O>,
    O: Element,
{
    let View {
        columns, stored, data, ..
    } = share.input;
    let (up, first) = (layer.up, block * layer.block);
    let valid = (layer.outputs - first).min(layer.block);
    // A window of 3x3 begins in the border, one of 1x1 behind it.
    let border = if layer.kernel == 3 { 0 } else { 1 };
    let line = (columns + 2) * stored;
    let input = &data[(row * layer.stride + border) * line + border * stored..];
    let output_row = (row - share.rows.start) * up + cell / up;
    let output = &mut share.output[output_row * share.row..(output_row + 1) * share.row];
    let output = &mut output[(1 + cell % up) * share.cell + share.first + first..];
    let mut tile = Tile::<S::Element, O> {
        input: input.as_ptr(),
        line,
        window: layer.stride * stored,
        taps: layer.kernel,
        weights: weights.as_ptr(),
        bias: layer.bias[first..].as_ptr(),
        floor: layer.floor,
        output: output.as_mut_ptr(),
        cell: up * share.cell,
        valid,
        run: layer.kernel * stored,
    };
    let mut left = share.columns;
    // SAFETY: window `w` of this row reads `kernel` lines from `input + w * window`, `run` numbers each: with
    // `w < windows(columns)` and the border, the last one ends at or before the end of a line of the map, and the last line
    // at or before its end, since `row < windows(rows)`. It writes `valid` numbers from `output + w * cell`, which are
    // channels `first..first + valid` of cell `w * up + cell % up` of this row of the share, exclusively borrowed.
    // `weights` and `bias` hold whole blocks. All of it is what `check` compared.
    unsafe {
        while left >= P {
            tile.compute::<S, P, J>();
            tile.advance(P);
            left -= P;
        }
        while left >= 4 {
            tile.compute::<S, 4, J>();
            tile.advance(4);
            left -= 4;
        }
        if left >= 2 {
            tile.compute::<S, 2, J>();
            tile.advance(2);
            left -= 2;
        }
        if left == 1 {
            tile.compute::<S, 1, J>();
        }
    }
}

/// Neighbouring windows and their block of outputs.
struct Tile<E, O> {
    /// The first window's first number.
    input: *const E,
    /// Numbers from one line of a window to the next.
    line: usize,
    /// Numbers from one window to the next.
    window: usize,
    /// Lines of a window.
    taps: usize,
    /// Numbers of a line of a window: they are contiguous.
    run: usize,
    weights: *const E,
    bias: *const f32,
    floor: f32,
    /// The first window's first output.
    output: *mut O,
    /// Numbers from one window's outputs to the next one's.
    cell: usize,
    /// Outputs of the block that exist.
    valid: usize,
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
            for (p, sums) in sums.iter().enumerate() {
                let output = self.output.add(p * self.cell);
                for (j, sum) in sums.iter().enumerate() {
                    let first = j * S::LANES;
                    let result = S::finish(*sum, self.bias.add(first), self.floor);
                    if first + S::LANES <= self.valid {
                        S::store(result, output.add(first));
                    } else if first < self.valid {
                        let mut part = [O::default(); MOST_LANES];
                        S::store(result, part.as_mut_ptr());
                        std::ptr::copy_nonoverlapping(part.as_ptr(), output.add(first), self.valid - first);
                    }
                }
            }
        }
    }

    /// # Safety
    /// At least `windows` windows and outputs exist from here on.
    #[inline(always)]
    unsafe fn advance(&mut self, windows: usize) {
        // `wrapping`: behind the last window the step may lead past the end of the map.
        self.input = self.input.wrapping_add(windows * self.window);
        self.output = self.output.wrapping_add(windows * self.cell);
    }
}
