//! Logs.

use std::path::PathBuf;
use std::sync::Arc;

use arrow_array::types::Float64Type;
use arrow_array::{ArrayRef, FixedSizeListArray, Int64Array, RecordBatch, UInt64Array};
use arrow_pyarrow::PyArrowType;
use arrow_schema::ArrowError;
use pyo3::exceptions::PyKeyError;
use pyo3::prelude::*;
use realo_logs::{Log, LogError, MAX_GAP, Stream, pose_track};
use realo_operator::Source;
use realo_player::{Player, Settings};
use realo_schemas::{Kind, Message, Nanos, Pose, is_same_stamp};
use serde_json::{Map, Value, json};

use crate::messages::{Clouds, Labels, Messages, PlayedTruth, header};
use crate::{Columns, Row, refused, row, unreadable};

/// An open log.
#[pyclass(frozen, module = "realo._realo")]
pub struct LogFile {
    log: Log,
}

#[pymethods]
impl LogFile {
    #[new]
    fn new(py: Python, path: PathBuf) -> PyResult<Self> {
        let log = py
            .detach(|| Log::open(&path))
            .map_err(|error| unreadable("path", &error))?;
        Ok(LogFile { log })
    }

    /// What the log says of itself and what is in it, as JSON.
    fn about(&self) -> PyResult<String> {
        let mut about = serde_json::to_value(self.log.info()).map_err(|error| refused("path", error))?;
        let mut streams = Map::new();
        for agent in &self.log.info().agents {
            let counts = Stream::ALL.map(|stream| (stream.as_str(), self.log.count(&agent.name, stream)));
            let counts = counts.into_iter().filter(|(_, n)| *n > 0);
            let counts: Map<String, Value> = counts.map(|(stream, n)| (stream.to_string(), json!(n))).collect();
            streams.insert(agent.name.clone(), counts.into());
        }
        about["streams"] = streams.into();
        about["span"] = json!(self.log.span());
        about["scored"] = json!(self.log.key_frames());
        about["truncated"] = json!(self.log.truncation().map(ToString::to_string));
        Ok(about.to_string())
    }

    /// Number, stamp and ready time of each of an agent's sweeps.
    fn sweeps(&self, py: Python, agent: &str) -> PyResult<Columns> {
        self.known(agent)?;
        let read = || {
            let (lists, points) = (
                self.log.count(agent, Stream::Sweeps),
                self.log.count(agent, Stream::Points),
            );
            let stream = if lists == points {
                Stream::Sweeps
            } else {
                Stream::Points
            };
            let mut reader = self.log.read_all(&[(agent, stream)])?;
            let (mut seqs, mut stamps, mut readies) = (Vec::new(), Vec::new(), Vec::new());
            while let Some(entry) = reader.next()? {
                seqs.push(entry.seq());
                stamps.push(entry.stamp());
                readies.push(entry.ready());
            }
            Ok((seqs, stamps, readies))
        };
        let (seqs, stamps, readies) = py.detach(read).map_err(|error: LogError| unreadable("log", &error))?;
        table([
            ("seq", Arc::new(UInt64Array::from(seqs)) as ArrayRef),
            ("stamp", Arc::new(Int64Array::from(stamps))),
            ("ready", Arc::new(Int64Array::from(readies))),
        ])
    }

    /// The points of the sweep of a stamp and a ready time.
    fn cloud(&self, py: Python, agent: &str, stamp: Nanos, ready: Nanos) -> PyResult<Row> {
        self.known(agent)?;
        let read = || {
            let mut reader = self
                .log
                .read(&[(agent, Stream::Points)], ready, ready.saturating_add(1))?;
            while let Some(entry) = reader.next()? {
                if is_same_stamp(entry.stamp(), stamp) {
                    return Ok(Some(Message::new(header(&entry, Kind::Points), entry.cloud()?)));
                }
            }
            Ok(None)
        };
        let found = py.detach(read).map_err(|error: LogError| unreadable("log", &error))?;
        let found = found.ok_or_else(|| PyKeyError::new_err(format!("{agent} has no sweep with stamp {stamp} ns")))?;
        Ok(row(&found))
    }

    /// An agent's messages of a stream that exist at log times in `[from, until)`.
    fn messages(&self, agent: &str, stream: &str, from: Nanos, until: Nanos) -> PyResult<Messages> {
        self.known(agent)?;
        let bad = |error: LogError| unreadable("log", &error);
        let (array, companion, views) = match stream {
            "points" => {
                let reader = self.log.read(&[(agent, Stream::Points)], from, until).map_err(bad)?;
                return Ok(Messages::new(Clouds(reader)));
            }
            "detections" => (Stream::Detections, Stream::DetectionsInfo, None),
            "own_labels" => (Stream::OwnLabels, Stream::OwnLabelsInfo, Some(Stream::OwnLabelsViews)),
            "ground_truth" => (
                Stream::GroundTruth,
                Stream::GroundTruthInfo,
                Some(Stream::GroundTruthViews),
            ),
            _ => {
                let expected = "points, detections, own_labels or ground_truth";
                return Err(refused("stream", format!("expected {expected}, found `{stream}`")));
            }
        };
        let more = [Some(companion), views].into_iter().flatten();
        let more = more.filter(|stream| self.log.has(agent, *stream));
        let wanted: Vec<(&str, Stream)> = std::iter::once(array).chain(more).map(|s| (agent, s)).collect();
        let reader = self.log.read(&wanted, from, until).map_err(bad)?;
        Ok(Messages::new(Labels::new(reader, array)))
    }

    /// The truth of an ego's sweeps, as a run with these agents plays it; all agents if none is named.
    fn truth(&self, py: Python, ego: &str, agents: Vec<String>) -> PyResult<Messages> {
        self.known(ego)?;
        agents.iter().try_for_each(|agent| self.known(agent))?;
        let settings = Settings {
            log: self.log.path().into(),
            ego: ego.into(),
            agents,
            points: false,
            ..Settings::default()
        };
        let player = py
            .detach(|| Player::new(settings))
            .map_err(|error| refused("log", error))?;
        Ok(Messages::new(PlayedTruth(player)))
    }

    /// An agent's poses: `pose` is x, y, z (m) and the quaternion x y z w, `covariance` null where it is not known.
    fn poses(&self, py: Python, agent: &str, truth: bool) -> PyResult<Columns> {
        self.known(agent)?;
        let read = || {
            let mut reader = self.log.read_all(&[(agent, pose_stream(truth))])?;
            let (mut seqs, mut stamps, mut readies) = (Vec::new(), Vec::new(), Vec::new());
            let (mut poses, mut covariances) = (Vec::new(), Vec::new());
            while let Some(entry) = reader.next()? {
                let state = entry.pose()?;
                seqs.push(entry.seq());
                stamps.push(entry.stamp());
                readies.push(entry.ready());
                poses.push(Some(seven(&state.map_from_body)));
                covariances.push(state.covariance.map(|c| (*c).map(Some)));
            }
            Ok((seqs, stamps, readies, poses, covariances))
        };
        let read = py.detach(read).map_err(|error: LogError| unreadable("log", &error))?;
        let (seqs, stamps, readies, poses, covariances) = read;
        table([
            ("seq", Arc::new(UInt64Array::from(seqs)) as ArrayRef),
            ("stamp", Arc::new(Int64Array::from(stamps))),
            ("ready", Arc::new(Int64Array::from(readies))),
            ("pose", lists(poses, 7)),
            ("covariance", lists(covariances, 36)),
        ])
    }

    /// An agent's pose at each stamp, as stages get it: recorded, interpolated or carried on over at most 150 ms; null where it is
    /// not known.
    fn poses_at(&self, py: Python, agent: &str, truth: bool, stamps: Vec<Nanos>) -> PyResult<Columns> {
        self.known(agent)?;
        let read = || pose_track(&self.log, agent, pose_stream(truth), MAX_GAP);
        let track = py.detach(read).map_err(|error| unreadable("log", &error))?;
        let poses = stamps.iter().map(|stamp| track.at(*stamp).map(|pose| seven(&pose)));
        let poses: Vec<_> = poses.collect();
        table([
            ("stamp", Arc::new(Int64Array::from(stamps)) as ArrayRef),
            ("pose", lists(poses, 7)),
        ])
    }
}

impl LogFile {
    fn known(&self, agent: &str) -> PyResult<()> {
        match self.log.info().agent(agent) {
            Some(_) => Ok(()),
            None => {
                let names: Vec<&str> = self.log.info().agents.iter().map(|agent| &*agent.name).collect();
                let reason = format!("expected one of {}, found `{agent}`", names.join(", "));
                Err(refused("agent", reason))
            }
        }
    }
}

fn pose_stream(truth: bool) -> Stream {
    if truth { Stream::PoseTruth } else { Stream::Pose }
}

fn seven(pose: &nalgebra::Isometry3<f64>) -> [Option<f64>; 7] {
    let ([x, y, z], [i, j, k, w]) = Pose::exact(*pose).to_parts();
    [x, y, z, i, j, k, w].map(Some)
}

/// Rows of so many numbers, or null.
fn lists<I: IntoIterator<Item = Option<f64>>>(rows: Vec<Option<I>>, width: i32) -> ArrayRef {
    Arc::new(FixedSizeListArray::from_iter_primitive::<Float64Type, _, _>(
        rows, width,
    ))
}

/// A table of columns of one length.
pub fn table<const N: usize>(columns: [(&str, ArrayRef); N]) -> PyResult<Columns> {
    let batch = RecordBatch::try_from_iter(columns);
    batch
        .map(PyArrowType)
        .map_err(|error: ArrowError| refused("log", error))
}
