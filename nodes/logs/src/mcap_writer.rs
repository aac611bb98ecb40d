//! Writes MCAP with chunks compressed on several threads.
//!
//! The caller's thread appends messages to open chunks; workers compress full chunks; one thread writes them in the order
//! in which they were closed. So the bytes do not depend on the number of threads.

mod chunk;
mod failure;
mod parts;
mod sheet;

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, Write};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Arc, Mutex};
use std::thread::{self, JoinHandle};

use mcap::records::op;

use crate::Schema;
use chunk::{ChunkEntry, OpenChunk, compress_all};
pub use failure::Failure;
use parts::{record, string_map, text, write_channel, write_schema};
use sheet::Sheet;

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

/// Messages of different groups never share a chunk, so that small ones can be read without decompressing clouds.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum ChunkGroup {
    /// Everything but clouds and packets.
    Small,
    /// Clouds.
    Bulk,
    /// What agents send, computed beforehand.
    Packets,
}

impl ChunkGroup {
    const ALL: [ChunkGroup; 3] = [ChunkGroup::Small, ChunkGroup::Bulk, ChunkGroup::Packets];

    /// The group of messages of a schema, by its name.
    pub fn of(schema: &str) -> Self {
        match Schema::named(schema) {
            Some(Schema::PointCloud2) => ChunkGroup::Bulk,
            Some(Schema::SentPacket) => ChunkGroup::Packets,
            _ => ChunkGroup::Small,
        }
    }
}

struct Channel {
    group: ChunkGroup,
    schema: u16,
    topic: String,
    count: u64,
    announced: bool,
}

/// Bytes for the file, and what the index must say of them.
struct Piece {
    bytes: Vec<u8>,
    /// A chunk's index entry; its offsets count from the start of the piece.
    chunk: Option<ChunkEntry>,
    /// Name of a metadata record.
    metadata: Option<String>,
}

type Packed = io::Result<Piece>;
type Work = (OpenChunk, SyncSender<Packed>);

/// A writer of one MCAP file.
pub struct McapWriter {
    channels: Vec<Channel>,
    schemas: Vec<Schema>,
    open: [OpenChunk; ChunkGroup::ALL.len()],
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
    pub fn channel(&mut self, topic: &str, schema: Schema, group: ChunkGroup) -> ChannelId {
        let schema = match self.schemas.iter().position(|known| *known == schema) {
            Some(at) => at,
            None => {
                self.schemas.push(schema);
                self.schemas.len() - 1
            }
        };
        let id = self.channels.len() as u16;
        self.channels.push(Channel {
            group,
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
        let group = known.group;
        let open = &mut self.open[group as usize];
        open.note(id, log_time);
        record(&mut open.records, op::MESSAGE, |out| {
            out.extend(id.to_le_bytes());
            out.extend(number.to_le_bytes());
            out.extend(log_time.to_le_bytes());
            out.extend(publish_time.to_le_bytes());
            encode(out);
        });
        if open.records.len() >= CHUNK_BYTES {
            self.close(group);
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
        let records = &mut self.open[channel.group as usize].records;
        write_schema(records, channel.schema, self.schemas[usize::from(channel.schema) - 1]);
        write_channel(records, id, channel);
    }

    fn close_all(&mut self) {
        ChunkGroup::ALL.into_iter().for_each(|group| self.close(group));
    }

    fn close(&mut self, group: ChunkGroup) {
        let open = std::mem::take(&mut self.open[group as usize]);
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
