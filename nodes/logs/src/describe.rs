use std::collections::BTreeMap;
use std::fmt;
use std::path::{Path, PathBuf};

use realo_schemas::{Nanos, to_seconds};
use serde::Serialize;

use crate::findings::problems;
use crate::level::{LEVEL, tilts};
use crate::log::{join, nanos, times};
use crate::{
    ChannelInfo, Levelled, Log, LogError, LogInfo, McapFile, RECORDING_RECORD, Stream, SweepsInfo, Truncation,
};

/// What `realo info` says of a log.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Description {
    /// The file.
    pub path: PathBuf,
    /// Its length.
    pub bytes: u64,
    /// What it says of itself.
    #[serde(flatten)]
    pub info: LogInfo,
    /// First log time, ns.
    pub first: Option<Nanos>,
    /// Last log time, ns.
    pub last: Option<Nanos>,
    /// Time between them, s.
    pub duration_s: f64,
    /// Its topics.
    pub topics: BTreeMap<String, TopicInfo>,
    /// How each agent's sweeps are read.
    pub sweeps: BTreeMap<String, SweepsInfo>,
    /// How each agent's body frame was levelled, where the log says so.
    pub levelled: BTreeMap<String, Levelled>,
    /// How far the body frames of the others tilt by their poses at most, degrees.
    pub tilted: BTreeMap<String, f64>,
    /// Scored frames per agent, in a finished log.
    pub scored_frames: Option<BTreeMap<String, usize>>,
    /// Classes of the objects in the ground truth of all agents, and how often each is there.
    pub truth_classes: BTreeMap<String, u64>,
    /// Classes of the recorded detections of all agents, and how often each is there.
    pub detection_classes: BTreeMap<String, u64>,
    /// Topics that nothing reads, and how many messages each has.
    pub not_read: BTreeMap<String, u64>,
    /// What a run of it would stumble over, or score wrongly.
    pub problems: Vec<String>,
    /// Where it was cut, if it was.
    pub truncated: Option<Truncation>,
}

/// What `realo info` says of a topic.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct TopicInfo {
    /// Its channel.
    #[serde(flatten)]
    pub channel: ChannelInfo,
    /// Messages a second from its first to its last one; `None` with fewer than two times.
    pub rate_hz: Option<f64>,
}

/// What `realo info` says of a recording of a run.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct RecordingDescription {
    /// The file.
    pub path: PathBuf,
    /// Its length.
    pub bytes: u64,
    /// What recorded it.
    pub program: String,
    /// Agents that it has topics of.
    pub agents: Vec<String>,
    /// First log time, ns.
    pub first: Option<Nanos>,
    /// Last log time, ns.
    pub last: Option<Nanos>,
    /// Time between them, s.
    pub duration_s: f64,
    /// Its topics.
    pub topics: BTreeMap<String, TopicInfo>,
    /// Where it was cut, if it was.
    pub truncated: Option<Truncation>,
}

/// What `realo info` says of a file.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(untagged)]
pub enum Described {
    /// A log.
    Log(Box<Description>),
    /// A recording of a run.
    Recording(Box<RecordingDescription>),
}

impl Described {
    /// What a run of it would stumble over, or score wrongly.
    pub fn problems(&self) -> &[String] {
        match self {
            Described::Log(log) => &log.problems,
            Described::Recording(_) => &[],
        }
    }

    /// Whether there is one, or sweeps that cannot be read.
    pub fn has_problems(&self) -> bool {
        let unreadable = match self {
            Described::Log(log) => log.sweeps.values().any(|sweeps| sweeps.problem.is_some()),
            Described::Recording(_) => false,
        };
        unreadable || !self.problems().is_empty()
    }

    /// Where the file was cut, if it was.
    pub fn truncated(&self) -> Option<&Truncation> {
        match self {
            Described::Log(log) => log.truncated.as_ref(),
            Described::Recording(recording) => recording.truncated.as_ref(),
        }
    }
}

impl fmt::Display for Described {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            Described::Log(log) => log.fmt(f),
            Described::Recording(recording) => recording.fmt(f),
        }
    }
}

/// Describes a log, or a recording of a run.
///
/// # Errors
/// As [`Log::open`].
pub fn describe_any(path: impl AsRef<Path>) -> Result<Described, LogError> {
    let file = McapFile::open(path)?;
    Ok(match file.metadata().contains_key(RECORDING_RECORD) {
        true => Described::Recording(Box::new(describe_recording(&file)?)),
        false => Described::Log(Box::new(describe_log(&Log::of(file)?)?)),
    })
}

/// Describes a log.
///
/// # Errors
/// As [`Log::open`].
pub fn describe(path: impl AsRef<Path>) -> Result<Description, LogError> {
    describe_log(&Log::open(path)?)
}

fn describe_log(log: &Log) -> Result<Description, LogError> {
    let span = log.span();
    let count = |frames: BTreeMap<String, Vec<Nanos>>| frames.into_iter().map(|(k, v)| (k, v.len())).collect();
    let mut sweeps = BTreeMap::new();
    for agent in &log.info().agents {
        if let Some(info) = log.sweeps_info(&agent.name)? {
            sweeps.insert(agent.name.clone(), info);
        }
    }
    let (problems, classes) = problems(log)?;
    // Poses that start again say nothing of how a body tilts.
    let tilted = match problems.is_empty() {
        true => tilts(log)?,
        false => BTreeMap::new(),
    };
    Ok(Description {
        path: log.path().into(),
        bytes: length(log.path())?,
        info: log.info().clone(),
        first: span.map(|(first, _)| first),
        last: span.map(|(_, last)| last),
        duration_s: span.map_or(0.0, |(first, last)| to_seconds(last - first)),
        topics: with_rates(log.topics(), |topic| log.times(topic))?,
        sweeps,
        levelled: log.levelled()?,
        tilted,
        scored_frames: log.key_frames().map(count),
        truth_classes: classes.truth,
        detection_classes: classes.detections,
        not_read: log.not_read(),
        problems,
        truncated: log.truncation().cloned(),
    })
}

fn describe_recording(file: &McapFile) -> Result<RecordingDescription, LogError> {
    let record = file.metadata().get(RECORDING_RECORD);
    let span = file.span().map(|(first, last)| (nanos(first), nanos(last)));
    let channels = file.channels().values().filter(|channel| channel.messages > 0);
    let channels: BTreeMap<_, _> = channels
        .map(|channel| (channel.topic.clone(), channel.clone()))
        .collect();
    let mut agents: Vec<String> = channels.keys().filter_map(|topic| agent_of(topic)).collect();
    agents.dedup();
    Ok(RecordingDescription {
        path: file.path().into(),
        bytes: length(file.path())?,
        program: record
            .and_then(|record| record.get("program"))
            .cloned()
            .unwrap_or_default(),
        agents,
        first: span.map(|(first, _)| first),
        last: span.map(|(_, last)| last),
        duration_s: span.map_or(0.0, |(first, last)| to_seconds(last.saturating_sub(first))),
        topics: with_rates(channels, |topic| times(file, topic))?,
        truncated: file.truncation().cloned(),
    })
}

/// `/<agent>/<stream>`; topics of one part belong to nobody.
fn agent_of(topic: &str) -> Option<String> {
    let (agent, _) = topic.strip_prefix('/')?.split_once('/')?;
    Some(agent.into())
}

fn length(path: &Path) -> Result<u64, LogError> {
    Ok(std::fs::metadata(path).map_err(LogError::io(path, "read"))?.len())
}

fn with_rates(
    channels: BTreeMap<String, ChannelInfo>,
    times: impl Fn(&str) -> Result<Option<(Nanos, Nanos)>, LogError>,
) -> Result<BTreeMap<String, TopicInfo>, LogError> {
    let mut topics = BTreeMap::new();
    for (topic, channel) in channels {
        let rate_hz = times(&topic)?
            .filter(|(first, last)| first < last)
            .map(|(first, last)| channel.messages.saturating_sub(1) as f64 / to_seconds(last - first));
        topics.insert(topic, TopicInfo { channel, rate_hz });
    }
    Ok(topics)
}

fn write_topics(f: &mut fmt::Formatter, topics: &BTreeMap<String, TopicInfo>) -> fmt::Result {
    writeln!(f, "  topics")?;
    for (topic, TopicInfo { channel, rate_hz }) in topics {
        let rate = rate_hz.map(|rate| format!("{rate:6.1} Hz")).unwrap_or_default();
        writeln!(
            f,
            "    {topic:<32} {:>7}  {rate:>9}  {}",
            channel.messages, channel.schema
        )?;
    }
    Ok(())
}

fn write_head(f: &mut fmt::Formatter, path: &Path, bytes: u64, truncated: Option<&Truncation>) -> fmt::Result {
    writeln!(f, "{}  ({:.1} MB)", path.display(), bytes as f64 / 1e6)?;
    match truncated {
        Some(cut) => writeln!(f, "  TRUNCATED: {cut}"),
        None => Ok(()),
    }
}

fn write_time(f: &mut fmt::Formatter, first: Option<Nanos>, duration_s: f64) -> fmt::Result {
    let first = first.map(to_seconds).unwrap_or_default();
    writeln!(f, "  time      {duration_s:.3} s from {first:.3} s")
}

impl Description {
    /// What can be said of a log whose ground truth has no object, and what cannot; `None` of a log that can be scored.
    pub fn lacks_truth(&self) -> Option<String> {
        if !self.truth_classes.is_empty() || self.truncated.is_some() {
            return None;
        }
        let mut agents = self.info.agents.iter();
        let has_topic = agents.any(|agent| self.topics.contains_key(&Stream::GroundTruth.topic(&agent.name)));
        let lacks = match (has_topic, self.problems.is_empty()) {
            (true, true) => "the ground truth of all agents has no object",
            // What cannot be read is a problem that is named.
            (true, false) => return None,
            (false, _) => "no agent has ground truth",
        };
        Some(format!(
            "{lacks}: a run reports rates, ages, bytes and boxes, and scores nothing; docs/guide/your-data.md says how truth is added"
        ))
    }

    /// What becomes of body frames that tilt.
    fn mended(&self) -> &'static str {
        match self.info.precomputed {
            None => "levelled while played; `realo-lab import log` makes a level copy",
            Some(_) => "its packets keep it so; level the log that they were made from by `realo-lab import log`",
        }
    }
}

impl fmt::Display for Description {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        write_head(f, &self.path, self.bytes, self.truncated.as_ref())?;
        for problem in &self.problems {
            writeln!(f, "  PROBLEM: {problem}")?;
        }
        writeln!(f, "  source    {}", self.info.source)?;
        writeln!(f, "  program   {}", self.info.program)?;
        writeln!(f, "  protocol  {}", self.info.protocol)?;
        write_time(f, self.first, self.duration_s)?;
        if let Some(precomputed) = &self.info.precomputed {
            writeln!(f, "  computed  {precomputed}")?;
        }
        write!(f, "  scored    {}", self.info.key_frames)?;
        for (agent, frames) in self.scored_frames.iter().flatten() {
            write!(f, "; {agent} {frames}")?;
        }
        writeln!(f, "\n  agents (poses in frame `{}`)", self.info.map_frame)?;
        for agent in &self.info.agents {
            write!(f, "    {:<12} {:<9} {}", agent.name, agent.kind.as_str(), agent.sensor)?;
            let level = self.levelled.get(&agent.name).map(ToString::to_string);
            let tilt = self.tilted.get(&agent.name).filter(|tilt| **tilt > LEVEL);
            let tilt = tilt.map(|tilt| format!("TILTS by up to {tilt:.2}°: {}", self.mended()));
            match level.or(tilt) {
                Some(text) if !agent.sensor.is_empty() => writeln!(f, "; {text}")?,
                Some(text) => writeln!(f, "{text}")?,
                None => writeln!(f)?,
            }
        }
        if !self.sweeps.is_empty() {
            writeln!(f, "  sweeps")?;
        }
        for (agent, sweeps) in &self.sweeps {
            writeln!(f, "    {agent:<12} {sweeps}")?;
        }
        if let Some(words) = self.lacks_truth() {
            writeln!(f, "  no truth  {words}")?;
        }
        write_topics(f, &self.topics)?;
        match self.not_read.is_empty() {
            true => Ok(()),
            false => writeln!(f, "  not read  {}", join(self.not_read.keys().map(String::as_str))),
        }
    }
}

impl fmt::Display for RecordingDescription {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        write_head(f, &self.path, self.bytes, self.truncated.as_ref())?;
        writeln!(f, "  recording of a run: `realo render` draws it; it is no log to play")?;
        writeln!(f, "  program   {}", self.program)?;
        writeln!(f, "  agents    {}", join(self.agents.iter().map(String::as_str)))?;
        write_time(f, self.first, self.duration_s)?;
        write_topics(f, &self.topics)
    }
}
