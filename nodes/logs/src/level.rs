//! Body frames that pitch and roll, made level by the poses of the log: z points up as that of the map does.

use std::collections::BTreeMap;
use std::sync::Arc;

use nalgebra::{Isometry3, Translation3};
use realo_schemas::geometry::{Motion, PoseTrack, View, level_from_body, tilt_degrees, transform_boxes};
use realo_schemas::{AgentState, Box3, Nanos, PointCloud};

use crate::{Log, LogError, Stream};

/// Body frames that tilt less are level, degrees: the noise of an attitude is less.
pub const LEVEL: f64 = 0.25;

/// How far body frames tilt at most by all poses, believed and true ones, degrees; of the agents with poses of which the log
/// does not say how they were levelled.
///
/// # Errors
/// A log that cannot be read.
pub(crate) fn tilts(log: &Log) -> Result<BTreeMap<String, f64>, LogError> {
    let reported = log.levelled()?;
    let agents = log.info().agents.iter().map(|agent| agent.name.as_str());
    let streams = agents.flat_map(|agent| [Stream::Pose, Stream::PoseTruth].map(|stream| (agent, stream)));
    let there = |(agent, stream): &(&str, Stream)| !reported.contains_key(*agent) && log.has(agent, *stream);
    let wanted: Vec<(&str, Stream)> = streams.filter(there).collect();
    let mut tilts: BTreeMap<String, f64> = wanted.iter().map(|(agent, _)| (agent.to_string(), 0.0)).collect();
    let mut reader = log.read_all(&wanted)?;
    while let Some(entry) = reader.next()? {
        // What is no pose is counted when the log is played.
        if let (Some(most), Ok(state)) = (tilts.get_mut(&*entry.agent), entry.pose()) {
            *most = most.max(tilt_degrees(&state.map_from_body.rotation));
        }
    }
    Ok(tilts)
}

/// The agents whose frames are levelled while the log is played, and how far these tilt at most, degrees. Packets lie in the
/// frames of their making: beside them all stays as it is.
///
/// # Errors
/// A log that cannot be read.
pub fn levelled_while_played(log: &Log) -> Result<BTreeMap<String, f64>, LogError> {
    match log.info().precomputed {
        Some(_) => Ok(BTreeMap::new()),
        None => tilted(log),
    }
}

/// The agents whose frames are not level, and how far these tilt at most, degrees.
fn tilted(log: &Log) -> Result<BTreeMap<String, f64>, LogError> {
    let mut tilts = tilts(log)?;
    tilts.retain(|_, tilt| *tilt > LEVEL);
    Ok(tilts)
}

/// Refuses a log that tilts, for what reads a log as it is and has to agree with what is played.
///
/// # Errors
/// A log that cannot be read, or whose frames are levelled while it is played.
pub fn need_level(log: &Log) -> Result<(), LogError> {
    let Some((agent, tilt)) = tilted(log)?.pop_first() else {
        return Ok(());
    };
    let reason = format!(
        "poses of `{agent}`: expected ones that are level within {LEVEL}°, found {tilt:.2}°: level the log by `realo import log` first"
    );
    Err(LogError::Unfit {
        path: log.path().into(),
        reason,
    })
}

/// The pose of the level frame: the heading and the place of the body's.
pub fn level_state(state: AgentState) -> AgentState {
    let body_from_level = level_from_body(&state.map_from_body.rotation).inverse();
    AgentState {
        map_from_body: state.map_from_body * body_from_level,
        angular_rate: state.angular_rate.map(|rate| body_from_level.inverse() * rate),
        ..state
    }
}

/// Which way is up in an agent's body frame, by its poses.
#[derive(Clone, Debug)]
pub struct Attitude(PoseTrack);

impl Attitude {
    /// Poses further apart say nothing of what lies between, ns.
    pub const MAX_GAP: Nanos = 1_000_000_000;

    /// By all poses of a stream; what is no pose is skipped.
    ///
    /// # Errors
    /// A log that cannot be read, or that does not have the stream.
    pub fn read(log: &Log, agent: &str, stream: Stream) -> Result<Self, LogError> {
        let mut track = PoseTrack::new(Nanos::MAX, Self::MAX_GAP);
        let mut reader = log.read_all(&[(agent, stream)])?;
        while let Some(entry) = reader.next()? {
            if let Ok(state) = entry.pose() {
                track.insert(entry.stamp(), state.map_from_body);
            }
        }
        Ok(Attitude(track))
    }

    /// Level from body at a time; `None` where no poses are near, and behind the last: how a body nodded says little of how it
    /// will.
    pub fn at(&self, stamp: Nanos) -> Option<Isometry3<f64>> {
        let known = stamp <= self.0.newest()?;
        self.0.at(stamp).filter(|_| known).map(|pose| level(&pose))
    }

    /// Level from body at a time; where no poses are near, by the nearest that there is.
    pub fn near(&self, stamp: Nanos) -> Isometry3<f64> {
        let nearest = || self.0.nearest(stamp).map(|pose| level(&pose));
        self.at(stamp).or_else(nearest).unwrap_or_default()
    }

    /// A sweep with each point in the level frame of its own time. Points that reach beyond the poses turn with the sweep.
    pub fn cloud(&self, stamp: Nanos, mut cloud: PointCloud) -> PointCloud {
        let ends = cloud.time.iter().min().zip(cloud.time.iter().max());
        let Some((first, last)) = ends.map(|(first, last)| (Nanos::from(*first), Nanos::from(*last))) else {
            return cloud;
        };
        let whole = self.near(stamp);
        let then = |time: Nanos| self.at(stamp.saturating_add(time)).unwrap_or(whole);
        let motion = Motion::by(first, last, then);
        let [x, y, z] = motion.at_stamp([&cloud.x, &cloud.y, &cloud.z], &cloud.time);
        (cloud.x, cloud.y, cloud.z) = (x.into(), y.into(), z.into());
        cloud
    }

    /// Brings boxes of a stamp to the level frame.
    pub fn boxes(&self, stamp: Nanos, boxes: &mut [Box3]) {
        transform_boxes(&self.near(stamp), boxes);
    }

    /// Brings views of a stamp to the level frame.
    pub fn views(&self, stamp: Nanos, views: &mut [View]) {
        let level = self.near(stamp);
        views.iter_mut().for_each(|view| *view = view.moved(&level));
    }
}

fn level(map_from_body: &Isometry3<f64>) -> Isometry3<f64> {
    Isometry3::from_parts(Translation3::identity(), level_from_body(&map_from_body.rotation))
}

/// The attitudes that make an agent's frames level.
#[derive(Clone, Debug)]
pub struct Attitudes {
    /// By the poses that go with its sweeps, for clouds and detections.
    pub sweeps: Arc<Attitude>,
    /// By its true poses, where the log has them, for ground truth, own labels and their views.
    pub truth: Arc<Attitude>,
}

impl Attitudes {
    /// `poses`: the stream whose poses go with the sweeps.
    ///
    /// # Errors
    /// As [`Attitude::read`].
    pub fn read(log: &Log, agent: &str, poses: Stream) -> Result<Self, LogError> {
        let sweeps = Arc::new(Attitude::read(log, agent, poses)?);
        let truth = match poses == Stream::PoseTruth || !log.has(agent, Stream::PoseTruth) {
            true => sweeps.clone(),
            false => Arc::new(Attitude::read(log, agent, Stream::PoseTruth)?),
        };
        Ok(Attitudes { sweeps, truth })
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{Point3, UnitQuaternion};
    use realo_schemas::PoseStatus;
    use realo_schemas::geometry::yaw_of;

    use super::*;

    const MS: Nanos = 1_000_000;

    /// A body that turns, and nods by up to 3° three times a second.
    fn pose(stamp: Nanos) -> Isometry3<f64> {
        let t = 1e-9 * stamp as f64;
        let rotation = UnitQuaternion::from_euler_angles(0.02, 0.05 * (20.0 * t).sin(), 0.5 + 0.3 * t);
        Isometry3::from_parts(Translation3::new(100.0 + 10.0 * t, 5.0, 2.0), rotation)
    }

    fn attitude() -> Attitude {
        let mut track = PoseTrack::new(Nanos::MAX, Attitude::MAX_GAP);
        (0..=30).for_each(|tick| track.insert(10 * tick * MS, pose(10 * tick * MS)));
        Attitude(track)
    }

    #[test]
    fn each_point_is_levelled_by_the_pose_of_its_own_time() {
        let stamp = 150 * MS;
        let times: Vec<i32> = (-50..50).rev().map(|i| 1_000_000 * i + 137).collect();
        // Level ground, seen from a body that is not level.
        let ground = |time: i32| Point3::new(60.0, 0.5 * f64::from(time) * 1e-6, 0.0);
        let seen = |time: &i32| level(&pose(stamp + Nanos::from(*time))).inverse() * ground(*time);
        let points: Vec<Point3<f64>> = times.iter().map(seen).collect();
        let column = |axis: usize| points.iter().map(|point| point[axis] as f32).collect::<Vec<f32>>();
        let n = points.len();
        let cloud = PointCloud::new(column(0), column(1), column(2), vec![7; n], times.clone(), vec![3; n]);
        let tilted = cloud.unwrap();
        assert!(tilted.z.iter().any(|z| z.abs() > 1.0));
        let found = attitude().cloud(stamp, tilted.clone());
        for (i, time) in times.iter().enumerate() {
            let point = Point3::new(found.x[i], found.y[i], found.z[i]).cast::<f64>();
            let off = (point - ground(*time)).norm();
            // What poses 10 ms apart say of what nods in between.
            assert!(off < 0.02, "{off} m at {time} ns");
        }
        let others = |cloud: &PointCloud| (cloud.intensity.to_vec(), cloud.time.to_vec(), cloud.ring.to_vec());
        assert_eq!(others(&found), others(&tilted));
        assert_eq!(attitude().cloud(stamp, PointCloud::empty()), PointCloud::empty());
    }

    #[test]
    fn a_level_pose_keeps_heading_and_place() {
        let state = AgentState {
            map_from_body: pose(70 * MS),
            covariance: None,
            velocity: None,
            angular_rate: None,
            status: PoseStatus::Truth,
        };
        let found = level_state(state.clone());
        let (from, to) = (state.map_from_body, found.map_from_body);
        assert!(tilt_degrees(&from.rotation) > 1.0 && tilt_degrees(&to.rotation) < 1e-9);
        assert!((yaw_of(&from.rotation) - yaw_of(&to.rotation)).abs() < 1e-12);
        assert_eq!((from.translation, found.status), (to.translation, PoseStatus::Truth));
    }

    #[test]
    fn beyond_the_poses_the_nearest_tells() {
        let attitude = attitude();
        assert_eq!(attitude.at(-MS), None);
        assert_eq!(attitude.near(-MS), level(&pose(0)));
        assert_eq!(attitude.at(5_000 * MS), None);
        for behind in [350, 5_000] {
            assert_eq!(attitude.near(behind * MS), level(&pose(300 * MS)));
        }
        assert_eq!(attitude.near(100 * MS), level(&pose(100 * MS)));
        let empty = Attitude(PoseTrack::new(Nanos::MAX, Attitude::MAX_GAP));
        assert_eq!(empty.near(0), Isometry3::identity());
    }
}
