//! AMX: products of tiles, 16 windows x 64 bytes of their inputs times as many of 16 outputs.
//!
//! The standard library has no stable functions for them, so they are written out. No register but the eight tiles is touched
//! that the compiler does not know of, and the compiler itself never uses those.

use std::arch::asm;

use super::avx512::{Avx512Bf16, Avx512Bytes};
use crate::conv::element::{Bf16, Element, U8};
use crate::conv::pack::{Kernel, Packed, Share};
use crate::conv::tile::{Registers, Row, Store, Tile, share};

/// Outputs side by side: two tiles.
pub(super) const BLOCK: usize = 32;
/// Windows of a tile.
const WINDOWS: usize = 16;
/// Bytes of a tile's row.
const ROW: usize = 64;

/// Whether the inputs of a window's line come in whole rows of tiles.
pub(super) fn fits<E>(stored: usize) -> bool {
    (stored * size_of::<E>()).is_multiple_of(ROW)
}

/// # Safety
/// The CPU and the system have AMX.
#[target_feature(enable = "avx512f,avx512bf16")]
pub(super) unsafe fn half<O: Element>(layer: &Packed<Bf16, O>, part: Share<Bf16, O>)
where
    Avx512Bf16: Store<O>,
    Bf16: Kernel<O>,
{
    // SAFETY: the caller's promise.
    unsafe { with_tiles(|| share::<Tiles<Avx512Bf16>, Bf16, O>(layer, part)) }
}

/// # Safety
/// The CPU and the system have AMX.
#[target_feature(enable = "avx512f,avx512vnni")]
pub(super) unsafe fn bytes<O: Element>(layer: &Packed<U8, O>, part: Share<U8, O>)
where
    Avx512Bytes: Store<O>,
    U8: Kernel<O>,
{
    // SAFETY: the caller's promise.
    unsafe { with_tiles(|| share::<Tiles<Avx512Bytes>, U8, O>(layer, part)) }
}

/// Which rows and columns the tiles have, as `ldtilecfg` reads it.
#[repr(C, align(64))]
struct Configuration {
    palette: u8,
    start: u8,
    reserved: [u8; 14],
    /// Bytes of a row.
    columns: [u16; 16],
    rows: [u8; 16],
}

/// Does something with eight tiles of 16 rows and 64 bytes.
///
/// # Safety
/// The CPU and the system have AMX.
#[inline(always)]
unsafe fn with_tiles(work: impl FnOnce()) {
    const FULL: Configuration = Configuration {
        palette: 1,
        start: 0,
        reserved: [0; 14],
        columns: [
            ROW as u16, ROW as u16, ROW as u16, ROW as u16, ROW as u16, ROW as u16, ROW as u16, ROW as u16, 0, 0, 0, 0,
            0, 0, 0, 0,
        ],
        rows: [16, 16, 16, 16, 16, 16, 16, 16, 0, 0, 0, 0, 0, 0, 0, 0],
    };
    // SAFETY: the instructions read the 64 bytes given, or none.
    unsafe {
        asm!("ldtilecfg [{}]", in(reg) &FULL, options(nostack, readonly, preserves_flags));
        work();
        asm!("tilerelease", options(nostack, nomem, preserves_flags));
    }
}

/// Rows in tiles; where a row has fewer windows than a tile, in the registers of `S`.
struct Tiles<S>(std::marker::PhantomData<S>);

/// Sums of 32 windows at most, as tiles are stored.
#[repr(C, align(64))]
struct Sums([[u32; BLOCK]; 2 * WINDOWS]);

/// What a product of tiles reads; all in bytes.
struct Operands {
    input: *const u8,
    /// From one window to the next.
    window: usize,
    /// From one line of a window to the next.
    line: usize,
    lines: usize,
    /// Rows of tiles in a line of a window.
    steps: usize,
    weights: *const u8,
}

trait Product {
    /// Sums of 32 windows.
    ///
    /// # Safety
    /// The operands are there, and the tiles.
    unsafe fn double(operands: &Operands, sums: &mut Sums);
    /// Sums of 16 windows.
    ///
    /// # Safety
    /// The operands are there, and the tiles.
    unsafe fn single(operands: &Operands, sums: &mut Sums);
}

/// Products with an instruction: tiles 0 to 3 hold sums, 4 and 5 windows, 6 and 7 weights.
macro_rules! product {
    ($simd:ty, $multiply:literal) => {
        impl Product for $simd {
            #[inline(always)]
            unsafe fn double(operands: &Operands, sums: &mut Sums) {
                // SAFETY: the caller's promise; `sums` has room for four tiles.
                unsafe {
                    asm!(
                        "tilezero tmm0",
                        "tilezero tmm1",
                        "tilezero tmm2",
                        "tilezero tmm3",
                        "2:",
                        "mov {first}, {line}",
                        "lea {second}, [{line} + {half}]",
                        "mov {left}, {steps}",
                        "3:",
                        "tileloadd tmm6, [{weights} + {pitch}]",
                        "tileloadd tmm4, [{first} + {window}]",
                        concat!($multiply, " tmm0, tmm4, tmm6"),
                        "tileloadd tmm7, [{weights} + {pitch} + 64]",
                        concat!($multiply, " tmm1, tmm4, tmm7"),
                        "tileloadd tmm5, [{second} + {window}]",
                        concat!($multiply, " tmm2, tmm5, tmm6"),
                        concat!($multiply, " tmm3, tmm5, tmm7"),
                        "add {first}, 64",
                        "add {second}, 64",
                        "add {weights}, 2048",
                        "dec {left}",
                        "jnz 3b",
                        "add {line}, {lines_apart}",
                        "dec {lines}",
                        "jnz 2b",
                        "tilestored [{sums} + {pitch}], tmm0",
                        "tilestored [{sums} + {pitch} + 64], tmm1",
                        "tilestored [{sums} + {pitch} + 2048], tmm2",
                        "tilestored [{sums} + {pitch} + 2112], tmm3",
                        first = out(reg) _,
                        second = out(reg) _,
                        left = out(reg) _,
                        line = inout(reg) operands.input => _,
                        half = in(reg) WINDOWS * operands.window,
                        steps = in(reg) operands.steps,
                        weights = inout(reg) operands.weights => _,
                        pitch = in(reg) BLOCK * 4,
                        window = in(reg) operands.window,
                        lines_apart = in(reg) operands.line,
                        lines = inout(reg) operands.lines => _,
                        sums = in(reg) sums,
                        out("tmm0") _, out("tmm1") _, out("tmm2") _, out("tmm3") _,
                        out("tmm4") _, out("tmm5") _, out("tmm6") _, out("tmm7") _,
                        options(nostack),
                    );
                }
            }

            #[inline(always)]
            unsafe fn single(operands: &Operands, sums: &mut Sums) {
                // SAFETY: the caller's promise; `sums` has room for two tiles.
                unsafe {
                    asm!(
                        "tilezero tmm0",
                        "tilezero tmm1",
                        "2:",
                        "mov {first}, {line}",
                        "mov {left}, {steps}",
                        "3:",
                        "tileloadd tmm6, [{weights} + {pitch}]",
                        "tileloadd tmm4, [{first} + {window}]",
                        concat!($multiply, " tmm0, tmm4, tmm6"),
                        "tileloadd tmm7, [{weights} + {pitch} + 64]",
                        concat!($multiply, " tmm1, tmm4, tmm7"),
                        "add {first}, 64",
                        "add {weights}, 2048",
                        "dec {left}",
                        "jnz 3b",
                        "add {line}, {lines_apart}",
                        "dec {lines}",
                        "jnz 2b",
                        "tilestored [{sums} + {pitch}], tmm0",
                        "tilestored [{sums} + {pitch} + 64], tmm1",
                        first = out(reg) _,
                        left = out(reg) _,
                        line = inout(reg) operands.input => _,
                        steps = in(reg) operands.steps,
                        weights = inout(reg) operands.weights => _,
                        pitch = in(reg) BLOCK * 4,
                        window = in(reg) operands.window,
                        lines_apart = in(reg) operands.line,
                        lines = inout(reg) operands.lines => _,
                        sums = in(reg) sums,
                        out("tmm0") _, out("tmm1") _, out("tmm4") _, out("tmm6") _, out("tmm7") _,
                        options(nostack),
                    );
                }
            }
        }
    };
}
product!(Avx512Bf16, "tdpbf16ps");
product!(Avx512Bytes, "tdpbusd");

impl<S, O: Element> Row<S::Element, O> for Tiles<S>
where
    S: Store<O> + Product,
{
    const BLOCK: usize = BLOCK;
    const WINDOWS: usize = 2 * WINDOWS;

    #[inline(always)]
    unsafe fn row(mut tile: Tile<S::Element, O>, windows: usize) {
        // SAFETY: the caller's promise: no step computes windows beyond the row's; `fits` has found the steps to be whole.
        unsafe {
            if windows < WINDOWS {
                return Registers::<S, 12, 2>::row(tile, windows);
            }
            let mut left = windows;
            while left >= 2 * WINDOWS {
                double::<S, O>(&tile);
                tile.advance(2 * WINDOWS);
                left -= 2 * WINDOWS;
            }
            if left >= WINDOWS {
                single::<S, O>(&tile);
                tile.advance(WINDOWS);
                left -= WINDOWS;
            }
            if left > 0 {
                // The last tile of a row computes windows of the one before once more.
                tile.retreat(WINDOWS - left);
                single::<S, O>(&tile);
            }
        }
    }
}

fn operands<E, O>(tile: &Tile<E, O>) -> Operands {
    Operands {
        input: tile.input.cast(),
        window: tile.window * size_of::<E>(),
        line: tile.line * size_of::<E>(),
        lines: tile.taps,
        steps: tile.run * size_of::<E>() / ROW,
        weights: tile.weights.cast(),
    }
}

/// # Safety
/// 32 windows and their outputs exist from the tile's on, and the CPU has the instructions.
#[inline(always)]
unsafe fn double<S: Store<O> + Product, O: Element>(tile: &Tile<S::Element, O>) {
    let mut sums = Sums([[0; BLOCK]; 2 * WINDOWS]);
    // SAFETY: the caller's promise.
    unsafe {
        S::double(&operands(tile), &mut sums);
        write::<S, O>(tile, &sums, 2 * WINDOWS);
    }
}

/// # Safety
/// 16 windows and their outputs exist from the tile's on, and the CPU has the instructions.
#[inline(always)]
unsafe fn single<S: Store<O> + Product, O: Element>(tile: &Tile<S::Element, O>) {
    let mut sums = Sums([[0; BLOCK]; 2 * WINDOWS]);
    // SAFETY: the caller's promise.
    unsafe {
        S::single(&operands(tile), &mut sums);
        write::<S, O>(tile, &sums, WINDOWS);
    }
}

/// # Safety
/// The outputs of so many windows exist from the tile's on, and the CPU has the instructions.
#[inline(always)]
unsafe fn write<S: Store<O>, O: Element>(tile: &Tile<S::Element, O>, sums: &Sums, windows: usize) {
    const TOGETHER: usize = 8;
    const { assert!(size_of::<S::Sum>() == ROW) };
    for first in (0..windows).step_by(TOGETHER) {
        let mut part = Tile { ..*tile };
        // SAFETY: the caller's promise; sums of two registers lie as in the rows of two tiles.
        unsafe {
            part.advance(first);
            part.write::<S, TOGETHER, 2>(&*sums.0.as_ptr().add(first).cast());
        }
    }
}
