//! Frames from a log with ground truth.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use nalgebra::Isometry3;
use realo_logs::{AgentInfo, AgentKind, Log, Stream, need_level, pose_track, same};
use realo_schemas::geometry::{PoseTrack, transform_box};
use realo_schemas::{Box3, Boxes, Nanos, PointCloud, from_seconds};
use realo_scoring::Protocol;
use serde::{Deserialize, Serialize};

use super::frame::{AgentSweep, Frame, Seen, write_whole};
use super::frames::Frames;
use super::left_out::{Account, Cause, LeftOut, gap};
use super::simulated::{class_names, cleaned, returns, seen};
use crate::TrainError;

/// How far from a frame's time an agent's sweep may lie, ns.
pub(super) const NEAR: Nanos = 60_000_000;

/// Rises with every change of how frames are made of logs.
const RECIPE: u32 = 2;

/// A box is this much larger on every side when points in it are counted, m: sensors and labels err.
const SLACK: f64 = 0.05;

/// Which frames of which logs.
#[derive(Clone, Debug, PartialEq)]
pub struct LoggedData {
    /// The logs.
    pub logs: Vec<PathBuf>,
    /// Min time between two frames of a log, s.
    pub apart: f64,
    /// Max gap between poses that is bridged, ms: the argument of the operator `sync`.
    pub max_gap_ms: u32,
}

/// Frames of logs, kept in a folder.
pub struct LoggedFrames {
    paths: Vec<PathBuf>,
    /// Of each log.
    identities: Vec<u64>,
    left_out: Vec<LeftOut>,
}

impl LoggedFrames {
    /// Brings frames of logs into a folder, as far as they are not there.
    ///
    /// # Errors
    /// [`TrainError::NoTruth`] for a log without ground truth, [`TrainError::Log`] for one that cannot be read,
    /// [`TrainError::NoFrames`] where all is left out.
    pub fn new(folder: &Path, data: &LoggedData) -> Result<Self, TrainError> {
        std::fs::create_dir_all(folder).map_err(|error| TrainError::Write {
            path: folder.into(),
            error,
        })?;
        let mut frames = LoggedFrames {
            paths: Vec::new(),
            identities: Vec::new(),
            left_out: Vec::new(),
        };
        for log in &data.logs {
            let reading = Reading::open(log, data.max_gap_ms)?;
            let identity = reading.identity();
            let Extracted { stamps, left_out } = reading.extracted(folder, identity, data.apart)?;
            let path = |stamp: &Nanos| frame_path(folder, identity, *stamp);
            frames.paths.extend(stamps.iter().map(path));
            frames.identities.push(identity);
            frames.left_out.extend(reading.cut());
            frames.left_out.extend(left_out);
        }
        match frames.paths.is_empty() {
            true => Err(TrainError::NoFrames {
                logs: data.logs.clone(),
                left_out: frames.left_out,
            }),
            false => Ok(frames),
        }
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

    fn left_out(&self) -> &[LeftOut] {
        &self.left_out
    }
}

fn frame_path(folder: &Path, identity: u64, stamp: Nanos) -> PathBuf {
    folder.join(format!("log-{identity:016x}-{stamp}.frame"))
}

/// What became of a log: kept beside its frames.
#[derive(Serialize, Deserialize)]
struct Extracted {
    /// Of its frames.
    stamps: Vec<Nanos>,
    left_out: Vec<LeftOut>,
}

impl Extracted {
    /// What was kept, if all of it is there.
    fn kept(file: &Path, folder: &Path, identity: u64) -> Option<Self> {
        // A file that is missing or cut is made again.
        let kept: Extracted = serde_json::from_slice(&std::fs::read(file).ok()?).ok()?;
        let is_there = |stamp: &Nanos| frame_path(folder, identity, *stamp).exists();
        kept.stamps.iter().all(is_there).then_some(kept)
    }
}

/// A log whose frames are wanted.
struct Reading {
    log: Log,
    protocol: Protocol,
    max_gap_ms: u32,
    tracks: BTreeMap<String, PoseTrack>,
    /// Agents with ground truth, each with its objects and their points by stamp.
    truth: BTreeMap<String, BTreeMap<Nanos, Labels>>,
}

/// Labels of one agent at one stamp.
struct Labels {
    objects: Boxes,
    /// The agent's own points on each, where somebody counted.
    points: Option<Vec<u32>>,
}

/// The labels that a frame is made for: whose, and when.
#[derive(Clone, Copy)]
struct Labelled<'a> {
    agent: &'a str,
    stamp: Nanos,
}

impl Reading {
    fn open(path: &Path, max_gap_ms: u32) -> Result<Self, TrainError> {
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
            max_gap_ms,
            tracks: BTreeMap::new(),
            truth: BTreeMap::new(),
        };
        for name in &names {
            let stream = reading.pose_stream(name);
            let track = match reading.log.has(name, stream) {
                true => pose_track(&reading.log, name, stream, gap(max_gap_ms))?,
                false => PoseTrack::new(Nanos::MAX, gap(max_gap_ms)),
            };
            reading.tracks.insert(name.clone(), track);
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

    /// What the log lacks if its file was cut.
    fn cut(&self) -> Option<LeftOut> {
        self.log.truncation().map(|cut| LeftOut {
            log: self.log.path().into(),
            agent: String::new(),
            is_labelled: false,
            cause: Cause::Cut {
                reason: cut.to_string(),
            },
            count: 1,
            of: 1,
        })
    }

    /// The true poses where the log has them.
    fn pose_stream(&self, agent: &str) -> Stream {
        match self.log.has(agent, Stream::PoseTruth) {
            true => Stream::PoseTruth,
            false => Stream::Pose,
        }
    }

    fn read_truth(&mut self, agent: &str) -> Result<(), TrainError> {
        let mut wanted = vec![(agent, Stream::GroundTruth)];
        if self.log.has(agent, Stream::GroundTruthInfo) {
            wanted.push((agent, Stream::GroundTruthInfo));
        }
        let mut reader = self.log.read_all(&wanted)?;
        // A companion may come before what it completes.
        let (mut arrays, mut companions) = (BTreeMap::new(), BTreeMap::new());
        while let Some(entry) = reader.next()? {
            match entry.stream {
                Stream::GroundTruth => _ = arrays.insert(entry.stamp(), entry.boxes()?),
                _ => _ = companions.insert(entry.stamp(), entry),
            }
        }
        let mut labels = BTreeMap::new();
        for (stamp, mut objects) in arrays {
            let points = match companions.get(&stamp) {
                Some(companion) => companion.info(&mut objects)?.points,
                None => None,
            };
            labels.insert(stamp, Labels { objects, points });
        }
        if !labels.is_empty() {
            self.truth.insert(agent.into(), labels);
        }
        Ok(())
    }

    /// What became of the log, with its frames in a folder. `apart`: min time between two, s.
    fn extracted(&self, folder: &Path, identity: u64, apart: f64) -> Result<Extracted, TrainError> {
        let file = folder.join(format!("log-{identity:016x}-{apart}.json"));
        if let Some(kept) = Extracted::kept(&file, folder, identity) {
            return Ok(kept);
        }
        let extracted = self.extract(folder, identity, from_seconds(apart))?;
        let text = serde_json::to_vec(&extracted).expect("an account is plain data");
        write_whole(&file, &text)?;
        Ok(extracted)
    }

    /// Writes the frames that are missing. `apart`: min time between two, ns.
    fn extract(&self, folder: &Path, identity: u64, apart: Nanos) -> Result<Extracted, TrainError> {
        let mut account = Account::default();
        self.count_poses(&mut account)?;
        self.count_classes(&mut account);
        let first = self.truth.first_key_value();
        let (agent, labels) = first.expect("a log without ground truth is not opened");
        let (mut wanted, mut stamps) = (Vec::new(), Vec::new());
        for stamp in labels.keys().copied() {
            if wanted.last().is_none_or(|last| stamp - last >= apart) {
                wanted.push(stamp);
            }
        }
        for stamp in wanted.iter().copied() {
            let labelled = Labelled { agent, stamp };
            let Some(frame) = self.frame(labelled, wanted.len(), &mut account)? else {
                continue;
            };
            let path = frame_path(folder, identity, stamp);
            if !path.exists() {
                frame.write(&path)?;
            }
            stamps.push(stamp);
        }
        Ok(Extracted {
            stamps,
            left_out: account.of(self.log.path(), agent),
        })
    }

    /// Counts messages that do not hold a valid pose.
    fn count_poses(&self, account: &mut Account) -> Result<(), TrainError> {
        for agent in self.tracks.keys() {
            let stream = self.pose_stream(agent);
            if !self.log.has(agent, stream) {
                continue;
            }
            let mut reader = self.log.read_all(&[(agent, stream)])?;
            let (mut all, mut bad, mut first) = (0, 0, None);
            while let Some(entry) = reader.next()? {
                all += 1;
                if let Err(error) = entry.pose() {
                    bad += 1;
                    first.get_or_insert(error);
                }
            }
            if let Some(error) = first {
                let reason = error.to_string();
                account.add(agent, Cause::BadPoses { reason }, bad, all);
            }
        }
        Ok(())
    }

    /// Counts labels that the protocol does not score.
    fn count_classes(&self, account: &mut Account) {
        for (agent, labels) in &self.truth {
            let objects = || labels.values().flat_map(|labels| &labels.objects.0);
            let mut unknown: BTreeMap<&str, usize> = BTreeMap::new();
            for object in objects().filter(|object| self.protocol.class_of(&object.class).is_none()) {
                *unknown.entry(&object.class).or_default() += 1;
            }
            for (class, count) in unknown {
                let cause = Cause::UnknownClass {
                    class: class.into(),
                    protocol: self.protocol.name.clone(),
                };
                account.add(agent, cause, count, objects().count());
            }
        }
    }

    /// Tells logs of the same name and different content apart: a hash of its path, its source, its span, of size and date of
    /// the file, and of the rules by which frames are made.
    fn identity(&self) -> u64 {
        let file = std::fs::metadata(self.log.path()).map(|file| (file.len(), file.modified().ok()));
        let (path, info, span) = (self.log.path(), self.log.info(), self.log.span());
        let rules = (RECIPE, self.max_gap_ms);
        let text = format!("{path:?} {info:?} {span:?} {:?} {rules:?}", file.ok());
        text.bytes().fold(0xcbf2_9ce4_8422_2325, |hash, byte| {
            (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3)
        })
    }

    /// The sweeps nearest to labels; `None` if their agent has none there that can be used. `of`: frames that are wanted.
    fn frame(&self, labelled: Labelled, of: usize, account: &mut Account) -> Result<Option<Frame>, TrainError> {
        let mut agents = Vec::new();
        let mut causes = Vec::new();
        for info in &self.log.info().agents {
            match self.sweep(info, labelled)? {
                Ok((sweep, true)) => agents.push(sweep),
                Ok((sweep, false)) => {
                    agents.push(sweep);
                    causes.push((&*info.name, Cause::NotDeskewed));
                }
                Err(cause) => causes.push((&*info.name, cause)),
            }
        }
        let complete = agents.iter().any(|agent| agent.name == labelled.agent);
        // Where there is no frame it is not the others' fault.
        for (agent, cause) in causes {
            account.add(agent, cause, usize::from(complete || agent == labelled.agent), of);
        }
        let classes = class_names(&self.protocol);
        Ok(complete.then_some(Frame {
            classes,
            agents,
            earlier: None,
        }))
    }

    /// An agent's sweep, and whether its motion was removed; or why there is none.
    fn sweep(&self, info: &AgentInfo, labelled: Labelled) -> Result<Result<(AgentSweep, bool), Cause>, TrainError> {
        let name = &info.name;
        if !self.log.has(name, Stream::Points) {
            return Ok(Err(Cause::NoPoints));
        }
        let Some((at, cloud)) = self.nearest(name, labelled.stamp)? else {
            return Ok(Err(Cause::NoSweep));
        };
        let track = &self.tracks[name];
        let Some(pose) = track.at(at) else {
            let max_gap_ms = self.max_gap_ms;
            return Ok(Err(Cause::NoPose { max_gap_ms }));
        };
        let roadside = info.kind == AgentKind::Roadside;
        let (cloud, is_deskewed) = cleaned(&cloud, track, at, roadside);
        let points: Vec<[f32; 3]> = returns(&cloud).map(|(point, _)| point).collect();
        let Some(objects) = self.objects(name, at, &pose, &points, labelled) else {
            return Ok(Err(Cause::NoLabels));
        };
        let sweep = AgentSweep::new(name, roadside, pose, returns(&cloud), objects);
        Ok(Ok((sweep, is_deskewed)))
    }

    fn nearest(&self, agent: &str, stamp: Nanos) -> Result<Option<(Nanos, PointCloud)>, TrainError> {
        // A sweep is complete some time after its stamp.
        let mut reader = self.log.read(
            &[(agent, Stream::Points)],
            stamp - NEAR,
            stamp + NEAR + from_seconds(1.0),
        )?;
        let mut best = None;
        while let Some(entry) = reader.next()? {
            let off = (entry.stamp() - stamp).abs();
            if off <= NEAR && best.as_ref().is_none_or(|(min, _)| off < *min) {
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
        labelled: Labelled,
    ) -> Option<Vec<Seen>> {
        let own = self.truth.get(agent);
        if let Some(labels) = own.and_then(|truth| truth.get(&same(truth, stamp)?)) {
            return Some(match &labels.points {
                Some(counts) => seen(&self.protocol, &labels.objects.0, counts.iter().copied()),
                None => self.counted(&labels.objects.0, points),
            });
        }
        let map_from_labelled = self.tracks[labelled.agent].at(labelled.stamp)?;
        let agent_from_labelled = pose.inverse() * map_from_labelled;
        let objects = &self.truth[labelled.agent].get(&labelled.stamp)?.objects.0;
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
    use realo_schemas::{AgentState, PoseStatus};

    use super::*;

    const MAX_GAP_MS: u32 = 150;
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

    fn state(x: f64, y: f64, yaw: f64) -> AgentState {
        AgentState {
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

    fn of(logs: &[PathBuf], apart: f64) -> LoggedData {
        LoggedData {
            logs: logs.into(),
            apart,
            max_gap_ms: MAX_GAP_MS,
        }
    }

    #[test]
    fn labels_of_one_agent_serve_those_without() {
        let folder = tempfile::tempdir().unwrap();
        let cache = folder.path().join("cache");
        let frames = LoggedFrames::new(&cache, &of(&[log(folder.path(), true)], 1.0)).unwrap();
        assert_eq!(frames.len(), 3, "2.5 s hold three frames a second apart");
        let half = LoggedFrames::new(&cache, &of(&[log(folder.path(), true)], 0.5)).unwrap();
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
        let read = || LoggedFrames::new(&folder.path().join("cache"), &of(std::slice::from_ref(&path), 1.0)).unwrap();
        let (one, same) = (read(), read());
        assert_eq!((&one.paths, one.identity()), (&same.paths, same.identity()));
        let file = std::fs::File::options().append(true).open(&path).unwrap();
        file.set_modified(std::time::SystemTime::UNIX_EPOCH).unwrap();
        let other = read();
        assert_ne!(one.identity(), other.identity());
        assert!(other.paths.iter().all(|path| !one.paths.contains(path)));
    }

    #[test]
    fn a_log_that_was_cut_says_so_each_time() {
        let folder = tempfile::tempdir().unwrap();
        let path = log(folder.path(), true);
        let whole = std::fs::read(&path).unwrap();
        std::fs::write(&path, &whole[..whole.len() / 2]).unwrap();
        for _ in 0..2 {
            let frames =
                LoggedFrames::new(&folder.path().join("cache"), &of(std::slice::from_ref(&path), 1.0)).unwrap();
            let said: Vec<String> = frames.left_out().iter().map(LeftOut::to_string).collect();
            assert!(
                said.iter()
                    .any(|line| line.contains("a.mcap: ") && line.contains("cut")),
                "{said:?}"
            );
        }
    }

    #[test]
    fn a_log_of_an_unknown_protocol_is_refused_and_stays() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("other.mcap");
        let mut info = LogInfo::new("a test", vec![agent("cav1", AgentKind::Vehicle)]);
        info.protocol = "kitti".into();
        LogWriter::create(&path, &info).unwrap().finish().unwrap();
        let Err(error) = LoggedFrames::new(folder.path(), &of(std::slice::from_ref(&path), 1.0)) else {
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
        let Err(error) = LoggedFrames::new(folder.path(), &of(&[path], 1.0)) else {
            panic!("nothing to learn from")
        };
        let said = error.to_string();
        assert!(matches!(error, TrainError::NoTruth { .. }), "{said}");
        assert!(said.contains("bare.mcap") && said.contains("cav1"), "{said}");
    }

    /// A vehicle with a sweep and labels at each tenth of 2 s, poses each so many tenths, and a roadside unit with one pose.
    /// Labels are `off` ns off the sweeps.
    fn sparse(folder: &Path, every: i64, off: Nanos) -> PathBuf {
        let path = folder.join("sparse.mcap");
        let agents = vec![agent("cav1", AgentKind::Vehicle), agent("rsu1", AgentKind::Roadside)];
        let mut writer = LogWriter::create(&path, &LogInfo::new("a test", agents)).unwrap();
        for step in 0..20 {
            let now = SECOND + step * TENTH;
            if step % every == 0 {
                writer.pose("cav1", now, now, &state(0.0, 0.0, 0.0)).unwrap();
            }
            if step == 3 {
                writer.pose("rsu1", now, now, &state(30.0, 0.0, 3.0)).unwrap();
            }
            for agent in ["cav1", "rsu1"] {
                writer.cloud(agent, now, now, &cloud(&[[19.0, 0.5, 1.0]; 3])).unwrap();
            }
            writer
                .truth("cav1", now + off, now, &[car(20.0, "Car")], None, true)
                .unwrap();
        }
        writer.finish().unwrap();
        path
    }

    fn causes(frames: &LoggedFrames) -> Vec<(&str, &Cause, usize, usize)> {
        let left_out = frames.left_out().iter();
        left_out
            .map(|out| (&*out.agent, &out.cause, out.count, out.of))
            .collect()
    }

    #[test]
    fn poses_and_stamps_are_joined_as_the_player_joins_them() {
        let folder = tempfile::tempdir().unwrap();
        let read = |every, off, max_gap_ms| {
            let data = LoggedData {
                max_gap_ms,
                ..of(&[sparse(folder.path(), every, off)], 0.1)
            };
            LoggedFrames::new(&folder.path().join("cache"), &data)
        };
        // The roadside unit's single pose holds at all times; labels are of a sweep 0.9 µs before.
        let frames = read(1, 900, 150).unwrap();
        assert_eq!((frames.len(), causes(&frames)), (20, vec![]));
        assert_eq!(frames.load(0).unwrap().agents.len(), 2);
        let gaps = Cause::NoPose { max_gap_ms: 150 };
        let frames = read(4, 0, 150).unwrap();
        assert_eq!((frames.len(), causes(&frames)), (5, vec![("cav1", &gaps, 15, 20)]));
        let said = frames.left_out()[0].to_string();
        assert!(
            said.contains("sparse.mcap: 15 of 20 frames are left out: `cav1`") && said.contains("--max-gap-ms"),
            "{said}"
        );
        // What was kept says the same.
        let kept = read(4, 0, 150).unwrap();
        assert_eq!(kept.left_out(), frames.left_out());
        let frames = read(4, 0, 400).unwrap();
        assert_eq!((frames.len(), causes(&frames)), (20, vec![]));
    }

    #[test]
    fn classes_that_no_protocol_scores_are_counted() {
        let folder = tempfile::tempdir().unwrap();
        let frames = LoggedFrames::new(folder.path(), &of(&[log(folder.path(), true)], 1.0)).unwrap();
        let class = Cause::UnknownClass {
            class: "FireHydrant".into(),
            protocol: "default".into(),
        };
        assert_eq!(causes(&frames), [("cav1", &class, 25, 50)]);
    }

    #[test]
    fn a_log_of_which_all_is_left_out_is_refused_with_the_causes() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("unposed.mcap");
        let mut writer =
            LogWriter::create(&path, &LogInfo::new("a test", vec![agent("cav1", AgentKind::Vehicle)])).unwrap();
        for step in 0..5 {
            let now = SECOND + step * TENTH;
            writer.cloud("cav1", now, now, &cloud(&[[19.0, 0.5, 1.0]; 3])).unwrap();
            writer.truth("cav1", now, now, &[car(20.0, "Car")], None, true).unwrap();
        }
        writer.finish().unwrap();
        let Err(error) = LoggedFrames::new(folder.path(), &of(&[path], 0.1)) else {
            panic!("there is no pose")
        };
        let said = error.to_string();
        assert!(
            said.contains("unposed.mcap: 5 of 5 frames are left out: `cav1`") && said.contains("record them at 10 Hz"),
            "{said}"
        );
    }
}
