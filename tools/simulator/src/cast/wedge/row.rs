//! One row of rays and what each has met.

use std::ops::Range;

use super::columns::Columns;
use super::{Across, Lanes, NOTHING, SOMETHING, WIDTH};
use crate::solid::Hit;

/// Rays of one beam.
pub(crate) struct Row {
    pub(super) x: Across,
    pub(super) y: Across,
    pub(super) z: Across,
    /// How far it is to what was met, m; negative where the beam does not fire.
    pub(super) limit: Across,
    pub(super) cos: Across,
    pub(super) rho: Across,
    /// The rays' own hashes.
    pub(super) hash: [u64; WIDTH],
    pub(super) met: [u32; WIDTH],
    /// Bins of azimuth.
    pub(super) bins: [i16; WIDTH],
    /// Index among the columns' numbers of the column of the first ray.
    pub(super) first: usize,
    /// Time after the column's start, and after its middle, s.
    pub fires: f64,
    pub(super) aside: f64,
}

impl Row {
    /// The columns to which its rays belong.
    pub(super) fn columns(&self, columns: &Columns) -> Range<usize> {
        let reach = columns.reach();
        let index = |i: usize| i.saturating_sub(reach).min(columns.all.len());
        index(self.first)..index(self.first + WIDTH)
    }

    /// The rays that belong to a column.
    pub(super) fn fired(&self, columns: &Columns) -> Range<usize> {
        let fired = self.columns(columns);
        let ray = |column: usize| (column + columns.reach()) - self.first;
        match fired.is_empty() {
            true => 0..0,
            false => ray(fired.start)..ray(fired.end),
        }
    }

    /// The rays of a group, by axis.
    #[inline(always)]
    pub fn rays(&self, group: usize) -> [&Lanes; 3] {
        let (x, y, z) = (self.x.as_chunks().0, self.y.as_chunks().0, self.z.as_chunks().0);
        [&x[group], &y[group], &z[group]]
    }

    /// How far the rays of a group may go, m.
    #[inline(always)]
    pub fn limits(&self, group: usize) -> &Lanes {
        &self.limit.as_chunks().0[group]
    }

    #[inline(always)]
    pub fn ray(&self, ray: usize) -> [f64; 3] {
        [self.x[ray], self.y[ray], self.z[ray]]
    }

    /// How far a ray may go, m.
    #[inline(always)]
    pub fn limit(&self, ray: usize) -> f64 {
        self.limit[ray]
    }

    #[inline(always)]
    pub fn hash(&self, ray: usize) -> u64 {
        self.hash[ray]
    }

    /// Whether a ray looks into a thing's bins.
    #[inline(always)]
    pub fn looks_into(&self, ray: usize, [from, to]: [i16; 2]) -> bool {
        (from..=to).contains(&self.bins[ray])
    }

    /// Bounds of the rays' slopes, rounded outwards.
    pub(super) fn slopes(&self) -> [f32; 2] {
        let [low, high] = self.z.iter().fold([f64::MAX, f64::MIN], |[low, high], z| {
            [if *z < low { *z } else { low }, if *z > high { *z } else { high }]
        });
        // A ray's length is 1.
        let slope = |z: f64| (z / (1.0 - z * z).max(1e-12).sqrt()) as f32;
        let margin = |slope: f32| 1e-5 + 1e-5 * slope.abs();
        let [low, high] = [slope(low), slope(high)];
        [low - margin(low), high + margin(high)]
    }

    /// Takes down what a ray met, which is nearer than all before.
    #[inline(always)]
    pub fn meet(&mut self, ray: usize, hit: Hit, user: Option<u32>) {
        self.limit[ray] = hit.t;
        self.cos[ray] = hit.cos;
        self.rho[ray] = hit.rho;
        self.met[ray] = user.map_or(SOMETHING, |user| user + SOMETHING + 1);
    }

    /// What a ray met.
    #[inline(always)]
    pub fn met(&self, ray: usize) -> Option<Hit> {
        (self.met[ray] != NOTHING).then(|| Hit {
            t: self.limit[ray],
            cos: self.cos[ray],
            rho: self.rho[ray],
        })
    }
}
