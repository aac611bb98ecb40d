use std::collections::BTreeMap;
use std::fs::{self, File};
use std::path::{Path, PathBuf};

use realo_logs::{
    ChannelId, ChunkGroup, LogError, McapWriter, Owner, RECORDING_RECORD, Schema, program, refuse_foreign,
};
use realo_operator::Books;
use realo_schemas::Nanos;
use serde_json::json;

use crate::channels::{Channels, Times, put_document};

/// A recording in the making.
pub struct Recording {
    path: PathBuf,
    mcap: McapWriter,
    channels: BTreeMap<String, ChannelId>,
    last: Nanos,
}

impl Recording {
    pub fn create(path: &Path) -> Result<Self, LogError> {
        let io = |action| {
            move |reason| LogError::Io {
                path: path.into(),
                action,
                reason,
            }
        };
        if let Some(folder) = path.parent().filter(|folder| !folder.as_os_str().is_empty()) {
            fs::create_dir_all(folder).map_err(io("make the folder of"))?;
        }
        refuse_foreign(path)?;
        if Owner::of(path).map_err(io("look at"))? == Owner::Log {
            let reason = "it is a log, and would be lost; choose another `path`";
            return Err(LogError::Io {
                path: path.into(),
                action: "record into",
                reason: std::io::Error::other(reason),
            });
        }
        let file = File::create(path).map_err(io("create"))?;
        let metadata = BTreeMap::from([("format".into(), "1".into()), ("program".into(), program())]);
        let mcap = McapWriter::new(file, &program(), RECORDING_RECORD, &metadata).map_err(io("start writing"))?;
        Ok(Recording {
            path: path.into(),
            mcap,
            channels: BTreeMap::new(),
            last: 0,
        })
    }

    /// The newest time of a message so far, ns.
    pub fn last(&self) -> Nanos {
        self.last
    }

    pub fn finish(mut self, books: &Books) -> Result<(), LogError> {
        let last = Times::at(self.last);
        put_document(&mut self, last, &json!({ "topic": "books", "report": books }))?;
        self.mcap.finish().map_err(|failure| failure.of(&self.path))
    }
}

impl Channels for Recording {
    type Error = LogError;

    fn put(
        &mut self,
        topic: &str,
        schema: Schema,
        Times { ready, stamp }: Times,
        encode: impl FnOnce(&mut Vec<u8>),
    ) -> Result<(), LogError> {
        self.last = self.last.max(ready);
        let channel = match self.channels.get(topic) {
            Some(channel) => *channel,
            None => {
                let channel = self.mcap.channel(topic, schema, ChunkGroup::of(&schema.name()));
                self.channels.insert(topic.into(), channel);
                channel
            }
        };
        let written = self
            .mcap
            .write(channel, ready.max(0) as u64, stamp.max(0) as u64, encode);
        written.map(|_| ()).map_err(|failure| failure.of(&self.path))
    }
}
