//! What both drivers do around one call of an operator.

use realo_schemas::{Message, Name, Nanos, TraceEntry};

use crate::intake::Work;
use crate::pipe::Gone;
use crate::{AnyOperator, Error, NodeBooks, Outputs, PortId, Registration};

/// Errors of a node that are printed; the rest is only counted.
const LOGGED_ERRORS: u64 = 5;

/// One node's identity, counters and numbering of outputs.
pub(crate) struct Stage {
    pub id: Name,
    pub registration: &'static Registration,
    pub books: NodeBooks,
    /// Messages sent so far on each output.
    pub hops: Vec<u64>,
}

/// A call as it went: what it made and when it was asked for again.
pub(crate) struct Called {
    pub sent: Vec<(PortId, Message)>,
    pub wakes: std::collections::BTreeSet<Nanos>,
    /// `on_input` calls that failed: the port and the message's identity.
    pub failed: Vec<(PortId, Message)>,
    /// Why the stage cannot be called again; the run fails.
    pub gone: Option<Error>,
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

    /// Hands work to the operator; `start` is the log time of the call.
    pub fn run(&mut self, operator: &mut dyn AnyOperator, work: Work, start: Nanos) -> Called {
        let mut out = Outputs::at(start);
        let mut failed = Vec::new();
        for (port, message) in work.calls {
            let header = message.header.clone();
            if let Err(error) = operator.on_input(port, message, &mut out) {
                if error.is::<Gone>() {
                    return self.called(out, failed, Some(error));
                }
                self.log(
                    &format!("input `{}`, {header}", self.registration.inputs[port.0].name),
                    &error,
                );
                failed.push((port, Message::new(header, realo_schemas::Boxes::default())));
            }
        }
        self.called(out, failed, None)
    }

    /// Wakes the operator.
    pub fn wake(&mut self, operator: &mut dyn AnyOperator, start: Nanos) -> Called {
        let mut out = Outputs::at(start);
        let woken = operator.on_wake(start, &mut out);
        self.asked(&format!("wake at {start} ns"), woken, out)
    }

    /// Tells the operator that nothing follows.
    pub fn end(&mut self, operator: &mut dyn AnyOperator, start: Nanos) -> Called {
        let mut out = Outputs::at(start);
        let ended = operator.on_end(&mut out);
        self.asked("end of the stream", ended, out)
    }

    fn asked(&mut self, place: &str, done: Result<(), Error>, out: Outputs) -> Called {
        match done {
            Err(error) if error.is::<Gone>() => return self.called(out, Vec::new(), Some(error)),
            Err(error) => self.log(place, &error),
            Ok(()) => {}
        }
        self.called(out, Vec::new(), None)
    }

    fn called(&mut self, out: Outputs, failed: Vec<(PortId, Message)>, gone: Option<Error>) -> Called {
        for (counter, n) in out.counts {
            let count = self.books.counters.entry(counter.into_owned()).or_default();
            *count = count.saturating_add(n);
        }
        Called {
            sent: out.sent,
            wakes: out.wakes,
            failed,
            gone,
        }
    }

    fn log(&mut self, place: &str, error: &Error) {
        self.books.errors += 1;
        if self.books.errors <= LOGGED_ERRORS {
            eprintln!("realo: {} ({}): {place}: {error}", self.id, self.registration.name);
            if self.books.errors == LOGGED_ERRORS {
                eprintln!("realo: {}: further errors are counted, not printed", self.id);
            }
        }
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
