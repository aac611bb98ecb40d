//! Convolutions for inference, on maps with channels last and a border of one cell of zeros.
//!
//! A kernel row of a 3x3 window is then 3 x channels contiguous numbers, no bounds test is needed, and concatenation is a
//! channel offset at write. Channels are counted in units of 4 bytes (1 f32, 2 bf16, 4 bytes), so that one loop nest serves all.
//! Every output is one sum in one order, whatever thread computes it: bits do not depend on the number of threads.
//! 3x3 windows with stride 1 are computed by tiles ([`winograd`]), all else and bytes directly ([`tile`]).

mod element;
mod isa;
mod map;
mod pack;
mod pool;
mod portable;
mod tile;
mod winograd;
#[cfg(target_arch = "x86_64")]
mod x86;

#[cfg(test)]
mod tests;

pub use element::Bf16;
pub(crate) use element::Element;
pub(crate) use element::U8;
pub use isa::{Isa, UnknownIsa};
pub(crate) use map::{Map, Rows, View, split};
pub(crate) use pack::{Kernel, Packed, Steps};
pub(crate) use pool::Pool;

/// A convolution with bias on a map padded with zeros so that stride 1 keeps its size, or a transposed one that enlarges
/// the map by `stride` (kernel = stride, no padding).
#[derive(Clone, Debug, PartialEq)]
pub struct Convolution {
    /// Channels that it reads.
    pub inputs: usize,
    /// Channels that it gives.
    pub outputs: usize,
    /// Side of the kernel: 1 or 3, or the stride if transposed.
    pub kernel: usize,
    /// Cells from one window to the next, or the factor of enlargement.
    pub stride: usize,
    /// Whether it enlarges the map.
    pub transposed: bool,
    /// Whether negative results become zero.
    pub relu: bool,
    /// `[outputs, inputs, kernel, kernel]`, or `[inputs, outputs, kernel, kernel]` if transposed.
    pub weights: Vec<f32>,
    /// One for each output.
    pub bias: Vec<f32>,
}

impl Convolution {
    /// Rows or columns of the result from those of the input.
    #[cfg(test)]
    pub fn size(&self, input: usize) -> usize {
        match self.transposed {
            true => input * self.stride,
            false => input.div_ceil(self.stride),
        }
    }

    /// The largest weight of each output, without its sign.
    pub(crate) fn max_weights(&self) -> impl Iterator<Item = f32> {
        let taps = self.kernel * self.kernel;
        (0..self.outputs).map(move |output| {
            let weights = (0..self.inputs * taps).map(|i| {
                let (input, tap) = (i / taps, i % taps);
                self.weight(output, input, tap / self.kernel, tap % self.kernel).abs()
            });
            weights.fold(0.0, f32::max)
        })
    }

    pub(crate) fn weight(&self, output: usize, input: usize, row: usize, column: usize) -> f32 {
        let (major, minor, minors) = match self.transposed {
            true => (input, output, self.outputs),
            false => (output, input, self.inputs),
        };
        self.weights[((major * minors + minor) * self.kernel + row) * self.kernel + column]
    }
}

/// Runs convolutions one after the other in f32, for tests. `data`: `[rows, columns, channels]`, without a border; so is the result.
///
/// # Panics
/// If the sizes do not fit together or the CPU lacks `isa`.
#[cfg(test)]
pub(crate) fn apply(layers: &[Convolution], isa: Isa, threads: usize, size: [usize; 2], data: &[f32]) -> Vec<f32> {
    assert!(isa.is_available(), "this CPU has no {isa}");
    let mut pool = Pool::new(threads);
    let channels = layers.first().map_or(0, |layer| layer.inputs);
    let mut map = Map::<f32>::new(size[0], size[1], channels);
    map.fill_from(data);
    for layer in layers {
        let mut next = Map::new(layer.size(map.rows), layer.size(map.columns), layer.outputs);
        Packed::<f32>::new(layer, isa, Steps::ONE).run(&mut pool, map.view(), &mut next, 0);
        map = next;
    }
    map.to_f32(&mut pool)
}
