//! Messages in the order of time.

use std::cmp::Reverse;
use std::collections::{BTreeSet, BinaryHeap};
use std::fs::File;
use std::ops::Range;
use std::path::PathBuf;
use std::sync::{Arc, Weak};

use mcap::records::op;

use super::Span;
use super::summary::{read_at, whole_record};
use crate::LogError;
use crate::records::{MESSAGE_HEAD, MessageRecord, most_unpacked, records, unpack};

/// A message of a file.
#[derive(Clone, Debug)]
pub struct RawMessage {
    /// Its channel.
    pub channel: u16,
    /// Its number on the channel, as the writer gave it.
    pub sequence: u32,
    /// Log time, ns.
    pub log_time: u64,
    /// Publish time, ns.
    pub publish_time: u64,
    pub(super) chunk: Arc<Vec<u8>>,
    pub(super) body: Range<usize>,
}

impl RawMessage {
    /// The payload.
    pub fn data(&self) -> &[u8] {
        &self.chunk[self.body.clone()]
    }
}

/// Reads messages in order; holds only the chunks that overlap the current time.
#[derive(Debug)]
pub struct Messages {
    pub(super) path: PathBuf,
    pub(super) file: File,
    pub(super) spans: Arc<Vec<Span>>,
    pub(super) next: usize,
    pub(super) channels: BTreeSet<u16>,
    pub(super) times: Range<u64>,
    pub(super) heap: BinaryHeap<Reverse<Waiting>>,
    /// Chunks of which messages wait or are in use.
    pub(super) held: Vec<Weak<Vec<u8>>>,
}

#[derive(Debug)]
pub(super) struct Waiting(RawMessage, (u64, usize));

impl Waiting {
    fn key(&self) -> (u64, (u64, usize)) {
        (self.0.log_time, self.1)
    }
}

impl PartialEq for Waiting {
    fn eq(&self, other: &Self) -> bool {
        self.key() == other.key()
    }
}

impl Eq for Waiting {}

impl PartialOrd for Waiting {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}

impl Ord for Waiting {
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        self.key().cmp(&other.key())
    }
}

impl Messages {
    /// The next message; `None` after the last.
    ///
    /// # Errors
    /// Bytes that contradict the format, with their place.
    #[allow(clippy::should_implement_trait)]
    pub fn next(&mut self) -> Result<Option<RawMessage>, LogError> {
        loop {
            let soonest = self.heap.peek().map_or(u64::MAX, |waiting| waiting.0.0.log_time);
            match self.spans.get(self.next) {
                Some(span) if span.first <= soonest && span.first < self.times.end => {
                    let span = span.clone();
                    self.next += 1;
                    if self.wants(&span) {
                        self.load(&span)?;
                    }
                }
                _ => return Ok(self.heap.pop().map(|Reverse(waiting)| waiting.0)),
            }
        }
    }

    pub(super) fn wants(&self, span: &Span) -> bool {
        let wanted = |channels: &BTreeSet<u16>| channels.iter().any(|channel| self.channels.contains(channel));
        span.last >= self.times.start && span.channels.as_ref().is_none_or(wanted)
    }

    /// The records of a chunk, or of a message outside of chunks.
    pub(super) fn chunk(&mut self, span: &Span) -> Result<Vec<u8>, LogError> {
        let damaged = |reason: String| LogError::damaged(&self.path, span.offset, reason);
        let size = self.file.metadata().map_err(LogError::io(&self.path, "read"))?.len();
        let bytes = read_at(&mut self.file, span.offset, span.length, size).map_err(damaged)?;
        match whole_record(&bytes).map_err(damaged)? {
            (op::MESSAGE, _) => Ok(bytes),
            (op::CHUNK, body) => unpack(body).map_err(damaged),
            (other, _) => Err(damaged(format!(
                "expected a chunk here, found a record of type {other:#04x}"
            ))),
        }
    }

    /// Chunks of one time are unpacked together: a file must not make more of them than of one great chunk.
    fn hold(&mut self, chunk: &Arc<Vec<u8>>, offset: u64) -> Result<(), LogError> {
        self.held.retain(|held| held.strong_count() > 0);
        self.held.push(Arc::downgrade(chunk));
        let bytes: u64 = self
            .held
            .iter()
            .filter_map(Weak::upgrade)
            .map(|held| held.len() as u64)
            .sum();
        let size = self.file.metadata().map_err(LogError::io(&self.path, "read"))?.len();
        let most = most_unpacked(size);
        match bytes <= most {
            true => Ok(()),
            false => Err(LogError::damaged(
                &self.path,
                offset,
                format!(
                    "chunks that overlap in time unpack to {bytes} bytes; of a file of {size} at most {most} are \
                     believed"
                ),
            )),
        }
    }

    fn load(&mut self, span: &Span) -> Result<(), LogError> {
        let path = self.path.clone();
        let damaged = |reason: String| LogError::damaged(&path, span.offset, reason);
        let chunk = Arc::new(self.chunk(span)?);
        self.hold(&chunk, span.offset)?;
        for record in records(&chunk) {
            let (opcode, body) = record.map_err(damaged)?;
            if opcode != op::MESSAGE {
                continue;
            }
            let head = MessageRecord::read(&chunk[body.clone()]).map_err(damaged)?;
            if self.channels.contains(&head.channel) && self.times.contains(&head.log_time) {
                let order = (span.offset, body.start);
                let message = RawMessage {
                    channel: head.channel,
                    sequence: head.sequence,
                    log_time: head.log_time,
                    publish_time: head.publish_time,
                    chunk: chunk.clone(),
                    body: body.start + MESSAGE_HEAD..body.end,
                };
                self.heap.push(Reverse(Waiting(message, order)));
            }
        }
        Ok(())
    }
}
