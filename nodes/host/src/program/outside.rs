//! Programs that are sources and sinks of a graph.

use std::collections::VecDeque;

use realo_clock::wall_now;
use realo_operator::{AnyOperator, AnySink, AnySource, Books, Built, Counts, Error, Outputs, PortId, Role};
use realo_schemas::report::Fated;
use realo_schemas::{Clock, Message, Nanos};

use super::Child;
use crate::dora::is_ending;

impl Child {
    /// The stage that the program serves. A sink opens what it needs.
    ///
    /// # Errors
    /// What keeps a sink from the world outside.
    pub(crate) fn into_built(mut self) -> Result<Built, String> {
        Ok(match self.registration().role {
            Role::Source => Built::Source(Box::new(ProgramSource {
                child: self,
                came: VecDeque::new(),
                counts: Counts::default(),
                has_ended: false,
            })),
            Role::Sink => {
                let mut out = Outputs::at(wall_now());
                self.on_wake(out.now(), &mut out).map_err(|error| error.to_string())?;
                Built::Sink(Box::new(ProgramSink(self)))
            }
            Role::Operator | Role::Gateway => Built::Operator(Box::new(self)),
        })
    }
}

/// A program that brings messages in: it is woken again and again, and waits for a moment each time.
struct ProgramSource {
    child: Child,
    /// What it has sent and nobody has taken yet.
    came: VecDeque<(PortId, Message)>,
    counts: Counts,
    has_ended: bool,
}

impl ProgramSource {
    fn wake(&mut self) -> Result<(), Error> {
        let mut out = Outputs::at(wall_now());
        let is_last = match is_ending() {
            true => true,
            false => {
                self.child.on_wake(out.now(), &mut out)?;
                let made = out.into_made();
                let is_last = made.wakes.is_empty();
                self.counts.extend(made.counts);
                self.came.extend(made.sent);
                out = Outputs::at(wall_now());
                is_last
            }
        };
        if is_last {
            self.has_ended = true;
            self.child.on_end(&mut out)?;
            let made = out.into_made();
            self.counts.extend(made.counts);
            self.came.extend(made.sent);
        }
        Ok(())
    }
}

impl AnySource for ProgramSource {
    fn next(&mut self) -> Result<Option<(Nanos, PortId, Message)>, Error> {
        loop {
            if let Some((port, message)) = self.came.pop_front() {
                return Ok(Some((message.header.ready, port, message)));
            }
            if self.has_ended {
                return Ok(None);
            }
            self.wake()?;
        }
    }

    fn rate(&self) -> f64 {
        1.0
    }

    fn clock(&self, _: Nanos) -> Option<Clock> {
        None
    }

    fn counts(&self) -> Counts {
        self.counts.clone()
    }

    fn is_live(&self) -> bool {
        true
    }
}

/// A program that takes messages out.
struct ProgramSink(Child);

impl AnySink for ProgramSink {
    fn accept(&mut self, port: PortId, message: Message, out: &mut Outputs) -> Result<(), Error> {
        self.0.on_input(port, message, out)
    }

    fn fates(&mut self, _: &[Fated]) -> Result<(), Error> {
        Ok(())
    }

    fn finish(&mut self, _: &Books, out: &mut Outputs) -> Result<(), Error> {
        self.0.on_end(out)
    }

    fn outlives_errors(&self) -> bool {
        true
    }
}
