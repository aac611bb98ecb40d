//! Reads any MCAP file in constant memory: by its index, or, where that is missing, after one pass over the file.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet, BinaryHeap};
use std::fs::{self, File};
use std::io::{self, Read, Seek, SeekFrom};
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Weak};

use mcap::records::op;
use realo_schemas::{Nanos, to_seconds};
use serde::Serialize;

use crate::records::{
    ChannelRecord, ChunkIndex, FOOTER, Footer, HEAD, MESSAGE_HEAD, MessageRecord, MetadataIndex, MetadataRecord,
    SchemaRecord, Statistics, most_unpacked, records, unpack,
};
use crate::{Lane, LogError, foreign};

pub(crate) const MAGIC: [u8; 8] = *b"\x89MCAP0\r\n";
/// Bytes at the beginning that tell what a file is.
const LOOKED_AT: u64 = 64;
const RECORD_HEAD: u64 = HEAD as u64;
/// Footer and magic.
const TAIL: usize = FOOTER + MAGIC.len();

/// Where a cut file ends.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Truncation {
    /// Length of the readable part, bytes.
    pub at_byte: u64,
    /// Length of the file.
    pub file_bytes: u64,
    /// What follows the readable part.
    pub reason: String,
    /// Log time before which no message is missing, ns; `None` if none is left.
    pub complete_until: Option<Nanos>,
    /// When the log was to end, where it says so, ns.
    pub expected_end: Option<Nanos>,
}

impl std::fmt::Display for Truncation {
    fn fmt(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
        write!(
            f,
            "cut at byte {} of {} ({})",
            self.at_byte, self.file_bytes, self.reason
        )?;
        match (self.complete_until, self.expected_end) {
            (Some(until), Some(end)) => {
                let missing = to_seconds(end.saturating_sub(until)).max(0.0);
                write!(f, "; the last {missing:.3} s are missing")
            }
            (Some(until), None) => write!(f, "; from {:.3} s on messages are missing", to_seconds(until)),
            (None, _) => write!(f, "; no message is left"),
        }
    }
}

/// A channel of a file.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct ChannelInfo {
    /// Its topic.
    pub topic: String,
    /// Name of its schema; empty without.
    pub schema: String,
    /// Encoding of its messages.
    pub encoding: String,
    /// Messages in the file.
    pub messages: u64,
}

impl ChannelInfo {
    fn new(channel: &ChannelRecord) -> Self {
        ChannelInfo {
            topic: channel.topic.into(),
            schema: String::new(),
            encoding: channel.encoding.into(),
            messages: 0,
        }
    }
}

/// A chunk, or a message outside of chunks.
#[derive(Clone, Debug)]
struct Span {
    first: u64,
    last: u64,
    offset: u64,
    length: u64,
    /// Channels with messages in it; `None` if the file does not say.
    channels: Option<BTreeSet<u16>>,
}

/// An open MCAP file.
#[derive(Clone, Debug)]
pub struct McapFile {
    path: PathBuf,
    channels: BTreeMap<u16, ChannelInfo>,
    metadata: BTreeMap<String, BTreeMap<String, String>>,
    spans: Arc<Vec<Span>>,
    first: Option<u64>,
    last: Option<u64>,
    truncation: Option<Truncation>,
}

impl McapFile {
    /// Opens a file and reads its index; a file without one is read once from start to end.
    ///
    /// # Errors
    /// A file that cannot be read or is no MCAP.
    pub fn open(path: impl AsRef<Path>) -> Result<Self, LogError> {
        let path = path.as_ref();
        let not_mcap = |reason: String| LogError::NotMcap {
            path: path.into(),
            reason,
        };
        if path.is_dir() {
            return Err(not_mcap(foreign::folder(path)));
        }
        // To open a pipe would wait for whoever writes into it.
        let is_file = fs::metadata(path).map_err(LogError::io(path, "open"))?.is_file();
        if !is_file {
            return Err(not_mcap("a pipe, socket or device; write it to a file first".into()));
        }
        let mut file = File::open(path).map_err(LogError::io(path, "open"))?;
        let size = file.metadata().map_err(LogError::io(path, "read"))?.len();
        let mut head = Vec::new();
        let read = Read::by_ref(&mut file).take(LOOKED_AT).read_to_end(&mut head);
        read.map_err(LogError::io(path, "read"))?;
        if !head.starts_with(&MAGIC) {
            return Err(not_mcap(foreign::not_mcap(path, &head)));
        }
        file.seek(SeekFrom::Start(MAGIC.len() as u64))
            .map_err(LogError::io(path, "read"))?;
        match Self::by_index(path, &mut file, size)? {
            Some(indexed) => Ok(indexed),
            None => Scan::new(path, file, size).run(),
        }
    }

    /// The file's path.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Channels by id.
    pub fn channels(&self) -> &BTreeMap<u16, ChannelInfo> {
        &self.channels
    }

    /// Metadata records by name.
    pub fn metadata(&self) -> &BTreeMap<String, BTreeMap<String, String>> {
        &self.metadata
    }

    /// First and last log time.
    pub fn span(&self) -> Option<(u64, u64)> {
        self.first.zip(self.last)
    }

    /// Where the file was cut, if it was.
    pub fn truncation(&self) -> Option<&Truncation> {
        self.truncation.as_ref()
    }

    /// Messages of channels with log times in a range, in order of log time, then of the file.
    ///
    /// # Errors
    /// If the file cannot be opened again.
    pub fn messages(&self, channels: BTreeSet<u16>, times: Range<u64>) -> Result<Messages, LogError> {
        let file = File::open(&self.path).map_err(LogError::io(&self.path, "open"))?;
        Ok(Messages {
            path: self.path.clone(),
            file,
            spans: self.spans.clone(),
            next: 0,
            channels,
            times,
            heap: BinaryHeap::new(),
            held: Vec::new(),
        })
    }

    /// First and last log time of a channel's messages; `None` without any.
    ///
    /// # Errors
    /// If the file cannot be opened again; bytes that contradict the format.
    pub fn times_of(&self, channel: u16) -> Result<Option<(u64, u64)>, LogError> {
        let only = BTreeSet::from([channel]);
        let mut messages = self.messages(only, 0..u64::MAX)?;
        let Some(first) = messages.next()?.map(|message| message.log_time) else {
            return Ok(None);
        };
        let mut last = first;
        let mut spans: Vec<&Span> = self.spans.iter().filter(|span| messages.wants(span)).collect();
        spans.sort_by_key(|span| Reverse((span.last, span.offset)));
        for span in spans {
            if span.last <= last {
                break;
            }
            let chunk = messages.chunk(span)?;
            for record in records(&chunk) {
                let (opcode, body) = record.map_err(|reason| LogError::damaged(&self.path, span.offset, reason))?;
                if opcode == op::MESSAGE
                    && let Ok(head) = MessageRecord::read(&chunk[body])
                    && head.channel == channel
                {
                    last = last.max(head.log_time);
                }
            }
        }
        Ok(Some((first, last)))
    }

    /// Reads the index; `None` if the file has none, or one that does not fit the file.
    fn by_index(path: &Path, file: &mut File, size: u64) -> Result<Option<Self>, LogError> {
        let Some(summary) = Summary::read(file, size).filter(|summary| summary.fits(size)) else {
            return Ok(None);
        };
        let Some(stats) = summary.stats else { return Ok(None) };
        let mut channels = summary.channels;
        for (id, channel) in &mut channels {
            channel.messages = stats.counts.get(id).copied().unwrap_or(0);
        }
        let mut metadata = BTreeMap::new();
        for index in &summary.metadata {
            let damaged = |reason| LogError::damaged(path, index.offset, reason);
            let bytes = read_at(file, index.offset, index.length, size).map_err(damaged)?;
            let (opcode, body) = whole_record(&bytes).map_err(damaged)?;
            if opcode == op::METADATA {
                let record = MetadataRecord::read(body).map_err(damaged)?;
                metadata.insert(record.name, record.entries);
            }
        }
        let spans = summary.chunks.into_iter().map(|chunk| Span {
            first: chunk.first,
            last: chunk.last,
            offset: chunk.offset,
            length: chunk.length,
            channels: Some(chunk.channels).filter(|channels| !channels.is_empty()),
        });
        let has = stats.messages > 0;
        Ok(Some(McapFile {
            path: path.into(),
            channels,
            metadata,
            spans: Arc::new(sorted(spans.collect())),
            first: has.then_some(stats.first),
            last: has.then_some(stats.last),
            truncation: None,
        }))
    }
}

/// The index at a file's end.
#[derive(Default)]
struct Summary {
    stats: Option<Statistics>,
    channels: BTreeMap<u16, ChannelInfo>,
    chunks: Vec<ChunkIndex>,
    metadata: Vec<MetadataIndex>,
}

impl Summary {
    /// `None` where there is none, or its bytes or checksum are wrong.
    fn read(file: &mut File, size: u64) -> Option<Self> {
        let tail = size.checked_sub(TAIL as u64).filter(|at| *at >= MAGIC.len() as u64)?;
        let mut bytes = [0; TAIL];
        file.seek(SeekFrom::Start(tail)).ok()?;
        file.read_exact(&mut bytes).ok()?;
        let (opcode, body) = whole_record(&bytes[..FOOTER]).ok()?;
        if opcode != op::FOOTER || bytes[FOOTER..] != MAGIC {
            return None;
        }
        let footer = Footer::read(body).ok()?;
        let length = tail
            .checked_sub(footer.summary)
            .filter(|_| footer.summary >= MAGIC.len() as u64)?;
        file.seek(SeekFrom::Start(footer.summary)).ok()?;
        let mut section = io::BufReader::new(file).take(length);
        let mut crc = crc32fast::Hasher::new();
        let mut summary = Summary::default();
        let mut schemas: BTreeMap<u16, String> = BTreeMap::new();
        let mut schema_of: Vec<(u16, u16)> = Vec::new();
        while section.limit() > 0 {
            let mut head = [0; HEAD];
            section.read_exact(&mut head).ok()?;
            let length = u64::from_le_bytes(std::array::from_fn(|i| head[i + 1]));
            if length > section.limit() {
                return None;
            }
            let mut body = vec![0; length as usize];
            section.read_exact(&mut body).ok()?;
            crc.update(&head);
            crc.update(&body);
            match head[0] {
                op::SCHEMA => {
                    let schema = SchemaRecord::read(&body).ok()?;
                    schemas.insert(schema.id, schema.name.into());
                }
                op::CHANNEL => {
                    let channel = ChannelRecord::read(&body).ok()?;
                    schema_of.push((channel.id, channel.schema));
                    summary.channels.insert(channel.id, ChannelInfo::new(&channel));
                }
                op::CHUNK_INDEX => summary.chunks.push(ChunkIndex::read(&body).ok()?),
                op::METADATA_INDEX => summary.metadata.push(MetadataIndex::read(&body).ok()?),
                op::STATISTICS => summary.stats = Some(Statistics::read(&body).ok()?),
                _ => {}
            }
        }
        // The checksum covers the footer up to itself.
        crc.update(&bytes[..FOOTER - 4]);
        if footer.crc != 0 && footer.crc != crc.finalize() {
            return None;
        }
        for (channel, schema) in schema_of {
            if let (Some(channel), Some(name)) = (summary.channels.get_mut(&channel), schemas.get(&schema)) {
                channel.schema.clone_from(name);
            }
        }
        Some(summary)
    }

    /// Whether it leads to every message of a file, and claims nothing that a file of this size cannot hold.
    fn fits(&self, size: u64) -> bool {
        let Some(stats) = &self.stats else { return false };
        let unpacked = |chunk: &ChunkIndex| {
            let believed = chunk.packed <= chunk.length && chunk.unpacked <= most_unpacked(chunk.packed);
            believed.then_some(chunk.unpacked)
        };
        let room = self
            .chunks
            .iter()
            .map(unpacked)
            .try_fold(0u64, |sum, unpacked| sum.checked_add(unpacked?));
        let counted = stats
            .counts
            .values()
            .try_fold(0u64, |sum, count| sum.checked_add(*count));
        let chunks = self.chunks.iter().map(|chunk| (chunk.offset, chunk.length));
        let metadata = self.metadata.iter().map(|record| (record.offset, record.length));
        self.chunks.len() == stats.chunks as usize
            && self.metadata.len() == stats.metadata as usize
            && stats.counts.keys().all(|id| self.channels.contains_key(id))
            && counted == Some(stats.messages)
            && room.is_some_and(|room| stats.messages <= room / (HEAD + MESSAGE_HEAD) as u64)
            && stats.first <= stats.last
            && are_apart(chunks.chain(metadata).collect(), size)
    }
}

/// Whether stretches of (offset, length) lie in a file, and none on another.
fn are_apart(mut stretches: Vec<(u64, u64)>, size: u64) -> bool {
    stretches.sort_unstable();
    let mut end = MAGIC.len() as u64;
    stretches.into_iter().all(|(offset, length)| {
        let before = std::mem::replace(&mut end, offset.saturating_add(length));
        offset >= before && length >= RECORD_HEAD && end <= size
    })
}

fn sorted(mut spans: Vec<Span>) -> Vec<Span> {
    spans.sort_by_key(|span| (span.first, span.offset));
    spans
}

/// Reads a whole record, head included.
fn read_at(file: &mut File, offset: u64, length: u64, size: u64) -> Result<Vec<u8>, String> {
    if length < RECORD_HEAD || offset.checked_add(length).is_none_or(|end| end > size) {
        return Err(format!("a record of {length} bytes in a file of {size}"));
    }
    let mut bytes = vec![0; length as usize];
    let read = |file: &mut File, bytes: &mut [u8]| -> io::Result<()> {
        file.seek(SeekFrom::Start(offset))?;
        file.read_exact(bytes)
    };
    read(file, &mut bytes).map_err(|error| error.to_string())?;
    Ok(bytes)
}

/// Opcode and body of a record whose head says exactly the bytes that there are.
fn whole_record(bytes: &[u8]) -> Result<(u8, &[u8]), String> {
    let mut found = records(bytes);
    match (found.next(), found.next()) {
        (Some(Ok((opcode, body))), None) => Ok((opcode, &bytes[body])),
        _ => Err(format!(
            "expected a record of {} bytes, found another length",
            bytes.len()
        )),
    }
}

/// One pass over a file without a usable index.
struct Scan {
    path: PathBuf,
    file: io::BufReader<File>,
    size: u64,
    at: u64,
    schemas: BTreeMap<u16, String>,
    channels: BTreeMap<u16, (ChannelInfo, u16)>,
    counts: BTreeMap<u16, u64>,
    metadata: BTreeMap<String, BTreeMap<String, String>>,
    spans: Vec<Span>,
    lanes: BTreeMap<Lane, Reach>,
    /// Whether the record after the last message was found.
    all_data: bool,
    /// Where the file ends by its closing record.
    end: Option<u64>,
}

/// How far the messages of a lane reach.
#[derive(Clone, Copy, Default)]
struct Reach {
    newest: u64,
    /// By how much a message lay before an earlier one of the file.
    disorder: u64,
}

impl Reach {
    fn note(&mut self, time: u64) {
        self.newest = self.newest.max(time);
        self.disorder = self.disorder.max(self.newest - time);
    }

    /// More messages of the newest time may have followed, and as late ones as there were before.
    fn complete_until(self) -> u64 {
        self.newest.saturating_sub(self.disorder)
    }
}

impl Scan {
    fn new(path: &Path, file: File, size: u64) -> Self {
        Scan {
            path: path.into(),
            file: io::BufReader::with_capacity(1 << 16, file),
            size,
            at: MAGIC.len() as u64,
            schemas: BTreeMap::new(),
            channels: BTreeMap::new(),
            counts: BTreeMap::new(),
            metadata: BTreeMap::new(),
            spans: Vec::new(),
            lanes: BTreeMap::new(),
            all_data: false,
            end: None,
        }
    }

    /// Log time before which no message is missing.
    fn complete_until(&self, last: Option<u64>) -> Option<u64> {
        match self.all_data {
            true => last.map(|last| last.saturating_add(1)),
            // Lanes are cut at different times: what one lacks, the others' messages cannot do without.
            false => self.lanes.values().map(|reach| reach.complete_until()).min(),
        }
    }

    fn run(mut self) -> Result<McapFile, LogError> {
        self.file
            .seek(SeekFrom::Start(self.at))
            .map_err(LogError::io(&self.path, "read"))?;
        let cut = loop {
            match self.step() {
                Ok(true) => {}
                Ok(false) => break None,
                Err(reason) => break Some(reason),
            }
        };
        if let Some(end) = self.end.filter(|end| self.size > *end) {
            return Err(self.goes_on(end));
        }
        let mut channels = BTreeMap::new();
        for (id, (mut info, schema)) in std::mem::take(&mut self.channels) {
            info.schema = self.schemas.get(&schema).cloned().unwrap_or_default();
            info.messages = self.counts.get(&id).copied().unwrap_or(0);
            channels.insert(id, info);
        }
        let with_messages = || {
            self.spans
                .iter()
                .filter(|span| span.channels.as_ref().is_some_and(|c| !c.is_empty()))
        };
        let first = with_messages().map(|span| span.first).min();
        let last = with_messages().map(|span| span.last).max();
        let complete_until = self.complete_until(last);
        let truncation = cut.map(|reason| Truncation {
            at_byte: self.at,
            file_bytes: self.size,
            reason,
            complete_until: complete_until.map(|until| until.min(Nanos::MAX as u64) as Nanos),
            expected_end: None,
        });
        let spans = Arc::new(sorted(self.spans));
        Ok(McapFile {
            path: self.path,
            channels,
            metadata: self.metadata,
            spans,
            first,
            last,
            truncation,
        })
    }

    /// Why a file is refused that goes on after its end: what follows would be lost in silence.
    fn goes_on(&mut self, end: u64) -> LogError {
        let mut head = [0; MAGIC.len()];
        let read = self
            .file
            .seek(SeekFrom::Start(end))
            .and_then(|_| self.file.read_exact(&mut head));
        let (path, more) = (self.path.display(), self.size - end);
        let reason = match read.is_ok() && head == MAGIC {
            true => format!(
                "another MCAP file of {more} B follows, as where two files were written into one; keep the first by `head -c {end} \
                 {path} > first.mcap`, the other by `tail -c {more} {path} > second.mcap`"
            ),
            false => format!(
                "what follows, {more} B, is not of an MCAP file; leave it out by `head -c {end} {path} > mended.mcap`"
            ),
        };
        LogError::GoesOn {
            path: self.path.clone(),
            offset: end,
            reason,
        }
    }

    /// Reads a record; false after the last one, an error where the file is cut.
    fn step(&mut self) -> Result<bool, String> {
        let mut head = [0; HEAD];
        if self.at == self.size {
            return Err("the index at the end is missing".into());
        }
        self.file
            .read_exact(&mut head)
            .map_err(|_| "the file ends within a record's head".to_string())?;
        let opcode = head[0];
        let length = u64::from_le_bytes(std::array::from_fn(|i| head[i + 1]));
        if length > self.size.saturating_sub(self.at + RECORD_HEAD) {
            return Err("the file ends within a record".into());
        }
        match opcode {
            op::FOOTER => {
                self.end = Some(self.at + RECORD_HEAD + length + MAGIC.len() as u64);
                return Ok(false);
            }
            // Behind the data, an index that was not believed repeats the definitions.
            op::CHUNK | op::MESSAGE | op::SCHEMA | op::CHANNEL | op::METADATA | op::DATA_END if !self.all_data => {
                let mut body = vec![0; length as usize];
                self.file.read_exact(&mut body).map_err(|error| error.to_string())?;
                self.note(opcode, &body)?;
            }
            _ => self
                .file
                .seek_relative(length as i64)
                .map_err(|error| error.to_string())?,
        }
        self.at += RECORD_HEAD + length;
        Ok(true)
    }

    fn note(&mut self, opcode: u8, body: &[u8]) -> Result<(), String> {
        if !matches!(opcode, op::CHUNK | op::MESSAGE) {
            return self.note_definition(opcode, body);
        }
        let mut span = Span {
            first: 0,
            last: 0,
            offset: self.at,
            length: RECORD_HEAD + body.len() as u64,
            channels: Some(BTreeSet::new()),
        };
        if opcode == op::MESSAGE {
            self.note_message(body, &mut span)?;
        } else {
            let chunk = unpack(body)?;
            for record in records(&chunk) {
                match record? {
                    (op::MESSAGE, body) => self.note_message(&chunk[body], &mut span)?,
                    (opcode @ (op::SCHEMA | op::CHANNEL), body) => self.note_definition(opcode, &chunk[body])?,
                    // Nothing else belongs into a chunk.
                    _ => {}
                }
            }
        }
        self.spans.push(span);
        Ok(())
    }

    fn note_message(&mut self, body: &[u8], span: &mut Span) -> Result<(), String> {
        let MessageRecord { channel, log_time, .. } = MessageRecord::read(body)?;
        let channels = span.channels.get_or_insert_default();
        (span.first, span.last) = match channels.is_empty() {
            true => (log_time, log_time),
            false => (span.first.min(log_time), span.last.max(log_time)),
        };
        channels.insert(channel);
        self.lanes.entry(self.lane_of(channel)).or_default().note(log_time);
        *self.counts.entry(channel).or_default() += 1;
        Ok(())
    }

    fn note_definition(&mut self, opcode: u8, body: &[u8]) -> Result<(), String> {
        match opcode {
            op::SCHEMA => {
                let schema = SchemaRecord::read(body)?;
                self.schemas.insert(schema.id, schema.name.into());
            }
            op::CHANNEL => {
                let channel = ChannelRecord::read(body)?;
                let info = ChannelInfo::new(&channel);
                self.channels.insert(channel.id, (info, channel.schema));
            }
            op::METADATA => {
                let record = MetadataRecord::read(body)?;
                self.metadata.insert(record.name, record.entries);
            }
            op::DATA_END => self.all_data = true,
            _ => {}
        }
        Ok(())
    }

    fn lane_of(&self, channel: u16) -> Lane {
        let schema = self
            .channels
            .get(&channel)
            .and_then(|(_, schema)| self.schemas.get(schema));
        schema.map_or(Lane::Small, |schema| Lane::of(schema))
    }
}

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
    chunk: Arc<Vec<u8>>,
    body: Range<usize>,
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
    path: PathBuf,
    file: File,
    spans: Arc<Vec<Span>>,
    next: usize,
    channels: BTreeSet<u16>,
    times: Range<u64>,
    heap: BinaryHeap<Reverse<Waiting>>,
    /// Chunks of which messages wait or are in use.
    held: Vec<Weak<Vec<u8>>>,
}

#[derive(Debug)]
struct Waiting(RawMessage, (u64, usize));

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

    fn wants(&self, span: &Span) -> bool {
        let wanted = |channels: &BTreeSet<u16>| channels.iter().any(|channel| self.channels.contains(channel));
        span.last >= self.times.start && span.channels.as_ref().is_none_or(wanted)
    }

    /// The records of a chunk, or of a message outside of chunks.
    fn chunk(&mut self, span: &Span) -> Result<Vec<u8>, LogError> {
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stretches_lie_in_the_file_and_apart() {
        let apart = |stretches: &[(u64, u64)]| are_apart(stretches.to_vec(), 100);
        assert!(apart(&[]) && apart(&[(8, 9)]) && apart(&[(50, 50), (8, 42)]) && apart(&[(91, 9)]));
        for wrong in [
            &[(7, 20)][..],
            &[(8, 8)],
            &[(8, 0)],
            &[(92, 9)],
            &[(8, 93)],
            &[(8, 20), (27, 9)],
            &[(8, 20), (8, 20)],
            &[(8, u64::MAX)],
            &[(u64::MAX, 9)],
        ] {
            assert!(!apart(wrong), "{wrong:?}");
        }
    }

    fn summary() -> Summary {
        let channel = ChannelInfo {
            topic: "/x".into(),
            schema: String::new(),
            encoding: "cdr".into(),
            messages: 0,
        };
        Summary {
            stats: Some(Statistics {
                messages: 3,
                metadata: 1,
                chunks: 1,
                first: 5,
                last: 6,
                counts: BTreeMap::from([(0, 1), (1, 2)]),
            }),
            channels: BTreeMap::from([(0, channel.clone()), (1, channel)]),
            chunks: vec![ChunkIndex {
                first: 5,
                last: 6,
                offset: 8,
                length: 200,
                channels: BTreeSet::new(),
                packed: 93,
                unpacked: 93,
            }],
            metadata: vec![MetadataIndex { offset: 208, length: 9 }],
        }
    }

    #[test]
    fn an_index_is_used_only_if_it_fits_the_file() {
        assert!(summary().fits(217));
        type Change = fn(&mut Summary, &mut Statistics);
        let changes: [Change; 14] = [
            |_, stats| stats.messages = 4,
            |_, stats| stats.messages = 2,
            |_, stats| stats.metadata = 0,
            |_, stats| stats.chunks = 2,
            |_, stats| stats.first = 7,
            |_, stats| stats.counts = BTreeMap::from([(0, 1), (2, 2)]),
            |_, stats| stats.counts = BTreeMap::from([(0, u64::MAX), (1, 4)]),
            // A message takes 31 bytes.
            |summary, _| summary.chunks[0].unpacked = 92,
            |summary, _| summary.chunks[0].unpacked = most_unpacked(93) + 1,
            |summary, _| summary.chunks[0].packed = 201,
            |summary, _| summary.chunks[0].offset = 9,
            |summary, _| summary.metadata[0].length = 10,
            |summary, _| summary.metadata[0].offset = 207,
            |summary, _| summary.metadata.clear(),
        ];
        for (k, change) in changes.into_iter().enumerate() {
            let mut changed = summary();
            let mut stats = changed.stats.take().unwrap();
            change(&mut changed, &mut stats);
            changed.stats = Some(stats);
            assert!(!changed.fits(217), "change {k}");
        }
        let bare = Summary {
            stats: None,
            ..summary()
        };
        assert!(!bare.fits(217) && !summary().fits(216));
    }

    #[test]
    fn whole_records_have_the_length_that_they_say() {
        let record = [&[op::METADATA][..], &3u64.to_le_bytes(), b"abc"].concat();
        assert_eq!(whole_record(&record), Ok((op::METADATA, &b"abc"[..])));
        for wrong in [
            &record[..11],
            &[&record[..], b"x"].concat(),
            &[&record[..], &record[..]].concat(),
            &[],
        ] {
            assert!(whole_record(wrong).is_err(), "{wrong:?}");
        }
    }
}
