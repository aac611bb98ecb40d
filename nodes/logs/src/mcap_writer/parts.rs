//! Records and their fields as bytes.

use std::collections::BTreeMap;

use mcap::records::op;

use super::chunk::ChunkEntry;
use super::{COMPRESSION, Channel};
use crate::Schema;

pub(super) fn write_chunk_index(out: &mut Vec<u8>, start: u64, piece_length: u64, entry: &ChunkEntry) {
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

pub(super) fn write_schema(out: &mut Vec<u8>, id: u16, schema: Schema) {
    record(out, op::SCHEMA, |out| {
        out.extend(id.to_le_bytes());
        text(out, &schema.name());
        text(out, "ros2msg");
        text(out, &schema.text());
    });
}

pub(super) fn write_channel(out: &mut Vec<u8>, id: u16, channel: &Channel) {
    record(out, op::CHANNEL, |out| {
        out.extend(id.to_le_bytes());
        out.extend(channel.schema.to_le_bytes());
        text(out, &channel.topic);
        text(out, "cdr");
        out.extend(0u32.to_le_bytes());
    });
}

pub(super) fn record(out: &mut Vec<u8>, opcode: u8, fill: impl FnOnce(&mut Vec<u8>)) {
    out.push(opcode);
    let length_at = out.len();
    out.extend([0; 8]);
    fill(out);
    let length = (out.len() - length_at - 8) as u64;
    out[length_at..length_at + 8].copy_from_slice(&length.to_le_bytes());
}

pub(super) fn text(out: &mut Vec<u8>, text: &str) {
    out.extend((text.len() as u32).to_le_bytes());
    out.extend_from_slice(text.as_bytes());
}

pub(super) fn string_map(out: &mut Vec<u8>, entries: &BTreeMap<String, String>) {
    let bytes: usize = entries.iter().map(|(key, value)| 8 + key.len() + value.len()).sum();
    out.extend((bytes as u32).to_le_bytes());
    for (key, value) in entries {
        text(out, key);
        text(out, value);
    }
}
