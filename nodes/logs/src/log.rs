use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::path::Path;
use std::sync::Arc;

use realo_schemas::geometry::View;
use realo_schemas::{AgentState, Boxes, Name, Nanos, PointCloud, PoseStatus, SAME_STAMP, to_seconds};

use crate::cdr::CdrReader;
use crate::frames::bare;
use crate::info::{CLOCKS, END_RECORD, LEVELLED, LOG_RECORD};
use crate::log_writer::body;
use crate::mcap_file::{ChannelInfo, McapFile, Messages, RawMessage, Truncation};
use crate::packets::{self, SentPacket};
use crate::repeats::Repeats;
use crate::stamps::{Stamps, stamp_of};
use crate::sweeps::{Context, NoCloud, SweepsInfo};
use crate::{BoxesInfo, Levelled, LogError, LogInfo, PeerClock, Stream, boxes, foreign, pose, views};

/// An open log.
#[derive(Clone, Debug)]
pub struct Log {
    file: McapFile,
    info: LogInfo,
    truncation: Option<Truncation>,
    streams: BTreeMap<(String, Stream), Vec<u16>>,
    context: Arc<Context>,
}

impl Log {
    /// Opens a log. One that was cut opens with what is left; [`Log::truncation`] says what is missing.
    ///
    /// # Errors
    /// A file that cannot be read, is no MCAP, or is not one of our logs.
    pub fn open(path: impl AsRef<Path>) -> Result<Self, LogError> {
        Self::of(McapFile::open(path)?)
    }

    /// The log that an open file is.
    pub(crate) fn of(file: McapFile) -> Result<Self, LogError> {
        let path = file.path();
        let Some(record) = file.metadata().get(LOG_RECORD) else {
            return Err(not_realo(&file));
        };
        let info = LogInfo::from_record(path, record)?;
        let truncation = truncation(&file, &info);
        let mut streams = BTreeMap::new();
        for (id, channel) in file.channels().iter().filter(|(_, channel)| channel.messages > 0) {
            let Some((agent, stream)) = parse_topic(&channel.topic) else {
                continue;
            };
            if channel.schema != stream.schema().name() || channel.encoding != "cdr" {
                let found = match channel.schema.is_empty() {
                    true => "no schema".into(),
                    false => format!("{} as {}", channel.schema, channel.encoding),
                };
                let reason = format!(
                    "topic `{}` has another type: expected {} as cdr, found {found}: convert its messages, or give it another name",
                    channel.topic,
                    stream.schema().name()
                );
                return Err(LogError::Unfit {
                    path: path.into(),
                    reason,
                });
            }
            streams.entry((agent, stream)).or_insert_with(Vec::new).push(*id);
        }
        for channels in streams.values().filter(|channels| channels.len() > 1) {
            follow_each_other(&file, channels)?;
        }
        Ok(Log {
            context: Arc::new(Context::new(file.clone(), &info.map_frame)),
            file,
            info,
            truncation,
            streams,
        })
    }

    pub(crate) fn file(&self) -> &McapFile {
        &self.file
    }

    /// The channels of the file that have messages.
    pub(crate) fn topics_by_id(&self) -> impl Iterator<Item = (u16, &ChannelInfo)> {
        let channels = self.file.channels().iter().map(|(id, channel)| (*id, channel));
        channels.filter(|(_, channel)| channel.messages > 0)
    }

    /// The file's path.
    pub fn path(&self) -> &Path {
        self.file.path()
    }

    /// What the log says of itself.
    pub fn info(&self) -> &LogInfo {
        &self.info
    }

    /// Where the log was cut, if it was.
    pub fn truncation(&self) -> Option<&Truncation> {
        self.truncation.as_ref()
    }

    /// First and last log time, ns, up to which no message is missing; `None` without messages.
    pub fn span(&self) -> Option<(Nanos, Nanos)> {
        let (first, last) = self.file.span()?;
        let last = nanos(last).min(self.complete_until().saturating_sub(1));
        let first = nanos(first);
        (first <= last).then_some((first, last))
    }

    /// Log time before which no message is missing.
    fn complete_until(&self) -> Nanos {
        let until = self.truncation.as_ref().and_then(|cut| cut.complete_until);
        until.unwrap_or(Nanos::MAX)
    }

    /// Stamps of the scored frames of each agent; `None` for a log that was not finished.
    pub fn key_frames(&self) -> Option<BTreeMap<String, Vec<Nanos>>> {
        serde_json::from_str(self.file.metadata().get(END_RECORD)?.get("key_frames")?).ok()
    }

    /// How far the clocks of other agents lie from the log's; none where the log does not tell.
    ///
    /// # Errors
    /// Clocks that cannot be.
    pub fn clocks(&self) -> Result<Vec<PeerClock>, LogError> {
        let Some(text) = self.at_the_end(CLOCKS) else {
            return Ok(Vec::new());
        };
        let read = || -> Result<Vec<PeerClock>, String> {
            let clocks: Vec<PeerClock> = serde_json::from_str(text).map_err(|error| error.to_string())?;
            clocks.iter().find_map(PeerClock::fault).map_or(Ok(()), Err)?;
            Ok(clocks)
        };
        read().map_err(|reason| LogError::Metadata {
            path: self.path().into(),
            field: CLOCKS,
            reason,
        })
    }

    /// How the body frames of agents were levelled, by agent; none where the log does not tell.
    ///
    /// # Errors
    /// Another form than it has.
    pub fn levelled(&self) -> Result<BTreeMap<String, Levelled>, LogError> {
        let Some(text) = self.at_the_end(LEVELLED) else {
            return Ok(BTreeMap::new());
        };
        let wrong = |reason: String| LogError::Metadata {
            path: self.path().into(),
            field: LEVELLED,
            reason,
        };
        let all: BTreeMap<String, Levelled> = serde_json::from_str(text).map_err(|error| wrong(error.to_string()))?;
        let known = [Levelled::BY_POSE, Levelled::BY_GROUND, Levelled::BY_NOTHING];
        match all.iter().find(|(_, levelled)| !known.contains(&&*levelled.by)) {
            None => Ok(all),
            Some((agent, levelled)) => {
                let known = known.join(", ");
                Err(wrong(format!(
                    "{agent}: `by`: expected one of {known}, found `{}`",
                    levelled.by
                )))
            }
        }
    }

    /// A value of the closing record.
    fn at_the_end(&self, key: &str) -> Option<&String> {
        self.file.metadata().get(END_RECORD)?.get(key)
    }

    /// Every topic of the file.
    pub fn topics(&self) -> BTreeMap<String, ChannelInfo> {
        let mut topics: BTreeMap<String, ChannelInfo> = BTreeMap::new();
        for channel in self.file.channels().values().filter(|channel| channel.messages > 0) {
            let known = topics.entry(channel.topic.clone());
            known
                .and_modify(|known| known.messages += channel.messages)
                .or_insert_with(|| channel.clone());
        }
        topics
    }

    /// First and last log time of a topic's messages, ns; `None` without any.
    ///
    /// # Errors
    /// Bytes that contradict the format.
    pub fn times(&self, topic: &str) -> Result<Option<(Nanos, Nanos)>, LogError> {
        times(&self.file, topic)
    }

    /// How an agent's sweeps are read; `None` if it has none.
    ///
    /// # Errors
    /// Bytes that contradict the format.
    pub fn sweeps_info(&self, agent: &str) -> Result<Option<SweepsInfo>, LogError> {
        match self.streams.get(&(agent.to_string(), Stream::Points)) {
            Some(channels) => self.context.describe(channels[0], agent),
            None => Ok(None),
        }
    }

    /// The frame of an agent's points, by its first sweep; `None` without any that can be read.
    ///
    /// # Errors
    /// Bytes that contradict the format.
    pub(crate) fn frame_of_points(&self, agent: &str) -> Result<Option<String>, LogError> {
        if !self.has(agent, Stream::Points) {
            return Ok(None);
        }
        let first = self.read_all(&[(agent, Stream::Points)])?.next()?;
        let frame = |entry: &Entry| {
            CdrReader::new(entry.data())?
                .header()
                .map(|(_, frame)| frame.to_string())
        };
        Ok(first.as_ref().and_then(|entry| frame(entry).ok()))
    }

    /// How many of an agent's sweeps, by their stamps, no transform brings to its body frame, and why the first is not.
    ///
    /// # Errors
    /// Bytes that contradict the format.
    pub(crate) fn unplaced(&self, agent: &str, stamps: &[Nanos]) -> Result<Option<(usize, Nanos, String)>, LogError> {
        let Some(info) = self.sweeps_info(agent)? else {
            return Ok(None);
        };
        let unplaced = |stamp: &Nanos| match self.context.way(agent, &info.frame, *stamp) {
            Err(NoCloud::Unplaced(reason)) => Some((*stamp, reason)),
            _ => None,
        };
        let mut all = stamps.iter().filter_map(unplaced);
        let Some((first, reason)) = all.next() else {
            return Ok(None);
        };
        Ok(Some((1 + all.count(), first, reason)))
    }

    /// How many intensities of the sweeps read so far did not fit into 0…255 and were limited, by agent.
    pub fn limited_intensities(&self) -> BTreeMap<String, u64> {
        self.context.limited()
    }

    /// Messages of an agent's stream.
    pub fn count(&self, agent: &str, stream: Stream) -> u64 {
        let ids = self.streams.get(&(agent.to_string(), stream)).into_iter().flatten();
        ids.map(|id| self.file.channels()[id].messages).sum()
    }

    /// Whether an agent has messages on a stream.
    pub fn has(&self, agent: &str, stream: Stream) -> bool {
        self.streams.contains_key(&(agent.to_string(), stream))
    }

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

    /// Messages of the wanted streams with log times in `[from, until)`, in order of log time, then of [`Stream`], then
    /// of the agents in [`LogInfo::agents`]. A log that was cut is read up to where messages are missing.
    ///
    /// # Errors
    /// A wanted stream that the log does not have.
    pub fn read(&self, wanted: &[(&str, Stream)], from: Nanos, until: Nanos) -> Result<LogReader, LogError> {
        let mut channels = BTreeMap::new();
        for (agent, stream) in wanted {
            self.need(agent, *stream)?;
            let rank = self
                .info
                .agents
                .iter()
                .position(|known| known.name == *agent)
                .unwrap_or(0);
            for id in &self.streams[&(agent.to_string(), *stream)] {
                channels.insert(*id, (*stream, rank, Name::from(*agent)));
            }
        }
        let ids: BTreeSet<u16> = channels.keys().copied().collect();
        let until = until.min(self.complete_until());
        let messages = self.file.messages(ids, from.max(0) as u64..until.max(0) as u64)?;
        Ok(LogReader {
            messages,
            channels,
            ahead: None,
            instant: VecDeque::new(),
            repeats: Repeats::default(),
            stamps: Stamps::default(),
            context: self.context.clone(),
        })
    }

    /// All messages of the wanted streams.
    ///
    /// # Errors
    /// As [`Log::read`].
    pub fn read_all(&self, wanted: &[(&str, Stream)]) -> Result<LogReader, LogError> {
        self.read(wanted, 0, Nanos::MAX)
    }
}

/// Refuses a topic whose channels have messages at the same time: nobody can say which of two publishers is right.
fn follow_each_other(file: &McapFile, channels: &[u16]) -> Result<(), LogError> {
    let mut spans = Vec::new();
    for id in channels {
        if let Some((first, last)) = file.times_of(*id)? {
            spans.push((first, last, *id));
        }
    }
    spans.sort_unstable();
    let Some([(_, until, one), (from, _, other)]) = spans.array_windows().find(|[a, b]| b.0 <= a.1) else {
        return Ok(());
    };
    let messages = |id: &u16| file.channels()[id].messages;
    Err(LogError::Content {
        topic: file.channels()[one].topic.clone(),
        log_time: nanos(*from),
        reason: format!(
            "two channels have this topic at the same time, {one} with {} messages until {:.3} s and {other} with {} from {:.3} s on: \
             two publishers, or a message that was recorded twice; leave one of them in the log, or give the other a topic of its own",
            messages(one),
            to_seconds(nanos(*until)),
            messages(other),
            to_seconds(nanos(*from))
        ),
    })
}

/// Where the file was cut, and what it lacks by what the log says of itself.
fn truncation(file: &McapFile, info: &LogInfo) -> Option<Truncation> {
    let cut = file.truncation()?;
    // The closing record follows the last message: of such a log only the index is missing.
    let complete = file.metadata().contains_key(END_RECORD).then(|| file.span()).flatten();
    Some(Truncation {
        complete_until: complete
            .map(|(_, last)| nanos(last).saturating_add(1))
            .or(cut.complete_until),
        expected_end: info.end,
        ..cut.clone()
    })
}

/// Times beyond what 63 bits hold are no times.
pub(crate) fn nanos(time: u64) -> Nanos {
    Nanos::try_from(time).unwrap_or(Nanos::MAX)
}

pub(crate) fn times(file: &McapFile, topic: &str) -> Result<Option<(Nanos, Nanos)>, LogError> {
    let mut span: Option<(u64, u64)> = None;
    for (id, _) in file.channels().iter().filter(|(_, channel)| channel.topic == topic) {
        if let Some((first, last)) = file.times_of(*id)? {
            span = Some(span.map_or((first, last), |(a, b)| (a.min(first), b.max(last))));
        }
    }
    Ok(span.map(|(first, last)| (nanos(first), nanos(last))))
}

fn not_realo(file: &McapFile) -> LogError {
    let found = join(file.metadata().keys().map(String::as_str));
    let hint = match file.metadata().contains_key(crate::RECORDING_RECORD) {
        true => "it is a recording of a run: give it to `realo evaluate LOG --detections`".into(),
        false => format!("it holds {}; {}", foreign::of_mcap(file), foreign::GUIDE),
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

pub(crate) fn parse_topic(topic: &str) -> Option<(String, Stream)> {
    let (agent, rest) = topic.strip_prefix('/')?.split_once('/')?;
    let stream = Stream::ALL.into_iter().find(|stream| stream.as_str() == rest)?;
    Some((agent.into(), stream))
}

/// Reads messages of a log in order.
#[derive(Debug)]
pub struct LogReader {
    messages: Messages,
    channels: BTreeMap<u16, (Stream, usize, Name)>,
    ahead: Option<RawMessage>,
    instant: VecDeque<Entry>,
    repeats: Repeats,
    stamps: Stamps,
    context: Arc<Context>,
}

impl LogReader {
    /// The next message; `None` after the last.
    ///
    /// # Errors
    /// Bytes that contradict the format.
    #[allow(clippy::should_implement_trait)]
    pub fn next(&mut self) -> Result<Option<Entry>, LogError> {
        if self.instant.is_empty() {
            self.read_instant()?;
        }
        let Some(mut entry) = self.instant.pop_front() else {
            return Ok(None);
        };
        // Several channels of a topic follow each other: they are one stream.
        let (stream, rank, _) = &self.channels[&entry.raw.channel];
        entry.stamp = self.stamps.unify(*stream, *rank, entry.stamp);
        let noted = self.repeats.note((*stream, *rank), entry.stamp());
        noted.map_err(|reason| entry.bad(reason)).map(|()| Some(entry))
    }

    /// Reads all messages of the next log time and puts them in order.
    fn read_instant(&mut self) -> Result<(), LogError> {
        let Some(first) = self
            .ahead
            .take()
            .map_or_else(|| self.messages.next(), |raw| Ok(Some(raw)))?
        else {
            return Ok(());
        };
        let time = first.log_time;
        let mut instant = vec![first];
        loop {
            match self.messages.next()? {
                Some(raw) if raw.log_time == time => instant.push(raw),
                other => {
                    self.ahead = other;
                    break;
                }
            }
        }
        instant.sort_by_key(|raw| {
            let (stream, rank, _) = &self.channels[&raw.channel];
            (*stream, *rank, raw.sequence)
        });
        self.instant.extend(instant.into_iter().map(|raw| {
            let (stream, _, agent) = &self.channels[&raw.channel];
            Entry {
                agent: agent.clone(),
                stream: *stream,
                stamp: stamp_of(*stream, &raw),
                raw,
                context: self.context.clone(),
            }
        }));
        Ok(())
    }
}

/// One message of a log.
#[derive(Clone, Debug)]
pub struct Entry {
    /// Its agent.
    pub agent: Name,
    /// Its stream.
    pub stream: Stream,
    stamp: Nanos,
    raw: RawMessage,
    context: Arc<Context>,
}

impl Entry {
    /// Its number on its topic, from 0 at the log's beginning.
    pub fn seq(&self) -> u64 {
        self.raw.sequence.into()
    }

    /// The measurement's reference time, ns: the stamp of the message's header; where that is 0, the publish time. Messages of
    /// an agent whose stamps differ by at most [`SAME_STAMP`] have the first of them.
    pub fn stamp(&self) -> Nanos {
        self.stamp
    }

    /// By how much the publish time is later than the stamp of the header, ns, where the two differ: one of them is wrong.
    pub fn published_apart(&self) -> Option<Nanos> {
        let apart = nanos(self.raw.publish_time).saturating_sub(stamp_of(self.stream, &self.raw));
        (apart.abs() > SAME_STAMP).then_some(apart)
    }

    /// When it existed on the log's time line, ns.
    pub fn ready(&self) -> Nanos {
        nanos(self.raw.log_time)
    }

    /// The message as written.
    pub fn data(&self) -> &[u8] {
        self.raw.data()
    }

    /// The points of a sweep ([`Stream::Points`]) in the agent's body frame; intensities that the log has as floats in
    /// 0…1 are scaled to 0…255.
    ///
    /// # Errors
    /// Bytes that are no such message; points in a frame from which the log has no transform into the body frame;
    /// [`LogError::Unplaced`] where it has some, but none near this time.
    pub fn cloud(&self) -> Result<PointCloud, LogError> {
        let cloud = self
            .context
            .cloud(self.raw.channel, &self.agent, self.stamp(), self.data());
        cloud.map_err(|no_cloud| match no_cloud {
            NoCloud::Unreadable(reason) => self.bad(reason),
            NoCloud::Unplaced(reason) => LogError::Unplaced {
                topic: self.stream.topic(&self.agent),
                log_time: self.ready(),
                reason,
            },
        })
    }

    /// Looks whether a sweep ([`Stream::Points`]) is whole and its frame one that leads to the agent's body, without its points.
    ///
    /// # Errors
    /// As [`Entry::cloud`], but for what the points alone tell.
    pub(crate) fn look_at_cloud(&self) -> Result<(), LogError> {
        let looked = self.context.look(&self.agent, self.stamp(), self.data());
        looked.map_err(|reason| self.bad(reason))
    }

    /// A pose ([`Stream::Pose`], [`Stream::PoseTruth`]).
    ///
    /// # Errors
    /// Bytes that are no such message; another frame than the map's; numbers that are no pose.
    pub fn pose(&self) -> Result<AgentState, LogError> {
        let status = match self.stream {
            Stream::PoseTruth => PoseStatus::Truth,
            _ => PoseStatus::Recorded,
        };
        self.in_frame(&self.context.map_frame)
            .and_then(|()| pose::decode(self.data(), status))
            .and_then(|(_, state)| pose::fault(&state).map_or(Ok(state), Err))
            .map_err(|reason| self.bad(reason))
    }

    /// Why the covariance of a pose that can be read cannot be right, in words; such a pose has an unknown one.
    pub fn wrong_covariance(&self) -> Option<String> {
        pose::wrong_covariance(self.data())
    }

    /// Boxes ([`Stream::Detections`], [`Stream::GroundTruth`], [`Stream::OwnLabels`]) without what their companion says.
    ///
    /// # Errors
    /// Bytes that are no such message; another frame than the agent's body.
    pub fn boxes(&self) -> Result<Boxes, LogError> {
        self.in_frame(&body(&self.agent))
            .and_then(|()| boxes::decode_with(self.data(), |id| self.context.track(id)))
            .map(|(_, boxes)| boxes)
            .map_err(|reason| self.bad(reason))
    }

    /// Companion of `boxes` ([`Stream::DetectionsInfo`], [`Stream::GroundTruthInfo`], [`Stream::OwnLabelsInfo`]), which it completes.
    ///
    /// # Errors
    /// Bytes that are no such message; a companion of other boxes.
    pub fn info(&self, boxes: &mut Boxes) -> Result<BoxesInfo, LogError> {
        boxes::decode_info(self.data(), boxes)
            .map(|(_, info)| info)
            .map_err(|reason| self.bad(reason))
    }

    /// Views ([`Stream::GroundTruthViews`], [`Stream::OwnLabelsViews`]).
    ///
    /// # Errors
    /// Bytes that are no such message; another frame than the agent's body; numbers that are no view.
    pub fn views(&self) -> Result<Vec<View>, LogError> {
        self.in_frame(&body(&self.agent))
            .and_then(|()| views::decode(self.data()))
            .map(|(_, views)| views)
            .map_err(|reason| self.bad(reason))
    }

    /// What the agent sent ([`Stream::Packets`]).
    ///
    /// # Errors
    /// Bytes that are no such message.
    pub fn packet(&self) -> Result<SentPacket, LogError> {
        let packet = packets::decode(self.data()).map(|(_, packet)| packet);
        packet.map_err(|reason| self.bad(reason))
    }

    /// Stamp in the message itself ([`Stream::Sweeps`]).
    ///
    /// # Errors
    /// Bytes that are no such message.
    pub fn header_stamp(&self) -> Result<Nanos, LogError> {
        let read = || CdrReader::new(self.data())?.header().map(|(stamp, _)| stamp);
        read().map_err(|reason| self.bad(reason))
    }

    fn in_frame(&self, expected: &str) -> Result<(), String> {
        let (_, frame) = CdrReader::new(self.data())?.header()?;
        match bare(frame) == bare(expected) {
            true => Ok(()),
            false => Err(format!(
                "its frame is `{frame}`, expected `{expected}`; write it in that frame"
            )),
        }
    }

    fn bad(&self, reason: String) -> LogError {
        LogError::Content {
            topic: self.stream.topic(&self.agent),
            log_time: self.ready(),
            reason,
        }
    }
}
