//! Kernels in plain Rust, in registers of 8 numbers that the compiler maps to what the CPU has.
#![allow(unsafe_code)]

use super::element::{Bf16, Element, U8};
use super::isa::Isa;
use super::pack::{Kernel, Packed, Run, Share};
use super::tile::{Load, Registers, Simd, Store, share};
use super::winograd;

const LANES: usize = 8;

struct Single;

impl Simd for Single {
    type Element = f32;
    type Sum = [f32; LANES];
    type Units = [f32; LANES];
    type Results = [f32; LANES];
    const LANES: usize = LANES;

    #[inline(always)]
    unsafe fn zero() -> [f32; LANES] {
        [0.0; LANES]
    }

    #[inline(always)]
    unsafe fn weights(at: *const f32) -> [f32; LANES] {
        // SAFETY: the caller gives `LANES` units.
        unsafe { at.cast::<[f32; LANES]>().read_unaligned() }
    }

    #[inline(always)]
    unsafe fn broadcast(at: *const f32) -> [f32; LANES] {
        // SAFETY: the caller gives a unit.
        [unsafe { at.read_unaligned() }; LANES]
    }

    #[inline(always)]
    unsafe fn multiply_add(mut sum: [f32; LANES], input: [f32; LANES], weights: [f32; LANES]) -> [f32; LANES] {
        for i in 0..LANES {
            sum[i] += input[i] * weights[i];
        }
        sum
    }

    #[inline(always)]
    unsafe fn finish(sum: [f32; LANES], _: *const f32, bias: *const f32, floor: f32) -> [f32; LANES] {
        // SAFETY: the caller gives `LANES` biases.
        unsafe { finish(sum, bias, floor) }
    }
}

impl Load for Single {
    #[inline(always)]
    unsafe fn load(at: *const f32) -> [f32; LANES] {
        // SAFETY: the caller's promise.
        unsafe { Single::weights(at) }
    }
}

impl Store<f32> for Single {
    #[inline(always)]
    unsafe fn store(results: [f32; LANES], to: *mut f32) {
        // SAFETY: the caller gives room for `LANES` numbers.
        unsafe { to.cast::<[f32; LANES]>().write_unaligned(results) };
    }
}

/// bf16 where the CPU has no products of it: exact products, f32 sums.
struct Half;

impl Simd for Half {
    type Element = Bf16;
    type Sum = [f32; LANES];
    type Units = [u32; LANES];
    type Results = [f32; LANES];
    const LANES: usize = LANES;

    #[inline(always)]
    unsafe fn zero() -> [f32; LANES] {
        [0.0; LANES]
    }

    #[inline(always)]
    unsafe fn weights(at: *const Bf16) -> [u32; LANES] {
        // SAFETY: the caller gives `LANES` units of two.
        unsafe { at.cast::<[u32; LANES]>().read_unaligned() }
    }

    #[inline(always)]
    unsafe fn broadcast(at: *const Bf16) -> [u32; LANES] {
        // SAFETY: the caller gives a unit of two.
        [unsafe { at.cast::<u32>().read_unaligned() }; LANES]
    }

    #[inline(always)]
    unsafe fn multiply_add(mut sum: [f32; LANES], input: [u32; LANES], weights: [u32; LANES]) -> [f32; LANES] {
        let halves = |unit: u32| (f32::from_bits(unit << 16), f32::from_bits(unit & 0xffff_0000));
        for i in 0..LANES {
            let (input, weights) = (halves(input[i]), halves(weights[i]));
            sum[i] += input.0 * weights.0;
            sum[i] += input.1 * weights.1;
        }
        sum
    }

    #[inline(always)]
    unsafe fn finish(sum: [f32; LANES], _: *const f32, bias: *const f32, floor: f32) -> [f32; LANES] {
        // SAFETY: the caller gives `LANES` biases.
        unsafe { finish(sum, bias, floor) }
    }
}

impl Load for Half {
    #[inline(always)]
    unsafe fn load(at: *const Bf16) -> [f32; LANES] {
        // SAFETY: the caller gives `LANES` numbers.
        unsafe { at.cast::<[Bf16; LANES]>().read_unaligned() }.map(Bf16::to_f32)
    }
}

impl Store<f32> for Half {
    #[inline(always)]
    unsafe fn store(results: [f32; LANES], to: *mut f32) {
        // SAFETY: the caller gives room for `LANES` numbers.
        unsafe { to.cast::<[f32; LANES]>().write_unaligned(results) };
    }
}

impl Store<Bf16> for Half {
    #[inline(always)]
    unsafe fn store(results: [f32; LANES], to: *mut Bf16) {
        // SAFETY: the caller gives room for `LANES` numbers.
        unsafe { to.cast::<[Bf16; LANES]>().write_unaligned(results.map(Bf16::from_f32)) };
    }
}

/// Steps of a byte times weights of a byte.
struct Bytes;

impl Simd for Bytes {
    type Element = U8;
    type Sum = [i32; LANES];
    type Units = [[u8; 4]; LANES];
    type Results = [f32; LANES];
    const LANES: usize = LANES;

    #[inline(always)]
    unsafe fn zero() -> [i32; LANES] {
        [0; LANES]
    }

    #[inline(always)]
    unsafe fn weights(at: *const U8) -> [[u8; 4]; LANES] {
        // SAFETY: the caller gives `LANES` units of four.
        unsafe { at.cast::<[[u8; 4]; LANES]>().read_unaligned() }
    }

    #[inline(always)]
    unsafe fn broadcast(at: *const U8) -> [[u8; 4]; LANES] {
        // SAFETY: the caller gives a unit of four.
        [unsafe { at.cast::<[u8; 4]>().read_unaligned() }; LANES]
    }

    #[inline(always)]
    unsafe fn multiply_add(mut sum: [i32; LANES], input: [[u8; 4]; LANES], weights: [[u8; 4]; LANES]) -> [i32; LANES] {
        for i in 0..LANES {
            for k in 0..4 {
                sum[i] += i32::from(input[i][k]) * i32::from(weights[i][k] as i8);
            }
        }
        sum
    }

    #[inline(always)]
    unsafe fn finish(sum: [i32; LANES], scale: *const f32, bias: *const f32, floor: f32) -> [f32; LANES] {
        // SAFETY: the caller gives `LANES` scales and biases.
        unsafe {
            let scale = scale.cast::<[f32; LANES]>().read_unaligned();
            finish(std::array::from_fn(|i| sum[i] as f32 * scale[i]), bias, floor)
        }
    }
}

impl Store<f32> for Bytes {
    #[inline(always)]
    unsafe fn store(results: [f32; LANES], to: *mut f32) {
        // SAFETY: the caller gives room for `LANES` numbers.
        unsafe { to.cast::<[f32; LANES]>().write_unaligned(results) };
    }
}

impl Store<U8> for Bytes {
    #[inline(always)]
    unsafe fn store(results: [f32; LANES], to: *mut U8) {
        // SAFETY: the caller gives room for `LANES` numbers.
        unsafe { to.cast::<[U8; LANES]>().write_unaligned(results.map(U8::from_f32)) };
    }
}

/// # Safety
/// `bias` has `LANES` numbers.
#[inline(always)]
unsafe fn finish(mut sum: [f32; LANES], bias: *const f32, floor: f32) -> [f32; LANES] {
    // SAFETY: the caller's promise.
    let bias = unsafe { bias.cast::<[f32; LANES]>().read_unaligned() };
    for i in 0..LANES {
        let value = sum[i] + bias[i];
        // Not `max`, which would hide NaN.
        sum[i] = if value < floor { floor } else { value };
    }
    sum
}

/// A kernel in instructions of x86-64 if there is one, or else that of all CPUs.
macro_rules! better {
    ($x86:expr, $all:expr) => {{
        #[cfg(target_arch = "x86_64")]
        let better = $x86;
        #[cfg(not(target_arch = "x86_64"))]
        let better = None;
        better.unwrap_or($all)
    }};
}

/// Defines a kernel and says for which maps it is the one of all CPUs.
macro_rules! kernel {
    (
        $name:ident, $simd:ty, $element:ty, [$($output:ty),*],
        |$isa:ident, $stored:ident, $outputs:ident| $better:expr, $winograd:expr
    ) => {
        /// # Safety
        /// None is needed.
        unsafe fn $name<O: Element>(layer: &Packed<$element, O>, part: Share<$element, O>)
        where
            $simd: Store<O>,
            $element: Kernel<O>,
        {
            // SAFETY: every CPU has these instructions.
            unsafe { share::<Registers<$simd, 4, 1>, $element, O>(layer, part) }
        }

        $(impl Kernel<$output> for $element {
            fn kernel($isa: Isa, $stored: usize, $outputs: usize) -> (Run<$element, $output>, usize) {
                let _ = ($isa, $stored, $outputs);
                better!($better, ($name, LANES))
            }

            fn winograd($isa: Isa, $outputs: usize) -> Option<(Run<$element, $output>, usize)> {
                let _ = ($isa, $outputs);
                $winograd
            }
        })*
    };
}
kernel!(
    single,
    Single,
    f32,
    [f32],
    |isa, stored, outputs| super::x86::single(isa, outputs),
    Some(better!(
        super::x86::winograd(isa, outputs),
        (tiles::<Single, f32>, LANES)
    ))
);
kernel!(
    half,
    Half,
    Bf16,
    [Bf16, f32],
    |isa, stored, outputs| super::x86::half(isa, stored, outputs),
    // Sixteen times the products at once are more than a quarter of them.
    (isa != Isa::Amx).then(|| better!(super::x86::half_winograd(isa, outputs), (tiles::<Half, _>, LANES)))
);
kernel!(
    bytes,
    Bytes,
    U8,
    [U8, f32],
    |isa, stored, outputs| super::x86::bytes(isa, stored, outputs),
    None
);

/// [`winograd`]'s tiles, with `M` to read and write maps.
///
/// # Safety
/// None is needed.
unsafe fn tiles<M, O: Element>(layer: &Packed<M::Element, O>, part: Share<M::Element, O>)
where
    M: Load + Store<O, Results = [f32; LANES]>,
    M::Element: Kernel<O>,
{
    // SAFETY: every CPU has these instructions.
    unsafe { winograd::share::<Single, M, O, 4, 1>(layer, part) }
}
