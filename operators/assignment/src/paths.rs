//! Shortest augmenting paths, of a matrix whose costs are all finite.

/// No row.
const NOBODY: usize = usize::MAX;

/// The column of each row, all different, of the smallest sum of costs; `rows` ≤ `columns`.
pub(crate) fn columns_of_rows(rows: usize, columns: usize, cost: impl Fn(usize, usize) -> f64) -> Vec<usize> {
    let mut search = Search {
        values: (0..rows * columns).map(|at| cost(at / columns, at % columns)).collect(),
        row_prices: vec![0.0; rows],
        column_prices: vec![0.0; columns],
        column_of: vec![NOBODY; rows],
        row_of: vec![NOBODY; columns],
        reach: Reach::new(columns),
    };
    for row in 0..rows {
        search.augment(row);
    }
    search.column_of
}

struct Search {
    /// `[rows, columns]`, row-major.
    values: Vec<f64>,
    /// The dual variables: no price of a row and a column together is above their cost.
    row_prices: Vec<f64>,
    column_prices: Vec<f64>,
    column_of: Vec<usize>,
    row_of: Vec<usize>,
    reach: Reach,
}

/// What one search has found, by column.
struct Reach {
    /// Length of the shortest path to it.
    length: Vec<f64>,
    /// The row before it on that path.
    from: Vec<usize>,
    /// Whether the path is final.
    is_done: Vec<bool>,
    /// Columns whose path is final, in that order.
    done: Vec<usize>,
}

impl Reach {
    fn new(columns: usize) -> Self {
        Reach {
            length: vec![f64::INFINITY; columns],
            from: vec![NOBODY; columns],
            is_done: vec![false; columns],
            done: Vec::with_capacity(columns),
        }
    }

    fn clear(&mut self) {
        self.length.fill(f64::INFINITY);
        self.is_done.fill(false);
        self.done.clear();
    }
}

impl Search {
    /// Gives a row a column; rows that have one may change theirs.
    fn augment(&mut self, row: usize) {
        self.reach.clear();
        let (mut shortest, mut from) = (0.0, row);
        let free = loop {
            let column = self.next(from, shortest);
            shortest = self.reach.length[column];
            self.reach.is_done[column] = true;
            if self.row_of[column] == NOBODY {
                break column;
            }
            self.reach.done.push(column);
            from = self.row_of[column];
        };
        self.row_prices[row] += shortest;
        for column in &self.reach.done {
            let by = shortest - self.reach.length[*column];
            self.row_prices[self.row_of[*column]] += by;
            self.column_prices[*column] -= by;
        }
        self.flip(row, free);
    }

    /// Extends paths of length `shortest` by a row's columns; the nearest column that is not done, of equally near ones a
    /// free one, then the first.
    fn next(&mut self, row: usize, shortest: f64) -> usize {
        let columns = self.row_of.len();
        let costs = &self.values[row * columns..][..columns];
        let mut nearest: Option<usize> = None;
        for (column, cost) in costs.iter().enumerate() {
            if self.reach.is_done[column] {
                continue;
            }
            let length = shortest + cost - self.row_prices[row] - self.column_prices[column];
            if length < self.reach.length[column] {
                (self.reach.length[column], self.reach.from[column]) = (length, row);
            }
            let is_free = |column: usize| self.row_of[column] == NOBODY;
            let is_nearer = |best: usize| {
                let [here, there] = [self.reach.length[column], self.reach.length[best]];
                here < there || (here == there && is_free(column) && !is_free(best))
            };
            if nearest.is_none_or(is_nearer) {
                nearest = Some(column);
            }
        }
        // At most as many columns are done as there are rows before this one, which are fewer than all columns.
        nearest.expect("a column is left")
    }

    /// Takes the pairs of the path from `row` to `column` in place of those that it crosses.
    fn flip(&mut self, row: usize, mut column: usize) {
        loop {
            let from = self.reach.from[column];
            self.row_of[column] = from;
            std::mem::swap(&mut self.column_of[from], &mut column);
            if from == row {
                return;
            }
        }
    }
}
