//! Least-cost assignment: pairs rows of a matrix with its columns so that the sum of their costs is the smallest.
//!
//! - [`Costs`] is the matrix, rectangular; a pair that may not be made costs [`FORBIDDEN`].
//! - [`assign`] finds the best pairs by shortest augmenting paths (Jonker and Volgenant 1987, as Crouse 2016 describes it for
//!   rectangular matrices), in f64 and O(rows × rows × columns) of the shorter side first.
//!
//! The same costs give the same pairs on every machine. Where several sets of pairs cost the same, lower indices go first in
//! each step of the search.

mod paths;

use paths::columns_of_rows;

/// What a pair costs that may not be made.
pub const FORBIDDEN: f64 = f64::INFINITY;

/// Max rows and max columns of a matrix.
pub const MAX_SIDE: usize = 2048;

/// Max size of a cost, and of a finite limit: beyond it sums would lose the digits that small differences need.
pub const MAX_COST: f64 = 1e9;

/// Costs that cannot be assigned.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum AssignmentError {
    /// A matrix that is too large.
    #[error("expected up to {MAX_SIDE} rows and columns, found {rows} × {columns}; leave out what matters least")]
    TooLarge {
        /// Rows.
        rows: usize,
        /// Columns.
        columns: usize,
    },
    /// Another number of costs than the matrix has places.
    #[error("expected {rows} × {columns} costs, found {found}")]
    Shape {
        /// Rows.
        rows: usize,
        /// Columns.
        columns: usize,
        /// Costs.
        found: usize,
    },
    /// A cost that is too large, or not a number.
    #[error(
        "row {row}, column {column}: expected a number within ±{MAX_COST:e}, or infinity where the pair is forbidden, found {found}"
    )]
    Cost {
        /// Row.
        row: usize,
        /// Column.
        column: usize,
        /// The cost.
        found: f64,
    },
    /// A limit that is too large, or not a number.
    #[error("limit: expected a number within ±{MAX_COST:e}, or infinity for as many pairs as can be, found {0}")]
    Limit(f64),
}

/// A matrix of costs, `[rows, columns]`, row-major.
#[derive(Clone, Debug, PartialEq)]
pub struct Costs {
    rows: usize,
    columns: usize,
    values: Vec<f64>,
}

impl Costs {
    /// A matrix of `rows × columns` costs, row-major: within ±[`MAX_COST`], or [`FORBIDDEN`].
    ///
    /// # Errors
    /// [`AssignmentError`] for a side above [`MAX_SIDE`], another number of costs, and a cost that is neither.
    pub fn new(rows: usize, columns: usize, values: Vec<f64>) -> Result<Self, AssignmentError> {
        if rows.max(columns) > MAX_SIDE {
            return Err(AssignmentError::TooLarge { rows, columns });
        }
        if values.len() != rows * columns {
            let found = values.len();
            return Err(AssignmentError::Shape { rows, columns, found });
        }
        let is_cost = |cost: &f64| cost.abs() <= MAX_COST || *cost == FORBIDDEN;
        if let Some(at) = values.iter().position(|cost| !is_cost(cost)) {
            let (row, column, found) = (at / columns, at % columns, values[at]);
            return Err(AssignmentError::Cost { row, column, found });
        }
        Ok(Costs { rows, columns, values })
    }

    /// A matrix of the costs that a function gives of each row and column.
    ///
    /// # Errors
    /// As [`Costs::new`].
    pub fn of(rows: usize, columns: usize, cost: impl Fn(usize, usize) -> f64) -> Result<Self, AssignmentError> {
        if rows.max(columns) > MAX_SIDE {
            return Err(AssignmentError::TooLarge { rows, columns });
        }
        let places = (0..rows).flat_map(|row| (0..columns).map(move |column| (row, column)));
        Costs::new(rows, columns, places.map(|(row, column)| cost(row, column)).collect())
    }

    /// Number of rows.
    pub fn rows(&self) -> usize {
        self.rows
    }

    /// Number of columns.
    pub fn columns(&self) -> usize {
        self.columns
    }

    /// What a pair costs.
    pub fn at(&self, row: usize, column: usize) -> f64 {
        self.values[row * self.columns + column]
    }
}

/// The pairs (row, column) of the smallest sum of costs, by row.
///
/// A row without a pair costs `limit`, so no pair is made that costs as much. A limit of infinity asks for as many pairs as
/// can be, and among those for the smallest sum; what is summed is then exact to about 10⁻¹² of the largest difference of
/// costs, by which sums that are closer may be mistaken for each other.
///
/// # Errors
/// [`AssignmentError::Limit`] for a limit that is neither within ±[`MAX_COST`] nor infinity.
pub fn assign(costs: &Costs, limit: f64) -> Result<Vec<(usize, usize)>, AssignmentError> {
    if !(limit.abs() <= MAX_COST || limit == f64::INFINITY) {
        return Err(AssignmentError::Limit(limit));
    }
    let instead = instead_of_forbidden(costs, limit);
    let is_made = |row, column| {
        let cost = costs.at(row, column);
        cost != FORBIDDEN && cost < limit
    };
    let finite = |row, column| {
        if is_made(row, column) {
            costs.at(row, column)
        } else {
            instead
        }
    };
    let is_wide = costs.rows <= costs.columns;
    let mut pairs: Vec<(usize, usize)> = match is_wide {
        true => columns_of_rows(costs.rows, costs.columns, finite)
            .into_iter()
            .enumerate()
            .collect(),
        false => {
            let rows = columns_of_rows(costs.columns, costs.rows, |column, row| finite(row, column));
            rows.into_iter()
                .enumerate()
                .map(|(column, row)| (row, column))
                .collect()
        }
    };
    pairs.retain(|(row, column)| is_made(*row, *column));
    pairs.sort_unstable();
    Ok(pairs)
}

/// A finite cost for pairs that are not made: the limit, or more than any exchange of pairs can save.
fn instead_of_forbidden(costs: &Costs, limit: f64) -> f64 {
    if limit.is_finite() {
        return limit;
    }
    let known = || costs.values.iter().copied().filter(|cost| *cost != FORBIDDEN);
    let (min, max) = (
        known().fold(f64::INFINITY, f64::min),
        known().fold(f64::NEG_INFINITY, f64::max),
    );
    if min > max {
        return 0.0;
    }
    let pairs = costs.rows.min(costs.columns) as f64;
    max + (pairs * (max - min)).max(1.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pairs(rows: usize, columns: usize, costs: &[f64], limit: f64) -> Vec<(usize, usize)> {
        assign(&Costs::new(rows, columns, costs.to_vec()).unwrap(), limit).unwrap()
    }

    #[test]
    fn the_sum_is_the_smallest_not_each_cost() {
        // Each row's best is column 0.
        assert_eq!(pairs(2, 2, &[1.0, 2.0, 1.5, 9.0], f64::INFINITY), [(0, 1), (1, 0)]);
        assert_eq!(pairs(2, 3, &[1.0, 2.0, 7.0, 1.5, 9.0, 1.9], 5.0), [(0, 0), (1, 2)]);
        assert_eq!(
            pairs(3, 2, &[4.0, 3.0, 1.0, 8.0, -2.0, 1.0], f64::INFINITY),
            [(0, 1), (2, 0)]
        );
    }

    #[test]
    fn a_limit_keeps_good_pairs_where_more_pairs_would_break_them() {
        let costs = [0.1, 2.9, 2.9, FORBIDDEN];
        assert_eq!(
            pairs(2, 2, &costs, 6.0),
            [(0, 1), (1, 0)],
            "two of 2.9 are less than 0.1 and 6"
        );
        assert_eq!(pairs(2, 2, &costs, 5.0), [(0, 0)]);
        assert_eq!(pairs(2, 2, &costs, f64::INFINITY), [(0, 1), (1, 0)]);
        assert_eq!(pairs(1, 1, &[3.0], 3.0), [], "as much as the limit is not less");
    }

    #[test]
    fn what_is_forbidden_is_never_paired() {
        let costs = [FORBIDDEN, 1.0, FORBIDDEN, 2.0];
        assert_eq!(pairs(2, 2, &costs, f64::INFINITY), [(0, 1)]);
        assert_eq!(pairs(2, 2, &[FORBIDDEN; 4], f64::INFINITY), []);
        assert_eq!(pairs(0, 3, &[], 1.0), []);
        assert_eq!(pairs(3, 0, &[], f64::INFINITY), []);
    }

    #[test]
    fn equal_costs_pair_in_order() {
        let same = |n| (0..n).map(|i| (i, i)).collect::<Vec<_>>();
        assert_eq!(pairs(3, 3, &[1.0; 9], f64::INFINITY), same(3));
        assert_eq!(pairs(2, 4, &[0.0; 8], 1.0), same(2));
        assert_eq!(pairs(4, 2, &[0.0; 8], 1.0), same(2));
    }

    #[test]
    fn what_is_wrong_is_named() {
        let error = |result: Result<Costs, AssignmentError>| result.unwrap_err().to_string();
        let found = error(Costs::new(2, 2, vec![0.0, 1.0, f64::NAN, 0.0]));
        assert!(found.contains("row 1, column 0") && found.contains("NaN"), "{found}");
        assert!(error(Costs::new(1, 1, vec![f64::NEG_INFINITY])).contains("-inf"));
        assert!(error(Costs::new(1, 1, vec![1e300])).contains("within ±1e9"));
        assert!(error(Costs::new(2, 2, vec![0.0; 3])).contains("expected 2 × 2 costs, found 3"));
        let found = error(Costs::of(2049, 1, |_, _| 0.0));
        assert!(found.contains("up to 2048") && found.contains("2049 × 1"), "{found}");
        let limit = assign(&Costs::new(1, 1, vec![0.0]).unwrap(), f64::NAN).unwrap_err();
        assert!(limit.to_string().contains("limit"), "{limit}");
    }

    #[test]
    fn a_large_sparse_matrix_is_paired_along_its_diagonal() {
        let n = 512;
        let near = |row: usize, column: usize| match row.abs_diff(column) {
            0 => 0.5,
            1 => 0.6,
            _ => FORBIDDEN,
        };
        let costs = Costs::of(n, n, near).unwrap();
        for limit in [1.0, f64::INFINITY] {
            let found = assign(&costs, limit).unwrap();
            assert!(found.iter().all(|(row, column)| row == column) && found.len() == n);
        }
    }
}
