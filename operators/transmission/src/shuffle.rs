//! The byte-shuffle: bytes of the same place in every cell lie together, so that a channel is one run of bytes.

/// Side of the squares that are turned at once.
const TILE: usize = 16;
/// Rows whose squares are turned before those of the next columns: few enough for the cache.
const BLOCK: usize = 256;

type Tile = [[u8; TILE]; TILE];

/// Bytes `[rows, columns]`, turned to `[columns, rows]`; both are as long.
///
/// With the bytes of a cell as columns this shuffles; with the number of cells as columns it puts back.
pub(crate) fn transpose(from: &[u8], columns: usize, to: &mut [u8]) {
    assert!(columns > 0 && from.len().is_multiple_of(columns) && from.len() == to.len());
    let rows = from.len() / columns;
    let (whole_rows, whole_columns) = (rows / TILE * TILE, columns / TILE * TILE);
    for first in (0..whole_rows).step_by(BLOCK) {
        let end = whole_rows.min(first + BLOCK);
        for column in (0..whole_columns).step_by(TILE) {
            for row in (first..end).step_by(TILE) {
                let line = |k: usize| (row + k) * columns + column;
                let tile = turned(std::array::from_fn(|k| {
                    std::array::from_fn(|i| from[line(k)..line(k) + TILE][i])
                }));
                for (k, line) in tile.iter().enumerate() {
                    to[(column + k) * rows + row..][..TILE].copy_from_slice(line);
                }
            }
        }
    }
    for row in 0..rows {
        let rest = if row < whole_rows { whole_columns } else { 0 };
        for column in rest..columns {
            to[column * rows + row] = from[row * columns + column];
        }
    }
}

/// A square turned: weaving its upper half into its lower one four times does it, with two instructions a line.
#[inline(always)]
fn turned(mut tile: Tile) -> Tile {
    for _ in 0..TILE.ilog2() {
        let mut woven = [[0; TILE]; TILE];
        for k in 0..TILE / 2 {
            (woven[2 * k], woven[2 * k + 1]) = weave(&tile[k], &tile[k + TILE / 2]);
        }
        tile = woven;
    }
    tile
}

#[inline(always)]
fn weave(a: &[u8; TILE], b: &[u8; TILE]) -> ([u8; TILE], [u8; TILE]) {
    let half = |from: usize| std::array::from_fn(|i| if i % 2 == 0 { a[from + i / 2] } else { b[from + i / 2] });
    (half(0), half(TILE / 2))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_shape_is_turned_and_turned_back() {
        for (rows, columns) in [
            (1, 1),
            (16, 16),
            (17, 33),
            (300, 20),
            (5, 64),
            (64, 5),
            (512, 48),
            (15, 15),
        ] {
            let from: Vec<u8> = (0..rows * columns).map(|i| (i * 7919 % 251) as u8).collect();
            let (mut to, mut back) = (vec![0; from.len()], vec![0; from.len()]);
            transpose(&from, columns, &mut to);
            for (row, column) in (0..rows).flat_map(|row| (0..columns).map(move |column| (row, column))) {
                assert_eq!(
                    to[column * rows + row],
                    from[row * columns + column],
                    "{rows} × {columns}"
                );
            }
            transpose(&to, rows, &mut back);
            assert_eq!(back, from, "{rows} × {columns}");
        }
        transpose(&[], 3, &mut []);
    }
}
