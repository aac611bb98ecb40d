use realo_schemas::{Clock, Header, Kind, Message, Name, Report};
use serde::{Deserialize, Serialize};

use crate::{Books, PortId};

use super::{DoraLink, HostError};

const TOPIC: &str = "realo/end";
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

impl End {
    /// The `end` in a message, if it is one.
    pub fn of(message: &Message) -> Option<Result<End, String>> {
        match &message.payload {
            realo_schemas::Payload::Report(report) if &*report.topic == TOPIC => {
                Some(serde_json::from_str(&report.json).map_err(|error| format!("end of a stream: {error}")))
            }
            _ => None,
        }
    }
}

/// Ends every output: three times, so that one lost message does not fail the run.
pub(super) fn send(link: &mut DoraLink, hops: &[u64], books: &Books, clock: Option<Clock>) -> Result<(), HostError> {
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
            let mut header = Header::origin(&Name::default(), &Name::default(), Kind::Report, 0, 0, 0);
            header.clock = clock;
            link.send(
                PortId(port),
                &Message::new(
                    header,
                    Report {
                        topic: TOPIC.into(),
                        json,
                    },
                ),
            )?;
        }
    }
    Ok(())
}
