//! AVX-512, and its products of bf16 and of bytes.

// SAFETY of all blocks: the caller has the instructions and gives pointers to as many numbers as a register holds;
// loads and stores take any alignment. `max(floor, value)` gives its second operand, if one is NaN.

use std::arch::x86_64::*;

use crate::conv::element::{Bf16, U8};
use crate::conv::tile::{Load, Simd, Store};

pub(in crate::conv) struct Avx512;

impl Simd for Avx512 {
    type Element = f32;
    type Sum = __m512;
    type Units = __m512;
    type Results = __m512;
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
    unsafe fn finish(sum: __m512, _: *const f32, bias: *const f32, floor: f32) -> __m512 {
        unsafe { _mm512_max_ps(_mm512_set1_ps(floor), _mm512_add_ps(sum, _mm512_loadu_ps(bias))) }
    }
}

impl Load for Avx512 {
    #[inline(always)]
    unsafe fn load(at: *const f32) -> __m512 {
        unsafe { Avx512::weights(at) }
    }
}

impl Store<f32> for Avx512 {
    #[inline(always)]
    unsafe fn store(results: __m512, to: *mut f32) {
        unsafe { _mm512_storeu_ps(to, results) }
    }
}

pub(in crate::conv) struct Avx512Bf16;

impl Simd for Avx512Bf16 {
    type Element = Bf16;
    type Sum = __m512;
    type Units = __m512i;
    type Results = __m512;
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
    unsafe fn finish(sum: __m512, _: *const f32, bias: *const f32, floor: f32) -> __m512 {
        unsafe { Avx512::finish(sum, std::ptr::null(), bias, floor) }
    }
}

impl Load for Avx512Bf16 {
    #[inline(always)]
    unsafe fn load(at: *const Bf16) -> __m512 {
        unsafe {
            let halves = _mm512_cvtepu16_epi32(_mm256_loadu_si256(at.cast()));
            _mm512_castsi512_ps(_mm512_slli_epi32::<16>(halves))
        }
    }
}

impl Store<f32> for Avx512Bf16 {
    #[inline(always)]
    unsafe fn store(results: __m512, to: *mut f32) {
        unsafe { _mm512_storeu_ps(to, results) }
    }
}

impl Store<Bf16> for Avx512Bf16 {
    #[inline(always)]
    unsafe fn store(results: __m512, to: *mut Bf16) {
        unsafe {
            let half = std::mem::transmute::<__m256bh, __m256i>(_mm512_cvtneps_pbh(results));
            _mm256_storeu_si256(to.cast(), half);
        }
    }
}

/// Steps of a byte times weights of a byte.
pub(in crate::conv) struct Avx512Bytes;

impl Simd for Avx512Bytes {
    type Element = U8;
    type Sum = __m512i;
    type Units = __m512i;
    type Results = __m512;
    const LANES: usize = 16;

    #[inline(always)]
    unsafe fn zero() -> __m512i {
        unsafe { _mm512_setzero_si512() }
    }

    #[inline(always)]
    unsafe fn weights(at: *const U8) -> __m512i {
        unsafe { _mm512_loadu_si512(at.cast()) }
    }

    #[inline(always)]
    unsafe fn broadcast(at: *const U8) -> __m512i {
        unsafe { _mm512_set1_epi32(at.cast::<i32>().read_unaligned()) }
    }

    #[inline(always)]
    unsafe fn multiply_add(sum: __m512i, input: __m512i, weights: __m512i) -> __m512i {
        unsafe { _mm512_dpbusd_epi32(sum, input, weights) }
    }

    #[inline(always)]
    unsafe fn finish(sum: __m512i, scale: *const f32, bias: *const f32, floor: f32) -> __m512 {
        unsafe {
            // Not fused, for the same bits everywhere.
            let scaled = _mm512_mul_ps(_mm512_cvtepi32_ps(sum), _mm512_loadu_ps(scale));
            Avx512::finish(scaled, scale, bias, floor)
        }
    }
}

impl Store<f32> for Avx512Bytes {
    #[inline(always)]
    unsafe fn store(results: __m512, to: *mut f32) {
        unsafe { _mm512_storeu_ps(to, results) }
    }
}

impl Store<U8> for Avx512Bytes {
    #[inline(always)]
    unsafe fn store(results: __m512, to: *mut U8) {
        unsafe {
            // Beyond 2^31 the conversion gives the smallest number: cut off before. NaN stays NaN there, and becomes 0.
            let steps = _mm512_cvtps_epi32(_mm512_min_ps(_mm512_set1_ps(255.0), results));
            let steps = _mm512_max_epi32(steps, _mm512_setzero_si512());
            _mm_storeu_si128(to.cast(), _mm512_cvtepi32_epi8(steps));
        }
    }
}
