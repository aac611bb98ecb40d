//! MCAP files of any maker, by the reader of logs.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use realo_logs::{LOG_RECORD, McapFile, RECORDING_RECORD};
use realo_schemas::Nanos;

use crate::source::{believed, plain_kind};
use crate::{Bag, BagError, Connection, Encoding, Message, Messages};

/// An open MCAP file.
pub(crate) struct Mcap {
    file: McapFile,
    connections: Vec<Connection>,
    /// Channels, as places in `connections`.
    known: BTreeMap<u16, usize>,
    notes: Vec<String>,
}

impl Mcap {
    pub fn open(path: &Path) -> Result<Self, BagError> {
        let file = McapFile::open(path)?;
        let (mut connections, mut known) = (Vec::<Connection>::new(), BTreeMap::new());
        for (id, channel) in file.channels() {
            let connection = Connection {
                topic: channel.topic.clone(),
                kind: plain_kind(&channel.schema),
                encoding: Encoding::named(&channel.encoding),
                messages: 0,
            };
            let place = connections.iter().position(|other| *other == connection);
            let place = place.unwrap_or_else(|| {
                connections.push(connection);
                connections.len() - 1
            });
            known.insert(*id, place);
        }
        for (id, place) in &known {
            connections[*place].messages += file.channels()[id].messages;
        }
        let mut notes: Vec<String> = file.truncation().map(ToString::to_string).into_iter().collect();
        if file.metadata().contains_key(LOG_RECORD) {
            notes.push("it is a log of realo: `realo run --log` plays it as it is".into());
        }
        Ok(Mcap {
            file,
            connections,
            known,
            notes,
        })
    }

    /// Whether it is a log of realo, or a recording of a run.
    pub fn is_ours(&self) -> bool {
        let records = self.file.metadata();
        records.contains_key(LOG_RECORD) || records.contains_key(RECORDING_RECORD)
    }
}

fn nanos(time: u64) -> Nanos {
    believed(Nanos::try_from(time).unwrap_or(Nanos::MAX))
}

impl Bag for Mcap {
    fn path(&self) -> &Path {
        self.file.path()
    }

    fn format(&self) -> &'static str {
        "MCAP"
    }

    fn connections(&self) -> &[Connection] {
        &self.connections
    }

    fn span(&self) -> Option<[Nanos; 2]> {
        self.file.span().map(|(first, last)| [nanos(first), nanos(last)])
    }

    fn notes(&self) -> &[String] {
        &self.notes
    }

    fn messages(&self, wanted: &BTreeSet<usize>) -> Result<Box<dyn Messages + '_>, BagError> {
        let channels = self.known.iter().filter(|(_, place)| wanted.contains(place));
        let channels = channels.map(|(id, _)| *id).collect();
        Ok(Box::new(InOrder {
            messages: self.file.messages(channels, 0..u64::MAX)?,
            known: self.known.clone(),
        }))
    }
}

struct InOrder {
    messages: realo_logs::Messages,
    known: BTreeMap<u16, usize>,
}

impl Messages for InOrder {
    fn next(&mut self) -> Result<Option<Message>, BagError> {
        let Some(message) = self.messages.next()? else {
            return Ok(None);
        };
        let connection = self.known[&message.channel];
        Ok(Some(Message::owned(
            connection,
            nanos(message.log_time),
            message.data().to_vec(),
        )))
    }
}
