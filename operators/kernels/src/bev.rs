//! Maps of features seen from above.

/// A map of features seen from above: `rows` along y, `columns` along x.
#[derive(Clone, Debug, PartialEq)]
pub struct BevMap {
    /// Cells along y.
    pub rows: usize,
    /// Cells along x.
    pub columns: usize,
    /// Features of a cell.
    pub channels: usize,
    /// `[rows, columns, channels]`.
    pub data: Vec<f32>,
}

/// A [`BevMap`] to read, wherever its numbers lie.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BevView<'a> {
    /// Cells along y.
    pub rows: usize,
    /// Cells along x.
    pub columns: usize,
    /// Features of a cell.
    pub channels: usize,
    /// `[rows, columns, channels]`.
    pub data: &'a [f32],
}

impl<'a> From<&'a BevMap> for BevView<'a> {
    fn from(map: &'a BevMap) -> Self {
        BevView {
            rows: map.rows,
            columns: map.columns,
            channels: map.channels,
            data: &map.data,
        }
    }
}
