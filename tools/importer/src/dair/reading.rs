//! Reads the sweeps of a pair as a whole, with all that is wrong with them.

use std::path::{Path, PathBuf};

use nalgebra::Isometry3;
use realo_schemas::geometry::{View, tilt_degrees};

use super::index::{Index, Listed};
use super::labels::{Labels, WorldLabels, side_labels};
use super::lists::Frame;
use super::poses::{Camera, roadside_pose, vehicle_pose};
use super::{ROADSIDE, VEHICLE, lidar_height};
use crate::ImportError;
use crate::clouds::{BodyCloud, Brightest, read_points};
use crate::faults::{Faults, FaultsOfSweep, FileKind};
use crate::level::{Level, body_from_sensor};

/// Reads sweeps below a folder.
pub struct Reader {
    dir: PathBuf,
    level: Level,
}

/// A sweep in its body frame.
pub struct Sweep {
    /// Of its reference time.
    pub map_from_body: Isometry3<f64>,
    /// What was levelled, degrees.
    pub tilt: f64,
    /// Its points.
    pub cloud: BodyCloud,
    /// What its side labelled.
    pub labels: Labels,
    /// What its camera has in its image, if it has one.
    pub view: Option<View>,
}

/// What the two sides say together of a vehicle's sweep, in its body frame.
pub struct Together {
    /// Cooperative labels.
    pub truth: Labels,
    /// What the cameras of both have in their images; `None` where one has no camera.
    pub views: Option<[View; 2]>,
}

/// The files of a pair, each of which was there and could be read.
pub struct Pair {
    /// The vehicle's.
    pub vehicle: Frame,
    /// The roadside unit's.
    pub roadside: Frame,
    truth: PathBuf,
    offset: [f64; 2],
}

impl Pair {
    /// What is added to the roadside unit's position in the world, m.
    pub fn offset(&self) -> [f64; 2] {
        self.offset
    }
}

/// The pairs of a data set.
pub struct Checked {
    /// Those of which all is there and can be read, in order of the vehicle's stamps.
    pub pairs: Vec<Pair>,
    /// Other pairs.
    pub incomplete: usize,
    /// What is missing or damaged of them.
    pub faults: Faults,
    /// What is wrong with entries that no pair needs.
    pub unneeded: Faults,
    /// The brightest intensities of the vehicle and of the roadside unit.
    pub brightest: [Brightest; 2],
}

impl Reader {
    /// Reads below a folder; frames are levelled like that.
    pub fn new(dir: &Path, level: Level) -> Self {
        Reader { dir: dir.into(), level }
    }

    /// Reads all pairs and keeps those that are whole; calls `progress` with the pairs that were read and all pairs.
    ///
    /// # Errors
    /// Lists that cannot be read.
    pub fn check(&self, mut progress: impl FnMut(u64, u64)) -> Result<Checked, ImportError> {
        let index = Index::read(&self.dir)?;
        let mut checked = Checked {
            pairs: Vec::new(),
            incomplete: index.broken,
            faults: index.faults,
            unneeded: index.unneeded,
            brightest: Default::default(),
        };
        let mut listed = index.pairs;
        listed.sort_by_key(|pair| [&pair.vehicle, &pair.roadside].map(|frame| frame.as_ref().map(|frame| frame.stamp)));
        let all = listed.len() as u64;
        for (done, pair) in (0..).zip(listed) {
            progress(done, all);
            match self.read(pair) {
                Ok((pair, clouds)) => {
                    for (brightest, cloud) in checked.brightest.iter_mut().zip(&clouds) {
                        brightest.look_at(cloud.intensity(), cloud.intensity_from());
                    }
                    checked.pairs.push(pair);
                }
                Err(faults) => {
                    checked.incomplete += 1;
                    checked.faults.extend(&self.dir, faults);
                }
            }
        }
        Ok(checked)
    }

    /// A pair with the clouds of vehicle and roadside unit, or all that is wrong with it.
    fn read(&self, listed: Listed) -> Result<(Pair, [BodyCloud; 2]), FaultsOfSweep> {
        let Listed {
            vehicle,
            roadside,
            alone,
            truth,
            offset,
        } = listed;
        let mut faults = FaultsOfSweep::default();
        for cloud in &alone {
            faults.keep(FileKind::Cloud, read_points(&self.dir.join(cloud)));
        }
        let mut keep = |read: Result<Sweep, FaultsOfSweep>| read.map_err(|found| faults.0.extend(found.0)).ok();
        let of_vehicle = vehicle.as_ref().and_then(|frame| keep(self.vehicle(frame)));
        let of_roadside = roadside.as_ref().and_then(|frame| keep(self.roadside(frame, offset)));
        let (Some(vehicle), Some(roadside), Some(of_vehicle), Some(of_roadside)) =
            (vehicle, roadside, of_vehicle, of_roadside)
        else {
            faults.keep(FileKind::Labels, WorldLabels::read(&self.dir.join(truth)));
            return Err(faults);
        };
        let pair = Pair {
            vehicle,
            roadside,
            truth,
            offset,
        };
        self.together(&pair, &of_vehicle)?;
        Ok((pair, [of_vehicle.cloud, of_roadside.cloud]))
    }

    /// The vehicle's sweep.
    pub fn vehicle(&self, frame: &Frame) -> Result<Sweep, FaultsOfSweep> {
        let [mounting, place] = [0, 1].map(|index| self.dir.join(&frame.calibrations[index]));
        self.sweep(VEHICLE, frame, vehicle_pose(&mounting, &place))
    }

    /// The roadside unit's sweep, the offset of the pair added to its position in the world, m.
    pub fn roadside(&self, frame: &Frame, offset: [f64; 2]) -> Result<Sweep, FaultsOfSweep> {
        let path = self.dir.join(&frame.calibrations[0]);
        self.sweep(ROADSIDE, frame, roadside_pose(&path, offset))
    }

    fn sweep(
        &self,
        agent: &str,
        frame: &Frame,
        pose: Result<Isometry3<f64>, ImportError>,
    ) -> Result<Sweep, FaultsOfSweep> {
        let mut faults = FaultsOfSweep::default();
        let path = self.dir.join(&frame.cloud);
        let pose = faults.keep(FileKind::Calibration, pose);
        let points = faults.keep(FileKind::Cloud, read_points(&path));
        let labels = faults.keep(FileKind::Labels, side_labels(&self.dir.join(&frame.labels)));
        let camera = faults.keep(FileKind::Calibration, self.camera(frame));
        let (Some(map_from_lidar), Some(points), Some(labels), Some(camera)) = (pose, points, labels, camera) else {
            return Err(faults);
        };
        let placed = || -> Option<Sweep> {
            let body_from_lidar = body_from_sensor(self.level, &map_from_lidar.rotation, lidar_height(agent), &points);
            let body_from_lidar = faults.keep(FileKind::Cloud, of_file(&path, body_from_lidar))?;
            let cloud = BodyCloud::new(points, frame.stamp, &body_from_lidar);
            let cloud = faults.keep(FileKind::Cloud, of_file(&path, cloud));
            let view = camera.map(|camera| camera.view(&body_from_lidar)).transpose();
            let view = faults.keep(FileKind::Calibration, view);
            Some(Sweep {
                map_from_body: map_from_lidar * body_from_lidar.inverse(),
                tilt: tilt_degrees(&body_from_lidar.rotation),
                cloud: cloud?,
                labels: labels.moved(&body_from_lidar),
                view: view?,
            })
        };
        let sweep = placed();
        faults.or(sweep)
    }

    fn camera(&self, frame: &Frame) -> Result<Option<Camera>, ImportError> {
        let paths = frame
            .camera
            .as_ref()
            .map(|paths| paths.each_ref().map(|path| self.dir.join(path)));
        paths
            .map(|[extrinsic, intrinsic]| Camera::read(&extrinsic, &intrinsic))
            .transpose()
    }

    /// What both sides say of the vehicle's sweep.
    pub fn together(&self, pair: &Pair, vehicle: &Sweep) -> Result<Together, FaultsOfSweep> {
        let mut faults = FaultsOfSweep::default();
        let labels = WorldLabels::read(&self.dir.join(&pair.truth));
        let truth = labels.and_then(|labels| labels.in_body(&vehicle.map_from_body));
        let truth = faults.keep(FileKind::Labels, truth);
        let views = faults.keep(FileKind::Calibration, self.views(pair, vehicle));
        let together = truth.zip(views).map(|(truth, views)| Together { truth, views });
        faults.or(together)
    }

    /// Without one of the two views it is not known where cooperative labels could be.
    fn views(&self, pair: &Pair, vehicle: &Sweep) -> Result<Option<[View; 2]>, ImportError> {
        let Some((own, camera)) = vehicle.view.clone().zip(self.camera(&pair.roadside)?) else {
            return Ok(None);
        };
        let path = self.dir.join(&pair.roadside.calibrations[0]);
        let body_from_other = vehicle.map_from_body.inv_mul(&roadside_pose(&path, pair.offset)?);
        Ok(Some([own, camera.view(&body_from_other)?]))
    }
}

fn of_file<T>(path: &Path, read: Result<T, String>) -> Result<T, ImportError> {
    read.map_err(|reason| ImportError::content(path, reason))
}
