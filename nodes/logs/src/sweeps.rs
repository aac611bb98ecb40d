//! Sweeps of logs that others wrote: where their points lie, and on which scale their intensities are.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Mutex, OnceLock};

use nalgebra::{Isometry3, Point3};
use realo_schemas::{Nanos, PointCloud};
use serde::Serialize;

use crate::cloud::CloudReader;
use crate::frames::{Frames, Way, bare};
use crate::log_writer::body;
use crate::{LogError, McapFile};

/// Sweeps that tell whether intensities are in [0, 1].
const LOOKED_AT: usize = 10;

/// What reading one message needs to know of the whole log; it is looked up when a message asks for it.
#[derive(Debug)]
pub(crate) struct Context {
    file: McapFile,
    pub map_frame: String,
    frames: OnceLock<Result<Frames, String>>,
    /// Factor of float intensities by channel.
    scales: Mutex<BTreeMap<u16, f32>>,
}

impl Context {
    pub fn new(file: McapFile, map_frame: &str) -> Self {
        Context {
            file,
            map_frame: map_frame.into(),
            frames: OnceLock::new(),
            scales: Mutex::default(),
        }
    }

    /// The points of a message in its agent's body frame.
    pub fn cloud(&self, channel: u16, agent: &str, stamp: Nanos, payload: &[u8]) -> Result<PointCloud, String> {
        let reader = CloudReader::new(payload)?;
        if reader.stamp != stamp {
            return Err(format!(
                "its header's stamp is {} ns, its publish time {stamp} ns: expected the same; write the stamp as both",
                reader.stamp
            ));
        }
        let scale = self.scale(channel, &reader).map_err(|error| error.to_string())?;
        let cloud = reader.cloud(scale)?;
        Ok(match self.way(agent, reader.frame, stamp)? {
            None => cloud,
            Some(way) => moved(&way.to_from_from, cloud),
        })
    }

    /// How to bring what lies in `frame` into the agent's body frame; `None` if it lies there.
    fn way(&self, agent: &str, frame: &str, stamp: Nanos) -> Result<Option<Way>, String> {
        let to = body(agent);
        if bare(frame) == to {
            return Ok(None);
        }
        let frames = self
            .frames
            .get_or_init(|| Frames::read(&self.file).map_err(|error| error.to_string()));
        let way = frames
            .as_ref()
            .map_err(String::clone)
            .and_then(|frames| frames.way(&to, bare(frame), stamp));
        way.map(Some).map_err(|reason| {
            format!(
                "its frame is `{frame}`, expected `{to}`, and no transform leads there: {reason}; put the transform from \
                 `{to}` to `{frame}` on /tf_static (tf2_msgs/msg/TFMessage), or write the points in `{to}`"
            )
        })
    }

    /// Factor that brings a channel's intensities to 0…255.
    fn scale(&self, channel: u16, reader: &CloudReader) -> Result<f32, LogError> {
        if !reader.intensity().is_some_and(|kind| kind.starts_with("float")) {
            return Ok(1.0);
        }
        let known = |scales: &BTreeMap<u16, f32>| scales.get(&channel).copied();
        if let Some(scale) = known(&self.scales.lock().unwrap_or_else(|poisoned| poisoned.into_inner())) {
            return Ok(scale);
        }
        let mut messages = self.file.messages(BTreeSet::from([channel]), 0..u64::MAX)?;
        let mut brightest = 0f32;
        for _ in 0..LOOKED_AT {
            let Some(message) = messages.next()? else { break };
            let found = CloudReader::new(message.data())
                .ok()
                .and_then(|reader| reader.brightest());
            brightest = brightest.max(found.unwrap_or(0.0));
        }
        let scale = if brightest > 0.0 && brightest <= 1.0 {
            255.0
        } else {
            1.0
        };
        self.scales
            .lock()
            .unwrap_or_else(|poisoned| poisoned.into_inner())
            .insert(channel, scale);
        Ok(scale)
    }

    /// How an agent's sweeps are read, by the first of them.
    pub fn describe(&self, channel: u16, agent: &str) -> Result<Option<SweepsInfo>, LogError> {
        let Some(first) = self.file.messages(BTreeSet::from([channel]), 0..u64::MAX)?.next()? else {
            return Ok(None);
        };
        let stamp = first.publish_time.min(Nanos::MAX as u64) as Nanos;
        let reader = match CloudReader::new(first.data()) {
            Ok(reader) => reader,
            Err(reason) => {
                return Ok(Some(SweepsInfo {
                    problem: Some(reason),
                    ..SweepsInfo::default()
                }));
            }
        };
        let way = self.way(agent, reader.frame, stamp);
        let scale = self.scale(channel, &reader)?;
        Ok(Some(SweepsInfo {
            frame: reader.frame.into(),
            brought_by: way
                .iter()
                .flatten()
                .flat_map(|way| way.by.iter().map(|topic| topic.to_string()))
                .collect(),
            time: reader.time().map(|(field, kind)| format!("{field} ({kind})")),
            intensity: reader.intensity().map(str::to_string),
            intensity_scale: scale,
            problem: self.cloud(channel, agent, stamp, first.data()).err(),
        }))
    }
}

/// How an agent's sweeps are read.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct SweepsInfo {
    /// The frame that the log says its points are in.
    pub frame: String,
    /// Topics whose transforms bring them into the body frame; empty if they lie there.
    pub brought_by: Vec<String>,
    /// The field of the points' times; without one all are taken at the stamp.
    pub time: Option<String>,
    /// Type of the intensities; without any all are 0.
    pub intensity: Option<String>,
    /// What intensities are multiplied by.
    pub intensity_scale: f32,
    /// Why the first sweep cannot be read.
    pub problem: Option<String>,
}

impl std::fmt::Display for SweepsInfo {
    fn fmt(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
        if let Some(problem) = &self.problem {
            return write!(f, "CANNOT BE READ: {problem}");
        }
        write!(f, "frame {}", self.frame)?;
        if !self.brought_by.is_empty() {
            write!(f, ", brought to the body frame by {}", self.brought_by.join(" and "))?;
        }
        match &self.time {
            Some(field) => write!(f, "; times from {field}")?,
            None => write!(f, "; no times: all points are taken at the stamp")?,
        }
        match &self.intensity {
            None => write!(f, "; no intensities: 0"),
            Some(kind) if self.intensity_scale != 1.0 => {
                write!(f, "; intensities {kind} in 0…1, scaled to 0…255")
            }
            Some(kind) => write!(f, "; intensities {kind} as they are"),
        }
    }
}

fn moved(to_from_from: &Isometry3<f64>, mut cloud: PointCloud) -> PointCloud {
    let n = cloud.len();
    let (mut x, mut y, mut z) = (Vec::with_capacity(n), Vec::with_capacity(n), Vec::with_capacity(n));
    for i in 0..n {
        let point = to_from_from * Point3::new(cloud.x[i], cloud.y[i], cloud.z[i]).cast::<f64>();
        x.push(point.x as f32);
        y.push(point.y as f32);
        z.push(point.z as f32);
    }
    (cloud.x, cloud.y, cloud.z) = (x.into(), y.into(), z.into());
    cloud
}
