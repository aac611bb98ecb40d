//! Writes MCAP with chunks compressed on several threads.
//!
//! The caller's thread appends messages to open chunks; workers compress full chunks; one thread writes them in the order
//! in which they were closed. So the bytes do not depend on the number of threads.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, Write};
use std::path::Path;
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Arc, Mutex};
use std::thread::{self, JoinHandle};

use mcap::records::op;

use crate::{LogError, Schema};

/// Closes a chunk that holds as many bytes.
const CHUNK_BYTES: usize = 1 << 20;
/// Closes chunks that span as much log time, so that a cut costs less than a second.
const CHUNK_NANOS: u64 = 500_000_000;
const COMPRESSION: &str = "zstd";
const LEVEL: i32 = 1;
/// What is added to the niceness of compressing threads.
const YIELDING: i32 = 10;
const MAGIC: [u8; 8] = *b"\x89MCAP0\r\n";

/// Where an MCAP goes.
pub trait Output: Write + Send + 'static {
    /// Drops what lies beyond `length`, as far as the output can.
    fn cut(&mut self, length: u64);
}

impl Output for File {
    fn cut(&mut self, length: u64) {
        // A file that cannot be shortened ends in part of a record, which readers expect of a cut file.
        let _ = self.set_len(length);
    }
}

/// A channel of a writer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ChannelId(u16);

/// Messages of different lanes never share a chunk, so that small ones can be read without decompressing clouds.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Lane {
    /// Everything but clouds and packets.
    Small,
    /// Clouds.
    Bulk,
    /// What agents send, computed beforehand.
    Packets,
}

impl Lane {
    const ALL: [Lane; 3] = [Lane::Small, Lane::Bulk, Lane::Packets];

    /// The lane of messages of a schema, by its name.
    pub fn of(schema: &str) -> Self {
        match Schema::named(schema) {
            Some(Schema::PointCloud2) => Lane::Bulk,
            Some(Schema::SentPacket) => Lane::Packets,
            _ => Lane::Small,
        }
    }
}

/// Why writing stopped.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Failure {
    /// Length of the readable part, bytes.
    pub written: u64,
    /// What the system said.
    pub reason: String,
}

impl Failure {
    /// The failure to write a file, as an error of this crate.
    pub fn of(self, path: &Path) -> LogError {
        LogError::Write {
            path: path.into(),
            written: self.written,
            reason: self.reason,
        }
    }

    /// The failure to write a file that appears only when it is complete.
    pub fn of_unfinished(self, target: &Path) -> LogError {
        LogError::Unfinished {
            path: target.into(),
            written: self.written,
            reason: self.reason,
        }
    }
}

struct Channel {
    lane: Lane,
    schema: u16,
    topic: String,
    count: u64,
    announced: bool,
}

#[derive(Default)]
struct OpenChunk {
    records: Vec<u8>,
    first: u64,
    last: u64,
    index: BTreeMap<u16, Vec<(u64, u64)>>,
}

/// Bytes for the file, and what the index must say of them.
struct Piece {
    bytes: Vec<u8>,
    /// A chunk's index entry; its offsets count from the start of the piece.
    chunk: Option<ChunkEntry>,
    /// Name of a metadata record.
    metadata: Option<String>,
}

struct ChunkEntry {
    first: u64,
    last: u64,
    length: u64,
    message_indexes: BTreeMap<u16, u64>,
    compressed: u64,
    uncompressed: u64,
}

type Packed = io::Result<Piece>;
type Work = (OpenChunk, SyncSender<Packed>);

/// A writer of one MCAP file.
pub struct McapWriter {
    channels: Vec<Channel>,
    schemas: Vec<Schema>,
    open: [OpenChunk; Lane::ALL.len()],
    span: Option<(u64, u64)>,
    work: Option<SyncSender<Work>>,
    order: Option<SyncSender<Receiver<Packed>>>,
    writer: Option<JoinHandle<Sheet>>,
    workers: Vec<JoinHandle<()>>,
    failure: Arc<Mutex<Option<Failure>>>,
}

impl McapWriter {
    /// Starts a file: profile `ros2`, and a metadata record right behind its head.
    ///
    /// # Errors
    /// If the system gives no threads.
    pub fn new(
        output: impl Output,
        program: &str,
        name: &str,
        metadata: &BTreeMap<String, String>,
    ) -> io::Result<Self> {
        let threads = thread::available_parallelism().map_or(2, |n| n.get()).clamp(1, 8);
        let (work, jobs) = sync_channel::<Work>(threads);
        let (order, pieces) = sync_channel(2 * threads);
        let jobs = Arc::new(Mutex::new(jobs));
        let failure = Arc::new(Mutex::new(None));
        let worker = |_| {
            let jobs = jobs.clone();
            thread::Builder::new()
                .name("log-compress".into())
                .spawn(move || compress_all(&jobs))
        };
        let workers = (0..threads).map(worker).collect::<io::Result<_>>()?;
        let seen = failure.clone();
        let writer = thread::Builder::new()
            .name("log-write".into())
            .spawn(move || Sheet::new(output, seen).run(&pieces))?;
        let mut mcap = McapWriter {
            channels: Vec::new(),
            schemas: Vec::new(),
            open: Default::default(),
            span: None,
            work: Some(work),
            order: Some(order),
            writer: Some(writer),
            workers,
            failure,
        };
        let mut head = MAGIC.to_vec();
        record(&mut head, op::HEADER, |out| {
            text(out, "ros2");
            text(out, program);
        });
        mcap.send(Piece {
            bytes: head,
            chunk: None,
            metadata: None,
        });
        mcap.metadata(name, metadata);
        Ok(mcap)
    }

    /// The channel of a topic; its records are written with its first message.
    pub fn channel(&mut self, topic: &str, schema: Schema, lane: Lane) -> ChannelId {
        let schema = match self.schemas.iter().position(|known| *known == schema) {
            Some(at) => at,
            None => {
                self.schemas.push(schema);
                self.schemas.len() - 1
            }
        };
        let id = self.channels.len() as u16;
        self.channels.push(Channel {
            lane,
            schema: schema as u16 + 1,
            topic: topic.into(),
            count: 0,
            announced: false,
        });
        ChannelId(id)
    }

    /// Adds a message, numbered per channel from 0; `encode` appends its payload. Returns its number.
    ///
    /// # Errors
    /// Why an earlier chunk could not be written.
    pub fn write(
        &mut self,
        channel: ChannelId,
        log_time: u64,
        publish_time: u64,
        encode: impl FnOnce(&mut Vec<u8>),
    ) -> Result<u64, Failure> {
        let ChannelId(id) = channel;
        let number = self.channels[usize::from(id)].count;
        self.put(channel, number as u32, log_time, publish_time, encode)?;
        Ok(number)
    }

    /// Adds a message of another file as it is, with its number there.
    ///
    /// # Errors
    /// As [`McapWriter::write`].
    pub fn copy(
        &mut self,
        channel: ChannelId,
        number: u32,
        log_time: u64,
        publish_time: u64,
        data: &[u8],
    ) -> Result<(), Failure> {
        self.put(channel, number, log_time, publish_time, |out| {
            out.extend_from_slice(data)
        })
    }

    fn put(
        &mut self,
        channel: ChannelId,
        number: u32,
        log_time: u64,
        publish_time: u64,
        encode: impl FnOnce(&mut Vec<u8>),
    ) -> Result<(), Failure> {
        let too_long = |open: &OpenChunk| !open.records.is_empty() && open.span_with(log_time) >= CHUNK_NANOS;
        if self.open.iter().any(too_long) {
            self.flush()?;
        }
        self.announce(channel);
        let ChannelId(id) = channel;
        let known = &mut self.channels[usize::from(id)];
        known.count += 1;
        self.span = Some(
            self.span
                .map_or((log_time, log_time), |(a, b)| (a.min(log_time), b.max(log_time))),
        );
        let lane = known.lane;
        let open = &mut self.open[lane as usize];
        open.note(id, log_time);
        record(&mut open.records, op::MESSAGE, |out| {
            out.extend(id.to_le_bytes());
            out.extend(number.to_le_bytes());
            out.extend(log_time.to_le_bytes());
            out.extend(publish_time.to_le_bytes());
            encode(out);
        });
        if open.records.len() >= CHUNK_BYTES {
            self.close(lane);
        }
        self.check()
    }

    /// Adds a metadata record behind what was written so far.
    pub fn metadata(&mut self, name: &str, entries: &BTreeMap<String, String>) {
        self.close_all();
        let mut bytes = Vec::new();
        record(&mut bytes, op::METADATA, |out| {
            text(out, name);
            string_map(out, entries);
        });
        self.send(Piece {
            bytes,
            chunk: None,
            metadata: Some(name.into()),
        });
    }

    /// Closes the open chunks; they reach the file without further calls.
    ///
    /// # Errors
    /// Why an earlier chunk could not be written.
    pub fn flush(&mut self) -> Result<(), Failure> {
        self.close_all();
        self.check()
    }

    /// First and last log time of what was written.
    pub fn span(&self) -> Option<(u64, u64)> {
        self.span
    }

    /// Writes what is open, the index and the footer.
    ///
    /// # Errors
    /// Why something could not be written.
    pub fn finish(mut self) -> Result<(), Failure> {
        self.flush()?;
        let Some(mut sheet) = self.join() else {
            return Err(Failure {
                written: 0,
                reason: "the writing thread stopped".into(),
            });
        };
        self.check()?;
        sheet.write_end(&self);
        self.check()
    }

    fn join(&mut self) -> Option<Sheet> {
        self.order = None;
        self.work = None;
        for worker in self.workers.drain(..) {
            let _ = worker.join();
        }
        self.writer.take().and_then(|writer| writer.join().ok())
    }

    fn check(&self) -> Result<(), Failure> {
        self.failure
            .lock()
            .unwrap_or_else(|poisoned| poisoned.into_inner())
            .clone()
            .map_or(Ok(()), Err)
    }

    fn announce(&mut self, ChannelId(id): ChannelId) {
        let channel = &mut self.channels[usize::from(id)];
        if channel.announced {
            return;
        }
        channel.announced = true;
        let records = &mut self.open[channel.lane as usize].records;
        write_schema(records, channel.schema, self.schemas[usize::from(channel.schema) - 1]);
        write_channel(records, id, channel);
    }

    fn close_all(&mut self) {
        Lane::ALL.into_iter().for_each(|lane| self.close(lane));
    }

    fn close(&mut self, lane: Lane) {
        let open = std::mem::take(&mut self.open[lane as usize]);
        if open.records.is_empty() {
            return;
        }
        let (reply, piece) = sync_channel(1);
        let sent = self.work.as_ref().is_some_and(|work| work.send((open, reply)).is_ok());
        if sent && let Some(order) = &self.order {
            let _ = order.send(piece);
        }
    }

    fn send(&mut self, piece: Piece) {
        let (reply, receiver) = sync_channel(1);
        let _ = reply.send(Ok(piece));
        if let Some(order) = &self.order {
            let _ = order.send(receiver);
        }
    }
}

impl Drop for McapWriter {
    /// Without `finish` there is no index, but every message reaches the output.
    fn drop(&mut self) {
        if self.writer.is_some() {
            let _ = self.flush();
            self.join();
        }
    }
}

impl OpenChunk {
    fn span_with(&self, time: u64) -> u64 {
        match self.index.is_empty() {
            true => 0,
            false => self.last.max(time) - self.first.min(time),
        }
    }

    fn note(&mut self, channel: u16, time: u64) {
        let offset = self.records.len() as u64;
        (self.first, self.last) = match self.index.is_empty() {
            true => (time, time),
            false => (self.first.min(time), self.last.max(time)),
        };
        self.index.entry(channel).or_default().push((time, offset));
    }
}

fn compress_all(jobs: &Mutex<Receiver<Work>>) {
    // What makes the data, online a whole perception, must not wait for this. Where the system refuses, it may have to.
    let _ = rustix::process::nice(YIELDING);
    loop {
        let job = match jobs.lock() {
            Ok(jobs) => jobs.recv(),
            Err(_) => return,
        };
        match job {
            Ok((chunk, reply)) => {
                let _ = reply.send(compress(chunk));
            }
            Err(_) => return,
        }
    }
}

fn compress(chunk: OpenChunk) -> Packed {
    let packed = zstd::bulk::compress(&chunk.records, LEVEL)?;
    let mut bytes = Vec::with_capacity(packed.len() + 64 * chunk.index.len() + 128);
    record(&mut bytes, op::CHUNK, |out| {
        out.extend(chunk.first.to_le_bytes());
        out.extend(chunk.last.to_le_bytes());
        out.extend((chunk.records.len() as u64).to_le_bytes());
        out.extend(crc32fast::hash(&chunk.records).to_le_bytes());
        text(out, COMPRESSION);
        out.extend((packed.len() as u64).to_le_bytes());
        out.extend_from_slice(&packed);
    });
    let length = bytes.len() as u64;
    let mut message_indexes = BTreeMap::new();
    for (channel, entries) in &chunk.index {
        message_indexes.insert(*channel, bytes.len() as u64);
        record(&mut bytes, op::MESSAGE_INDEX, |out| {
            out.extend(channel.to_le_bytes());
            out.extend((16 * entries.len() as u32).to_le_bytes());
            for (time, offset) in entries {
                out.extend(time.to_le_bytes());
                out.extend(offset.to_le_bytes());
            }
        });
    }
    let entry = ChunkEntry {
        first: chunk.first,
        last: chunk.last,
        length,
        message_indexes,
        compressed: packed.len() as u64,
        uncompressed: chunk.records.len() as u64,
    };
    Ok(Piece {
        bytes,
        chunk: Some(entry),
        metadata: None,
    })
}

/// The file, and what its index will say.
struct Sheet {
    output: Box<dyn Output>,
    at: u64,
    data_crc: crc32fast::Hasher,
    chunks: Vec<(u64, u64, ChunkEntry)>,
    metadata: Vec<(u64, u64, String)>,
    failure: Arc<Mutex<Option<Failure>>>,
}

impl Sheet {
    fn new(output: impl Output, failure: Arc<Mutex<Option<Failure>>>) -> Self {
        Sheet {
            output: Box::new(output),
            at: 0,
            data_crc: crc32fast::Hasher::new(),
            chunks: Vec::new(),
            metadata: Vec::new(),
            failure,
        }
    }

    fn run(mut self, pieces: &Receiver<Receiver<Packed>>) -> Self {
        let mut good = true;
        while let Ok(piece) = pieces.recv() {
            // After a failure the queue is emptied, so that nobody waits for it.
            good = good && self.put_next(&piece);
        }
        self
    }

    fn put_next(&mut self, piece: &Receiver<Packed>) -> bool {
        let piece = match piece.recv() {
            Ok(Ok(piece)) => piece,
            Ok(Err(error)) => return self.fail(format!("compressing a chunk: {error}")),
            Err(_) => return self.fail("a compressing thread stopped".into()),
        };
        let start = self.at;
        if !self.put(&piece.bytes) {
            return false;
        }
        self.data_crc.update(&piece.bytes);
        let length = self.at - start;
        if let Some(entry) = piece.chunk {
            self.chunks.push((start, length, entry));
        }
        if let Some(name) = piece.metadata {
            self.metadata.push((start, length, name));
        }
        true
    }

    fn put(&mut self, bytes: &[u8]) -> bool {
        match self.output.write_all(bytes).and_then(|()| self.output.flush()) {
            Ok(()) => {
                self.at += bytes.len() as u64;
                true
            }
            Err(error) => {
                self.output.cut(self.at);
                self.fail(error.to_string())
            }
        }
    }

    fn fail(&self, reason: String) -> bool {
        let mut failure = self.failure.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
        failure.get_or_insert(Failure {
            written: self.at,
            reason,
        });
        false
    }

    fn write_end(&mut self, mcap: &McapWriter) {
        let mut end = Vec::new();
        record(&mut end, op::DATA_END, |out| {
            out.extend(self.data_crc.clone().finalize().to_le_bytes())
        });
        let base = self.at + end.len() as u64;
        let mut summary = Vec::new();
        let mut groups = Vec::new();
        let mut group = |summary: &mut Vec<u8>, opcode: u8, fill: &mut dyn FnMut(&mut Vec<u8>)| {
            let start = summary.len() as u64;
            fill(summary);
            let length = summary.len() as u64 - start;
            if length > 0 {
                groups.push((opcode, base + start, length));
            }
        };
        group(&mut summary, op::SCHEMA, &mut |out| {
            for (index, schema) in mcap.schemas.iter().enumerate() {
                write_schema(out, index as u16 + 1, *schema);
            }
        });
        let used = || {
            mcap.channels
                .iter()
                .enumerate()
                .filter(|(_, channel)| channel.count > 0)
        };
        group(&mut summary, op::CHANNEL, &mut |out| {
            used().for_each(|(id, channel)| write_channel(out, id as u16, channel));
        });
        group(&mut summary, op::STATISTICS, &mut |out| {
            self.write_statistics(out, mcap)
        });
        group(&mut summary, op::CHUNK_INDEX, &mut |out| {
            for (start, length, entry) in &self.chunks {
                write_chunk_index(out, *start, *length, entry);
            }
        });
        group(&mut summary, op::METADATA_INDEX, &mut |out| {
            for (start, length, name) in &self.metadata {
                record(out, op::METADATA_INDEX, |out| {
                    out.extend(start.to_le_bytes());
                    out.extend(length.to_le_bytes());
                    text(out, name);
                });
            }
        });
        let offsets = base + summary.len() as u64;
        for (opcode, start, length) in groups {
            record(&mut summary, op::SUMMARY_OFFSET, |out| {
                out.push(opcode);
                out.extend(start.to_le_bytes());
                out.extend(length.to_le_bytes());
            });
        }
        // The footer's checksum covers itself up to the checksum.
        summary.push(op::FOOTER);
        summary.extend(20u64.to_le_bytes());
        summary.extend(base.to_le_bytes());
        summary.extend(offsets.to_le_bytes());
        summary.extend(crc32fast::hash(&summary).to_le_bytes());
        summary.extend(MAGIC);
        end.extend(summary);
        self.put(&end);
    }

    fn write_statistics(&self, out: &mut Vec<u8>, mcap: &McapWriter) {
        let (first, last) = mcap.span.unwrap_or_default();
        let used: Vec<(u16, u64)> = mcap
            .channels
            .iter()
            .enumerate()
            .map(|(id, c)| (id as u16, c.count))
            .collect();
        let used: Vec<(u16, u64)> = used.into_iter().filter(|(_, count)| *count > 0).collect();
        record(out, op::STATISTICS, |out| {
            out.extend(used.iter().map(|(_, count)| count).sum::<u64>().to_le_bytes());
            out.extend((mcap.schemas.len() as u16).to_le_bytes());
            out.extend((used.len() as u32).to_le_bytes());
            out.extend(0u32.to_le_bytes());
            out.extend((self.metadata.len() as u32).to_le_bytes());
            out.extend((self.chunks.len() as u32).to_le_bytes());
            out.extend(first.to_le_bytes());
            out.extend(last.to_le_bytes());
            out.extend((10 * used.len() as u32).to_le_bytes());
            for (id, count) in &used {
                out.extend(id.to_le_bytes());
                out.extend(count.to_le_bytes());
            }
        });
    }
}

fn write_chunk_index(out: &mut Vec<u8>, start: u64, piece_length: u64, entry: &ChunkEntry) {
    record(out, op::CHUNK_INDEX, |out| {
        out.extend(entry.first.to_le_bytes());
        out.extend(entry.last.to_le_bytes());
        out.extend(start.to_le_bytes());
        out.extend(entry.length.to_le_bytes());
        out.extend((10 * entry.message_indexes.len() as u32).to_le_bytes());
        for (channel, offset) in &entry.message_indexes {
            out.extend(channel.to_le_bytes());
            out.extend((start + offset).to_le_bytes());
        }
        out.extend((piece_length - entry.length).to_le_bytes());
        text(out, COMPRESSION);
        out.extend(entry.compressed.to_le_bytes());
        out.extend(entry.uncompressed.to_le_bytes());
    });
}

fn write_schema(out: &mut Vec<u8>, id: u16, schema: Schema) {
    record(out, op::SCHEMA, |out| {
        out.extend(id.to_le_bytes());
        text(out, &schema.name());
        text(out, "ros2msg");
        text(out, &schema.text());
    });
}

fn write_channel(out: &mut Vec<u8>, id: u16, channel: &Channel) {
    record(out, op::CHANNEL, |out| {
        out.extend(id.to_le_bytes());
        out.extend(channel.schema.to_le_bytes());
        text(out, &channel.topic);
        text(out, "cdr");
        out.extend(0u32.to_le_bytes());
    });
}

fn record(out: &mut Vec<u8>, opcode: u8, fill: impl FnOnce(&mut Vec<u8>)) {
    out.push(opcode);
    let length_at = out.len();
    out.extend([0; 8]);
    fill(out);
    let length = (out.len() - length_at - 8) as u64;
    out[length_at..length_at + 8].copy_from_slice(&length.to_le_bytes());
}

fn text(out: &mut Vec<u8>, text: &str) {
    out.extend((text.len() as u32).to_le_bytes());
    out.extend_from_slice(text.as_bytes());
}

fn string_map(out: &mut Vec<u8>, entries: &BTreeMap<String, String>) {
    let bytes: usize = entries.iter().map(|(key, value)| 8 + key.len() + value.len()).sum();
    out.extend((bytes as u32).to_le_bytes());
    for (key, value) in entries {
        text(out, key);
        text(out, value);
    }
}
