//! Bags of ROS 1, format 2.0: records of heads and data, messages in chunks.
//!
//! The index at the end is not needed: the records are read in their order, and the index behind each chunk says what is in it. So a
//! bag that was not closed, or was cut, gives all of its whole chunks.

mod messages;
mod record;

use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::io::{BufReader, Read};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use realo_schemas::Nanos;

use self::messages::InOrder;
use self::record::{Head, Op, records};
use crate::pack::Packing;
use crate::source::plain_kind;
use crate::{Bag, BagError, Connection, Encoding, Messages};

/// How a bag of ROS 1 begins.
pub(crate) const MAGIC: &[u8] = b"#ROSBAG V";
const VERSION: &[u8] = b"#ROSBAG V2.0\n";
/// No head of a record is longer, bytes.
const LONGEST_HEAD: u64 = 1 << 20;
/// Bytes of an entry of the index behind a chunk: time and offset.
const ENTRY: usize = 12;

/// An open bag of ROS 1.
pub(crate) struct Rosbag1 {
    path: PathBuf,
    connections: Vec<Connection>,
    chunks: Arc<Vec<Chunk>>,
    /// Numbers of the file's connections, as places in `connections`.
    known: Arc<BTreeMap<u32, usize>>,
    notes: Vec<String>,
}

/// A chunk, or a message outside of chunks.
#[derive(Clone, Debug)]
struct Chunk {
    /// Where its packed bytes are.
    offset: u64,
    packed: u64,
    unpacked: u64,
    packing: Packing,
    first: Nanos,
    last: Nanos,
    /// Messages by the number of their connection; `None` until somebody knows.
    counts: Option<BTreeMap<u32, u64>>,
}

impl Rosbag1 {
    pub fn open(path: &Path) -> Result<Self, BagError> {
        let mut scan = Scan::new(path)?;
        let end = scan.run()?;
        scan.finish(end)
    }
}

impl Bag for Rosbag1 {
    fn path(&self) -> &Path {
        &self.path
    }

    fn format(&self) -> &'static str {
        "bag of ROS 1"
    }

    fn connections(&self) -> &[Connection] {
        &self.connections
    }

    fn span(&self) -> Option<[Nanos; 2]> {
        let full = || self.chunks.iter().filter(|chunk| chunk.first <= chunk.last);
        let first = full().map(|chunk| chunk.first).min()?;
        Some([first, full().map(|chunk| chunk.last).max()?])
    }

    fn notes(&self) -> &[String] {
        &self.notes
    }

    fn messages(&self, wanted: &BTreeSet<usize>) -> Result<Box<dyn Messages + '_>, BagError> {
        let known = self.known.iter().filter(|(_, place)| wanted.contains(place));
        let wanted: BTreeMap<u32, usize> = known.map(|(id, place)| (*id, *place)).collect();
        Ok(Box::new(InOrder::new(&self.path, self.chunks.clone(), wanted)?))
    }
}

/// Goes through the records of a file.
struct Scan {
    path: PathBuf,
    file: BufReader<File>,
    size: u64,
    at: u64,
    chunks: Vec<Chunk>,
    /// Topic and type by number.
    known: BTreeMap<u32, (String, String)>,
    is_closed: bool,
    expected_chunks: u64,
}

impl Scan {
    fn new(path: &Path) -> Result<Self, BagError> {
        let mut file = File::open(path).map_err(BagError::io(path))?;
        let size = file.metadata().map_err(BagError::io(path))?.len();
        let mut magic = Vec::new();
        let mut head = Read::by_ref(&mut file).take(VERSION.len() as u64);
        head.read_to_end(&mut magic).map_err(BagError::io(path))?;
        if magic != VERSION {
            let found = String::from_utf8_lossy(&magic);
            let reason = format!(
                "expected `#ROSBAG V2.0`, found `{}`; bring an older bag to this version with `rosbag fix`, or fetch the file anew",
                found.trim_end().escape_debug()
            );
            return Err(BagError::content(path, reason));
        }
        Ok(Scan {
            path: path.into(),
            file: BufReader::new(file),
            size,
            at: VERSION.len() as u64,
            chunks: Vec::new(),
            known: BTreeMap::new(),
            is_closed: false,
            expected_chunks: 0,
        })
    }

    /// Reads record by record; gives why the file ends early, if it does.
    fn run(&mut self) -> Result<Option<String>, BagError> {
        while self.at < self.size {
            if let Err(reason) = self.record()? {
                return Ok(Some(format!("cut at byte {} of {} ({reason})", self.at, self.size)));
            }
        }
        Ok(None)
    }

    /// One record; the inner error says why it is not whole.
    fn record(&mut self) -> Result<Result<(), String>, BagError> {
        let begins = self.at;
        let mut at = self.at;
        let head = match self.block(&mut at, LONGEST_HEAD)? {
            Ok(head) => head,
            Err(reason) => return Ok(Err(format!("the head of a record {reason}"))),
        };
        let head = match Head::read(&head) {
            Ok(head) => head,
            Err(reason) => return Ok(Err(reason)),
        };
        let length = match self.length(&mut at)? {
            Ok(length) => length,
            Err(reason) => return Ok(Err(format!("a record {reason}"))),
        };
        let left = self.size - at;
        if length > left {
            return Ok(Err(format!("a record of {length} bytes, {left} are there")));
        }
        let end = at + length;
        let read = match head.op {
            Op::Chunk => self.chunk(&head, at, length),
            Op::Message => self.loose_message(&head, begins, end),
            Op::Index | Op::Connection => {
                let mut data = vec![0; length as usize];
                self.file.read_exact(&mut data).map_err(BagError::io(&self.path))?;
                match head.op {
                    Op::Index => self.index(&head, &data),
                    _ => self.connection(&head, &data),
                }
            }
            Op::Bag => {
                self.is_closed = head.u64("index_pos").is_ok_and(|position| position > 0);
                self.expected_chunks = head.u32("chunk_count").map_or(0, u64::from);
                Ok(())
            }
            Op::Other => Ok(()),
        };
        if let Err(reason) = read {
            return Ok(Err(reason));
        }
        if !matches!(head.op, Op::Index | Op::Connection) {
            self.file
                .seek_relative(length as i64)
                .map_err(BagError::io(&self.path))?;
        }
        self.at = end;
        Ok(Ok(()))
    }

    fn length(&mut self, at: &mut u64) -> Result<Result<u64, String>, BagError> {
        if self.size - *at < 4 {
            return Ok(Err("has no length".into()));
        }
        let mut length = [0; 4];
        self.file.read_exact(&mut length).map_err(BagError::io(&self.path))?;
        *at += 4;
        Ok(Ok(u32::from_le_bytes(length).into()))
    }

    fn block(&mut self, at: &mut u64, most: u64) -> Result<Result<Vec<u8>, String>, BagError> {
        let length = match self.length(at)? {
            Ok(length) => length,
            Err(reason) => return Ok(Err(reason)),
        };
        let left = self.size - *at;
        if length > left.min(most) {
            return Ok(Err(format!(
                "has {length} bytes, at most {} can be there",
                left.min(most)
            )));
        }
        let mut bytes = vec![0; length as usize];
        self.file.read_exact(&mut bytes).map_err(BagError::io(&self.path))?;
        *at += length;
        Ok(Ok(bytes))
    }

    fn chunk(&mut self, head: &Head, offset: u64, packed: u64) -> Result<(), String> {
        let compression = head.text("compression")?;
        let packing = Packing::of_chunk(compression).ok_or_else(|| {
            format!(
                "a chunk's `compression` is `{}`, expected none, bz2 or lz4; write the bag anew with one of these",
                compression.escape_debug()
            )
        })?;
        // A chunk that was still being written has length 0, and its records follow.
        if packed > 0 {
            self.chunks.push(Chunk {
                offset,
                packed,
                unpacked: head.u32("size")?.into(),
                packing,
                first: Nanos::MAX,
                last: Nanos::MIN,
                counts: None,
            });
        }
        Ok(())
    }

    fn loose_message(&mut self, head: &Head, begins: u64, end: u64) -> Result<(), String> {
        let (connection, time) = (head.u32("conn")?, head.time("time")?);
        self.chunks.push(Chunk {
            offset: begins,
            packed: end - begins,
            unpacked: end - begins,
            packing: Packing::Plain,
            first: time,
            last: time,
            counts: Some(BTreeMap::from([(connection, 1)])),
        });
        Ok(())
    }

    fn index(&mut self, head: &Head, data: &[u8]) -> Result<(), String> {
        let (connection, version) = (head.u32("conn")?, head.u32("ver")?);
        let Some(chunk) = self.chunks.last_mut() else {
            return Ok(());
        };
        if version != 1 {
            return Err(format!("an index whose `ver` is {version}, expected 1"));
        }
        let counts = chunk.counts.get_or_insert_default();
        for entry in data.chunks_exact(ENTRY) {
            let time = record::time(std::array::from_fn(|i| entry[i]));
            chunk.first = chunk.first.min(time);
            chunk.last = chunk.last.max(time);
        }
        *counts.entry(connection).or_default() += (data.len() / ENTRY) as u64;
        Ok(())
    }

    fn connection(&mut self, head: &Head, data: &[u8]) -> Result<(), String> {
        let id = head.u32("conn")?;
        let topic = head.text("topic")?.to_string();
        let kind = plain_kind(Head::fields(data)?.text("type")?);
        self.known.entry(id).or_insert((topic, kind));
        Ok(())
    }

    /// Looks into chunks that nothing describes, and joins the connections of each topic.
    fn finish(mut self, cut: Option<String>) -> Result<Rosbag1, BagError> {
        let mut notes = Vec::new();
        // Its index may be cut.
        if cut.is_some()
            && let Some(last) = self.chunks.last_mut()
        {
            last.counts = None;
        }
        let found = self.chunks.len() as u64;
        match (&cut, self.is_closed) {
            (Some(cut), _) => notes.push(format!(
                "{cut}; what is whole before it is read{}",
                match self.expected_chunks.checked_sub(found) {
                    Some(lost @ 1..) => format!(", {lost} of {} chunks are lost", self.expected_chunks),
                    _ => String::new(),
                }
            )),
            (None, false) => {
                notes.push("it was not closed: its last messages may be missing (`rosbag reindex` closes it)".into())
            }
            (None, true) => {}
        }
        let is_unknown = |chunk: &Chunk, known: &BTreeMap<u32, (String, String)>| match &chunk.counts {
            None => true,
            Some(counts) => counts.keys().any(|id| !known.contains_key(id)),
        };
        let mut damaged = Vec::new();
        for place in 0..self.chunks.len() {
            if is_unknown(&self.chunks[place], &self.known)
                && let Err(reason) = self.look_into(place)?
            {
                damaged.push(place);
                notes.push(format!(
                    "a chunk at byte {} is lost: {reason}",
                    self.chunks[place].offset
                ));
            }
        }
        for place in damaged.into_iter().rev() {
            self.chunks.remove(place);
        }
        let mut connections: Vec<Connection> = Vec::new();
        let mut known = BTreeMap::new();
        for (id, (topic, kind)) in &self.known {
            let place = connections
                .iter()
                .position(|other| other.topic == *topic && other.kind == *kind);
            let place = place.unwrap_or_else(|| {
                connections.push(Connection {
                    topic: topic.clone(),
                    kind: kind.clone(),
                    encoding: Encoding::Ros1,
                    messages: 0,
                });
                connections.len() - 1
            });
            known.insert(*id, place);
        }
        for (id, count) in self.chunks.iter().flat_map(|chunk| chunk.counts.iter().flatten()) {
            if let Some(place) = known.get(id) {
                connections[*place].messages += count;
            }
        }
        self.chunks.sort_by_key(|chunk| (chunk.first, chunk.offset));
        Ok(Rosbag1 {
            path: self.path,
            connections,
            chunks: Arc::new(self.chunks),
            known: Arc::new(known),
            notes,
        })
    }

    /// Reads the records of a chunk; the inner error says why they cannot be.
    fn look_into(&mut self, place: usize) -> Result<Result<(), String>, BagError> {
        let chunk = self.chunks[place].clone();
        let bytes = messages::bytes_of(self.file.get_mut(), &chunk).map_err(BagError::io(&self.path))?;
        Ok(bytes.and_then(|bytes| self.described(place, &bytes)))
    }

    fn described(&mut self, place: usize, bytes: &[u8]) -> Result<(), String> {
        let mut counts = BTreeMap::new();
        let (mut first, mut last) = (Nanos::MAX, Nanos::MIN);
        for record in records(bytes) {
            let (head, data) = record?;
            match head.op {
                Op::Connection => self.connection(&head, &bytes[data])?,
                Op::Message => {
                    let time = head.time("time")?;
                    (first, last) = (first.min(time), last.max(time));
                    *counts.entry(head.u32("conn")?).or_default() += 1;
                }
                _ => {}
            }
        }
        let chunk = &mut self.chunks[place];
        (chunk.first, chunk.last, chunk.counts) = (first, last, Some(counts));
        Ok(())
    }
}
