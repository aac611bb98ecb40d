//! The lists of DAIR's data sets: their entries, and the files and stamps that these name.

use std::fmt::Display;
use std::ops::Range;
use std::path::{Path, PathBuf};

use realo_schemas::Nanos;
use serde::Deserialize;
use serde::de::DeserializeOwned;
use serde_json::Value;

use crate::ImportError;
use crate::files::{Number, local, read_json, text};

/// Folder of what both sides say together.
pub const COOPERATIVE: &str = "cooperative";
/// Folder of the vehicle's side.
pub const VEHICLE_SIDE: &str = "vehicle-side";
/// Folder of the roadside unit's side.
pub const ROADSIDE_SIDE: &str = "infrastructure-side";

/// A list of the data set in each of its folders.
pub const LIST: &str = "data_info.json";

/// A pair is at most so far from where it was recorded, along x and y, m.
const MOST_OFFSET: f64 = 1000.0;

/// The files of a sweep.
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

/// Which data set a list of pairs is of.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ListOf {
    /// DAIR-V2X-C: pairs name their files.
    DairC,
    /// V2X-Seq-SPD: pairs name their frames and sequences.
    Seq,
}

/// Keys of pairs that the other data set does not have.
const KEYS_OF_C: [&str; 3] = [
    "vehicle_pointcloud_path",
    "infrastructure_pointcloud_path",
    "cooperative_label_path",
];
const KEYS_OF_SEQ: [&str; 4] = [
    "vehicle_frame",
    "infrastructure_frame",
    "vehicle_sequence",
    "infrastructure_sequence",
];

/// Which data set the list of pairs below a folder is of, by the keys of its entries, and why. One that cannot be read is taken as
/// of DAIR-V2X-C, whose import says what is wrong with it.
///
/// # Errors
/// No such list; one with keys of both.
pub fn list_of(dir: &Path) -> Result<(ListOf, String), String> {
    let name = format!("{COOPERATIVE}/{LIST}");
    let path = dir.join(COOPERATIVE).join(LIST);
    if !path.is_file() {
        return Err(format!("there is no `{name}`"));
    }
    let entries: Vec<Value> = read_json(&path).unwrap_or_default();
    let first = |keys: &[&'static str]| {
        let found = entries.iter().enumerate().find_map(|(number, entry)| {
            let key = keys.iter().find(|key| entry.get(**key).is_some())?;
            Some((number, *key))
        });
        found.map(|(number, key)| format!("`{key}` in entry {number}"))
    };
    match (first(&KEYS_OF_C), first(&KEYS_OF_SEQ)) {
        (Some(own), Some(other)) => Err(format!(
            "`{name}` has entries of two data sets: {own}, as DAIR-V2X-C has it, and {other}, as V2X-Seq-SPD; \
             unpack each into a folder of its own"
        )),
        (None, Some(key)) => Ok((ListOf::Seq, format!("`{name}` has {key}"))),
        _ => Ok((ListOf::DairC, format!("there is `{name}`"))),
    }
}

/// Why an entry of a list cannot be taken, as a cause.
pub fn unusable(list: &Path) -> String {
    format!("entry of {} that is not usable", list.display())
}

/// Why a sweep cannot be taken, as a cause.
pub fn in_no_entry(list: &Path) -> String {
    format!("in no entry of {}", list.display())
}

/// An entry of a list that is not usable.
pub struct Unusable {
    /// The cloud that it names, below the data set's folder, if it names one.
    pub cloud: Option<PathBuf>,
    /// The number of its frame, if it has one.
    pub frame: Option<u64>,
    /// Which entry it is, and what is wrong with it.
    pub text: String,
}

impl Unusable {
    /// `number`: of the entry in its list.
    pub fn new(number: usize, cloud: Option<PathBuf>, reason: impl Display) -> Self {
        let text = match &cloud {
            Some(cloud) => format!("entry {number} ({}): {reason}", cloud.display()),
            None => format!("entry {number}: {reason}"),
        };
        Unusable {
            cloud,
            frame: None,
            text,
        }
    }
}

/// Entries with their numbers in a list, and entries that cannot be read.
pub type Entries<T> = (Vec<(usize, T)>, Vec<Unusable>);

/// The entries of the list in a folder of the data set `dir`.
pub fn entries<T: DeserializeOwned>(dir: &Path, folder: &str) -> Result<Entries<T>, ImportError> {
    let (mut entries, mut unusable) = (Vec::new(), Vec::new());
    let values: Vec<Value> = read_json(&dir.join(folder).join(LIST))?;
    for (number, value) in values.into_iter().enumerate() {
        let cloud = value.get("pointcloud_path").and_then(Value::as_str);
        let cloud = cloud.map(|cloud| Path::new(folder).join(local(cloud.into())));
        let frame = value.get("frame_id").and_then(|frame| whole(&words(frame)));
        match serde_json::from_value(value) {
            Ok(entry) => entries.push((number, entry)),
            Err(error) => unusable.push(Unusable {
                frame,
                ..Unusable::new(number, cloud, error)
            }),
        }
    }
    Ok((entries, unusable))
}

/// The number that digits are.
fn whole(text: &str) -> Option<u64> {
    let is_number = !text.is_empty() && text.bytes().all(|byte| byte.is_ascii_digit());
    is_number.then(|| text.parse().ok()).flatten()
}

/// The name of a frame, as `000009`, with its number.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct FrameId {
    /// As the file has it, of which names of files are made.
    pub name: String,
    /// Its number.
    pub number: u64,
}

impl FrameId {
    /// Of what is under the key `field`.
    ///
    /// # Errors
    /// No digits.
    pub fn of(field: &str, value: &Value) -> Result<Self, String> {
        let name = words(value);
        match whole(&name) {
            Some(number) => Ok(FrameId { name, number }),
            None => Err(format!(
                "{field}: expected the digits of a frame, as `000009`, found `{}`",
                crate::shown(&name)
            )),
        }
    }
}

/// A value as a text, which numbers may be written as.
pub fn words(value: &Value) -> String {
    match value {
        Value::String(text) => text.trim().into(),
        other => other.to_string(),
    }
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

/// Some versions of the dataset write an empty text for no offset.
#[derive(Deserialize)]
#[serde(untagged)]
#[allow(missing_docs, reason = "as the lists name them")]
pub enum SystemErrorOffset {
    Known { delta_x: Number, delta_y: Number },
    None(Empty),
}

/// An empty text.
#[derive(Deserialize)]
#[allow(missing_docs, reason = "there is one")]
pub enum Empty {
    #[serde(rename = "")]
    Text,
}

impl SystemErrorOffset {
    /// The offset, m.
    ///
    /// # Errors
    /// No number, or one that is too large.
    pub fn meters(&self) -> Result<[f64; 2], String> {
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
pub struct Files {
    cloud: PathBuf,
    /// µs.
    stamp: String,
    calibrations: Vec<PathBuf>,
    camera: Option<[PathBuf; 2]>,
    labels: PathBuf,
}

impl Files {
    /// Where its cloud is.
    pub fn cloud(&self) -> PathBuf {
        local(self.cloud.clone())
    }

    /// The sweep, its files brought to where they are by `below`.
    ///
    /// # Errors
    /// A stamp that is none.
    pub fn frame(self, below: impl Fn(PathBuf) -> PathBuf) -> Result<Frame, String> {
        let below = |path: PathBuf| below(local(path));
        Ok(Frame {
            stamp: nanos(&self.stamp).map_err(|reason| format!("pointcloud_timestamp: {reason}"))?,
            cloud: below(self.cloud),
            calibrations: self.calibrations.into_iter().map(below).collect(),
            camera: self.camera.map(|files| files.map(below)),
            labels: below(self.labels),
        })
    }
}

/// What the list of a side says of a sweep.
pub trait SideInfo: DeserializeOwned {
    /// The files of it.
    fn files(self) -> Files;
}

/// A sweep of the vehicle in its list.
#[derive(Deserialize)]
pub struct VehicleInfo {
    pointcloud_path: PathBuf,
    #[serde(deserialize_with = "text")]
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

/// A sweep of the roadside unit in its list.
#[derive(Deserialize)]
pub struct RoadsideInfo {
    pointcloud_path: PathBuf,
    #[serde(deserialize_with = "text")]
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
