//! Values on a square grid over a place.

/// A grid of values.
pub(super) struct Field<T> {
    pub x: f64,
    pub y: f64,
    pub cell: f64,
    pub columns: usize,
    pub rows: usize,
    pub values: Vec<T>,
}

impl<T: Copy> Field<T> {
    pub(super) fn new([x0, y0, x1, y1]: [f64; 4], cell: f64, value: T) -> Self {
        let count = |from: f64, to: f64| ((to - from) / cell).ceil() as usize + 2;
        let (columns, rows) = (count(x0, x1), count(y0, y1));
        Field {
            x: x0,
            y: y0,
            cell,
            columns,
            rows,
            values: vec![value; columns * rows],
        }
    }

    pub(super) fn node(&self, i: usize) -> (f64, f64) {
        let (column, row) = (i % self.columns, i / self.columns);
        (self.x + column as f64 * self.cell, self.y + row as f64 * self.cell)
    }

    /// Columns and rows whose nodes lie within `reach` of a point.
    pub(super) fn around(&self, x: f64, y: f64, reach: f64) -> [usize; 4] {
        let index = |v: f64, limit: usize| (v / self.cell).clamp(0.0, limit as f64) as usize;
        [
            index((x - reach - self.x).ceil(), self.columns),
            index(x + reach - self.x + self.cell, self.columns),
            index((y - reach - self.y).ceil(), self.rows),
            index(y + reach - self.y + self.cell, self.rows),
        ]
    }

    /// The cell of a point, and the point's place in it.
    #[inline(always)]
    pub(super) fn find(&self, x: f64, y: f64) -> Option<(usize, f64, f64)> {
        let (u, v) = ((x - self.x) * (1.0 / self.cell), (y - self.y) * (1.0 / self.cell));
        if !(u >= 0.0 && v >= 0.0 && u < (self.columns - 1) as f64 && v < (self.rows - 1) as f64) {
            return None;
        }
        let (i, j) = (u as usize, v as usize);
        Some((j * self.columns + i, u - i as f64, v - j as f64))
    }
}

impl Field<f32> {
    #[inline(always)]
    pub(super) fn at(&self, x: f64, y: f64) -> Option<f64> {
        let (i, u, v) = self.find(x, y)?;
        let [a, b] = [self.values[i], self.values[i + 1]].map(f64::from);
        let [c, d] = [self.values[i + self.columns], self.values[i + self.columns + 1]].map(f64::from);
        let (low, high) = (a + (b - a) * u, c + (d - c) * u);
        Some(low + (high - low) * v)
    }
}
