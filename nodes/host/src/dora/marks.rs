//! Messages of the driver itself: hello, fates, end.

use realo_operator::Books;
use realo_schemas::report::Fated;
use realo_schemas::{Clock, Header, Kind, Message, Name, Payload, Report};
use serde::de::DeserializeOwned;
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

/// A message of the driver beside a stream; [`Fates`] go down the graph within one.
pub(super) enum Mark {
    /// Opens dora's routes before the first message.
    Hello,
    /// Ends a stream.
    End(End),
}

impl Fates {
    /// The fates in a message, if it brings some.
    pub fn of(message: &Message) -> Result<Option<Fates>, String> {
        match report_of(message) {
            Some((FATES, json)) => from_json(FATES, json).map(Some),
            _ => Ok(None),
        }
    }

    /// The fates as a message, which is numbered like those of stages.
    pub fn to_message(&self, hop: u64, clock: Option<Clock>) -> Message {
        message(FATES, to_json(self), hop, clock)
    }
}

impl Mark {
    /// The mark in a message, if it is one.
    pub fn of(message: &Message) -> Result<Option<Mark>, String> {
        match report_of(message) {
            Some((HELLO, _)) => Ok(Some(Mark::Hello)),
            Some((END, json)) => from_json(END, json).map(Mark::End).map(Some),
            _ => Ok(None),
        }
    }

    /// The mark as a message.
    pub fn into_message(self, hop: u64, clock: Option<Clock>) -> Message {
        let (topic, json) = match self {
            Mark::Hello => (HELLO, String::new()),
            Mark::End(end) => (END, to_json(&end)),
        };
        message(topic, json, hop, clock)
    }
}

fn message(topic: &str, json: String, hop: u64, clock: Option<Clock>) -> Message {
    let mut header = Header::origin(&Name::default(), &Name::default(), Kind::Report, 0, 0, 0);
    header.clock = clock;
    header.hop = hop;
    let topic = topic.into();
    Message::new(header, Report { topic, json })
}

/// Topic and text of a report.
fn report_of(message: &Message) -> Option<(&str, &str)> {
    match &message.payload {
        Payload::Report(report) => Some((&report.topic, &report.json)),
        _ => None,
    }
}

fn from_json<T: DeserializeOwned>(topic: &str, json: &str) -> Result<T, String> {
    serde_json::from_str(json).map_err(|error| format!("`{topic}`: {error}"))
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

    /// A message after its way over dora.
    fn sent(message: &Message) -> Message {
        wire::from_arrow(&wire::to_arrow(message)).unwrap()
    }

    #[test]
    fn marks_survive_the_wire() {
        let hello = sent(&Mark::Hello.into_message(0, Some(CLOCK)));
        assert!(matches!(Mark::of(&hello), Ok(Some(Mark::Hello))));
        assert_eq!((hello.header.clock, hello.header.hop), (Some(CLOCK), 0));

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
        let end = sent(&Mark::End(end).into_message(4, Some(CLOCK)));
        let Ok(Some(Mark::End(end))) = Mark::of(&end) else {
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
        let message = sent(&fates.to_message(4, Some(CLOCK)));
        assert!(matches!(Mark::of(&message), Ok(None)), "they are part of the stream");
        assert_eq!(Fates::of(&message), Ok(Some(fates)));
        assert_eq!(message.header.hop, 4);
    }

    #[test]
    fn messages_of_stages_are_no_marks_and_broken_marks_are_named() {
        let header = Header::origin(&"run".into(), &"a".into(), Kind::Report, 0, 0, 0);
        let report = |topic: &str, json: &str| {
            let (topic, json) = (topic.into(), json.to_string());
            Message::new(header.clone(), Report { topic, json })
        };
        for message in [
            report("evaluation", "{}"),
            Message::new(header.clone(), Boxes::default()),
        ] {
            assert!(matches!(Mark::of(&message), Ok(None)));
            assert_eq!(Fates::of(&message), Ok(None));
        }
        let end = Mark::of(&report(END, "{\"hops\": 3}")).err();
        let fates = Fates::of(&report(FATES, "{\"hops\": 3}")).err();
        for (topic, error) in [(END, end), (FATES, fates)] {
            let error = error.expect("a broken mark");
            assert!(error.starts_with(&format!("`{topic}`: ")), "{error}");
        }
    }
}
