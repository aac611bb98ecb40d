//! The lists of the data set: which sweeps there are, and which make a pair.

use std::collections::BTreeMap;
use std::fmt::Display;
use std::ops::Range;
use std::path::{Path, PathBuf};

use realo_schemas::Nanos;
use serde::Deserialize;
use serde::de::DeserializeOwned;
use serde_json::Value;

use crate::ImportError;
use crate::faults::Faults;
use crate::files::{Number, local, read_json};

const COOPERATIVE: &str = "cooperative";
const VEHICLE_SIDE: &str = "vehicle-side";
const ROADSIDE_SIDE: &str = "infrastructure-side";

/// A list of the data set in each of its folders.
const LIST: &str = "data_info.json";

/// A pair is at most so far from where it was recorded, along x and y, m.
const MOST_OFFSET: f64 = 1000.0;

/// The files of a sweep, below the data set's folder.
#[derive(Clone, Debug, PartialEq)]
pub struct Frame {
    /// Stamp of the sweep, ns.
    pub stamp: Nanos,
    /// Its points.
    pub cloud: PathBuf,
    /// Calibrations of the LiDAR.
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
    /// Pairs whose entry is usable.
    pub pairs: Vec<Listed>,
    /// Pairs whose entry is not usable.
    pub broken: usize,
    /// What is wrong with entries of pairs, and with entries of sweeps that pairs need.
    pub faults: Faults,
    /// What is wrong with other entries.
    pub unneeded: Faults,
}

impl Index {
    /// Reads the lists below a folder.
    ///
    /// # Errors
    /// All lists that cannot be read; a list without pairs.
    pub fn read(dir: &Path) -> Result<Self, ImportError> {
        let list = Path::new(COOPERATIVE).join(LIST);
        let (infos, vehicles, roadsides) = (
            entries::<PairInfo>(dir, COOPERATIVE),
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
            unneeded: Faults::default(),
        };
        for entry in broken {
            index.faults.add(unusable(&list), entry.text);
        }
        for (number, info) in infos {
            index.pair(&list, number, info, [&vehicles, &roadsides]);
        }
        index.entries_of_no_pair(&vehicles);
        index.entries_of_no_pair(&roadsides);
        match index.pairs.is_empty() && index.broken == 0 {
            true => Err(ImportError::content(
                &dir.join(list),
                "expected at least one pair, found none",
            )),
            false => Ok(index),
        }
    }

    /// `number`: of the entry in its list.
    fn pair(&mut self, list: &Path, number: usize, info: PairInfo, sides: [&Side; 2]) {
        let clouds = [info.vehicle_pointcloud_path, info.infrastructure_pointcloud_path].map(local);
        let mut alone = Vec::new();
        let [vehicle, roadside] = [0, 1].map(|index| {
            let (cloud, side) = (&clouds[index], sides[index]);
            let frame = side.frames.get(cloud).cloned();
            if frame.is_none() {
                self.sweep_without_entry(cloud, side);
                alone.push(cloud.clone());
            }
            frame
        });
        let offset = match info.system_error_offset.meters() {
            Ok(offset) => offset,
            Err(reason) => {
                self.broken += 1;
                let [vehicle, _] = clouds;
                let entry = Unusable::new(number, Some(vehicle), reason);
                return self.faults.add(unusable(list), entry.text);
            }
        };
        self.pairs.push(Listed {
            vehicle,
            roadside,
            alone,
            truth: local(info.cooperative_label_path),
            offset,
        });
    }

    /// Adds what is wrong with the entries of a sweep that a pair needs, or that there is none.
    fn sweep_without_entry(&mut self, cloud: &Path, side: &Side) {
        let of_cloud = |entry: &&Unusable| entry.cloud.as_deref() == Some(cloud);
        let mut entries = side.unusable.iter().filter(of_cloud).peekable();
        if entries.peek().is_none() {
            self.faults.add(in_no_entry(&side.list), cloud.display().to_string());
        }
        for entry in entries {
            self.faults.add(unusable(&side.list), &entry.text);
        }
    }

    /// Adds what is wrong with the other entries of a side. One that does not say its cloud may be what a pair needs.
    fn entries_of_no_pair(&mut self, side: &Side) {
        let cause = unusable(&side.list);
        let is_one_missing = self.faults.by_cause.contains_key(&in_no_entry(&side.list));
        for entry in &side.unusable {
            if entry.cloud.is_none() && is_one_missing {
                self.faults.add(&cause, &entry.text);
            } else if !self.faults.contains(&cause, &entry.text) {
                self.unneeded.add(&cause, &entry.text);
            }
        }
    }
}

fn unusable(list: &Path) -> String {
    format!("entry of {} that is not usable", list.display())
}

fn in_no_entry(list: &Path) -> String {
    format!("in no entry of {}", list.display())
}

/// An entry of a list that is not usable.
struct Unusable {
    /// The cloud that it names, below the data set's folder, if it names one.
    cloud: Option<PathBuf>,
    /// Which entry it is, and what is wrong with it.
    text: String,
}

impl Unusable {
    /// `number`: of the entry in its list.
    fn new(number: usize, cloud: Option<PathBuf>, reason: impl Display) -> Self {
        let text = match &cloud {
            Some(cloud) => format!("entry {number} ({}): {reason}", cloud.display()),
            None => format!("entry {number}: {reason}"),
        };
        Unusable { cloud, text }
    }
}

/// The sweeps of a side.
struct Side {
    list: PathBuf,
    /// By their clouds.
    frames: BTreeMap<PathBuf, Frame>,
    /// Other entries.
    unusable: Vec<Unusable>,
}

impl Side {
    fn read<T: SideInfo>(dir: &Path, side: &str) -> Result<Self, ImportError> {
        let list = Path::new(side).join(LIST);
        let (infos, unusable) = entries::<T>(dir, side)?;
        let mut found = Side {
            list,
            frames: BTreeMap::new(),
            unusable,
        };
        let mut stamps = BTreeMap::new();
        for (number, info) in infos {
            let Files {
                cloud,
                stamp,
                calibrations,
                camera,
                labels,
            } = info.files();
            let below = |path: PathBuf| Path::new(side).join(local(path));
            let cloud = below(cloud);
            let stamp = match nanos(&stamp) {
                Ok(stamp) => stamp,
                Err(reason) => {
                    let reason = format!("pointcloud_timestamp: {reason}");
                    found.unusable.push(Unusable::new(number, Some(cloud), reason));
                    continue;
                }
            };
            let frame = Frame {
                stamp,
                cloud,
                calibrations: calibrations.into_iter().map(below).collect(),
                camera: camera.map(|files| files.map(below)),
                labels: below(labels),
            };
            found.add(number, frame, &mut stamps);
        }
        Ok(found)
    }

    /// Takes a sweep, if no other has its cloud or its stamp.
    fn add(&mut self, number: usize, frame: Frame, stamps: &mut BTreeMap<Nanos, PathBuf>) {
        let is_other = self.frames.get(&frame.cloud).is_some_and(|known| *known != frame);
        let at_its_stamp = stamps.get(&frame.stamp).filter(|known| **known != frame.cloud);
        let reason = match (is_other, at_its_stamp) {
            (true, _) => "expected one entry of this cloud, found two that differ; the first was taken".to_string(),
            (false, Some(known)) => format!(
                "pointcloud_timestamp: expected one cloud at each time, found that of {} too",
                known.display()
            ),
            (false, None) => {
                stamps.insert(frame.stamp, frame.cloud.clone());
                self.frames.insert(frame.cloud.clone(), frame);
                return;
            }
        };
        self.unusable.push(Unusable::new(number, Some(frame.cloud), reason));
    }
}

/// Entries with their numbers in a list, and entries that cannot be read.
type Entries<T> = (Vec<(usize, T)>, Vec<Unusable>);

/// The entries of the list in a folder of the data set `dir`.
fn entries<T: DeserializeOwned>(dir: &Path, folder: &str) -> Result<Entries<T>, ImportError> {
    let (mut entries, mut unusable) = (Vec::new(), Vec::new());
    let values: Vec<Value> = read_json(&dir.join(folder).join(LIST))?;
    for (number, value) in values.into_iter().enumerate() {
        let cloud = value.get("pointcloud_path").and_then(Value::as_str);
        let cloud = cloud.map(|cloud| Path::new(folder).join(local(cloud.into())));
        match serde_json::from_value(value) {
            Ok(entry) => entries.push((number, entry)),
            Err(error) => unusable.push(Unusable::new(number, cloud, error)),
        }
    }
    Ok((entries, unusable))
}

/// Seconds since 1970 from 2000 to 2100.
const SINCE_EPOCH: Range<i64> = 946_684_800..4_102_444_800;
/// Units that stamps are written in elsewhere, by how many make a second.
const OTHER_UNITS: [(i64, &str); 3] = [(1, "seconds"), (1_000, "milliseconds"), (1_000_000_000, "nanoseconds")];

/// A stamp in ns, of one that is written in µs.
fn nanos(stamp: &str) -> Result<Nanos, String> {
    let micros: i64 = stamp
        .parse()
        .map_err(|_| format!("expected microseconds, found `{stamp}`"))?;
    let other_unit = OTHER_UNITS
        .iter()
        .find(|(per_second, _)| SINCE_EPOCH.contains(&(micros / per_second)));
    if let Some((_, unit)) = other_unit {
        return Err(format!(
            "expected microseconds since 1970, found {micros}, which looks like {unit}"
        ));
    }
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
