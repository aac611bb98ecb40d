//! Rays that are cast together: those that look between two azimuths, in one row for each beam.
//!
//! Neighbours of a row mostly meet the same things. A thing is tested against a few of them at once, in vectors where the
//! processor has such, and what is decided about one is mostly decided alike about the next.

use std::ops::Range;

use super::table::Extent;
use super::{LEAD, Rotation, Shot, TURN, round};
use crate::place::Scenery;
use crate::random::{mix, normal_of, unit_of};
use crate::sensor::{Optics, Sensor};
use crate::solid::Hit;

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

/// A column as it is when it fires.
pub(super) struct Column {
    pub number: usize,
    /// Clockwise from the first column, rad.
    pub azimuth: f64,
    /// Seconds after the sweep's start.
    pub fires: f64,
    /// The sensor in the middle of the column, and its velocity.
    pub position: [f64; 3],
    pub velocity: [f64; 3],
    pub place_from_sensor: Rotation,
    pub reported_from_sensor: Rotation,
}

/// The columns of a sweep, and how they are cut into wedges: a wedge has of each beam the rays that look between two
/// azimuths, whatever columns they belong to.
pub(super) struct Columns {
    pub all: Vec<Column>,
    /// By how many columns each beam looks ahead, the smallest and the most.
    shifts: Vec<isize>,
    min: isize,
    most: isize,
    /// Azimuth from one column to the next, rad.
    step: f64,
    /// The columns' numbers by axis, with the first and the last repeated as far as wedges reach beyond them.
    position: [Vec<f64>; 3],
    velocity: [Vec<f64>; 3],
    time: Vec<f64>,
    azimuth: Vec<f64>,
    rotation: [[Vec<f64>; 3]; 3],
    height: f64,
}

impl Columns {
    /// Columns that follow each other, each `step` radians after the one before.
    pub fn new(shot: &Shot, all: Vec<Column>, step: f64) -> Self {
        let beams = &shot.agent.sensor.beams;
        let shifts: Vec<isize> = beams
            .iter()
            .map(|beam| (beam.azimuth / step).round() as isize)
            .collect();
        let (min, most) = shifts.iter().fold((0, 0), |(a, b), v| (a.min(*v), b.max(*v)));
        let reach = most - min + WIDTH as isize;
        let numbers = |number: &dyn Fn(&Column) -> f64| -> Vec<f64> {
            let last = all.len() as isize - 1;
            (-reach..all.len() as isize + reach)
                .map(|i| number(&all[i.clamp(0, last) as usize]))
                .collect()
        };
        Columns {
            position: [0, 1, 2].map(|k| numbers(&|column| column.position[k])),
            velocity: [0, 1, 2].map(|k| numbers(&|column| column.velocity[k])),
            time: numbers(&|column| shot.start + column.fires),
            azimuth: numbers(&|column| column.azimuth),
            rotation: [0, 1, 2].map(|r| [0, 1, 2].map(|c| numbers(&|column| column.place_from_sensor[r][c]))),
            height: shot.agent.info.sensor_height,
            all,
            shifts,
            min,
            most,
            step,
        }
    }

    fn reach(&self) -> usize {
        (self.most - self.min) as usize + WIDTH
    }

    /// How many wedges there are.
    pub fn wedges(&self) -> usize {
        (self.all.len() + (self.most - self.min) as usize).div_ceil(WIDTH)
    }

    /// First and last bin of azimuth in each wedge, rounded outwards.
    pub fn bins(&self, shot: &Shot) -> Vec<[i16; 2]> {
        let bins = |wedge: usize| {
            let first = (self.min + (wedge * WIDTH) as isize) as f64 * self.step;
            let last = first + (WIDTH - 1) as f64 * self.step;
            let [low, high] =
                [first - 0.6 * self.step, last + 0.6 * self.step].map(|azimuth| shot.span.bin_of(azimuth));
            [low - 1, high + 1]
        };
        (0..self.wedges()).map(bins).collect()
    }

    /// Numbers of the columns of a group of rays; `first` is the index of the row's first.
    #[inline(always)]
    fn lanes<'a>(&self, all: &'a [f64], first: usize, group: usize) -> &'a Lanes {
        all[first + group * LANES..]
            .first_chunk()
            .expect("columns reach beyond every row")
    }

    /// Where the rays of a group of a row begin.
    #[inline(always)]
    pub fn origins(&self, row: &Row, group: usize) -> [Lanes; 3] {
        let mut origins = [[0.0; LANES]; 3];
        for (k, axis) in origins.iter_mut().enumerate() {
            let position = self.lanes(&self.position[k], row.first, group);
            let velocity = self.lanes(&self.velocity[k], row.first, group);
            for (i, origin) in axis.iter_mut().enumerate() {
                *origin = position[i] + velocity[i] * row.aside;
            }
        }
        for up in &mut origins[2] {
            *up += self.height;
        }
        origins
    }

    /// Where a ray begins.
    #[inline(always)]
    pub fn origin(&self, row: &Row, ray: usize) -> [f64; 3] {
        let column = row.first + ray;
        let axis = |k: usize| self.position[k][column] + self.velocity[k][column] * row.aside;
        [axis(0), axis(1), axis(2) + self.height]
    }

    /// When the columns of a group start, s.
    #[inline(always)]
    pub fn times(&self, row: &Row, group: usize) -> &Lanes {
        self.lanes(&self.time, row.first, group)
    }

    /// When the column of a ray starts, s.
    #[inline(always)]
    pub fn time(&self, row: &Row, ray: usize) -> f64 {
        self.time[row.first + ray]
    }
}

/// Rays of one beam.
pub(super) struct Row {
    x: Across,
    y: Across,
    z: Across,
    /// How far it is to what was met, m; negative where the beam does not fire.
    limit: Across,
    cos: Across,
    rho: Across,
    /// The rays' own hashes.
    hash: [u64; WIDTH],
    met: [u32; WIDTH],
    /// Bins of azimuth.
    bins: [i16; WIDTH],
    /// Index among the columns' numbers of the column of the first ray.
    first: usize,
    /// Time after the column's start, and after its middle, s.
    pub fires: f64,
    aside: f64,
}

/// What came back of a ray.
#[derive(Clone, Copy)]
pub(super) struct Return {
    /// m; negative for nothing.
    pub range: f64,
    pub intensity: u8,
    met: u32,
}

impl Return {
    pub const NONE: Return = Return {
        range: -1.0,
        intensity: 0,
        met: NOTHING,
    };

    /// Index of the road user that was met.
    pub fn user(&self) -> Option<u32> {
        self.met.checked_sub(SOMETHING + 1)
    }
}

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

impl Row {
    /// The columns to which its rays belong.
    fn columns(&self, columns: &Columns) -> Range<usize> {
        let reach = columns.reach();
        let index = |i: usize| i.saturating_sub(reach).min(columns.all.len());
        index(self.first)..index(self.first + WIDTH)
    }

    /// The rays that belong to a column.
    fn fired(&self, columns: &Columns) -> Range<usize> {
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
    fn slopes(&self) -> [f32; 2] {
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

/// Range and intensity of what comes back; `None` if nothing is seen.
#[inline]
fn receive(optics: &Optics, hit: &Hit, hash: u64) -> Option<(f64, u8)> {
    let ratio = optics.reference_range / hit.t;
    let mut q = optics.strength * hit.rho * hit.cos * ratio * ratio;
    if optics.extinction > 0.0 {
        q *= libm::exp(-2.0 * optics.extinction * hit.t);
    }
    let q4 = q * q * q * q;
    if unit_of(hash) * (q4 + 1.0) >= q4 * (1.0 - optics.unanswered) {
        return None;
    }
    let scatter = (optics.noise_floor + optics.noise_slope / q.sqrt()).min(optics.noise_ceiling);
    let range = hit.t + scatter * normal_of(mix(hash));
    let range = round(range * optics.steps_per_metre) * optics.step;
    if range < optics.nearest || range > optics.farthest {
        return None;
    }
    // Calibrated for range: 100 stands for a white wall met squarely, more for retro-reflectors.
    let shimmer = (hash & 0x3ff) as f64 * (0.06 / 1024.0);
    Some((range, (100.0 * hit.rho * hit.cos * (0.97 + shimmer)).min(255.0) as u8))
}
