use std::collections::{BTreeMap, BTreeSet};
use std::fs::{self, File};
use std::path::{Path, PathBuf};

use nalgebra::Isometry3;
use realo_schemas::geometry::View;
use realo_schemas::{AgentState, Box3, Boxes, Name, Nanos, PointCloud, body_frame};

use crate::error::CREATE;
use crate::info::{CLOCKS, END_RECORD, LEVELLED, LOG_RECORD, check_agents};
use crate::mcap_writer::{ChannelId, ChunkGroup, Failure, McapWriter, Output};
use crate::motion::{FixReading, ImuReading, WheelReading, encode_fix, encode_imu, encode_wheels};
use crate::{
    BoxesInfo, Entry, Levelled, LogError, LogInfo, PeerClock, Schema, Stream, boxes, cdr::CdrWriter, cloud, pose, views,
};

/// Writes a log.
///
/// Messages should come roughly in order of `ready`; `stamp` is the measurement's reference time. What was written at
/// least half a second of log time ago is in the file, whatever happens to the program.
pub struct LogWriter {
    path: PathBuf,
    /// Where the file goes when it is finished, if it is not written in place.
    target: Option<PathBuf>,
    map_frame: String,
    mcap: Option<McapWriter>,
    agents: BTreeMap<String, Agent>,
    clocks: Vec<PeerClock>,
    levelled: BTreeMap<String, Levelled>,
    tf: Option<ChannelId>,
    /// Frames of sensors that are on `/tf_static`.
    mounted: BTreeSet<String>,
}

#[derive(Default)]
struct Agent {
    channels: BTreeMap<Stream, ChannelId>,
    sweeps: BTreeMap<Nanos, u64>,
    key_frames: Vec<Nanos>,
}

impl LogWriter {
    /// Writes in place: what is there if the program dies can be read.
    ///
    /// # Errors
    /// A file that cannot be created; agents of one name.
    pub fn create(path: impl AsRef<Path>, info: &LogInfo) -> Result<Self, LogError> {
        let path = path.as_ref();
        check_agents(&info.agents).map_err(|reason| LogError::input(path, reason))?;
        let file = File::create(path).map_err(LogError::io(path, CREATE))?;
        // Whoever clears up leaves what somebody writes.
        let _ = file.try_lock();
        Self::to_output(path, file, info)
    }

    /// Writes beside `path` and renames when finished: `path` is never a part of a log.
    ///
    /// # Errors
    /// As [`LogWriter::create`].
    pub fn create_atomic(path: impl AsRef<Path>, info: &LogInfo) -> Result<Self, LogError> {
        let target = replaceable(path.as_ref())?;
        let mut writer = Self::create(partial(&target), info).map_err(|error| error.named(&target))?;
        writer.target = Some(target);
        Ok(writer)
    }

    /// Writes to anything; `path` is its name in errors.
    ///
    /// # Errors
    /// As [`LogWriter::create`].
    pub fn to_output(path: &Path, output: impl Output, info: &LogInfo) -> Result<Self, LogError> {
        check_agents(&info.agents).map_err(|reason| LogError::input(path, reason))?;
        let mcap = McapWriter::new(output, &info.program, LOG_RECORD, &info.to_record());
        Ok(LogWriter {
            path: path.into(),
            target: None,
            map_frame: info.map_frame.clone(),
            mcap: Some(mcap.map_err(LogError::io(path, "start writing"))?),
            agents: info
                .agents
                .iter()
                .map(|agent| (agent.name.clone(), Agent::default()))
                .collect(),
            clocks: Vec::new(),
            levelled: BTreeMap::new(),
            tf: None,
            mounted: BTreeSet::new(),
        })
    }

    /// A sweep: `/<agent>/points`, frame `<agent>/body`, and its entry in `/<agent>/sweeps`.
    ///
    /// # Errors
    /// An agent that the log does not have; times before 1970; why writing failed.
    pub fn cloud(&mut self, agent: &str, stamp: Nanos, ready: Nanos, cloud: &PointCloud) -> Result<(), LogError> {
        self.sweep(agent, stamp, ready)?;
        let frame = body_frame(agent);
        self.write(agent, Stream::Points, stamp, ready, |out| {
            cloud::encode(out, stamp, &frame, cloud)
        })
    }

    /// A sweep without its points, for logs that are replayed by their recorded detections alone.
    ///
    /// # Errors
    /// As [`LogWriter::cloud`].
    pub fn sweep(&mut self, agent: &str, stamp: Nanos, ready: Nanos) -> Result<(), LogError> {
        let frame = body_frame(agent);
        let encode = |out: &mut Vec<u8>| CdrWriter::new(out).header(stamp, &frame);
        self.write(agent, Stream::Sweeps, stamp, ready, encode)?;
        if let Some(known) = self.agents.get_mut(agent) {
            let seq = known.sweeps.last_key_value().map_or(0, |(_, seq)| seq + 1);
            known.sweeps.insert(stamp, seq);
            // Detections and truth of a sweep come soon after it.
            while known.sweeps.len() > 64 {
                known.sweeps.pop_first();
            }
        }
        Ok(())
    }

    /// What the agent believes of its pose: `/<agent>/pose`, and `/tf` for viewers.
    ///
    /// # Errors
    /// As [`LogWriter::cloud`].
    pub fn pose(&mut self, agent: &str, stamp: Nanos, ready: Nanos, state: &AgentState) -> Result<(), LogError> {
        let map = self.map_frame.clone();
        self.write(agent, Stream::Pose, stamp, ready, |out| {
            pose::encode(out, stamp, &map, state)
        })?;
        let mcap = open(&mut self.mcap);
        let tf = *self
            .tf
            .get_or_insert_with(|| mcap.channel("/tf", Schema::TfMessage, ChunkGroup::Small));
        let frame = body_frame(agent);
        let encode = |out: &mut Vec<u8>| pose::encode_transform(out, stamp, &map, &frame, &state.map_from_body);
        let written = mcap.write(tf, ready as u64, stamp as u64, encode);
        written.map(|_| ()).map_err(|failure| self.failed(failure))
    }

    /// The agent's true pose: `/<agent>/pose_truth`.
    ///
    /// # Errors
    /// As [`LogWriter::cloud`].
    pub fn pose_truth(&mut self, agent: &str, stamp: Nanos, ready: Nanos, state: &AgentState) -> Result<(), LogError> {
        let map = self.map_frame.clone();
        self.write(agent, Stream::PoseTruth, stamp, ready, |out| {
            pose::encode(out, stamp, &map, state)
        })
    }

    /// How the frame of an agent's sensor lies in its vehicle frame, on `/tf_static`; once for each frame. Write it before the
    /// sensor's first message.
    ///
    /// # Errors
    /// As [`LogWriter::cloud`].
    pub fn mount(&mut self, agent: &str, ready: Nanos, frame: &str, at: &Isometry3<f64>) -> Result<(), LogError> {
        if !self.mounted.insert(frame.into()) {
            return Ok(());
        }
        let mcap = open(&mut self.mcap);
        let channel = mcap.channel("/tf_static", Schema::TfMessage, ChunkGroup::Small);
        let body = body_frame(agent);
        let encode = |out: &mut Vec<u8>| pose::encode_transform(out, ready, &body, frame, at);
        let written = mcap.write(channel, ready.max(0) as u64, ready.max(0) as u64, encode);
        written.map(|_| ()).map_err(|failure| self.failed(failure))
    }

    /// A sample of the agent's inertial unit, along the axes of the frame [`IMU_FRAME`] of the agent: `/<agent>/imu`.
    ///
    /// # Errors
    /// As [`LogWriter::cloud`].
    pub fn imu(&mut self, agent: &str, stamp: Nanos, ready: Nanos, reading: &ImuReading) -> Result<(), LogError> {
        let frame = sensor_frame(agent, IMU_FRAME);
        self.write(agent, Stream::Imu, stamp, ready, |out| {
            encode_imu(out, stamp, &frame, reading)
        })
    }

    /// What the agent's satellite receiver says, of the origin of its frame [`ANTENNA_FRAME`]: `/<agent>/fix`.
    ///
    /// # Errors
    /// As [`LogWriter::cloud`].
    pub fn fix(&mut self, agent: &str, stamp: Nanos, ready: Nanos, reading: &FixReading) -> Result<(), LogError> {
        let frame = sensor_frame(agent, ANTENNA_FRAME);
        self.write(agent, Stream::Fix, stamp, ready, |out| {
            encode_fix(out, stamp, &frame, reading)
        })
    }

    /// The speed of the agent's wheels, of the origin of its frame [`AXLE_FRAME`]: `/<agent>/wheels`.
    ///
    /// # Errors
    /// As [`LogWriter::cloud`].
    pub fn wheels(&mut self, agent: &str, stamp: Nanos, ready: Nanos, reading: &WheelReading) -> Result<(), LogError> {
        let frame = sensor_frame(agent, AXLE_FRAME);
        self.write(agent, Stream::Wheels, stamp, ready, |out| {
            encode_wheels(out, stamp, &frame, reading)
        })
    }

    /// A message of a motion sensor of another log at other times, with how the sensor is mounted.
    ///
    /// # Errors
    /// As [`LogWriter::cloud`]; bytes that have no header.
    pub fn copy_motion(&mut self, entry: &Entry, stamp: Nanos, ready: Nanos) -> Result<(), LogError> {
        let frame = entry.frame()?;
        // A frame that nothing places is copied as it is.
        if frame != *body_frame(&entry.agent)
            && let Ok(mount) = entry.mount()
        {
            self.mount(&entry.agent, ready, &frame, &mount)?;
        }
        self.write(&entry.agent, entry.stream, stamp, ready, |out| {
            let begins = out.len();
            out.extend_from_slice(entry.data());
            restamp(&mut out[begins..], stamp);
        })
    }

    /// What is really there at `stamp`, in the agent's true body frame, with the agent's own points on each object where
    /// somebody counted, and whether the frame is scored: `/<agent>/ground_truth`, `…_info` and `…_markers`.
    ///
    /// # Errors
    /// As [`LogWriter::cloud`]; another number of counts than of boxes.
    pub fn truth(
        &mut self,
        agent: &str,
        stamp: Nanos,
        ready: Nanos,
        objects: &[Box3],
        points: Option<&[u32]>,
        key: bool,
    ) -> Result<(), LogError> {
        let info = self.labels_info(agent, stamp, objects, points, key)?;
        let streams = [Stream::GroundTruth, Stream::GroundTruthInfo];
        self.write_boxes(agent, streams, stamp, ready, objects, &info)?;
        let frame = body_frame(agent);
        self.write(agent, Stream::GroundTruthMarkers, stamp, ready, |out| {
            boxes::encode_markers(out, stamp, &frame, "ground_truth", objects);
        })?;
        if key && let Some(known) = self.agents.get_mut(agent) {
            known.key_frames.push(stamp);
        }
        Ok(())
    }

    /// What the agent's own side labelled at `stamp`, by its own sensors, in the agent's true body frame, with the agent's
    /// points on each object where somebody counted: `/<agent>/own_labels` and `…_info`.
    ///
    /// # Errors
    /// As [`LogWriter::truth`].
    pub fn own_labels(
        &mut self,
        agent: &str,
        stamp: Nanos,
        ready: Nanos,
        objects: &[Box3],
        points: Option<&[u32]>,
        key: bool,
    ) -> Result<(), LogError> {
        let info = self.labels_info(agent, stamp, objects, points, key)?;
        let streams = [Stream::OwnLabels, Stream::OwnLabelsInfo];
        self.write_boxes(agent, streams, stamp, ready, objects, &info)
    }

    /// Where the objects of [`LogWriter::truth`] of this stamp could be labelled, in the agent's true body frame:
    /// `/<agent>/ground_truth_views`. Give both the same `ready`.
    ///
    /// # Errors
    /// As [`LogWriter::cloud`]; numbers that are no view.
    pub fn truth_views(&mut self, agent: &str, stamp: Nanos, ready: Nanos, views: &[View]) -> Result<(), LogError> {
        self.write_views(agent, Stream::GroundTruthViews, stamp, ready, views)
    }

    /// The same of [`LogWriter::own_labels`]: `/<agent>/own_labels_views`.
    ///
    /// # Errors
    /// As [`LogWriter::truth_views`].
    pub fn own_views(&mut self, agent: &str, stamp: Nanos, ready: Nanos, views: &[View]) -> Result<(), LogError> {
        self.write_views(agent, Stream::OwnLabelsViews, stamp, ready, views)
    }

    /// Detections that were recorded for a sweep, in the agent's body frame: `/<agent>/detections` and `…_info`.
    ///
    /// # Errors
    /// As [`LogWriter::cloud`].
    pub fn detections(&mut self, agent: &str, stamp: Nanos, ready: Nanos, detections: &Boxes) -> Result<(), LogError> {
        let info = BoxesInfo {
            seq: self.sweep_number(agent, stamp),
            ..BoxesInfo::default()
        };
        let streams = [Stream::Detections, Stream::DetectionsInfo];
        self.write_boxes(agent, streams, stamp, ready, &detections.0, &info)
    }

    /// How far the clocks of other agents lie from the log's, which the closing record reports.
    pub fn clocks(&mut self, clocks: Vec<PeerClock>) {
        self.clocks = clocks;
    }

    /// How the body frames of agents were levelled, which the closing record reports.
    pub fn levelled(&mut self, levelled: BTreeMap<String, Levelled>) {
        self.levelled = levelled;
    }

    /// Writes what is left, the index and the closing record.
    ///
    /// # Errors
    /// Why writing failed; what had been written stays readable, unless the log was to appear only when complete.
    pub fn finish(mut self) -> Result<(), LogError> {
        let Some(mut mcap) = self.mcap.take() else {
            return Ok(());
        };
        mcap.metadata(END_RECORD, &self.end_record(mcap.span()));
        mcap.finish().map_err(|failure| self.failed(failure))?;
        if let Some(target) = self.target.take() {
            fs::rename(&self.path, &target).map_err(LogError::io(&target, "rename the finished log to"))?;
        }
        Ok(())
    }

    /// Why writing stopped, and what is left of it.
    fn failed(&self, failure: Failure) -> LogError {
        match &self.target {
            Some(target) => failure.of_unfinished(target),
            None => failure.of(&self.path),
        }
    }

    fn end_record(&self, span: Option<(u64, u64)>) -> BTreeMap<String, String> {
        let key_frames: BTreeMap<&str, &[Nanos]> = self
            .agents
            .iter()
            .map(|(name, agent)| (name.as_str(), &agent.key_frames[..]))
            .collect();
        let key_frames = serde_json::to_string(&key_frames).expect("times are plain data");
        let mut record = BTreeMap::from([("key_frames".to_string(), key_frames)]);
        if !self.clocks.is_empty() {
            let clocks = serde_json::to_string(&self.clocks).expect("times are plain data");
            record.insert(CLOCKS.into(), clocks);
        }
        if !self.levelled.is_empty() {
            let levelled = serde_json::to_string(&self.levelled).expect("numbers are plain data");
            record.insert(LEVELLED.into(), levelled);
        }
        if let Some((start, end)) = span {
            record.extend([
                ("start".to_string(), start.to_string()),
                ("end".to_string(), end.to_string()),
            ]);
        }
        record
    }

    fn sweep_number(&self, agent: &str, stamp: Nanos) -> u64 {
        self.agents
            .get(agent)
            .and_then(|known| known.sweeps.get(&stamp))
            .copied()
            .unwrap_or(u64::MAX)
    }

    /// The companion of labels.
    fn labels_info(
        &self,
        agent: &str,
        stamp: Nanos,
        objects: &[Box3],
        points: Option<&[u32]>,
        key: bool,
    ) -> Result<BoxesInfo, LogError> {
        if let Some(points) = points
            && points.len() != objects.len()
        {
            let reason = format!("{} point counts for {} boxes of {agent}", points.len(), objects.len());
            return Err(LogError::input(&self.path, reason));
        }
        Ok(BoxesInfo {
            seq: self.sweep_number(agent, stamp),
            key,
            map_from_frame: None,
            agents: points.map(|_| Name::from(agent)).into_iter().collect(),
            points: points.map(<[u32]>::to_vec),
            ..BoxesInfo::default()
        })
    }

    fn write_views(
        &mut self,
        agent: &str,
        stream: Stream,
        stamp: Nanos,
        ready: Nanos,
        views: &[View],
    ) -> Result<(), LogError> {
        let fault = |(index, view): (usize, &View)| Some((index, view.clone().checked().err()?));
        if let Some((index, reason)) = views.iter().enumerate().find_map(fault) {
            let topic = stream.topic(agent);
            return Err(LogError::input(&self.path, format!("{topic}: view {index}: {reason}")));
        }
        let frame = body_frame(agent);
        self.write(agent, stream, stamp, ready, |out| {
            views::encode(out, stamp, &frame, views)
        })
    }

    fn write_boxes(
        &mut self,
        agent: &str,
        [stream, companion]: [Stream; 2],
        stamp: Nanos,
        ready: Nanos,
        objects: &[Box3],
        info: &BoxesInfo,
    ) -> Result<(), LogError> {
        let frame = body_frame(agent);
        self.write(agent, stream, stamp, ready, |out| {
            boxes::encode(out, stamp, &frame, objects)
        })?;
        self.write(agent, companion, stamp, ready, |out| {
            boxes::encode_info(out, stamp, &frame, objects, info)
        })
    }

    fn write(
        &mut self,
        agent: &str,
        stream: Stream,
        stamp: Nanos,
        ready: Nanos,
        encode: impl FnOnce(&mut Vec<u8>),
    ) -> Result<(), LogError> {
        let Some(known) = self.agents.get_mut(agent) else {
            let reason = format!("agent `{agent}` is not one of those that the log was created with");
            return Err(LogError::input(&self.path, reason));
        };
        if stamp < 0 || ready < 0 {
            let reason = format!("stamp {stamp} and ready {ready} of {agent} must not lie before 1970");
            return Err(LogError::input(&self.path, reason));
        }
        let mcap = open(&mut self.mcap);
        let channel = || mcap.channel(&stream.topic(agent), stream.schema(), stream.group());
        let channel = *known.channels.entry(stream).or_insert_with(channel);
        let written = mcap.write(channel, ready as u64, stamp as u64, encode);
        written.map(|_| ()).map_err(|failure| self.failed(failure))
    }
}

/// Frames of an agent's motion sensors: `<agent>/` and this.
pub const IMU_FRAME: &str = "imu";
/// The frame of the antenna.
pub const ANTENNA_FRAME: &str = "antenna";
/// The frame of the axle that the wheels carry.
pub const AXLE_FRAME: &str = "axle";

/// The frame of an agent's sensor.
pub fn sensor_frame(agent: &str, sensor: &str) -> String {
    format!("{agent}/{sensor}")
}

/// Puts a stamp into the header of a message, which begins behind the 4 bytes of CDR.
fn restamp(payload: &mut [u8], stamp: Nanos) {
    if let Some([seconds, nanos]) = payload
        .get_mut(4..12)
        .and_then(|time| time.as_chunks_mut().0.first_chunk_mut())
    {
        *seconds = (stamp.div_euclid(1_000_000_000) as i32).to_le_bytes();
        *nanos = (stamp.rem_euclid(1_000_000_000) as u32).to_le_bytes();
    }
}

impl Drop for LogWriter {
    /// An unfinished log that was to appear only when complete leaves nothing behind.
    fn drop(&mut self) {
        if self.target.is_some() {
            self.mcap = None;
            let _ = fs::remove_file(&self.path);
        }
    }
}

/// The writer is there until `finish` takes it together with the whole log writer.
pub(crate) fn open(mcap: &mut Option<McapWriter>) -> &mut McapWriter {
    mcap.as_mut().expect("finish consumes the log writer")
}

/// The file that a finished log becomes: what `path` leads to, if it is a link. Nothing but a file may be replaced.
pub(crate) fn replaceable(path: &Path) -> Result<PathBuf, LogError> {
    let target = match fs::symlink_metadata(path) {
        Ok(there) if there.is_symlink() => fs::canonicalize(path).map_err(LogError::io(path, "follow the link"))?,
        _ => path.into(),
    };
    let found = match fs::metadata(&target) {
        Ok(there) if there.is_dir() => "a folder",
        Ok(there) if !there.is_file() => "a device or the like",
        _ => return Ok(target),
    };
    let reason = format!("expected a file, or nothing yet, at this place, found {found}; choose another path");
    Err(LogError::input(path, reason))
}

/// Where a file is written that appears when it is finished.
pub(crate) fn partial(target: &Path) -> PathBuf {
    let mut name = target.file_name().unwrap_or_default().to_os_string();
    name.push(format!(".{}.partial", std::process::id()));
    target.with_file_name(name)
}
