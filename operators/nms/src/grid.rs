use realo_schemas::geometry::{Footprint, iou_exceeds};

const NONE: u32 = u32::MAX;

/// Footprints by the cell of their centre; cells are so large that overlapping hulls lie in neighbouring ones.
struct Grid<'a> {
    footprints: &'a [Footprint],
    min: [f64; 2],
    per_metre: f64,
    columns: usize,
    rows: usize,
    /// Newest footprint of each cell; a border of empty cells surrounds the others.
    heads: Vec<u32>,
    /// What was inserted, each with the place here of the one inserted before it in its cell.
    inserted: Vec<(u32, u32)>,
}

impl<'a> Grid<'a> {
    fn new(footprints: &'a [Footprint], order: &[u32]) -> Self {
        let (mut min, mut max, mut reach) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2], 0.0f64);
        // In order of memory; a few more than `order` names do no harm. Comparisons with NaN leave it out.
        for object in footprints {
            for axis in 0..2 {
                let (center, hull) = (object.center[axis], object.hull[axis]);
                min[axis] = if center < min[axis] { center } else { min[axis] };
                max[axis] = if center > max[axis] { center } else { max[axis] };
                reach = if hull > reach { hull } else { reach };
            }
        }
        // About four cells a box at most, and a little more than twice the reach, for the rounding of cell indices.
        let side_cells = (4.0 * order.len() as f64 + 16.0).sqrt();
        let span = (max[0] - min[0]).max(max[1] - min[1]);
        let cell = (2.0 * reach * (1.0 + 1e-6)).max(span / side_cells);
        let per_metre = if cell > 0.0 && cell.is_finite() {
            1.0 / cell
        } else {
            0.0
        };
        let cells = |axis: usize| ((max[axis] - min[axis]).max(0.0) * per_metre) as usize + 1;
        let (columns, rows) = (
            cells(0).min(side_cells as usize + 2),
            cells(1).min(side_cells as usize + 2),
        );
        let heads = vec![NONE; (columns + 2) * (rows + 2)];
        Grid {
            footprints,
            min,
            per_metre,
            columns,
            rows,
            heads,
            inserted: Vec::with_capacity(order.len()),
        }
    }

    fn cell(&self, object: &Footprint) -> usize {
        // A cast takes NaN to 0 and what is too large to the last cell.
        let index = |axis: usize| ((object.center[axis] - self.min[axis]) * self.per_metre) as u32 as usize;
        let (column, row) = (index(0).min(self.columns - 1), index(1).min(self.rows - 1));
        (row + 1) * (self.columns + 2) + column + 1
    }

    /// The inserted footprints in a cell, where an overlap is most likely, and in the eight around it.
    fn around(&self, cell: usize) -> impl Iterator<Item = u32> {
        let (above, below) = (cell - self.columns - 2, cell + self.columns + 2);
        let cells = [
            cell,
            cell - 1,
            cell + 1,
            above - 1,
            above,
            above + 1,
            below - 1,
            below,
            below + 1,
        ];
        cells.into_iter().flat_map(|cell| {
            // There is none at `NONE`.
            let entry = |at: u32| self.inserted.get(at as usize);
            let entries = std::iter::successors(entry(self.heads[cell]), move |(_, before)| entry(*before));
            entries.map(|(index, _)| *index)
        })
    }

    fn insert(&mut self, cell: usize, index: u32) {
        let head = &mut self.heads[cell];
        let before = std::mem::replace(head, self.inserted.len() as u32);
        self.inserted.push((index, before));
    }
}

pub(crate) fn suppress(footprints: &[Footprint], order: &[u32], threshold: f64) -> Vec<u32> {
    let mut grid = Grid::new(footprints, order);
    let mut kept = Vec::with_capacity(order.len());
    for &candidate in order {
        let object = &footprints[candidate as usize];
        let cell = grid.cell(object);
        let exceeds = |kept: u32| iou_exceeds(&footprints[kept as usize], object, threshold);
        if !grid.around(cell).any(exceeds) {
            grid.insert(cell, candidate);
            kept.push(candidate);
        }
    }
    kept
}

/// Which of some footprints may overlap one of them.
pub(crate) struct Neighbours<'a> {
    order: &'a [u32],
    /// Of the footprints' ranks in the order.
    grid: Grid<'a>,
}

impl<'a> Neighbours<'a> {
    pub fn new(footprints: &'a [Footprint], order: &'a [u32]) -> Self {
        let mut grid = Grid::new(footprints, order);
        for (index, rank) in order.iter().zip(0..) {
            grid.insert(grid.cell(&footprints[*index as usize]), rank);
        }
        Neighbours { order, grid }
    }

    /// Those whose hulls may meet that of footprint `index`, itself among them, in the order.
    pub fn of(&self, index: u32) -> Vec<u32> {
        let mut ranks: Vec<u32> = self
            .grid
            .around(self.grid.cell(&self.grid.footprints[index as usize]))
            .collect();
        ranks.sort_unstable();
        ranks.into_iter().map(|rank| self.order[rank as usize]).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn square(x: f64, y: f64) -> Footprint {
        Footprint::new([x, y], 4.0, 4.0, 0.0)
    }

    fn grid(footprints: &[Footprint]) -> Grid<'_> {
        let order: Vec<u32> = (0..footprints.len() as u32).collect();
        Grid::new(footprints, &order)
    }

    #[test]
    fn cells_are_a_little_wider_than_two_hulls_can_reach() {
        // 100 boxes of reach 2 m over 40 x 12 m.
        let footprints: Vec<Footprint> = (0..100)
            .map(|i| Footprint::new([f64::from(i % 11) * 4.0, f64::from(i % 4) * 4.0], 4.0, 2.0, 0.0))
            .collect();
        let grid = grid(&footprints);
        assert_eq!((grid.columns, grid.rows, grid.heads.len()), (10, 3, 12 * 5));
        assert!(grid.per_metre < 0.25 && grid.per_metre > 0.2499, "{}", grid.per_metre);
        // A border of empty cells on every side.
        let cell = |x: f64, y: f64| grid.cell(&square(x, y));
        assert_eq!([cell(0.0, 0.0), cell(40.0, 12.0)], [12 + 1, 3 * 12 + 10]);
        assert_eq!(
            [cell(4.1, 0.0), cell(3.9, 0.0), cell(0.0, 4.1)],
            [12 + 2, 12 + 1, 2 * 12 + 1]
        );
    }

    #[test]
    fn there_are_about_four_cells_a_box_however_far_apart_they_lie() {
        let corners = [[0.0, 0.0], [1e6, 1e6], [0.0, 1e6], [1e6, 0.0]];
        let footprints = corners.map(|[x, y]| square(x, y));
        let wide = grid(&footprints);
        // The root of 4 * 4 + 16 is 5.7.
        assert_eq!((wide.columns, wide.rows), (6, 6));
        let row = [0.0, 1e6, 2e6, 3e6].map(|y| square(5.0, y));
        let row = grid(&row);
        assert_eq!((row.columns, row.rows), (1, 6));
    }

    #[test]
    fn what_has_no_place_or_extent_gets_the_first_cell() {
        let footprints = [square(f64::NAN, 3.0), square(2.0, 3.0), square(30.0, 3.0)];
        let some = grid(&footprints);
        assert_eq!(some.min, [2.0, 3.0]);
        assert_eq!(some.cell(&footprints[0]), some.cell(&footprints[1]));
        let points = [Footprint::new([7.0, 7.0], 0.0, 0.0, 0.0); 3];
        let points = grid(&points);
        assert_eq!((points.per_metre, points.columns, points.rows), (0.0, 1, 1));
        let none = grid(&[]);
        assert_eq!((none.per_metre, none.columns, none.rows), (0.0, 1, 1));
    }

    #[test]
    fn neighbours_are_found_in_every_direction() {
        // Nine cells of 4 m from (-4, -4) on; one box lies in the middle, the other beside it.
        let far = [square(-4.0, -4.0), square(8.0, 8.0)];
        let at = |step: i32| match step {
            -1 => (0.3, -0.3),
            1 => (3.7, 4.3),
            _ => (2.0, 2.0),
        };
        for (dx, dy) in (-1..=1).flat_map(|dx| (-1..=1).map(move |dy| (dx, dy))) {
            let ((x, beside_x), (y, beside_y)) = (at(dx), at(dy));
            let footprints = [far[0], far[1], square(beside_x, beside_y), square(x, y)];
            let grid = grid(&footprints);
            let cells = [2, 3].map(|i| grid.cell(&footprints[i]) as i64);
            let width = grid.columns as i64 + 2;
            assert_eq!(cells[0] - cells[1], i64::from(dx) + i64::from(dy) * width, "{dx} {dy}");
            assert_eq!(suppress(&footprints, &[0, 1, 2, 3], 0.15), [0, 1, 2], "{dx} {dy}");
        }
    }

    #[test]
    fn all_that_a_cell_holds_is_asked() {
        let mut footprints = vec![square(-40.0, -40.0), square(40.0, 40.0)];
        // Three that do not overlap in one cell, then one on each of them.
        let thin = |x: f64| Footprint::new([x, 2.0], 0.5, 0.5, 0.0);
        footprints.extend([0.5, 1.5, 2.5, 0.6, 1.6, 2.6].map(thin));
        let order: Vec<u32> = (0..8).collect();
        let grid = Grid::new(&footprints, &order);
        let cells: Vec<usize> = footprints[2..].iter().map(|object| grid.cell(object)).collect();
        assert!(cells.iter().all(|cell| *cell == cells[0]), "{cells:?}");
        assert_eq!(suppress(&footprints, &order, 0.15), [0, 1, 2, 3, 4]);
    }
}
