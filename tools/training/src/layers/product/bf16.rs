//! Products of bf16 with sums in f32, by AVX-512's instructions for them.

use std::arch::x86_64::*;
use std::cell::RefCell;

use realo_kernels::conv::Isa;

use super::View;

/// Numbers of a register.
const LANES: usize = 16;

/// Registers of a row of results at most.
const WIDE: usize = 4;

/// Pairs of products that are summed in registers: what is packed of both matrices stays in the second cache.
const DEPTH: usize = 192;

/// Bits of bf16, two of neighbours in `k` in one number, the first one in the lower half.
type Pair = u32;

#[derive(Default)]
struct Room {
    a: Vec<u16>,
    b: Vec<Pair>,
}

thread_local! {
    static ROOM: RefCell<Room> = RefCell::default();
}

/// As [`super::multiply`], whose asserts hold; rows of `b` are contiguous, and rows or columns of `a`.
///
/// # Panics
/// If the CPU lacks the instructions.
pub fn multiply(out: &mut [f32], out_row: usize, a: View, b: View, size: [usize; 3], add: bool) {
    assert!(Isa::Avx512Bf16.is_available(), "a CPU without products of bf16");
    ROOM.with_borrow_mut(|room| {
        // SAFETY: the CPU has the instructions (asserted).
        unsafe { blocks(out, out_row, a, b, size, add, room) }
    });
}

#[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
fn blocks(out: &mut [f32], out_row: usize, a: View, b: View, [m, k, n]: [usize; 3], add: bool, room: &mut Room) {
    let pairs = k.div_ceil(2);
    let has_rows = a.column == 1;
    if has_rows {
        // A last half pair meets zeros of `b`.
        narrow(&a.data[..(m - 1) * a.row + k], &mut room.a);
    }
    for first in (0..pairs).step_by(DEPTH) {
        let depth = DEPTH.min(pairs - first);
        let inner = 2 * first..k.min(2 * (first + depth));
        let (from, rows) = if has_rows {
            (2 * first, [a.row, 2])
        } else {
            let pitch = m.next_multiple_of(LANES);
            room.a.resize(2 * depth * pitch, 0);
            let to = room.a.as_mut_ptr().cast();
            // SAFETY: there is room for `depth` rows of `pitch` pairs; the matrix lies inside its slice (the caller's assert).
            unsafe { pair_up(&a.data[inner.start * a.column..], a.column, inner.len(), m, to, pitch) };
            (0, [2, 2 * pitch])
        };
        for left in (0..n).step_by(WIDE * LANES) {
            let width = (n - left).min(WIDE * LANES);
            let vectors = width.div_ceil(LANES);
            let pitch = vectors * LANES;
            room.b.resize(depth * pitch, 0);
            // SAFETY: as above.
            unsafe {
                let data = &b.data[inner.start * b.row + left..];
                pair_up(data, b.row, inner.len(), width, room.b.as_mut_ptr(), pitch);
            }
            let strip = Strip {
                out: &mut out[left..],
                out_row,
                a: &room.a[from..],
                rows,
                b: &room.b,
                depth,
                last: mask(width - (vectors - 1) * LANES),
                add: add || first > 0,
            };
            // SAFETY: all that a strip of `m` rows reads and writes lies inside these slices: `a` has `depth` pairs for each row,
            // `b` as many rows of `vectors` registers, `out` rows of `width` numbers.
            unsafe {
                match vectors {
                    1 => strip.run::<12, 4, 1>(m),
                    2 => strip.run::<12, 4, 2>(m),
                    3 => strip.run::<6, 2, 3>(m),
                    _ => strip.run::<6, 2, 4>(m),
                }
            }
        }
    }
}

/// The first lanes.
fn mask(lanes: usize) -> __mmask16 {
    ((1u32 << lanes) - 1) as __mmask16
}

/// f32 to bf16, with a zero behind them.
#[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
fn narrow(from: &[f32], to: &mut Vec<u16>) {
    to.resize(from.len().next_multiple_of(LANES) + LANES, 0);
    let (chunks, rest) = from.as_chunks::<LANES>();
    for (chunk, to) in chunks.iter().zip(to.as_chunks_mut::<LANES>().0) {
        // SAFETY: both are of 16 numbers.
        unsafe { _mm256_storeu_si256(to.as_mut_ptr().cast(), halves(_mm512_loadu_ps(chunk.as_ptr()))) };
    }
    let to = &mut to[from.len() - rest.len()..];
    // SAFETY: lanes beyond the rest are not read, and `to` has 16 numbers and more left.
    unsafe {
        let rest = _mm512_maskz_loadu_ps(mask(rest.len()), rest.as_ptr());
        _mm256_storeu_si256(to.as_mut_ptr().cast(), halves(rest));
    }
}

#[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
fn halves(numbers: __m512) -> __m256i {
    // SAFETY: both are 16 numbers of 16 bits.
    unsafe { std::mem::transmute::<__m256bh, __m256i>(_mm512_cvtneps_pbh(numbers)) }
}

/// Neighbouring rows of a matrix as pairs; a last single row has zeros beside it.
///
/// # Safety
/// `to` has room for a row of `pitch` pairs, a multiple of 16, for every two of `rows`; `data` holds the matrix.
#[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
unsafe fn pair_up(data: &[f32], row: usize, rows: usize, columns: usize, to: *mut Pair, pitch: usize) {
    for upper in (0..rows).step_by(2) {
        for column in (0..columns).step_by(LANES) {
            let lanes = mask((columns - column).min(LANES));
            // SAFETY: lanes beyond the matrix are not read.
            unsafe {
                let at = data.as_ptr().add(upper * row + column);
                let low = _mm512_cvtepu16_epi32(halves(_mm512_maskz_loadu_ps(lanes, at)));
                let both = if upper + 1 < rows {
                    let high = _mm512_cvtepu16_epi32(halves(_mm512_maskz_loadu_ps(lanes, at.add(row))));
                    _mm512_or_si512(low, _mm512_slli_epi32::<16>(high))
                } else {
                    low
                };
                _mm512_storeu_si512(to.add(upper / 2 * pitch + column).cast(), both);
            }
        }
    }
}

/// Up to 64 columns of results.
struct Strip<'a> {
    out: &'a mut [f32],
    out_row: usize,
    a: &'a [u16],
    /// From a row of `a` to the next, and from a pair to the next.
    rows: [usize; 2],
    b: &'a [Pair],
    depth: usize,
    /// Lanes of the last register.
    last: __mmask16,
    add: bool,
}

impl Strip<'_> {
    /// # Safety
    /// `a` and `out` hold `m` rows.
    #[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
    unsafe fn run<const ROWS: usize, const FEW: usize, const VECTORS: usize>(mut self, m: usize) {
        let mut row = 0;
        // SAFETY: the rows up to `m` are there.
        unsafe {
            while m - row >= ROWS {
                self.tile::<ROWS, VECTORS>(row);
                row += ROWS;
            }
            while m - row >= FEW {
                self.tile::<FEW, VECTORS>(row);
                row += FEW;
            }
            while m > row {
                self.tile::<1, VECTORS>(row);
                row += 1;
            }
        }
    }

    /// # Safety
    /// `a` and `out` hold `ROWS` rows from this one.
    #[inline]
    #[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
    unsafe fn tile<const ROWS: usize, const VECTORS: usize>(&mut self, row: usize) {
        let lanes = |vector: usize| if vector + 1 < VECTORS { !0 } else { self.last };
        // SAFETY: by the caller; lanes beyond the results are neither read nor written.
        unsafe {
            let out = self.out.as_mut_ptr().add(row * self.out_row);
            let mut sums = [[_mm512_setzero_ps(); VECTORS]; ROWS];
            if self.add {
                for (i, sums) in sums.iter_mut().enumerate() {
                    for (v, sum) in sums.iter_mut().enumerate() {
                        *sum = _mm512_maskz_loadu_ps(lanes(v), out.add(i * self.out_row + v * LANES));
                    }
                }
            }
            let [between_rows, between_pairs] = self.rows;
            let mut a = self.a.as_ptr().add(row * between_rows);
            let mut b = self.b.as_ptr();
            for _ in 0..self.depth {
                let mut weights = [_mm512_setzero_si512(); VECTORS];
                for (v, weights) in weights.iter_mut().enumerate() {
                    *weights = _mm512_loadu_si512(b.add(v * LANES).cast());
                }
                for (i, sums) in sums.iter_mut().enumerate() {
                    let pair = _mm512_set1_epi32(a.add(i * between_rows).cast::<i32>().read_unaligned());
                    for (sum, weights) in sums.iter_mut().zip(weights) {
                        let bits = |pairs: __m512i| std::mem::transmute::<__m512i, __m512bh>(pairs);
                        *sum = _mm512_dpbf16_ps(*sum, bits(pair), bits(weights));
                    }
                }
                a = a.wrapping_add(between_pairs);
                b = b.wrapping_add(VECTORS * LANES);
            }
            for (i, sums) in sums.iter().enumerate() {
                for (v, sum) in sums.iter().enumerate() {
                    _mm512_mask_storeu_ps(out.add(i * self.out_row + v * LANES), lanes(v), *sum);
                }
            }
        }
    }
}
