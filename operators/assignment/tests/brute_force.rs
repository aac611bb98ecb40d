//! Small matrices against every possible set of pairs.

use proptest::prelude::*;
use realo_assignment::{Costs, FORBIDDEN, assign};

/// The best (pairs, sum) over all sets of pairs: with a finite limit the smallest sum where a row without a pair costs it,
/// else the most pairs first.
fn best(costs: &Costs, limit: f64) -> (usize, f64) {
    fn search(costs: &Costs, limit: f64, row: usize, used: u32) -> (usize, f64) {
        if row == costs.rows() {
            return (0, 0.0);
        }
        let (count, sum) = search(costs, limit, row + 1, used);
        let mut best = (count, sum + if limit.is_finite() { limit } else { 0.0 });
        for column in (0..costs.columns()).filter(|column| used & (1 << column) == 0) {
            let cost = costs.at(row, column);
            if cost == FORBIDDEN || cost >= limit {
                continue;
            }
            let (count, sum) = search(costs, limit, row + 1, used | (1 << column));
            let found = (count + 1, sum + cost);
            let is_better = match limit.is_finite() {
                true => found.1 < best.1,
                false => found.0 > best.0 || (found.0 == best.0 && found.1 < best.1),
            };
            if is_better {
                best = found;
            }
        }
        best
    }
    search(costs, limit, 0, 0)
}

fn cost() -> impl Strategy<Value = f64> {
    prop_oneof![
        3 => -50.0..50.0f64,
        // Ties.
        2 => (-3i32..3).prop_map(f64::from),
        2 => Just(FORBIDDEN),
    ]
}

fn costs() -> impl Strategy<Value = Costs> {
    (0usize..=6, 0usize..=6).prop_flat_map(|(rows, columns)| {
        let values = proptest::collection::vec(cost(), rows * columns);
        values.prop_map(move |values| Costs::new(rows, columns, values).unwrap())
    })
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(2000))]

    #[test]
    fn pairs_are_the_best_of_all(costs in costs(), limit in prop_oneof![Just(f64::INFINITY), -20.0..60.0f64]) {
        let pairs = assign(&costs, limit).unwrap();
        prop_assert!(pairs.is_sorted());
        let mut columns: Vec<usize> = pairs.iter().map(|(_, column)| *column).collect();
        columns.sort_unstable();
        columns.dedup();
        prop_assert_eq!(columns.len(), pairs.len(), "no column twice");
        prop_assert!(pairs.windows(2).all(|two| two[0].0 != two[1].0), "no row twice");
        let mut sum: f64 = pairs.iter().map(|(row, column)| costs.at(*row, *column)).sum();
        prop_assert!(pairs.iter().all(|(row, column)| costs.at(*row, *column) < limit), "{:?}", pairs);
        let (count, expected) = best(&costs, limit);
        match limit.is_finite() {
            true => sum += limit * (costs.rows() - pairs.len()) as f64,
            false => prop_assert_eq!(pairs.len(), count),
        }
        prop_assert!((sum - expected).abs() < 1e-9, "{} for {}", sum, expected);
    }

    #[test]
    fn rows_and_columns_can_be_exchanged(costs in costs(), limit in prop_oneof![Just(f64::INFINITY), -20.0..60.0f64]) {
        let turned = Costs::of(costs.columns(), costs.rows(), |row, column| costs.at(column, row)).unwrap();
        let sum = |costs: &Costs| {
            let pairs = assign(costs, limit).unwrap();
            let saved = |(row, column): &(usize, usize)| match limit.is_finite() {
                true => limit - costs.at(*row, *column),
                false => costs.at(*row, *column),
            };
            pairs.iter().map(saved).sum::<f64>()
        };
        prop_assert!((sum(&costs) - sum(&turned)).abs() < 1e-9);
    }
}
