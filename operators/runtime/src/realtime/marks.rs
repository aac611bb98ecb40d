use realo_schemas::{Clock, Header, Kind, Message, Name, Payload, Report};
use serde::{Deserialize, Serialize};

use crate::{Books, PortId};

use super::{DoraLink, HostError};

const END: &str = "realo/end";
const HELLO: &str = "realo/hello";
const TIMES: u32 = 3;
const APART: std::time::Duration = std::time::Duration::from_millis(50);

/// The last word on an output.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct End {
    /// Messages that the output sent in all.
    pub hops: u64,
    /// The books of the sender and of all nodes above it.
    pub books: Books,
}

/// A message of the driver itself; not part of a stream.
pub(super) enum Mark {
    /// Opens dora's routes before the first message.
    Hello,
    /// Ends a stream.
    End(End),
}

impl Mark {
    /// The mark in a message, if it is one.
    pub fn of(message: &Message) -> Result<Option<Mark>, String> {
        match &message.payload {
            Payload::Report(report) if &*report.topic == HELLO => Ok(Some(Mark::Hello)),
            Payload::Report(report) if &*report.topic == END => match serde_json::from_str(&report.json) {
                Ok(end) => Ok(Some(Mark::End(end))),
                Err(error) => Err(format!("end of a stream: {error}")),
            },
            _ => Ok(None),
        }
    }
}

/// Says hello on every output.
pub(super) fn send_hello(link: &mut DoraLink) -> Result<(), HostError> {
    let hello = mark(HELLO, String::new(), None);
    (0..link.registration.outputs.len()).try_for_each(|port| link.send(PortId(port), &hello))
}

fn mark(topic: &str, json: String, clock: Option<Clock>) -> Message {
    let mut header = Header::origin(&Name::default(), &Name::default(), Kind::Report, 0, 0, 0);
    header.clock = clock;
    Message::new(
        header,
        Report {
            topic: topic.into(),
            json,
        },
    )
}

/// Ends every output: three times, so that one lost message does not fail the run.
pub(super) fn send_end(
    link: &mut DoraLink,
    hops: &[u64],
    books: &Books,
    clock: Option<Clock>,
) -> Result<(), HostError> {
    for round in 0..TIMES {
        if round > 0 {
            std::thread::sleep(APART);
        }
        for (port, hops) in hops.iter().enumerate() {
            let end = End {
                hops: *hops,
                books: books.clone(),
            };
            let json = serde_json::to_string(&end).expect("books have text keys only");
            link.send(PortId(port), &mark(END, json, clock))?;
        }
    }
    Ok(())
}
