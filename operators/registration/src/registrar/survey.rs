//! Which poses around a guess are worth a look: what stands upright in a sweep is laid on what stands upright in the map, on a
//! grid of places and headings, seen from above.

use std::collections::BTreeMap;

use nalgebra::{Isometry3, Vector3};

use super::Around;
use super::wide::moved;
use crate::cell::cell_of;
use crate::map::VoxelMap;
use crate::sample::Sample;
use crate::voxel::Record;

/// Side of a column at least, m. Places are so far apart.
const COLUMN: f64 = 1.0;
/// Headings are so far apart, degrees; a whole number of them is a circle.
const APART_DEG: f64 = 4.0;
/// A column stands upright if it is so high, and is ground if it is no higher than that, m.
const UPRIGHT: f32 = 1.2;
const FLAT: f32 = 0.3;
/// Columns of the sweep that are nearer than this count, m.
const FAR: f64 = 50.0;
/// So many of them are enough: upright ones and ground.
const ENOUGH: [usize; 2] = [250, 100];
/// What an upright column of the sweep counts in an upright one of the map, one beside it, and two beside it.
const FITS: [i32; 3] = [4, 3, 1];
/// What ground counts that is in an upright column of the map.
const CONTRADICTS: i32 = -3;
/// Two poses are neighbours within so many steps of places and of headings.
const NEIGHBOURS: i32 = 2;

/// Columns around a place.
struct Grid {
    /// Cells from the middle to each side.
    half: i32,
    size: f64,
    /// What an upright column of the sweep counts in each, and what ground does.
    upright: Vec<i32>,
    flat: Vec<i32>,
}

/// A pose on the grid: steps of x, y and heading.
type Steps = [i32; 3];

/// The poses around a guess that fit best, no neighbours of each other, the best first; at most so many.
pub(super) fn starts(map: &VoxelMap, sample: &Sample, around: &Around, most: usize) -> Vec<Isometry3<f64>> {
    let size = map.info().voxel_m.max(COLUMN);
    let radius = (around.radius_m / size).ceil() as i32;
    let grid = Grid::of(map, &around.guess.translation.vector, size, radius);
    let [upright, flat] = columns(sample, &around.guess, size);
    let mut all: Vec<(i32, Steps)> = Vec::new();
    for turn in turns(around.turn_rad) {
        let angle = f64::from(turn) * APART_DEG.to_radians();
        let places = [&upright, &flat].map(|columns| grid.places(columns, angle));
        for y in -radius..=radius {
            for x in -radius..=radius {
                if x * x + y * y <= radius * radius {
                    all.push((grid.score(&places, [x, y]), [x, y, turn]));
                }
            }
        }
    }
    // Of equal ones the first.
    all.sort_by_key(|(score, _)| -score);
    let mut best: Vec<Steps> = Vec::new();
    for (_, steps) in all {
        if best.len() < most && !best.iter().any(|known| is_near(known, &steps)) {
            best.push(steps);
        }
    }
    let pose = |[x, y, turn]: Steps| {
        let shift = Vector3::new(f64::from(x) * size, f64::from(y) * size, 0.0);
        moved(&around.guess, shift, f64::from(turn) * APART_DEG.to_radians())
    };
    best.into_iter().map(pose).collect()
}

/// Steps of headings within a turn to each side; at most those of a circle.
fn turns(most: f64) -> std::ops::Range<i32> {
    let circle = (360.0 / APART_DEG) as i32;
    let side = (most.to_degrees() / APART_DEG).ceil().min(360.0) as i32;
    if 2 * side + 1 >= circle {
        0..circle
    } else {
        -side..side + 1
    }
}

fn is_near(a: &Steps, b: &Steps) -> bool {
    let circle = (360.0 / APART_DEG) as i32;
    let turn = (a[2] - b[2]).rem_euclid(circle);
    let is_place = (0..2).all(|axis| (a[axis] - b[axis]).abs() <= NEIGHBOURS);
    is_place && turn.min(circle - turn) <= NEIGHBOURS
}

impl Grid {
    fn of(map: &VoxelMap, middle: &Vector3<f64>, size: f64, radius: i32) -> Self {
        let half = (FAR / size).ceil() as i32 + radius + 2;
        let mut grid = Grid {
            half,
            size,
            upright: Vec::new(),
            flat: Vec::new(),
        };
        let side = grid.side();
        let mut heights = vec![[f32::INFINITY, f32::NEG_INFINITY]; side * side];
        let (voxel, from) = (map.info().voxel_m, map.info().origin.coords - middle);
        for record in map.records().iter().map(Record) {
            let (cell, mean) = (cell_of(record.key()), record.mean());
            let [x, y, z]: [f64; 3] =
                std::array::from_fn(|i| (f64::from(cell[i]) + f64::from(mean[i])) * voxel + from[i]);
            if let Some(place) = grid.place(x, y) {
                let [low, high] = &mut heights[place];
                (*low, *high) = (low.min(z as f32), high.max(z as f32));
            }
        }
        grid.spread(&heights);
        grid
    }

    /// Fills in what columns count, from the lowest and highest points of the map's.
    fn spread(&mut self, heights: &[[f32; 2]]) {
        let side = self.side();
        (self.upright, self.flat) = (vec![0; side * side], vec![0; side * side]);
        let stands = heights
            .iter()
            .enumerate()
            .filter(|(_, [low, high])| high - low >= UPRIGHT);
        for (at, _) in stands {
            self.flat[at] = CONTRADICTS;
            let (x, y) = (at % side, at / side);
            for y_beside in y.saturating_sub(2)..=(y + 2).min(side - 1) {
                for x_beside in x.saturating_sub(2)..=(x + 2).min(side - 1) {
                    let beside = x.abs_diff(x_beside).max(y.abs_diff(y_beside));
                    let counts = &mut self.upright[y_beside * side + x_beside];
                    *counts = FITS[beside].max(*counts);
                }
            }
        }
    }

    fn side(&self) -> usize {
        2 * self.half.unsigned_abs() as usize + 1
    }

    /// The column of a place, m from the middle; `None` outside.
    fn place(&self, x: f64, y: f64) -> Option<usize> {
        // Casts bound what is too far, and take NaN to 0.
        let [x, y] = [x, y].map(|part| (part / self.size).round() as i32);
        let inside = x.unsigned_abs() <= self.half.unsigned_abs() && y.unsigned_abs() <= self.half.unsigned_abs();
        inside.then(|| (y + self.half) as usize * self.side() + (x + self.half) as usize)
    }

    /// Where columns of the sweep are after a turn; all may be moved by the radius.
    fn places(&self, columns: &[[f64; 2]], turn: f64) -> Vec<usize> {
        let (sin, cos) = libm::sincos(turn);
        let turned = columns
            .iter()
            .map(|[x, y]| self.place(cos * x - sin * y, sin * x + cos * y));
        turned.flatten().collect()
    }

    /// How well columns fit that are moved by so many steps.
    fn score(&self, [upright, flat]: &[Vec<usize>; 2], [x, y]: [i32; 2]) -> i32 {
        let step = y as isize * self.side() as isize + x as isize;
        let sum = |places: &[usize], counts: &[i32]| -> i32 {
            let moved = places.iter().map(|place| place.wrapping_add_signed(step));
            moved.filter_map(|place| counts.get(place)).sum()
        };
        sum(upright, &self.upright) + sum(flat, &self.flat)
    }
}

/// Columns of a sweep from above, in the map's axes from the guess, m: those that stand upright, and ground.
fn columns(sample: &Sample, guess: &Isometry3<f64>, size: f64) -> [Vec<[f64; 2]>; 2] {
    // Lowest and highest point, sums of x and y, and number.
    let mut columns: BTreeMap<[i32; 2], [f64; 5]> = BTreeMap::new();
    for ((x, y), z) in sample.x.iter().zip(&sample.y).zip(&sample.z) {
        let point = guess.rotation * Vector3::new(f64::from(*x), f64::from(*y), f64::from(*z));
        if point.x * point.x + point.y * point.y > FAR * FAR {
            continue;
        }
        let key = [point.x, point.y].map(|part| (part / size).floor() as i32);
        let new = [f64::INFINITY, f64::NEG_INFINITY, 0.0, 0.0, 0.0];
        let [low, high, sum_x, sum_y, count] = columns.entry(key).or_insert(new);
        (*low, *high) = (low.min(point.z), high.max(point.z));
        (*sum_x, *sum_y, *count) = (*sum_x + point.x, *sum_y + point.y, *count + 1.0);
    }
    let [most, flattest] = ENOUGH;
    let of = |is: &dyn Fn(f32) -> bool, most: usize| -> Vec<[f64; 2]> {
        let kept = columns.values().filter(|[low, high, ..]| is((high - low) as f32));
        let all: Vec<[f64; 2]> = kept.map(|[_, _, x, y, count]| [x / count, y / count]).collect();
        let every = all.len().div_ceil(most).max(1);
        all.into_iter().step_by(every).collect()
    };
    [of(&|rise| rise >= UPRIGHT, most), of(&|rise| rise <= FLAT, flattest)]
}
