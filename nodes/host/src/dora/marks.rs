//! Messages of the driver itself: hello, fates, end.

use realo_operator::Books;
use realo_schemas::report::Fated;
use realo_schemas::{Clock, Header, Kind, Message, Name, Payload, Report};
use serde::{Deserialize, Serialize};

const END: &str = "realo/end";
const HELLO: &str = "realo/hello";
const FATES: &str = "realo/fates";

/// The last word on an output.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct End {
    /// What the output sent in all.
    pub hops: u64,
    /// The books of the sender's stages and of all above them.
    pub books: Books,
}

/// What stages of a process, or of those above it, said of messages over links.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Fates {
    /// The process that put them together.
    pub origin: String,
    /// Their number there; several ways may lead from there to here.
    pub number: u64,
    /// What was said.
    pub fates: Vec<Fated>,
}

/// A message of the driver.
pub(super) enum Mark {
    /// Opens dora's routes before the first message; is no part of a stream.
    Hello,
    /// Goes down the graph to the sinks; is numbered like a message.
    Fates(Fates),
    /// Ends a stream.
    End(End),
}

impl Mark {
    /// The mark in a message, if it is one.
    pub fn of(message: &Message) -> Result<Option<Mark>, String> {
        let Payload::Report(report) = &message.payload else {
            return Ok(None);
        };
        let wrong = |error: serde_json::Error| format!("`{}`: {error}", report.topic);
        match &*report.topic {
            HELLO => Ok(Some(Mark::Hello)),
            END => serde_json::from_str(&report.json)
                .map(Mark::End)
                .map(Some)
                .map_err(wrong),
            FATES => serde_json::from_str(&report.json)
                .map(Mark::Fates)
                .map(Some)
                .map_err(wrong),
            _ => Ok(None),
        }
    }

    /// The mark as a message.
    pub fn into_message(self, hop: u64, clock: Option<Clock>) -> Message {
        let (topic, json) = match self {
            Mark::Hello => (HELLO, String::new()),
            Mark::Fates(fates) => (FATES, to_json(&fates)),
            Mark::End(end) => (END, to_json(&end)),
        };
        let mut header = Header::origin(&Name::default(), &Name::default(), Kind::Report, 0, 0, 0);
        header.clock = clock;
        header.hop = hop;
        Message::new(
            header,
            Report {
                topic: topic.into(),
                json,
            },
        )
    }
}

fn to_json<T: Serialize>(document: &T) -> String {
    serde_json::to_string(document).expect("marks have text keys only")
}
