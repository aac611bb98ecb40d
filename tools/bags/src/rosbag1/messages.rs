//! Messages of a bag of ROS 1 in the order of time.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BinaryHeap};
use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom};
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Weak};

use realo_schemas::Nanos;

use super::Chunk;
use super::record::{Op, records};
use crate::pack::most_unpacked;
use crate::{BagError, Message, Messages};

/// The unpacked bytes of a chunk; the inner error says why they cannot be had.
pub fn bytes_of(file: &mut File, chunk: &Chunk) -> io::Result<Result<Vec<u8>, String>> {
    let size = file.metadata()?.len();
    if chunk.offset.checked_add(chunk.packed).is_none_or(|end| end > size) {
        return Ok(Err("it goes beyond the file".into()));
    }
    let mut packed = vec![0; chunk.packed as usize];
    file.seek(SeekFrom::Start(chunk.offset))?;
    file.read_exact(&mut packed)?;
    Ok(chunk.packing.unpack_to(&packed, chunk.unpacked))
}

/// Reads chunk by chunk; holds only those that overlap the current time.
pub struct InOrder {
    path: PathBuf,
    file: File,
    chunks: Arc<Vec<Chunk>>,
    next: usize,
    wanted: BTreeMap<u32, usize>,
    heap: BinaryHeap<Reverse<Waiting>>,
    held: Vec<Weak<Vec<u8>>>,
}

/// Time, then place in the file, then what is read.
type Waiting = (Nanos, (u64, usize), Body);

#[derive(PartialEq, Eq, PartialOrd, Ord)]
struct Body {
    connection: usize,
    begins: usize,
    ends: usize,
    bytes: Arc<Vec<u8>>,
}

impl InOrder {
    pub fn new(path: &Path, chunks: Arc<Vec<Chunk>>, wanted: BTreeMap<u32, usize>) -> Result<Self, BagError> {
        Ok(InOrder {
            path: path.into(),
            file: File::open(path).map_err(BagError::io(path))?,
            chunks,
            next: 0,
            wanted,
            heap: BinaryHeap::new(),
            held: Vec::new(),
        })
    }

    fn wants(&self, chunk: &Chunk) -> bool {
        let counts = chunk.counts.as_ref();
        counts.is_none_or(|counts| counts.keys().any(|id| self.wanted.contains_key(id)))
    }

    fn load(&mut self, chunk: &Chunk) -> Result<(), BagError> {
        let damaged = |reason: String| {
            let reason = format!(
                "a chunk at byte {} cannot be read: {reason}; fetch the file anew, or cut it there",
                chunk.offset
            );
            BagError::content(&self.path, reason)
        };
        let bytes = bytes_of(&mut self.file, chunk).map_err(BagError::io(&self.path))?;
        let bytes = Arc::new(bytes.map_err(damaged)?);
        self.held.retain(|held| held.strong_count() > 0);
        self.held.push(Arc::downgrade(&bytes));
        let held: usize = self.held.iter().filter_map(Weak::upgrade).map(|held| held.len()).sum();
        // Chunks of one time are unpacked together: a file must not make more of them than of one great chunk.
        let size = self.file.metadata().map_err(BagError::io(&self.path))?.len();
        let most = most_unpacked(size);
        if held as u64 > most {
            return Err(damaged(format!(
                "chunks that overlap in time take {held} bytes, at most {most} are held"
            )));
        }
        for record in records(&bytes) {
            let (head, Range { start, end }) = record.map_err(damaged)?;
            if head.op != Op::Message {
                continue;
            }
            let id = head.u32("conn").map_err(damaged)?;
            if let Some(connection) = self.wanted.get(&id) {
                let body = Body {
                    connection: *connection,
                    begins: start,
                    ends: end,
                    bytes: bytes.clone(),
                };
                let time = head.time("time").map_err(damaged)?;
                self.heap.push(Reverse((time, (chunk.offset, start), body)));
            }
        }
        Ok(())
    }
}

impl Messages for InOrder {
    fn next(&mut self) -> Result<Option<Message>, BagError> {
        loop {
            let soonest = self.heap.peek().map_or(Nanos::MAX, |Reverse((time, ..))| *time);
            match self.chunks.get(self.next) {
                Some(chunk) if chunk.first <= soonest => {
                    let chunk = chunk.clone();
                    self.next += 1;
                    if self.wants(&chunk) {
                        self.load(&chunk)?;
                    }
                }
                _ => {
                    return Ok(self.heap.pop().map(|Reverse((time, _, body))| {
                        Message::new(body.connection, time, body.bytes, body.begins..body.ends)
                    }));
                }
            }
        }
    }
}
