//! The bird's-eye map that the pillar net writes and the first convolution reads.

use crate::conv::{Rows, View, split};

/// A map of `rows` (along y) × `columns` (along x) cells with `channels` f32 each, channels last, with a border of one
/// cell of zeros for 3×3 convolutions.
///
/// Cell (row, column) begins at `((row + 1) * (columns + 2) + column + 1) * channels` of [`Canvas::data`].
#[derive(Clone, Debug, PartialEq)]
pub struct Canvas {
    rows: usize,
    columns: usize,
    channels: usize,
    data: Vec<f32>,
    /// Where cells begin that are not known to be zero.
    written: Vec<usize>,
}

impl Canvas {
    /// A map of zeros.
    pub fn new(rows: usize, columns: usize, channels: usize) -> Self {
        Canvas {
            rows,
            columns,
            channels,
            data: vec![0.0; (rows + 2) * (columns + 2) * channels],
            written: Vec::new(),
        }
    }

    /// Cells along y, without the border.
    pub fn rows(&self) -> usize {
        self.rows
    }

    /// Cells along x, without the border.
    pub fn columns(&self) -> usize {
        self.columns
    }

    /// Numbers per cell.
    pub fn channels(&self) -> usize {
        self.channels
    }

    /// The canvas as layers read it.
    pub fn view(&self) -> View<'_, f32> {
        View {
            rows: self.rows,
            columns: self.columns,
            stored: self.channels,
            border: 1,
            data: &self.data,
            written: Some(&self.written),
        }
    }

    /// All numbers, `[rows + 2, columns + 2, channels]`; the border is zero.
    pub fn data(&self) -> &[f32] {
        &self.data
    }

    /// The cells without the border, `[rows, columns, channels]`.
    pub fn cells(&self) -> Vec<f32> {
        let length = self.columns * self.channels;
        let rows = (0..self.rows).map(|row| &self.data[self.start(row, 0)..][..length]);
        rows.flatten().copied().collect()
    }

    /// Rows and columns of the cells that are not known to be zero, in no order, some of them perhaps twice.
    pub fn written_cells(&self) -> impl Iterator<Item = [usize; 2]> {
        let length = self.columns + 2;
        let cells = self.written.iter().map(|start| start / self.channels);
        cells.map(move |cell| [cell / length - 1, cell % length - 1])
    }

    /// The channels of a cell.
    ///
    /// # Panics
    /// If the cell does not exist.
    pub fn cell(&self, row: usize, column: usize) -> &[f32] {
        let start = self.start(row, column);
        &self.data[start..start + self.channels]
    }

    /// The channels of a cell, to be written.
    ///
    /// # Panics
    /// If the cell does not exist.
    pub fn cell_mut(&mut self, row: usize, column: usize) -> &mut [f32] {
        let start = self.start(row, column);
        self.written.push(start);
        &mut self.data[start..start + self.channels]
    }

    /// Makes all cells zero; only those that were written are touched.
    pub fn clear(&mut self) {
        for start in self.written.drain(..) {
            self.data[start..start + self.channels].fill(0.0);
        }
    }

    /// Says that only cells `row * columns + column` will be other than zero, and where those begin that were before; to be
    /// cleared by whoever writes.
    pub fn mark(&mut self, cells: &[u32]) -> Vec<usize> {
        let columns = self.columns;
        let starts = cells.iter().map(|cell| *cell as usize);
        let starts = starts.map(|cell| self.start(cell / columns, cell % columns)).collect();
        std::mem::replace(&mut self.written, starts)
    }

    /// The rows without the border, cut for workers; each with its border columns.
    pub fn shares(&mut self, workers: usize) -> Vec<Rows<'_, f32>> {
        let length = (self.columns + 2) * self.channels;
        split(
            &mut self.data[length..length * (self.rows + 1)],
            length,
            self.rows,
            workers,
            1,
        )
    }

    fn start(&self, row: usize, column: usize) -> usize {
        assert!(
            row < self.rows && column < self.columns,
            "cell ({row}, {column}) lies outside a map of {}×{} cells",
            self.rows,
            self.columns
        );
        ((row + 1) * (self.columns + 2) + column + 1) * self.channels
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cells_lie_inside_a_border_of_zeros() {
        let mut canvas = Canvas::new(2, 3, 2);
        for row in 0..2 {
            for column in 0..3 {
                canvas.cell_mut(row, column).fill(1.0);
            }
        }
        assert_eq!(canvas.data().len(), 4 * 5 * 2);
        let ones: Vec<usize> = (0..20)
            .filter(|cell| canvas.data()[cell * 2..][..2] == [1.0, 1.0])
            .collect();
        assert_eq!(ones, [6, 7, 8, 11, 12, 13]);
        assert_eq!(canvas.data().iter().filter(|value| **value != 0.0).count(), 12);
    }

    #[test]
    fn clearing_leaves_zeros() {
        let mut canvas = Canvas::new(4, 4, 3);
        canvas.cell_mut(3, 3)[2] = 5.0;
        canvas.cell_mut(0, 1)[0] = 7.0;
        assert_eq!(canvas.cell(3, 3), [0.0, 0.0, 5.0]);
        canvas.clear();
        assert_eq!(canvas, Canvas::new(4, 4, 3));
    }

    #[test]
    #[should_panic(expected = "cell (0, 3) lies outside a map of 2×3 cells")]
    fn a_cell_of_the_next_row_is_not_a_column_too_many() {
        Canvas::new(2, 3, 1).cell_mut(0, 3);
    }
}
