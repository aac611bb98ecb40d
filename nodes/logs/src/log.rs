mod entry;
mod motion;
mod needs;
mod reader;

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::path::Path;
use std::sync::Arc;

use realo_schemas::{Name, Nanos};

use crate::cdr::CdrReader;
use crate::geodesy::MapOrigin;
use crate::info::{CLOCKS, END_RECORD, LEVELLED, LOG_RECORD};
use crate::mcap_file::{ChannelInfo, McapFile, Truncation};
use crate::rebase::Rebased;
use crate::repeats::Repeats;
use crate::stamps::Stamps;
use crate::sweeps::{Context, NoCloud, SweepsInfo};
use crate::{Levelled, LogError, LogInfo, PeerClock, Stream};
pub use entry::Entry;
pub(crate) use needs::join;
use needs::not_realo;
pub use reader::LogReader;
use reader::follow_each_other;

/// An open log.
#[derive(Clone, Debug)]
pub struct Log {
    file: McapFile,
    info: LogInfo,
    truncation: Option<Truncation>,
    streams: BTreeMap<(String, Stream), Vec<u16>>,
    context: Arc<Context>,
    /// How stamps are put right, where somebody asked for it.
    pub(crate) rebased: Option<Arc<Rebased>>,
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
        let origin = info.map_origin.and_then(|origin| MapOrigin::new(origin).ok());
        Ok(Log {
            context: Arc::new(Context::new(file.clone(), &info.map_frame, origin)),
            file,
            info,
            truncation,
            streams,
            rebased: None,
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
            repeats: Some(Repeats::default()),
            stamps: Stamps::default(),
            rebased: self.rebased.clone(),
            context: self.context.clone(),
        })
    }

    /// All messages of the wanted streams with the stamps that they have, whether or not these rise.
    ///
    /// # Errors
    /// As [`Log::read`].
    pub(crate) fn read_unjudged(&self, wanted: &[(&str, Stream)]) -> Result<LogReader, LogError> {
        let reader = self.read_all(wanted)?;
        Ok(LogReader {
            repeats: None,
            rebased: None,
            ..reader
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

pub(crate) fn parse_topic(topic: &str) -> Option<(String, Stream)> {
    let (agent, rest) = topic.strip_prefix('/')?.split_once('/')?;
    let stream = Stream::ALL.into_iter().find(|stream| stream.as_str() == rest)?;
    Some((agent.into(), stream))
}
