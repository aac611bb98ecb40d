//! Convolutions for inference, on maps with channels last and a border of one cell of zeros.
//!
//! A kernel row of a 3x3 window is then 3 x channels contiguous numbers, no bounds test is needed, and concatenation is a
//! channel offset at write. Channels are counted in units of 4 bytes (1 f32, 2 bf16, 4 bytes), so that one loop nest serves all.
//! Every output is one sum in one order, whatever thread computes it: bits do not depend on the number of threads.
//! 3x3 windows with stride 1 are computed by tiles ([`winograd`]), all else and bytes directly ([`tile`]).

mod aligned;
mod convolution;
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

pub use convolution::Convolution;
pub use element::{Bf16, Element, U8};
pub use isa::{Isa, UnknownIsa};
pub use map::{Map, Rows, View, split};
pub use pack::{Kernel, Packed, Share, Steps};
pub use pool::{Pool, lock};

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
