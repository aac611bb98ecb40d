use std::ops::Range;

use super::aligned::Aligned;
use super::convolution::Convolution;
use super::element::Element;
use super::isa::Isa;
use super::map::{Map, Rows, View};
use super::pool::Pool;
use super::winograd::places::{self, SIDE, at_places};

/// Computes a share of a layer, on a CPU that has the instructions.
pub type Run<E, O> = unsafe fn(&Packed<E, O>, Share<E, O>);

/// The rows of one worker.
pub struct Share<'a, E, O> {
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
    /// Numbers for the worker's own use, as many as [`Packed::room`] says.
    pub room: &'a mut [f32],
}

/// A number type with its kernels, which read maps of it and write maps of `O`.
pub trait Kernel<O>: Element {
    /// The kernel for cells of so many numbers and so many outputs in these instructions, and the outputs that it computes
    /// side by side.
    fn kernel(isa: Isa, stored: usize, outputs: usize) -> (Run<Self, O>, usize);

    /// The same by [`winograd`](super::winograd)'s tiles, where they are faster.
    fn winograd(isa: Isa, outputs: usize) -> Option<(Run<Self, O>, usize)>;
}

/// What a number of a map stands for: 1, but for bytes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Steps {
    /// In the map that a layer reads.
    pub input: f32,
    /// In the map that it writes.
    pub output: f32,
}

impl Steps {
    /// Of maps of floating-point numbers.
    pub const ONE: Steps = Steps {
        input: 1.0,
        output: 1.0,
    };
}

/// A convolution made ready for a kernel.
pub struct Packed<E, O = E> {
    pub(super) inputs: usize,
    pub(super) outputs: usize,
    pub(super) kernel: usize,
    pub(super) stride: usize,
    /// Factor of enlargement; 1 if not transposed.
    pub(super) up: usize,
    /// Smallest result.
    pub(super) floor: f32,
    /// Rows and columns of outputs that are computed as one: 1, or those of a tile of [`winograd`](super::winograd).
    pub(super) side: usize,
    /// Outputs side by side.
    pub(super) block: usize,
    /// `[up, up, blocks, taps, units, block, numbers of a unit]`; none if outputs are computed by tiles.
    pub(super) weights: Aligned<E>,
    /// `[blocks, places, inputs, block]`; none if they are not.
    pub(super) at_places: Aligned<f32>,
    /// What a sum is multiplied by, `[blocks, block]`.
    pub(super) scales: Vec<f32>,
    /// `[blocks, block]`.
    pub(super) bias: Vec<f32>,
    run: Run<E, O>,
}

impl<E: Kernel<O>, O: Element> Packed<E, O> {
    /// By tiles where that is faster.
    ///
    /// # Panics
    /// If the CPU lacks `isa`, or the convolution's sizes do not fit together.
    pub fn new(layer: &Convolution, isa: Isa, steps: Steps) -> Self {
        Packed::with(layer, isa, steps, places::suits(layer))
    }

    /// As [`Packed::new`], by tiles only if they are wanted and the number type has them.
    pub(super) fn with(layer: &Convolution, isa: Isa, steps: Steps, tiles: bool) -> Self {
        assert!(isa.is_available(), "this CPU has no {isa}");
        let Convolution {
            inputs,
            outputs,
            kernel,
            stride,
            ..
        } = *layer;
        assert!(inputs > 0 && outputs > 0 && stride > 0, "a convolution of nothing");
        assert_eq!(
            layer.weights.len(),
            inputs * outputs * kernel * kernel,
            "weights of a convolution"
        );
        assert_eq!(layer.bias.len(), outputs, "biases of a convolution");
        let up = if layer.transposed { stride } else { 1 };
        match layer.transposed {
            true => assert_eq!(kernel, stride, "kernel of a transposed convolution"),
            false => assert!(
                kernel == 1 || kernel == 3,
                "kernel of a convolution: 1 or 3, found {kernel}"
            ),
        }
        let direct = || E::kernel(isa, inputs.next_multiple_of(E::PER_UNIT), outputs);
        let tiled = E::winograd(isa, outputs).filter(|_| tiles);
        let side = if tiled.is_some() { SIDE } else { 1 };
        let (run, block) = tiled.unwrap_or_else(direct);
        let weight_steps = layer.max_weights().map(E::weight_step);
        let weight_steps: Vec<f32> = weight_steps.collect();
        let filled = |numbers: &mut dyn Iterator<Item = f32>| {
            let mut numbers: Vec<f32> = numbers.collect();
            numbers.resize(outputs.next_multiple_of(block), 0.0);
            numbers
        };
        let (weights, at_places) = match side {
            1 => (pack(layer, &weight_steps, up, block), Aligned::zeros(0)),
            _ => (
                Aligned::zeros(0),
                pack(&at_places(layer), &vec![1.0; outputs], up, block),
            ),
        };
        Packed {
            inputs,
            outputs,
            // A transposed convolution is one of 1x1 for each cell that an input cell becomes.
            kernel: if layer.transposed { 1 } else { kernel },
            stride: if layer.transposed { 1 } else { stride },
            up,
            floor: if layer.relu { 0.0 } else { f32::NEG_INFINITY },
            side,
            block,
            weights,
            at_places,
            scales: filled(&mut weight_steps.iter().map(|step| step * steps.input / steps.output)),
            bias: filled(&mut layer.bias.iter().map(|bias| bias / steps.output)),
            run,
        }
    }

    /// Numbers of an input cell.
    pub(super) fn stored(&self) -> usize {
        self.inputs.next_multiple_of(E::PER_UNIT)
    }

    /// Matrices of weights for each of the cells that an input cell becomes.
    pub(super) fn taps(&self) -> usize {
        (self.side + self.kernel - 1).pow(2)
    }

    /// Numbers that a worker needs beside its maps.
    pub(super) fn room(&self) -> usize {
        match self.side {
            1 => 0,
            _ => places::room(self.inputs),
        }
    }

    pub(super) fn windows(&self, input: usize) -> usize {
        input.div_ceil(self.stride)
    }

    /// Channels that it gives.
    pub fn outputs(&self) -> usize {
        self.outputs
    }

    /// Whether windows reach beyond the map.
    pub fn needs_border(&self) -> bool {
        self.kernel > 1
    }

    /// Writes channels `first..first + outputs` of `output`.
    ///
    /// # Panics
    /// If a map has another size or too few channels.
    pub fn run(&self, pool: &mut Pool, input: View<E>, output: &mut Map<O>, first: usize) {
        let size = [
            self.windows(input.rows) * self.up,
            self.windows(input.columns) * self.up,
        ];
        assert_eq!([output.rows, output.columns], size, "size of an output map");
        assert!(first + self.outputs <= output.channels, "channels of an output map");
        assert_eq!(input.stored, self.stored(), "channels of an input map");
        assert!(input.border == 1 || !self.needs_border(), "border of an input map");
        assert_eq!(input.data.len(), input.numbers(), "numbers of an input map");
        let (row, cell) = (output.row_length(), output.stored);
        let shares = output.shares(pool.threads(), self.up * self.side);
        pool.each_in_room(shares, self.room(), |Rows { range, data }, room| {
            let share = Share {
                input,
                rows: range.start / self.up..range.end / self.up,
                columns: size[1] / self.up,
                output: data,
                row,
                cell,
                first,
                room,
            };
            // SAFETY: `new` has chosen the kernel for instructions that the CPU has.
            #[allow(unsafe_code)]
            unsafe {
                (self.run)(self, share)
            };
        });
    }
}

fn pack<E: Element>(layer: &Convolution, steps: &[f32], up: usize, block: usize) -> Aligned<E> {
    let kernel = if layer.transposed { 1 } else { layer.kernel };
    let (blocks, units) = (layer.outputs.div_ceil(block), layer.inputs.div_ceil(E::PER_UNIT));
    let mut weights = Aligned::with_capacity(up * up * blocks * kernel * kernel * units * block * E::PER_UNIT);
    let weight =
        |output: usize, input: usize, row: usize, column: usize| match output < layer.outputs && input < layer.inputs {
            true => E::weight(layer.weight(output, input, row, column) / steps[output]),
            false => E::default(),
        };
    for (cell, first) in (0..up * up).flat_map(|cell| (0..blocks).map(move |index| (cell, index * block))) {
        for tap in 0..kernel * kernel {
            let (row, column) = match layer.transposed {
                true => (cell / up, cell % up),
                false => (tap / kernel, tap % kernel),
            };
            for unit in 0..units {
                for output in first..first + block {
                    let inputs = unit * E::PER_UNIT..(unit + 1) * E::PER_UNIT;
                    weights.extend(inputs.map(|input| weight(output, input, row, column)));
                }
            }
        }
    }
    weights
}
