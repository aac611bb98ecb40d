//! Reading a log's messages in the order of time.

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;

use realo_schemas::{Name, to_seconds};

use super::entry::Entry;
use super::nanos;
use crate::mcap_file::{McapFile, Messages, RawMessage};
use crate::rebase::Rebased;
use crate::repeats::Repeats;
use crate::stamps::{Stamps, stamp_of};
use crate::sweeps::Context;
use crate::{LogError, Stream};

/// Refuses a topic whose channels have messages at the same time: nobody can say which of two publishers is right.
pub(super) fn follow_each_other(file: &McapFile, channels: &[u16]) -> Result<(), LogError> {
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

/// Reads messages of a log in order.
#[derive(Debug)]
pub struct LogReader {
    pub(super) messages: Messages,
    pub(super) channels: BTreeMap<u16, (Stream, usize, Name)>,
    pub(super) ahead: Option<RawMessage>,
    pub(super) instant: VecDeque<Entry>,
    /// What refuses stamps that repeat or start again.
    pub(super) repeats: Option<Repeats>,
    pub(super) stamps: Stamps,
    pub(super) rebased: Option<Arc<Rebased>>,
    pub(super) context: Arc<Context>,
}

impl LogReader {
    /// The next message; `None` after the last.
    ///
    /// # Errors
    /// Bytes that contradict the format.
    #[allow(clippy::should_implement_trait)]
    pub fn next(&mut self) -> Result<Option<Entry>, LogError> {
        loop {
            if self.instant.is_empty() {
                self.read_instant()?;
            }
            let Some(mut entry) = self.instant.pop_front() else {
                return Ok(None);
            };
            // Several channels of a topic follow each other: they are one stream.
            let (stream, rank, agent) = &self.channels[&entry.raw.channel];
            entry.stamp = self.stamps.unify(*stream, *rank, entry.stamp);
            if let Some(rebased) = &self.rebased {
                match rebased.stamp((agent, *stream), entry.stamp, entry.ready()) {
                    Some(stamp) => entry.stamp = stamp,
                    None => continue,
                }
            }
            let repeats = self.repeats.as_mut();
            let noted = repeats.map_or(Ok(()), |repeats| repeats.note((*stream, *rank), entry.stamp()));
            return noted.map_err(|reason| entry.bad(reason)).map(|()| Some(entry));
        }
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
