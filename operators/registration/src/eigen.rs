//! Eigenvalues of small symmetric matrices, by square roots alone: the same bits on every machine.

/// Rounds over all elements; a matrix of six rows needs eight.
const ROUNDS: usize = 32;

/// Eigenvalues, rising, and an eigenvector of length 1 for each, of a symmetric matrix (cyclic Jacobi, Golub and Van Loan §8.5).
///
/// A matrix with elements that are not finite gives values that are not finite.
pub(crate) fn eigen<const N: usize>(mut matrix: [[f64; N]; N]) -> ([f64; N], [[f64; N]; N]) {
    // Rows are the vectors.
    let mut vectors: [[f64; N]; N] = std::array::from_fn(|i| std::array::from_fn(|j| f64::from(u8::from(i == j))));
    for _ in 0..ROUNDS {
        let mut turned = false;
        for p in 0..N {
            for q in p + 1..N {
                turned |= turn(&mut matrix, &mut vectors, p, q);
            }
        }
        if !turned {
            break;
        }
    }
    let mut order: [usize; N] = std::array::from_fn(|i| i);
    order.sort_by(|a, b| matrix[*a][*a].total_cmp(&matrix[*b][*b]));
    (order.map(|i| matrix[i][i]), order.map(|i| vectors[i]))
}

/// Turns rows and columns `p` and `q` so that their common element is 0; whether it was not yet.
fn turn<const N: usize>(matrix: &mut [[f64; N]; N], vectors: &mut [[f64; N]; N], p: usize, q: usize) -> bool {
    let (off, scale) = (matrix[p][q], (matrix[p][p] * matrix[q][q]).abs().sqrt());
    // The comparison is false for what is not a number too.
    if !(off.abs() > 1e-17 * scale && off.abs() > f64::MIN_POSITIVE) {
        return false;
    }
    let half = (matrix[q][q] - matrix[p][p]) / (2.0 * off);
    let tangent = half.signum() / (half.abs() + (half * half + 1.0).sqrt());
    let cos = 1.0 / (tangent * tangent + 1.0).sqrt();
    let sin = tangent * cos;
    for row in matrix.iter_mut() {
        (row[p], row[q]) = (cos * row[p] - sin * row[q], sin * row[p] + cos * row[q]);
    }
    for i in 0..N {
        let (a, b) = (matrix[p][i], matrix[q][i]);
        (matrix[p][i], matrix[q][i]) = (cos * a - sin * b, sin * a + cos * b);
        let (a, b) = (vectors[p][i], vectors[q][i]);
        (vectors[p][i], vectors[q][i]) = (cos * a - sin * b, sin * a + cos * b);
    }
    (matrix[p][q], matrix[q][p]) = (0.0, 0.0);
    true
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn check<const N: usize>(entries: &[f64]) -> Result<(), TestCaseError> {
        let matrix: [[f64; N]; N] = std::array::from_fn(|i| std::array::from_fn(|j| entries[i.max(j) * N + i.min(j)]));
        let (values, vectors) = eigen(matrix);
        for k in 0..N {
            prop_assert!(k == 0 || values[k - 1] <= values[k]);
            for i in 0..N {
                let product: f64 = (0..N).map(|j| matrix[i][j] * vectors[k][j]).sum();
                prop_assert!((product - values[k] * vectors[k][i]).abs() < 1e-9 * 1e3, "{values:?}");
            }
            for other in 0..=k {
                let dot: f64 = (0..N).map(|j| vectors[k][j] * vectors[other][j]).sum();
                prop_assert!((dot - f64::from(u8::from(k == other))).abs() < 1e-12);
            }
        }
        Ok(())
    }

    proptest! {
        #[test]
        fn vectors_are_stretched_by_their_values(entries in prop::collection::vec(-1e3f64..1e3, 36)) {
            check::<3>(&entries)?;
            check::<6>(&entries)?;
        }
    }

    #[test]
    fn what_is_not_finite_ends_too() {
        assert!(eigen([[f64::NAN; 3]; 3]).0.iter().any(|value| value.is_nan()));
        assert_eq!(eigen([[0.0; 6]; 6]).0, [0.0; 6]);
    }
}
