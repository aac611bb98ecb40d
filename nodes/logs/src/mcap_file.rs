//! Reads any MCAP file in constant memory: by its index, or, where that is missing, after one pass over the file.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet, BinaryHeap};
use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom};
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use mcap::records::{Record, op};
use mcap::sans_io::{SummaryReadEvent, SummaryReader, SummaryReaderOptions};
use realo_schemas::{Nanos, to_seconds};
use serde::Serialize;

use crate::{Lane, LogError};

const MAGIC: [u8; 8] = *b"\x89MCAP0\r\n";
/// Opcode and length.
const RECORD_HEAD: u64 = 9;
/// Channel, sequence, log time, publish time.
const MESSAGE_HEAD: usize = 22;
/// No writer makes such chunks; a damaged length must not claim all memory.
const MAX_CHUNK: u64 = 1 << 30;

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
            (Some(until), Some(end)) => write!(f, "; the last {:.3} s are missing", to_seconds(end - until).max(0.0)),
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
        let mut file = File::open(path).map_err(LogError::io(path, "open"))?;
        let size = file.metadata().map_err(LogError::io(path, "read"))?.len();
        let mut magic = [0; 8];
        let found = file.read(&mut magic).map_err(LogError::io(path, "read"))?;
        if found < 8 || magic != MAGIC {
            let reason = format!(
                "expected it to start with 89 4d 43 41 50, found {:02x?}",
                &magic[..found.min(5)]
            );
            return Err(LogError::NotMcap {
                path: path.into(),
                reason,
            });
        }
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
        })
    }

    /// Reads the summary; `None` if the file has none, or one that does not lead to its messages.
    fn by_index(path: &Path, file: &mut File, size: u64) -> Result<Option<Self>, LogError> {
        let Some(summary) = read_summary(file, size) else {
            return Ok(None);
        };
        let Some(stats) = &summary.stats else { return Ok(None) };
        let whole = summary.chunk_indexes.len() == stats.chunk_count as usize
            && summary.metadata_indexes.len() == stats.metadata_count as usize
            && stats
                .channel_message_counts
                .keys()
                .all(|id| summary.channels.contains_key(id))
            && (stats.message_count == 0 || stats.chunk_count > 0);
        if !whole {
            return Ok(None);
        }
        let channel = |channel: &mcap::Channel| ChannelInfo {
            topic: channel.topic.clone(),
            schema: channel
                .schema
                .as_ref()
                .map(|schema| schema.name.clone())
                .unwrap_or_default(),
            encoding: channel.message_encoding.clone(),
            messages: stats.channel_message_counts.get(&channel.id).copied().unwrap_or(0),
        };
        let spans = summary.chunk_indexes.iter().map(|chunk| Span {
            first: chunk.message_start_time,
            last: chunk.message_end_time,
            offset: chunk.chunk_start_offset,
            length: chunk.chunk_length,
            channels: Some(chunk.message_index_offsets.keys().copied().collect())
                .filter(|channels: &BTreeSet<u16>| !channels.is_empty()),
        });
        let mut metadata = BTreeMap::new();
        for index in &summary.metadata_indexes {
            let bytes = read_at(file, index.offset, index.length, size)
                .map_err(|reason| LogError::damaged(path, index.offset, reason))?;
            if let Ok(Record::Metadata(record)) = parse(&bytes) {
                metadata.insert(record.name, record.metadata);
            }
        }
        let has = stats.message_count > 0;
        Ok(Some(McapFile {
            path: path.into(),
            channels: summary
                .channels
                .iter()
                .map(|(id, known)| (*id, channel(known)))
                .collect(),
            metadata,
            spans: Arc::new(sorted(spans.collect())),
            first: has.then_some(stats.message_start_time),
            last: has.then_some(stats.message_end_time),
            truncation: None,
        }))
    }
}

fn sorted(mut spans: Vec<Span>) -> Vec<Span> {
    spans.sort_by_key(|span| (span.first, span.offset));
    spans
}

fn read_summary(file: &mut File, size: u64) -> Option<mcap::Summary> {
    let mut reader = SummaryReader::new_with_options(SummaryReaderOptions::default().with_file_size(size));
    while let Some(event) = reader.next_event() {
        match event.ok()? {
            SummaryReadEvent::SeekRequest(to) => {
                let at = file.seek(to).ok()?;
                reader.notify_seeked(at);
            }
            SummaryReadEvent::ReadRequest(wanted) => {
                let read = file.read(reader.insert(wanted)).ok()?;
                reader.notify_read(read);
            }
        }
    }
    reader.finish()
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

/// Parses a record with its head.
fn parse(bytes: &[u8]) -> Result<Record<'_>, String> {
    let Some((opcode, rest)) = bytes.split_first() else {
        return Err("an empty record".into());
    };
    let body = rest.get(8..).ok_or("a record without length")?;
    if *opcode == op::ATTACHMENT {
        return Err("attachments are not read".into());
    }
    mcap::parse_record(*opcode, body).map_err(|error| error.to_string())
}

/// The records of a chunk as (opcode, body range).
fn records(data: &[u8]) -> impl Iterator<Item = Result<(u8, Range<usize>), String>> + '_ {
    let mut at = 0;
    std::iter::from_fn(move || {
        if at == data.len() {
            return None;
        }
        let head = data.get(at..at + RECORD_HEAD as usize);
        let record = head.and_then(|head| {
            let length = u64::from_le_bytes(std::array::from_fn(|i| head[i + 1]));
            let start = at + RECORD_HEAD as usize;
            let end = usize::try_from(length)
                .ok()
                .and_then(|length| start.checked_add(length))?;
            (end <= data.len()).then_some((head[0], start..end))
        });
        Some(match record {
            Some((opcode, body)) => {
                at = body.end;
                Ok((opcode, body))
            }
            None => {
                let error = format!(
                    "a record at byte {at} of a chunk reaches beyond its {} bytes",
                    data.len()
                );
                at = data.len();
                Err(error)
            }
        })
    })
}

/// The records of a chunk record, decompressed and checked.
fn unpack(bytes: &[u8]) -> Result<Vec<u8>, String> {
    let Record::Chunk { header, data } = parse(bytes)? else {
        return Err("expected a chunk here".into());
    };
    if header.uncompressed_size > MAX_CHUNK {
        return Err(format!(
            "a chunk of {} bytes, more than {MAX_CHUNK}",
            header.uncompressed_size
        ));
    }
    let size = header.uncompressed_size as usize;
    let records = match header.compression.as_str() {
        "" => data.to_vec(),
        "zstd" => zstd::bulk::decompress(&data, size).map_err(|error| format!("zstd: {error}"))?,
        _ => by_crate(bytes, size)?,
    };
    if records.len() != size {
        return Err(format!("a chunk of {} bytes, its head says {size}", records.len()));
    }
    let crc = header.uncompressed_crc;
    if crc != 0 && crc != crc32fast::hash(&records) {
        return Err("a chunk's checksum is wrong".into());
    }
    Ok(records)
}

/// Other compressions, by the `mcap` crate.
fn by_crate(chunk: &[u8], size: usize) -> Result<Vec<u8>, String> {
    use mcap::sans_io::{LinearReadEvent, LinearReader, LinearReaderOptions};
    let options = LinearReaderOptions::default()
        .with_skip_start_magic(true)
        .with_skip_end_magic(true);
    let mut reader = LinearReader::new_with_options(options);
    let mut out = Vec::with_capacity(size);
    let mut left = chunk;
    while let Some(event) = reader.next_event() {
        match event.map_err(|error| error.to_string())? {
            LinearReadEvent::ReadRequest(wanted) => {
                let n = wanted.min(left.len());
                reader.insert(wanted)[..n].copy_from_slice(&left[..n]);
                reader.notify_read(n);
                left = &left[n..];
            }
            LinearReadEvent::Record { opcode, data } => {
                out.push(opcode);
                out.extend((data.len() as u64).to_le_bytes());
                out.extend_from_slice(data);
            }
        }
    }
    Ok(out)
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
    /// Whether the record behind the last message was found.
    all_data: bool,
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

    /// Reads a record; false after the last one, an error where the file is cut.
    fn step(&mut self) -> Result<bool, String> {
        let mut head = [0; RECORD_HEAD as usize];
        if self.at == self.size {
            return Err("the index at the end is missing".into());
        }
        self.file
            .read_exact(&mut head)
            .map_err(|_| "the file ends within a record's head".to_string())?;
        let opcode = head[0];
        let length = u64::from_le_bytes(std::array::from_fn(|i| head[i + 1]));
        if length > self.size - self.at - RECORD_HEAD {
            return Err("the file ends within a record".into());
        }
        let skipped = matches!(opcode, op::ATTACHMENT | op::MESSAGE_INDEX);
        if skipped {
            self.file
                .seek_relative(length as i64)
                .map_err(|error| error.to_string())?;
        } else {
            let mut bytes = vec![0; (RECORD_HEAD + length) as usize];
            bytes[..RECORD_HEAD as usize].copy_from_slice(&head);
            self.file
                .read_exact(&mut bytes[RECORD_HEAD as usize..])
                .map_err(|error| error.to_string())?;
            if opcode == op::FOOTER {
                return Ok(false);
            }
            self.note(opcode, &bytes)?;
        }
        self.at += RECORD_HEAD + length;
        Ok(true)
    }

    fn note(&mut self, opcode: u8, bytes: &[u8]) -> Result<(), String> {
        let length = bytes.len() as u64;
        match opcode {
            op::CHUNK => {
                let records_of_chunk = unpack(bytes)?;
                let mut span = Span {
                    first: 0,
                    last: 0,
                    offset: self.at,
                    length,
                    channels: Some(BTreeSet::new()),
                };
                for record in records(&records_of_chunk) {
                    let (opcode, body) = record?;
                    self.note_inner(
                        opcode,
                        &records_of_chunk[body.start - RECORD_HEAD as usize..body.end],
                        &mut span,
                    )?;
                }
                self.spans.push(span);
            }
            op::MESSAGE => {
                let mut span = Span {
                    first: 0,
                    last: 0,
                    offset: self.at,
                    length,
                    channels: Some(BTreeSet::new()),
                };
                self.note_inner(opcode, bytes, &mut span)?;
                self.spans.push(span);
            }
            _ => {
                let mut none = Span {
                    first: 0,
                    last: 0,
                    offset: 0,
                    length: 0,
                    channels: None,
                };
                self.note_inner(opcode, bytes, &mut none)?;
            }
        }
        Ok(())
    }

    fn note_inner(&mut self, opcode: u8, bytes: &[u8], span: &mut Span) -> Result<(), String> {
        if opcode == op::MESSAGE {
            let (channel, _, time, _) = message_head(&bytes[RECORD_HEAD as usize..])?;
            let channels = span.channels.get_or_insert_default();
            (span.first, span.last) = match channels.is_empty() {
                true => (time, time),
                false => (span.first.min(time), span.last.max(time)),
            };
            channels.insert(channel);
            self.lanes.entry(self.lane_of(channel)).or_default().note(time);
            *self.counts.entry(channel).or_default() += 1;
            return Ok(());
        }
        match parse(bytes)? {
            Record::Schema { header, .. } => {
                self.schemas.insert(header.id, header.name);
            }
            Record::Channel(channel) => {
                let info = ChannelInfo {
                    topic: channel.topic,
                    schema: String::new(),
                    encoding: channel.message_encoding,
                    messages: 0,
                };
                self.channels.insert(channel.id, (info, channel.schema_id));
            }
            Record::Metadata(record) => {
                self.metadata.insert(record.name, record.metadata);
            }
            Record::DataEnd(_) => self.all_data = true,
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

fn message_head(body: &[u8]) -> Result<(u16, u32, u64, u64), String> {
    if body.len() < MESSAGE_HEAD {
        return Err(format!(
            "a message of {} bytes, its head alone takes {MESSAGE_HEAD}",
            body.len()
        ));
    }
    let u64_at = |at: usize| u64::from_le_bytes(std::array::from_fn(|i| body[at + i]));
    let sequence = u32::from_le_bytes(std::array::from_fn(|i| body[2 + i]));
    Ok((u16::from_le_bytes([body[0], body[1]]), sequence, u64_at(6), u64_at(14)))
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

    fn load(&mut self, span: &Span) -> Result<(), LogError> {
        let damaged = |reason: String| LogError::damaged(&self.path, span.offset, reason);
        let size = self.file.metadata().map_err(LogError::io(&self.path, "read"))?.len();
        let bytes = read_at(&mut self.file, span.offset, span.length, size).map_err(damaged)?;
        let data = match bytes[0] {
            op::MESSAGE => bytes,
            _ => unpack(&bytes).map_err(damaged)?,
        };
        let chunk = Arc::new(data);
        for record in records(&chunk) {
            let (opcode, body) = record.map_err(damaged)?;
            if opcode != op::MESSAGE {
                continue;
            }
            let (channel, sequence, log_time, publish_time) = message_head(&chunk[body.clone()]).map_err(damaged)?;
            if self.channels.contains(&channel) && self.times.contains(&log_time) {
                let order = (span.offset, body.start);
                let body = body.start + MESSAGE_HEAD..body.end;
                let message = RawMessage {
                    channel,
                    sequence,
                    log_time,
                    publish_time,
                    chunk: chunk.clone(),
                    body,
                };
                self.heap.push(Reverse(Waiting(message, order)));
            }
        }
        Ok(())
    }
}
