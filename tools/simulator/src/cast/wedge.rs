//! Rays that are cast together: those that look between two azimuths, in one row for each beam.
//!
//! Neighbours of a row mostly meet the same things. A thing is tested against a few of them at once, in vectors where the
//! processor has such, and what is decided about one is mostly decided alike about the next.

mod columns;
mod receive;
mod row;

use super::table::Extent;
use super::{LEAD, Shot, TURN};
use crate::place::Scenery;
use crate::random::mix;
use crate::sensor::{Optics, Sensor};
pub(super) use columns::{Column, Columns};
pub(super) use receive::Return;
use receive::receive;
pub(super) use row::Row;

/// Rays of a row.
const WIDTH: usize = 32;
/// Rays that are tested at once; a divisor of `WIDTH`.
pub(super) const LANES: usize = 4;

/// Rays that fall less than this are likely to meet foliage before the ground.
const FLAT: f64 = 0.06;

/// A number for each of the rays that are tested at once.
pub(super) type Lanes = [f64; LANES];
/// A number for each ray of a row.
type Across = [f64; WIDTH];

/// What a ray met: nothing, something that is no road user, or two more than the index of a road user.
const NOTHING: u32 = 0;
const SOMETHING: u32 = 1;

/// The rays between two azimuths.
pub(super) struct Wedge {
    rows: Vec<Row>,
    /// Rows by elevation, and bounds of their slopes: no row up to one has a greater slope than `highest`, none from it on
    /// has a smaller one than `lowest`.
    order: Vec<u32>,
    highest: Vec<f32>,
    lowest: Vec<f32>,
    /// Column that would belong to the first rays of a beam that looks straight ahead.
    first: isize,
    /// Bins in an azimuth of a column's width, and the bin in which the first rays are.
    bins_per_column: f64,
    first_bin: f64,
}

impl Wedge {
    pub fn new(sensor: &Sensor) -> Self {
        let period = TURN / sensor.columns as f64;
        let row = |fires: f64| Row {
            x: [0.0; WIDTH],
            y: [0.0; WIDTH],
            z: [0.0; WIDTH],
            limit: [0.0; WIDTH],
            cos: [0.0; WIDTH],
            rho: [0.0; WIDTH],
            hash: [0; WIDTH],
            met: [NOTHING; WIDTH],
            bins: [0; WIDTH],
            first: 0,
            fires,
            aside: fires - 0.5 * period,
        };
        let mut order: Vec<u32> = (0..sensor.beams.len() as u32).collect();
        let rise = |beam: &u32| sensor.beams[*beam as usize].direction[2];
        order.sort_by(|a, b| rise(a).total_cmp(&rise(b)));
        Wedge {
            rows: sensor.beams.iter().map(|beam| row(beam.fires)).collect(),
            highest: vec![0.0; order.len()],
            lowest: vec![0.0; order.len()],
            order,
            first: 0,
            bins_per_column: 0.0,
            first_bin: 0.0,
        }
    }

    /// Fires the rays of a wedge into the empty world.
    pub fn fire(&mut self, shot: &Shot, columns: &Columns, number: usize) {
        let sensor = &*shot.agent.sensor;
        let per_column = sensor.beams.len().max(256);
        self.first = columns.min + (number * WIDTH) as isize;
        self.bins_per_column = columns.step / shot.span.bin;
        self.first_bin = (self.first as f64 * columns.step + LEAD) / shot.span.bin;
        for (number, (row, beam)) in self.rows.iter_mut().zip(&sensor.beams).enumerate() {
            let first = self.first - columns.shifts[number];
            row.first = (first + columns.reach() as isize) as usize;
            let [a, b, c] = beam.direction;
            for (k, out) in [&mut row.x, &mut row.y, &mut row.z].into_iter().enumerate() {
                let [u, v, w] = columns.rotation[k].each_ref().map(|all| &all[row.first..][..WIDTH]);
                for i in 0..WIDTH {
                    out[i] = u[i] * a + v[i] * b + w[i] * c;
                }
            }
            for (bin, azimuth) in row.bins.iter_mut().zip(&columns.azimuth[row.first..][..WIDTH]) {
                *bin = shot.span.bin_of(azimuth + beam.azimuth);
            }
            row.met = [NOTHING; WIDTH];
            row.limit = [f64::NEG_INFINITY; WIDTH];
            let fired = row.columns(columns);
            for (i, column) in columns.all[fired.clone()].iter().enumerate() {
                let i = (i as isize + fired.start as isize - first) as usize;
                let ray = (column.number * per_column + number) as u64;
                row.hash[i] = mix(shot.key.wrapping_add(ray.wrapping_mul(0x9e37_79b9_7f4a_7c15)));
                if beam.every <= 1 || column.number % beam.every == 0 {
                    row.limit[i] = sensor.optics.farthest;
                }
            }
        }
        self.sort_slopes();
    }

    fn sort_slopes(&mut self) {
        let mut highest = f32::NEG_INFINITY;
        for (k, number) in self.order.iter().enumerate() {
            let [low, high] = self.rows[*number as usize].slopes();
            highest = highest.max(high);
            (self.lowest[k], self.highest[k]) = (low, highest);
        }
        let mut lowest = f32::INFINITY;
        for low in self.lowest.iter_mut().rev() {
            lowest = lowest.min(*low);
            *low = lowest;
        }
    }

    /// Visits groups of rays that may meet a thing: its row and the number of the group.
    #[inline(always)]
    pub fn each(&mut self, extent: &Extent, mut visit: impl FnMut(&mut Row, usize)) {
        let first = self.highest.partition_point(|high| *high < extent.low);
        let last = self.lowest.partition_point(|low| *low <= extent.high);
        // A beam looks up to half a column away from where its row has it.
        let column = |bin: f64| (bin - self.first_bin) / self.bins_per_column;
        let from = (column(f64::from(extent.bins[0])) - 0.6).max(0.0) as usize / LANES;
        let to = (column(f64::from(extent.bins[1]) + 1.0) + 1.6).clamp(0.0, WIDTH as f64) as usize;
        let groups = from..to.div_ceil(LANES);
        for number in self.order.get(first..last).unwrap_or_default() {
            let row = &mut self.rows[*number as usize];
            for group in groups.clone() {
                if row.limits(group).iter().any(|limit| *limit >= extent.near) {
                    visit(row, group);
                }
            }
        }
    }

    /// Casts rays down to the ground: those that fall steeply, or the `flat` ones.
    pub fn ground(&mut self, columns: &Columns, place: &Scenery, flat: bool) {
        for (k, number) in self.order.iter().enumerate() {
            let some_flat = self.highest[k] >= -FLAT as f32;
            let some_steep = self.lowest[k] <= -FLAT as f32;
            let wanted = if flat { some_flat } else { some_steep };
            if !wanted {
                continue;
            }
            let row = &mut self.rows[*number as usize];
            for group in 0..WIDTH / LANES {
                let rays = row.rays(group);
                let mut limits = *row.limits(group);
                if some_flat && some_steep {
                    let [x, y, z] = rays;
                    for k in 0..LANES {
                        let level = (x[k] * x[k] + y[k] * y[k]).sqrt();
                        if (z[k] > -FLAT * level) != flat {
                            limits[k] = f64::NEG_INFINITY;
                        }
                    }
                }
                if limits.iter().all(|limit| *limit < 0.0) {
                    continue;
                }
                let hits = place.cast_ground(&columns.origins(row, group), rays, &limits);
                for (k, hit) in hits.into_iter().enumerate() {
                    if let Some(hit) = hit {
                        row.meet(group * LANES + k, hit, None);
                    }
                }
            }
        }
    }

    /// Receives what comes back, by column and beam.
    pub fn receive(&self, columns: &Columns, optics: &Optics, returns: &mut [Return]) {
        for (number, row) in self.rows.iter().enumerate() {
            for (ray, column) in row.fired(columns).zip(row.columns(columns)) {
                if let Some(hit) = row.met(ray)
                    && let Some((range, intensity)) = receive(optics, &hit, row.hash[ray])
                {
                    returns[column * self.rows.len() + number] = Return {
                        range,
                        intensity,
                        met: row.met[ray],
                    };
                }
            }
        }
    }

    /// The rays that were fired, by beam.
    #[cfg(test)]
    pub fn rays(&self, columns: &Columns) -> impl Iterator<Item = (&Row, usize)> {
        let rows = self.rows.iter().map(|row| (row, row.fired(columns)));
        rows.flat_map(|(row, fired)| fired.map(move |ray| (row, ray)))
            .filter(|(row, ray)| row.limit(*ray) >= 0.0)
    }
}
