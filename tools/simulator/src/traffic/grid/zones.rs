//! Which parts of the junction a way takes up: sets of half-metre cells.

use crate::path::Path;

const CELL: f64 = 0.5;
const SIDE: usize = 112;
/// Step along a path, m.
const STEP: f64 = 0.25;
const HALF: f64 = CELL * SIDE as f64 / 2.0;

/// A set of cells around the centre; whoever holds one keeps others out.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Zone(Vec<u64>);

impl Zone {
    /// The cells whose middle lies within `reach` of a path between two distances.
    pub fn along(path: &Path, from: f64, to: f64, reach: f64) -> Self {
        let mut bits = vec![0; SIDE * SIDE / 64];
        let middle = |i: usize| (i as f64 + 0.5) * CELL - HALF;
        let around = |v: f64| {
            let first = ((v - reach + HALF) / CELL).floor().clamp(0.0, SIDE as f64) as usize;
            let last = ((v + reach + HALF) / CELL).ceil().clamp(0.0, SIDE as f64) as usize;
            first..last
        };
        let steps = ((to - from) / STEP).ceil() as usize;
        for k in 0..=steps {
            let point = path.at((from + k as f64 * STEP).min(to)).0;
            for j in around(point.y) {
                for i in around(point.x) {
                    let (dx, dy) = (middle(i) - point.x, middle(j) - point.y);
                    if dx * dx + dy * dy < reach * reach {
                        let index = j * SIDE + i;
                        bits[index / 64] |= 1 << (index % 64);
                    }
                }
            }
        }
        Zone(bits)
    }

    pub fn meets(&self, other: &Zone) -> bool {
        self.0.iter().zip(&other.0).any(|(a, b)| a & b != 0)
    }
}
