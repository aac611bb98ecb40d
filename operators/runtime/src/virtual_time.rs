//! Runs a whole graph as a discrete-event simulation in one process.
//!
//! Every stage has one server for each agent; the order of events is total and does not depend on threads, so a run
//! gives the same bits each time. Time is the log's; computing takes what the [`ComputeProfile`] says. A plug-in runs as a
//! child process and answers one call at a time ([`crate::pipe`]), so it changes nothing in that order.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet, BinaryHeap};
use std::rc::Rc;

use realo_schemas::{Kind, Message, Name, Nanos};

use crate::intake::{Intake, Overflow, Work};
use crate::stage::{Called, Stage};
use crate::{AnyOperator, AnySink, AnySource, Books, Built, Class, ComputeProfile, PortId, Wiring, WrongType};

/// Why a run in virtual time failed.
#[derive(Debug, thiserror::Error)]
pub enum RunError {
    /// A node could not be built.
    #[error("node `{node}`: {reason}")]
    Build {
        /// Its id.
        node: String,
        /// What the configuration or its files lack.
        reason: String,
    },
    /// A source or sink could not go on.
    #[error("node `{node}` failed: {reason}")]
    Node {
        /// Its id.
        node: String,
        /// What went wrong.
        reason: String,
    },
    /// A message that an input does not take.
    #[error("node `{node}`: {wrong}")]
    Type {
        /// The receiver's id.
        node: String,
        /// Which input, what it takes, and what came.
        wrong: WrongType,
    },
    /// A stage fell behind without bound.
    #[error("node `{node}`: {overflow}; give it a `latest` port or a faster profile")]
    Overflow {
        /// Its id.
        node: String,
        /// Which input.
        overflow: Overflow,
    },
}

/// Sees every message that a node sends, with the node's id and the output's name.
pub type Observer<'a> = &'a mut dyn FnMut(&str, &str, &Message);

/// Runs a graph to its end and returns the books of all nodes.
///
/// # Errors
/// [`RunError`] names the node that could not be built or go on.
pub fn run(wiring: &Wiring, compute: &ComputeProfile, observer: Observer) -> Result<Books, RunError> {
    let mut simulation = Simulation::new(wiring, compute, observer)?;
    while let Some(Reverse(event)) = simulation.events.pop() {
        simulation.handle(event)?;
    }
    Ok(simulation.books)
}

/// Order among the events of one instant and stage.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum EventClass {
    ServerFree,
    State,
    Data,
    Wake,
    Query,
    End,
}

impl From<Class> for EventClass {
    fn from(class: Class) -> Self {
        match class {
            Class::State => EventClass::State,
            Class::Data => EventClass::Data,
            Class::Query => EventClass::Query,
        }
    }
}

#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
struct Key {
    time: Nanos,
    rank: usize,
    class: EventClass,
    port: usize,
    agent: Name,
    kind: Option<Kind>,
    seq: u64,
    emission: u64,
}

enum What {
    Release(Option<(PortId, Message)>),
    Arrive(Message),
    ServerFree,
    Wake,
    End(Rc<Books>),
}

struct Event {
    key: Key,
    what: What,
}

impl PartialEq for Event {
    fn eq(&self, other: &Self) -> bool {
        self.key == other.key
    }
}
impl Eq for Event {}
impl PartialOrd for Event {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}
impl Ord for Event {
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        self.key.cmp(&other.key)
    }
}

enum Body {
    Operator(Box<dyn AnyOperator>),
    Source(Box<dyn AnySource>),
    Sink(Box<dyn AnySink>),
}

/// One node of the running graph.
struct Running {
    stage: Stage,
    body: Body,
    intake: Intake,
    compute: Nanos,
    /// Until when each agent's server is busy.
    busy: BTreeMap<Name, Nanos>,
    /// Wakes that were asked for and have not come yet.
    wakes: BTreeSet<(Nanos, Name)>,
    /// Wakes that came while their server was busy.
    late_wakes: BTreeSet<(Nanos, Name)>,
    consumers: Vec<Vec<(usize, PortId)>>,
    last_ready: Vec<Nanos>,
    open_inputs: usize,
    above: Books,
    finished: bool,
}

impl Running {
    fn is_free(&self, server: &str, now: Nanos) -> bool {
        self.busy.get(server).is_none_or(|until| *until <= now)
    }

    fn is_done(&self, now: Nanos) -> bool {
        if matches!(self.body, Body::Source(_)) {
            // A source says itself when it ends.
            return false;
        }
        let idle = self.intake.is_idle() && self.wakes.is_empty() && self.late_wakes.is_empty();
        !self.finished && self.open_inputs == 0 && idle && self.busy.values().all(|until| *until <= now)
    }
}

struct Simulation<'a> {
    events: BinaryHeap<Reverse<Event>>,
    nodes: Vec<Running>,
    observer: Observer<'a>,
    books: Books,
    emissions: u64,
}

impl<'a> Simulation<'a> {
    fn new(wiring: &Wiring, compute: &ComputeProfile, observer: Observer<'a>) -> Result<Self, RunError> {
        let mut nodes = Vec::new();
        for (index, node) in wiring.nodes.iter().enumerate() {
            let registration = node.registration;
            let built = match &node.program {
                None => (registration.build)(&node.args),
                Some(program) => program
                    .start()
                    .map(|child| Built::Operator(Box::new(child)))
                    .map_err(crate::Error::from),
            };
            let built = built.map_err(|error| RunError::Build {
                node: node.id.to_string(),
                reason: error.to_string(),
            })?;
            let wired: Vec<bool> = node.inputs.iter().map(Option::is_some).collect();
            nodes.push(Running {
                stage: Stage::new(node.id.clone(), registration),
                body: match built {
                    Built::Operator(operator) => Body::Operator(operator),
                    Built::Source(source) => Body::Source(source),
                    Built::Sink(sink) => Body::Sink(sink),
                },
                open_inputs: wired.iter().filter(|wired| **wired).count(),
                intake: Intake::new(registration.inputs, wired),
                compute: compute.of(&node.id),
                busy: BTreeMap::new(),
                wakes: BTreeSet::new(),
                late_wakes: BTreeSet::new(),
                consumers: (0..registration.outputs.len())
                    .map(|o| wiring.consumers(index, PortId(o)))
                    .collect(),
                last_ready: vec![Nanos::MIN; registration.outputs.len()],
                above: Books::default(),
                finished: false,
            });
        }
        let mut simulation = Simulation {
            events: BinaryHeap::new(),
            nodes,
            observer,
            books: Books::default(),
            emissions: 0,
        };
        for rank in 0..simulation.nodes.len() {
            simulation.schedule_release(rank, Nanos::MIN)?;
        }
        Ok(simulation)
    }

    /// Schedules what concerns a message.
    fn push(&mut self, time: Nanos, rank: usize, class: EventClass, port: PortId, of: &Message, what: What) {
        let header = &of.header;
        let (agent, kind, seq) = (header.agent.clone(), Some(header.kind), header.seq);
        let key = Key {
            time,
            rank,
            class,
            port: port.0,
            agent,
            kind,
            seq,
            emission: self.emissions,
        };
        self.emissions += 1;
        self.events.push(Reverse(Event { key, what }));
    }

    /// Schedules what concerns a stage or one of its servers.
    fn push_plain(&mut self, time: Nanos, rank: usize, class: EventClass, port: PortId, agent: Name, what: What) {
        let key = Key {
            time,
            rank,
            class,
            port: port.0,
            agent,
            kind: None,
            seq: 0,
            emission: self.emissions,
        };
        self.emissions += 1;
        self.events.push(Reverse(Event { key, what }));
    }

    /// Pulls the next message of a source and schedules its release, or the source's end.
    fn schedule_release(&mut self, rank: usize, now: Nanos) -> Result<(), RunError> {
        let Body::Source(source) = &mut self.nodes[rank].body else {
            return Ok(());
        };
        let next = source.next();
        let next = next.map_err(|error| failed(&self.nodes[rank].stage.id, &error))?;
        match next {
            Some((time, port, message)) => {
                let keyed = message.clone();
                let what = What::Release(Some((port, message)));
                self.push(time.max(now), rank, EventClass::Data, port, &keyed, what);
            }
            None => self.push_plain(
                now,
                rank,
                EventClass::End,
                PortId(0),
                Name::default(),
                What::Release(None),
            ),
        }
        Ok(())
    }

    fn handle(&mut self, event: Event) -> Result<(), RunError> {
        let Key {
            time,
            rank,
            agent,
            port,
            ..
        } = event.key;
        match event.what {
            What::Release(Some((port, message))) => {
                self.dispatch(rank, vec![(port, message)], time, time, time);
                self.schedule_release(rank, time)?;
            }
            What::Release(None) => self.finish(rank, time)?,
            What::Arrive(message) => self.arrive(rank, PortId(port), message, time)?,
            What::ServerFree => self.serve(rank, &agent, time)?,
            What::Wake => {
                self.nodes[rank].wakes.remove(&(time, agent.clone()));
                self.nodes[rank].late_wakes.insert((time, agent.clone()));
                self.serve(rank, &agent, time)?;
            }
            What::End(books) => {
                let node = &mut self.nodes[rank];
                node.above.merge(&books);
                node.open_inputs -= 1;
            }
        }
        if self.nodes[rank].is_done(time) {
            self.finish(rank, time)?;
        }
        Ok(())
    }

    fn arrive(&mut self, rank: usize, port: PortId, message: Message, now: Nanos) -> Result<(), RunError> {
        let node = &mut self.nodes[rank];
        let admitted = node.stage.registration.inputs[port.0].admit(&message);
        admitted.map_err(|wrong| RunError::Type {
            node: node.stage.id.to_string(),
            wrong,
        })?;
        if let Body::Sink(sink) = &mut node.body {
            node.intake.books_of(port).received.add(&message);
            return sink
                .accept(port, message)
                .map_err(|error| failed(&node.stage.id, &error));
        }
        let server = message.header.agent.clone();
        node.intake
            .offer(&server, port, message)
            .map_err(|overflow| RunError::Overflow {
                node: node.stage.id.to_string(),
                overflow,
            })?;
        self.serve(rank, &server, now)
    }

    /// Starts what waits for a server, as long as it is free.
    fn serve(&mut self, rank: usize, server: &Name, now: Nanos) -> Result<(), RunError> {
        loop {
            let node = &mut self.nodes[rank];
            if !node.is_free(server, now) {
                return Ok(());
            }
            let wake = node.late_wakes.iter().find(|(_, agent)| agent == server).cloned();
            let wake_first = match (&wake, node.intake.first(server)) {
                (Some((at, _)), Some((ready, class))) => (*at, EventClass::Wake) < (ready, class.into()),
                (wake, None) => wake.is_some(),
                (None, Some(_)) => false,
            };
            if let (Some(wake), true) = (wake, wake_first) {
                node.late_wakes.remove(&wake);
                self.call(rank, server, now, None)?;
            } else if let Some(work) = node.intake.next(server) {
                self.call(rank, server, now, Some(work))?;
            } else {
                return Ok(());
            }
        }
    }

    /// One call of an operator, and what follows from it.
    fn call(&mut self, rank: usize, server: &Name, start: Nanos, work: Option<Work>) -> Result<(), RunError> {
        let node = &mut self.nodes[rank];
        let Body::Operator(operator) = &mut node.body else {
            return Ok(());
        };
        let input = work.as_ref().map_or(start, |work| work.ready);
        let called = match work {
            Some(work) => node.stage.run(operator.as_mut(), work, start),
            None => node.stage.wake(operator.as_mut(), start),
        };
        if let Some(error) = &called.gone {
            return Err(failed(&node.stage.id, error));
        }
        node.stage.books.compute.record(node.compute);
        let done = start + node.compute;
        node.busy.insert(server.clone(), done);
        if node.compute > 0 {
            self.push_plain(
                done,
                rank,
                EventClass::ServerFree,
                PortId(0),
                server.clone(),
                What::ServerFree,
            );
        }
        self.follow(rank, server, called, input, start, done);
        Ok(())
    }

    fn follow(&mut self, rank: usize, server: &Name, called: Called, input: Nanos, start: Nanos, done: Nanos) {
        let node = &mut self.nodes[rank];
        for (port, message) in &called.failed {
            node.intake.reject(*port, message);
        }
        for time in called.wakes {
            if self.nodes[rank].wakes.insert((time, server.clone())) {
                self.push_plain(time, rank, EventClass::Wake, PortId(0), server.clone(), What::Wake);
            }
        }
        self.dispatch(rank, called.sent, input, start, done);
    }

    /// Sends messages on; they arrive when they are ready.
    fn dispatch(&mut self, rank: usize, sent: Vec<(PortId, Message)>, input: Nanos, start: Nanos, done: Nanos) {
        for (port, mut message) in sent {
            let node = &mut self.nodes[rank];
            node.stage.stamp(port, &mut message, input, start, done);
            let ready = message.header.ready;
            node.last_ready[port.0] = node.last_ready[port.0].max(ready);
            (self.observer)(&node.stage.id, node.stage.registration.outputs[port.0].name, &message);
            for (to, input) in node.consumers[port.0].clone() {
                let class = self.nodes[to].stage.registration.inputs[input.0].class.into();
                let arriving = message.clone();
                self.push(ready, to, class, input, &message, What::Arrive(arriving));
            }
        }
    }

    /// Ends a node whose inputs have ended and which has nothing left to do.
    fn finish(&mut self, rank: usize, now: Nanos) -> Result<(), RunError> {
        self.nodes[rank].finished = true;
        let node = &mut self.nodes[rank];
        if let Body::Operator(operator) = &mut node.body {
            let called = node.stage.end(operator.as_mut(), now);
            if let Some(error) = &called.gone {
                return Err(failed(&node.stage.id, error));
            }
            self.dispatch(rank, called.sent, now, now, now);
        }
        let node = &mut self.nodes[rank];
        node.intake.close();
        let mut own = node.stage.books.clone();
        own.inputs = node
            .intake
            .books()
            .iter()
            .map(|(port, books)| (port.to_string(), books.clone()))
            .collect();
        if let Body::Source(source) = &node.body {
            own.counters = source.counters();
        }
        let mut books = std::mem::take(&mut node.above);
        books.nodes.insert(node.stage.id.to_string(), own);
        if let Body::Sink(sink) = &mut node.body {
            sink.finish(&books).map_err(|error| failed(&node.stage.id, &error))?;
        }
        self.books.merge(&books);
        let books = Rc::new(books);
        for output in 0..self.nodes[rank].consumers.len() {
            let time = now.max(self.nodes[rank].last_ready[output]);
            for (to, input) in self.nodes[rank].consumers[output].clone() {
                self.push_plain(
                    time,
                    to,
                    EventClass::End,
                    input,
                    Name::default(),
                    What::End(books.clone()),
                );
            }
        }
        Ok(())
    }
}

fn failed(node: &Name, error: &crate::Error) -> RunError {
    RunError::Node {
        node: node.to_string(),
        reason: error.to_string(),
    }
}
