//! Points to pillars: the upright columns of a sweep's grid that hold points (PointPillars, Lang et al. 2019, Sec. 2.1;
//! the cell and the order of points as in the CPU voxeliser of spconv, which V2X-Real uses).

use realo_kernels::simd::dispatch;
use realo_nn::model::Grid;

/// Points of one frame, in columns of equal length.
#[derive(Clone, Copy, Debug)]
pub struct Points<'a> {
    /// Metres, forward.
    pub x: &'a [f32],
    /// Metres, left.
    pub y: &'a [f32],
    /// Metres, up.
    pub z: &'a [f32],
    /// Reflected intensity in the network's scale; 0 where there is none.
    pub intensity: Option<&'a [f32]>,
}

impl Points<'_> {
    fn at(&self, i: usize) -> [f32; 4] {
        let intensity = self.intensity.map_or(0.0, |intensity| intensity[i]);
        [self.x[i], self.y[i], self.z[i], intensity]
    }

    fn assert_columns_agree(&self) {
        let others = [
            self.y.len(),
            self.z.len(),
            self.intensity.map_or(self.x.len(), <[f32]>::len),
        ];
        assert_eq!(others, [self.x.len(); 3], "columns of points differ in length");
    }
}

/// What became of the points that no pillar took.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Dropped {
    /// Points with a number that is NaN or infinite.
    pub not_finite: u64,
    /// Points outside the grid.
    pub out_of_range: u64,
    /// Points that came after the last that their pillar takes.
    pub over_points: u64,
    /// Points of pillars beyond the largest number of pillars.
    pub over_pillars: u64,
}

/// The pillars of one sweep, without padding.
#[derive(Clone, Debug, PartialEq)]
pub struct Pillars {
    /// Each pillar's cell, `row * columns + column`, in the order in which points first touched them.
    pub cells: Vec<u32>,
    /// Where each pillar's points begin, and after the last pillar where they end.
    pub starts: Vec<u32>,
    /// x, y, z (m) and intensity, by pillar, inside a pillar in scan order.
    pub points: Vec<[f32; 4]>,
    /// What was left out.
    pub dropped: Dropped,
}

impl Pillars {
    /// No pillars.
    pub fn empty() -> Self {
        Pillars {
            cells: Vec::new(),
            starts: vec![0],
            points: Vec::new(),
            dropped: Dropped::default(),
        }
    }

    /// Number of pillars.
    pub fn len(&self) -> usize {
        self.cells.len()
    }

    /// Whether there is no pillar.
    pub fn is_empty(&self) -> bool {
        self.cells.is_empty()
    }

    /// The points of a pillar.
    pub fn points_of(&self, pillar: usize) -> &[[f32; 4]] {
        &self.points[self.starts[pillar] as usize..self.starts[pillar + 1] as usize]
    }
}

/// Sorts points into pillars; its buffers serve one sweep after another.
#[derive(Clone, Debug)]
pub struct Pillariser {
    lattice: Lattice,
    max_points: u32,
    max_pillars: u32,
    /// For each cell `stamp` + its pillar in the present sweep; less than `stamp` is of an earlier sweep.
    index: Vec<u32>,
    stamp: u32,
    /// For each point its cell, then its pillar.
    place: Vec<u32>,
    /// For each pillar the number of its points, then where its next point goes.
    cursors: Vec<u32>,
    pillars: Pillars,
}

impl Pillariser {
    /// Takes the first `max_points` points in scan order of each of the first `max_pillars` pillars, from strictly inside
    /// the grid's volume.
    pub fn new(grid: &Grid, max_points: usize, max_pillars: usize) -> Self {
        let lattice = Lattice::new(grid);
        let cells = lattice.rows as usize * lattice.columns as usize;
        Pillariser {
            lattice,
            max_points: u32::try_from(max_points).unwrap_or(u32::MAX),
            max_pillars: max_pillars.min(cells) as u32,
            index: vec![0; cells],
            stamp: 1,
            place: Vec::new(),
            cursors: Vec::new(),
            pillars: Pillars::empty(),
        }
    }

    /// The pillars of a sweep. They stay until the next one.
    ///
    /// # Panics
    /// If the columns differ in length.
    pub fn run(&mut self, points: &Points) -> &Pillars {
        points.assert_columns_agree();
        self.place.resize(points.x.len(), NOWHERE);
        locate(&self.lattice, points, &mut self.place);
        self.assign(points);
        self.gather(points);
        &self.pillars
    }

    /// From each point's cell to its pillar, and the number of points of each pillar.
    fn assign(&mut self, points: &Points) {
        self.renew();
        let Pillariser {
            index, stamp, cursors, ..
        } = self;
        let cells = &mut self.pillars.cells;
        let mut dropped = Dropped::default();
        for (i, place) in self.place.iter_mut().enumerate() {
            let cell = std::mem::replace(place, NOWHERE);
            let intensity_is_finite = points.intensity.is_none_or(|intensity| intensity[i].is_finite());
            if cell == NOWHERE || !intensity_is_finite {
                let finite = points.at(i).iter().all(|number| number.is_finite());
                *(if finite {
                    &mut dropped.out_of_range
                } else {
                    &mut dropped.not_finite
                }) += 1;
                continue;
            }
            let entry = &mut index[cell as usize];
            let mut pillar = entry.wrapping_sub(*stamp);
            if pillar >= cells.len() as u32 {
                if cells.len() as u32 == self.max_pillars {
                    dropped.over_pillars += 1;
                    continue;
                }
                pillar = cells.len() as u32;
                *entry = *stamp + pillar;
                cells.push(cell);
                cursors.push(0);
            }
            let count = &mut cursors[pillar as usize];
            if *count == self.max_points {
                dropped.over_points += 1;
                continue;
            }
            *count += 1;
            *place = pillar;
        }
        self.pillars.dropped = dropped;
    }

    /// Makes every entry of the index one of an earlier sweep.
    fn renew(&mut self) {
        let next = self.stamp.checked_add(self.pillars.len() as u32);
        self.stamp = next
            .filter(|stamp| *stamp <= u32::MAX - self.max_pillars)
            .unwrap_or_else(|| {
                self.index.fill(0);
                1
            });
        self.pillars.cells.clear();
        self.cursors.clear();
    }

    /// Copies points to their pillars.
    fn gather(&mut self, points: &Points) {
        let Pillars {
            starts, points: kept, ..
        } = &mut self.pillars;
        starts.clear();
        let mut end = 0;
        for cursor in &mut self.cursors {
            starts.push(end);
            end += std::mem::replace(cursor, end);
        }
        starts.push(end);
        // What is there is overwritten: every place gets a point.
        kept.resize(end as usize, [0.0; 4]);
        for (i, pillar) in self.place.iter().enumerate() {
            if *pillar != NOWHERE {
                let cursor = &mut self.cursors[*pillar as usize];
                kept[*cursor as usize] = points.at(i);
                *cursor += 1;
            }
        }
    }
}

const NOWHERE: u32 = u32::MAX;

/// The grid in single precision, in which cells are defined.
#[derive(Clone, Debug)]
struct Lattice {
    rows: u32,
    columns: u32,
    /// Lower limits of x, y, z, m.
    min: [f32; 3],
    /// Extent of a cell along x, y, z, m.
    size: [f32; 3],
    /// Upper limits of x, y, z, m.
    limit: [f32; 3],
}

impl Lattice {
    fn new(grid: &Grid) -> Self {
        let axes = [grid.x, grid.y, grid.z];
        Lattice {
            rows: grid.rows() as u32,
            columns: grid.columns() as u32,
            min: axes.map(|[from, _]| from as f32),
            size: [grid.cell as f32, grid.cell as f32, (grid.z[1] - grid.z[0]) as f32],
            limit: axes.map(|[_, to]| to as f32),
        }
    }
}

dispatch! {
    /// Each point's cell, or `NOWHERE`. Divides, because the product with a reciprocal puts points near a border into
    /// other cells.
    fn locate(lattice: &Lattice, points: &Points, cells: &mut [u32]) {
        let n = cells.len();
        let (columns, rows) = (lattice.columns as f32, lattice.rows as f32);
        let (x, y, z) = (&points.x[..n], &points.y[..n], &points.z[..n]);
        for (i, place) in cells.iter_mut().enumerate() {
            let (column, in_x) = lattice.along(0, x[i], columns);
            let (row, in_y) = lattice.along(1, y[i], rows);
            let (_, in_z) = lattice.along(2, z[i], 1.0);
            let cell = (row as i32 as u32).wrapping_mul(lattice.columns).wrapping_add(column as i32 as u32);
            *place = if in_x & in_y & in_z { cell } else { NOWHERE };
        }
    }
}

impl Lattice {
    /// The cell of a coordinate along an axis of `count` cells, with its fraction, and whether it is inside.
    #[inline(always)]
    fn along(&self, axis: usize, value: f32, count: f32) -> (f32, bool) {
        let distance = value - self.min[axis];
        let cell = distance / self.size[axis];
        // False for NaN.
        let inside = (distance > 0.0) & (value < self.limit[axis]) & (cell < count);
        (cell, inside)
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use proptest::prelude::*;

    use super::*;
    use crate::vectors::Vector;

    const GRID: Grid = Grid {
        x: [-2.0, 2.0],
        y: [-1.0, 1.0],
        z: [-1.0, 3.0],
        cell: 0.5,
    };

    type Columns = [Vec<f32>; 4];

    fn columns(points: &[[f32; 4]]) -> Columns {
        std::array::from_fn(|axis| points.iter().map(|point| point[axis]).collect())
    }

    fn run(pillariser: &mut Pillariser, points: &[[f32; 4]]) -> Pillars {
        let [x, y, z, intensity] = &columns(points);
        let intensity = Some(&intensity[..]);
        pillariser.run(&Points { x, y, z, intensity }).clone()
    }

    /// The definition, with a map from cell to points.
    fn plain(grid: &Grid, points: &[[f32; 4]], max_points: usize, max_pillars: usize) -> Pillars {
        let (mut order, mut cells) = (Vec::new(), BTreeMap::<u32, Vec<[f32; 4]>>::new());
        let mut dropped = Dropped::default();
        for point in points {
            if point.iter().any(|number| !number.is_finite()) {
                dropped.not_finite += 1;
                continue;
            }
            let inside = [grid.x, grid.y, grid.z]
                .iter()
                .zip(point)
                .all(|([from, to], value)| *value > *from as f32 && *value < *to as f32);
            let size = grid.cell as f32;
            let column = ((point[0] - grid.x[0] as f32) / size).floor();
            let row = ((point[1] - grid.y[0] as f32) / size).floor();
            let level = ((point[2] - grid.z[0] as f32) / (grid.z[1] - grid.z[0]) as f32).floor();
            if !inside || column >= grid.columns() as f32 || row >= grid.rows() as f32 || level >= 1.0 {
                dropped.out_of_range += 1;
                continue;
            }
            let cell = row as u32 * grid.columns() as u32 + column as u32;
            if !cells.contains_key(&cell) {
                if order.len() == max_pillars {
                    dropped.over_pillars += 1;
                    continue;
                }
                order.push(cell);
            }
            let pillar = cells.entry(cell).or_default();
            if pillar.len() == max_points {
                dropped.over_points += 1;
            } else {
                pillar.push(*point);
            }
        }
        let mut pillars = Pillars::empty();
        for cell in order {
            pillars.points.extend(&cells[&cell]);
            pillars.cells.push(cell);
            pillars.starts.push(pillars.points.len() as u32);
        }
        pillars.dropped = dropped;
        pillars
    }

    #[test]
    fn reference_vectors_are_met_exactly() {
        for case in ["basic", "point_limit", "voxel_limit"] {
            let vector = Vector::open(&format!("pillars/voxelize_{case}.safetensors"));
            let (grid, slots) = (
                crate::testing::grid_of(&vector),
                vector.number("max_points_per_voxel") as usize,
            );
            let mut pillariser = Pillariser::new(&grid, slots, vector.number("max_voxels") as usize);
            let found = run(&mut pillariser, &vector.rows::<4>("in.points"));
            let coordinates = vector.rows_f64::<3>("out.coords_zyx");
            let cells = coordinates
                .iter()
                .map(|[_, y, x]| (*y as u32) * grid.columns() as u32 + *x as u32);
            assert_eq!(found.cells, cells.collect::<Vec<_>>(), "{case}");
            let (counts, voxels) = (vector.f64("out.num_points"), vector.rows::<4>("out.voxels"));
            for (pillar, count) in counts.iter().enumerate() {
                let expected = &voxels[pillar * slots..][..*count as usize];
                assert_eq!(found.points_of(pillar), expected, "{case}: pillar {pillar}");
            }
            assert!(found.len() > 10, "{case}");
        }
    }

    #[test]
    fn counts_what_it_drops_by_cause() {
        let p = |x: f32, y: f32, z: f32| [x, y, z, 0.5];
        let mut points = vec![
            p(f32::NAN, 0.0, 0.0),
            p(0.1, f32::INFINITY, 0.0),
            p(0.1, 0.1, f32::NAN),
            [0.1, 0.1, 0.1, f32::NAN],
            p(-2.0, 0.0, 0.0),
            p(2.0, 0.0, 0.0),
            p(0.0, 0.0, 3.5),
        ];
        points.extend([p(0.1, 0.1, 0.0); 5]);
        points.extend([p(0.6, 0.1, 0.0); 2]);
        points.extend([p(1.1, 0.1, 0.0); 2]);
        let pillars = run(&mut Pillariser::new(&GRID, 3, 2), &points);
        let expected = Dropped {
            not_finite: 4,
            out_of_range: 3,
            over_points: 2,
            over_pillars: 2,
        };
        assert_eq!(
            (pillars.len(), pillars.starts.as_slice(), pillars.dropped),
            (2, &[0, 3, 5][..], expected)
        );
    }

    #[test]
    fn an_empty_cloud_and_a_single_point_give_no_and_one_pillar() {
        let mut pillariser = Pillariser::new(&GRID, 32, 100);
        assert_eq!(run(&mut pillariser, &[]), Pillars::empty());
        let one = run(&mut pillariser, &[[1.9, 0.9, 0.0, 1.0]]);
        assert_eq!(
            (one.cells, one.starts, one.points),
            (vec![31], vec![0, 1], vec![[1.9, 0.9, 0.0, 1.0]])
        );
        let [x, y, z, _] = columns(&[[0.1, 0.1, 0.1, 9.0]]);
        let intensity = None;
        let blind = pillariser.run(&Points {
            x: &x,
            y: &y,
            z: &z,
            intensity,
        });
        assert_eq!(blind.points, [[0.1, 0.1, 0.1, 0.0]]);
    }

    #[test]
    fn sweeps_do_not_see_each_other_even_when_stamps_run_out() {
        let mut pillariser = Pillariser::new(&GRID, 2, 100);
        pillariser.stamp = u32::MAX - 70;
        let points: Vec<[f32; 4]> = (0..40).map(|i| [i as f32 * 0.1 - 1.99, 0.3, 0.0, 0.0]).collect();
        let first = run(&mut Pillariser::new(&GRID, 2, 100), &points);
        for _ in 0..20 {
            assert_eq!(run(&mut pillariser, &points), first);
        }
        assert!(pillariser.stamp < 1000, "{}", pillariser.stamp);
    }

    proptest! {
        #[test]
        fn is_the_plain_definition(
            sweeps in prop::collection::vec(
                prop::collection::vec((-2.3f32..2.3, -1.2f32..1.2, -1.2f32..3.2, 0f32..1.0), 0..200), 1..4),
            max_points in 1usize..6,
            max_pillars in 1usize..40,
        ) {
            let mut pillariser = Pillariser::new(&GRID, max_points, max_pillars);
            for sweep in sweeps {
                // Half of the points lie on cells' borders.
                let snap = |i: usize, v: f32| if i.is_multiple_of(2) { (v * 2.0).round() / 2.0 } else { v };
                let points: Vec<[f32; 4]> =
                    sweep.iter().enumerate().map(|(i, p)| [snap(i, p.0), snap(i, p.1), p.2, p.3]).collect();
                prop_assert_eq!(run(&mut pillariser, &points), plain(&GRID, &points, max_points, max_pillars));
            }
        }
    }
}
