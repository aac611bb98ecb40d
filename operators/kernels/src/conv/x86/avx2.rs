//! AVX2 with FMA, and its products of bytes.

// SAFETY of all blocks: the caller has the instructions and gives pointers to as many numbers as a register holds;
// loads and stores take any alignment. `max(floor, value)` gives its second operand, if one is NaN.

use std::arch::x86_64::*;

use crate::conv::element::U8;
use crate::conv::tile::{Load, Simd, Store};

pub(in crate::conv) struct Avx2;

impl Simd for Avx2 {
    type Element = f32;
    type Sum = __m256;
    type Units = __m256;
    type Results = __m256;
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
    unsafe fn finish(sum: __m256, _: *const f32, bias: *const f32, floor: f32) -> __m256 {
        unsafe { _mm256_max_ps(_mm256_set1_ps(floor), _mm256_add_ps(sum, _mm256_loadu_ps(bias))) }
    }
}

impl Load for Avx2 {
    #[inline(always)]
    unsafe fn load(at: *const f32) -> __m256 {
        unsafe { Avx2::weights(at) }
    }
}

impl Store<f32> for Avx2 {
    #[inline(always)]
    unsafe fn store(results: __m256, to: *mut f32) {
        unsafe { _mm256_storeu_ps(to, results) }
    }
}

/// Steps of a byte times weights of a byte. Two products are added in 16 bits: weights within ±64 keep them from overflow.
pub(in crate::conv) struct Avx2Bytes;

impl Simd for Avx2Bytes {
    type Element = U8;
    type Sum = __m256i;
    type Units = __m256i;
    type Results = __m256;
    const LANES: usize = 8;

    #[inline(always)]
    unsafe fn zero() -> __m256i {
        unsafe { _mm256_setzero_si256() }
    }

    #[inline(always)]
    unsafe fn weights(at: *const U8) -> __m256i {
        unsafe { _mm256_loadu_si256(at.cast()) }
    }

    #[inline(always)]
    unsafe fn broadcast(at: *const U8) -> __m256i {
        unsafe { _mm256_set1_epi32(at.cast::<i32>().read_unaligned()) }
    }

    #[inline(always)]
    unsafe fn multiply_add(sum: __m256i, input: __m256i, weights: __m256i) -> __m256i {
        unsafe {
            let pairs = _mm256_maddubs_epi16(input, weights);
            _mm256_add_epi32(sum, _mm256_madd_epi16(pairs, _mm256_set1_epi16(1)))
        }
    }

    #[inline(always)]
    unsafe fn finish(sum: __m256i, scale: *const f32, bias: *const f32, floor: f32) -> __m256 {
        unsafe {
            // Not fused, for the same bits everywhere.
            let scaled = _mm256_mul_ps(_mm256_cvtepi32_ps(sum), _mm256_loadu_ps(scale));
            Avx2::finish(scaled, scale, bias, floor)
        }
    }
}

impl Store<f32> for Avx2Bytes {
    #[inline(always)]
    unsafe fn store(results: __m256, to: *mut f32) {
        unsafe { _mm256_storeu_ps(to, results) }
    }
}

impl Store<U8> for Avx2Bytes {
    #[inline(always)]
    unsafe fn store(results: __m256, to: *mut U8) {
        unsafe {
            // Beyond 2^31 the conversion gives the smallest number: cut off before. NaN stays NaN there, and becomes 0.
            let steps = _mm256_cvtps_epi32(_mm256_min_ps(_mm256_set1_ps(255.0), results));
            let (low, high) = (_mm256_castsi256_si128(steps), _mm256_extracti128_si256::<1>(steps));
            let bytes = _mm_packus_epi16(_mm_packs_epi32(low, high), _mm_setzero_si128());
            _mm_storel_epi64(to.cast(), bytes);
        }
    }
}
