//! Where points beside a line are: how far along it and aside.

use super::field::Field;
use crate::path::Path;

/// How far beyond its pavements a road is felt, m.
pub(super) const BESIDE: f64 = 1.5;

/// Where a point lies along a road: square of its distance from the line, distance along it, offset.
#[derive(Clone, Copy)]
pub(super) struct Beside {
    square: f32,
    pub along: f32,
    pub across: f32,
}

const AWAY: Beside = Beside {
    square: f32::INFINITY,
    along: 0.0,
    across: 0.0,
};

/// The places along a line of the nodes around it: a part of a greater grid.
pub(super) struct Ribbon {
    pub field: Field<Beside>,
    /// First column and row of the part.
    first: [usize; 2],
}

impl Ribbon {
    /// The nodes that are near the line: their numbers in the greater grid, and their places.
    pub(super) fn found<'a, T: Copy>(&'a self, grid: &Field<T>) -> impl Iterator<Item = (usize, Beside)> + use<'a, T> {
        let (columns, [c0, r0]) = (grid.columns, self.first);
        self.field.values.iter().enumerate().filter_map(move |(i, place)| {
            let (column, row) = (i % self.field.columns + c0, i / self.field.columns + r0);
            place.square.is_finite().then_some((row * columns + column, *place))
        })
    }
}

/// The places of the nodes of a grid along a line, as far as `reach` beside it.
pub(super) fn beside(line: &Path, bounds: [f64; 4], cell: f64, reach: f64) -> Ribbon {
    const STEP: f64 = 2.0;
    let count = (line.length() / STEP).ceil() as usize;
    let samples: Vec<_> = (0..=count)
        .map(|k| (k as f64 * STEP).min(line.length()))
        .map(|s| (s, line.at(s)))
        .collect();
    let mut own = [f64::MAX, f64::MAX, f64::MIN, f64::MIN];
    for (_, (pose, _)) in &samples {
        own = [
            own[0].min(pose.x - reach),
            own[1].min(pose.y - reach),
            own[2].max(pose.x + reach),
            own[3].max(pose.y + reach),
        ];
    }
    // Nodes of the part are nodes of the whole.
    let first = [0, 1].map(|k| ((own[k] - bounds[k]) / cell).floor().max(0.0) as usize);
    for k in 0..2 {
        own[k] = bounds[k] + first[k] as f64 * cell;
        own[k + 2] = own[k + 2].min(bounds[k + 2] - 2.0 * cell);
    }
    let mut field = Field::new(own, cell, AWAY);
    for (s, (pose, curvature)) in samples {
        let (sin, cos) = libm::sincos(pose.heading);
        let [c0, c1, r0, r1] = field.around(pose.x, pose.y, reach);
        for row in r0..r1 {
            for column in c0..c1 {
                let i = row * field.columns + column;
                let (x, y) = field.node(i);
                let (dx, dy) = (x - pose.x, y - pose.y);
                let square = (dx * dx + dy * dy) as f32;
                if square < field.values[i].square {
                    let (ahead, aside) = (dx * cos + dy * sin, dy * cos - dx * sin);
                    // The line bends away from the tangent by so much.
                    let scale = 1.0 - curvature * aside;
                    let bent = 0.5 * curvature * ahead * ahead / scale.max(0.3);
                    field.values[i] = Beside {
                        square,
                        along: (s + ahead / scale.max(0.3)) as f32,
                        across: (aside - bent) as f32,
                    };
                }
            }
        }
    }
    Ribbon { field, first }
}
