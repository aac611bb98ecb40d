//! What is asked of a log, and what it has beside that.

use std::collections::{BTreeMap, BTreeSet};

use super::{Log, parse_topic};
use crate::info::LOG_RECORD;
use crate::mcap_file::McapFile;
use crate::{LogError, Stream, foreign};

impl Log {
    /// Fails, saying what there is, unless the log has the agent.
    ///
    /// # Errors
    /// [`LogError::MissingAgent`].
    pub fn need_agent(&self, agent: &str) -> Result<(), LogError> {
        match self.info.agent(agent) {
            Some(_) => Ok(()),
            None => Err(LogError::MissingAgent {
                path: self.path().into(),
                agent: agent.into(),
                has: join(self.info.agents.iter().map(|agent| agent.name.as_str())),
            }),
        }
    }

    /// Fails, saying what there is, unless the agent has messages on the stream.
    ///
    /// # Errors
    /// [`LogError::MissingAgent`], [`LogError::MissingTopic`].
    pub fn need(&self, agent: &str, stream: Stream) -> Result<(), LogError> {
        self.need_agent(agent)?;
        match self.has(agent, stream) {
            true => Ok(()),
            false => Err(LogError::MissingTopic {
                path: self.path().into(),
                agent: agent.into(),
                topic: stream.topic(agent),
                has: self.topics_beside(agent),
            }),
        }
    }

    /// Agents that have poses and sweeps while the log's record does not name them, and how many messages of theirs there are.
    pub fn undeclared(&self) -> BTreeMap<String, u64> {
        let mut found: BTreeMap<String, (BTreeSet<Stream>, u64)> = BTreeMap::new();
        for (topic, messages) in self.topics() {
            let Some((agent, stream)) = parse_topic(&topic) else {
                continue;
            };
            if self.info.agent(&agent).is_none() {
                let (streams, count) = found.entry(agent).or_default();
                streams.insert(stream);
                *count += messages.messages;
            }
        }
        let is_agent = |streams: &BTreeSet<Stream>| {
            let has_sweeps = [Stream::Sweeps, Stream::Points]
                .iter()
                .any(|stream| streams.contains(stream));
            has_sweeps && streams.contains(&Stream::Pose)
        };
        let agents = found.into_iter().filter(|(_, (streams, _))| is_agent(streams));
        agents.map(|(agent, (_, count))| (agent, count)).collect()
    }

    /// Topics that nothing reads, and how many messages each has.
    pub fn not_read(&self) -> BTreeMap<String, u64> {
        let is_read = |topic: &str| {
            let agent = parse_topic(topic).map(|(agent, _)| agent);
            crate::frames::TOPICS.contains(&topic) || agent.is_some_and(|agent| self.info.agent(&agent).is_some())
        };
        let left = self.topics().into_iter().filter(|(topic, _)| !is_read(topic));
        left.map(|(topic, channel)| (topic, channel.messages)).collect()
    }

    /// The topics of an agent, and those that are of no agent.
    pub(crate) fn topics_beside(&self, agent: &str) -> String {
        const SHOWN: usize = 12;
        let is_of_others = |topic: &str| {
            let owner = parse_topic(topic).map(|(owner, _)| owner);
            owner.is_some_and(|owner| owner != agent && self.info.agent(&owner).is_some())
        };
        let topics = self.topics();
        let mut shown: Vec<&str> = topics
            .keys()
            .map(String::as_str)
            .filter(|topic| !is_of_others(topic))
            .collect();
        let more = shown.len() > SHOWN;
        shown.truncate(SHOWN);
        join(shown.into_iter().chain(more.then_some("…")))
    }
}

pub(super) fn not_realo(file: &McapFile) -> LogError {
    let found = join(file.metadata().keys().map(String::as_str));
    let hint = match file.metadata().contains_key(crate::RECORDING_RECORD) {
        true => "it is a recording of a run: give it to `realo evaluate LOG --detections`".into(),
        false => format!(
            "it holds {}; {}",
            foreign::of_mcap(file),
            foreign::imported(file.path())
        ),
    };
    LogError::NotRealo {
        path: file.path().into(),
        expected: "log of realo",
        record: LOG_RECORD,
        found,
        hint,
    }
}

pub(crate) fn join<'a>(names: impl Iterator<Item = &'a str>) -> String {
    let names: Vec<&str> = names.collect();
    if names.is_empty() {
        "none".into()
    } else {
        names.join(", ")
    }
}
