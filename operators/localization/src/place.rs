//! Where on a map a sweep was taken.

use std::collections::BTreeMap;
use std::path::Path;

use nalgebra::{Isometry3, Matrix6, Vector3};
use realo_registration::{
    AlignError, Alignment, Around, MapError, Registrar, RegistrarSettings, Search, SettingError, VoxelMap,
};
use realo_schemas::PointCloud;
use realo_state_estimation::level;

/// Another pose that fits nearly as well makes both doubtful, in all directions or so far around, m: by so much of the share.
const DISTINCT: f64 = 0.08;
const FAR_AROUND: f64 = 7.0;
/// Headings are looked for so far to either side at least, rad, and by so many standard deviations.
const TURN: (f64, f64) = (0.18, 3.0);
/// A guess that is known to so much is tracked, m and rad; of any other a wider neighbourhood is searched.
const TRACKED: [f64; 2] = [0.6, 0.035];
/// Where a map ends, this part of the share is enough, if of the points in its voxels so many are near its surfaces.
const PART: f64 = 0.5;
const MET_SHARE: f64 = 0.85;
/// Standard deviations of places on a map of exact poses, if all of a sweep fits: on the ground along each axis, up, m, and of the heading,
/// rad. Measured on drives of another day than the map's. They go by the inverse square of the share that fits: with a half of
/// it they are four times as large.
const MATCHING: [f64; 3] = [0.005, 0.004, 4e-5];
/// They do not become larger below this share.
const LEAST_SHARE: f64 = 0.2;
/// What tells a place is so far away, m.
const FAR: f64 = 20.0;
/// Side of the cells in which the ground's height is known, m.
const GROUND_CELL: f64 = 4.0;
/// A place is on the map if the map has ground so many cells around it.
const AROUND: i32 = 5;

/// Why there is no map to look at.
#[derive(Debug, thiserror::Error)]
pub enum PlaceError {
    /// A file that is none.
    #[error(transparent)]
    Map(#[from] MapError),
    /// Settings that are none.
    #[error(transparent)]
    Settings(#[from] SettingError),
    /// A map without voxels.
    #[error("{0}: a map without voxels; build it by `realo map build`")]
    Empty(std::path::PathBuf),
}

/// A map, and what looks for sweeps on it.
pub(crate) struct Place {
    map: VoxelMap,
    registrar: Registrar,
    /// Height of the lowest voxel, m.
    ground: BTreeMap<[i32; 2], f64>,
    min_share: f64,
    /// What the map's poses add to [`Place::errors`].
    by_poses: [f64; 3],
}

/// What is known of a pose before the sweep is looked at.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Guess {
    pub position: Vector3<f64>,
    /// Heading, rad; `None` where it is not known.
    pub yaw: Option<f64>,
    /// Standard deviations of place and heading, m and rad.
    pub sigmas: [f64; 2],
    /// How far around it may be, m.
    pub radius: f64,
    /// Whether the height is of GNSS alone, so that the ground of the map knows it better.
    pub is_height_unsure: bool,
}

/// What came of looking for a sweep.
#[derive(Clone, Debug)]
pub(crate) enum Found {
    /// Its pose.
    Pose(Box<FoundPose>),
    /// The map is not like the sweep there.
    Unfit,
    /// It has too few points.
    FewPoints,
    /// The map does not reach there.
    OffMap,
}

/// A sweep's pose.
#[derive(Clone, Debug)]
pub(crate) struct FoundPose {
    pub map_from_body: Isometry3<f64>,
    /// See [`realo_state_estimation::ScanPose`].
    pub information: Matrix6<f64>,
    /// Share of what is off the ground that fits.
    pub share: f64,
}

impl Found {
    fn of(alignment: Alignment) -> Self {
        Found::Pose(Box::new(FoundPose {
            map_from_body: alignment.map_from_body,
            information: alignment.information,
            share: alignment.structure_share,
        }))
    }
}

impl From<AlignError> for Found {
    fn from(error: AlignError) -> Self {
        match error {
            AlignError::FewPoints { .. } => Found::FewPoints,
            AlignError::Guess(_) | AlignError::OffMap { .. } => Found::OffMap,
        }
    }
}

impl Place {
    /// Opens a map. Sweeps fit it where a share of at least `min_share` of what is off the ground does.
    ///
    /// # Errors
    /// [`PlaceError`]: a file that is no map, a map without voxels.
    pub fn open(path: &Path, min_share: f64) -> Result<Self, PlaceError> {
        Place::of(VoxelMap::open(path)?, min_share)?.ok_or_else(|| PlaceError::Empty(path.into()))
    }

    fn of(map: VoxelMap, min_share: f64) -> Result<Option<Self>, SettingError> {
        let mut ground: BTreeMap<[i32; 2], f64> = BTreeMap::new();
        for voxel in map.voxels() {
            let height = ground.entry(cell(&voxel.mean.coords)).or_insert(voxel.mean.z);
            *height = height.min(voxel.mean.z);
        }
        map.prepare();
        let place = Place {
            by_poses: by_poses(&map.info().pose_sigmas),
            map,
            registrar: Registrar::new(RegistrarSettings::default())?,
            ground,
            min_share,
        };
        Ok((!place.ground.is_empty()).then_some(place))
    }

    /// Standard deviations of what all sweeps of a place have in common, so that it does not average: on the ground along each axis, up,
    /// m, and of the heading, rad. `share`: how much of a sweep fits.
    pub fn errors(&self, share: f64) -> [f64; 3] {
        let share = share.clamp(LEAST_SHARE, 1.0);
        let own = MATCHING.map(|sigma| sigma / (share * share));
        std::array::from_fn(|i| libm::hypot(own[i], self.by_poses[i]))
    }

    /// The height of the ground at a place of the map, m; `None` where the map does not reach.
    fn ground(&self, position: &Vector3<f64>) -> Option<f64> {
        let [x, y] = cell(position);
        (0..=AROUND).find_map(|reach| {
            let columns = (x - reach..=x + reach).flat_map(|x| (y - reach..=y + reach).map(move |y| [x, y]));
            let heights = columns.filter_map(|cell| self.ground.get(&cell));
            heights.copied().reduce(f64::min)
        })
    }

    /// Looks for a sweep, points in the level body frame, m.
    pub fn look(&mut self, cloud: &PointCloud, guess: &Guess) -> Found {
        let Some(ground) = self.ground(&guess.position) else {
            return Found::OffMap;
        };
        let mut position = guess.position;
        if guess.is_height_unsure {
            position.z = ground;
        }
        let start = level(&position, guess.yaw.unwrap_or(0.0));
        let [place, turn] = guess.sigmas;
        let is_known = guess.yaw.is_some() && place <= TRACKED[0] && turn <= TRACKED[1];
        if is_known {
            match self.registrar.align(&self.map, cloud, &start, Search::Track) {
                Ok(found) if self.fits(&found) || self.fits_in_part(&found) => return Found::of(found),
                Ok(_) => {}
                Err(error) => return error.into(),
            }
        }
        let around = Around {
            guess: start,
            radius_m: guess.radius,
            turn_rad: guess.yaw.map_or(std::f64::consts::PI, |_| TURN.0.max(TURN.1 * turn)),
        };
        match self.registrar.find(&self.map, cloud, &around) {
            Ok(found) => {
                let is_near = guess.yaw.is_some() && guess.radius <= FAR_AROUND;
                let is_distinct = is_near || found.ahead >= DISTINCT;
                match is_distinct && self.fits(&found.best) {
                    true => Found::of(found.best),
                    false => Found::Unfit,
                }
            }
            Err(error) => error.into(),
        }
    }

    fn fits(&self, alignment: &Alignment) -> bool {
        alignment.is_settled() && alignment.structure_share >= self.min_share
    }

    /// Whether a sweep that is known to be near fits what there is of the map: at its ends, and in its gaps.
    fn fits_in_part(&self, alignment: &Alignment) -> bool {
        alignment.is_settled() && alignment.structure_share >= PART * self.min_share && alignment.met_share >= MET_SHARE
    }
}

/// What the standard deviations of a map's poses are for places that are found on it, as [`Place::errors`]: a heading moves what is far
/// away, too.
fn by_poses([ground, up, heading]: &[f64; 3]) -> [f64; 3] {
    [libm::hypot(*ground, FAR * heading), *up, *heading]
}

/// The cell of a place on the ground.
fn cell(position: &Vector3<f64>) -> [i32; 2] {
    // Casts bound what is too far, and take NaN to 0.
    [position.x, position.y].map(|at| (at / GROUND_CELL).floor().clamp(-1e9, 1e9) as i32)
}
