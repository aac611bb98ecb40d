//! A search from guesses that are some voxels off.
//!
//! A gradient leads to the right place from within a voxel or two only, and a sweep has places where it fits half: so starts on a
//! grid are compared first, several go on, and how much of what stands upright fits in the end decides.

use nalgebra::{Isometry3, Vector3};

use super::{Progress, Registrar, Stage, stepped};
use crate::gather::{CHUNK, Kernel, Placed, fitness};
use crate::map::VoxelMap;
use crate::rows::Sums;
use crate::sample::Sample;

/// Starts on each side of the guess: along x and y of the body, and of headings; and how far they are apart, voxels and degrees.
const STARTS: [i32; 2] = [2, 4];
const APART: [f64; 2] = [2.5, 2.5];
/// So many of them go on.
const BEST: usize = 6;
/// So many points are enough for comparing starts.
const POINTS: usize = 1500;
/// Widths of the kernel, first and last, in voxels, and the factor from one step to the next.
const WIDTHS: [f64; 2] = [0.75, 0.2];
const NARROWING: f64 = 0.7;
/// The last step on a level for voxels of 1 m: m, degrees.
const STOP: [f64; 2] = [0.02, 0.05];
/// Iterations on a level at most.
const MOST: u32 = 10;

/// A start: how far along the grid, and how well it fits.
struct Start {
    place: [i32; 3],
    pose: Isometry3<f64>,
    score: f64,
}

impl Registrar {
    /// The best fit around a guess; iterations are those of its own way.
    pub(super) fn search(&self, map: &VoxelMap, sample: &Sample, guess: &Isometry3<f64>) -> Progress {
        let few = sample.thinned(POINTS);
        let twice = map.coarser();
        let levels = [twice.coarser(), twice, map];
        let mut best: Option<(Progress, [u32; 2])> = None;
        for pose in far_apart(starts(map, levels[0], &few, guess)) {
            let mut progress = Progress::at(pose);
            levels
                .iter()
                .for_each(|level| self.run(&few, &mut progress, &on(level)));
            self.run(&few, &mut progress, &self.tracking(map));
            let fit = fit(&progress.sums);
            if best.as_ref().is_none_or(|(_, known)| fit > *known) {
                best = Some((progress, fit));
            }
        }
        // Where tracking alone gets there, nothing is better.
        let mut near = Progress::at(*guess);
        self.run(sample, &mut near, &self.tracking(map));
        let Some((mut far, _)) = best else { return near };
        self.run(sample, &mut far, &self.tracking(map));
        if fit(&far.sums) > fit(&near.sums) { far } else { near }
    }
}

/// Distributions on a map of any width.
fn on(map: &VoxelMap) -> Stage<'_> {
    let size = map.info().voxel_m;
    Stage {
        map,
        is_wide: true,
        widths: WIDTHS.map(|width| width * size),
        narrowing: NARROWING,
        stop: STOP.map(|stop| stop * size),
        most: MOST,
    }
}

/// How many points are on surfaces: first those that are not on horizontal ones, which fit at wrong places too.
fn fit(sums: &Sums) -> [u32; 2] {
    [sums.inliers - sums.on_ground, sums.inliers]
}

/// All starts around a guess, with how well they fit on a coarse map.
fn starts(map: &VoxelMap, coarse: &VoxelMap, sample: &Sample, guess: &Isometry3<f64>) -> Vec<Start> {
    let [most, turns] = STARTS;
    let kernel = Kernel {
        width: (WIDTHS[0] * coarse.info().voxel_m) as f32,
        inlier: 0.0,
        is_wide: true,
    };
    let mut all = Vec::new();
    for turn in -turns..=turns {
        for x in -most..=most {
            for y in -most..=most {
                let [shift, heading] = [APART[0] * map.info().voxel_m, APART[1].to_radians()];
                let pose = moved(
                    guess,
                    [f64::from(x) * shift, f64::from(y) * shift],
                    f64::from(turn) * heading,
                );
                let Some(placed) = Placed::new(coarse, &pose) else {
                    continue;
                };
                all.push(Start {
                    place: [x, y, turn],
                    score: score(coarse, &placed, sample, &kernel),
                    pose,
                });
            }
        }
    }
    all
}

/// How well a sample fits at a pose: sums of chunks in their order.
fn score(map: &VoxelMap, placed: &Placed, sample: &Sample, kernel: &Kernel) -> f64 {
    let chunks = (0..sample.len()).step_by(CHUNK).map(|from| {
        let range = from..sample.len().min(from + CHUNK);
        [&sample.x[range.clone()], &sample.y[range.clone()], &sample.z[range]]
    });
    chunks.map(|points| fitness(map, placed, points, kernel)).sum()
}

/// The best starts that are no neighbours of each other.
fn far_apart(mut all: Vec<Start>) -> Vec<Isometry3<f64>> {
    // Stable: of equal ones the first.
    all.sort_by(|a, b| b.score.total_cmp(&a.score));
    let mut best: Vec<Start> = Vec::new();
    for start in all {
        let is_near = |known: &Start| (0..3).all(|axis| (known.place[axis] - start.place[axis]).abs() <= 1);
        if best.len() < BEST && !best.iter().any(is_near) {
            best.push(start);
        }
    }
    best.into_iter().map(|start| start.pose).collect()
}

/// A pose that is shifted along its own x and y, and turned about the vertical.
fn moved(pose: &Isometry3<f64>, [x, y]: [f64; 2], turn: f64) -> Isometry3<f64> {
    let shift = pose.rotation * Vector3::new(x, y, 0.0);
    stepped(pose, &[shift.x, shift.y, shift.z, 0.0, 0.0, turn])
}
