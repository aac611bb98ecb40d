//! Builds a voxel map from sweeps with poses.
//!
//! # What moves
//! A cell becomes a voxel only if
//!
//! 1. it has enough points, of `min_sweeps` sweeps or more, the first and the last of them `apart_s` s or more apart. What drives past is
//!    in a cell for less, and stray points are in few sweeps.
//! 2. it was seldom seen empty. Twice a second each agent's sweep is kept as a picture of ranges, 1° wide and high. A cell near
//!    the sensor that such a sweep did not hit, and that all points around its direction lie behind, was empty then. If that is so for
//!    more than `empty_share` of the pictures that decide, the cell is left out: lanes in which one vehicle follows another, the place of
//!    one that waited at lights and drove off, and of a car that was parked on one day only.
//!
//! What stands still whenever it is seen is in the map; so build it from drives of several days where parked cars are many.

use std::collections::BTreeMap;

use nalgebra::{Isometry3, Point3, Vector3};
use realo_schemas::{Nanos, PointCloud, to_seconds};

use crate::cell::{NO_CELL, cell_of, key_of};
use crate::error::{BuildError, MAX_PLACE_M, SettingError};
use crate::file::made;
use crate::map::{Closure, MapInfo, VoxelMap};
use crate::table::CellTable;
use crate::view::View;
use crate::voxel::{BYTES, Moments};

/// From one picture of an agent to its next, ns.
const VIEW_PERIOD: Nanos = 500_000_000;
/// Cells that are farther from the sensor are not called empty: there, bins of 1° see over them, m.
const VIEW_RANGE_M: f64 = 30.0;
/// Pictures that must show a cell empty.
const MIN_EMPTY: u32 = 2;

/// How a map is built.
#[derive(Clone, Debug, PartialEq)]
pub struct MapSettings {
    /// Side of a voxel, m; 0.05 to 10.
    pub voxel_m: f64,
    /// Surfaces are taken to be at least this thick (standard deviation), m; 0.001 to 1.
    pub thickness_m: f64,
    /// Points nearer and farther than this from the body's origin are left out, m.
    pub range_m: [f64; 2],
    /// Points that a voxel takes; 4 to 8,191.
    pub min_points: u32,
    /// Sweeps that must hit a voxel; 1 to 1,000.
    pub min_sweeps: u32,
    /// Seconds from the first to the last of them; 0 to 1,000,000.
    pub apart_s: f64,
    /// A cell that more than this share of pictures show empty is left out; 0 to 1, and 1 keeps all.
    pub empty_share: f64,
}

impl Default for MapSettings {
    fn default() -> Self {
        MapSettings {
            voxel_m: 1.0,
            thickness_m: 0.05,
            range_m: [3.0, 80.0],
            min_points: 10,
            min_sweeps: 3,
            apart_s: 1.0,
            empty_share: 0.25,
        }
    }
}

impl MapSettings {
    /// Checks all settings.
    ///
    /// # Errors
    /// The first that is out of its range.
    pub fn check(&self) -> Result<(), SettingError> {
        let [near, far] = self.range_m;
        let settings = [
            ("voxel_m", self.voxel_m, 0.05, 10.0),
            ("thickness_m", self.thickness_m, 1e-3, 1.0),
            ("range_m, near", near, 0.0, 1000.0),
            ("range_m, far", far, near, 1000.0),
            ("min_points", f64::from(self.min_points), 4.0, 8191.0),
            ("min_sweeps", f64::from(self.min_sweeps), 1.0, 1000.0),
            ("apart_s", self.apart_s, 0.0, 1e6),
            ("empty_share", self.empty_share, 0.0, 1.0),
        ];
        settings
            .into_iter()
            .try_for_each(|(name, found, min, max)| SettingError::check(name, found, min, max))
    }
}

/// A sweep and where it was taken.
#[derive(Clone, Copy, Debug)]
pub struct PosedSweep<'a> {
    /// Whose it is.
    pub agent: &'a str,
    /// Its stamp, ns.
    pub stamp: Nanos,
    /// Points in the body frame at the stamp: without the agent's own motion and body.
    pub cloud: &'a PointCloud,
    /// Where the body was.
    pub map_from_body: &'a Isometry3<f64>,
    /// Where the LiDAR is in the body frame, m.
    pub sensor: [f64; 3],
    /// Standard deviations of the pose: on the ground along each axis, up, m, and of the heading, rad. 0 for an exact one.
    pub sigmas: [f64; 3],
}

/// What is known of a cell so far.
#[derive(Clone, Copy, Debug)]
struct CellStats {
    moments: Moments,
    /// Stamps of the first and the last sweep that hit it.
    span: [Nanos; 2],
    /// Sweeps that hit it.
    sweeps: u32,
    /// The last of them, by its number.
    last_sweep: u64,
    /// Pictures that show a hit.
    shown: u32,
}

/// Takes sweeps, and makes a map of them.
///
/// The same sweeps in the same order give the same bytes on every machine.
pub struct MapBuilder {
    settings: MapSettings,
    frame: String,
    /// Lower corner of cell (0, 0, 0); set by the first sweep.
    origin: Option<Point3<f64>>,
    table: CellTable,
    cells: Vec<CellStats>,
    views: Vec<View>,
    /// Stamps of each agent's last picture, by day: what runs backwards is another drive.
    last_views: BTreeMap<String, Nanos>,
    sweeps: u64,
    /// Sums over sweeps of the squares of their poses' standard deviations.
    squares: [f64; 3],
    span: [Nanos; 2],
    closure: Option<Closure>,
}

impl MapBuilder {
    /// Begins a map in the frame of this name.
    ///
    /// # Errors
    /// A setting out of its range.
    pub fn new(settings: MapSettings, frame: &str) -> Result<Self, SettingError> {
        settings.check()?;
        Ok(MapBuilder {
            settings,
            frame: frame.into(),
            origin: None,
            table: CellTable::with_capacity(1 << 16),
            cells: Vec::new(),
            views: Vec::new(),
            last_views: BTreeMap::new(),
            sweeps: 0,
            squares: [0.0; 3],
            span: [Nanos::MAX, Nanos::MIN],
            closure: None,
        })
    }

    /// Says how a pose graph found the poses of the sweeps.
    pub fn closed(&mut self, closure: Closure) {
        self.closure = Some(closure);
    }

    /// Sweeps that were added.
    pub fn sweeps(&self) -> u64 {
        self.sweeps
    }

    /// Adds a sweep; points that are not finite or out of range are left out.
    ///
    /// # Errors
    /// [`BuildError::Pose`], [`BuildError::Far`]; the map stays as it was.
    pub fn add(&mut self, sweep: &PosedSweep) -> Result<(), BuildError> {
        let place = sweep.map_from_body.translation.vector;
        let rotation = sweep.map_from_body.rotation;
        let finite = rotation.coords.iter().all(|part| part.is_finite());
        // False for what is not a number too.
        if !(finite && place.iter().all(|part| part.abs() <= MAX_PLACE_M)) {
            return Err(BuildError::Pose {
                agent: sweep.agent.into(),
                stamp: sweep.stamp,
                found: place.into(),
            });
        }
        let origin = self.origin.unwrap_or_else(|| self.origin_at(&place));
        let limit = f64::from(1 << 19) * self.settings.voxel_m;
        let found = (place - origin.coords).norm();
        if found > limit {
            return Err(BuildError::Far {
                agent: sweep.agent.into(),
                stamp: sweep.stamp,
                limit,
                found,
            });
        }
        self.origin = Some(origin);
        self.span = [self.span[0].min(sweep.stamp), self.span[1].max(sweep.stamp)];
        self.sweeps += 1;
        for (sum, sigma) in self.squares.iter_mut().zip(sweep.sigmas) {
            *sum += sigma * sigma;
        }
        self.add_points(sweep, &origin);
        Ok(())
    }

    /// A corner near the first place, half a voxel lower: so flat ground is in the middle of its cells rather than on their border.
    fn origin_at(&self, place: &Vector3<f64>) -> Point3<f64> {
        let size = self.settings.voxel_m;
        let [x, y] = [place.x, place.y].map(|part| (part / size).floor() * size);
        Point3::new(x, y, place.z - 0.5 * size)
    }

    fn add_points(&mut self, sweep: &PosedSweep, origin: &Point3<f64>) {
        let pose = Isometry3::from_parts(
            (sweep.map_from_body.translation.vector - origin.coords).into(),
            sweep.map_from_body.rotation,
        );
        let mut view = self.view_is_due(sweep).then(|| {
            let sensor = pose * Point3::from(sweep.sensor);
            View::new(sensor.coords)
        });
        let size = self.settings.voxel_m;
        let [near, far] = self.settings.range_m.map(|range| (range * range) as f32);
        let cloud = sweep.cloud;
        for ((x, y), z) in cloud.x.iter().zip(cloud.y.iter()).zip(cloud.z.iter()) {
            let square = x * x + y * y + z * z;
            // False for what is not a number too.
            if !(square >= near && square <= far) {
                continue;
            }
            let point = (pose * Point3::new(f64::from(*x), f64::from(*y), f64::from(*z))).coords;
            if let Some(view) = &mut view {
                view.add(&point);
            }
            let cell = [point.x, point.y, point.z].map(|part| (part / size).floor());
            let key = key_of(cell.map(|number| number as i32));
            if key != NO_CELL {
                let from_centre = std::array::from_fn(|i| point[i] - (cell[i] + 0.5) * size);
                self.hit(key, from_centre, sweep.stamp, view.is_some());
            }
        }
        self.views.extend(view);
    }

    /// Whether an agent's last picture is old enough; then this is the last one. No picture decides where all cells are kept.
    fn view_is_due(&mut self, sweep: &PosedSweep) -> bool {
        if self.settings.empty_share >= 1.0 {
            return false;
        }
        let last = self.last_views.get(sweep.agent);
        let due = last.is_none_or(|last| sweep.stamp.saturating_sub(*last).saturating_abs() >= VIEW_PERIOD);
        if due {
            self.last_views.insert(sweep.agent.into(), sweep.stamp);
        }
        due
    }

    fn hit(&mut self, key: u64, from_centre: [f64; 3], stamp: Nanos, is_shown: bool) {
        let place = self.table.get_or_insert(key) as usize;
        if place == self.cells.len() {
            self.cells.push(CellStats {
                moments: Moments::default(),
                span: [stamp; 2],
                sweeps: 0,
                last_sweep: 0,
                shown: 0,
            });
        }
        let cell = &mut self.cells[place];
        cell.moments.add(from_centre);
        if cell.last_sweep != self.sweeps {
            cell.last_sweep = self.sweeps;
            cell.span = [cell.span[0].min(stamp), cell.span[1].max(stamp)];
            cell.sweeps += 1;
            cell.shown += u32::from(is_shown);
        }
    }

    /// The map of all sweeps; `progress` is told how many of how many cells are decided.
    ///
    /// # Errors
    /// [`BuildError::Empty`] if nothing was seen often enough.
    pub fn finish(self, mut progress: impl FnMut(usize, usize)) -> Result<VoxelMap, BuildError> {
        let settings = &self.settings;
        let mut order: Vec<(u64, u32)> = self.table.keys().collect();
        order.sort_unstable();
        let mut records: Vec<[u8; BYTES]> = Vec::new();
        for (done, (key, place)) in order.iter().enumerate() {
            let cell = &self.cells[*place as usize];
            if self.is_kept(*key, cell) {
                records.push(cell.moments.encode(*key, settings.voxel_m, settings.thickness_m));
            }
            if done % 1024 == 0 {
                progress(done, order.len());
            }
        }
        let origin = self.origin.filter(|_| !records.is_empty()).ok_or(BuildError::Empty {
            cells: order.len(),
            sweeps: self.sweeps,
            min_sweeps: settings.min_sweeps,
            apart_s: settings.apart_s,
        })?;
        let info = MapInfo {
            frame: self.frame[..self.frame.floor_char_boundary(255)].into(),
            voxel_m: settings.voxel_m,
            thickness_m: settings.thickness_m,
            origin,
            pose_sigmas: self.squares.map(|sum| (sum / self.sweeps.max(1) as f64).sqrt()),
            sweeps: self.sweeps,
            span: self.span,
            left_out: (order.len() - records.len()) as u64,
            closure: self.closure,
        };
        Ok(made(info, &records))
    }

    /// Whether what is in a cell stands still.
    fn is_kept(&self, key: u64, cell: &CellStats) -> bool {
        let settings = &self.settings;
        let enough = cell.moments.points >= settings.min_points && cell.sweeps >= settings.min_sweeps;
        if !enough || to_seconds(cell.span[1].saturating_sub(cell.span[0])) < settings.apart_s {
            return false;
        }
        let (size, mean) = (settings.voxel_m, cell.moments.mean());
        let corner = cell_of(key);
        let place = Vector3::from_fn(|i, _| (f64::from(corner[i]) + 0.5) * size + mean[i]);
        let near = |view: &&View| (view.sensor - place).norm_squared() < VIEW_RANGE_M * VIEW_RANGE_M;
        let margin = size.max(1.0);
        let empty = self
            .views
            .iter()
            .filter(near)
            .filter(|view| view.is_past(&place, margin))
            .count() as u32;
        let decided = f64::from(empty) + f64::from(cell.shown);
        empty < MIN_EMPTY || f64::from(empty) <= settings.empty_share * decided
    }
}

#[cfg(test)]
mod tests;
