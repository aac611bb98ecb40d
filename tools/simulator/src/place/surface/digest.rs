//! What whole cells are, so that most points are answered at once.

use super::field::Field;
use super::{CELL, Ground};

/// Bits of a cell's digest: on which side of the kerb all of it lies, what all of it is made of, whether there is paint.
pub(super) const RAISED: u8 = 1;

pub(super) const RAISED_MIXED: u8 = 3;

pub(super) const ASPHALT: u8 = 0;

pub(super) const PAVING: u8 = 4;

pub(super) const GREEN: u8 = 8;

pub(super) const GROUND_MIXED: u8 = 12;

pub(super) const PAINTED: u8 = 16;

/// The digests of the cells that four cells of `kerb` and `ground` make up.
pub(super) fn digest(kerb: &Field<f32>, ground: &Field<Ground>, starts: &Field<u32>) -> Field<u8> {
    const TIMES: usize = (1.0 / CELL) as usize;
    let mut digest = Field {
        x: kerb.x,
        y: kerb.y,
        cell: 1.0,
        columns: (kerb.columns - 1) / TIMES,
        rows: (kerb.rows - 1) / TIMES,
        values: Vec::new(),
    };
    for cell in 0..digest.columns * digest.rows {
        let (column, row) = (cell % digest.columns * TIMES, cell / digest.columns * TIMES);
        let nodes = (row..=row + TIMES).flat_map(|r| (column..=column + TIMES).map(move |c| r * kerb.columns + c));
        let (mut sides, mut kinds) = ([false; 2], [false; 3]);
        for node in nodes {
            sides[usize::from(kerb.values[node] > 0.0)] = true;
            kinds[ground.values[node] as usize] = true;
        }
        let side = match sides {
            [true, true] => RAISED_MIXED,
            [_, raised] => u8::from(raised),
        };
        let kind = match kinds {
            [true, false, false] => ASPHALT,
            [false, true, false] => PAVING,
            [false, false, true] => GREEN,
            _ => GROUND_MIXED,
        };
        let (x, y) = digest.node(cell);
        let paint = starts
            .find(x + 0.5, y + 0.5)
            .is_some_and(|(i, ..)| starts.values[i] < starts.values[i + 1]);
        digest.values.push(side | kind | if paint { PAINTED } else { 0 });
    }
    digest
}
