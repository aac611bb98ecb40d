//! DAIR-V2X-C in its original layout (root `cooperative-vehicle-infrastructure`); images are not read.
//!
//! Frames: the log's `map` is the dataset's world. A body frame has the heading of the LiDAR and its z = 0 on the ground
//! below it; [`Level`] says which way is up, and how the ground is found: [`lidar_height`] below the LiDAR, or by a plane
//! through the points. The recorded `system_error_offset` of a pair is added to the roadside unit's position in the world.
//!
//! Views: labels were drawn where image and cloud show the same, so those of a side lie in the image of its camera, and the
//! cooperative ones in either. The boxes of the image labels are exact projections without the lens's distortion, so the
//! views are pinholes. The vehicle's calibration does not say the size of the image; all images are 1920 × 1080.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::fs;
use std::io::ErrorKind;
use std::path::{Component, Path, PathBuf};

use nalgebra::{Isometry3, Matrix3, Point3, Translation3, UnitQuaternion, Vector3};
use realo_logs::{AgentInfo, AgentKind, Levelled, LogInfo, LogWriter};
use realo_schemas::geometry::{View, is_valid, tilt_degrees, transform_box};
use realo_schemas::{Box3, Boxes, EgoState, Nanos, PointCloud, PoseStatus};
use serde::de::{DeserializeOwned, Error as _};
use serde::{Deserialize, Deserializer, Serialize};

use crate::ImportError;
use crate::level::{BELOW_A_SENSOR, Level, Plane, by_ground, by_pose};
use crate::pcd::{Points, read_points};

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

/// Size of all images, pixels.
const IMAGE: [u32; 2] = [1920, 1080];
/// What was labelled in an image may lie beside it at the sweep's stamp, m: up to 0.12 s lie between the two. Three of the
/// sample's labels lie beside it, by up to 0.99 m.
const VIEW_MARGIN: f64 = 1.0;

/// Duration of a vehicle's sweep (10.00 Hz; its stamp is the start).
const VEHICLE_SWEEP: Nanos = 100_000_000;
/// Duration of a roadside sweep (about 10.4 Hz).
const ROADSIDE_SWEEP: Nanos = 96_000_000;

/// What the recorded time of a roadside sweep is; the dataset does not say.
///
/// Either way it is the sweep's stamp, by which the dataset's authors paired the sides; what differs is when the sweep
/// is ready: a sweep's duration later, or at once.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum RoadsideStamp {
    /// The start of the sweep, as on the vehicle.
    #[default]
    Start,
    /// Its end.
    End,
}

/// How DAIR is imported.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct DairOptions {
    /// What the recorded time of a roadside sweep is.
    pub roadside_stamp: RoadsideStamp,
    /// By what the body frames are levelled.
    pub level: Level,
    /// Leaves out pairs of which a file or an entry is missing.
    pub skip_incomplete: bool,
}

/// What was imported.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Summary {
    /// Pairs of sweeps.
    pub pairs: usize,
    /// Pairs that were left out, for something of them is missing.
    pub incomplete_pairs: usize,
    /// What is missing of them, by cause.
    pub missing: BTreeMap<String, Vec<String>>,
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
    /// How the intensities of each agent became bytes.
    pub intensities: Vec<String>,
    /// Intensities that were limited to 0…255 after they were scaled.
    pub limited_intensities: usize,
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
        )?;
        for rule in &self.intensities {
            write!(f, "\nintensities {rule}")?;
        }
        if self.limited_intensities > 0 {
            let limited = self.limited_intensities;
            write!(
                f,
                "\nlimited: {limited} intensities below 0 or brighter than those of the first {LOOKED_AT} pairs"
            )?;
        }
        match self.incomplete_pairs {
            0 => Ok(()),
            pairs => write!(
                f,
                "\nleft out: {pairs} incomplete pairs; missing:\n{}",
                listed(&self.missing)
            ),
        }
    }
}

/// Imports a DAIR-V2X-C dataset into a log of the agents [`VEHICLE`] and [`ROADSIDE`].
///
/// Recorded detections are the single-side LiDAR labels in file order, score 1, and so are the own labels of both agents; the
/// vehicle's ground truth are the cooperative labels. Every frame is scored, without point counts, and has its views.
///
/// # Errors
/// All that is missing, at once; the first file that does not say what it must.
pub fn dair(dir: &Path, out: &Path, options: DairOptions) -> Result<Summary, ImportError> {
    dair_with(dir, out, options, |_, _| {})
}

/// As [`dair`]; calls `progress` with the pairs that are done and all pairs.
///
/// # Errors
/// As [`dair`].
pub fn dair_with(
    dir: &Path,
    out: &Path,
    options: DairOptions,
    mut progress: impl FnMut(u64, u64),
) -> Result<Summary, ImportError> {
    let DairOptions {
        roadside_stamp,
        level,
        skip_incomplete,
    } = options;
    let found = read_pairs(dir)?;
    let all = found.pairs.len() + found.incomplete;
    if !found.missing.is_empty() && (!skip_incomplete || found.pairs.is_empty()) {
        return Err(ImportError::Incomplete {
            path: dir.into(),
            incomplete: found.incomplete,
            pairs: all,
            missing: listed(&found.missing),
            some: !found.pairs.is_empty(),
        });
    }
    let pairs = found.pairs;
    let mut info = LogInfo::new(
        format!(
            "DAIR-V2X-C, roadside stamps taken as the {} of a sweep",
            match roadside_stamp {
                RoadsideStamp::Start => "start",
                RoadsideStamp::End => "end",
            }
        ),
        vec![
            agent(VEHICLE, AgentKind::Vehicle, level),
            agent(ROADSIDE, AgentKind::Roadside, level),
        ],
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
        dir: dir.into(),
        log: LogWriter::create_atomic(out, &info)?,
        summary: Summary {
            incomplete_pairs: found.incomplete,
            missing: found.missing,
            ..Summary::default()
        },
        level,
        tilts: BTreeMap::new(),
        brightest: [0.0; 2],
    };
    let clouds = [
        (
            VEHICLE,
            pairs.iter().map(|pair| &pair.vehicle_cloud).collect::<Vec<_>>(),
        ),
        (ROADSIDE, pairs.iter().map(|pair| &pair.roadside_cloud).collect()),
    ];
    for (side, (agent, clouds)) in clouds.into_iter().enumerate() {
        let (most, rule) = brightest(dir, &clouds)?;
        import.brightest[side] = most;
        import.summary.intensities.push(format!("of `{agent}`: {rule}"));
    }
    let (mut vehicles, mut roadsides) = (BTreeSet::new(), BTreeSet::new());
    for (done, pair) in pairs.iter().enumerate() {
        progress(done as u64, pairs.len() as u64);
        import.summary.pairs += 1;
        let new_vehicle = vehicles.insert(pair.vehicle.stamp);
        let new_roadside = roadsides.insert(pair.roadside.stamp);
        import.summary.repeated_sweeps += usize::from(!new_vehicle) + usize::from(!new_roadside);
        let vehicle_first = pair.vehicle.stamp + VEHICLE_SWEEP <= pair.roadside.stamp + roadside_sweep;
        if new_vehicle && vehicle_first {
            import.vehicle(pair)?;
        }
        if new_roadside {
            import.roadside(pair, roadside_sweep)?;
        }
        if new_vehicle && !vehicle_first {
            import.vehicle(pair)?;
        }
    }
    import.log.levelled(levelled(level, import.tilts));
    import.log.finish()?;
    Ok(import.summary)
}

/// Clouds of a side whose brightest intensity says how all of them are scaled, as of the sweeps of a log.
const LOOKED_AT: usize = 10;

/// The brightest intensity of the first clouds, and in words how intensities of a side are scaled.
fn brightest(dir: &Path, clouds: &[&PathBuf]) -> Result<(f32, String), ImportError> {
    let (mut most, mut first) = (0f32, None);
    for cloud in clouds.iter().take(LOOKED_AT) {
        let intensity = read_points(&dir.join(cloud))?.intensity;
        most = most.max(intensity.brightest().unwrap_or(0.0));
        first.get_or_insert(intensity);
    }
    let rule = match first {
        Some(intensity) => intensity.rule(most, clouds.len().min(LOOKED_AT)),
        None => String::new(),
    };
    Ok((most, rule))
}

/// Max files listed for each cause; of a data set on the wrong disk thousands are missing.
const LISTED: usize = 200;

fn listed(missing: &BTreeMap<String, Vec<String>>) -> String {
    let mut text = Vec::new();
    for (cause, names) in missing {
        text.push(format!("  {} × {cause}", names.len()));
        text.extend(names.iter().take(LISTED).map(|name| format!("    {name}")));
        if names.len() > LISTED {
            text.push(format!("    and {} more", names.len() - LISTED));
        }
    }
    text.join("\n")
}

fn agent(name: &str, kind: AgentKind, level: Level) -> AgentInfo {
    AgentInfo {
        name: name.into(),
        kind,
        footprint: (kind == AgentKind::Vehicle).then_some(FOOTPRINT),
        sensor: match level {
            Level::Ground => "LiDAR".into(),
            Level::Pose | Level::None => format!("LiDAR, {} m over the body frame", lidar_height(name)),
        },
        sensor_position: (level != Level::Ground).then_some([0.0, 0.0, lidar_height(name)]),
    }
}

fn levelled(level: Level, tilts: BTreeMap<&'static str, Vec<f64>>) -> BTreeMap<String, Levelled> {
    let of = |(agent, tilts): (&'static str, Vec<f64>)| {
        let degrees = [
            tilts.iter().copied().fold(f64::INFINITY, f64::min),
            tilts.iter().copied().fold(0.0, f64::max),
        ];
        let by = level.as_str().into();
        (agent.to_string(), Levelled { by, degrees })
    };
    tilts.into_iter().map(of).collect()
}

struct Import {
    dir: PathBuf,
    log: LogWriter,
    summary: Summary,
    level: Level,
    /// What was levelled of each sweep, degrees.
    tilts: BTreeMap<&'static str, Vec<f64>>,
    /// The brightest intensity of the vehicle's and of the roadside unit's first clouds.
    brightest: [f32; 2],
}

/// Where the frames of a sweep lie.
struct Placed {
    map_from_body: Isometry3<f64>,
    body_from_lidar: Isometry3<f64>,
}

impl Import {
    fn vehicle(&mut self, pair: &Pair) -> Result<(), ImportError> {
        let (dir, frame) = (self.dir.clone(), &pair.vehicle);
        let side = dir.join(VEHICLE_SIDE);
        let path = dir.join(&pair.vehicle_cloud);
        let cloud = read_points(&path)?;
        let placed = self.place(VEHICLE, &path, &vehicle_pose(&side, frame)?, &cloud)?;
        let Placed {
            map_from_body,
            body_from_lidar,
        } = placed;
        let ready = frame.stamp + VEHICLE_SWEEP;
        self.log
            .pose(VEHICLE, frame.stamp, frame.stamp, &state(map_from_body))?;
        self.cloud(VEHICLE, frame, ready, &path, cloud, &body_from_lidar)?;
        let own: Vec<View> = view(&side, frame, &body_from_lidar)?.into_iter().collect();
        self.summary.vehicle_boxes += self.labels(VEHICLE, &side, frame, ready, &body_from_lidar, &own)?;
        // Without one of the two views it is not known where cooperative labels could be.
        let other = &pair.roadside;
        let map_from_other = roadside_pose(&dir.join(ROADSIDE_SIDE), other, pair.offset)?;
        let theirs = view(&dir.join(ROADSIDE_SIDE), other, &map_from_body.inv_mul(&map_from_other))?;
        if let (Some(theirs), false) = (theirs, own.is_empty()) {
            let both = [own, vec![theirs]].concat();
            self.log.truth_views(VEHICLE, frame.stamp, ready, &both)?;
        }
        let truth = self.truth(&dir.join(&pair.truth), &map_from_body)?;
        self.summary.truth_boxes += truth.len();
        self.log.truth(VEHICLE, frame.stamp, ready, &truth, None, true)?;
        Ok(())
    }

    fn roadside(&mut self, pair: &Pair, sweep: Nanos) -> Result<(), ImportError> {
        let (dir, frame) = (self.dir.clone(), &pair.roadside);
        let side = dir.join(ROADSIDE_SIDE);
        let path = dir.join(&pair.roadside_cloud);
        let cloud = read_points(&path)?;
        let placed = self.place(ROADSIDE, &path, &roadside_pose(&side, frame, pair.offset)?, &cloud)?;
        let Placed {
            map_from_body,
            body_from_lidar,
        } = placed;
        let ready = frame.stamp + sweep;
        self.log
            .pose(ROADSIDE, frame.stamp, frame.stamp, &state(map_from_body))?;
        self.cloud(ROADSIDE, frame, ready, &path, cloud, &body_from_lidar)?;
        let own: Vec<View> = view(&side, frame, &body_from_lidar)?.into_iter().collect();
        self.summary.roadside_boxes += self.labels(ROADSIDE, &side, frame, ready, &body_from_lidar, &own)?;
        Ok(())
    }

    /// Levels a sweep.
    fn place(
        &mut self,
        agent: &'static str,
        path: &Path,
        map_from_lidar: &Isometry3<f64>,
        cloud: &Points,
    ) -> Result<Placed, ImportError> {
        let height = lidar_height(agent);
        let body_from_lidar = match self.level {
            Level::Pose => by_pose(&map_from_lidar.rotation, height),
            Level::Ground => {
                let points = cloud.x.iter().zip(&cloud.y).zip(&cloud.z);
                let points = points.map(|((x, y), z)| [*x, *y, *z]);
                let plane = Plane::of_ground(points, BELOW_A_SENSOR);
                by_ground(&plane.map_err(|reason| ImportError::content(path, reason))?)
            }
            Level::None => Translation3::new(0.0, 0.0, height).into(),
        };
        let tilts = self.tilts.entry(agent).or_default();
        tilts.push(tilt_degrees(&body_from_lidar.rotation));
        Ok(Placed {
            map_from_body: map_from_lidar * body_from_lidar.inverse(),
            body_from_lidar,
        })
    }

    fn cloud(
        &mut self,
        agent: &str,
        frame: &Frame,
        ready: Nanos,
        path: &Path,
        cloud: Points,
        body_from_lidar: &Isometry3<f64>,
    ) -> Result<(), ImportError> {
        let scale = cloud.intensity.scale(self.brightest[usize::from(agent == ROADSIDE)]);
        let (intensity, limited) = cloud.intensity.to_bytes(scale);
        self.summary.limited_intensities += limited;
        let cloud = to_body(cloud, intensity, frame.stamp, body_from_lidar)
            .map_err(|reason| ImportError::content(path, reason))?;
        self.summary.points += cloud.len();
        self.log.cloud(agent, frame.stamp, ready, &cloud)?;
        Ok(())
    }

    /// What a side labelled, as its recorded detections and as its own labels; their number.
    fn labels(
        &mut self,
        agent: &str,
        side: &Path,
        frame: &Frame,
        ready: Nanos,
        body_from_lidar: &Isometry3<f64>,
        views: &[View],
    ) -> Result<usize, ImportError> {
        let boxes = self.side_labels(&side.join(&frame.labels), body_from_lidar)?;
        self.log.detections(agent, frame.stamp, ready, &boxes)?;
        if !views.is_empty() {
            self.log.own_views(agent, frame.stamp, ready, views)?;
        }
        self.log.own_labels(agent, frame.stamp, ready, &boxes.0, None, true)?;
        Ok(boxes.0.len())
    }

    /// Labels of one side, in its body frame.
    fn side_labels(&mut self, path: &Path, body_from_lidar: &Isometry3<f64>) -> Result<Boxes, ImportError> {
        let mut boxes = Vec::new();
        for (index, label) in read_json::<Vec<SideLabel>>(path)?.into_iter().enumerate() {
            if label.size.is_placeholder() {
                self.summary.placeholders_dropped += 1;
                continue;
            }
            let Location { x, y, z } = label.location;
            let in_lidar = label.size.to_box([x, y, z], label.rotation, &label.class);
            let in_lidar = label_box(in_lidar).map_err(|found| not_a_label(path, index, &found))?;
            boxes.push(transform_box(body_from_lidar, &in_lidar));
        }
        Ok(Boxes(boxes))
    }

    /// Cooperative labels, in the vehicle's body frame. Their pose is taken from the corners: `rotation` is the angle
    /// in the frame of the side that drew the box, and missing where that is the roadside unit.
    fn truth(&mut self, path: &Path, map_from_body: &Isometry3<f64>) -> Result<Vec<Box3>, ImportError> {
        let body_from_map = map_from_body.inverse();
        let mut boxes = Vec::new();
        for (index, label) in read_json::<Vec<WorldLabel>>(path)?.into_iter().enumerate() {
            if label.size.is_placeholder() {
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
            let in_body = label.size.to_box(center.into(), yaw, &label.class);
            boxes.push(label_box(in_body).map_err(|found| not_a_label(path, index, &found))?);
        }
        Ok(boxes)
    }
}

/// Nothing that a LiDAR sees lies farther from it, m; single precision holds it to a centimetre.
const SEEN: f64 = 1e5;
/// Labels lie no farther from their agent, m.
const LABELLED: f64 = 1000.0;
/// No labelled thing is longer, wider or higher, m.
const LONGEST: f64 = 100.0;

/// More than a heading in radians or degrees needs.
const MOST_TURN: f64 = 1000.0;

/// A label in a frame of its agent; itself if there can be no such one.
fn label_box(label: Box3) -> Result<Box3, Box<Box3>> {
    let near = label.center.iter().all(|metres| metres.abs() <= LABELLED);
    let small = [label.length, label.width, label.height]
        .iter()
        .all(|metres| *metres <= LONGEST);
    match is_valid(&label) && near && small && label.yaw.abs() <= MOST_TURN {
        true => Ok(label),
        false => Err(label.into()),
    }
}

fn not_a_label(path: &Path, index: usize, found: &Box3) -> ImportError {
    let Box3 {
        center,
        length,
        width,
        height,
        yaw,
        class,
        ..
    } = found;
    let reason = format!(
        "label {index} (`{class}`): expected a box within {LABELLED} m of its agent, at most {LONGEST} m long, with a heading within \
         ±{MOST_TURN}, found centre {center:?} there, extents {:?} m and heading {yaw}",
        [length, width, height]
    );
    ImportError::content(path, reason)
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
fn to_body(
    cloud: Points,
    intensity: Vec<u8>,
    stamp: Nanos,
    body_from_lidar: &Isometry3<f64>,
) -> Result<PointCloud, String> {
    let n = cloud.x.len();
    let [mut x, mut y, mut z] = [(); 3].map(|()| Vec::with_capacity(n));
    for ((u, v), w) in cloud.x.iter().zip(&cloud.y).zip(&cloud.z) {
        if [u, v, w].iter().any(|metres| metres.abs() > SEEN) {
            return Err(format!(
                "expected points within {SEEN} m of the LiDAR, in its frame, found one at {u}, {v}, {w}; bring them there in doubles"
            ));
        }
        let point = body_from_lidar * Point3::new(*u, *v, *w);
        x.push(point.x as f32);
        y.push(point.y as f32);
        z.push(point.z as f32);
    }
    let time = match cloud.timestamp {
        None => vec![0; n],
        Some(times) => times
            .iter()
            .map(|time| offset(*time, stamp))
            .collect::<Result<Vec<_>, _>>()?,
    };
    PointCloud::new(x, y, z, intensity, time, vec![0u16; n]).ok_or_else(|| "columns of different length".into())
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

fn compose((r1, t1): &Parts, (r2, t2): &Parts) -> Parts {
    (r1 * r2, r1 * t2 + t1)
}

/// How far from the identity the product of a LiDAR's rotation and its transpose may be; the files' are orthonormal to 2e-7.
const ORTHONORMAL: f64 = 0.01;
/// The same of a camera's: the rotations to roadside cameras are skewed, with a determinant of 0.81.
const SKEWED: f64 = 0.5;
/// No place lies farther from the origin of the world, m: twice around the Earth.
const WORLD: f64 = 8e7;
/// No LiDAR is mounted at a greater tilt, degrees.
const MOST_TILT: f64 = 45.0;

/// A calibration from a file, whose rotation is one but for so much.
fn calibration(path: &Path, transform: &Transform, skew: f64) -> Result<Parts, ImportError> {
    let (rotation, translation) = transform.parts();
    let off = (rotation * rotation.transpose() - Matrix3::identity()).abs().max();
    // A NaN is not near either.
    if !(off <= skew && rotation.determinant() > 0.0) {
        let reason = format!(
            "rotation: expected an orthonormal matrix (within {skew}) with a positive determinant, found {:?} with determinant {:.3}",
            transform.rotation,
            rotation.determinant()
        );
        return Err(ImportError::content(path, reason));
    }
    if !translation.iter().all(|metres| metres.abs() <= WORLD) {
        let reason = format!(
            "translation: expected metres within ±{WORLD:e}, found {:?}",
            transform.translation
        );
        return Err(ImportError::content(path, reason));
    }
    Ok((rotation, translation))
}

/// Map from a LiDAR, by the calibration that tells how it lies in the world.
fn pose_of_lidar(path: &Path, parts: &Parts) -> Result<Isometry3<f64>, ImportError> {
    let map_from_lidar = isometry(parts);
    let tilt = tilt_degrees(&map_from_lidar.rotation);
    if tilt > MOST_TILT {
        let reason = format!("rotation: expected a LiDAR that tilts by at most {MOST_TILT}°, found {tilt:.1}°");
        return Err(ImportError::content(path, reason));
    }
    Ok(map_from_lidar)
}

/// The nearest rotation, and the translation.
fn isometry((rotation, translation): &Parts) -> Isometry3<f64> {
    let rotation = UnitQuaternion::from_matrix(rotation);
    Isometry3::from_parts(Translation3::from(*translation), rotation)
}

/// Map from the vehicle's LiDAR.
fn vehicle_pose(side: &Path, frame: &Frame) -> Result<Isometry3<f64>, ImportError> {
    let [mounting, place] = [0, 1].map(|index| side.join(&frame.calibrations[index]));
    let novatel_from_lidar = calibration(
        &mounting,
        &read_json::<LidarToNovatel>(&mounting)?.transform,
        ORTHONORMAL,
    )?;
    let world_from_novatel = calibration(&place, &read_json(&place)?, ORTHONORMAL)?;
    pose_of_lidar(&place, &compose(&world_from_novatel, &novatel_from_lidar))
}

/// Map from the roadside unit's LiDAR, the offset added in the world.
fn roadside_pose(side: &Path, frame: &Frame, [dx, dy]: [f64; 2]) -> Result<Isometry3<f64>, ImportError> {
    let path = side.join(&frame.calibrations[0]);
    let mut map_from_lidar = pose_of_lidar(&path, &calibration(&path, &read_json(&path)?, ORTHONORMAL)?)?;
    map_from_lidar.translation.vector += Vector3::new(dx, dy, 0.0);
    Ok(map_from_lidar)
}

/// What the camera of a side has in its image, in the frame that is given from the LiDAR; `None` for a data set whose lists
/// name no calibration of a camera.
fn view(side: &Path, frame: &Frame, to_from_lidar: &Isometry3<f64>) -> Result<Option<View>, ImportError> {
    let Some([extrinsic, intrinsic]) = &frame.camera else {
        return Ok(None);
    };
    let path = side.join(extrinsic);
    let camera_from_lidar = isometry(&calibration(&path, &read_json(&path)?, SKEWED)?);
    let path = side.join(intrinsic);
    let Intrinsic { k, width, height } = read_json(&path)?;
    let view = View {
        frame_from_camera: to_from_lidar * camera_from_lidar.inverse(),
        focal: [k[0], k[4]],
        center: [k[2], k[5]],
        size: [width.unwrap_or(IMAGE[0]), height.unwrap_or(IMAGE[1])],
        margin: VIEW_MARGIN,
    };
    let named = |reason: String| {
        let said = [
            ("`focal`", "`cam_K`"),
            ("`center`", "`cam_K`"),
            ("`size`", "`width`, `height`"),
        ];
        said.iter()
            .fold(reason, |reason, (ours, theirs)| reason.replace(ours, theirs))
    };
    view.checked()
        .map(Some)
        .map_err(|reason| ImportError::content(&path, named(reason)))
}

const VEHICLE_SIDE: &str = "vehicle-side";
const ROADSIDE_SIDE: &str = "infrastructure-side";

/// One side of a pair.
#[derive(Clone, Debug)]
struct Frame {
    stamp: Nanos,
    /// Of the LiDAR.
    calibrations: Vec<PathBuf>,
    /// Of the camera: where it lies to the LiDAR, and what is in its image.
    camera: Option<[PathBuf; 2]>,
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

/// The pairs of a data set, and what is missing of others.
struct FoundPairs {
    /// In order of the vehicle's stamps.
    pairs: Vec<Pair>,
    incomplete: usize,
    missing: BTreeMap<String, Vec<String>>,
}

fn read_pairs(dir: &Path) -> Result<FoundPairs, ImportError> {
    let list = Path::new("cooperative").join(LIST);
    let (infos, broken) = entries::<PairInfo>(dir, &list)?;
    let mut missing = Missing::default();
    let vehicles = read_frames::<VehicleInfo>(dir, VEHICLE_SIDE, &mut missing)?;
    let roadsides = read_frames::<RoadsideInfo>(dir, ROADSIDE_SIDE, &mut missing)?;
    let (mut pairs, mut incomplete) = (Vec::new(), broken.len());
    missing.broken(&list, broken);
    for info in infos {
        let before = missing.found;
        let [vehicle_cloud, roadside_cloud, truth] = [
            info.vehicle_pointcloud_path,
            info.infrastructure_pointcloud_path,
            info.cooperative_label_path,
        ]
        .map(local);
        missing.file(dir, truth.clone());
        let vehicle = missing.frame(dir, VEHICLE_SIDE, &vehicles, &vehicle_cloud);
        let roadside = missing.frame(dir, ROADSIDE_SIDE, &roadsides, &roadside_cloud);
        match (vehicle, roadside) {
            (Some(vehicle), Some(roadside)) if missing.found == before => pairs.push(Pair {
                vehicle,
                roadside,
                vehicle_cloud,
                roadside_cloud,
                truth,
                offset: info.system_error_offset.meters(),
            }),
            _ => incomplete += 1,
        }
    }
    if pairs.is_empty() && incomplete == 0 {
        let reason = "expected at least one pair, found none";
        return Err(ImportError::content(&dir.join(list), reason));
    }
    pairs.sort_by_key(|pair| (pair.vehicle.stamp, pair.roadside.stamp));
    Ok(FoundPairs {
        pairs,
        incomplete,
        missing: missing.by_cause,
    })
}

/// What is missing.
#[derive(Default)]
struct Missing {
    by_cause: BTreeMap<String, Vec<String>>,
    seen: BTreeSet<(String, String)>,
    /// How often something was missing, repeats included.
    found: usize,
}

impl Missing {
    fn add(&mut self, cause: impl Into<String>, name: impl Into<String>) {
        let (cause, name) = (cause.into(), name.into());
        self.found += 1;
        if self.seen.insert((cause.clone(), name.clone())) {
            self.by_cause.entry(cause).or_default().push(name);
        }
    }

    fn broken(&mut self, list: &Path, entries: Vec<String>) {
        let cause = format!("entry of {} that cannot be read", list.display());
        entries.into_iter().for_each(|entry| self.add(&cause, entry));
    }

    /// A file that must be there, and hold something.
    fn file(&mut self, dir: &Path, file: PathBuf) {
        let name = file.display().to_string();
        match fs::metadata(dir.join(&file)) {
            Ok(found) if found.is_dir() => self.add("a folder, expected a file", name),
            Ok(found) if found.len() == 0 => self.add("an empty file", name),
            Ok(_) => {}
            Err(error) if error.kind() == ErrorKind::NotFound => self.add("no such file", name),
            Err(error) => self.add(error.to_string(), name),
        }
    }

    /// A side's frame by its cloud, whose files must be there.
    fn frame(&mut self, dir: &Path, side: &str, frames: &BTreeMap<PathBuf, Frame>, cloud: &Path) -> Option<Frame> {
        self.file(dir, cloud.into());
        let Some(frame) = frames.get(cloud) else {
            self.add(format!("in no entry of {side}/{LIST}"), cloud.display().to_string());
            return None;
        };
        let camera = frame.camera.iter().flatten();
        for file in frame.calibrations.iter().chain([&frame.labels]).chain(camera) {
            self.file(dir, Path::new(side).join(file));
        }
        Some(frame.clone())
    }
}

/// A list of the data set in each of its folders.
const LIST: &str = "data_info.json";

/// The entries of a list, and what is wrong with those that are none.
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

fn read_frames<T: SideInfo>(
    dir: &Path,
    side: &str,
    missing: &mut Missing,
) -> Result<BTreeMap<PathBuf, Frame>, ImportError> {
    let list = Path::new(side).join(LIST);
    let (infos, broken) = entries::<T>(dir, &list)?;
    missing.broken(&list, broken);
    let mut frames = BTreeMap::new();
    for info in infos {
        let (cloud, stamp, frame) = info.into_parts();
        match nanos(&stamp) {
            Ok(stamp) => _ = frames.insert(Path::new(side).join(local(cloud)), Frame { stamp, ..frame }),
            Err(reason) => missing.broken(
                &list,
                vec![format!("{}: pointcloud_timestamp: {reason}", cloud.display())],
            ),
        }
    }
    Ok(frames)
}

/// A stamp in ns, of one that is written in µs.
fn nanos(stamp: &str) -> Result<Nanos, String> {
    let micros: i64 = stamp
        .parse()
        .map_err(|_| format!("expected microseconds, found `{stamp}`"))?;
    let nanos = micros.checked_mul(1000).filter(|nanos| *nanos >= 0);
    nanos.ok_or_else(|| format!("expected 0 to {} microseconds, found {micros}", i64::MAX / 1000))
}

/// A path of the data set's lists, which some tools write with backslashes.
fn local(path: PathBuf) -> PathBuf {
    let text = path.to_string_lossy().replace('\\', "/");
    Path::new(&text)
        .components()
        .filter(|part| *part != Component::CurDir)
        .collect()
}

/// A file of JSON; some editors put a mark of UTF-8 before it.
fn read_json<T: DeserializeOwned>(path: &Path) -> Result<T, ImportError> {
    let bytes = fs::read(path).map_err(ImportError::io(path))?;
    if bytes.starts_with(&[0xff, 0xfe]) || bytes.starts_with(&[0xfe, 0xff]) {
        return Err(ImportError::content(
            path,
            "expected UTF-8, found UTF-16; save it as UTF-8",
        ));
    }
    let text = bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(&bytes);
    serde_json::from_slice(text).map_err(|error| ImportError::content(path, error))
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
    calib_lidar_to_camera_path: Option<PathBuf>,
    calib_camera_intrinsic_path: Option<PathBuf>,
    label_lidar_std_path: PathBuf,
}

impl SideInfo for VehicleInfo {
    fn into_parts(self) -> (PathBuf, String, Frame) {
        let calibrations = [self.calib_lidar_to_novatel_path, self.calib_novatel_to_world_path];
        let camera = self.calib_lidar_to_camera_path.zip(self.calib_camera_intrinsic_path);
        let frame = Frame {
            stamp: 0,
            calibrations: calibrations.map(local).into(),
            camera: camera.map(|(extrinsic, intrinsic)| [extrinsic, intrinsic].map(local)),
            labels: local(self.label_lidar_std_path),
        };
        (self.pointcloud_path, self.pointcloud_timestamp, frame)
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
    fn into_parts(self) -> (PathBuf, String, Frame) {
        let camera = self
            .calib_virtuallidar_to_camera_path
            .zip(self.calib_camera_intrinsic_path);
        let frame = Frame {
            stamp: 0,
            calibrations: vec![local(self.calib_virtuallidar_to_world_path)],
            camera: camera.map(|(extrinsic, intrinsic)| [extrinsic, intrinsic].map(local)),
            labels: local(self.label_lidar_std_path),
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

/// Of a camera: its matrix, row-major, and the size of its image, which the vehicle's files leave out.
#[derive(Deserialize)]
struct Intrinsic {
    #[serde(rename = "cam_K")]
    k: [f64; 9],
    width: Option<u32>,
    height: Option<u32>,
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
    /// Of an object that was labelled in the image only.
    fn is_placeholder(&self) -> bool {
        [self.l, self.w, self.h].iter().any(|metres| *metres <= 0.0)
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
