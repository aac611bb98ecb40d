//! Kernels in the vector instructions of x86-64.
#![allow(unsafe_code)]

use std::arch::x86_64::*;

use super::pack::{Kernel, Packed, Run, Share};
use super::tile::{Simd, Store, share};
use super::{Bf16, Element, Isa};

/// The f32 kernel in these instructions, if they are of x86-64, and the outputs of a block.
pub(super) fn single(isa: Isa, outputs: usize) -> Option<(Run<f32, f32>, usize)> {
    match isa {
        Isa::Portable => None,
        Isa::Avx2 => Some((avx2, 16)),
        Isa::Avx512 | Isa::Avx512Bf16 if wide(outputs) => Some((avx512_wide, 64)),
        Isa::Avx512 | Isa::Avx512Bf16 => Some((avx512_narrow, 32)),
    }
}

/// The bf16 kernel, if these instructions have products of bf16, and the outputs of a block.
pub(super) fn half<O: Element>(isa: Isa, outputs: usize) -> Option<(Run<Bf16, O>, usize)>
where
    Avx512Bf16: Store<O>,
    Bf16: Kernel<O>,
{
    match isa {
        Isa::Avx512Bf16 if wide(outputs) => Some((bf16_wide, 64)),
        Isa::Avx512Bf16 => Some((bf16_narrow, 32)),
        Isa::Avx512 | Isa::Avx2 | Isa::Portable => None,
    }
}

/// Whether blocks of 64 outputs compute no more outputs that do not exist than blocks of 32.
fn wide(outputs: usize) -> bool {
    outputs.next_multiple_of(64) == outputs.next_multiple_of(32)
}

// Tiles: 12 sums of 16 registers with AVX2, 24 of 32 with AVX-512; the rest holds weights and one unit of the input.

/// # Safety
/// The CPU has AVX2 and FMA.
#[target_feature(enable = "avx2,fma")]
unsafe fn avx2(layer: &Packed<f32>, part: Share<f32, f32>) {
    // SAFETY: the caller's promise.
    unsafe { share::<Avx2, f32, 6, 2>(layer, part) }
}

/// # Safety
/// The CPU has AVX-512.
#[target_feature(enable = "avx512f")]
unsafe fn avx512_wide(layer: &Packed<f32>, part: Share<f32, f32>) {
    // SAFETY: the caller's promise.
    unsafe { share::<Avx512, f32, 6, 4>(layer, part) }
}

/// # Safety
/// The CPU has AVX-512.
#[target_feature(enable = "avx512f")]
unsafe fn avx512_narrow(layer: &Packed<f32>, part: Share<f32, f32>) {
    // SAFETY: the caller's promise.
    unsafe { share::<Avx512, f32, 12, 2>(layer, part) }
}

/// # Safety
/// The CPU has AVX-512 and its bf16.
#[target_feature(enable = "avx512f,avx512bf16")]
unsafe fn bf16_wide<O: Element>(layer: &Packed<Bf16, O>, part: Share<Bf16, O>)
where
    Avx512Bf16: Store<O>,
    Bf16: Kernel<O>,
{
    // SAFETY: the caller's promise.
    unsafe { share::<Avx512Bf16, O, 6, 4>(layer, part) }
}

/// # Safety
/// The CPU has AVX-512 and its bf16.
#[target_feature(enable = "avx512f,avx512bf16")]
unsafe fn bf16_narrow<O: Element>(layer: &Packed<Bf16, O>, part: Share<Bf16, O>)
where
    Avx512Bf16: Store<O>,
    Bf16: Kernel<O>,
{
    // SAFETY: the caller's promise.
    unsafe { share::<Avx512Bf16, O, 12, 2>(layer, part) }
}

pub(super) struct Avx2;

// SAFETY of the blocks below: the caller has the instructions and gives pointers to as many numbers as a register holds;
// loads and stores take any alignment. `max(floor, value)` gives its second operand, if one is NaN.

impl Simd for Avx2 {
    type Element = f32;
    type Sum = __m256;
    type Units = __m256;
    const LANES: usize = 8;

    #[inline(always)]
    unsafe fn zero() -> __m256 {
        unsafe { _mm256_setzero_ps() }
    }

    #[inline(always)]
    unsafe fn weights(at: *const f32) -> __m256 {
        unsafe { _mm256_loadu_ps(at) }
    }

    #[inline(always)]
    unsafe fn broadcast(at: *const f32) -> __m256 {
        unsafe { _mm256_broadcast_ss(&*at) }
    }

    #[inline(always)]
    unsafe fn multiply_add(sum: __m256, input: __m256, weights: __m256) -> __m256 {
        unsafe { _mm256_fmadd_ps(input, weights, sum) }
    }

    #[inline(always)]
    unsafe fn finish(sum: __m256, bias: *const f32, floor: f32) -> __m256 {
        unsafe { _mm256_max_ps(_mm256_set1_ps(floor), _mm256_add_ps(sum, _mm256_loadu_ps(bias))) }
    }
}

impl Store<f32> for Avx2 {
    #[inline(always)]
    unsafe fn store(sum: __m256, to: *mut f32) {
        unsafe { _mm256_storeu_ps(to, sum) }
    }
}

pub(super) struct Avx512;

impl Simd for Avx512 {
    type Element = f32;
    type Sum = __m512;
    type Units = __m512;
    const LANES: usize = 16;

    #[inline(always)]
    unsafe fn zero() -> __m512 {
        unsafe { _mm512_setzero_ps() }
    }

    #[inline(always)]
    unsafe fn weights(at: *const f32) -> __m512 {
        unsafe { _mm512_loadu_ps(at) }
    }

    #[inline(always)]
    unsafe fn broadcast(at: *const f32) -> __m512 {
        unsafe { _mm512_set1_ps(*at) }
    }

    #[inline(always)]
    unsafe fn multiply_add(sum: __m512, input: __m512, weights: __m512) -> __m512 {
        unsafe { _mm512_fmadd_ps(input, weights, sum) }
    }

    #[inline(always)]
    unsafe fn finish(sum: __m512, bias: *const f32, floor: f32) -> __m512 {
        unsafe { _mm512_max_ps(_mm512_set1_ps(floor), _mm512_add_ps(sum, _mm512_loadu_ps(bias))) }
    }
}

impl Store<f32> for Avx512 {
    #[inline(always)]
    unsafe fn store(sum: __m512, to: *mut f32) {
        unsafe { _mm512_storeu_ps(to, sum) }
    }
}

pub(super) struct Avx512Bf16;

impl Simd for Avx512Bf16 {
    type Element = Bf16;
    type Sum = __m512;
    type Units = __m512i;
    const LANES: usize = 16;

    #[inline(always)]
    unsafe fn zero() -> __m512 {
        unsafe { _mm512_setzero_ps() }
    }

    #[inline(always)]
    unsafe fn weights(at: *const Bf16) -> __m512i {
        unsafe { _mm512_loadu_si512(at.cast()) }
    }

    #[inline(always)]
    unsafe fn broadcast(at: *const Bf16) -> __m512i {
        unsafe { _mm512_set1_epi32(at.cast::<i32>().read_unaligned()) }
    }

    #[inline(always)]
    unsafe fn multiply_add(sum: __m512, input: __m512i, weights: __m512i) -> __m512 {
        unsafe {
            let pairs = |units: __m512i| std::mem::transmute::<__m512i, __m512bh>(units);
            _mm512_dpbf16_ps(sum, pairs(input), pairs(weights))
        }
    }

    #[inline(always)]
    unsafe fn finish(sum: __m512, bias: *const f32, floor: f32) -> __m512 {
        unsafe { Avx512::finish(sum, bias, floor) }
    }
}

impl Store<f32> for Avx512Bf16 {
    #[inline(always)]
    unsafe fn store(sum: __m512, to: *mut f32) {
        unsafe { _mm512_storeu_ps(to, sum) }
    }
}

impl Store<Bf16> for Avx512Bf16 {
    #[inline(always)]
    unsafe fn store(sum: __m512, to: *mut Bf16) {
        unsafe {
            let half = std::mem::transmute::<__m256bh, __m256i>(_mm512_cvtneps_pbh(sum));
            _mm256_storeu_si256(to.cast(), half);
        }
    }
}
