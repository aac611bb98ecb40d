//! The form of all feature maps: `[batch, rows + 2, columns + 2, channels]` f32 with a border of one zero cell.

use candle_core::{CpuStorage, Layout, Result, Shape, Tensor, bail};
use rayon::prelude::*;

/// Size of a map, without its border.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct MapShape {
    pub batch: usize,
    pub rows: usize,
    pub columns: usize,
    pub channels: usize,
}

impl MapShape {
    /// The map of a tensor's dimensions.
    pub fn of(shape: &Shape) -> Result<Self> {
        let (batch, rows, columns, channels) = shape.dims4()?;
        if rows < 3 || columns < 3 {
            bail!("expected a map of at least 1x1 cells inside a border, found {rows}x{columns} with it");
        }
        Ok(MapShape {
            batch,
            rows: rows - 2,
            columns: columns - 2,
            channels,
        })
    }

    pub fn with_channels(self, channels: usize) -> Self {
        MapShape { channels, ..self }
    }

    /// With the border.
    pub fn dims(&self) -> Shape {
        Shape::from((self.batch, self.rows + 2, self.columns + 2, self.channels))
    }

    /// Numbers of a row with its two border cells.
    pub fn pitch(&self) -> usize {
        (self.columns + 2) * self.channels
    }

    /// Numbers of an image with its border.
    pub fn image(&self) -> usize {
        (self.rows + 2) * self.pitch()
    }

    pub fn len(&self) -> usize {
        self.batch * self.image()
    }

    /// Cells inside the border, of all images.
    pub fn cells(&self) -> usize {
        self.batch * self.rows * self.columns
    }

    /// The image's row of a padded row among all images' padded rows; `None` for a border row.
    pub fn inner(&self, padded: usize) -> Option<(usize, usize)> {
        let (image, row) = (padded / (self.rows + 2), padded % (self.rows + 2));
        (row > 0 && row <= self.rows).then(|| (image, row - 1))
    }

    /// Where the first cell of a row lies; rows and columns count from -1, the border.
    pub fn at(&self, image: usize, row: isize, column: isize) -> usize {
        image * self.image() + (row + 1) as usize * self.pitch() + (column + 1) as usize * self.channels
    }

    /// Calls `fill(image, row, cells)` with the cells inside the border of each row, in parallel; the border becomes 0.
    pub fn fill_rows(&self, out: &mut [f32], fill: impl Fn(usize, usize, &mut [f32]) + Sync) {
        let c = self.channels;
        out.par_chunks_mut(self.pitch())
            .enumerate()
            .for_each(|(padded, row)| match self.inner(padded) {
                None => row.fill(0.0),
                Some((image, y)) => {
                    row[..c].fill(0.0);
                    let end = row.len() - c;
                    row[end..].fill(0.0);
                    fill(image, y, &mut row[c..end]);
                }
            });
    }

    /// The cells inside the border of a row.
    pub fn row<'a>(&self, data: &'a [f32], image: usize, row: usize) -> &'a [f32] {
        &data[self.at(image, row as isize, 0)..][..self.columns * self.channels]
    }
}

/// The numbers of a tensor's storage.
pub(crate) fn numbers<'a>(storage: &'a CpuStorage, layout: &Layout) -> Result<&'a [f32]> {
    let Some((from, to)) = layout.contiguous_offsets() else {
        bail!("expected a contiguous tensor, found {layout:?}");
    };
    match storage {
        CpuStorage::F32(data) => Ok(&data[from..to]),
        _ => bail!("expected f32 numbers"),
    }
}

/// Calls `read` with the numbers of a contiguous tensor on the CPU.
pub(crate) fn with_numbers<T>(tensor: &Tensor, read: impl FnOnce(&[f32]) -> Result<T>) -> Result<T> {
    let (storage, layout) = tensor.storage_and_layout();
    match &*storage {
        candle_core::Storage::Cpu(storage) => read(numbers(storage, layout)?),
        _ => bail!("expected a tensor on the CPU"),
    }
}

/// A tensor of a shape.
pub(crate) fn tensor(data: Vec<f32>, shape: impl Into<Shape>) -> Result<Tensor> {
    Tensor::from_vec(data, shape.into(), &candle_core::Device::Cpu)
}

/// A buffer whose numbers are all about to be written.
pub(crate) fn buffer(len: usize) -> Vec<f32> {
    vec![0.0; len]
}
