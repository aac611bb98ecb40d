use realo_schemas::geometry::{Footprint, iou_exceeds};

const NONE: u32 = u32::MAX;

/// The kept footprints by the cell of their centre; cells are so large that overlapping hulls lie in neighbouring ones.
struct Grid {
    least: [f64; 2],
    per_metre: f64,
    columns: usize,
    rows: usize,
    /// Newest footprint of each cell; a border of empty cells surrounds the others.
    heads: Vec<u32>,
    /// Each with the one kept before it in its cell.
    kept: Vec<(Footprint, u32)>,
}

impl Grid {
    fn new(footprints: &[Footprint], order: &[u32]) -> Self {
        let (mut least, mut greatest, mut reach) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2], 0.0f64);
        for object in order.iter().map(|i| &footprints[*i as usize]) {
            for axis in 0..2 {
                least[axis] = least[axis].min(object.center[axis]);
                greatest[axis] = greatest[axis].max(object.center[axis]);
                reach = reach.max(object.hull[axis]);
            }
        }
        // About four cells a box at most, and a little more than twice the reach, for the rounding of cell indices.
        let side_cells = (4.0 * order.len() as f64 + 16.0).sqrt();
        let span = (greatest[0] - least[0]).max(greatest[1] - least[1]);
        let cell = (2.0 * reach * (1.0 + 1e-6)).max(span / side_cells);
        let per_metre = if cell > 0.0 && cell.is_finite() {
            1.0 / cell
        } else {
            0.0
        };
        let cells = |axis: usize| ((greatest[axis] - least[axis]).max(0.0) * per_metre) as usize + 1;
        let (columns, rows) = (
            cells(0).min(side_cells as usize + 2),
            cells(1).min(side_cells as usize + 2),
        );
        let heads = vec![NONE; (columns + 2) * (rows + 2)];
        Grid {
            least,
            per_metre,
            columns,
            rows,
            heads,
            kept: Vec::with_capacity(order.len()),
        }
    }

    fn cell(&self, object: &Footprint) -> usize {
        // A cast takes NaN to 0 and what is too large to the last cell.
        let index = |axis: usize| ((object.center[axis] - self.least[axis]) * self.per_metre) as usize;
        let (column, row) = (index(0).min(self.columns - 1), index(1).min(self.rows - 1));
        (row + 1) * (self.columns + 2) + column + 1
    }

    fn overlaps_any(&self, cell: usize, object: &Footprint, threshold: f64) -> bool {
        let row = self.columns + 2;
        // Its own cell first, where the overlap is most likely.
        let near = [cell, cell - 1, cell + 1, cell - row, cell + row];
        let far = [cell - row - 1, cell - row + 1, cell + row - 1, cell + row + 1];
        near.into_iter().chain(far).any(|cell| {
            let mut at = self.heads[cell];
            while at != NONE {
                let (kept, before) = &self.kept[at as usize];
                if iou_exceeds(kept, object, threshold) {
                    return true;
                }
                at = *before;
            }
            false
        })
    }

    fn insert(&mut self, cell: usize, object: Footprint) {
        let head = &mut self.heads[cell];
        let before = std::mem::replace(head, self.kept.len() as u32);
        self.kept.push((object, before));
    }
}

pub(crate) fn suppress(footprints: &[Footprint], order: &[u32], threshold: f64) -> Vec<u32> {
    let mut grid = Grid::new(footprints, order);
    let mut kept = Vec::with_capacity(order.len());
    for &candidate in order {
        let object = &footprints[candidate as usize];
        let cell = grid.cell(object);
        if !grid.overlaps_any(cell, object, threshold) {
            grid.insert(cell, *object);
            kept.push(candidate);
        }
    }
    kept
}
