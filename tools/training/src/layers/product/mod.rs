//! The one entrance to the matrix kernels.
#![allow(unsafe_code)]

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
/// If a matrix does not lie inside its slice, or rows of `out` overlap.
pub(crate) fn multiply(out: &mut [f32], out_row: usize, a: View, b: View, [m, k, n]: [usize; 3], add: bool) {
    if m == 0 || n == 0 || k == 0 {
        return;
    }
    assert!(out_row >= n || m == 1, "rows of the product overlap");
    View::rows(out, out_row).assert_holds(m, n);
    a.assert_holds(m, k);
    b.assert_holds(k, n);
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
    use super::*;

    #[test]
    fn multiplies_transposed_and_overlapping_matrices() {
        let data: Vec<f32> = (0..12).map(|v| v as f32).collect();
        let mut out = vec![1.0; 4];
        // Rows [0 1 2], [2 3 4]; columns [0 1 2], [3 4 5].
        multiply(
            &mut out,
            2,
            View::rows(&data, 2),
            View::columns(&data, 3),
            [2, 3, 2],
            false,
        );
        assert_eq!(out, [5.0, 14.0, 11.0, 38.0]);
        multiply(
            &mut out,
            2,
            View::rows(&data, 2),
            View::columns(&data, 3),
            [2, 3, 2],
            true,
        );
        assert_eq!(out, [10.0, 28.0, 22.0, 76.0]);
    }

    #[test]
    #[should_panic(expected = "outside its slice")]
    fn refuses_matrices_outside_their_slices() {
        multiply(
            &mut [0.0; 4],
            2,
            View::rows(&[0.0; 5], 3),
            View::rows(&[0.0; 6], 2),
            [2, 3, 2],
            false,
        );
    }
}
