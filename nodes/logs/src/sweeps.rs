//! Sweeps of logs that others wrote: where their points lie, and on which scale their intensities are.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Mutex, MutexGuard, OnceLock};

use realo_schemas::{Nanos, PointCloud, body_frame};
use serde::Serialize;

use crate::cloud::{CloudReader, Reading};
use crate::frames::{Frames, NoWay, Way, bare};
use crate::geodesy::MapOrigin;
use crate::stamps::stamp_of;
use crate::times::TimeRule;
use crate::tracks::Tracks;
use crate::{LogError, McapFile, Stream};

/// Sweeps of a topic that tell the range of its intensities and the unit of its times.
const LOOKED_AT: usize = 10;
/// Largest intensities of sensors whose range is more than a byte.
const RANGES: [f32; 3] = [1_023.0, 4_095.0, 65_535.0];

/// How the sweeps of a channel are read.
#[derive(Clone, Debug)]
struct Rules {
    /// What intensities are multiplied by.
    scale: f32,
    /// How times are read, or why they cannot be.
    times: Result<Option<TimeRule>, String>,
}

/// What reading one message needs to know of the whole log; it is looked up when a message asks for it.
#[derive(Debug)]
pub(crate) struct Context {
    file: McapFile,
    pub map_frame: String,
    /// Where the map is on the Earth, where the log says so.
    pub origin: Option<MapOrigin>,
    frames: OnceLock<Result<Frames, String>>,
    /// How sweeps are read, by channel.
    rules: Mutex<BTreeMap<u16, Rules>>,
    tracks: Mutex<Tracks>,
    /// Intensities that were limited to 0…255, by agent.
    limited: Mutex<BTreeMap<String, u64>>,
}

impl Context {
    pub fn new(file: McapFile, map_frame: &str, origin: Option<MapOrigin>) -> Self {
        Context {
            file,
            map_frame: map_frame.into(),
            origin,
            frames: OnceLock::new(),
            rules: Mutex::default(),
            tracks: Mutex::default(),
            limited: Mutex::default(),
        }
    }

    /// The track that a text names, the same in all messages of the log.
    pub fn track(&self, id: &str) -> Result<Option<u64>, String> {
        open(&self.tracks).track(id)
    }

    /// Intensities that were limited to 0…255 in the sweeps read so far, by agent.
    pub fn limited(&self) -> BTreeMap<String, u64> {
        open(&self.limited).clone()
    }

    /// The points of a message in its agent's body frame.
    pub fn cloud(&self, channel: u16, agent: &str, stamp: Nanos, payload: &[u8]) -> Result<PointCloud, NoCloud> {
        let mut reader = CloudReader::new(payload)?;
        reader.stamp = stamp;
        let rules = self.rules(channel, &reader).map_err(|error| error.to_string())?;
        let reading = Reading {
            scale: rules.scale,
            times: rules.times?,
            to: self.way(agent, reader.frame, stamp)?.map(|way| way.to_from_from),
        };
        let (cloud, limited) = reader.cloud(&reading)?;
        if limited > 0 {
            *open(&self.limited).entry(agent.into()).or_default() += limited;
        }
        Ok(cloud)
    }

    /// Looks at a sweep without its points; one that no transform brings to the body at its time may be placed at others.
    pub fn look(&self, agent: &str, stamp: Nanos, payload: &[u8]) -> Result<(), String> {
        let reader = CloudReader::new(payload)?;
        match self.way(agent, reader.frame, stamp) {
            Ok(_) | Err(NoCloud::Unplaced(_)) => Ok(()),
            Err(NoCloud::Unreadable(reason)) => Err(reason),
        }
    }

    /// How to bring what lies in `frame` into the agent's body frame; `None` if it lies there.
    pub fn way(&self, agent: &str, frame: &str, stamp: Nanos) -> Result<Option<Way>, NoCloud> {
        let to = body_frame(agent);
        if *bare(frame) == *to {
            return Ok(None);
        }
        let frames = self
            .frames
            .get_or_init(|| Frames::read(&self.file).map_err(|error| error.to_string()));
        let way = frames
            .as_ref()
            .map_err(|reason| NoWay::Never(reason.clone()))
            .and_then(|frames| frames.way(&to, bare(frame), stamp));
        way.map(Some).map_err(|no_way| match no_way {
            NoWay::Gap(reason) => NoCloud::Unplaced(reason),
            NoWay::Never(reason) => NoCloud::Unreadable(format!(
                "its frame is `{frame}`, expected `{to}`, and no transform leads there: {reason}; put the transform from \
                 `{to}` to `{frame}` on /tf_static (tf2_msgs/msg/TFMessage), or write it in `{to}`"
            )),
        })
    }

    /// How the sweeps of a channel are read, by its first ten.
    fn rules(&self, channel: u16, reader: &CloudReader) -> Result<Rules, LogError> {
        if let Some(rules) = open(&self.rules).get(&channel) {
            return Ok(rules.clone());
        }
        let (mut brightest, mut looks) = (0f32, Vec::new());
        let tells = reader.time().is_some() || reader.intensity().is_some_and(|kind| kind != "uint8");
        if tells && !reader.is_ours() {
            let mut messages = self.file.messages(BTreeSet::from([channel]), 0..u64::MAX)?;
            for _ in 0..LOOKED_AT {
                let Some(message) = messages.next()? else { break };
                if let Ok(mut reader) = CloudReader::new(message.data()) {
                    reader.stamp = stamp_of(Stream::Points, &message);
                    brightest = brightest.max(reader.brightest().unwrap_or(0.0));
                    looks.extend(reader.look());
                }
            }
        }
        let rules = Rules {
            scale: intensity_scale(reader.intensity().unwrap_or_default(), brightest),
            times: reader.time_rule(&looks),
        };
        open(&self.rules).insert(channel, rules.clone());
        Ok(rules)
    }

    /// How an agent's sweeps are read, by the first of them.
    pub fn describe(&self, channel: u16, agent: &str) -> Result<Option<SweepsInfo>, LogError> {
        let Some(first) = self.file.messages(BTreeSet::from([channel]), 0..u64::MAX)?.next()? else {
            return Ok(None);
        };
        let stamp = stamp_of(Stream::Points, &first);
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
        let rules = self.rules(channel, &reader)?;
        Ok(Some(SweepsInfo {
            frame: reader.frame.into(),
            brought_by: way
                .iter()
                .flatten()
                .flat_map(|way| way.by.iter().map(|topic| topic.to_string()))
                .collect(),
            time: reader.time().map(|(field, kind)| match &rules.times {
                Ok(Some(rule)) => format!("{field} ({kind}, {rule})"),
                _ => format!("{field} ({kind})"),
            }),
            intensity: reader.intensity().map(str::to_string),
            intensity_scale: rules.scale,
            problem: match self.cloud(channel, agent, stamp, first.data()) {
                // The others may be placed: how many are not is said with the poses.
                Ok(_) | Err(NoCloud::Unplaced(_)) => None,
                Err(NoCloud::Unreadable(reason)) => Some(reason),
            },
        }))
    }
}

/// Why the points of a message cannot be had.
#[derive(Clone, Debug)]
pub(crate) enum NoCloud {
    /// No transform brings them to the body frame at their time, in words.
    Unplaced(String),
    /// Its bytes or its frame are wrong, in words.
    Unreadable(String),
}

impl From<String> for NoCloud {
    fn from(reason: String) -> Self {
        NoCloud::Unreadable(reason)
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
                let range = 255.0 / self.intensity_scale;
                write!(f, "; intensities {kind} in 0…{range:.0}, scaled to 0…255")
            }
            Some(kind) => write!(f, "; intensities {kind} as they are"),
        }
    }
}

/// What intensities are multiplied by: floats of which the brightest is at most 1 fill the byte; what exceeds a byte is
/// divided by the smallest range of sensors that holds the brightest. `kind` is a type's name as `uint8` or `float32`.
pub fn intensity_scale(kind: &str, brightest: f32) -> f32 {
    let float = kind.starts_with("float");
    match brightest {
        _ if kind == "uint8" => 1.0,
        unit if float && unit > 0.0 && unit <= 1.0 => 255.0,
        byte if byte <= 255.0 => 1.0,
        bright => 255.0 / RANGES.into_iter().find(|range| bright <= *range).unwrap_or(bright),
    }
}

/// What a thread that panicked left behind is whole: every insertion is one step.
fn open<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(|poisoned| poisoned.into_inner())
}

#[cfg(test)]
mod tests {
    use super::intensity_scale;

    #[test]
    fn intensities_fill_a_byte_by_the_range_of_the_brightest() {
        for (kind, brightest, expected) in [
            ("uint8", 1.0, 1.0),
            ("float32", 0.0, 1.0),
            ("float32", 0.7, 255.0),
            ("uint16", 1.0, 1.0),
            ("float32", 254.5, 1.0),
            ("float32", 300.0, 255.0 / 1_023.0),
            ("uint16", 3_000.0, 255.0 / 4_095.0),
            ("uint16", 65_535.0, 255.0 / 65_535.0),
            ("float64", 1e6, 255.0 / 1e6),
        ] {
            assert_eq!(intensity_scale(kind, brightest), expected, "{kind} {brightest}");
        }
    }
}
