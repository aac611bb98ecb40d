//! Where on a map a sweep was taken.

use std::collections::BTreeMap;
use std::path::Path;

use nalgebra::{Isometry3, Matrix6, Translation3, UnitQuaternion, Vector3};
use realo_registration::{
    AlignError, Alignment, MapError, Registrar, RegistrarSettings, Search, SettingError, VoxelMap,
};
use realo_schemas::PointCloud;
use realo_schemas::geometry::normalize_yaw;

/// Headings that are tried where none is known.
const HEADINGS: u32 = 24;
/// The best of them are looked at closely.
const CLOSELY: usize = 3;
/// Another heading that fits nearly as well makes both doubtful: by so much of the share.
const DISTINCT: f64 = 0.08;
/// Headings that differ by less are one, rad.
const ONE_HEADING: f64 = 0.35;
/// A guess that is known to so much is tracked, m and rad; of any other a wider neighbourhood is searched.
const TRACKED: [f64; 2] = [0.6, 0.035];
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
    /// Quick and coarse: ranks headings.
    scout: Registrar,
    /// Height of the lowest voxel, m.
    ground: BTreeMap<[i32; 2], f64>,
    min_share: f64,
}

/// What is known of a pose before the sweep is looked at.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Guess {
    pub position: Vector3<f64>,
    /// Heading, rad; `None` where it is not known.
    pub yaw: Option<f64>,
    /// Standard deviations of place and heading, m and rad.
    pub sigmas: [f64; 2],
    /// Whether the height is of GNSS alone, so that the ground of the map knows it better.
    pub is_height_unsure: bool,
}

/// What came of looking for a sweep.
#[derive(Clone, Debug)]
pub(crate) enum Found {
    /// Its pose, and the pose's information, see [`realo_state_estimation::ScanPose`].
    Pose(Box<(Isometry3<f64>, Matrix6<f64>)>),
    /// The map is not like the sweep there.
    Unfit,
    /// It has too few points.
    FewPoints,
    /// The map does not reach there.
    OffMap,
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
        let scout = RegistrarSettings {
            sample_m: 2.0,
            min_points: 50,
            max_iterations: 10,
            ..RegistrarSettings::default()
        };
        let place = Place {
            map,
            registrar: Registrar::new(RegistrarSettings::default())?,
            scout: Registrar::new(scout)?,
            ground,
            min_share,
        };
        Ok((!place.ground.is_empty()).then_some(place))
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
        let Some(yaw) = guess.yaw else {
            let best = self.in_all_directions(cloud, &position);
            return self.found(best);
        };
        let start = level(&position, yaw);
        let [place, turn] = guess.sigmas;
        let is_known = place <= TRACKED[0] && turn <= TRACKED[1];
        if is_known {
            let tracked = self.registrar.align(&self.map, cloud, &start, Search::Track);
            if tracked.as_ref().map_or(true, |found| self.fits(found)) {
                return self.found(tracked);
            }
        }
        let wide = self.registrar.align(&self.map, cloud, &start, Search::Wide);
        self.found(wide)
    }

    fn fits(&self, alignment: &Alignment) -> bool {
        alignment.converged && alignment.structure_share >= self.min_share
    }

    fn found(&self, alignment: Result<Alignment, AlignError>) -> Found {
        match alignment {
            Ok(found) if self.fits(&found) => Found::Pose(Box::new((found.map_from_body, found.information))),
            Ok(_) => Found::Unfit,
            Err(AlignError::FewPoints { .. }) => Found::FewPoints,
            Err(AlignError::Guess(_) | AlignError::OffMap { .. }) => Found::OffMap,
        }
    }

    /// The pose that fits best of all headings around a place; one that another heading nearly reaches does not fit.
    fn in_all_directions(&mut self, cloud: &PointCloud, position: &Vector3<f64>) -> Result<Alignment, AlignError> {
        let mut ranked = Vec::new();
        for step in 0..HEADINGS {
            let yaw = std::f64::consts::TAU * f64::from(step) / f64::from(HEADINGS);
            ranked.push(
                self.scout
                    .align(&self.map, cloud, &level(position, yaw), Search::Wide)?,
            );
        }
        ranked.sort_by(|a, b| b.structure_share.total_cmp(&a.structure_share));
        let mut close = Vec::new();
        for coarse in ranked.iter().take(CLOSELY) {
            close.push(
                self.registrar
                    .align(&self.map, cloud, &coarse.map_from_body, Search::Wide)?,
            );
        }
        close.sort_by(|a, b| b.structure_share.total_cmp(&a.structure_share));
        let best = close.swap_remove(0);
        let heading = |found: &Alignment| realo_schemas::geometry::yaw_of(&found.map_from_body.rotation);
        let is_other = |found: &&Alignment| normalize_yaw(heading(found) - heading(&best)).abs() > ONE_HEADING;
        let others = ranked.iter().chain(&close).filter(is_other);
        let next = others.map(|found| found.structure_share).fold(0.0, f64::max);
        let is_distinct = best.structure_share >= next + DISTINCT;
        Ok(Alignment {
            converged: best.converged && is_distinct,
            ..best
        })
    }
}

/// The cell of a place on the ground.
fn cell(position: &Vector3<f64>) -> [i32; 2] {
    // Casts bound what is too far, and take NaN to 0.
    [position.x, position.y].map(|at| (at / GROUND_CELL).floor().clamp(-1e9, 1e9) as i32)
}

/// A level pose.
pub(crate) fn level(position: &Vector3<f64>, yaw: f64) -> Isometry3<f64> {
    let (sin, cos) = libm::sincos(0.5 * yaw);
    let turn = UnitQuaternion::new_normalize(nalgebra::Quaternion::new(cos, 0.0, 0.0, sin));
    Isometry3::from_parts(Translation3::from(*position), turn)
}
