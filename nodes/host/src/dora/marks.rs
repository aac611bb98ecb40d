//! What drivers say to each other: hello, fates, end.

use std::collections::{BTreeMap, BTreeSet};

use dora_node_api::{MetadataParameters, Parameter};
use realo_operator::Books;
use realo_schemas::report::Fated;
use realo_schemas::{Clock, Header, Kind, Message, Name, Payload, Report};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

/// The parameter of dora's metadata that brings an end.
const END: &str = "realo_end";
const HELLO: &str = "realo/hello";
const FATES: &str = "realo/fates";

/// The last word on an output.
///
/// It is metadata without a payload: dora takes that through its daemon, which loses nothing, where a payload in shared
/// memory is gone with the process that sent it.
#[derive(Debug, Serialize, Deserialize)]
pub(super) struct End {
    /// What the output sent in all.
    pub hops: u64,
    /// The books of the sender's stages and of all above them.
    pub books: Books,
    /// What was still to be said of messages over links.
    pub fates: Option<Fates>,
    /// The sender's, if it has one.
    pub clock: Option<Clock>,
}

/// What stages of a process said of messages over links, and with it what came from the processes above it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Fates {
    /// The process that put them together.
    pub origin: String,
    /// Their number there; several ways may lead from there to here.
    pub number: u64,
    /// What was said.
    pub fates: Vec<Fated>,
    /// What others said, each as it came: by its origin and number a process knows it on every way, round a circle too.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub passed: Vec<Fates>,
}

/// What processes said of messages over links: what of it has come, and what is still to be passed on.
#[derive(Default)]
pub(super) struct Known {
    /// This process, whose own word may come back to it.
    own: String,
    /// By process: the newest numbers that have come.
    numbers: BTreeMap<String, BTreeSet<u64>>,
    /// What others said, not yet passed on.
    passing: Vec<Fates>,
}

/// Marks of a process that are remembered, to know those that come on a second way.
const REMEMBERED: usize = 64;

impl Known {
    pub fn new(own: &str) -> Self {
        Known {
            own: own.into(),
            ..Known::default()
        }
    }

    /// Takes a mark; gives what is new of it.
    pub fn take(&mut self, mut mark: Fates) -> Vec<Fated> {
        let passed = std::mem::take(&mut mark.passed);
        let mut new = Vec::new();
        for said in std::iter::once(mark).chain(passed) {
            if said.origin == self.own {
                continue;
            }
            let numbers = self.numbers.entry(said.origin.clone()).or_default();
            let is_new = numbers.insert(said.number);
            while numbers.len() > REMEMBERED {
                numbers.pop_first();
            }
            if is_new && !said.fates.is_empty() {
                new.extend(said.fates.iter().cloned());
                self.passing.push(said);
            }
        }
        new
    }

    /// What others said since the last call.
    pub fn pass(&mut self) -> Vec<Fates> {
        std::mem::take(&mut self.passing)
    }
}

/// A message beside a stream, which opens dora's routes before the first message.
pub(super) struct Hello;

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

impl End {
    /// The end in dora's metadata, if it brings one.
    pub fn of(parameters: &MetadataParameters) -> Option<Result<End, String>> {
        match parameters.get(END)? {
            Parameter::String(json) => Some(from_json(END, json)),
            other => Some(Err(format!("`{END}`: expected text, found {other:?}"))),
        }
    }

    pub fn to_parameters(&self) -> MetadataParameters {
        MetadataParameters::from([(END.to_string(), Parameter::String(to_json(self)))])
    }
}

impl Hello {
    pub fn is_in(message: &Message) -> bool {
        matches!(report_of(message), Some((HELLO, _)))
    }

    pub fn to_message(&self, clock: Option<Clock>) -> Message {
        message(HELLO, String::new(), 0, clock)
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
        let hello = sent(&Hello.to_message(Some(CLOCK)));
        assert!(Hello::is_in(&hello));
        assert_eq!((hello.header.clock, hello.header.hop), (Some(CLOCK), 0));

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
                entry: None,
            }],
            passed: vec![Fates {
                origin: "v2x".into(),
                number: 5,
                fates: Vec::new(),
                passed: Vec::new(),
            }],
        };
        let mut books = Books::default();
        let node = NodeBooks {
            name: "nms".into(),
            errors: 3,
            ..NodeBooks::default()
        };
        books.nodes.insert("ego.nms".into(), node);
        let clock = Some(CLOCK);
        let end = End {
            hops: 9,
            books: books.clone(),
            fates: Some(fates.clone()),
            clock,
        };
        let end = End::of(&end.to_parameters()).unwrap().unwrap();
        assert_eq!((end.hops, end.books, end.clock), (9, books, clock));
        assert_eq!(end.fates, Some(fates.clone()));

        let message = sent(&fates.to_message(4, Some(CLOCK)));
        assert!(!Hello::is_in(&message));
        assert_eq!(Fates::of(&message), Ok(Some(fates)));
        assert_eq!(message.header.hop, 4);
    }

    /// Processes, each with what it was told, and how its marks are numbered.
    struct Net {
        known: Vec<Known>,
        told: Vec<Vec<u64>>,
        numbers: Vec<u64>,
    }

    impl Net {
        fn new(names: &[&str]) -> Self {
            Net {
                known: names.iter().map(|name| Known::new(name)).collect(),
                told: vec![Vec::new(); names.len()],
                numbers: vec![0; names.len()],
            }
        }

        /// A process passes on what it said and what came to it.
        fn pass(&mut self, from: usize, said: &[u64], to: &[usize]) {
            let of = |seq: &u64| Fated {
                message: Crossing {
                    from: "rsu1".into(),
                    to: "cav1".into(),
                    kind: Kind::Boxes,
                    seq: *seq,
                },
                fate: Fate::Used,
                r#use: None,
                entry: None,
            };
            let mark = Fates {
                origin: self.known[from].own.clone(),
                number: self.numbers[from],
                fates: said.iter().map(of).collect(),
                passed: self.known[from].pass(),
            };
            self.numbers[from] += 1;
            for to in to {
                let new = self.known[*to].take(mark.clone());
                self.told[*to].extend(new.iter().map(|fated| fated.message.seq));
            }
        }
    }

    #[test]
    fn what_is_said_comes_once_on_however_many_ways_and_round_a_circle() {
        // a to b and c, both to d, which leads back to a and b.
        let mut net = Net::new(&["a", "b", "c", "d"]);
        for round in 0..50 {
            let seq = 10 * round;
            net.pass(0, &[seq], &[1, 2]);
            net.pass(1, &[seq + 1], &[3]);
            net.pass(2, &[], &[3]);
            net.pass(3, &[seq + 3], &[0, 1]);
        }
        for (place, own) in [0, 1, 2, 3].into_iter().enumerate() {
            let told = &mut net.told[place];
            told.sort_unstable();
            let mut once = told.clone();
            once.dedup();
            assert_eq!(*told, once, "process {place}");
            assert!(
                told.iter().all(|seq| seq % 10 != own),
                "its own word does not come back"
            );
        }
        assert_eq!(net.told[3].len(), 100, "all of a and b");
        assert_eq!(net.told[0].len(), 100, "all of b and d");
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
            assert!(!Hello::is_in(&message));
            assert_eq!(Fates::of(&message), Ok(None));
        }
        assert!(End::of(&MetadataParameters::new()).is_none());
        let broken = |value| {
            End::of(&MetadataParameters::from([(END.to_string(), value)]))
                .unwrap()
                .err()
        };
        let errors = [
            (END, broken(Parameter::String("{\"hops\": 3}".into()))),
            (END, broken(Parameter::Integer(3))),
            (FATES, Fates::of(&report(FATES, "{\"hops\": 3}")).err()),
        ];
        for (topic, error) in errors {
            let error = error.expect("a broken mark");
            assert!(error.starts_with(&format!("`{topic}`: ")), "{error}");
        }
    }
}
