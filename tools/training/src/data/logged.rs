//! Frames from a log with ground truth.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use nalgebra::Isometry3;
use realo_logs::{AgentKind, Log, Stream, need_level, pose_track, same};
use realo_schemas::geometry::{PoseTrack, transform_box};
use realo_schemas::{Box3, Boxes, Nanos, PointCloud, from_seconds};
use realo_scoring::Protocol;

use super::frame::{AgentSweep, Frame, Seen};
use super::frames::Frames;
use super::simulated::{class_names, deskewed, returns, seen};
use crate::TrainError;

/// How far from a frame's time an agent's sweep may lie, ns.
const NEAR: Nanos = 60_000_000;

/// Longest gap between poses, ns.
const POSE_GAP: Nanos = 500_000_000;

/// A box is this much larger on every side when points in it are counted, m: sensors and labels err.
const SLACK: f64 = 0.05;

/// Frames of logs, kept in a folder.
pub struct LoggedFrames {
    paths: Vec<PathBuf>,
    /// Of each log.
    identities: Vec<u64>,
}

impl LoggedFrames {
    /// Brings frames of logs, at least so many seconds apart, into a folder, as far as they are not there.
    ///
    /// # Errors
    /// [`TrainError::NoTruth`] for a log without ground truth, [`TrainError::Log`] for one that cannot be read.
    pub fn new(folder: &Path, logs: &[PathBuf], apart: f64) -> Result<Self, TrainError> {
        std::fs::create_dir_all(folder).map_err(|error| TrainError::Write {
            path: folder.into(),
            error,
        })?;
        let (mut paths, mut identities) = (Vec::new(), Vec::new());
        for log in logs {
            let reading = Reading::open(log)?;
            let identity = reading.identity();
            paths.extend(reading.extract(folder, identity, from_seconds(apart))?);
            identities.push(identity);
        }
        Ok(LoggedFrames { paths, identities })
    }

    /// Tells these logs from others, and from the same files with another content.
    pub fn identity(&self) -> String {
        let words: Vec<String> = self
            .identities
            .iter()
            .map(|identity| format!("{identity:016x}"))
            .collect();
        words.join(" ")
    }
}

impl Frames for LoggedFrames {
    fn len(&self) -> usize {
        self.paths.len()
    }

    fn load(&self, index: usize) -> Result<Frame, TrainError> {
        Frame::read(&self.paths[index])
    }
}

/// A log whose frames are wanted.
struct Reading {
    log: Log,
    protocol: Protocol,
    tracks: BTreeMap<String, PoseTrack>,
    /// Agents with ground truth, each with its objects and their points by stamp.
    truth: BTreeMap<String, BTreeMap<Nanos, Labels>>,
}

/// Labels of one agent at one stamp.
#[derive(Default)]
struct Labels {
    objects: Boxes,
    /// The agent's own points on each, where somebody counted.
    points: Option<Vec<u32>>,
}

impl Reading {
    fn open(path: &Path) -> Result<Self, TrainError> {
        let log = Log::open(path)?;
        need_level(&log)?;
        let protocol = Protocol::load(&log.info().protocol).map_err(|error| TrainError::Protocol {
            path: path.into(),
            error,
        })?;
        let names: Vec<String> = log.info().agents.iter().map(|agent| agent.name.clone()).collect();
        let mut reading = Reading {
            log,
            protocol,
            tracks: BTreeMap::new(),
            truth: BTreeMap::new(),
        };
        for name in &names {
            reading.read_poses(name)?;
            if reading.log.has(name, Stream::GroundTruth) {
                reading.read_truth(name)?;
            }
        }
        match reading.truth.is_empty() {
            true => Err(TrainError::NoTruth {
                path: path.into(),
                agent: names.join("`, `"),
            }),
            false => Ok(reading),
        }
    }

    /// The true poses where the log has them.
    fn read_poses(&mut self, agent: &str) -> Result<(), TrainError> {
        let stream = if self.log.has(agent, Stream::PoseTruth) {
            Stream::PoseTruth
        } else {
            Stream::Pose
        };
        let track = pose_track(&self.log, agent, stream, POSE_GAP)?;
        self.tracks.insert(agent.into(), track);
        Ok(())
    }

    fn read_truth(&mut self, agent: &str) -> Result<(), TrainError> {
        let mut wanted = vec![(agent, Stream::GroundTruth)];
        if self.log.has(agent, Stream::GroundTruthInfo) {
            wanted.push((agent, Stream::GroundTruthInfo));
        }
        let mut reader = self.log.read_all(&wanted)?;
        let mut labels: BTreeMap<Nanos, Labels> = BTreeMap::new();
        while let Some(entry) = reader.next()? {
            let here = labels.entry(entry.stamp()).or_default();
            match entry.stream {
                Stream::GroundTruth => here.objects = entry.boxes()?,
                _ => here.points = entry.info(&mut here.objects)?.points,
            }
        }
        self.truth.insert(agent.into(), labels);
        Ok(())
    }

    /// Writes the frames that are missing; returns the paths of all. `apart`: min time between two, ns.
    fn extract(&self, folder: &Path, identity: u64, apart: Nanos) -> Result<Vec<PathBuf>, TrainError> {
        let Some((first, labels)) = self.truth.first_key_value() else {
            return Ok(Vec::new());
        };
        let (mut paths, mut last) = (Vec::new(), None);
        for stamp in labels.keys().copied() {
            if last.is_some_and(|last| stamp - last < apart) {
                continue;
            }
            last = Some(stamp);
            let path = folder.join(format!("log-{identity:016x}-{stamp}.frame"));
            if !path.exists() {
                let Some(frame) = self.frame(stamp, first)? else {
                    continue;
                };
                frame.write(&path)?;
            }
            paths.push(path);
        }
        Ok(paths)
    }

    /// Tells logs of the same name and different content apart: a hash of its path, its source, its span, and of size and
    /// date of the file.
    fn identity(&self) -> u64 {
        let file = std::fs::metadata(self.log.path()).map(|file| (file.len(), file.modified().ok()));
        let (path, info, span) = (self.log.path(), self.log.info(), self.log.span());
        let text = format!("{path:?} {info:?} {span:?} {:?}", file.ok());
        text.bytes().fold(0xcbf2_9ce4_8422_2325, |hash, byte| {
            (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3)
        })
    }

    /// The sweeps nearest to a stamp; `None` if the agent with the labels has none there.
    fn frame(&self, stamp: Nanos, labelled: &str) -> Result<Option<Frame>, TrainError> {
        let mut agents = Vec::new();
        for info in &self.log.info().agents {
            let Some((at, cloud)) = self.nearest(&info.name, stamp)? else {
                continue;
            };
            let track = &self.tracks[&info.name];
            let roadside = info.kind == AgentKind::Roadside;
            let (Some(pose), Some(cloud)) = (track.at(at), deskewed(&cloud, track, at, roadside)) else {
                continue;
            };
            let points: Vec<[f32; 3]> = returns(&cloud).map(|(point, _)| point).collect();
            let Some(objects) = self.objects(&info.name, at, &pose, &points, (labelled, stamp)) else {
                continue;
            };
            agents.push(AgentSweep::new(&info.name, roadside, pose, returns(&cloud), objects));
        }
        let complete = agents.iter().any(|agent| agent.name == labelled);
        let classes = class_names(&self.protocol);
        Ok(complete.then_some(Frame {
            classes,
            agents,
            earlier: None,
        }))
    }

    fn nearest(&self, agent: &str, stamp: Nanos) -> Result<Option<(Nanos, PointCloud)>, TrainError> {
        if !self.log.has(agent, Stream::Points) {
            return Ok(None);
        }
        // A sweep is complete some time after its stamp.
        let mut reader = self.log.read(
            &[(agent, Stream::Points)],
            stamp - NEAR,
            stamp + NEAR + from_seconds(1.0),
        )?;
        let mut best = None;
        while let Some(entry) = reader.next()? {
            let off = (entry.stamp() - stamp).abs();
            if off <= NEAR && best.as_ref().is_none_or(|(least, _)| off < *least) {
                best = Some((off, entry));
            }
        }
        best.map(|(_, entry)| Ok((entry.stamp(), entry.cloud()?))).transpose()
    }

    /// The objects around an agent: its own labels, else those of the agent that has some.
    fn objects(
        &self,
        agent: &str,
        stamp: Nanos,
        pose: &Isometry3<f64>,
        points: &[[f32; 3]],
        (labelled, labelled_at): (&str, Nanos),
    ) -> Option<Vec<Seen>> {
        let own = self.truth.get(agent);
        if let Some(labels) = own.and_then(|truth| truth.get(&same(truth, stamp)?)) {
            return Some(match &labels.points {
                Some(counts) => seen(&self.protocol, &labels.objects.0, counts.iter().copied()),
                None => self.counted(&labels.objects.0, points),
            });
        }
        let map_from_labelled = self.tracks[labelled].at(labelled_at)?;
        let agent_from_labelled = pose.inverse() * map_from_labelled;
        let objects = &self.truth[labelled].get(&labelled_at)?.objects.0;
        let moved: Vec<Box3> = objects
            .iter()
            .map(|object| transform_box(&agent_from_labelled, object))
            .collect();
        Some(self.counted(&moved, points))
    }

    fn counted(&self, objects: &[Box3], points: &[[f32; 3]]) -> Vec<Seen> {
        let count = |object: &Box3| points.iter().filter(|point| contains(object, **point)).count() as u32;
        seen(&self.protocol, objects, objects.iter().map(count))
    }
}

fn contains(object: &Box3, point: [f32; 3]) -> bool {
    let [dx, dy, dz] = std::array::from_fn(|i| f64::from(point[i]) - object.center[i]);
    let (sin, cos) = object.yaw.sin_cos();
    let within = |offset: f64, extent: f64| offset.abs() <= extent / 2.0 + SLACK;
    within(dx * cos + dy * sin, object.length) && within(dy * cos - dx * sin, object.width) && within(dz, object.height)
}

#[cfg(test)]
mod tests {
    use nalgebra::{Translation3, UnitQuaternion};
    use realo_logs::{AgentInfo, LogInfo, LogWriter};
    use realo_schemas::{EgoState, PoseStatus};

    use super::*;

    const TENTH: Nanos = 100_000_000;
    const SECOND: Nanos = 1_000_000_000;

    fn agent(name: &str, kind: AgentKind) -> AgentInfo {
        AgentInfo {
            name: name.into(),
            kind,
            footprint: None,
            sensor: String::new(),
            sensor_position: None,
        }
    }

    fn state(x: f64, y: f64, yaw: f64) -> EgoState {
        EgoState {
            map_from_body: Isometry3::from_parts(
                Translation3::new(x, y, 0.0),
                UnitQuaternion::from_euler_angles(0.0, 0.0, yaw),
            ),
            covariance: None,
            velocity: None,
            angular_rate: None,
            status: PoseStatus::Truth,
        }
    }

    fn cloud(points: &[[f32; 3]]) -> PointCloud {
        let column = |axis: usize| points.iter().map(|point| point[axis]).collect::<Vec<f32>>();
        let count = points.len();
        PointCloud::new(
            column(0),
            column(1),
            column(2),
            vec![0; count],
            vec![0; count],
            vec![0; count],
        )
        .unwrap()
    }

    fn car(x: f64, class: &str) -> Box3 {
        Box3 {
            center: [x, 0.0, 0.8],
            length: 4.5,
            width: 1.9,
            height: 1.6,
            yaw: 0.0,
            velocity: None,
            class: class.into(),
            score: 1.0,
            track: Some(7),
            covariance: None,
        }
    }

    /// A car 20 m ahead of a vehicle, and a roadside unit beyond it that looks back at it and has no labels.
    fn log(folder: &Path, truth: bool) -> PathBuf {
        let path = folder.join(if truth { "a.mcap" } else { "bare.mcap" });
        let agents = vec![agent("cav1", AgentKind::Vehicle), agent("rsu1", AgentKind::Roadside)];
        let mut writer = LogWriter::create(&path, &LogInfo::new("a test", agents)).unwrap();
        for step in 0..25 {
            let now = SECOND + step * TENTH;
            writer.pose("cav1", now, now, &state(0.0, 0.0, 0.0)).unwrap();
            writer
                .pose("rsu1", now, now, &state(30.0, 0.0, std::f64::consts::PI))
                .unwrap();
            let (seen, back) = ([[19.0, 0.5, 1.0]; 3], [[11.0, -0.5, 1.0]; 4]);
            writer.cloud("cav1", now, now, &cloud(&seen)).unwrap();
            // Its sweeps lie a little later.
            writer
                .cloud("rsu1", now + TENTH / 4, now + TENTH / 4, &cloud(&back))
                .unwrap();
            let objects = [car(20.0, "Car"), car(40.0, "FireHydrant")];
            if truth {
                writer.truth("cav1", now, now, &objects, None, true).unwrap();
            }
        }
        writer.finish().unwrap();
        path
    }

    #[test]
    fn labels_of_one_agent_serve_those_without() {
        let folder = tempfile::tempdir().unwrap();
        let cache = folder.path().join("cache");
        let frames = LoggedFrames::new(&cache, &[log(folder.path(), true)], 1.0).unwrap();
        assert_eq!(frames.len(), 3, "2.5 s hold three frames a second apart");
        let half = LoggedFrames::new(&cache, &[log(folder.path(), true)], 0.5).unwrap();
        assert_eq!(half.len(), 5, "and five half a second apart");
        let frame = frames.load(1).unwrap();
        assert_eq!(frame.classes, ["vehicle", "pedestrian", "truck"]);
        let [own, other] = &frame.agents[..] else {
            panic!("two agents, not {}", frame.agents.len())
        };
        assert_eq!(
            (&*own.name, own.roadside, &*other.name, other.roadside),
            ("cav1", false, "rsu1", true)
        );
        for (agent, x, yaw, points) in [(own, 20.0, 0.0, 3), (other, 10.0, std::f64::consts::PI, 4)] {
            let [object] = agent.objects[..] else {
                panic!("only the car counts: {:?}", agent.objects)
            };
            assert_eq!((object.track, object.class, object.points), (7, 0, points));
            assert!((object.lwh[0] - x).abs() < 1e-9, "{object:?}");
            assert!((object.lwh[6].abs() - yaw).abs() < 1e-9, "{object:?}");
        }
    }

    #[test]
    fn a_log_that_was_written_anew_gives_frames_anew() {
        let folder = tempfile::tempdir().unwrap();
        let path = log(folder.path(), true);
        let read = || LoggedFrames::new(&folder.path().join("cache"), std::slice::from_ref(&path), 1.0).unwrap();
        let (one, same) = (read(), read());
        assert_eq!((&one.paths, one.identity()), (&same.paths, same.identity()));
        let file = std::fs::File::options().append(true).open(&path).unwrap();
        file.set_modified(std::time::SystemTime::UNIX_EPOCH).unwrap();
        let other = read();
        assert_ne!(one.identity(), other.identity());
        assert!(other.paths.iter().all(|path| !one.paths.contains(path)));
    }

    #[test]
    fn a_log_of_an_unknown_protocol_is_refused_and_stays() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("other.mcap");
        let mut info = LogInfo::new("a test", vec![agent("cav1", AgentKind::Vehicle)]);
        info.protocol = "kitti".into();
        LogWriter::create(&path, &info).unwrap().finish().unwrap();
        let Err(error) = LoggedFrames::new(folder.path(), std::slice::from_ref(&path), 1.0) else {
            panic!("its classes are not known")
        };
        let said = error.to_string();
        assert!(said.contains("other.mcap") && said.contains("`kitti`"), "{said}");
        assert!(!said.contains("remove"), "{said}");
    }

    #[test]
    fn a_log_without_ground_truth_is_refused_by_name() {
        let folder = tempfile::tempdir().unwrap();
        let path = log(folder.path(), false);
        let Err(error) = LoggedFrames::new(folder.path(), &[path], 1.0) else {
            panic!("nothing to learn from")
        };
        let said = error.to_string();
        assert!(matches!(error, TrainError::NoTruth { .. }), "{said}");
        assert!(said.contains("bare.mcap") && said.contains("cav1"), "{said}");
    }
}
