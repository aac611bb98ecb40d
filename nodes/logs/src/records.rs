//! MCAP records, taken apart without believing any length: what a record claims is compared with the bytes that there are
//! before anything is read or allocated.

use std::collections::{BTreeMap, BTreeSet};
use std::io::Read;
use std::ops::Range;

/// Opcode and length.
pub const HEAD: usize = 9;
/// Channel, sequence, log time, publish time.
pub const MESSAGE_HEAD: usize = 22;
/// Length of a footer with its head.
pub const FOOTER: usize = HEAD + 20;

/// What a chunk may unpack to beside [`RATIO`] times its packed bytes: clouds of a covered sensor are zeros.
const ROOM: u64 = 16 << 20;
const RATIO: u64 = 1024;
/// No writer makes greater chunks.
const MAX_CHUNK: u64 = 1 << 30;

/// Most bytes that `packed` bytes of a file may unpack to.
pub fn most_unpacked(packed: u64) -> u64 {
    RATIO.saturating_mul(packed).saturating_add(ROOM)
}

/// A part of a record.
struct Fields<'a> {
    record: &'static str,
    rest: &'a [u8],
}

impl<'a> Fields<'a> {
    fn new(record: &'static str, body: &'a [u8]) -> Self {
        Fields { record, rest: body }
    }

    fn take(&mut self, field: &'static str, length: u64) -> Result<&'a [u8], String> {
        let taken = usize::try_from(length)
            .ok()
            .and_then(|length| self.rest.split_at_checked(length));
        let (taken, rest) = taken.ok_or_else(|| {
            format!(
                "a {} whose `{field}` takes {length} bytes, {} are left",
                self.record,
                self.rest.len()
            )
        })?;
        self.rest = rest;
        Ok(taken)
    }

    fn array<const N: usize>(&mut self, field: &'static str) -> Result<[u8; N], String> {
        let taken = self.take(field, N as u64)?;
        Ok(std::array::from_fn(|i| taken[i]))
    }

    fn u16(&mut self, field: &'static str) -> Result<u16, String> {
        self.array(field).map(u16::from_le_bytes)
    }

    fn u32(&mut self, field: &'static str) -> Result<u32, String> {
        self.array(field).map(u32::from_le_bytes)
    }

    fn u64(&mut self, field: &'static str) -> Result<u64, String> {
        self.array(field).map(u64::from_le_bytes)
    }

    fn text(&mut self, field: &'static str) -> Result<&'a str, String> {
        let length = self.u32(field)?;
        std::str::from_utf8(self.take(field, length.into())?)
            .map_err(|_| format!("a {} whose `{field}` is not UTF-8", self.record))
    }

    /// A map, whose length is in bytes.
    fn map(&mut self, field: &'static str) -> Result<Fields<'a>, String> {
        let length = self.u32(field)?;
        Ok(Fields {
            record: self.record,
            rest: self.take(field, length.into())?,
        })
    }
}

/// Name of a schema by its number.
pub struct SchemaRecord<'a> {
    pub id: u16,
    pub name: &'a str,
}

impl<'a> SchemaRecord<'a> {
    pub fn read(body: &'a [u8]) -> Result<Self, String> {
        let mut fields = Fields::new("schema", body);
        let (id, name) = (fields.u16("id")?, fields.text("name")?);
        fields.text("encoding")?;
        let length = fields.u32("data")?;
        fields.take("data", length.into())?;
        Ok(SchemaRecord { id, name })
    }
}

/// A channel by its number.
pub struct ChannelRecord<'a> {
    pub id: u16,
    pub schema: u16,
    pub topic: &'a str,
    pub encoding: &'a str,
}

impl<'a> ChannelRecord<'a> {
    pub fn read(body: &'a [u8]) -> Result<Self, String> {
        let mut fields = Fields::new("channel", body);
        let (id, schema) = (fields.u16("id")?, fields.u16("schema_id")?);
        let (topic, encoding) = (fields.text("topic")?, fields.text("message_encoding")?);
        fields.map("metadata")?;
        Ok(ChannelRecord {
            id,
            schema,
            topic,
            encoding,
        })
    }
}

/// What stands in front of a message's payload.
pub struct MessageRecord {
    pub channel: u16,
    pub sequence: u32,
    pub log_time: u64,
    pub publish_time: u64,
}

impl MessageRecord {
    pub fn read(body: &[u8]) -> Result<Self, String> {
        let mut fields = Fields::new("message", body);
        Ok(MessageRecord {
            channel: fields.u16("channel_id")?,
            sequence: fields.u32("sequence")?,
            log_time: fields.u64("log_time")?,
            publish_time: fields.u64("publish_time")?,
        })
    }
}

/// Named texts.
pub struct MetadataRecord {
    pub name: String,
    pub entries: BTreeMap<String, String>,
}

impl MetadataRecord {
    pub fn read(body: &[u8]) -> Result<Self, String> {
        let mut fields = Fields::new("metadata record", body);
        let name = fields.text("name")?.to_string();
        let mut map = fields.map("metadata")?;
        let mut entries = BTreeMap::new();
        while !map.rest.is_empty() {
            let (key, value) = (map.text("metadata")?, map.text("metadata")?);
            entries.insert(key.into(), value.into());
        }
        Ok(MetadataRecord { name, entries })
    }
}

/// Where a metadata record lies.
pub struct MetadataIndex {
    pub offset: u64,
    pub length: u64,
}

impl MetadataIndex {
    pub fn read(body: &[u8]) -> Result<Self, String> {
        let mut fields = Fields::new("metadata index", body);
        Ok(MetadataIndex {
            offset: fields.u64("offset")?,
            length: fields.u64("length")?,
        })
    }
}

/// Where a chunk lies, and which channels have messages in it.
pub struct ChunkIndex {
    pub first: u64,
    pub last: u64,
    pub offset: u64,
    pub length: u64,
    pub channels: BTreeSet<u16>,
    pub packed: u64,
    pub unpacked: u64,
}

impl ChunkIndex {
    pub fn read(body: &[u8]) -> Result<Self, String> {
        let mut fields = Fields::new("chunk index", body);
        let (first, last) = (fields.u64("message_start_time")?, fields.u64("message_end_time")?);
        let (offset, length) = (fields.u64("chunk_start_offset")?, fields.u64("chunk_length")?);
        let mut map = fields.map("message_index_offsets")?;
        let mut channels = BTreeSet::new();
        while !map.rest.is_empty() {
            channels.insert(map.u16("message_index_offsets")?);
            map.u64("message_index_offsets")?;
        }
        fields.u64("message_index_length")?;
        fields.text("compression")?;
        Ok(ChunkIndex {
            first,
            last,
            offset,
            length,
            channels,
            packed: fields.u64("compressed_size")?,
            unpacked: fields.u64("uncompressed_size")?,
        })
    }
}

/// What the index says of the whole file.
pub struct Statistics {
    pub messages: u64,
    pub metadata: u32,
    pub chunks: u32,
    pub first: u64,
    pub last: u64,
    pub counts: BTreeMap<u16, u64>,
}

impl Statistics {
    pub fn read(body: &[u8]) -> Result<Self, String> {
        let mut fields = Fields::new("statistics record", body);
        let messages = fields.u64("message_count")?;
        fields.u16("schema_count")?;
        fields.u32("channel_count")?;
        fields.u32("attachment_count")?;
        let (metadata, chunks) = (fields.u32("metadata_count")?, fields.u32("chunk_count")?);
        let (first, last) = (fields.u64("message_start_time")?, fields.u64("message_end_time")?);
        let mut map = fields.map("channel_message_counts")?;
        let mut counts = BTreeMap::new();
        while !map.rest.is_empty() {
            counts.insert(map.u16("channel_message_counts")?, map.u64("channel_message_counts")?);
        }
        Ok(Statistics {
            messages,
            metadata,
            chunks,
            first,
            last,
            counts,
        })
    }
}

/// Where the index begins, and its checksum.
pub struct Footer {
    pub summary: u64,
    pub crc: u32,
}

impl Footer {
    pub fn read(body: &[u8]) -> Result<Self, String> {
        let mut fields = Fields::new("footer", body);
        let summary = fields.u64("summary_start")?;
        fields.u64("summary_offset_start")?;
        Ok(Footer {
            summary,
            crc: fields.u32("summary_crc")?,
        })
    }
}

/// The records of a chunk as (opcode, range of the body).
pub fn records(data: &[u8]) -> impl Iterator<Item = Result<(u8, Range<usize>), String>> + '_ {
    let mut at = 0;
    std::iter::from_fn(move || {
        if at == data.len() {
            return None;
        }
        let left = &data[at..];
        let mut fields = Fields::new("record head", left);
        let head = fields
            .array::<1>("opcode")
            .and_then(|[opcode]| Ok((opcode, fields.u64("length")?)));
        let (start, end) = (at + HEAD, data.len());
        at = end;
        Some(head.and_then(|(opcode, length)| {
            let room = end - start;
            match usize::try_from(length) {
                Ok(length) if length <= room => {
                    at = start + length;
                    Ok((opcode, start..at))
                }
                _ => Err(format!(
                    "a record of {length} bytes in a chunk with {room} bytes left for it"
                )),
            }
        }))
    })
}

/// The records in the body of a chunk record, decompressed and checked.
pub fn unpack(body: &[u8]) -> Result<Vec<u8>, String> {
    let mut fields = Fields::new("chunk", body);
    fields.take("message times", 16)?;
    let (size, crc) = (fields.u64("uncompressed_size")?, fields.u32("uncompressed_crc")?);
    let compression = fields.text("compression")?;
    let packed = fields.u64("records")?;
    let packed = fields.take("records", packed)?;
    let most = most_unpacked(packed.len() as u64).min(MAX_CHUNK);
    if size > most {
        return Err(format!(
            "a chunk of {} bytes whose head says that it unpacks to {size}; at most {most} are believed",
            packed.len()
        ));
    }
    let size = size as usize;
    let records = match compression {
        "" => packed.to_vec(),
        "zstd" => zstd::bulk::decompress(packed, size).map_err(|error| format!("a chunk's zstd: {error}"))?,
        "lz4" => unpack_lz4(packed, size).map_err(|error| format!("a chunk's lz4: {error}"))?,
        other => {
            return Err(format!(
                "a chunk's compression is `{other}`, expected zstd, lz4 or none; write the file again with one of these"
            ));
        }
    };
    if records.len() != size {
        let found = records.len();
        return Err(format!(
            "a chunk's head says {size} bytes, it unpacks to {found} or more"
        ));
    }
    if crc != 0 && crc != crc32fast::hash(&records) {
        return Err("a chunk's checksum is wrong".into());
    }
    Ok(records)
}

/// At most one byte more than `size`.
fn unpack_lz4(packed: &[u8], size: usize) -> std::io::Result<Vec<u8>> {
    let mut records = Vec::with_capacity(size + 1);
    lz4::Decoder::new(packed)?
        .take(size as u64 + 1)
        .read_to_end(&mut records)?;
    Ok(records)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn text(out: &mut Vec<u8>, text: &str) {
        out.extend((text.len() as u32).to_le_bytes());
        out.extend(text.as_bytes());
    }

    fn chunk(compression: &str, size: u64, crc: u32, packed: &[u8], claimed: u64) -> Vec<u8> {
        let mut body = vec![0; 16];
        body.extend(size.to_le_bytes());
        body.extend(crc.to_le_bytes());
        text(&mut body, compression);
        body.extend(claimed.to_le_bytes());
        body.extend(packed);
        body
    }

    fn lz4(data: &[u8]) -> Vec<u8> {
        let mut encoder = lz4::EncoderBuilder::new().build(Vec::new()).unwrap();
        std::io::Write::write_all(&mut encoder, data).unwrap();
        let (packed, result) = encoder.finish();
        result.unwrap();
        packed
    }

    #[test]
    fn every_compression_gives_the_same_and_every_wrong_size_is_refused() {
        let data: Vec<u8> = (0..100_000u32).map(|i| (i / 700) as u8).collect();
        let crc = crc32fast::hash(&data);
        let zstd = zstd::bulk::compress(&data, 1).unwrap();
        for (compression, packed) in [("", data.clone()), ("zstd", zstd), ("lz4", lz4(&data))] {
            let length = packed.len() as u64;
            let with = |size: u64, crc: u32| unpack(&chunk(compression, size, crc, &packed, length));
            assert_eq!(with(100_000, crc).unwrap(), data, "{compression}");
            assert_eq!(with(100_000, 0).unwrap(), data, "{compression}");
            assert!(
                with(100_000, crc ^ 1).unwrap_err().contains("checksum"),
                "{compression}"
            );
            for size in [0, 99_999, 100_001] {
                assert!(with(size, 0).is_err(), "{compression} {size}");
            }
            let error = with(1 << 62, 0).unwrap_err();
            assert!(
                error.contains("at most") && error.contains("4611686018427387904"),
                "{error}"
            );
            for claimed in [length + 1, 1 << 62, u64::MAX] {
                let error = unpack(&chunk(compression, 100_000, 0, &packed, claimed)).unwrap_err();
                assert!(error.contains("`records` takes"), "{error}");
            }
        }
        let error = unpack(&chunk("brotli", 1, 0, &[0], 1)).unwrap_err();
        assert!(error.contains("`brotli`, expected zstd, lz4 or none"), "{error}");
    }

    #[test]
    fn a_bound_for_every_packed_size() {
        assert_eq!(most_unpacked(0), 16 << 20);
        assert_eq!(most_unpacked(3), (16 << 20) + 3072);
        assert_eq!(most_unpacked(u64::MAX), u64::MAX);
        let zeros = |n: usize| zstd::bulk::compress(&vec![0; n], 1).unwrap();
        let (fits, bomb) = (zeros(16 << 20), zeros(64 << 20));
        let length = |packed: &[u8]| packed.len() as u64;
        assert!(length(&bomb) < 20_000);
        let unpacked = unpack(&chunk("zstd", 16 << 20, 0, &fits, length(&fits))).unwrap();
        assert_eq!(unpacked.len(), 16 << 20);
        let error = unpack(&chunk("zstd", 64 << 20, 0, &bomb, length(&bomb))).unwrap_err();
        assert!(error.contains("67108864"), "{error}");
    }

    #[test]
    fn records_end_with_the_chunk_that_holds_them() {
        let record = |opcode: u8, length: u64, body: &[u8]| [&[opcode][..], &length.to_le_bytes(), body].concat();
        let two = [record(3, 2, b"ab"), record(5, 0, b"")].concat();
        let found: Vec<_> = records(&two).collect();
        assert_eq!(found, [Ok((3, 9..11)), Ok((5, 20..20))]);
        assert_eq!(records(&[]).count(), 0);
        for length in [3, 1 << 62, 1 << 63, u64::MAX, u64::MAX - 8] {
            let found: Vec<_> = records(&record(3, length, b"ab")).collect();
            let expected = format!("a record of {length} bytes in a chunk with 2 bytes left for it");
            assert_eq!(found, [Err(expected)]);
        }
        let found: Vec<_> = records(&two[..15]).collect();
        assert_eq!(found.len(), 2);
        assert!(
            found[1]
                .as_ref()
                .unwrap_err()
                .contains("`length` takes 8 bytes, 3 are left")
        );
    }

    #[test]
    fn maps_and_texts_stay_within_their_record() {
        let mut body = Vec::new();
        text(&mut body, "realo");
        let mut map = Vec::new();
        text(&mut map, "key");
        text(&mut map, "value");
        body.extend((map.len() as u32).to_le_bytes());
        body.extend(&map);
        let whole = body.clone();
        let read = MetadataRecord::read(&whole).unwrap();
        assert_eq!(read.entries, BTreeMap::from([("key".into(), "value".into())]));
        for cut in 0..whole.len() {
            assert!(MetadataRecord::read(&whole[..cut]).is_err(), "{cut}");
        }
        // The map's length, then the key's.
        for at in [9, 13] {
            for length in [map.len() as u32 + 1, u32::MAX] {
                let mut damaged = whole.clone();
                damaged[at..at + 4].copy_from_slice(&length.to_le_bytes());
                damaged.extend([0; 3]);
                assert!(MetadataRecord::read(&damaged[..whole.len()]).is_err(), "{at} {length}");
            }
        }
    }
}
