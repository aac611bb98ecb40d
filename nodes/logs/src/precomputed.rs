//! Logs with what agents send computed beforehand: what is said of it, and the copy of a log that gets it.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::fs::{self, File};
use std::path::{Path, PathBuf};

use realo_schemas::Nanos;
use serde::{Deserialize, Serialize};

use crate::error::CREATE;
use crate::info::{END_RECORD, LOG_RECORD};
use crate::level::need_level;
use crate::log::parse_topic;
use crate::log_writer::{open, partial, replaceable};
use crate::packets::{self, SentPacket};
use crate::{ChannelId, ChunkGroup, Log, LogError, McapWriter, Messages, RawMessage, Schema, Stream};

/// What of a log was computed beforehand, and how.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Precomputed {
    /// Name of the graph whose lane did it.
    pub graph: String,
    /// The agents whose messages there are.
    pub agents: Vec<String>,
    /// Where the time comes from that making a message took: `measured`, or the name of a compute profile.
    pub compute: String,
    /// The stages of the lane, from the player to what gives packets to the link, by name.
    pub lane: Vec<LaneStage>,
}

/// One stage of a lane, and all that decides what it makes.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LaneStage {
    /// Its id in the graph.
    pub stage: String,
    /// What it runs: `operator NAME`, or `program NAME` with a hash of the file.
    pub runs: String,
    /// Its arguments, defaults included; a model by its name and a hash of its file and weights.
    pub arguments: BTreeMap<String, String>,
}

impl Precomputed {
    /// Where another lane differs from the one that computed: what that one has, and what the other has; `None` if it would
    /// make the same messages.
    pub fn difference(&self, other: &[LaneStage]) -> Option<String> {
        let find = |lane: &[LaneStage], id: &str| lane.iter().find(|stage| stage.stage == id).cloned();
        let ids: BTreeSet<&str> = self
            .lane
            .iter()
            .chain(other)
            .map(|stage| stage.stage.as_str())
            .collect();
        let pairs: Vec<_> = ids
            .into_iter()
            .map(|id| (id, find(&self.lane, id), find(other, id)))
            .collect();
        // Another argument may be why a stage is there or not.
        let argument = pairs
            .iter()
            .find_map(|(_, one, other)| one.as_ref()?.difference(other.as_ref()?));
        argument.or_else(|| {
            pairs.iter().find_map(|(id, one, other)| match (one, other) {
                (Some(_), None) => Some(format!("with the stage `{id}`, which has no part in it here")),
                (None, Some(_)) => Some(format!("without the stage `{id}`, which has a part in it here")),
                _ => None,
            })
        })
    }
}

impl LaneStage {
    fn difference(&self, other: &LaneStage) -> Option<String> {
        let id = &self.stage;
        if self.runs != other.runs {
            return Some(format!("by `{}` in `{id}`, here it is `{}`", self.runs, other.runs));
        }
        let keys: BTreeSet<&String> = self.arguments.keys().chain(other.arguments.keys()).collect();
        let value = |stage: &LaneStage, key: &String| stage.arguments.get(key).cloned().unwrap_or("nothing".into());
        let differs = keys
            .into_iter()
            .find(|key| self.arguments.get(*key) != other.arguments.get(*key))?;
        let (one, other) = (value(self, differs), value(other, differs));
        Some(format!("with `{id}.{differs}` = {one}, here it is {other}"))
    }
}

impl fmt::Display for Precomputed {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let models = self.lane.iter().filter_map(|stage| stage.arguments.get("model"));
        let models: BTreeSet<&str> = models.map(String::as_str).collect();
        let models: Vec<&str> = models.into_iter().collect();
        write!(f, "{} by {}", self.agents.join(", "), self.graph)?;
        if !models.is_empty() {
            write!(f, " with {}", models.join(", "))?;
        }
        write!(f, ", compute time: {}", self.compute)
    }
}

/// A copy of a log in the making, to which packets are added. One that is not finished leaves nothing behind.
pub struct LogCopy<'a> {
    log: &'a Log,
    /// Until it is finished.
    mcap: Option<McapWriter>,
    /// By agent: where its packets go.
    packets: BTreeMap<String, ChannelId>,
    /// By channel of the log: where its messages go.
    channels: BTreeMap<u16, ChannelId>,
    /// Topics that are not copied, for they hold nothing that realo reads.
    strange: Vec<String>,
    messages: Messages,
    ahead: Option<RawMessage>,
    target: PathBuf,
    partial: PathBuf,
}

impl<'a> LogCopy<'a> {
    /// Begins a copy beside `target`, which appears when it is finished. Packets that the log has of agents that
    /// `precomputed` names are copied, but for those of `anew`, whose new ones [`LogCopy::add`] takes.
    ///
    /// # Errors
    /// A file that cannot be made; the log's own path; body frames that tilt, which packets of level ones do not fit.
    pub fn begin(log: &'a Log, target: &Path, precomputed: &Precomputed, anew: &[String]) -> Result<Self, LogError> {
        let same = |a: &Path, b: &Path| a.canonicalize().is_ok_and(|a| b.canonicalize().is_ok_and(|b| a == b));
        if same(log.path(), target) {
            return Err(LogError::input(
                target,
                "it is the log that is read; choose another file",
            ));
        }
        // What is played beside the packets stays as it is in the log, and packets lie in level frames.
        need_level(log)?;
        let target = replaceable(target)?;
        let partial = partial(&target);
        let file = File::create(&partial).map_err(LogError::io(&target, CREATE))?;
        // Whoever clears up leaves what somebody writes.
        let _ = file.try_lock();
        let mut info = log.info().clone();
        info.precomputed = Some(precomputed.clone());
        let mcap = McapWriter::new(file, &info.program, LOG_RECORD, &info.to_record());
        let mut copy = LogCopy {
            log,
            mcap: Some(mcap.map_err(LogError::io(&partial, "start writing"))?),
            packets: BTreeMap::new(),
            channels: BTreeMap::new(),
            strange: Vec::new(),
            messages: log.file().messages(BTreeSet::new(), 0..0)?,
            ahead: None,
            target,
            partial,
        };
        let stays = |topic: &str| match parse_topic(topic) {
            Some((agent, Stream::Packets)) => precomputed.agents.contains(&agent) && !anew.contains(&agent),
            _ => true,
        };
        for (id, channel) in log.topics_by_id().filter(|(_, channel)| stays(&channel.topic)) {
            match Schema::named(&channel.schema).filter(|_| channel.encoding == "cdr") {
                Some(schema) => {
                    let to = open(&mut copy.mcap).channel(&channel.topic, schema, ChunkGroup::of(&channel.schema));
                    copy.channels.insert(id, to);
                }
                None => copy.strange.push(channel.topic.clone()),
            }
        }
        copy.messages = log
            .file()
            .messages(copy.channels.keys().copied().collect(), 0..u64::MAX)?;
        Ok(copy)
    }

    /// Topics that are not copied, for they hold nothing that realo reads.
    pub fn strange(&self) -> &[String] {
        &self.strange
    }

    /// Adds a packet; they come in order of `ready`, when they exist.
    ///
    /// # Errors
    /// A log that cannot be read; why writing failed.
    pub fn add(&mut self, agent: &str, stamp: Nanos, ready: Nanos, packet: &SentPacket) -> Result<(), LogError> {
        let (log_time, publish_time) = (ready.max(0) as u64, stamp.max(0) as u64);
        self.copy_until(log_time)?;
        let mcap = open(&mut self.mcap);
        let channel = || {
            mcap.channel(
                &Stream::Packets.topic(agent),
                Stream::Packets.schema(),
                Stream::Packets.group(),
            )
        };
        let channel = *self.packets.entry(agent.into()).or_insert_with(channel);
        let encode = |out: &mut Vec<u8>| packets::encode(out, stamp, packet);
        let written = mcap.write(channel, log_time, publish_time, encode);
        written
            .map(|_| ())
            .map_err(|failure| failure.of_unfinished(&self.target))
    }

    /// Copies the log's messages before a log time.
    fn copy_until(&mut self, until: u64) -> Result<(), LogError> {
        loop {
            let next = match self.ahead.take() {
                Some(raw) => Some(raw),
                None => self.messages.next()?,
            };
            let Some(raw) = next else { return Ok(()) };
            if raw.log_time >= until {
                self.ahead = Some(raw);
                return Ok(());
            }
            let to = self.channels[&raw.channel];
            let mcap = open(&mut self.mcap);
            let written = mcap.copy(to, raw.sequence, raw.log_time, raw.publish_time, raw.data());
            written.map_err(|failure| failure.of_unfinished(&self.target))?;
        }
    }

    /// Copies what is left, and gives the copy its name.
    ///
    /// # Errors
    /// As [`LogCopy::add`].
    pub fn finish(mut self) -> Result<(), LogError> {
        self.copy_until(u64::MAX)?;
        let Some(mut mcap) = self.mcap.take() else {
            return Ok(());
        };
        if let Some(mut end) = self.log.file().metadata().get(END_RECORD).cloned() {
            if let Some((first, last)) = mcap.span() {
                end.insert("start".into(), first.to_string());
                end.insert("end".into(), last.to_string());
            }
            mcap.metadata(END_RECORD, &end);
        }
        mcap.finish().map_err(|failure| failure.of_unfinished(&self.target))?;
        fs::rename(&self.partial, &self.target).map_err(LogError::io(&self.target, "rename the finished log to"))
    }
}

impl Drop for LogCopy<'_> {
    fn drop(&mut self) {
        self.mcap = None;
        // Once it has its name, there is none.
        let _ = fs::remove_file(&self.partial);
    }
}
