//! The smooth ground: a height field in bilinear cells.

mod walk;

use crate::random::Stream;

/// Nodes along a side.
const NODES: usize = 257;
/// Cells along the side of a block, and blocks along the field's side.
const BLOCK: i32 = 4;
const BLOCKS: i32 = (NODES as i32 - 1) / BLOCK;

/// Heights over the place's plane, m; beside its grade nowhere steeper than about 5 %.
pub(crate) struct Terrain {
    /// Heights over the inclined plane.
    heights: Vec<f32>,
    /// Nodes per metre, a power of two.
    per_metre: f64,
    /// Distance of the field's border from the origin, m.
    half: f64,
    /// Slope of the inclined plane along x and y.
    grade: [f64; 2],
    /// Whether anything was added to the waves.
    hilly: bool,
    lowest: f64,
    highest: f64,
    /// Highest points of blocks of cells.
    tops: Vec<f32>,
    /// Steepest slope of a cell's edge, with a margin.
    steepest: f64,
}

impl Terrain {
    /// The ground of a place: a sum of long waves.
    pub fn new(place: u64) -> Self {
        let mut terrain = Terrain::shaped(place, 2.0, [0.0; 2], |_, _| 0.0);
        terrain.hilly = false;
        terrain
    }

    /// The same on an inclined plane, with something added to the waves.
    pub fn shaped(place: u64, cell: f64, grade: [f64; 2], added: impl Fn(f64, f64) -> f64) -> Self {
        let half = cell * (NODES - 1) as f64 / 2.0;
        let mut draws = Stream::new(place, "terrain", 0);
        let waves: Vec<[f64; 4]> = (0..6)
            .map(|_| {
                let (sin, cos) = libm::sincos(draws.between(0.0, std::f64::consts::TAU));
                let length = draws.between(60.0, 160.0);
                let k = std::f64::consts::TAU / length;
                [
                    k * cos,
                    k * sin,
                    draws.between(0.0, std::f64::consts::TAU),
                    length * draws.between(2e-4, 6e-4),
                ]
            })
            .collect();
        let height = |x: f64, y: f64| -> f64 {
            waves
                .iter()
                .map(|[kx, ky, phase, amplitude]| amplitude * libm::sin(kx * x + ky * y + phase))
                .sum::<f64>()
                + added(x, y)
        };
        let node = |i: usize| i as f64 * cell - half;
        let heights: Vec<f32> = (0..NODES * NODES)
            .map(|i| height(node(i % NODES), node(i / NODES)) as f32)
            .collect();
        let (lowest, highest) = heights
            .iter()
            .fold((f32::MAX, f32::MIN), |(low, high), h| (low.min(*h), high.max(*h)));
        let side = 0..BLOCKS as usize;
        let blocks = side.clone().flat_map(|b| side.clone().map(move |a| (a, b)));
        let block = BLOCK as usize;
        let top = |(a, b): (usize, usize)| {
            let rows = (b * block..=(b + 1) * block).flat_map(|row| &heights[row * NODES + a * block..][..=block]);
            rows.fold(f32::MIN, |top, height| top.max(*height))
        };
        let tops = blocks.map(top).collect();
        let rise = |i: usize, step: usize| heights.get(i + step).map_or(0.0, |h| (h - heights[i]).abs());
        let along = (0..NODES * NODES)
            .filter(|i| i % NODES != NODES - 1)
            .map(|i| rise(i, 1));
        let steepest = along
            .chain((0..NODES * NODES).map(|i| rise(i, NODES)))
            .fold(0.0, f32::max);
        let steepest = 1.5 * f64::from(steepest) / cell;
        Terrain {
            heights,
            per_metre: 1.0 / cell,
            half,
            grade,
            hilly: true,
            lowest: f64::from(lowest),
            highest: f64::from(highest),
            tops,
            steepest,
        }
    }

    /// Height at a point, m; beyond the field, that of its border.
    pub fn height(&self, x: f64, y: f64) -> f64 {
        self.relief(x, y) + (self.grade[0] * x + self.grade[1] * y)
    }

    /// Height over the inclined plane, m.
    fn relief(&self, x: f64, y: f64) -> f64 {
        let ([a, b, c, d], u, v) = self.corners(x, y);
        let (low, high) = (a + (b - a) * u, c + (d - c) * u);
        low + (high - low) * v
    }

    /// Heights in the corners of a point's cell, and its place in the cell.
    #[inline(always)]
    fn corners(&self, x: f64, y: f64) -> ([f64; 4], f64, f64) {
        let limit = self.half - 1e-6;
        let u = (x.clamp(-limit, limit) + self.half) * self.per_metre;
        let v = (y.clamp(-limit, limit) + self.half) * self.per_metre;
        let (i, j) = (u as i32, v as i32);
        let corners = &self.heights[j as usize * NODES + i as usize..][..NODES + 2];
        let [a, b, c, d] = [corners[0], corners[1], corners[NODES], corners[NODES + 1]];
        let corners = [f64::from(a), f64::from(b), f64::from(c), f64::from(d)];
        (corners, u - f64::from(i), v - f64::from(j))
    }

    #[inline(always)]
    fn in_cell(&self, i: i32, j: i32, u: f64, v: f64) -> f64 {
        let corners = &self.heights[j as usize * NODES + i as usize..][..NODES + 2];
        let (a, b) = (f64::from(corners[0]), f64::from(corners[1]));
        let (c, d) = (f64::from(corners[NODES]), f64::from(corners[NODES + 1]));
        let (u, v) = (u - f64::from(i), v - f64::from(j));
        let (low, high) = (a + (b - a) * u, c + (d - c) * u);
        low + (high - low) * v
    }

    /// Where rays first come down to `lift` above the ground, at parameters in [`from`, `limit`]; NaN where they do not.
    #[inline]
    pub fn cast<const N: usize>(
        &self,
        origins: &[[f64; N]; 3],
        rays: [&[f64; N]; 3],
        lift: f64,
        [from, limit]: [&[f64; N]; 2],
    ) -> [f64; N] {
        let ([x, y, z], [dx, dy, dz]) = (origins, rays);
        // Seen from the inclined plane rays stay rays, and keep their parameters.
        let (mut up, mut rise) = ([0.0; N], [0.0; N]);
        for k in 0..N {
            up[k] = z[k] - (self.grade[0] * x[k] + self.grade[1] * y[k]);
            rise[k] = dz[k] - (self.grade[0] * dx[k] + self.grade[1] * dy[k]);
        }
        // Where not all are of one kind, each is cast by the way of its own.
        let (mut found, mut steep) = ([f64::NAN; N], [false; N]);
        let mut down = [false; N];
        let min = if self.hilly { 1.4 } else { 4.0 } * self.steepest;
        for k in 0..N {
            down[k] = rise[k] < 0.0 && (self.highest + lift - up[k]) / rise[k] <= limit[k];
            steep[k] = down[k] && rise[k] * rise[k] > min * min * (dx[k] * dx[k] + dy[k] * dy[k]);
        }
        if steep.contains(&true) {
            let rays = ([x, y, &up], [dx, dy, &rise]);
            found = match self.hilly {
                true => self.plunge(rays, lift, steep),
                false => self.drop(rays, lift, from, steep),
            };
        }
        for k in 0..N {
            if found[k].is_nan() && down[k] {
                let (origin, ray) = ([x[k], y[k], up[k]], [dx[k], dy[k], rise[k]]);
                found[k] = self.alone(origin, ray, lift, [from[k], limit[k]]);
            } else {
                found[k] = match found[k] <= limit[k] {
                    true => found[k].max(from[k]),
                    false => f64::NAN,
                };
            }
        }
        found
    }

    /// For rays steeper than hilly ground, which they meet once: Newton's steps. NaN where they do not settle, and where
    /// rays are not `wanted`.
    #[inline]
    fn plunge<const N: usize>(&self, ([x, y, z], [dx, dy, dz]): Rays<N>, lift: f64, mut wanted: [bool; N]) -> [f64; N] {
        let (mut t, mut found) = ([0.0; N], [f64::NAN; N]);
        for k in 0..N {
            t[k] = (0.5 * (self.lowest + self.highest) + lift - z[k]) / dz[k];
        }
        for _ in 0..8 {
            let (mut over, mut fall) = ([0.0; N], [0.0; N]);
            for k in 0..N {
                let ([a, b, c, d], u, v) = self.corners(x[k] + dx[k] * t[k], y[k] + dy[k] * t[k]);
                let (low, high) = (a + (b - a) * u, c + (d - c) * u);
                over[k] = z[k] + dz[k] * t[k] - lift - (low + (high - low) * v);
                let slope_u = (b - a) + ((d - c) - (b - a)) * v;
                fall[k] = dz[k] - (slope_u * dx[k] + (high - low) * dy[k]) * self.per_metre;
            }
            for k in 0..N {
                t[k] -= over[k] / fall[k];
                if wanted[k] && over[k].abs() < 1e-5 {
                    (found[k], wanted[k]) = (t[k], false);
                }
            }
            if !wanted.contains(&true) {
                break;
            }
        }
        found
    }

    /// For rays much steeper than the ground, which they meet once: the height over it shrinks to nothing in steps. NaN
    /// where rays are not `wanted`.
    #[inline]
    fn drop<const N: usize>(
        &self,
        ([x, y, z], [dx, dy, dz]): Rays<N>,
        lift: f64,
        from: &[f64; N],
        mut wanted: [bool; N],
    ) -> [f64; N] {
        let (mut t, mut down, mut found) = ([0.0; N], [0.0; N], [f64::NAN; N]);
        for k in 0..N {
            down[k] = 1.0 / dz[k];
            t[k] = ((0.5 * (self.lowest + self.highest) + lift - z[k]) * down[k]).max(from[k]);
        }
        for _ in 0..8 {
            for k in 0..N {
                let over = z[k] + dz[k] * t[k] - lift - self.relief(x[k] + dx[k] * t[k], y[k] + dy[k] * t[k]);
                t[k] -= over * down[k];
                if wanted[k] {
                    found[k] = t[k];
                    wanted[k] = over.abs() >= 1e-5;
                }
            }
            if !wanted.contains(&true) {
                break;
            }
        }
        found
    }
}

/// Rays by axis: origins and directions.
type Rays<'a, const N: usize> = ([&'a [f64; N]; 3], [&'a [f64; N]; 3]);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ray_ends_on_the_ground() {
        let slope = Terrain::shaped(4, 4.0, [0.02, -0.015], |x, y| {
            0.3 * libm::sin(0.03 * x) * libm::cos(0.02 * y)
        });
        for terrain in [Terrain::new(3), slope] {
            rays_end_on(&terrain);
        }
    }

    fn rays_end_on(terrain: &Terrain) {
        let mut draws = Stream::new(1, "test", 0);
        let mut hits = 0;
        for _ in 0..2000 {
            let origin = [
                draws.between(-100.0, 100.0),
                draws.between(-100.0, 100.0),
                draws.between(1.5, 6.0),
            ];
            let origin = [
                origin[0],
                origin[1],
                origin[2] + terrain.grade[0] * origin[0] + terrain.grade[1] * origin[1],
            ];
            let (sin, cos) = libm::sincos(draws.between(0.0, std::f64::consts::TAU));
            let ray = [
                cos,
                sin,
                terrain.grade[0] * cos + terrain.grade[1] * sin - draws.between(0.015, 0.5),
            ];
            let lift = draws.between(0.0, 0.2);
            let rays = ray.each_ref().map(std::array::from_ref);
            let [t] = terrain.cast(&origin.map(|axis| [axis]), rays, lift, [&[0.0], &[200.0]]);
            if t.is_nan() {
                continue;
            }
            hits += 1;
            let [x, y, z] = [0, 1, 2].map(|i| origin[i] + ray[i] * t);
            assert!((z - lift - terrain.height(x, y)).abs() < 1e-5);
            for share in [0.2, 0.5, 0.9, 0.99] {
                let [x, y, z] = [0, 1, 2].map(|i| origin[i] + ray[i] * t * share);
                assert!(
                    z - lift > terrain.height(x, y) - 1e-5,
                    "the ray was under ground before it hit"
                );
            }
        }
        assert!(hits > 1500, "{hits} hits");
    }

    #[test]
    fn ground_is_neither_flat_nor_steep() {
        for place in 0..20 {
            let terrain = Terrain::new(place);
            assert!(
                terrain.highest - terrain.lowest > 0.05,
                "flat: {} to {}",
                terrain.lowest,
                terrain.highest
            );
            for i in 0..400 {
                let (x, y) = (f64::from(i % 20) * 18.0 - 180.0, f64::from(i / 20) * 18.0 - 180.0);
                let slope = (terrain.height(x + 2.0, y) - terrain.height(x, y)) / 2.0;
                assert!(slope.abs() < 0.02, "slope {slope}");
            }
        }
    }
}
