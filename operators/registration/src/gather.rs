//! Finds the voxels of points at a pose, and makes rows of the distances between them.

use nalgebra::{Isometry3, Point3};

use crate::cell::{NO_CELL, STEPS, floor, key_of};
use crate::map::VoxelMap;
use crate::rows::{Rows, Sums};
use crate::voxel::Record;

/// Points of a chunk: sums are made of each by itself, whoever computes it.
pub(crate) const CHUNK: usize = 1024;
/// A plane is horizontal if its normal is at most 25° from the vertical: cosine.
const HORIZONTAL: f32 = 0.906;

/// Neighbours of a cell that may hold a point's surface: itself, and one cell up and down each axis.
const NEIGHBOURS: [(u64, [f32; 3]); 7] = [
    (0, [0.0, 0.0, 0.0]),
    (STEPS[0], [1.0, 0.0, 0.0]),
    (STEPS[0].wrapping_neg(), [-1.0, 0.0, 0.0]),
    (STEPS[1], [0.0, 1.0, 0.0]),
    (STEPS[1].wrapping_neg(), [0.0, -1.0, 0.0]),
    (STEPS[2], [0.0, 0.0, 1.0]),
    (STEPS[2].wrapping_neg(), [0.0, 0.0, -1.0]),
];

/// A pose on a map, in f32 near 0: how the body is turned, the cell where it is, and where in that cell.
pub(crate) struct Placed {
    /// By rows.
    rotation: [[f32; 3]; 3],
    cell: [i32; 3],
    /// m.
    in_cell: [f32; 3],
    size: f32,
    per_m: f32,
}

/// How distances count.
#[derive(Clone, Copy)]
pub(crate) struct Kernel {
    /// Width of the Geman-McClure kernel, m.
    pub width: f32,
    /// Points within this are inliers, m.
    pub inlier: f32,
    /// Whether distributions in neighbouring voxels count, rather than the surface in the point's own.
    pub is_wide: bool,
}

impl Placed {
    /// A pose on a map; `None` where cells have no keys.
    pub fn new(map: &VoxelMap, map_from_body: &Isometry3<f64>) -> Option<Self> {
        let size = map.info().voxel_m;
        let place = (Point3::from(map_from_body.translation.vector) - map.info().origin) / size;
        let cell = place.map(f64::floor);
        // False for what is not a number too.
        if !cell.iter().all(|number| number.abs() < f64::from(1 << 20)) {
            return None;
        }
        let rotation = map_from_body.rotation.to_rotation_matrix();
        Some(Placed {
            rotation: std::array::from_fn(|i| std::array::from_fn(|j| rotation[(i, j)] as f32)),
            cell: cell.map(|number| number as i32).into(),
            in_cell: ((place - cell) * size).map(|part| part as f32).into(),
            size: size as f32,
            per_m: (1.0 / size) as f32,
        })
    }
}

/// Points of a chunk on the map.
struct Moved {
    /// From the body's origin in the map's axes, m.
    points: [[f32; CHUNK]; 3],
    keys: [u64; CHUNK],
    /// From the lower corner of their cells, cells.
    in_cells: [[f32; CHUNK]; 3],
}

impl Moved {
    fn new(placed: &Placed, [x, y, z]: [&[f32]; 3]) -> Self {
        let mut moved = Moved {
            points: [[0.0; CHUNK]; 3],
            keys: [NO_CELL; CHUNK],
            in_cells: [[0.0; CHUNK]; 3],
        };
        for (i, ((x, y), z)) in x.iter().zip(y).zip(z).enumerate().take(CHUNK) {
            let mut cell = [0; 3];
            for (axis, cell) in cell.iter_mut().enumerate() {
                let [a, b, c] = placed.rotation[axis];
                let point = a * x + b * y + c * z;
                let at = (point + placed.in_cell[axis]) * placed.per_m;
                let whole = floor(at);
                moved.points[axis][i] = point;
                moved.in_cells[axis][i] = at - whole as f32;
                *cell = whole.wrapping_add(placed.cell[axis]);
            }
            moved.keys[i] = key_of(cell);
        }
        moved
    }
}

/// The sums of up to [`CHUNK`] points at a pose.
pub(crate) fn gather(map: &VoxelMap, placed: &Placed, points: [&[f32]; 3], kernel: &Kernel) -> Sums {
    let moved = Moved::new(placed, points);
    let (mut rows, mut sums) = (Rows::new(), Sums::default());
    for i in 0..points[0].len() {
        let key = moved.keys[i];
        if key == NO_CELL {
            continue;
        }
        let point = Matched {
            // By reference: these are 12 KB each, and would be copied.
            point: moved.points.each_ref().map(|axis| axis[i]),
            in_cell: moved.in_cells.each_ref().map(|axis| axis[i]),
        };
        match kernel.is_wide {
            false => point.near(map, placed, key, kernel, &mut rows, &mut sums),
            true => point.wide(map, placed, key, kernel, &mut rows, &mut sums),
        }
    }
    rows.flush(&mut sums);
    sums
}

/// A point whose surface is looked for.
struct Matched {
    /// From the body's origin in the map's axes, m.
    point: [f32; 3],
    /// From the lower corner of its cell, cells.
    in_cell: [f32; 3],
}

impl Matched {
    /// The surface in the point's own voxel: the plane, or else the distribution.
    #[inline]
    fn near(&self, map: &VoxelMap, placed: &Placed, key: u64, kernel: &Kernel, rows: &mut Rows, sums: &mut Sums) {
        let Some(record) = record_of(map, key) else { return };
        let off = self.off(record, placed, [0.0; 3]);
        if record.is_planar() {
            let normal = record.normal();
            let distance = dot(normal, off);
            let weight = kernel.root_weight(distance * distance);
            rows.push(normal, self.point, distance, weight, sums);
            self.count(distance * distance, weight, kernel, sums);
            let is_inlier = distance.abs() < kernel.inlier;
            sums.on_ground += u32::from(is_inlier && normal[2].abs() > HORIZONTAL);
        } else {
            let square = self.distribution(record, off, kernel, rows, sums);
            self.count(square, kernel.root_weight(square), kernel, sums);
        }
    }

    /// The distributions in the point's voxel and in its neighbours; the nearest of them tells whether it is an inlier.
    fn wide(&self, map: &VoxelMap, placed: &Placed, key: u64, kernel: &Kernel, rows: &mut Rows, sums: &mut Sums) {
        let mut nearest = f32::INFINITY;
        for (step, corner) in NEIGHBOURS {
            let Some(record) = record_of(map, key.wrapping_add(step)) else {
                continue;
            };
            let off = self.off(record, placed, corner);
            nearest = nearest.min(self.distribution(record, off, kernel, rows, sums));
        }
        if nearest.is_finite() {
            self.count(nearest, kernel.root_weight(nearest), kernel, sums);
        }
    }

    /// From the mean of a voxel's points, m; `corner` is where its cell is from the point's, cells.
    #[inline]
    fn off(&self, record: Record, placed: &Placed, corner: [f32; 3]) -> [f32; 3] {
        let mean = record.mean();
        std::array::from_fn(|axis| (self.in_cell[axis] - corner[axis] - mean[axis]) * placed.size)
    }

    /// Adds the rows of a distribution; the square of the distance, in units of its thickness times thickness, m².
    #[inline]
    fn distribution(&self, record: Record, off: [f32; 3], kernel: &Kernel, rows: &mut Rows, sums: &mut Sums) -> f32 {
        let root = record.root();
        let distances = root.map(|column| dot(column, off));
        let square = dot(distances, distances);
        let weight = kernel.root_weight(square);
        for (column, distance) in root.into_iter().zip(distances) {
            rows.push(column, self.point, distance, weight, sums);
        }
        square
    }

    /// Counts the point.
    #[inline]
    fn count(&self, square: f32, root_weight: f32, kernel: &Kernel, sums: &mut Sums) {
        let weight = f64::from(root_weight * root_weight);
        sums.weight += weight;
        sums.square += weight * f64::from(square);
        sums.met += 1;
        sums.lever += weight * f64::from(dot(self.point, self.point));
        if square < kernel.inlier * kernel.inlier {
            sums.inliers += 1;
            sums.distance += f64::from(square.sqrt());
        }
    }
}

impl Kernel {
    /// Square root of the Geman-McClure weight `(c² / (c² + r²))²`.
    #[inline]
    fn root_weight(&self, square: f32) -> f32 {
        let width = self.width * self.width;
        width / (width + square)
    }
}

#[inline]
fn record_of(map: &VoxelMap, key: u64) -> Option<Record<'_>> {
    let place = map.table().get(key)?;
    map.records().get(place as usize).map(Record)
}

#[inline]
fn dot([ax, ay, az]: [f32; 3], [bx, by, bz]: [f32; 3]) -> f32 {
    ax * bx + ay * by + az * bz
}
