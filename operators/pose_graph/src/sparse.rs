//! Cholesky's factorisation of a sparse symmetric matrix of 6×6 blocks.

use std::collections::{BTreeMap, BTreeSet};

use nalgebra::{Matrix6, Vector6};

/// A symmetric matrix: of each column its blocks on the diagonal and below.
#[derive(Clone, Debug)]
pub(crate) struct BlockMatrix {
    columns: Vec<BTreeMap<usize, Matrix6<f64>>>,
}

impl BlockMatrix {
    pub fn zeros(size: usize) -> Self {
        BlockMatrix {
            columns: vec![BTreeMap::new(); size],
        }
    }

    /// Adds to a block and, by symmetry, to the transposed one.
    pub fn add(&mut self, row: usize, column: usize, block: &Matrix6<f64>) {
        let (row, column, block) = match row >= column {
            true => (row, column, *block),
            false => (column, row, block.transpose()),
        };
        *self.columns[column].entry(row).or_insert_with(Matrix6::zeros) += block;
    }

    /// Makes the diagonal larger by a share of it, and a little.
    pub fn damp(&mut self, share: f64) {
        for (at, column) in self.columns.iter_mut().enumerate() {
            if let Some(block) = column.get_mut(&at) {
                for axis in 0..6 {
                    block[(axis, axis)] += share * block[(axis, axis)] + 1e-12;
                }
            }
        }
    }

    /// An order of elimination that fills in little: each time the one with the fewest neighbours, the first of several.
    pub fn order(&self) -> Vec<usize> {
        let mut neighbours: Vec<BTreeSet<usize>> = vec![BTreeSet::new(); self.columns.len()];
        for (column, rows) in self.columns.iter().enumerate() {
            for row in rows.keys().filter(|row| **row != column) {
                neighbours[column].insert(*row);
                neighbours[*row].insert(column);
            }
        }
        let mut waiting: BTreeSet<(usize, usize)> =
            (0..neighbours.len()).map(|at| (neighbours[at].len(), at)).collect();
        let mut order = Vec::with_capacity(neighbours.len());
        while let Some((_, next)) = waiting.pop_first() {
            order.push(next);
            let around = std::mem::take(&mut neighbours[next]);
            for at in &around {
                waiting.remove(&(neighbours[*at].len(), *at));
                neighbours[*at].remove(&next);
                neighbours[*at].extend(around.iter().filter(|other| *other != at));
                waiting.insert((neighbours[*at].len(), *at));
            }
        }
        order
    }
}

/// The factor L with L·Lᵀ = A, its rows and columns in an order of elimination.
#[derive(Clone, Debug)]
pub(crate) struct BlockCholesky {
    order: Vec<usize>,
    /// Of each column: its block on the diagonal, and those below by rising row.
    columns: Vec<(Matrix6<f64>, Below)>,
}

/// Blocks below the diagonal, each with its row.
type Below = Vec<(usize, Matrix6<f64>)>;

impl BlockCholesky {
    /// Factorises; `None` unless the matrix is positive definite.
    pub fn new(matrix: &BlockMatrix, order: &[usize]) -> Option<Self> {
        let mut place = vec![0; order.len()];
        order.iter().enumerate().for_each(|(at, node)| place[*node] = at);
        let mut left = BlockMatrix::zeros(order.len());
        for (column, rows) in matrix.columns.iter().enumerate() {
            for (row, block) in rows {
                left.add(place[*row], place[column], block);
            }
        }
        let mut columns = Vec::with_capacity(order.len());
        for at in 0..order.len() {
            let mut rows = std::mem::take(&mut left.columns[at]);
            let diagonal = rows.remove(&at)?.cholesky()?.unpack();
            let mut below = Below::with_capacity(rows.len());
            for (row, block) in rows {
                below.push((row, diagonal.solve_lower_triangular(&block.transpose())?.transpose()));
            }
            for (i, (column, by)) in below.iter().enumerate() {
                for (row, block) in &below[i..] {
                    left.add(*row, *column, &-(block * by.transpose()));
                }
            }
            columns.push((diagonal, below));
        }
        Some(BlockCholesky {
            order: order.into(),
            columns,
        })
    }

    /// Solves A·x = b.
    pub fn solve(&self, right: &[Vector6<f64>]) -> Option<Vec<Vector6<f64>>> {
        let mut x: Vec<Vector6<f64>> = self.order.iter().map(|node| right[*node]).collect();
        for (at, (diagonal, below)) in self.columns.iter().enumerate() {
            let solved = diagonal.solve_lower_triangular(&x[at])?;
            x[at] = solved;
            below.iter().for_each(|(row, block)| x[*row] -= block * solved);
        }
        for (at, (diagonal, below)) in self.columns.iter().enumerate().rev() {
            let mut sum = x[at];
            below.iter().for_each(|(row, block)| sum -= block.transpose() * x[*row]);
            x[at] = diagonal.tr_solve_lower_triangular(&sum)?;
        }
        let mut solved = vec![Vector6::zeros(); x.len()];
        self.order.iter().zip(x).for_each(|(node, x)| solved[*node] = x);
        Some(solved)
    }
}

#[cfg(test)]
mod tests {
    use damage::Draw;
    use nalgebra::{DMatrix, DVector};
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn it_agrees_with_a_dense_solver(
            size in 1usize..12,
            links in prop::collection::vec((0usize..12, 0usize..12), 0..20),
            seed in 0u64..1000,
        ) {
            let mut draw = Draw::new(seed);
            let mut number = || draw.below(2_000_000) as f64 * 1e-6 - 1.0;
            let (mut sparse, mut dense) = (BlockMatrix::zeros(size), DMatrix::<f64>::identity(6 * size, 6 * size));
            (0..size).for_each(|at| sparse.add(at, at, &Matrix6::identity()));
            for (a, b) in links.into_iter().filter(|(a, b)| *a < size && *b < size && a != b) {
                // As a factor of two poses is: JᵀJ.
                let jacobians = [(a, Matrix6::from_fn(|_, _| number())), (b, Matrix6::from_fn(|_, _| number()))];
                for (i, (row, left)) in jacobians.iter().enumerate() {
                    for (column, right) in &jacobians[i..] {
                        sparse.add(*row, *column, &(left.transpose() * right));
                    }
                    for (column, right) in &jacobians {
                        let mut block = dense.fixed_view_mut::<6, 6>(6 * row, 6 * column);
                        block += left.transpose() * right;
                    }
                }
            }
            let right: Vec<Vector6<f64>> = (0..size).map(|_| Vector6::from_fn(|_, _| number())).collect();
            let found = BlockCholesky::new(&sparse, &sparse.order()).unwrap().solve(&right).unwrap();
            let expected = dense.cholesky().unwrap().solve(&DVector::from_iterator(6 * size, right.iter().flatten().copied()));
            for (at, x) in found.iter().flatten().enumerate() {
                prop_assert!((x - expected[at]).abs() < 1e-9, "{at}: {x}, {}", expected[at]);
            }
        }
    }

    #[test]
    fn a_chain_is_eliminated_without_fill_and_an_indefinite_matrix_is_refused() {
        let mut chain = BlockMatrix::zeros(50);
        for at in 0..50 {
            chain.add(at, at, &(Matrix6::identity() * 3.0));
            if at > 0 {
                chain.add(at, at - 1, &-Matrix6::identity());
            }
        }
        let factor = BlockCholesky::new(&chain, &chain.order()).unwrap();
        assert_eq!(factor.columns.iter().map(|(_, below)| below.len()).sum::<usize>(), 49);
        chain.add(7, 7, &(Matrix6::identity() * -9.0));
        assert!(BlockCholesky::new(&chain, &chain.order()).is_none());
    }
}
