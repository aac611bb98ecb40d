//! Reads any MCAP file in constant memory: by its index, or, where that is missing, after one pass over the file.

mod messages;
mod scan;
mod summary;
mod truncation;

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet, BinaryHeap};
use std::fs::{self, File};
use std::io::{Read, Seek, SeekFrom};
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use mcap::records::op;
use serde::Serialize;

use crate::records::{ChannelRecord, FOOTER, HEAD, MessageRecord, MetadataRecord, records};
use crate::{LogError, foreign};
pub use messages::{Messages, RawMessage};
use scan::Scan;
use summary::{Summary, read_at, whole_record};
pub use truncation::Truncation;

pub(crate) const MAGIC: [u8; 8] = *b"\x89MCAP0\r\n";
/// Bytes at the beginning that tell what a file is.
const LOOKED_AT: u64 = 64;
const RECORD_HEAD: u64 = HEAD as u64;
/// Footer and magic.
const TAIL: usize = FOOTER + MAGIC.len();

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

impl ChannelInfo {
    fn new(channel: &ChannelRecord) -> Self {
        ChannelInfo {
            topic: channel.topic.into(),
            schema: String::new(),
            encoding: channel.encoding.into(),
            messages: 0,
        }
    }
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
        let not_mcap = |reason: String| LogError::NotMcap {
            path: path.into(),
            reason,
        };
        if path.is_dir() {
            return Err(not_mcap(foreign::folder(path)));
        }
        // To open a pipe would wait for whoever writes into it.
        let is_file = fs::metadata(path).map_err(LogError::io(path, "open"))?.is_file();
        if !is_file {
            return Err(not_mcap("a pipe, socket or device; write it to a file first".into()));
        }
        let mut file = File::open(path).map_err(LogError::io(path, "open"))?;
        let size = file.metadata().map_err(LogError::io(path, "read"))?.len();
        let mut head = Vec::new();
        let read = Read::by_ref(&mut file).take(LOOKED_AT).read_to_end(&mut head);
        read.map_err(LogError::io(path, "read"))?;
        if !head.starts_with(&MAGIC) {
            return Err(not_mcap(foreign::not_mcap(path, &head)));
        }
        file.seek(SeekFrom::Start(MAGIC.len() as u64))
            .map_err(LogError::io(path, "read"))?;
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
            held: Vec::new(),
        })
    }

    /// First and last log time of a channel's messages; `None` without any.
    ///
    /// # Errors
    /// If the file cannot be opened again; bytes that contradict the format.
    pub fn times_of(&self, channel: u16) -> Result<Option<(u64, u64)>, LogError> {
        let only = BTreeSet::from([channel]);
        let mut messages = self.messages(only, 0..u64::MAX)?;
        let Some(first) = messages.next()?.map(|message| message.log_time) else {
            return Ok(None);
        };
        let mut last = first;
        let mut spans: Vec<&Span> = self.spans.iter().filter(|span| messages.wants(span)).collect();
        spans.sort_by_key(|span| Reverse((span.last, span.offset)));
        for span in spans {
            if span.last <= last {
                break;
            }
            let chunk = messages.chunk(span)?;
            for record in records(&chunk) {
                let (opcode, body) = record.map_err(|reason| LogError::damaged(&self.path, span.offset, reason))?;
                if opcode == op::MESSAGE
                    && let Ok(head) = MessageRecord::read(&chunk[body])
                    && head.channel == channel
                {
                    last = last.max(head.log_time);
                }
            }
        }
        Ok(Some((first, last)))
    }

    /// Reads the index; `None` if the file has none, or one that does not fit the file.
    fn by_index(path: &Path, file: &mut File, size: u64) -> Result<Option<Self>, LogError> {
        let Some(summary) = Summary::read(file, size).filter(|summary| summary.fits(size)) else {
            return Ok(None);
        };
        let Some(stats) = summary.stats else { return Ok(None) };
        let mut channels = summary.channels;
        for (id, channel) in &mut channels {
            channel.messages = stats.counts.get(id).copied().unwrap_or(0);
        }
        let mut metadata = BTreeMap::new();
        for index in &summary.metadata {
            let damaged = |reason| LogError::damaged(path, index.offset, reason);
            let bytes = read_at(file, index.offset, index.length, size).map_err(damaged)?;
            let (opcode, body) = whole_record(&bytes).map_err(damaged)?;
            if opcode == op::METADATA {
                let record = MetadataRecord::read(body).map_err(damaged)?;
                metadata.insert(record.name, record.entries);
            }
        }
        let spans = summary.chunks.into_iter().map(|chunk| Span {
            first: chunk.first,
            last: chunk.last,
            offset: chunk.offset,
            length: chunk.length,
            channels: Some(chunk.channels).filter(|channels| !channels.is_empty()),
        });
        let has = stats.messages > 0;
        Ok(Some(McapFile {
            path: path.into(),
            channels,
            metadata,
            spans: Arc::new(sorted(spans.collect())),
            first: has.then_some(stats.first),
            last: has.then_some(stats.last),
            truncation: None,
        }))
    }
}

fn sorted(mut spans: Vec<Span>) -> Vec<Span> {
    spans.sort_by_key(|span| (span.first, span.offset));
    spans
}

#[cfg(test)]
mod tests {
    use super::summary::are_apart;
    use super::*;
    use crate::records::most_unpacked;
    use crate::records::{ChunkIndex, MetadataIndex, Statistics};

    #[test]
    fn stretches_lie_in_the_file_and_apart() {
        let apart = |stretches: &[(u64, u64)]| are_apart(stretches.to_vec(), 100);
        assert!(apart(&[]) && apart(&[(8, 9)]) && apart(&[(50, 50), (8, 42)]) && apart(&[(91, 9)]));
        for wrong in [
            &[(7, 20)][..],
            &[(8, 8)],
            &[(8, 0)],
            &[(92, 9)],
            &[(8, 93)],
            &[(8, 20), (27, 9)],
            &[(8, 20), (8, 20)],
            &[(8, u64::MAX)],
            &[(u64::MAX, 9)],
        ] {
            assert!(!apart(wrong), "{wrong:?}");
        }
    }

    fn summary() -> Summary {
        let channel = ChannelInfo {
            topic: "/x".into(),
            schema: String::new(),
            encoding: "cdr".into(),
            messages: 0,
        };
        Summary {
            stats: Some(Statistics {
                messages: 3,
                metadata: 1,
                chunks: 1,
                first: 5,
                last: 6,
                counts: BTreeMap::from([(0, 1), (1, 2)]),
            }),
            channels: BTreeMap::from([(0, channel.clone()), (1, channel)]),
            chunks: vec![ChunkIndex {
                first: 5,
                last: 6,
                offset: 8,
                length: 200,
                channels: BTreeSet::new(),
                packed: 93,
                unpacked: 93,
            }],
            metadata: vec![MetadataIndex { offset: 208, length: 9 }],
        }
    }

    #[test]
    fn an_index_is_used_only_if_it_fits_the_file() {
        assert!(summary().fits(217));
        type Change = fn(&mut Summary, &mut Statistics);
        let changes: [Change; 14] = [
            |_, stats| stats.messages = 4,
            |_, stats| stats.messages = 2,
            |_, stats| stats.metadata = 0,
            |_, stats| stats.chunks = 2,
            |_, stats| stats.first = 7,
            |_, stats| stats.counts = BTreeMap::from([(0, 1), (2, 2)]),
            |_, stats| stats.counts = BTreeMap::from([(0, u64::MAX), (1, 4)]),
            // A message takes 31 bytes.
            |summary, _| summary.chunks[0].unpacked = 92,
            |summary, _| summary.chunks[0].unpacked = most_unpacked(93) + 1,
            |summary, _| summary.chunks[0].packed = 201,
            |summary, _| summary.chunks[0].offset = 9,
            |summary, _| summary.metadata[0].length = 10,
            |summary, _| summary.metadata[0].offset = 207,
            |summary, _| summary.metadata.clear(),
        ];
        for (k, change) in changes.into_iter().enumerate() {
            let mut changed = summary();
            let mut stats = changed.stats.take().unwrap();
            change(&mut changed, &mut stats);
            changed.stats = Some(stats);
            assert!(!changed.fits(217), "change {k}");
        }
        let bare = Summary {
            stats: None,
            ..summary()
        };
        assert!(!bare.fits(217) && !summary().fits(216));
    }

    #[test]
    fn whole_records_have_the_length_that_they_say() {
        let record = [&[op::METADATA][..], &3u64.to_le_bytes(), b"abc"].concat();
        assert_eq!(whole_record(&record), Ok((op::METADATA, &b"abc"[..])));
        for wrong in [
            &record[..11],
            &[&record[..], b"x"].concat(),
            &[&record[..], &record[..]].concat(),
            &[],
        ] {
            assert!(whole_record(wrong).is_err(), "{wrong:?}");
        }
    }
}
