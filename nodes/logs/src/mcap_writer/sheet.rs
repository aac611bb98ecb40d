//! The file as far as it is written, and its end.

use std::io::Write;
use std::sync::mpsc::Receiver;
use std::sync::{Arc, Mutex};

use mcap::records::op;

use super::chunk::ChunkEntry;
use super::failure::Failure;
use super::parts::{record, text, write_channel, write_chunk_index, write_schema};
use super::{MAGIC, McapWriter, Output, Packed};

/// The file, and what its index will say.
pub(super) struct Sheet {
    pub output: Box<dyn Output>,
    pub at: u64,
    data_crc: crc32fast::Hasher,
    chunks: Vec<(u64, u64, ChunkEntry)>,
    pub metadata: Vec<(u64, u64, String)>,
    pub failure: Arc<Mutex<Option<Failure>>>,
}

impl Sheet {
    pub(super) fn new(output: impl Output, failure: Arc<Mutex<Option<Failure>>>) -> Self {
        Sheet {
            output: Box::new(output),
            at: 0,
            data_crc: crc32fast::Hasher::new(),
            chunks: Vec::new(),
            metadata: Vec::new(),
            failure,
        }
    }

    pub(super) fn run(mut self, pieces: &Receiver<Receiver<Packed>>) -> Self {
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

    pub(super) fn put(&mut self, bytes: &[u8]) -> bool {
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

    pub(super) fn write_end(&mut self, mcap: &McapWriter) {
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
        finish_summary(&mut summary, base, &groups);
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

/// Writes where the groups of the summary are (opcode, place, bytes), and the footer; the summary lies at `base`.
fn finish_summary(summary: &mut Vec<u8>, base: u64, groups: &[(u8, u64, u64)]) {
    let offsets = base + summary.len() as u64;
    for (opcode, start, length) in groups {
        record(summary, op::SUMMARY_OFFSET, |out| {
            out.push(*opcode);
            out.extend(start.to_le_bytes());
            out.extend(length.to_le_bytes());
        });
    }
    // The footer's checksum covers itself up to the checksum.
    summary.push(op::FOOTER);
    summary.extend(20u64.to_le_bytes());
    summary.extend(base.to_le_bytes());
    summary.extend(offsets.to_le_bytes());
    summary.extend(crc32fast::hash(summary).to_le_bytes());
    summary.extend(MAGIC);
}
