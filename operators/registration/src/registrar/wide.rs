//! A search from guesses that are some voxels off, or say nothing of the heading.
//!
//! A gradient leads to the right place from within a voxel or two only, and a sweep has places where it fits half: so starts on a
//! grid are compared first, several go on, and how much of what stands upright fits in the end decides.

use nalgebra::{Isometry3, Vector3};
use realo_schemas::PointCloud;
use realo_schemas::geometry::{normalize_yaw, yaw_of};

use super::survey::starts;
use super::{Alignment, Progress, Registrar, Stage, stepped};
use crate::error::AlignError;
use crate::map::VoxelMap;
use crate::rows::Sums;
use crate::sample::Sample;

/// How far [`Search::Wide`](super::Search::Wide) looks around a guess: voxels, degrees.
const REACH: [f64; 2] = [6.0, 12.0];
/// So many starts go on where the heading is known, and where it is not.
const BEST: [usize; 2] = [6, 12];
/// So many points are enough for comparing where they lead.
const POINTS: usize = 350;
/// Widths of the kernel, first and last, in voxels, and the factor from one step to the next.
const WIDTHS: [f64; 2] = [0.75, 0.2];
const NARROWING: f64 = 0.7;
/// The last step on a level for voxels of 1 m: m, degrees.
const STOP: [f64; 2] = [0.02, 0.05];
/// Iterations on a level at most.
const MOST: u32 = 10;
/// Poses that differ by more are others: m, rad.
const OTHER: [f64; 2] = [5.0, 0.35];

/// Where a sweep is looked for.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Around {
    /// The middle.
    pub guess: Isometry3<f64>,
    /// How far from there, on the ground, m.
    pub radius_m: f64,
    /// How far turned to either side, rad; π for all headings.
    pub turn_rad: f64,
}

/// What was found around a guess.
#[derive(Clone, Debug, PartialEq)]
pub struct FoundAround {
    /// What fits best.
    pub best: Alignment,
    /// By how much its share of what stands upright is larger than that of the next pose, which is more than 5 m or 20° away.
    pub ahead: f64,
}

impl Registrar {
    /// Finds the pose of a sweep in a wider neighbourhood, or in any direction. It takes some ten times as long as [`Self::align`].
    ///
    /// # Errors
    /// As [`Self::align`].
    pub fn find(&mut self, map: &VoxelMap, cloud: &PointCloud, around: &Around) -> Result<FoundAround, AlignError> {
        let sample = self.checked(map, cloud, &around.guess)?;
        let (progress, ahead) = self.around(map, &sample, around);
        let best = self.alignment(progress, sample.len());
        Ok(FoundAround { best, ahead })
    }

    /// The best fit around a guess, wherever tracking alone does not get there.
    pub(super) fn search(&self, map: &VoxelMap, sample: &Sample, guess: &Isometry3<f64>) -> Progress {
        let around = Around {
            guess: *guess,
            radius_m: REACH[0] * map.info().voxel_m,
            turn_rad: REACH[1].to_radians(),
        };
        self.around(map, sample, &around).0
    }

    /// The best fit, and by how much more of it fits than of another pose; iterations are those of its own way.
    fn around(&self, map: &VoxelMap, sample: &Sample, around: &Around) -> (Progress, f64) {
        let few = sample.thinned(POINTS);
        let twice = map.coarser();
        let is_turned = around.turn_rad >= std::f64::consts::FRAC_PI_2;
        let mut ends: Vec<Progress> = Vec::new();
        for start in starts(map, sample, around, BEST[usize::from(is_turned)]) {
            let mut progress = Progress::at(start);
            for level in [twice, map] {
                self.run(&few, &mut progress, &on(level));
            }
            self.run(&few, &mut progress, &self.tracking(map));
            ends.push(progress);
        }
        // Where tracking alone gets there, nothing is better.
        let mut near = Progress::at(around.guess);
        if !is_turned {
            self.run(sample, &mut near, &self.tracking(map));
        }
        // Of equal ones the first.
        ends.sort_by_key(|end| std::cmp::Reverse(fit(&end.sums)));
        let Some(first) = ends.first() else { return (near, 0.0) };
        let others = ends.iter().filter(|end| is_other(&end.pose, &first.pose));
        let share = |end: &Progress| self.share(end, few.len());
        let next = others.map(share).fold(0.0, f64::max);
        let ahead = share(first) - next;
        let mut far = ends.swap_remove(0);
        self.run(sample, &mut far, &self.tracking(map));
        if fit(&far.sums) > fit(&near.sums) {
            (far, ahead)
        } else {
            (near, ahead)
        }
    }

    fn share(&self, progress: &Progress, points: usize) -> f64 {
        self.alignment(progress.clone(), points).structure_share
    }
}

fn is_other(a: &Isometry3<f64>, b: &Isometry3<f64>) -> bool {
    let apart = (a.translation.vector - b.translation.vector).xy().norm();
    let turned = normalize_yaw(yaw_of(&a.rotation) - yaw_of(&b.rotation)).abs();
    apart > OTHER[0] || turned > OTHER[1]
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

/// A pose that is shifted, and turned about the vertical through it.
pub(super) fn moved(pose: &Isometry3<f64>, shift: Vector3<f64>, turn: f64) -> Isometry3<f64> {
    stepped(pose, &[shift.x, shift.y, shift.z, 0.0, 0.0, turn])
}
