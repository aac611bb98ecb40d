//! The lists of the data set: which sweeps there are, and which make a pair.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use realo_schemas::Nanos;
use serde::Deserialize;
use serde::de::DeserializeOwned;

use super::faults::Faults;
use super::files::{Number, local, read_json};
use crate::ImportError;

const VEHICLE_SIDE: &str = "vehicle-side";
const ROADSIDE_SIDE: &str = "infrastructure-side";

/// A list of the data set in each of its folders.
const LIST: &str = "data_info.json";

/// A pair is at most so far from where it was recorded, along x and y, m.
const MOST_OFFSET: f64 = 1000.0;

/// The files of a sweep, below the data set's folder.
#[derive(Clone, Debug, PartialEq)]
pub struct Frame {
    /// Of the sweep, ns.
    pub stamp: Nanos,
    /// Its points.
    pub cloud: PathBuf,
    /// Of the LiDAR.
    pub calibrations: Vec<PathBuf>,
    /// Of the camera: where it lies to the LiDAR, and what is in its image. Older lists name none.
    pub camera: Option<[PathBuf; 2]>,
    /// What its side labelled.
    pub labels: PathBuf,
}

/// A pair as its list names it.
pub struct Listed {
    /// The vehicle's sweep, if its list has it.
    pub vehicle: Option<Frame>,
    /// The roadside unit's sweep, if its list has it.
    pub roadside: Option<Frame>,
    /// Clouds of a pair whose sweeps are in no list.
    pub alone: Vec<PathBuf>,
    /// Cooperative labels.
    pub truth: PathBuf,
    /// Added to the roadside unit's position in the world, m.
    pub offset: [f64; 2],
}

/// What the lists say.
pub struct Index {
    /// Pairs whose entry can be read.
    pub pairs: Vec<Listed>,
    /// Pairs whose entry cannot be read.
    pub broken: usize,
    /// What is wrong with entries.
    pub faults: Faults,
}

impl Index {
    /// Reads the lists below a folder.
    ///
    /// # Errors
    /// All lists that cannot be read; a list without pairs.
    pub fn read(dir: &Path) -> Result<Self, ImportError> {
        let list = Path::new("cooperative").join(LIST);
        let (infos, vehicles, roadsides) = (
            entries::<PairInfo>(dir, &list),
            Side::read::<VehicleInfo>(dir, VEHICLE_SIDE),
            Side::read::<RoadsideInfo>(dir, ROADSIDE_SIDE),
        );
        let ((infos, broken), vehicles, roadsides) = match (infos, vehicles, roadsides) {
            (Ok(infos), Ok(vehicles), Ok(roadsides)) => (infos, vehicles, roadsides),
            (infos, vehicles, roadsides) => {
                let errors = [infos.err(), vehicles.err(), roadsides.err()];
                let reasons = errors.iter().flatten().map(|error| format!("  {error}"));
                return Err(ImportError::Lists {
                    path: dir.into(),
                    reasons: reasons.collect::<Vec<_>>().join("\n"),
                });
            }
        };
        let mut index = Index {
            pairs: Vec::new(),
            broken: broken.len(),
            faults: Faults::default(),
        };
        index.faults_of_list(&list, broken);
        index.faults_of_list(&vehicles.list, vehicles.broken.clone());
        index.faults_of_list(&roadsides.list, roadsides.broken.clone());
        for (number, info) in infos.into_iter().enumerate() {
            index.pair(&list, number, info, [&vehicles, &roadsides]);
        }
        match index.pairs.is_empty() && index.broken == 0 {
            true => Err(ImportError::content(
                &dir.join(list),
                "expected at least one pair, found none",
            )),
            false => Ok(index),
        }
    }

    fn faults_of_list(&mut self, list: &Path, entries: Vec<String>) {
        let cause = format!("entry of {} that cannot be read", list.display());
        entries.into_iter().for_each(|entry| self.faults.add(&cause, entry));
    }

    fn pair(&mut self, list: &Path, number: usize, info: PairInfo, sides: [&Side; 2]) {
        let offset = match info.system_error_offset.meters() {
            Ok(offset) => offset,
            Err(reason) => {
                self.broken += 1;
                let cloud = info.vehicle_pointcloud_path.display();
                return self.faults_of_list(list, vec![format!("entry {number} ({cloud}): {reason}")]);
            }
        };
        let clouds = [info.vehicle_pointcloud_path, info.infrastructure_pointcloud_path].map(local);
        let mut alone = Vec::new();
        let mut frames = clouds.into_iter().zip(sides).map(|(cloud, side)| {
            let frame = side.frames.get(&cloud).cloned();
            if frame.is_none() {
                self.faults.add(
                    format!("in no entry of {}", side.list.display()),
                    cloud.display().to_string(),
                );
                alone.push(cloud);
            }
            frame
        });
        let (vehicle, roadside) = (frames.next().flatten(), frames.next().flatten());
        drop(frames);
        self.pairs.push(Listed {
            vehicle,
            roadside,
            alone,
            truth: local(info.cooperative_label_path),
            offset,
        });
    }
}

/// The sweeps of a side.
struct Side {
    list: PathBuf,
    /// By their clouds.
    frames: BTreeMap<PathBuf, Frame>,
    /// What is wrong with other entries.
    broken: Vec<String>,
}

impl Side {
    fn read<T: SideInfo>(dir: &Path, side: &str) -> Result<Self, ImportError> {
        let list = Path::new(side).join(LIST);
        let (infos, broken) = entries::<T>(dir, &list)?;
        let mut found = Side {
            list,
            frames: BTreeMap::new(),
            broken,
        };
        let mut stamps = BTreeMap::new();
        for info in infos {
            let Files {
                cloud,
                stamp,
                calibrations,
                camera,
                labels,
            } = info.files();
            let below = |path: PathBuf| Path::new(side).join(local(path));
            let stamp = match nanos(&stamp) {
                Ok(stamp) => stamp,
                Err(reason) => {
                    let cloud = cloud.display();
                    found.broken.push(format!("{cloud}: pointcloud_timestamp: {reason}"));
                    continue;
                }
            };
            let frame = Frame {
                stamp,
                cloud: below(cloud),
                calibrations: calibrations.into_iter().map(below).collect(),
                camera: camera.map(|files| files.map(below)),
                labels: below(labels),
            };
            found.add(frame, &mut stamps);
        }
        Ok(found)
    }

    /// Takes a sweep, if no other has its cloud or its stamp.
    fn add(&mut self, frame: Frame, stamps: &mut BTreeMap<Nanos, PathBuf>) {
        let name = frame.cloud.display();
        if self.frames.get(&frame.cloud).is_some_and(|known| *known != frame) {
            let reason =
                format!("{name}: expected one entry of this cloud, found two that differ; the first was taken");
            return self.broken.push(reason);
        }
        match stamps.get(&frame.stamp).filter(|known| **known != frame.cloud) {
            Some(known) => self.broken.push(format!(
                "{name}: pointcloud_timestamp: expected one cloud at each time, found that of {} too",
                known.display()
            )),
            None => {
                stamps.insert(frame.stamp, frame.cloud.clone());
                self.frames.insert(frame.cloud.clone(), frame);
            }
        }
    }
}

/// The entries of a list, and what is wrong with those that cannot be read.
fn entries<T: DeserializeOwned>(dir: &Path, list: &Path) -> Result<(Vec<T>, Vec<String>), ImportError> {
    let (mut entries, mut broken) = (Vec::new(), Vec::new());
    for (index, value) in read_json::<Vec<serde_json::Value>>(&dir.join(list))?
        .into_iter()
        .enumerate()
    {
        match serde_json::from_value(value) {
            Ok(entry) => entries.push(entry),
            Err(error) => broken.push(format!("entry {index}: {error}")),
        }
    }
    Ok((entries, broken))
}

/// A stamp in ns, of one that is written in µs.
fn nanos(stamp: &str) -> Result<Nanos, String> {
    let micros: i64 = stamp
        .parse()
        .map_err(|_| format!("expected microseconds, found `{stamp}`"))?;
    let nanos = micros.checked_mul(1000).filter(|nanos| *nanos >= 0);
    nanos.ok_or_else(|| format!("expected 0 to {} microseconds, found {micros}", i64::MAX / 1000))
}

#[derive(Deserialize)]
struct PairInfo {
    infrastructure_pointcloud_path: PathBuf,
    vehicle_pointcloud_path: PathBuf,
    cooperative_label_path: PathBuf,
    system_error_offset: SystemErrorOffset,
}

/// Some versions of the dataset write an empty text for no offset.
#[derive(Deserialize)]
#[serde(untagged)]
enum SystemErrorOffset {
    Known { delta_x: Number, delta_y: Number },
    None(Empty),
}

#[derive(Deserialize)]
enum Empty {
    #[serde(rename = "")]
    Text,
}

impl SystemErrorOffset {
    fn meters(&self) -> Result<[f64; 2], String> {
        let offset = match self {
            SystemErrorOffset::Known { delta_x, delta_y } => [delta_x.0, delta_y.0],
            SystemErrorOffset::None(Empty::Text) => [0.0, 0.0],
        };
        // A NaN is not near either.
        match offset.iter().all(|metres| metres.abs() <= MOST_OFFSET) {
            true => Ok(offset),
            false => Err(format!(
                "system_error_offset: expected metres within ±{MOST_OFFSET}, found {offset:?}"
            )),
        }
    }
}

/// The files of a sweep as its list names them, below its side's folder.
struct Files {
    cloud: PathBuf,
    /// µs.
    stamp: String,
    calibrations: Vec<PathBuf>,
    camera: Option<[PathBuf; 2]>,
    labels: PathBuf,
}

trait SideInfo: DeserializeOwned {
    fn files(self) -> Files;
}

#[derive(Deserialize)]
struct VehicleInfo {
    pointcloud_path: PathBuf,
    pointcloud_timestamp: String,
    calib_lidar_to_novatel_path: PathBuf,
    calib_novatel_to_world_path: PathBuf,
    calib_lidar_to_camera_path: Option<PathBuf>,
    calib_camera_intrinsic_path: Option<PathBuf>,
    label_lidar_std_path: PathBuf,
}

impl SideInfo for VehicleInfo {
    fn files(self) -> Files {
        let camera = self.calib_lidar_to_camera_path.zip(self.calib_camera_intrinsic_path);
        Files {
            cloud: self.pointcloud_path,
            stamp: self.pointcloud_timestamp,
            calibrations: vec![self.calib_lidar_to_novatel_path, self.calib_novatel_to_world_path],
            camera: camera.map(<[PathBuf; 2]>::from),
            labels: self.label_lidar_std_path,
        }
    }
}

#[derive(Deserialize)]
struct RoadsideInfo {
    pointcloud_path: PathBuf,
    pointcloud_timestamp: String,
    calib_virtuallidar_to_world_path: PathBuf,
    calib_virtuallidar_to_camera_path: Option<PathBuf>,
    calib_camera_intrinsic_path: Option<PathBuf>,
    label_lidar_std_path: PathBuf,
}

impl SideInfo for RoadsideInfo {
    fn files(self) -> Files {
        let camera = self
            .calib_virtuallidar_to_camera_path
            .zip(self.calib_camera_intrinsic_path);
        Files {
            cloud: self.pointcloud_path,
            stamp: self.pointcloud_timestamp,
            calibrations: vec![self.calib_virtuallidar_to_world_path],
            camera: camera.map(<[PathBuf; 2]>::from),
            labels: self.label_lidar_std_path,
        }
    }
}
