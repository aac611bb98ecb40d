//! Where a sweep was taken, by a map.

mod survey;
mod wide;

use nalgebra::{Isometry3, Matrix6, Quaternion, Translation3, UnitQuaternion, Vector3, Vector6};
use rayon::prelude::*;
use realo_schemas::PointCloud;

use crate::error::{AlignError, SettingError};
use crate::gather::{CHUNK, Kernel, Placed, gather};
use crate::map::VoxelMap;
use crate::observe::{Direction, Observed};
use crate::rows::Sums;
use crate::sample::{Sample, Sampler};

pub use wide::{Around, FoundAround};

/// Largest turn of one step, rad; the largest shift is a voxel.
const MAX_TURN: f64 = 0.1;
/// Tracking begins with a kernel this many times as wide, for guesses are off by more than sensors are, and narrows it by a factor.
const WIDENING: f64 = 2.5;
const NARROWING: f64 = 0.6;
/// Distances have at least this variance, m²: sensors and maps are not better than 2 cm.
const MIN_VARIANCE: f64 = 0.02 * 0.02;
/// A pose whose last step was longer is still on its way, m and rad. Steps need not become as short as the registrar would have them:
/// points that change voxels move a pose to and fro by some millimetres.
const SETTLED: [f64; 2] = [0.02, 1e-3];

/// How sweeps are aligned.
#[derive(Clone, Debug, PartialEq)]
pub struct RegistrarSettings {
    /// Side of the cells of which one point each is used, m; 0.1 to 10.
    pub sample_m: f64,
    /// Points nearer and farther than this from the body's origin are left out, m.
    pub range_m: [f64; 2],
    /// Points that a sweep must have after sampling; 6 to 1,000,000.
    pub min_points: u32,
    /// Width of the Geman-McClure kernel, m; 0.01 to 10.
    pub kernel_m: f64,
    /// Iterations of tracking at most; 1 to 1,000.
    pub max_iterations: u32,
    /// A step that is shorter, and turns by less, is the last: m; 1e-6 to 1.
    pub stop_m: f64,
    /// The same, degrees; 1e-6 to 10.
    pub stop_deg: f64,
    /// Directions that a smaller share of the points tells keep the guess; 0 to 1.
    pub degenerate_share: f64,
}

impl Default for RegistrarSettings {
    fn default() -> Self {
        RegistrarSettings {
            sample_m: 1.0,
            range_m: [2.0, 100.0],
            min_points: 100,
            kernel_m: 0.3,
            max_iterations: 20,
            stop_m: 1e-3,
            stop_deg: 0.01,
            degenerate_share: 0.01,
        }
    }
}

impl RegistrarSettings {
    /// Checks all settings.
    ///
    /// # Errors
    /// The first that is out of its range.
    pub fn check(&self) -> Result<(), SettingError> {
        let [near, far] = self.range_m;
        let settings = [
            ("sample_m", self.sample_m, 0.1, 10.0),
            ("range_m, near", near, 0.0, 1000.0),
            ("range_m, far", far, near, 1000.0),
            ("min_points", f64::from(self.min_points), 6.0, 1e6),
            ("kernel_m", self.kernel_m, 0.01, 10.0),
            ("max_iterations", f64::from(self.max_iterations), 1.0, 1000.0),
            ("stop_m", self.stop_m, 1e-6, 1.0),
            ("stop_deg", self.stop_deg, 1e-6, 10.0),
            ("degenerate_share", self.degenerate_share, 0.0, 1.0),
        ];
        settings
            .into_iter()
            .try_for_each(|(name, found, min, max)| SettingError::check(name, found, min, max))
    }
}

/// How far from the guess a pose is looked for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Search {
    /// Within half a voxel or so: planes, each in a point's own voxel.
    Track,
    /// Within five voxels and ten degrees of heading, after a loss: what stands upright is compared from above on a grid of starts; the
    /// best go on with distributions in seven voxels, ever smaller, then as [`Search::Track`]; the one that fits best in the end
    /// counts. It takes some ten times as long. [`Registrar::find`] looks farther, and in all directions.
    Wide,
}

/// Where a sweep was taken, and how well that is known.
#[derive(Clone, Debug, PartialEq)]
pub struct Alignment {
    /// The body's pose in the frame of the map's poses.
    pub map_from_body: Isometry3<f64>,
    /// Information of the pose, 1/m² and 1/rad², over shifts along x, y, z and turns about x, y, z, in the map's axes and about the
    /// body's origin.
    ///
    /// Distances count as independent, with the variance that they have. They are not: the map has its errors too. So a filter adds
    /// some of its own. Along degenerate directions it is small, not 0.
    pub information: Matrix6<f64>,
    /// Its eigenvectors, the one that is told worst first.
    pub directions: [Direction; 6],
    /// Length by which turns and shifts are compared in them, m.
    pub lever_m: f64,
    /// Points after sampling.
    pub points: usize,
    /// Share of them within the kernel's width of a surface, 0 to 1.
    pub inlier_share: f64,
    /// The same share among those that are not on horizontal planes, which are alike everywhere: the map of another place has a low one.
    pub structure_share: f64,
    /// The same share among those in voxels of the map: it is high on a map that ends, or has gaps, and low on one of another place.
    pub met_share: f64,
    /// Mean distance of inliers from their surfaces, m; 0 without any.
    pub mean_distance_m: f64,
    /// Steps that were made.
    pub iterations: u32,
    /// Whether the last step was short enough.
    pub converged: bool,
    /// The shift of the last step, m, and its turn, rad.
    pub last_step: [f64; 2],
}

impl Alignment {
    /// Whether some direction is degenerate.
    pub fn is_degenerate(&self) -> bool {
        self.directions.iter().any(|direction| direction.is_degenerate)
    }

    /// Whether the pose is where its steps lead.
    pub fn is_settled(&self) -> bool {
        let [shift, turn] = self.last_step;
        shift <= SETTLED[0] && turn <= SETTLED[1]
    }

    /// The information with variances that are larger by `floor_m`², which turns have at the lever; degenerate directions weigh nothing.
    pub fn weighed(&self, floor_m: f64) -> Matrix6<f64> {
        let scale = |axis: usize| if axis < 3 { 1.0 } else { self.lever_m };
        let mut weighed = Matrix6::zeros();
        for direction in self.directions.iter().filter(|direction| !direction.is_degenerate) {
            let vector = Vector6::from(direction.vector);
            let unscaled = Vector6::from_fn(|axis, _| vector[axis] / scale(axis));
            let told = unscaled.dot(&(self.information * unscaled));
            // False for what is not a number too.
            if told > 0.0 {
                let scaled = Vector6::from_fn(|axis, _| vector[axis] * scale(axis));
                weighed += scaled * scaled.transpose() / (1.0 / told + floor_m * floor_m);
            }
        }
        weighed
    }
}

/// Aligns sweeps with maps; keeps its memory from one to the next.
///
/// It computes on the threads of the current pool of `rayon`. The same bits come out with any number of them.
#[derive(Clone, Debug)]
pub struct Registrar {
    settings: RegistrarSettings,
    sampler: Sampler,
}

/// A part of a search.
struct Stage<'a> {
    map: &'a VoxelMap,
    is_wide: bool,
    /// The kernel's width at the first step, its factor from one step to the next, and its width at last, m.
    widths: [f64; 2],
    narrowing: f64,
    /// A step that is shorter, and turns by less, is the last: m, degrees.
    stop: [f64; 2],
    /// Iterations at most.
    most: u32,
}

/// A pose on its way.
#[derive(Clone, Debug)]
struct Progress {
    pose: Isometry3<f64>,
    iterations: u32,
    converged: bool,
    last_step: [f64; 2],
    /// Of the pose before the last step.
    sums: Sums,
}

impl Progress {
    fn at(pose: Isometry3<f64>) -> Self {
        Progress {
            pose,
            iterations: 0,
            converged: false,
            last_step: [f64::INFINITY; 2],
            sums: Sums::default(),
        }
    }
}

impl Registrar {
    /// A registrar.
    ///
    /// # Errors
    /// A setting out of its range.
    pub fn new(settings: RegistrarSettings) -> Result<Self, SettingError> {
        settings.check()?;
        Ok(Registrar {
            sampler: Sampler::new(settings.sample_m, settings.range_m),
            settings,
        })
    }

    /// Finds the pose of a sweep near a guess. `cloud`: points in the body frame, m, without the agent's own motion and body.
    ///
    /// A pose that does not fit is no error: [`Alignment::converged`], [`Alignment::structure_share`] and
    /// [`Alignment::directions`] tell. Where no point meets the map, the guess comes back with shares of 0.
    ///
    /// # Errors
    /// [`AlignError`]: too few points, or a guess that is no place on the map.
    pub fn align(
        &mut self,
        map: &VoxelMap,
        cloud: &PointCloud,
        guess: &Isometry3<f64>,
        search: Search,
    ) -> Result<Alignment, AlignError> {
        let sample = self.checked(map, cloud, guess)?;
        let progress = match search {
            Search::Track => {
                let mut progress = Progress::at(*guess);
                self.run(&sample, &mut progress, &self.tracking(map));
                progress
            }
            Search::Wide => self.search(map, &sample, guess),
        };
        Ok(self.alignment(progress, sample.len()))
    }

    /// The points of a sweep that are aligned, once they and the guess are some.
    fn checked(&mut self, map: &VoxelMap, cloud: &PointCloud, guess: &Isometry3<f64>) -> Result<Sample, AlignError> {
        let place = guess.translation.vector;
        if !(guess.rotation.coords.iter().chain(&place).all(|part| part.is_finite())) {
            return Err(AlignError::Guess(place.into()));
        }
        let found = (place - map.info().origin.coords).amax();
        if found > map.reach_m() {
            return Err(AlignError::OffMap {
                limit: map.reach_m(),
                found,
            });
        }
        let sample = self.sampler.sample(cloud);
        if sample.len() < self.settings.min_points as usize {
            return Err(AlignError::FewPoints {
                expected: self.settings.min_points as usize,
                found: sample.len(),
                range_m: self.settings.range_m,
            });
        }
        Ok(sample)
    }

    /// Planes in the map's own voxels.
    fn tracking<'a>(&self, map: &'a VoxelMap) -> Stage<'a> {
        let settings = &self.settings;
        Stage {
            map,
            is_wide: false,
            widths: [WIDENING * settings.kernel_m, settings.kernel_m],
            narrowing: NARROWING,
            stop: [settings.stop_m, settings.stop_deg],
            most: settings.max_iterations,
        }
    }

    /// Steps until they are short or there were enough.
    fn run(&self, sample: &Sample, progress: &mut Progress, stage: &Stage) {
        let [mut width, last_width] = stage.widths;
        progress.converged = false;
        let until = progress.iterations.saturating_add(stage.most);
        while !progress.converged && progress.iterations < until {
            let kernel = Kernel {
                width: width.max(last_width) as f32,
                inlier: self.settings.kernel_m as f32,
                is_wide: stage.is_wide,
            };
            let Some(placed) = Placed::new(stage.map, &progress.pose) else {
                return;
            };
            progress.sums = sums(stage.map, &placed, sample, &kernel);
            progress.iterations += 1;
            let Some(observed) = Observed::new(&progress.sums, self.settings.degenerate_share) else {
                return;
            };
            let step = limited(observed.step, stage.map.info().voxel_m);
            progress.pose = stepped(&progress.pose, &step);
            let [shift, turn] = lengths(&step);
            let [stop_m, stop_deg] = stage.stop;
            // A kernel that still narrows moves the pose on.
            progress.converged = shift < stop_m && turn.to_degrees() < stop_deg && width <= last_width;
            progress.last_step = [shift, turn];
            width *= stage.narrowing;
        }
    }

    fn alignment(&self, progress: Progress, points: usize) -> Alignment {
        let sums = &progress.sums;
        let observed = Observed::new(sums, self.settings.degenerate_share);
        let variance = (sums.square / sums.weight).max(MIN_VARIANCE);
        let inliers = f64::from(sums.inliers);
        let [points_off, met_off, inliers_off] =
            [points as f64, f64::from(sums.met), inliers].map(|all| all - f64::from(sums.on_ground));
        let share = |part: f64, all: f64| if all > 0.0 { part / all } else { 0.0 };
        let unknown = |k: usize| Direction {
            share: 0.0,
            vector: std::array::from_fn(|i| f64::from(u8::from(i == k))),
            is_degenerate: true,
        };
        Alignment {
            map_from_body: progress.pose,
            information: Matrix6::from_fn(|i, j| sums.matrix()[i][j] / variance),
            lever_m: observed.as_ref().map_or(1.0, |observed| observed.lever_m),
            directions: observed.map_or_else(|| std::array::from_fn(unknown), |observed| observed.directions),
            points,
            inlier_share: share(inliers, points as f64),
            structure_share: share(inliers_off, points_off),
            met_share: share(inliers_off, met_off),
            mean_distance_m: share(sums.distance, inliers),
            iterations: progress.iterations,
            converged: progress.converged,
            last_step: progress.last_step,
        }
    }
}

/// The sums of all points, chunk by chunk in their order.
fn sums(map: &VoxelMap, placed: &Placed, sample: &Sample, kernel: &Kernel) -> Sums {
    let of = |chunk: usize| {
        let range = chunk * CHUNK..sample.len().min((chunk + 1) * CHUNK);
        let points = [&sample.x[range.clone()], &sample.y[range.clone()], &sample.z[range]];
        gather(map, placed, points, kernel)
    };
    let chunks = sample.len().div_ceil(CHUNK);
    let parts: Vec<Sums> = match rayon::current_num_threads() {
        1 => (0..chunks).map(of).collect(),
        _ => (0..chunks).into_par_iter().map(of).collect(),
    };
    let mut all = Sums::default();
    parts.iter().for_each(|part| all.add(part));
    all
}

/// The lengths of a step's shift, m, and turn, rad.
fn lengths(step: &[f64; 6]) -> [f64; 2] {
    [0, 3].map(|from| step[from..from + 3].iter().map(|part| part * part).sum::<f64>().sqrt())
}

/// The step, made shorter as a whole where it is too long.
fn limited(step: [f64; 6], max_shift: f64) -> [f64; 6] {
    let [shift, turn] = lengths(&step);
    let by = (max_shift / shift).min(MAX_TURN / turn).min(1.0);
    step.map(|part| part * by)
}

/// The pose after a step: shifted, and turned about the body's origin.
fn stepped(pose: &Isometry3<f64>, step: &[f64; 6]) -> Isometry3<f64> {
    let [x, y, z, turn @ ..] = *step;
    let [_, angle] = lengths(step);
    let (sin, cos) = libm::sincos(0.5 * angle);
    let per_turn = if angle > 0.0 { sin / angle } else { 0.5 };
    let [i, j, k] = turn.map(|part| part * per_turn);
    let turn = UnitQuaternion::new_normalize(Quaternion::new(cos, i, j, k));
    Isometry3::from_parts(
        Translation3::from(pose.translation.vector + Vector3::new(x, y, z)),
        UnitQuaternion::new_normalize((turn * pose.rotation).into_inner()),
    )
}

#[cfg(test)]
mod tests;
