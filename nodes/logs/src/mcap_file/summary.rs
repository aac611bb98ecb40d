//! The summary at the end of a file.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom};

use mcap::records::op;

use super::{ChannelInfo, MAGIC, RECORD_HEAD, TAIL};
use crate::records::{
    ChannelRecord, ChunkIndex, FOOTER, Footer, HEAD, MESSAGE_HEAD, MetadataIndex, SchemaRecord, Statistics,
    most_unpacked, records,
};

/// The index at a file's end.
#[derive(Default)]
pub(super) struct Summary {
    pub stats: Option<Statistics>,
    pub channels: BTreeMap<u16, ChannelInfo>,
    pub chunks: Vec<ChunkIndex>,
    pub metadata: Vec<MetadataIndex>,
}

impl Summary {
    /// `None` where there is none, or its bytes or checksum are wrong.
    pub(super) fn read(file: &mut File, size: u64) -> Option<Self> {
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
    pub(super) fn fits(&self, size: u64) -> bool {
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
pub(super) fn are_apart(mut stretches: Vec<(u64, u64)>, size: u64) -> bool {
    stretches.sort_unstable();
    let mut end = MAGIC.len() as u64;
    stretches.into_iter().all(|(offset, length)| {
        let before = std::mem::replace(&mut end, offset.saturating_add(length));
        offset >= before && length >= RECORD_HEAD && end <= size
    })
}

/// Reads a whole record, head included.
pub(super) fn read_at(file: &mut File, offset: u64, length: u64, size: u64) -> Result<Vec<u8>, String> {
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
pub(super) fn whole_record(bytes: &[u8]) -> Result<(u8, &[u8]), String> {
    let mut found = records(bytes);
    match (found.next(), found.next()) {
        (Some(Ok((opcode, body))), None) => Ok((opcode, &bytes[body])),
        _ => Err(format!(
            "expected a record of {} bytes, found another length",
            bytes.len()
        )),
    }
}
