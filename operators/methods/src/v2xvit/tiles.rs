//! Tiles of a map: the cells that a worker takes through one layer after the other while they lie in its cache.

use std::ops::Range;
use std::sync::Mutex;

use realo_kernels::cells::{Linear, line_mut};
use realo_kernels::conv::{Map, Packed, Pool, lock};
use realo_kernels::number::Number;

use super::settings::Window;

/// Cells of a tile, if windows fit: what layers make of them then stays in a core's second cache.
const CELLS: usize = 128;

/// Some columns of a few whole rows of a map.
#[derive(Clone, Copy, Debug)]
pub struct Tile {
    pub rows: usize,
    pub columns: usize,
    /// The first of its columns in the map.
    first: usize,
    /// Columns of the map.
    of: usize,
}

impl Tile {
    /// A whole map.
    pub fn whole([rows, columns]: [usize; 2]) -> Self {
        Tile {
            rows,
            columns,
            first: 0,
            of: columns,
        }
    }

    pub fn cells(self) -> usize {
        self.rows * self.columns
    }

    /// Its cells as a map of their own.
    pub fn alone(self) -> Self {
        Tile::whole([self.rows, self.columns])
    }

    /// Its part of each of its rows of a map; `numbers` of a cell.
    pub fn lines<T>(self, rows: &[T], numbers: usize) -> impl Iterator<Item = &[T]> {
        let part = self.part(numbers);
        rows.chunks_exact(self.of * numbers).map(move |row| &row[part.clone()])
    }

    /// As [`Tile::lines`], to be written.
    pub fn lines_mut<T>(self, rows: &mut [T], numbers: usize) -> impl Iterator<Item = &mut [T]> {
        let part = self.part(numbers);
        rows.chunks_exact_mut(self.of * numbers)
            .map(move |row| &mut row[part.clone()])
    }

    /// Adds its cells to its rows of a map.
    pub fn add(self, cells: &[f32], channels: usize, rows: &mut [f32]) {
        let lines = cells.chunks_exact(self.columns * channels);
        for (from, to) in lines.zip(self.lines_mut(rows, channels)) {
            to.iter_mut().zip(from).for_each(|(to, from)| *to += from);
        }
    }

    fn part(self, numbers: usize) -> Range<usize> {
        self.first * numbers..(self.first + self.columns) * numbers
    }
}

/// How a map is cut into tiles: whole windows of every size lie in one.
#[derive(Clone, Copy, Debug)]
pub struct Tiles {
    /// Rows and columns of a tile.
    tile: [usize; 2],
    /// Rows and columns of the map.
    map: [usize; 2],
}

impl Tiles {
    /// Of a map whose rows and columns all windows divide.
    pub fn new(windows: &[Window], map: [usize; 2]) -> Self {
        let side = windows
            .iter()
            .fold(1, |side, window| common_multiple(side, window.side));
        let across = map[1] / side;
        let most = (CELLS / (side * side)).clamp(1, across.max(1));
        let together = (1..=most).rev().find(|count| across.is_multiple_of(*count));
        Tiles {
            tile: [side, together.unwrap_or(1) * side],
            map,
        }
    }

    /// Cells of the map.
    pub fn cells(self) -> usize {
        self.map[0] * self.map[1]
    }

    /// Bands of tiles side by side, one under the other.
    pub fn bands(self) -> usize {
        self.map[0] / self.tile[0]
    }

    /// The tiles of a band.
    pub fn across(self) -> impl Iterator<Item = Tile> {
        let ([rows, columns], of) = (self.tile, self.map[1]);
        (0..of).step_by(columns).map(move |first| Tile {
            rows,
            columns,
            first,
            of,
        })
    }
}

/// The smallest one.
fn common_multiple(a: usize, b: usize) -> usize {
    let (mut divisor, mut rest) = (a, b);
    while rest > 0 {
        (divisor, rest) = (rest, divisor % rest);
    }
    a / divisor * b
}

/// What one worker computes tiles with. Its maps have one row, of all cells of a tile, and are kept from tile to tile.
pub struct Worker<E> {
    /// Of the worker alone.
    alone: Pool,
    single: Vec<Map<f32>>,
    own: Vec<Map<E>>,
}

impl<E: Number> Worker<E> {
    pub fn new() -> Self {
        Worker {
            alone: Pool::new(1),
            single: Vec::new(),
            own: Vec::new(),
        }
    }

    /// A map of f32, of any numbers.
    pub fn single(&mut self, cells: usize, channels: usize) -> Map<f32> {
        found(&mut self.single, cells, channels).unwrap_or_else(|| Map::new(1, cells, channels))
    }

    /// A map of the transformer's numbers, of any.
    pub fn own(&mut self, cells: usize, channels: usize) -> Map<E> {
        found(&mut self.own, cells, channels).unwrap_or_else(|| Map::new(1, cells, channels))
    }

    /// Takes maps back.
    pub fn keep_single(&mut self, maps: impl IntoIterator<Item = Map<f32>>) {
        self.single.extend(maps);
    }

    /// Takes maps back.
    pub fn keep_own(&mut self, maps: impl IntoIterator<Item = Map<E>>) {
        self.own.extend(maps);
    }

    /// The map that a layer makes of another.
    pub fn run(&mut self, layer: &Linear<E>, from: &Map<E>) -> Map<f32> {
        let mut to = self.single(from.columns, layer.outputs());
        layer.run(&mut self.alone, from.view(), &mut to, 0);
        to
    }

    /// The cells of a tile from its rows of a map.
    pub fn gather(&mut self, tile: Tile, rows: &[f32], channels: usize) -> Map<f32> {
        let mut to = self.single(tile.cells(), channels);
        let lines = line_mut(&mut to).chunks_exact_mut(tile.columns * channels);
        tile.lines(rows, channels)
            .zip(lines)
            .for_each(|(from, to)| to.copy_from_slice(from));
        to
    }

    /// As [`Worker::run`], in the transformer's numbers.
    pub fn run_own(&mut self, layer: &Packed<E>, from: &Map<E>) -> Map<E> {
        let mut to = self.own(from.columns, layer.outputs());
        layer.run(&mut self.alone, from.view(), &mut to, 0);
        to
    }
}

/// Threads, with a worker for each.
pub struct Crew<'a, E> {
    pub workers: &'a mut [Worker<E>],
    pub pool: &'a mut Pool,
}

impl<E: Number> Crew<'_, E> {
    /// Does something with every item; a worker that has finished one takes the next.
    pub fn each<T: Send>(&mut self, items: &mut [T], work: impl Fn(&mut T, &mut Worker<E>) + Sync) {
        let queue = Mutex::new(items.iter_mut());
        self.pool.each(self.workers.iter_mut().collect(), |worker| {
            loop {
                let Some(item) = lock(&queue).next() else { break };
                work(item, worker);
            }
        });
    }
}

fn found<T>(kept: &mut Vec<Map<T>>, cells: usize, channels: usize) -> Option<Map<T>> {
    let at = kept
        .iter()
        .position(|map| (map.columns, map.channels) == (cells, channels));
    at.map(|at| kept.swap_remove(at))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tiles_hold_whole_windows_and_cover_each_cell_once() {
        let window = |side| Window {
            side,
            heads: 1,
            head_width: 1,
        };
        let cases = [
            (vec![2, 4, 8], 256, [8, 16]),
            (vec![2, 4, 8], 24, [8, 8]),
            (vec![2, 3], 36, [6, 18]),
            (vec![1], 7, [1, 7]),
            (vec![32], 64, [32, 32]),
        ];
        for (sides, columns, expected) in cases {
            let windows: Vec<Window> = sides.iter().map(|side| window(*side)).collect();
            let tiles = Tiles::new(&windows, [2 * expected[0], columns]);
            assert_eq!((tiles.tile, tiles.bands()), (expected, 2), "{sides:?}");
            let rows: Vec<usize> = (0..expected[0] * columns * 3).collect();
            let mut seen: Vec<usize> = tiles
                .across()
                .flat_map(|tile| tile.lines(&rows, 3))
                .flatten()
                .copied()
                .collect();
            seen.sort();
            assert_eq!(seen, rows);
        }
    }
}
