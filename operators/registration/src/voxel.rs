//! What is known of the surface in one voxel, and the 32 bytes that hold it.
//!
//! | bytes | content |
//! |---|---|
//! | 0–7 | key of the cell: x, y, z, 21 bits each, plus 2²⁰ |
//! | 8–13 | mean of the points: x, y, z from the cell's lower corner, u16, 65,536 to a cell |
//! | 14–15 | number of points, at most 8,191 (bits 0–12); axis of the normal's largest part (13, 14); whether it is planar (15) |
//! | 16–19 | the normal's parts along the two axes that follow that axis, i16 over 32,767; the part along it is positive |
//! | 20–31 | root of the information: `l00 l10 l11 l20 l21 l22`, i16 over 32,767 |
//!
//! Any bytes are a voxel in numbers that are finite; so a mapped file that changes while it is read can make a pose wrong, but
//! nothing else.

use nalgebra::{Matrix3, Point3, Vector3};

use crate::cell::cell_of;
use crate::eigen::eigen;

/// Bytes of a voxel.
pub(crate) const BYTES: usize = 32;

/// Largest number of points that is told apart.
const MAX_POINTS: u32 = (1 << 13) - 1;
/// A surface is planar if it varies this many times less across than along its narrower side, as variances.
const FLATNESS: f64 = 0.1;
/// Standard deviation of a planar surface at most, cells.
const MAX_ROUGHNESS: f64 = 0.1;

/// The surface in one voxel.
#[derive(Clone, Debug, PartialEq)]
pub struct Voxel {
    /// The cell, in voxels from the map's origin.
    pub cell: [i32; 3],
    /// Points that it was made from; 8,191 stands for more too.
    pub points: u32,
    /// Their mean in the frame of the map's poses, m.
    pub mean: Point3<f64>,
    /// Direction in which they vary least, of length 1.
    pub normal: Vector3<f64>,
    /// Whether they are a plane.
    pub is_planar: bool,
    /// Inverse of their covariance, whose variances are at least the square of the map's thickness, 1/m².
    pub information: Matrix3<f64>,
}

/// Sums over the points of a cell; coordinates are m from the cell's centre, so that nothing is lost far from the origin.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Moments {
    pub points: u32,
    sum: [f64; 3],
    /// xx, xy, xz, yy, yz, zz.
    products: [f64; 6],
}

impl Moments {
    /// Adds a point.
    #[inline]
    pub fn add(&mut self, [x, y, z]: [f64; 3]) {
        self.points = self.points.saturating_add(1);
        for (sum, value) in self.sum.iter_mut().zip([x, y, z]) {
            *sum += value;
        }
        for (sum, value) in self.products.iter_mut().zip([x * x, x * y, x * z, y * y, y * z, z * z]) {
            *sum += value;
        }
    }

    /// Adds the mean of some points and their covariance, as one point.
    pub fn add_spread(&mut self, mean: [f64; 3], covariance: [f64; 6]) {
        self.add(mean);
        for (sum, value) in self.products.iter_mut().zip(covariance) {
            *sum += value;
        }
    }

    /// Mean of the points, m from the cell's centre.
    pub fn mean(&self) -> [f64; 3] {
        self.sum.map(|sum| sum / f64::from(self.points.max(1)))
    }

    fn covariance(&self) -> [[f64; 3]; 3] {
        let (mean, [xx, xy, xz, yy, yz, zz]) = (self.mean(), self.products);
        let rows = [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]];
        let points = f64::from(self.points.max(1));
        std::array::from_fn(|i| std::array::from_fn(|j| rows[i][j] / points - mean[i] * mean[j]))
    }

    /// The voxel's bytes; `size` and `thickness` in m.
    pub fn encode(&self, key: u64, size: f64, thickness: f64) -> [u8; BYTES] {
        let (values, vectors) = eigen(self.covariance());
        let normal = vectors[0];
        let is_planar =
            values[0] <= FLATNESS * values[1] && values[0] <= (MAX_ROUGHNESS * size) * (MAX_ROUGHNESS * size);
        let axis = (1..3).fold(0, |most, i| if normal[i].abs() > normal[most].abs() { i } else { most });
        let sign = if normal[axis] < 0.0 { -1.0 } else { 1.0 };
        let sides = [1, 2].map(|after| sign * normal[(axis + after) % 3]);

        let place = self.mean().map(|mean| (mean / size + 0.5) * 65536.0);
        let flags = self.points.min(MAX_POINTS) as u16 | (axis as u16) << 13 | u16::from(is_planar) << 15;
        let mut bytes = [0; BYTES];
        bytes[..8].copy_from_slice(&key.to_le_bytes());
        let unsigned = place.map(|place| place.clamp(0.0, 65535.0) as u16);
        let signed = sides.into_iter().chain(root(&values, &vectors, thickness));
        let words = unsigned.into_iter().chain([flags]).map(u16::to_le_bytes);
        let words = words.chain(signed.map(|value| ((value * 32767.0).round() as i16).to_le_bytes()));
        for (to, word) in bytes[8..].as_chunks_mut::<2>().0.iter_mut().zip(words) {
            *to = word;
        }
        bytes
    }
}

/// The lower triangle L with L·Lᵀ = thickness² · C⁻¹ by rows, all its elements within ±1; C has variances of thickness² or more.
fn root(variances: &[f64; 3], directions: &[[f64; 3]; 3], thickness: f64) -> [f64; 6] {
    let least = thickness * thickness;
    let weights = variances.map(|variance| least / variance.max(least));
    let element =
        |i: usize, j: usize| -> f64 { (0..3).map(|k| weights[k] * directions[k][i] * directions[k][j]).sum() };
    let l00 = element(0, 0).sqrt();
    let (l10, l20) = (element(1, 0) / l00, element(2, 0) / l00);
    let l11 = (element(1, 1) - l10 * l10).max(0.0).sqrt();
    let l21 = (element(2, 1) - l20 * l10) / l11;
    let l22 = (element(2, 2) - l20 * l20 - l21 * l21).max(0.0).sqrt();
    [l00, l10, l11, l20, l21, l22]
}

/// A voxel as it is stored.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Record<'a>(pub &'a [u8; BYTES]);

impl Record<'_> {
    /// Key of the cell.
    pub fn key(self) -> u64 {
        u64::from_le_bytes(std::array::from_fn(|i| self.0[i]))
    }

    #[inline]
    fn word(self, at: usize) -> u16 {
        u16::from_le_bytes([self.0[at], self.0[at + 1]])
    }

    #[inline]
    fn signed(self, at: usize) -> f32 {
        f32::from(self.word(at).cast_signed()) * (1.0 / 32767.0)
    }

    /// Mean from the cell's lower corner, cells.
    #[inline]
    pub fn mean(self) -> [f32; 3] {
        [8, 10, 12].map(|at| (f32::from(self.word(at)) + 0.5) * (1.0 / 65536.0))
    }

    /// Number of points.
    pub fn points(self) -> u32 {
        u32::from(self.word(14)) & MAX_POINTS
    }

    /// Whether the points are a plane.
    #[inline]
    pub fn is_planar(self) -> bool {
        self.0[15] & 0x80 != 0
    }

    /// Axis of the normal's largest part; 3 in no sound record.
    pub fn axis(self) -> u8 {
        self.0[15] >> 5 & 3
    }

    /// Whether the parts of the normal across its axis are no larger than those of one that is longest along it.
    pub fn is_sound_normal(self) -> bool {
        let [a, b] = self.sides();
        // At most 2/3, and what rounding adds.
        a * a + b * b < 0.67
    }

    /// The normal's parts along the two axes that follow its own.
    #[inline]
    pub fn sides(self) -> [f32; 2] {
        [16, 18].map(|at| self.signed(at))
    }

    /// Direction in which the points vary least.
    #[inline]
    pub fn normal(self) -> [f32; 3] {
        let [a, b] = self.sides();
        let most = (1.0 - a * a - b * b).max(0.0).sqrt();
        match self.axis() {
            0 => [most, a, b],
            1 => [b, most, a],
            _ => [a, b, most],
        }
    }

    /// Columns of the root L of the information times thickness².
    #[inline]
    pub fn root(self) -> [[f32; 3]; 3] {
        let [l00, l10, l11, l20, l21, l22] = [20, 22, 24, 26, 28, 30].map(|at| self.signed(at));
        [[l00, l10, l20], [0.0, l11, l21], [0.0, 0.0, l22]]
    }

    /// Covariance of the points with variances of thickness² or more, m²: xx, xy, xz, yy, yz, zz.
    pub fn covariance(self, thickness: f64) -> [f64; 6] {
        let [[l00, l10, l20], [_, l11, l21], [_, _, l22]] = self.root().map(|column| column.map(f64::from));
        // Columns of the inverse of L.
        let [a, b, c] = [1.0 / l00, 1.0 / l11, 1.0 / l22];
        let (d, f) = (-l10 * a * b, -l21 * b * c);
        let e = (l10 * l21 * b - l20) * a * c;
        let square = thickness * thickness;
        [a * a + d * d + e * e, d * b + e * f, e * c, b * b + f * f, f * c, c * c].map(|value| square * value)
    }

    /// All of it, in numbers for people; `origin` of the map, size and thickness in m.
    pub fn voxel(self, origin: &Point3<f64>, size: f64, thickness: f64) -> Voxel {
        let (cell, mean) = (cell_of(self.key()), self.mean());
        let mean = Vector3::from_fn(|i, _| (f64::from(cell[i]) + f64::from(mean[i])) * size);
        let columns = self.root().map(|column| Vector3::from(column.map(f64::from)));
        let information = columns
            .iter()
            .map(|column| column * column.transpose())
            .sum::<Matrix3<f64>>();
        Voxel {
            cell,
            points: self.points(),
            mean: origin + mean,
            normal: Vector3::from(self.normal().map(f64::from)),
            is_planar: self.is_planar(),
            information: information / (thickness * thickness),
        }
    }
}

#[cfg(test)]
mod tests {
    use damage::Draw;
    use proptest::prelude::*;

    use super::*;
    use crate::cell::key_of;

    const THICKNESS: f64 = 0.05;

    fn made(points: &[[f64; 3]], cell: [i32; 3]) -> Voxel {
        let mut moments = Moments::default();
        points.iter().for_each(|point| moments.add(*point));
        let bytes = moments.encode(key_of(cell), 1.0, THICKNESS);
        Record(&bytes).voxel(&Point3::new(1e6, -2e6, 40.0), 1.0, THICKNESS)
    }

    fn uniform(draw: &mut Draw) -> f64 {
        (draw.number() >> 11) as f64 / (1u64 << 53) as f64 - 0.5
    }

    /// Points of a plane through a cell's centre, with noise across it.
    fn plane(normal: Vector3<f64>, noise: f64, seed: u64) -> Vec<[f64; 3]> {
        let mut draw = Draw::new(seed);
        let side = normal.cross(&Vector3::new(0.3, -0.5, 0.8)).normalize();
        let other = normal.cross(&side);
        let mut point =
            || 0.5 * (side * uniform(&mut draw) + other * uniform(&mut draw)) + normal * (noise * uniform(&mut draw));
        (0..400).map(|_| point().into()).collect()
    }

    proptest! {
        #[test]
        fn a_plane_is_found_again(direction in prop::array::uniform3(-1f64..1.0), seed in 0u64..1000) {
            let normal = Vector3::from(direction);
            prop_assume!(normal.norm() > 0.1);
            let normal = normal.normalize();
            let voxel = made(&plane(normal, 0.05, seed), [7, -8, 9]);
            prop_assert!(voxel.is_planar && voxel.points == 400 && voxel.cell == [7, -8, 9]);
            prop_assert!(voxel.normal.dot(&normal).abs() > 0.999, "{} for {normal}", voxel.normal);
            prop_assert!((voxel.normal.norm() - 1.0).abs() < 1e-6);
            let centre = Point3::new(1e6 + 7.5, -2e6 - 7.5, 49.5);
            prop_assert!((voxel.mean - centre).norm() < 0.05, "{}", voxel.mean);
            // Across: 1 / thickness². Along: 12 / 0.5².
            let across = (voxel.normal.transpose() * voxel.information * voxel.normal)[0];
            prop_assert!((across * THICKNESS * THICKNESS - 1.0).abs() < 1e-3, "{across}");
            let all = voxel.information.trace();
            prop_assert!((all - across) > 70.0 && (all - across) < 130.0, "{all}");
        }
    }

    #[test]
    fn what_is_no_plane_says_so() {
        let mut draw = Draw::new(1);
        let mut ball = || [(); 3].map(|()| uniform(&mut draw));
        let heap: Vec<[f64; 3]> = (0..1000).map(|_| ball()).collect();
        assert!(!made(&heap, [0; 3]).is_planar);
        let pole: Vec<[f64; 3]> = heap.iter().map(|[x, y, z]| [0.1 * x, 0.1 * y, *z]).collect();
        let pole = made(&pole, [0; 3]);
        assert!(!pole.is_planar);
        let diagonal = pole.information.diagonal();
        assert!(
            diagonal[0] > 20.0 * diagonal[2] && diagonal[1] > 20.0 * diagonal[2],
            "{diagonal}"
        );
        let rough: Vec<[f64; 3]> = heap.iter().map(|[x, y, z]| [*x, *y, 0.5 * z]).collect();
        assert!(!made(&rough, [0; 3]).is_planar);
    }

    #[test]
    fn any_bytes_are_a_voxel_of_finite_numbers() {
        let mut draw = Draw::new(2);
        for _ in 0..10_000 {
            let bytes: [u8; BYTES] = std::array::from_fn(|_| draw.number() as u8);
            let record = Record(&bytes);
            let numbers = record
                .mean()
                .into_iter()
                .chain(record.normal())
                .chain(record.root().into_iter().flatten());
            assert!(numbers.into_iter().all(|number| number.abs() <= 1.01), "{bytes:?}");
        }
    }
}
