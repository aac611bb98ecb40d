//! Chunks: what is put together and compressed.

use std::collections::BTreeMap;
use std::sync::Mutex;
use std::sync::mpsc::Receiver;

use mcap::records::op;

use super::parts::{record, text};
use super::{COMPRESSION, LEVEL, Packed, Piece, Work, YIELDING};

#[derive(Default)]
pub(super) struct OpenChunk {
    pub records: Vec<u8>,
    pub first: u64,
    pub last: u64,
    pub index: BTreeMap<u16, Vec<(u64, u64)>>,
}

pub(super) struct ChunkEntry {
    pub first: u64,
    pub last: u64,
    pub length: u64,
    pub message_indexes: BTreeMap<u16, u64>,
    pub compressed: u64,
    pub uncompressed: u64,
}

impl OpenChunk {
    pub(super) fn span_with(&self, time: u64) -> u64 {
        match self.index.is_empty() {
            true => 0,
            false => self.last.max(time) - self.first.min(time),
        }
    }

    pub(super) fn note(&mut self, channel: u16, time: u64) {
        let offset = self.records.len() as u64;
        (self.first, self.last) = match self.index.is_empty() {
            true => (time, time),
            false => (self.first.min(time), self.last.max(time)),
        };
        self.index.entry(channel).or_default().push((time, offset));
    }
}

pub(super) fn compress_all(jobs: &Mutex<Receiver<Work>>) {
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

pub(super) fn compress(chunk: OpenChunk) -> Packed {
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
