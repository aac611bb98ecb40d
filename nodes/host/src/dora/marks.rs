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

#[cfg(test)]
mod tests {
    use realo_operator::NodeBooks;
    use realo_schemas::report::{Crossing, Fate};
    use realo_schemas::{Boxes, wire};

    use super::*;

    const CLOCK: Clock = Clock {
        wall_origin: 5,
        log_origin: 7,
        rate: 0.5,
    };

    /// A mark after its way over dora.
    fn sent(mark: Mark, hop: u64) -> (Mark, Header) {
        let message = wire::from_arrow(&wire::to_arrow(&mark.into_message(hop, Some(CLOCK)))).unwrap();
        (Mark::of(&message).unwrap().unwrap(), message.header)
    }

    #[test]
    fn marks_survive_the_wire() {
        let (hello, header) = sent(Mark::Hello, 0);
        assert!(matches!(hello, Mark::Hello));
        assert_eq!((header.clock, header.hop), (Some(CLOCK), 0));

        let mut books = Books::default();
        let node = NodeBooks {
            name: "nms".into(),
            errors: 3,
            ..NodeBooks::default()
        };
        books.nodes.insert("ego.nms".into(), node);
        let end = End {
            hops: 9,
            books: books.clone(),
        };
        let (Mark::End(end), _) = sent(Mark::End(end), 4) else {
            panic!("an end")
        };
        assert_eq!((end.hops, end.books), (9, books));

        let message = Crossing {
            from: "a".into(),
            to: "ego".into(),
            kind: Kind::Boxes,
            seq: 7,
        };
        let fates = Fates {
            origin: "fusion".into(),
            number: 2,
            fates: vec![Fated {
                message,
                fate: Fate::Stale,
                r#use: None,
            }],
        };
        let (Mark::Fates(read), header) = sent(Mark::Fates(fates.clone()), 4) else {
            panic!("fates")
        };
        assert_eq!((read, header.hop), (fates, 4));
    }

    #[test]
    fn messages_of_stages_are_no_marks_and_broken_marks_are_named() {
        let header = Header::origin(&"run".into(), &"a".into(), Kind::Report, 0, 0, 0);
        let of = |topic: &str, json: &str| {
            let (topic, json) = (topic.into(), json.to_string());
            Mark::of(&Message::new(header.clone(), Report { topic, json }))
        };
        assert!(matches!(of("evaluation", "{}"), Ok(None)));
        assert!(matches!(
            Mark::of(&Message::new(header.clone(), Boxes::default())),
            Ok(None)
        ));
        for topic in [END, FATES] {
            let Err(error) = of(topic, "{\"hops\": 3}") else {
                panic!("a broken mark")
            };
            assert!(error.starts_with(&format!("`{topic}`: ")), "{error}");
        }
    }
}
