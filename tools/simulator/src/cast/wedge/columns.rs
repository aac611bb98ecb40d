//! Columns of rays that are cast together.

use super::row::Row;
use super::{LANES, Lanes, WIDTH};
use crate::cast::{Rotation, Shot};

/// A column as it is when it fires.
pub(crate) struct Column {
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
pub(crate) struct Columns {
    pub all: Vec<Column>,
    /// By how many columns each beam looks ahead, the smallest and the most.
    pub(super) shifts: Vec<isize>,
    pub(super) min: isize,
    most: isize,
    /// Azimuth from one column to the next, rad.
    pub(super) step: f64,
    /// The columns' numbers by axis, with the first and the last repeated as far as wedges reach beyond them.
    position: [Vec<f64>; 3],
    velocity: [Vec<f64>; 3],
    time: Vec<f64>,
    pub(super) azimuth: Vec<f64>,
    pub(super) rotation: [[Vec<f64>; 3]; 3],
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

    pub(super) fn reach(&self) -> usize {
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
