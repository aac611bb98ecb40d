//! Fewer points of a sweep, evenly spread.

use realo_schemas::PointCloud;

use crate::cell::{NO_CELL, floor, key_of};
use crate::table::CellTable;

/// Points that are prepared at a time, so that the compiler takes several at once.
const BLOCK: usize = 64;

/// One point for each cell of a grid in the body frame: the mean of the cell's points, in order of first appearance; m.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Sample {
    /// Forward.
    pub x: Vec<f32>,
    /// Left.
    pub y: Vec<f32>,
    /// Up.
    pub z: Vec<f32>,
}

impl Sample {
    /// Number of points.
    pub fn len(&self) -> usize {
        self.x.len()
    }

    /// Whether there is no point.
    pub fn is_empty(&self) -> bool {
        self.x.is_empty()
    }

    /// At most about so many of its points, evenly chosen.
    pub(crate) fn thinned(&self, most: usize) -> Sample {
        let every = self.len().div_ceil(most.max(1)).max(1);
        let of = |axis: &[f32]| axis.iter().step_by(every).copied().collect();
        Sample {
            x: of(&self.x),
            y: of(&self.y),
            z: of(&self.z),
        }
    }
}

/// Makes samples; keeps its memory from one to the next.
#[derive(Clone, Debug)]
pub struct Sampler {
    cell_m: f32,
    range_m: [f32; 2],
    table: CellTable,
    /// Of each cell: its corner, cells; sum of the points' places in it, cells; their number.
    cells: Vec<([f32; 3], [f32; 4])>,
}

/// What is known of the points of a block.
struct Block {
    keys: [u64; BLOCK],
    corners: [[f32; BLOCK]; 3],
    places: [[f32; BLOCK]; 3],
}

impl Sampler {
    /// Samples with cells of `cell_m` m; points nearer and farther than `range_m` from the body's origin are left out.
    pub fn new(cell_m: f64, range_m: [f64; 2]) -> Self {
        Sampler {
            cell_m: cell_m as f32,
            range_m: range_m.map(|range| range as f32),
            table: CellTable::with_capacity(1 << 14),
            cells: Vec::new(),
        }
    }

    /// The sample of a sweep; points that are not finite are left out.
    pub fn sample(&mut self, cloud: &PointCloud) -> Sample {
        self.table.clear();
        self.cells.clear();
        let mut block = Block {
            keys: [NO_CELL; BLOCK],
            corners: [[0.0; BLOCK]; 3],
            places: [[0.0; BLOCK]; 3],
        };
        let columns = [&cloud.x[..], &cloud.y[..], &cloud.z[..]];
        // Neighbours of a sweep are mostly in one cell.
        let (mut last, mut place) = (NO_CELL, 0);
        for start in (0..cloud.len()).step_by(BLOCK) {
            let points = columns.map(|column| &column[start..cloud.len().min(start + BLOCK)]);
            self.prepare(points, &mut block);
            for i in 0..points[0].len() {
                let key = block.keys[i];
                if key == NO_CELL {
                    continue;
                }
                if key != last {
                    place = self.table.get_or_insert(key) as usize;
                    last = key;
                    if place == self.cells.len() {
                        self.cells
                            .push((block.corners.each_ref().map(|corner| corner[i]), [0.0; 4]));
                    }
                }
                let [x, y, z, points] = &mut self.cells[place].1;
                *x += block.places[0][i];
                *y += block.places[1][i];
                *z += block.places[2][i];
                *points += 1.0;
            }
        }
        let column = |axis: usize| {
            let mean = |(corner, sums): &([f32; 3], [f32; 4])| (corner[axis] + sums[axis] / sums[3]) * self.cell_m;
            self.cells.iter().map(mean).collect()
        };
        Sample {
            x: column(0),
            y: column(1),
            z: column(2),
        }
    }

    /// Cells of up to [`BLOCK`] points, and the points' places in them.
    fn prepare(&self, [x, y, z]: [&[f32]; 3], block: &mut Block) {
        let per_m = 1.0 / self.cell_m;
        let [near, far] = self.range_m.map(|range| range * range);
        for (i, ((x, y), z)) in x.iter().zip(y).zip(z).enumerate().take(BLOCK) {
            let square = x * x + y * y + z * z;
            // Both are false for what is not a number.
            let inside = (square >= near) & (square <= far);
            let at = [x * per_m, y * per_m, z * per_m];
            let cell = at.map(floor);
            block.keys[i] = if inside { key_of(cell) } else { NO_CELL };
            for axis in 0..3 {
                block.corners[axis][i] = cell[axis] as f32;
                block.places[axis][i] = at[axis] - cell[axis] as f32;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use damage::Draw;

    use super::*;

    fn cloud(points: &[[f32; 3]]) -> PointCloud {
        let column = |i: usize| points.iter().map(|point| point[i]).collect::<Vec<f32>>();
        let n = points.len();
        PointCloud::new(column(0), column(1), column(2), vec![0; n], vec![0; n], vec![0; n]).unwrap()
    }

    #[test]
    fn each_cell_gives_the_mean_of_its_points_in_order_of_first_appearance() {
        let points = [
            [10.2, -3.5, 0.5],
            [-4.5, 0.5, 0.25],
            [10.4, -3.5, 0.5],
            [f32::NAN, 0.0, 5.0],
            [f32::INFINITY, 0.0, 5.0],
            [0.5, 0.0, 0.0],
            [10.6, -3.8, 0.5],
            [0.0, 90.0, 0.0],
        ];
        let sample = Sampler::new(1.0, [2.0, 80.0]).sample(&cloud(&points));
        assert_eq!(sample.len(), 2);
        for (found, expected) in [
            (&sample.x, [10.4, -4.5]),
            (&sample.y, [-3.6, 0.5]),
            (&sample.z, [0.5, 0.25]),
        ] {
            assert!(
                found.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-5),
                "{sample:?}"
            );
        }
        assert!(Sampler::new(1.0, [2.0, 80.0]).sample(&PointCloud::empty()).is_empty());
    }

    #[test]
    fn a_sample_does_not_depend_on_the_one_before() {
        let mut draw = Draw::new(5);
        let mut random = |n: usize| -> PointCloud {
            let mut point = || [(); 3].map(|()| draw.below(80_000) as f32 * 1e-3 - 40.0);
            cloud(&(0..n).map(|_| point()).collect::<Vec<_>>())
        };
        let (one, other) = (random(5000), random(3001));
        let mut sampler = Sampler::new(0.5, [2.0, 80.0]);
        let first = sampler.sample(&one);
        sampler.sample(&other);
        assert_eq!(sampler.sample(&one), first);
        let cells = |sample: &Sample| {
            let each = sample.x.iter().zip(&sample.y).zip(&sample.z);
            let mut all: Vec<_> = each
                .map(|((x, y), z)| [x, y, z].map(|v| (v * 2.0).floor() as i32))
                .collect();
            all.sort_unstable();
            all.dedup();
            all.len()
        };
        assert_eq!(cells(&first), first.len());
    }
}
