use std::ops::Range;

use super::aligned::Aligned;
use super::element::Element;
use super::pool::Pool;

/// A map of `rows` x `columns` cells with a border of one cell of zeros, channels last.
#[derive(Debug)]
pub struct Map<E> {
    pub rows: usize,
    pub columns: usize,
    pub channels: usize,
    /// Numbers of a cell: the channels, filled up with zeros to whole units.
    pub stored: usize,
    /// What 1 stands for.
    step: f32,
    data: Aligned<E>,
}

/// A [`Map`] to read.
#[derive(Clone, Copy, Debug)]
pub struct View<'a, E> {
    pub rows: usize,
    pub columns: usize,
    pub stored: usize,
    /// Cells of zeros around it: 1, or 0 for what only kernels of 1x1 read.
    pub border: usize,
    /// `[rows + 2 * border, columns + 2 * border, stored]`.
    pub data: &'a [E],
    /// Where in `data` the cells begin that need not be zero; `None` if nobody knows.
    pub written: Option<&'a [usize]>,
}

impl<E> View<'_, E> {
    /// Numbers that its size says it has.
    pub fn numbers(&self) -> usize {
        (self.rows + 2 * self.border) * self.line()
    }

    /// Numbers of a row, border included.
    pub fn line(&self) -> usize {
        (self.columns + 2 * self.border) * self.stored
    }
}

/// Whole rows of a map, border columns included.
pub struct Rows<'a, E> {
    pub range: Range<usize>,
    pub data: &'a mut [E],
}

impl<E: Element> Map<E> {
    /// A map of zeros whose numbers stand for themselves.
    pub fn new(rows: usize, columns: usize, channels: usize) -> Self {
        Map::with_step([rows, columns, channels], 1.0)
    }

    /// A map of zeros of so many rows, columns and channels, with a step.
    pub fn with_step([rows, columns, channels]: [usize; 3], step: f32) -> Self {
        let stored = channels.next_multiple_of(E::PER_UNIT);
        Map {
            rows,
            columns,
            channels,
            stored,
            step,
            data: Aligned::zeros((rows + 2) * (columns + 2) * stored),
        }
    }

    pub fn view(&self) -> View<'_, E> {
        View {
            rows: self.rows,
            columns: self.columns,
            stored: self.stored,
            border: 1,
            data: &self.data,
            written: None,
        }
    }

    pub fn row_length(&self) -> usize {
        (self.columns + 2) * self.stored
    }

    /// The rows without the border, cut for workers; every `scale` rows stay together.
    pub fn shares(&mut self, workers: usize, scale: usize) -> Vec<Rows<'_, E>> {
        let (rows, length) = (self.rows, self.row_length());
        split(
            &mut self.data[length..length * (rows + 1)],
            length,
            rows,
            workers,
            scale,
        )
    }

    /// The channels of the cells of a row.
    pub fn row(&self, row: usize) -> impl Iterator<Item = &[E]> {
        let start = (row + 1) * self.row_length() + self.stored;
        let cells = &self.data[start..start + self.columns * self.stored];
        cells.chunks_exact(self.stored).map(|cell| &cell[..self.channels])
    }

    /// Takes all cells from `[rows, columns, channels]`.
    #[cfg(test)]
    pub fn fill_from(&mut self, cells: &[f32]) {
        self.fill_with(&mut Pool::new(1), cells);
    }

    pub fn fill_with(&mut self, pool: &mut Pool, cells: &[f32]) {
        let steps = 1.0 / self.step;
        let (columns, channels, stored, length) = (self.columns, self.channels, self.stored, self.row_length());
        assert_eq!(cells.len(), self.rows * columns * channels, "numbers of the map");
        pool.each(self.shares(pool.threads(), 1), |share| {
            for (row, to) in share.range.zip(share.data.chunks_exact_mut(length)) {
                let from = cells[row * columns * channels..].chunks_exact(channels);
                for (from, to) in from.zip(to[stored..].chunks_exact_mut(stored)).take(columns) {
                    from.iter()
                        .zip(to)
                        .for_each(|(from, to)| *to = E::from_f32(*from * steps));
                }
            }
        });
    }

    /// Takes all cells, border included, from a map of the same size.
    pub fn fill_from_view(&mut self, pool: &mut Pool, from: View<f32>) {
        self.assert_like(&from);
        let steps = 1.0 / self.step;
        let (rows, length, channels, stored) = (self.rows + 2, self.row_length(), self.channels, self.stored);
        let shares = split(&mut self.data, length, rows, pool.threads(), 1);
        pool.each(shares, |share| {
            let cells = share.range.start * (length / stored) * channels;
            let from = from.data[cells..].chunks_exact(channels);
            for (from, to) in from.zip(share.data.chunks_exact_mut(stored)) {
                from.iter()
                    .zip(to)
                    .for_each(|(from, to)| *to = E::from_f32(*from * steps));
            }
        });
    }

    /// Takes the cells that begin at `written` of a map of the same size, makes those zero that began at `before`.
    pub fn fill_from_cells(&mut self, pool: &mut Pool, from: View<f32>, before: &[usize], written: &[usize]) {
        self.assert_like(&from);
        let steps = 1.0 / self.step;
        let (rows, length, channels, stored) = (self.rows + 2, self.row_length(), self.channels, self.stored);
        let shares = split(&mut self.data, length, rows, pool.threads(), 1);
        pool.each(shares, |share| {
            let [begin, end] = [share.range.start, share.range.end].map(|row| row * (length / stored) * channels);
            let own = |start: &&usize| (begin..end).contains(*start);
            let place = |start: usize| (start - begin) / channels * stored;
            for start in before.iter().filter(own) {
                share.data[place(*start)..][..channels].fill(E::default());
            }
            for start in written.iter().filter(own) {
                let to = &mut share.data[place(*start)..][..channels];
                let from = &from.data[*start..][..channels];
                from.iter()
                    .zip(to)
                    .for_each(|(from, to)| *to = E::from_f32(*from * steps));
            }
        });
    }

    fn assert_like(&self, from: &View<f32>) {
        assert_eq!(
            (from.rows, from.columns, from.stored, from.border),
            (self.rows, self.columns, self.channels, 1),
            "size of a map"
        );
    }

    /// All cells as `[rows, columns, channels]`.
    pub fn to_f32(&self, pool: &mut Pool) -> Vec<f32> {
        let length = self.columns * self.channels;
        let mut cells = vec![0.0; self.rows * length];
        pool.each(split(&mut cells, length, self.rows, pool.threads(), 1), |share| {
            for (row, to) in share.range.zip(share.data.chunks_exact_mut(length)) {
                for (from, to) in self.row(row).zip(to.chunks_exact_mut(self.channels)) {
                    from.iter()
                        .zip(to)
                        .for_each(|(from, to)| *to = from.to_f32() * self.step);
                }
            }
        });
        cells
    }
}

/// Rows of `length` numbers cut into one share for each worker; every `scale` rows stay together.
pub fn split<T>(mut data: &mut [T], length: usize, rows: usize, workers: usize, scale: usize) -> Vec<Rows<'_, T>> {
    let groups = rows.div_ceil(scale);
    let mut shares = Vec::with_capacity(workers);
    for worker in 0..workers {
        let [start, end] = [worker, worker + 1].map(|worker| (groups * worker / workers * scale).min(rows));
        let range = start..end;
        let (share, rest) = data.split_at_mut(range.len() * length);
        data = rest;
        shares.push(Rows { range, data: share });
    }
    shares
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::conv::Bf16;

    #[test]
    fn shares_are_all_rows_in_order() {
        let mut map = Map::<f32>::new(12, 3, 2);
        let ranges: Vec<_> = map
            .shares(5, 2)
            .into_iter()
            .map(|share| (share.range, share.data.len()))
            .collect();
        let row = (3 + 2) * 2;
        assert_eq!(
            ranges,
            [
                (0..2, 2 * row),
                (2..4, 2 * row),
                (4..6, 2 * row),
                (6..8, 2 * row),
                (8..12, 4 * row)
            ]
        );
        let ranges = |shares: Vec<Rows<f32>>| shares.into_iter().map(|share| share.range).collect::<Vec<_>>();
        assert_eq!(ranges(map.shares(2, 8)), [0..8, 8..12]);
        assert_eq!(ranges(Map::<f32>::new(9, 3, 2).shares(4, 4)), [0..0, 0..4, 4..8, 8..9]);
        assert_eq!(
            map.shares(40, 1).iter().filter(|share| !share.range.is_empty()).count(),
            12
        );
    }

    #[test]
    fn the_border_and_the_rest_of_a_unit_stay_zero() {
        let mut map = Map::<Bf16>::new(2, 3, 3);
        let cells: Vec<f32> = (1..=18).map(|value| value as f32).collect();
        map.fill_from(&cells);
        assert_eq!((map.stored, map.to_f32(&mut Pool::new(2))), (4, cells));
        assert_eq!(map.data.iter().filter(|value| value.0 != 0).count(), 18);
    }
}
