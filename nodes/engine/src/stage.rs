//! One stage's identity, counters and numbering of outputs; and one call of it.

use std::collections::BTreeSet;

use realo_operator::{Built, Error, Made, NodeBooks, Outputs, PortId, Registration};
use realo_schemas::report::{Crossing, Fate, Fated};
use realo_schemas::{Message, Name, Nanos, Payload, TraceEntry};

/// Errors of a stage that are told; the rest is only counted.
const TOLD_ERRORS: u64 = 5;

/// Why a stage can no longer be called; the run fails.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct Gone(pub String);

/// What a stage is called for.
#[derive(Debug)]
pub enum Call {
    /// One message, or a complete set in declared order.
    Inputs(Vec<(PortId, Message)>),
    /// A wake that it asked for.
    Wake,
    /// Nothing follows; a sink gets the books of the graph.
    End(Box<realo_operator::Books>),
}

/// All that came of a call.
#[derive(Debug, Default)]
pub struct Called {
    pub(crate) made: Made,
    /// What the operator could not take: the place, the reason.
    pub(crate) errors: Vec<String>,
    /// Why the stage cannot be called again.
    pub(crate) gone: Option<Error>,
}

impl Call {
    /// Calls a stage; `start` is the log time of the call, `fates` what a sink has not been told yet.
    pub fn make(self, built: &mut Built, inputs: &Registration, start: Nanos, fates: &[Fated]) -> Called {
        let mut called = Called::default();
        let mut out = Outputs::at(start);
        match built {
            Built::Operator(operator) => match self {
                Call::Inputs(calls) => {
                    for (port, message) in calls {
                        let (text, carried) = (message.header.to_string(), crossings(&message));
                        let Err(error) = operator.on_input(port, message, &mut out) else {
                            continue;
                        };
                        if error.is::<Gone>() {
                            called.gone = Some(error);
                            break;
                        }
                        let name = inputs.inputs.get(port.0).map_or("?", |port| port.name);
                        called.errors.push(format!("input `{name}`, {text}: {error}"));
                        called.made.fates.extend(told(carried, Fate::Rejected));
                    }
                }
                Call::Wake => called.note(&format!("wake at {start} ns"), operator.on_wake(start, &mut out)),
                Call::End(_) => called.note("end of the stream", operator.on_end(&mut out)),
            },
            Built::Sink(sink) => {
                let taken = sink.fates(fates).and_then(|()| match self {
                    Call::Inputs(calls) => calls
                        .into_iter()
                        .try_for_each(|(port, message)| sink.accept(port, message)),
                    Call::Wake => Ok(()),
                    Call::End(books) => sink.finish(&books),
                });
                called.gone = taken.err();
            }
            Built::Source(_) => {}
        }
        let rejected = std::mem::take(&mut called.made.fates);
        called.made = out.into_made();
        called.made.fates.extend(rejected);
        called
    }
}

impl Called {
    fn note(&mut self, place: &str, done: Result<(), Error>) {
        match done {
            Err(error) if error.is::<Gone>() => self.gone = Some(error),
            Err(error) => self.errors.push(format!("{place}: {error}")),
            Ok(()) => {}
        }
    }

    /// What is charged for the call: what triggered it, and which outputs it sent on.
    pub fn trigger(&self, cause: &str, registration: &Registration) -> String {
        let ports: BTreeSet<PortId> = self.made.sent.iter().map(|(port, _)| *port).collect();
        let names: Vec<&str> = ports
            .iter()
            .filter_map(|port| Some(registration.outputs.get(port.0)?.name))
            .collect();
        match names.is_empty() {
            true => cause.to_string(),
            false => format!("{cause} > {}", names.join(", ")),
        }
    }
}

/// The messages over links that a message is, or that it selects.
pub(crate) fn crossings(message: &Message) -> Vec<Crossing> {
    match &message.payload {
        Payload::Selection(selection) => selection
            .entries
            .iter()
            .filter_map(|entry| Crossing::of(&entry.header))
            .collect(),
        _ => Crossing::of(&message.header).into_iter().collect(),
    }
}

pub(crate) fn told(messages: Vec<Crossing>, fate: Fate) -> impl Iterator<Item = Fated> {
    messages.into_iter().map(move |message| Fated {
        message,
        fate,
        r#use: None,
    })
}

/// One stage's identity, counters and numbering of outputs.
pub(crate) struct Stage {
    pub id: Name,
    pub registration: &'static Registration,
    pub books: NodeBooks,
    /// Messages sent so far on each output.
    pub hops: Vec<u64>,
}

impl Stage {
    pub fn new(id: Name, registration: &'static Registration) -> Self {
        let books = NodeBooks {
            name: registration.name.into(),
            ..NodeBooks::default()
        };
        Stage {
            id,
            registration,
            books,
            hops: vec![0; registration.outputs.len()],
        }
    }

    /// Counts what came of a call; gives what is to be told of its errors.
    pub fn count(&mut self, called: &mut Called) -> Vec<String> {
        for (counter, n) in std::mem::take(&mut called.made.counts) {
            let count = self.books.counters.entry(counter.into_owned()).or_default();
            *count = count.saturating_add(n);
        }
        for channel in std::mem::take(&mut called.made.traffic) {
            self.books.carried(channel);
        }
        let mut lines = Vec::new();
        for error in std::mem::take(&mut called.errors) {
            self.books.errors += 1;
            if self.books.errors <= TOLD_ERRORS {
                lines.push(format!("{} ({}): {error}", self.id, self.registration.name));
            }
            if self.books.errors == TOLD_ERRORS {
                lines.push(format!("{}: further errors are counted, not printed", self.id));
            }
        }
        lines
    }

    /// Stamps an outgoing message: its number on the output, when it is ready, and this stage in its trace.
    ///
    /// The operator saw the call begin at `start`; a `ready` beyond that is a delay which follows the computation.
    pub fn stamp(&mut self, port: PortId, message: &mut Message, input: Nanos, start: Nanos, done: Nanos) {
        let header = &mut message.header;
        let delay = (header.ready - start).max(0);
        header.ready = done + delay;
        header.hop = self.hops[port.0];
        self.hops[port.0] += 1;
        header.trace.push(TraceEntry {
            node: self.id.clone(),
            input,
            start,
            done,
            ready: header.ready,
        });
        let output = self.registration.outputs[port.0].name;
        match self.books.outputs.get_mut(output) {
            Some(tally) => tally.add(message),
            None => self.books.outputs.entry(output.into()).or_default().add(message),
        }
    }
}
