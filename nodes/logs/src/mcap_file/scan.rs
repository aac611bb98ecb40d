//! Reading a file from begin to end, where it has no summary.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use mcap::records::op;
use realo_schemas::Nanos;

use super::truncation::Truncation;
use super::{ChannelInfo, MAGIC, McapFile, RECORD_HEAD, Span, sorted};
use crate::records::{ChannelRecord, HEAD, MessageRecord, MetadataRecord, SchemaRecord, records, unpack};
use crate::{ChunkGroup, LogError};

/// One pass over a file without a usable index.
pub(super) struct Scan {
    pub path: PathBuf,
    pub file: io::BufReader<File>,
    pub size: u64,
    pub at: u64,
    pub schemas: BTreeMap<u16, String>,
    pub channels: BTreeMap<u16, (ChannelInfo, u16)>,
    pub counts: BTreeMap<u16, u64>,
    pub metadata: BTreeMap<String, BTreeMap<String, String>>,
    pub spans: Vec<Span>,
    groups: BTreeMap<ChunkGroup, Reach>,
    /// Whether the record after the last message was found.
    all_data: bool,
    /// Where the file ends by its closing record.
    pub end: Option<u64>,
}

/// How far the messages of a group reach.
#[derive(Clone, Copy, Default)]
pub(super) struct Reach {
    newest: u64,
    /// By how much a message lay before an earlier one of the file.
    disorder: u64,
}

impl Reach {
    fn note(&mut self, time: u64) {
        self.newest = self.newest.max(time);
        self.disorder = self.disorder.max(self.newest - time);
    }

    /// More messages of the newest time may have followed, and as late ones as there were before.
    pub(super) fn complete_until(self) -> u64 {
        self.newest.saturating_sub(self.disorder)
    }
}

impl Scan {
    pub(super) fn new(path: &Path, file: File, size: u64) -> Self {
        Scan {
            path: path.into(),
            file: io::BufReader::with_capacity(1 << 16, file),
            size,
            at: MAGIC.len() as u64,
            schemas: BTreeMap::new(),
            channels: BTreeMap::new(),
            counts: BTreeMap::new(),
            metadata: BTreeMap::new(),
            spans: Vec::new(),
            groups: BTreeMap::new(),
            all_data: false,
            end: None,
        }
    }

    /// Log time before which no message is missing.
    pub(super) fn complete_until(&self, last: Option<u64>) -> Option<u64> {
        match self.all_data {
            true => last.map(|last| last.saturating_add(1)),
            // Groups are cut at different times: what one lacks, the others' messages cannot do without.
            false => self.groups.values().map(|reach| reach.complete_until()).min(),
        }
    }

    pub(super) fn run(mut self) -> Result<McapFile, LogError> {
        self.file
            .seek(SeekFrom::Start(self.at))
            .map_err(LogError::io(&self.path, "read"))?;
        let cut = loop {
            match self.step() {
                Ok(true) => {}
                Ok(false) => break None,
                Err(reason) => break Some(reason),
            }
        };
        if let Some(end) = self.end.filter(|end| self.size > *end) {
            return Err(self.goes_on(end));
        }
        let mut channels = BTreeMap::new();
        for (id, (mut info, schema)) in std::mem::take(&mut self.channels) {
            info.schema = self.schemas.get(&schema).cloned().unwrap_or_default();
            info.messages = self.counts.get(&id).copied().unwrap_or(0);
            channels.insert(id, info);
        }
        let with_messages = || {
            self.spans
                .iter()
                .filter(|span| span.channels.as_ref().is_some_and(|c| !c.is_empty()))
        };
        let first = with_messages().map(|span| span.first).min();
        let last = with_messages().map(|span| span.last).max();
        let complete_until = self.complete_until(last);
        let truncation = cut.map(|reason| Truncation {
            at_byte: self.at,
            file_bytes: self.size,
            reason,
            complete_until: complete_until.map(|until| until.min(Nanos::MAX as u64) as Nanos),
            expected_end: None,
        });
        let spans = Arc::new(sorted(self.spans));
        Ok(McapFile {
            path: self.path,
            channels,
            metadata: self.metadata,
            spans,
            first,
            last,
            truncation,
        })
    }

    /// Why a file is refused that goes on after its end: what follows would be lost in silence.
    fn goes_on(&mut self, end: u64) -> LogError {
        let mut head = [0; MAGIC.len()];
        let read = self
            .file
            .seek(SeekFrom::Start(end))
            .and_then(|_| self.file.read_exact(&mut head));
        let (path, more) = (self.path.display(), self.size - end);
        let reason = match read.is_ok() && head == MAGIC {
            true => format!(
                "another MCAP file of {more} B follows, as where two files were written into one; keep the first by `head -c {end} \
                 {path} > first.mcap`, the other by `tail -c {more} {path} > second.mcap`"
            ),
            false => format!(
                "what follows, {more} B, is not of an MCAP file; leave it out by `head -c {end} {path} > mended.mcap`"
            ),
        };
        LogError::GoesOn {
            path: self.path.clone(),
            offset: end,
            reason,
        }
    }

    /// Reads a record; false after the last one, an error where the file is cut.
    fn step(&mut self) -> Result<bool, String> {
        let mut head = [0; HEAD];
        if self.at == self.size {
            return Err("the index at the end is missing".into());
        }
        self.file
            .read_exact(&mut head)
            .map_err(|_| "the file ends within a record's head".to_string())?;
        let opcode = head[0];
        let length = u64::from_le_bytes(std::array::from_fn(|i| head[i + 1]));
        if length > self.size.saturating_sub(self.at + RECORD_HEAD) {
            return Err("the file ends within a record".into());
        }
        match opcode {
            op::FOOTER => {
                self.end = Some(self.at + RECORD_HEAD + length + MAGIC.len() as u64);
                return Ok(false);
            }
            // Behind the data, an index that was not believed repeats the definitions.
            op::CHUNK | op::MESSAGE | op::SCHEMA | op::CHANNEL | op::METADATA | op::DATA_END if !self.all_data => {
                let mut body = vec![0; length as usize];
                self.file.read_exact(&mut body).map_err(|error| error.to_string())?;
                self.note(opcode, &body)?;
            }
            _ => self
                .file
                .seek_relative(length as i64)
                .map_err(|error| error.to_string())?,
        }
        self.at += RECORD_HEAD + length;
        Ok(true)
    }

    fn note(&mut self, opcode: u8, body: &[u8]) -> Result<(), String> {
        if !matches!(opcode, op::CHUNK | op::MESSAGE) {
            return self.note_definition(opcode, body);
        }
        let mut span = Span {
            first: 0,
            last: 0,
            offset: self.at,
            length: RECORD_HEAD + body.len() as u64,
            channels: Some(BTreeSet::new()),
        };
        if opcode == op::MESSAGE {
            self.note_message(body, &mut span)?;
        } else {
            let chunk = unpack(body)?;
            for record in records(&chunk) {
                match record? {
                    (op::MESSAGE, body) => self.note_message(&chunk[body], &mut span)?,
                    (opcode @ (op::SCHEMA | op::CHANNEL), body) => self.note_definition(opcode, &chunk[body])?,
                    // Nothing else belongs into a chunk.
                    _ => {}
                }
            }
        }
        self.spans.push(span);
        Ok(())
    }

    fn note_message(&mut self, body: &[u8], span: &mut Span) -> Result<(), String> {
        let MessageRecord { channel, log_time, .. } = MessageRecord::read(body)?;
        let channels = span.channels.get_or_insert_default();
        (span.first, span.last) = match channels.is_empty() {
            true => (log_time, log_time),
            false => (span.first.min(log_time), span.last.max(log_time)),
        };
        channels.insert(channel);
        self.groups.entry(self.group_of(channel)).or_default().note(log_time);
        *self.counts.entry(channel).or_default() += 1;
        Ok(())
    }

    fn note_definition(&mut self, opcode: u8, body: &[u8]) -> Result<(), String> {
        match opcode {
            op::SCHEMA => {
                let schema = SchemaRecord::read(body)?;
                self.schemas.insert(schema.id, schema.name.into());
            }
            op::CHANNEL => {
                let channel = ChannelRecord::read(body)?;
                let info = ChannelInfo::new(&channel);
                self.channels.insert(channel.id, (info, channel.schema));
            }
            op::METADATA => {
                let record = MetadataRecord::read(body)?;
                self.metadata.insert(record.name, record.entries);
            }
            op::DATA_END => self.all_data = true,
            _ => {}
        }
        Ok(())
    }

    fn group_of(&self, channel: u16) -> ChunkGroup {
        let schema = self
            .channels
            .get(&channel)
            .and_then(|(_, schema)| self.schemas.get(schema));
        schema.map_or(ChunkGroup::Small, |schema| ChunkGroup::of(schema))
    }
}
