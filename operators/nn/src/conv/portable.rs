//! Kernels in plain Rust, in registers of 8 numbers that the compiler maps to what the CPU has.
#![allow(unsafe_code)]

use super::pack::{Kernel, Packed, Run, Share};
use super::tile::{Simd, Store, share};
use super::{Bf16, Element, Isa};

const LANES: usize = 8;

struct Single;

impl Simd for Single {
    type Element = f32;
    type Sum = [f32; LANES];
    type Units = [f32; LANES];
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
    unsafe fn finish(sum: [f32; LANES], bias: *const f32, floor: f32) -> [f32; LANES] {
        // SAFETY: the caller gives `LANES` biases.
        unsafe { finish(sum, bias, floor) }
    }
}

impl Store<f32> for Single {
    #[inline(always)]
    unsafe fn store(sum: [f32; LANES], to: *mut f32) {
        // SAFETY: the caller gives room for `LANES` numbers.
        unsafe { to.cast::<[f32; LANES]>().write_unaligned(sum) };
    }
}

/// bf16 where the CPU has no products of it: exact products, f32 sums.
struct Half;

impl Simd for Half {
    type Element = Bf16;
    type Sum = [f32; LANES];
    type Units = [u32; LANES];
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
    unsafe fn finish(sum: [f32; LANES], bias: *const f32, floor: f32) -> [f32; LANES] {
        // SAFETY: the caller gives `LANES` biases.
        unsafe { finish(sum, bias, floor) }
    }
}

impl Store<f32> for Half {
    #[inline(always)]
    unsafe fn store(sum: [f32; LANES], to: *mut f32) {
        // SAFETY: the caller gives room for `LANES` numbers.
        unsafe { to.cast::<[f32; LANES]>().write_unaligned(sum) };
    }
}

impl Store<Bf16> for Half {
    #[inline(always)]
    unsafe fn store(sum: [f32; LANES], to: *mut Bf16) {
        // SAFETY: the caller gives room for `LANES` numbers.
        unsafe { to.cast::<[Bf16; LANES]>().write_unaligned(sum.map(Bf16::from_f32)) };
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

/// # Safety
/// None is needed.
unsafe fn single(layer: &Packed<f32>, part: Share<f32, f32>) {
    // SAFETY: every CPU has these instructions.
    unsafe { share::<Single, f32, 4, 1>(layer, part) }
}

/// # Safety
/// None is needed.
unsafe fn half<O: Element>(layer: &Packed<Bf16, O>, part: Share<Bf16, O>)
where
    Half: Store<O>,
    Bf16: Kernel<O>,
{
    // SAFETY: every CPU has these instructions.
    unsafe { share::<Half, O, 4, 1>(layer, part) }
}

impl Kernel<f32> for f32 {
    fn kernel(isa: Isa, outputs: usize) -> (Run<f32, f32>, usize) {
        #[cfg(target_arch = "x86_64")]
        if let Some(kernel) = super::x86::single(isa, outputs) {
            return kernel;
        }
        let _ = (isa, outputs);
        (single, LANES)
    }
}

impl Kernel<f32> for Bf16 {
    fn kernel(isa: Isa, outputs: usize) -> (Run<Bf16, f32>, usize) {
        #[cfg(target_arch = "x86_64")]
        if let Some(kernel) = super::x86::half(isa, outputs) {
            return kernel;
        }
        let _ = (isa, outputs);
        (half, LANES)
    }
}

impl Kernel<Bf16> for Bf16 {
    fn kernel(isa: Isa, outputs: usize) -> (Run<Bf16, Bf16>, usize) {
        #[cfg(target_arch = "x86_64")]
        if let Some(kernel) = super::x86::half(isa, outputs) {
            return kernel;
        }
        let _ = (isa, outputs);
        (half, LANES)
    }
}
