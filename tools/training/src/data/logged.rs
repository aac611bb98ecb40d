//! Frames from a log with ground truth.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use nalgebra::{Isometry3, Point3};
use realo_logs::{AgentKind, Log, Stream};
use realo_schemas::geometry::{PoseTrack, normalize_yaw};
use realo_schemas::{Box3, Boxes, Nanos, PointCloud, from_seconds};

use super::classes::ClassTable;
use super::frame::{AgentSweep, Frame, Seen};
use super::frames::Frames;
use super::simulated::{deskewed, seen};
use crate::TrainError;

/// Least time between two frames, ns.
const APART: Nanos = 1_000_000_000;

/// How far from a frame's time an agent's sweep may lie, ns.
const NEAR: Nanos = 60_000_000;

/// Longest gap between poses, ns.
const POSE_GAP: Nanos = 500_000_000;

/// A box is this much larger on every side when points in it are counted, m: sensors and labels err.
const SLACK: f64 = 0.05;

/// Frames of logs, kept in a folder.
pub struct LoggedFrames(Vec<PathBuf>);

impl LoggedFrames {
    /// Brings the frames of logs into a folder, as far as they are not there.
    ///
    /// # Errors
    /// [`TrainError::NoTruth`] for a log without ground truth, [`TrainError::Log`] for one that cannot be read.
    pub fn new(folder: &Path, logs: &[PathBuf]) -> Result<Self, TrainError> {
        std::fs::create_dir_all(folder).map_err(|error| TrainError::Write {
            path: folder.into(),
            error,
        })?;
        let mut paths = Vec::new();
        for log in logs {
            paths.extend(Reading::open(log)?.extract(folder)?);
        }
        Ok(LoggedFrames(paths))
    }
}

impl Frames for LoggedFrames {
    fn len(&self) -> usize {
        self.0.len()
    }

    fn load(&self, index: usize) -> Result<Frame, TrainError> {
        Frame::read(&self.0[index])
    }
}

/// A log whose frames are wanted.
struct Reading {
    log: Log,
    table: ClassTable,
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
        let Some(table) = ClassTable::of(&log.info().protocol) else {
            let reason = format!("no classes are known for its protocol `{}`", log.info().protocol);
            return Err(TrainError::Cache {
                path: path.into(),
                reason,
            });
        };
        let names: Vec<String> = log.info().agents.iter().map(|agent| agent.name.clone()).collect();
        let mut reading = Reading {
            log,
            table,
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
        let mut reader = self.log.read_all(&[(agent, stream)])?;
        let mut track = PoseTrack::new(Nanos::MAX, POSE_GAP);
        while let Some(entry) = reader.next()? {
            track.insert(entry.stamp(), entry.pose()?.map_from_body);
        }
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

    /// Writes the frames that are missing; returns the paths of all.
    fn extract(&self, folder: &Path) -> Result<Vec<PathBuf>, TrainError> {
        let Some((first, labels)) = self.truth.first_key_value() else {
            return Ok(Vec::new());
        };
        let (mut paths, mut last) = (Vec::new(), None);
        for stamp in labels.keys().copied() {
            if last.is_some_and(|last| stamp - last < APART) {
                continue;
            }
            last = Some(stamp);
            let path = folder.join(format!("log-{:016x}-{stamp}.frame", self.identity()));
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

    /// Tells logs of the same name and different content apart: a hash of its path, its source and its span.
    fn identity(&self) -> u64 {
        let text = format!("{:?} {:?} {:?}", self.log.path(), self.log.info(), self.log.span());
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
            let columns = [&cloud.x[..], &cloud.y, &cloud.z];
            let (Some(pose), Some(points)) = (track.at(at), deskewed(columns, &cloud.time, track, at, roadside)) else {
                continue;
            };
            let Some(objects) = self.objects(&info.name, at, &pose, &points, (labelled, stamp)) else {
                continue;
            };
            agents.push(AgentSweep::new(&info.name, roadside, pose, points.into_iter(), objects));
        }
        let complete = agents.iter().any(|agent| agent.name == labelled);
        let classes = self.table.names().map(String::from).collect();
        Ok(complete.then_some(Frame { classes, agents }))
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
        if let Some(labels) = self.truth.get(agent).and_then(|truth| truth.get(&stamp)) {
            return Some(match &labels.points {
                Some(counts) => seen(&self.table, &labels.objects.0, counts.iter().copied()),
                None => self.counted(&labels.objects.0, points),
            });
        }
        let map_from_labelled = self.tracks[labelled].at(labelled_at)?;
        let agent_from_labelled = pose.inverse() * map_from_labelled;
        let objects = &self.truth[labelled].get(&labelled_at)?.objects.0;
        let moved: Vec<Box3> = objects
            .iter()
            .map(|object| moved(object, &agent_from_labelled))
            .collect();
        Some(self.counted(&moved, points))
    }

    fn counted(&self, objects: &[Box3], points: &[[f32; 3]]) -> Vec<Seen> {
        let count = |object: &Box3| points.iter().filter(|point| contains(object, **point)).count() as u32;
        seen(&self.table, objects, objects.iter().map(count))
    }
}

/// A box in another gravity-aligned frame.
fn moved(object: &Box3, to_from: &Isometry3<f64>) -> Box3 {
    let center = to_from * Point3::from(object.center);
    let (_, _, turn) = to_from.rotation.euler_angles();
    Box3 {
        center: center.coords.into(),
        yaw: normalize_yaw(object.yaw + turn),
        ..object.clone()
    }
}

fn contains(object: &Box3, point: [f32; 3]) -> bool {
    let [dx, dy, dz] = std::array::from_fn(|i| f64::from(point[i]) - object.center[i]);
    let (sin, cos) = object.yaw.sin_cos();
    let within = |offset: f64, extent: f64| offset.abs() <= extent / 2.0 + SLACK;
    within(dx * cos + dy * sin, object.length) && within(dy * cos - dx * sin, object.width) && within(dz, object.height)
}
