//! Kernels in the vector and tile instructions of x86-64.
#![allow(unsafe_code)]

#[cfg(target_os = "linux")]
mod amx;
pub(super) mod ask;
mod avx2;
mod avx512;

use super::element::{Bf16, Element, U8};
use super::isa::Isa;
use super::pack::{Kernel, Packed, Run, Share};
use super::tile::{Registers, Row, Store, share};
use avx2::{Avx2, Avx2Bytes};
use avx512::{Avx512, Avx512Bf16, Avx512Bytes};

/// The f32 kernel in these instructions, if they are of x86-64, and the outputs of a block.
pub(super) fn single(isa: Isa, outputs: usize) -> Option<(Run<f32, f32>, usize)> {
    match isa {
        Isa::Portable => None,
        Isa::Avx2 => Some((avx2, 16)),
        Isa::Avx512 | Isa::Avx512Bf16 | Isa::Amx if wide(outputs) => Some((avx512_wide, 64)),
        Isa::Avx512 | Isa::Avx512Bf16 | Isa::Amx => Some((avx512_narrow, 32)),
    }
}

/// The f32 kernel of [`winograd`](super::winograd)'s tiles, if these instructions are of x86-64, and the outputs of a block.
pub(super) fn winograd(isa: Isa, outputs: usize) -> Option<(Run<f32, f32>, usize)> {
    match isa {
        Isa::Portable => None,
        Isa::Avx2 => Some((avx2_tiles, 16)),
        Isa::Avx512 | Isa::Avx512Bf16 | Isa::Amx if wide(outputs) => Some((avx512_wide_tiles, 64)),
        Isa::Avx512 | Isa::Avx512Bf16 | Isa::Amx => Some((avx512_narrow_tiles, 32)),
    }
}

/// The kernel of [`winograd`](super::winograd)'s tiles of bf16 maps with products of f32, if these instructions round to bf16,
/// and the outputs of a block.
pub(super) fn half_winograd<O: Element>(isa: Isa, outputs: usize) -> Option<(Run<Bf16, O>, usize)>
where
    Avx512Bf16: Store<O>,
    Bf16: Kernel<O>,
{
    match isa {
        Isa::Amx | Isa::Avx512Bf16 if wide(outputs) => Some((bf16_wide_tiles, 64)),
        Isa::Amx | Isa::Avx512Bf16 => Some((bf16_narrow_tiles, 32)),
        Isa::Avx512 | Isa::Avx2 | Isa::Portable => None,
    }
}

/// The bf16 kernel, if these instructions have products of bf16, and the outputs of a block; `stored`: numbers of a cell.
pub(super) fn half<O: Element>(isa: Isa, stored: usize, outputs: usize) -> Option<(Run<Bf16, O>, usize)>
where
    Avx512Bf16: Store<O>,
    Bf16: Kernel<O>,
{
    match isa {
        #[cfg(target_os = "linux")]
        Isa::Amx if amx::fits::<Bf16>(stored) => Some((amx::half, amx::BLOCK)),
        Isa::Amx | Isa::Avx512Bf16 if wide(outputs) => Some((bf16_wide, 64)),
        Isa::Amx | Isa::Avx512Bf16 => Some((bf16_narrow, 32)),
        Isa::Avx512 | Isa::Avx2 | Isa::Portable => None,
    }
}

/// The kernel of bytes, if these instructions have products of them, and the outputs of a block; `stored`: numbers of a cell.
pub(super) fn bytes<O: Element>(isa: Isa, stored: usize, outputs: usize) -> Option<(Run<U8, O>, usize)>
where
    Avx512Bytes: Store<O>,
    Avx2Bytes: Store<O>,
    U8: Kernel<O>,
{
    let has_products = is_x86_feature_detected!("avx512vnni");
    match isa {
        #[cfg(target_os = "linux")]
        Isa::Amx if amx::fits::<U8>(stored) => Some((amx::bytes, amx::BLOCK)),
        Isa::Amx | Isa::Avx512Bf16 | Isa::Avx512 if has_products && wide(outputs) => Some((vnni_wide, 64)),
        Isa::Amx | Isa::Avx512Bf16 | Isa::Avx512 if has_products => Some((vnni_narrow, 32)),
        Isa::Amx | Isa::Avx512Bf16 | Isa::Avx512 | Isa::Avx2 => Some((avx2_bytes, 16)),
        Isa::Portable => None,
    }
}

/// Whether blocks of 64 outputs compute no more outputs that do not exist than blocks of 32.
fn wide(outputs: usize) -> bool {
    outputs.next_multiple_of(64) == outputs.next_multiple_of(32)
}

/// Defines a kernel: the loop nest, compiled for its instructions.
macro_rules! kernel {
    ($name:ident, $features:literal, $element:ty, $row:ty) => {
        /// # Safety
        /// The CPU has the instructions.
        #[target_feature(enable = $features)]
        unsafe fn $name<O: Element>(layer: &Packed<$element, O>, part: Share<$element, O>)
        where
            $element: Kernel<O>,
            $row: Row<$element, O>,
        {
            // SAFETY: the caller's promise.
            unsafe { share::<$row, $element, O>(layer, part) }
        }
    };
}

// Tiles: 12 sums of 16 registers with AVX2, 24 of 32 with AVX-512; the rest holds weights and one unit of the input.
kernel!(avx2, "avx2,fma", f32, Registers<Avx2, 6, 2>);
kernel!(avx512_wide, "avx512f", f32, Registers<Avx512, 6, 4>);
kernel!(avx512_narrow, "avx512f", f32, Registers<Avx512, 12, 2>);
kernel!(bf16_wide, "avx512f,avx512bf16", Bf16, Registers<Avx512Bf16, 6, 4>);
kernel!(bf16_narrow, "avx512f,avx512bf16", Bf16, Registers<Avx512Bf16, 12, 2>);
kernel!(avx2_bytes, "avx2", U8, Registers<Avx2Bytes, 6, 2>);
kernel!(vnni_wide, "avx512f,avx512vnni", U8, Registers<Avx512Bytes, 6, 4>);
kernel!(vnni_narrow, "avx512f,avx512vnni", U8, Registers<Avx512Bytes, 12, 2>);

/// Defines a kernel of [`winograd`](super::winograd)'s tiles, from the instructions for products and those for maps.
macro_rules! tiles {
    ($name:ident, $features:literal, $simd:ty, $maps:ty, $element:ty, $windows:literal, $registers:literal) => {
        /// # Safety
        /// The CPU has the instructions.
        #[target_feature(enable = $features)]
        unsafe fn $name<O: Element>(layer: &Packed<$element, O>, part: Share<$element, O>)
        where
            $maps: Store<O>,
            $element: Kernel<O>,
        {
            // SAFETY: the caller's promise.
            unsafe { super::winograd::share::<$simd, $maps, O, $windows, $registers>(layer, part) }
        }
    };
}

tiles!(avx2_tiles, "avx2,fma", Avx2, Avx2, f32, 6, 2);
tiles!(avx512_wide_tiles, "avx512f", Avx512, Avx512, f32, 6, 4);
tiles!(avx512_narrow_tiles, "avx512f", Avx512, Avx512, f32, 12, 2);
tiles!(bf16_wide_tiles, "avx512f,avx512bf16", Avx512, Avx512Bf16, Bf16, 6, 4);
tiles!(bf16_narrow_tiles, "avx512f,avx512bf16", Avx512, Avx512Bf16, Bf16, 12, 2);
