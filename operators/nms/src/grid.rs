use realo_schemas::geometry::{Footprint, iou_exceeds};

const NONE: u32 = u32::MAX;

/// The kept footprints by the cell of their centre; cells are so large that overlapping hulls lie in neighbouring ones.
struct Grid<'a> {
    footprints: &'a [Footprint],
    least: [f64; 2],
    per_metre: f64,
    columns: usize,
    rows: usize,
    /// Newest footprint of each cell; a border of empty cells surrounds the others.
    heads: Vec<u32>,
    /// Indices of the kept footprints, each with the place here of the one kept before it in its cell.
    kept: Vec<(u32, u32)>,
}

impl<'a> Grid<'a> {
    fn new(footprints: &'a [Footprint], order: &[u32]) -> Self {
        let (mut least, mut greatest, mut reach) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2], 0.0f64);
        // In order of memory; a few more than `order` names do no harm. Comparisons with NaN leave it out.
        for object in footprints {
            for axis in 0..2 {
                let (center, hull) = (object.center[axis], object.hull[axis]);
                least[axis] = if center < least[axis] { center } else { least[axis] };
                greatest[axis] = if center > greatest[axis] {
                    center
                } else {
                    greatest[axis]
                };
                reach = if hull > reach { hull } else { reach };
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
            footprints,
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
        let index = |axis: usize| ((object.center[axis] - self.least[axis]) * self.per_metre) as u32 as usize;
        let (column, row) = (index(0).min(self.columns - 1), index(1).min(self.rows - 1));
        (row + 1) * (self.columns + 2) + column + 1
    }

    fn overlaps_any(&self, cell: usize, object: &Footprint, threshold: f64) -> bool {
        let row = self.columns + 2;
        let overlaps_one_of = |cell: usize| {
            let mut at = self.heads[cell];
            while at != NONE {
                let (kept, before) = self.kept[at as usize];
                if iou_exceeds(&self.footprints[kept as usize], object, threshold) {
                    return true;
                }
                at = before;
            }
            false
        };
        // Its own cell first, where an overlap is most likely.
        overlaps_one_of(cell)
            || [cell - 1, cell + 1].into_iter().any(overlaps_one_of)
            || (cell - row - 1..=cell - row + 1).any(overlaps_one_of)
            || (cell + row - 1..=cell + row + 1).any(overlaps_one_of)
    }

    fn insert(&mut self, cell: usize, index: u32) {
        let head = &mut self.heads[cell];
        let before = std::mem::replace(head, self.kept.len() as u32);
        self.kept.push((index, before));
    }
}

pub(crate) fn suppress(footprints: &[Footprint], order: &[u32], threshold: f64) -> Vec<u32> {
    let mut grid = Grid::new(footprints, order);
    let mut kept = Vec::with_capacity(order.len());
    for &candidate in order {
        let object = &footprints[candidate as usize];
        let cell = grid.cell(object);
        if !grid.overlaps_any(cell, object, threshold) {
            grid.insert(cell, candidate);
            kept.push(candidate);
        }
    }
    kept
}
