//! Layers on maps, and work on all their cells.

use crate::conv::{Convolution, Element, Isa, Kernel, Map, Packed, Pool, Rows, Steps, View};

/// A layer that makes f32 of a map.
pub type Linear<E> = Packed<E, f32>;

/// A layer of so many inputs with a kernel of a side.
pub fn packed<E: Kernel<O>, O: Element>(
    weights: Vec<f32>,
    bias: Vec<f32>,
    [inputs, kernel]: [usize; 2],
    isa: Isa,
) -> Packed<E, O> {
    let layer = Convolution {
        inputs,
        outputs: bias.len(),
        kernel,
        stride: 1,
        transposed: false,
        relu: false,
        weights,
        bias,
    };
    Packed::new(&layer, isa, Steps::ONE)
}

/// The cells of a row, border left out.
pub fn cells<'a, E>(view: &View<'a, E>, row: usize) -> &'a [E] {
    &view.data[(row + view.border) * view.line() + view.border * view.stored..][..view.columns * view.stored]
}

/// The cells of a map of one row.
pub fn line<E: Element>(map: &Map<E>) -> &[E] {
    debug_assert_eq!(map.rows, 1, "rows of a map of one");
    let length = map.columns * map.stored;
    &map.view().data[map.row_length() + map.stored..][..length]
}

/// As [`line`], to be written.
pub fn line_mut<E: Element>(map: &mut Map<E>) -> &mut [E] {
    let (stored, length) = (map.stored, map.columns * map.stored);
    let row = map.shares(1, 1).swap_remove(0);
    &mut row.data[stored..][..length]
}

/// Does something with the cells of every row of a map; `scale` rows stay with one worker.
pub fn each_cell<E: Element>(map: &mut Map<E>, scale: usize, pool: &mut Pool, work: impl Fn(usize, &mut [E]) + Sync) {
    let (length, stored, columns) = (map.row_length(), map.stored, map.columns);
    pool.each(map.shares(pool.threads(), scale), |Rows { range, data }| {
        for (row, to) in range.zip(data.chunks_exact_mut(length)) {
            work(row, &mut to[stored..(columns + 1) * stored]);
        }
    });
}

/// Adds a map to another.
pub fn add(to: &mut Map<f32>, from: &Map<f32>, pool: &mut Pool) {
    let from = from.view();
    each_cell(to, 1, pool, |row, to| {
        to.iter_mut().zip(cells(&from, row)).for_each(|(to, from)| *to += from);
    });
}

/// The map that a layer makes of another.
pub fn run<E: Kernel<f32>>(layer: &Linear<E>, from: &Map<E>, outputs: usize, pool: &mut Pool) -> Map<f32> {
    let mut to = Map::new(from.rows, from.columns, outputs);
    layer.run(pool, from.view(), &mut to, 0);
    to
}
