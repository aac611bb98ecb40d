//! DAIR-V2X-C in its original layout (root `cooperative-vehicle-infrastructure`); images are not read.
//!
//! Frames: the log's `map` is the dataset's world. A body frame is the LiDAR frame shifted down by [`lidar_height`], so
//! that its z = 0 lies about on the ground; roll and pitch of the LiDAR stay in the pose. The recorded
//! `system_error_offset` of a pair is added to the roadside unit's position in the world.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::fs;
use std::path::{Path, PathBuf};
use std::str::FromStr;

use nalgebra::{Isometry3, Matrix3, Point3, Translation3, UnitQuaternion, Vector3};
use realo_logs::{AgentInfo, AgentKind, LogInfo, LogWriter};
use realo_schemas::{Box3, Boxes, EgoState, Nanos, PointCloud, PoseStatus};
use serde::de::{DeserializeOwned, Error as _};
use serde::{Deserialize, Deserializer, Serialize};

use crate::{ImportError, PcdCloud, read_pcd};

/// Name of the vehicle in the log.
pub const VEHICLE: &str = "vehicle";
/// Name of the roadside unit in the log.
pub const ROADSIDE: &str = "roadside";
/// Height of an agent's LiDAR over the ground, m: the data set does not say; the commonest -z of the points on the road
/// within 20 m (vehicle) and 40 m (roadside) in the sample's clouds.
pub fn lidar_height(agent: &str) -> f64 {
    if agent == VEHICLE { 2.0 } else { 1.6 }
}

/// The vehicle's outline about its LiDAR, m: the data set does not say; an ordinary car's, 4.6 m × 1.9 m, with the LiDAR
/// in the middle of its roof. Boxes that others have of the vehicle are centred in it and count for nothing.
const FOOTPRINT: [f64; 4] = [-2.3, 2.3, -0.95, 0.95];

/// Duration of a vehicle's sweep (10.00 Hz; its stamp is the start).
const VEHICLE_SWEEP: Nanos = 100_000_000;
/// Duration of a roadside sweep (about 10.4 Hz).
const ROADSIDE_SWEEP: Nanos = 96_000_000;

/// What the recorded time of a roadside sweep is; the dataset does not say.
///
/// Either way it is the sweep's stamp, by which the dataset's authors paired the sides; what differs is when the sweep
/// is ready: a sweep's duration later, or at once.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum RoadsideStamp {
    /// The start of the sweep, as on the vehicle.
    #[default]
    Start,
    /// Its end.
    End,
}

impl FromStr for RoadsideStamp {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text {
            "start" => Ok(RoadsideStamp::Start),
            "end" => Ok(RoadsideStamp::End),
            _ => Err(format!("expected `start` or `end`, found `{text}`")),
        }
    }
}

/// What was imported.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Summary {
    /// Pairs of sweeps.
    pub pairs: usize,
    /// Points of all clouds.
    pub points: usize,
    /// Labels of the vehicle's sweeps.
    pub vehicle_boxes: usize,
    /// Labels of the roadside sweeps.
    pub roadside_boxes: usize,
    /// Cooperative labels: the ground truth.
    pub truth_boxes: usize,
    /// Labels without extent, which were annotated in the image only.
    pub placeholders_dropped: usize,
    /// Sweeps that stand in several pairs and were taken once.
    pub repeated_sweeps: usize,
}

impl fmt::Display for Summary {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        writeln!(f, "{} pairs, {} points", self.pairs, self.points)?;
        writeln!(
            f,
            "labels: {} of the vehicle, {} of the roadside unit, {} cooperative",
            self.vehicle_boxes, self.roadside_boxes, self.truth_boxes
        )?;
        write!(
            f,
            "dropped: {} placeholder labels, {} repeated sweeps",
            self.placeholders_dropped, self.repeated_sweeps
        )
    }
}

/// Imports a DAIR-V2X-C dataset into a log of the agents [`VEHICLE`] and [`ROADSIDE`].
///
/// Recorded detections are the single-side LiDAR labels in file order, score 1; the vehicle's ground truth are the
/// cooperative labels, every frame scored, without point counts.
///
/// # Errors
/// The first file that is missing or does not say what it must.
pub fn dair(dir: &Path, out: &Path, roadside_stamp: RoadsideStamp) -> Result<Summary, ImportError> {
    let pairs = read_pairs(dir)?;
    let mut info = LogInfo::new(
        format!(
            "DAIR-V2X-C, roadside stamps taken as the {} of a sweep",
            match roadside_stamp {
                RoadsideStamp::Start => "start",
                RoadsideStamp::End => "end",
            }
        ),
        vec![agent(VEHICLE, AgentKind::Vehicle), agent(ROADSIDE, AgentKind::Roadside)],
    );
    info.protocol = "dair".into();
    info.key_frames = "all".into();
    let roadside_sweep = match roadside_stamp {
        RoadsideStamp::Start => ROADSIDE_SWEEP,
        RoadsideStamp::End => 0,
    };
    let stamps = || pairs.iter().flat_map(|pair| [pair.vehicle.stamp, pair.roadside.stamp]);
    let ends = |pair: &Pair| (pair.vehicle.stamp + VEHICLE_SWEEP).max(pair.roadside.stamp + roadside_sweep);
    (info.start, info.end) = (stamps().min(), pairs.iter().map(ends).max());

    let mut import = Import {
        log: LogWriter::create_atomic(out, &info)?,
        summary: Summary::default(),
    };
    let (mut vehicles, mut roadsides) = (BTreeSet::new(), BTreeSet::new());
    for pair in &pairs {
        import.summary.pairs += 1;
        let new_vehicle = vehicles.insert(pair.vehicle.stamp);
        let new_roadside = roadsides.insert(pair.roadside.stamp);
        import.summary.repeated_sweeps += usize::from(!new_vehicle) + usize::from(!new_roadside);
        let vehicle_first = pair.vehicle.stamp + VEHICLE_SWEEP <= pair.roadside.stamp + roadside_sweep;
        if new_vehicle && vehicle_first {
            import.vehicle(dir, pair)?;
        }
        if new_roadside {
            import.roadside(dir, pair, roadside_sweep)?;
        }
        if new_vehicle && !vehicle_first {
            import.vehicle(dir, pair)?;
        }
    }
    import.log.finish()?;
    Ok(import.summary)
}

fn agent(name: &str, kind: AgentKind) -> AgentInfo {
    AgentInfo {
        name: name.into(),
        kind,
        footprint: (kind == AgentKind::Vehicle).then_some(FOOTPRINT),
        sensor: format!(
            "LiDAR; body frame = LiDAR frame shifted by {} m in z",
            lidar_height(name)
        ),
        sensor_position: Some([0.0, 0.0, lidar_height(name)]),
    }
}

struct Import {
    log: LogWriter,
    summary: Summary,
}

impl Import {
    fn vehicle(&mut self, dir: &Path, pair: &Pair) -> Result<(), ImportError> {
        let (side, frame) = (dir.join("vehicle-side"), &pair.vehicle);
        let novatel_from_lidar: LidarToNovatel = read_json(&side.join(&frame.calibrations[0]))?;
        let world_from_novatel: Transform = read_json(&side.join(&frame.calibrations[1]))?;
        let world_from_lidar = compose(&world_from_novatel, &novatel_from_lidar.transform);
        let map_from_body = body_pose(&world_from_lidar, [0.0, 0.0], VEHICLE);
        let ready = frame.stamp + VEHICLE_SWEEP;
        self.log
            .pose(VEHICLE, frame.stamp, frame.stamp, &state(map_from_body))?;
        self.cloud(VEHICLE, frame, ready, &dir.join(&pair.vehicle_cloud))?;
        let boxes = self.labels(&side.join(&frame.labels), VEHICLE)?;
        self.summary.vehicle_boxes += boxes.0.len();
        self.log.detections(VEHICLE, frame.stamp, ready, &boxes)?;
        let truth = self.truth(&dir.join(&pair.truth), &map_from_body)?;
        self.summary.truth_boxes += truth.len();
        self.log.truth(VEHICLE, frame.stamp, ready, &truth, None, true)?;
        Ok(())
    }

    fn roadside(&mut self, dir: &Path, pair: &Pair, sweep: Nanos) -> Result<(), ImportError> {
        let (side, frame) = (dir.join("infrastructure-side"), &pair.roadside);
        let world_from_lidar: Transform = read_json(&side.join(&frame.calibrations[0]))?;
        let map_from_body = body_pose(&world_from_lidar.parts(), pair.offset, ROADSIDE);
        let ready = frame.stamp + sweep;
        self.log
            .pose(ROADSIDE, frame.stamp, frame.stamp, &state(map_from_body))?;
        self.cloud(ROADSIDE, frame, ready, &dir.join(&pair.roadside_cloud))?;
        let boxes = self.labels(&side.join(&frame.labels), ROADSIDE)?;
        self.summary.roadside_boxes += boxes.0.len();
        self.log.detections(ROADSIDE, frame.stamp, ready, &boxes)?;
        Ok(())
    }

    fn cloud(&mut self, agent: &str, frame: &Frame, ready: Nanos, path: &Path) -> Result<(), ImportError> {
        let cloud =
            to_body(read_pcd(path)?, frame.stamp, agent).map_err(|reason| ImportError::content(path, reason))?;
        self.summary.points += cloud.len();
        self.log.cloud(agent, frame.stamp, ready, &cloud)?;
        Ok(())
    }

    /// Labels of one side, in its body frame.
    fn labels(&mut self, path: &Path, agent: &str) -> Result<Boxes, ImportError> {
        let mut boxes = Vec::new();
        for label in read_json::<Vec<SideLabel>>(path)? {
            if !label.size.is_real() {
                self.summary.placeholders_dropped += 1;
                continue;
            }
            let Location { x, y, z } = label.location;
            boxes.push(
                label
                    .size
                    .to_box([x, y, z + lidar_height(agent)], label.rotation, &label.class),
            );
        }
        Ok(Boxes(boxes))
    }

    /// Cooperative labels, in the vehicle's body frame. Their pose is taken from the corners: `rotation` is the angle
    /// in the frame of the side that drew the box, and missing where that is the roadside unit.
    fn truth(&mut self, path: &Path, map_from_body: &Isometry3<f64>) -> Result<Vec<Box3>, ImportError> {
        let body_from_map = map_from_body.inverse();
        let mut boxes = Vec::new();
        for label in read_json::<Vec<WorldLabel>>(path)? {
            if !label.size.is_real() {
                self.summary.placeholders_dropped += 1;
                continue;
            }
            let corners = label
                .corners
                .map(|corner| (body_from_map * Point3::from(corner)).coords);
            let center = corners.iter().sum::<Vector3<f64>>() / 8.0;
            // Front-left, front-right, rear-right, rear-left of the bottom, then of the top.
            let front = corners[0] + corners[1] + corners[4] + corners[5];
            let rear = corners[2] + corners[3] + corners[6] + corners[7];
            let heading = front - rear;
            let yaw = nalgebra::RealField::atan2(heading.y, heading.x);
            boxes.push(label.size.to_box(center.into(), yaw, &label.class));
        }
        Ok(boxes)
    }
}

fn state(map_from_body: Isometry3<f64>) -> EgoState {
    EgoState {
        map_from_body,
        covariance: None,
        velocity: None,
        angular_rate: None,
        status: PoseStatus::Recorded,
    }
}

/// Points in the body frame, their times as offsets from the stamp.
fn to_body(cloud: PcdCloud, stamp: Nanos, agent: &str) -> Result<PointCloud, String> {
    let n = cloud.x.len();
    let z: Vec<f32> = cloud
        .z
        .iter()
        .map(|z| (f64::from(*z) + lidar_height(agent)) as f32)
        .collect();
    let time = match cloud.timestamp {
        None => vec![0; n],
        Some(times) => times
            .iter()
            .map(|time| offset(*time, stamp))
            .collect::<Result<Vec<_>, _>>()?,
    };
    PointCloud::new(cloud.x, cloud.y, z, cloud.intensity, time, vec![0u16; n])
        .ok_or_else(|| "columns of different length".into())
}

fn offset(time: f64, stamp: Nanos) -> Result<i32, String> {
    // Whole seconds first: the difference of seconds since the epoch would lose digits in the multiplication.
    let (seconds, nanos) = (stamp.div_euclid(1_000_000_000), stamp.rem_euclid(1_000_000_000));
    let offset = (time - seconds as f64) * 1e9 - nanos as f64;
    match offset.abs() < 1e9 {
        true => Ok(offset.round() as i32),
        false => Err(format!(
            "field `timestamp`: a point at {time} s, more than 1 s from the sweep's {stamp} ns"
        )),
    }
}

type Parts = (Matrix3<f64>, Vector3<f64>);

fn compose(world_from_a: &Transform, a_from_b: &Transform) -> Parts {
    let ((r1, t1), (r2, t2)) = (world_from_a.parts(), a_from_b.parts());
    (r1 * r2, r1 * t2 + t1)
}

/// Map from body: the nearest rotation (the files' are orthonormal to 2e-7 only), the offset added in the world.
fn body_pose((rotation, translation): &Parts, [dx, dy]: [f64; 2], agent: &str) -> Isometry3<f64> {
    let rotation = UnitQuaternion::from_matrix(rotation);
    let position = translation + Vector3::new(dx, dy, 0.0) - rotation * Vector3::new(0.0, 0.0, lidar_height(agent));
    Isometry3::from_parts(Translation3::from(position), rotation)
}

/// One side of a pair.
#[derive(Clone, Debug)]
struct Frame {
    stamp: Nanos,
    calibrations: Vec<PathBuf>,
    labels: PathBuf,
}

struct Pair {
    vehicle: Frame,
    roadside: Frame,
    vehicle_cloud: PathBuf,
    roadside_cloud: PathBuf,
    truth: PathBuf,
    offset: [f64; 2],
}

/// All pairs, in order of the vehicle's stamps.
fn read_pairs(dir: &Path) -> Result<Vec<Pair>, ImportError> {
    let list = dir.join("cooperative/data_info.json");
    let infos: Vec<PairInfo> = read_json(&list)?;
    let vehicles = read_frames::<VehicleInfo>(dir, "vehicle-side")?;
    let roadsides = read_frames::<RoadsideInfo>(dir, "infrastructure-side")?;
    let find = |frames: &BTreeMap<PathBuf, Frame>, cloud: &Path| {
        let side = || format!("`{}` is in no data_info.json of its side", cloud.display());
        frames
            .get(cloud)
            .cloned()
            .ok_or_else(|| ImportError::content(&list, side()))
    };
    let mut pairs = Vec::new();
    for info in infos {
        pairs.push(Pair {
            vehicle: find(&vehicles, &info.vehicle_pointcloud_path)?,
            roadside: find(&roadsides, &info.infrastructure_pointcloud_path)?,
            vehicle_cloud: info.vehicle_pointcloud_path,
            roadside_cloud: info.infrastructure_pointcloud_path,
            truth: info.cooperative_label_path,
            offset: info.system_error_offset.meters(),
        });
    }
    if pairs.is_empty() {
        return Err(ImportError::content(&list, "expected at least one pair, found none"));
    }
    pairs.sort_by_key(|pair| (pair.vehicle.stamp, pair.roadside.stamp));
    Ok(pairs)
}

fn read_frames<T: SideInfo>(dir: &Path, side: &str) -> Result<BTreeMap<PathBuf, Frame>, ImportError> {
    let path = dir.join(side).join("data_info.json");
    let mut frames = BTreeMap::new();
    for info in read_json::<Vec<T>>(&path)? {
        let (cloud, stamp, frame) = info.into_parts();
        let micros: i64 = stamp.parse().map_err(|_| {
            ImportError::content(
                &path,
                format!("pointcloud_timestamp: expected microseconds, found `{stamp}`"),
            )
        })?;
        let stamp = micros.checked_mul(1000).filter(|stamp| *stamp >= 0);
        let stamp = stamp.ok_or_else(|| ImportError::content(&path, format!("pointcloud_timestamp: {micros} µs")))?;
        frames.insert(Path::new(side).join(cloud), Frame { stamp, ..frame });
    }
    Ok(frames)
}

fn read_json<T: DeserializeOwned>(path: &Path) -> Result<T, ImportError> {
    let bytes = fs::read(path).map_err(ImportError::io(path))?;
    serde_json::from_slice(&bytes).map_err(|error| ImportError::content(path, error))
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
    fn meters(&self) -> [f64; 2] {
        match self {
            SystemErrorOffset::Known { delta_x, delta_y } => [delta_x.0, delta_y.0],
            SystemErrorOffset::None(Empty::Text) => [0.0, 0.0],
        }
    }
}

trait SideInfo: DeserializeOwned {
    fn into_parts(self) -> (PathBuf, String, Frame);
}

#[derive(Deserialize)]
struct VehicleInfo {
    pointcloud_path: PathBuf,
    pointcloud_timestamp: String,
    calib_lidar_to_novatel_path: PathBuf,
    calib_novatel_to_world_path: PathBuf,
    label_lidar_std_path: PathBuf,
}

impl SideInfo for VehicleInfo {
    fn into_parts(self) -> (PathBuf, String, Frame) {
        let calibrations = vec![self.calib_lidar_to_novatel_path, self.calib_novatel_to_world_path];
        let frame = Frame {
            stamp: 0,
            calibrations,
            labels: self.label_lidar_std_path,
        };
        (self.pointcloud_path, self.pointcloud_timestamp, frame)
    }
}

#[derive(Deserialize)]
struct RoadsideInfo {
    pointcloud_path: PathBuf,
    pointcloud_timestamp: String,
    calib_virtuallidar_to_world_path: PathBuf,
    label_lidar_std_path: PathBuf,
}

impl SideInfo for RoadsideInfo {
    fn into_parts(self) -> (PathBuf, String, Frame) {
        let calibrations = vec![self.calib_virtuallidar_to_world_path];
        let frame = Frame {
            stamp: 0,
            calibrations,
            labels: self.label_lidar_std_path,
        };
        (self.pointcloud_path, self.pointcloud_timestamp, frame)
    }
}

#[derive(Deserialize)]
struct LidarToNovatel {
    transform: Transform,
}

#[derive(Deserialize)]
struct Transform {
    rotation: [[f64; 3]; 3],
    translation: [[f64; 1]; 3],
}

impl Transform {
    fn parts(&self) -> Parts {
        let rotation = Matrix3::from_fn(|row, column| self.rotation[row][column]);
        (rotation, Vector3::from_fn(|row, _| self.translation[row][0]))
    }
}

#[derive(Deserialize)]
struct SideLabel {
    #[serde(rename = "type")]
    class: String,
    #[serde(rename = "3d_dimensions")]
    size: Size,
    #[serde(rename = "3d_location")]
    location: Location,
    #[serde(deserialize_with = "number")]
    rotation: f64,
}

#[derive(Deserialize)]
struct WorldLabel {
    #[serde(rename = "type")]
    class: String,
    #[serde(rename = "3d_dimensions")]
    size: Size,
    #[serde(rename = "world_8_points")]
    corners: [[f64; 3]; 8],
}

#[derive(Deserialize)]
struct Size {
    #[serde(deserialize_with = "number")]
    l: f64,
    #[serde(deserialize_with = "number")]
    w: f64,
    #[serde(deserialize_with = "number")]
    h: f64,
}

impl Size {
    fn is_real(&self) -> bool {
        [self.l, self.w, self.h].iter().all(|v| v.is_finite() && *v > 0.0)
    }

    fn to_box(&self, center: [f64; 3], yaw: f64, class: &str) -> Box3 {
        Box3 {
            center,
            length: self.l,
            width: self.w,
            height: self.h,
            yaw,
            velocity: None,
            class: class.into(),
            score: 1.0,
            track: None,
            covariance: None,
        }
    }
}

#[derive(Deserialize)]
struct Location {
    #[serde(deserialize_with = "number")]
    x: f64,
    #[serde(deserialize_with = "number")]
    y: f64,
    #[serde(deserialize_with = "number")]
    z: f64,
}

/// A number, also one written as text, as some files of the dataset do.
struct Number(f64);

impl<'de> Deserialize<'de> for Number {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        number(deserializer).map(Number)
    }
}

fn number<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
    #[derive(Deserialize)]
    #[serde(untagged)]
    enum Written {
        Number(f64),
        Text(String),
    }
    match Written::deserialize(deserializer)? {
        Written::Number(value) => Ok(value),
        Written::Text(text) => text
            .parse()
            .map_err(|_| D::Error::custom(format!("expected a number, found `{text}`"))),
    }
}
