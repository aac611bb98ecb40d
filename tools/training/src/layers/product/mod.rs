//! The one entrance to the matrix kernels.
#![allow(unsafe_code)]

#[cfg(target_arch = "x86_64")]
mod bf16;

use std::fmt;
use std::str::FromStr;

use realo_kernels::conv::Isa;

/// In which numbers products are computed; sums are f32.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Arithmetic {
    /// bfloat16, on CPUs with instructions for it: inputs lose 16 of their 24 bits.
    Bf16,
    /// Single precision.
    F32,
}

impl Arithmetic {
    /// Whether this CPU has it.
    pub fn is_available(self) -> bool {
        match self {
            Arithmetic::Bf16 => Isa::Avx512Bf16.is_available(),
            Arithmetic::F32 => true,
        }
    }

    /// What this CPU computes fastest.
    pub fn fastest() -> Self {
        match Arithmetic::Bf16.is_available() {
            true => Arithmetic::Bf16,
            false => Arithmetic::F32,
        }
    }
}

impl fmt::Display for Arithmetic {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(match self {
            Arithmetic::Bf16 => "bf16",
            Arithmetic::F32 => "f32",
        })
    }
}

/// No arithmetic has this name.
#[derive(Debug, thiserror::Error)]
#[error("expected bf16 or f32, found `{0}`")]
pub struct UnknownArithmetic(String);

impl FromStr for Arithmetic {
    type Err = UnknownArithmetic;

    fn from_str(name: &str) -> Result<Self, UnknownArithmetic> {
        let mut all = [Arithmetic::Bf16, Arithmetic::F32].into_iter();
        all.find(|one| one.to_string() == name)
            .ok_or_else(|| UnknownArithmetic(name.into()))
    }
}

/// A matrix inside a slice: entry (i, j) lies at `i * row + j * column`. Rows may overlap.
#[derive(Clone, Copy)]
pub(crate) struct View<'a> {
    pub data: &'a [f32],
    pub row: usize,
    pub column: usize,
}

impl<'a> View<'a> {
    /// A matrix whose rows are contiguous and begin every `row` numbers.
    pub fn rows(data: &'a [f32], row: usize) -> Self {
        View { data, row, column: 1 }
    }

    /// The transpose of [`View::rows`].
    pub fn columns(data: &'a [f32], column: usize) -> Self {
        View { data, row: 1, column }
    }

    fn assert_holds(&self, rows: usize, columns: usize) {
        let last = (rows - 1) * self.row + (columns - 1) * self.column;
        assert!(
            last < self.data.len(),
            "a {rows}x{columns} matrix ends outside its slice"
        );
    }
}

/// `out = a * b`, or `out += a * b`, of sizes `m`×`k` and `k`×`n`; rows of `out` are contiguous and begin every
/// `out_row` numbers. Runs on the calling thread.
///
/// # Panics
/// If a matrix does not lie inside its slice, rows of `out` overlap, or the CPU lacks the arithmetic.
pub(crate) fn multiply(
    arithmetic: Arithmetic,
    out: &mut [f32],
    out_row: usize,
    a: View,
    b: View,
    [m, k, n]: [usize; 3],
    add: bool,
) {
    if m == 0 || n == 0 || k == 0 {
        return;
    }
    assert!(out_row >= n || m == 1, "rows of the product overlap");
    View::rows(out, out_row).assert_holds(m, n);
    a.assert_holds(m, k);
    b.assert_holds(k, n);
    #[cfg(target_arch = "x86_64")]
    if arithmetic == Arithmetic::Bf16 && b.column == 1 && (a.column == 1 || a.row == 1) {
        return bf16::multiply(out, out_row, a, b, [m, k, n], add);
    }
    // SAFETY: all three matrices lie inside their slices (asserted), and `out` is borrowed exclusively.
    unsafe {
        gemm::gemm(
            m,
            n,
            k,
            out.as_mut_ptr(),
            1,
            out_row as isize,
            add,
            a.data.as_ptr(),
            a.column as isize,
            a.row as isize,
            b.data.as_ptr(),
            b.column as isize,
            b.row as isize,
            1.0,
            1.0,
            false,
            false,
            false,
            gemm::Parallelism::None,
        );
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn multiplies_transposed_and_overlapping_matrices() {
        let data: Vec<f32> = (0..12).map(|v| v as f32).collect();
        // Rows [0 1 2], [2 3 4]; columns [0 1 2], [3 4 5].
        let (a, b) = (View::rows(&data, 2), View::columns(&data, 3));
        let mut out = vec![1.0; 4];
        multiply(Arithmetic::F32, &mut out, 2, a, b, [2, 3, 2], false);
        assert_eq!(out, [5.0, 14.0, 11.0, 38.0]);
        multiply(Arithmetic::F32, &mut out, 2, a, b, [2, 3, 2], true);
        assert_eq!(out, [10.0, 28.0, 22.0, 76.0]);
    }

    #[test]
    #[should_panic(expected = "outside its slice")]
    fn refuses_matrices_outside_their_slices() {
        let (a, b) = (View::rows(&[0.0; 5], 3), View::rows(&[0.0; 6], 2));
        multiply(Arithmetic::F32, &mut [0.0; 4], 2, a, b, [2, 3, 2], false);
    }

    #[test]
    fn arithmetics_have_names() {
        for one in [Arithmetic::Bf16, Arithmetic::F32] {
            assert_eq!(one.to_string().parse::<Arithmetic>().unwrap(), one);
        }
        let unknown = "f64".parse::<Arithmetic>().unwrap_err().to_string();
        assert_eq!(unknown, "expected bf16 or f32, found `f64`");
        assert!(Arithmetic::fastest().is_available());
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(256))]
        #[test]
        fn bf16_is_f32_of_rounded_numbers(
            size in [1usize..40, 1usize..900, 1usize..150],
            [overlap, gap] in [0usize..30, 0usize..5],
            by_columns in any::<bool>(),
            add in any::<bool>(),
            seed in any::<u64>(),
        ) {
            if !Arithmetic::Bf16.is_available() {
                return Ok(());
            }
            let [m, k, n] = size;
            let mut draws = crate::random::Stream::new(seed, "product", 0);
            let mut numbers = |count: usize| -> Vec<f32> {
                // Few bits: their products are exact in both, and sums nearly.
                (0..count).map(|_| (draws.below(255) as f32 - 127.0) / 64.0).collect()
            };
            let (a_row, b_row, out_row) = (k.saturating_sub(overlap).max(1), n + gap, n + gap);
            let (a, b, before) = (numbers((m + k) * (m.max(k) + 1)), numbers(k * b_row), numbers(m * out_row));
            let a = match by_columns {
                true => View::columns(&a, m + gap.min(1)),
                false => View::rows(&a, a_row),
            };
            let b = View::rows(&b, b_row);
            let [exact, found] = [Arithmetic::F32, Arithmetic::Bf16].map(|arithmetic| {
                let mut out = before.clone();
                multiply(arithmetic, &mut out, out_row, a, b, size, add);
                out
            });
            for (at, (exact, found)) in exact.iter().zip(&found).enumerate() {
                if at % out_row < n {
                    prop_assert!((exact - found).abs() < 0.05, "{at}: {exact} and {found}");
                } else {
                    prop_assert_eq!(before[at], *found, "beside the product");
                }
            }
        }
    }
}
