//! The state machine.

mod running;
mod sending;
mod serving;

use std::cmp::Reverse;
use std::collections::{BinaryHeap, VecDeque};

use realo_operator::{Books, Counts, PortId, Registration, Role, WrongType};
use realo_schemas::report::Fated;
use realo_schemas::{Clock, Message, Name, Nanos};

use self::running::{Life, Running};
use crate::Wiring;
use crate::event::{Event, Key, Order, What};
use crate::intake::Overflow;
use crate::stage::{Call, Called};

/// What triggers the last call of a stage.
const END: &str = "end";

/// How many calls of one stage may be under way.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Servers {
    /// One for each agent, and of what crossed a link for each sender and receiver: agents do not wait for each other
    /// (virtual time).
    PerStream,
    /// One in all (a process).
    One,
}

/// Why the stages cannot go on.
#[derive(Debug, thiserror::Error)]
pub enum EngineError {
    /// A source, a sink or a program failed.
    #[error("node `{node}` failed: {reason}")]
    Failed {
        /// The stage's id.
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
    #[error("node `{node}`: {overflow}; give it a `latest` port, or less to do")]
    Overflow {
        /// Its id.
        node: String,
        /// Which input.
        overflow: Overflow,
    },
}

/// What is to be done next.
#[derive(Debug)]
pub enum Step {
    /// A stage is to be called; [`Engine::complete`] takes what comes of it.
    Call(Task),
    /// A message of this source was released; the next one is wanted.
    Released(usize),
}

/// One call of a stage.
#[derive(Debug)]
pub struct Task {
    /// The call under way.
    pub ticket: Ticket,
    /// What the stage is called for.
    pub call: Call,
    /// Fates that a sink has not seen yet.
    pub fates: Vec<Fated>,
}

/// A call that is under way.
#[derive(Clone, Debug)]
pub struct Ticket {
    /// Index of the stage.
    pub stage: usize,
    /// Log time of the call.
    pub start: Nanos,
    /// What triggered it: an input's name, `wake` or `end`.
    pub cause: &'static str,
    server: Name,
    /// When the last of what it takes was ready.
    input: Nanos,
}

impl Ticket {
    /// Whether nothing follows.
    pub fn is_end(&self) -> bool {
        self.cause == END
    }
}

/// A message for somebody outside.
#[derive(Debug)]
pub struct Leaving {
    /// Index of the stage that sent it.
    pub stage: usize,
    /// Its output.
    pub port: PortId,
    /// The message.
    pub message: Message,
}

/// Stages, what waits for them, and when it is due. Without clock or I/O: messages and the time go in, calls and what
/// leaves come out.
pub struct Engine {
    stages: Vec<Running>,
    servers: Servers,
    events: BinaryHeap<Reverse<Event>>,
    /// Servers to look at before the next event.
    open: VecDeque<(usize, Name)>,
    emissions: u64,
    leaving: Vec<Leaving>,
    /// For somebody outside.
    fates: Vec<Fated>,
    complaints: Vec<String>,
    books: Books,
    clock: Option<Clock>,
    run: Name,
}

impl Engine {
    /// Stages that have nothing to do yet.
    pub fn new(wiring: &Wiring, servers: Servers) -> Self {
        let stages = (0..wiring.stages.len()).map(|index| Running::new(wiring, index));
        let stages: Vec<Running> = stages.collect();
        // A stage without inputs, a sink alone in its process among them, has to be looked at once.
        let open = (0..stages.len()).map(|stage| (stage, Name::default())).collect();
        Engine {
            stages,
            servers,
            events: BinaryHeap::new(),
            open,
            emissions: 0,
            leaving: Vec::new(),
            fates: Vec::new(),
            complaints: Vec::new(),
            books: Books::default(),
            clock: None,
            run: Name::default(),
        }
    }

    /// Sets the clock that outgoing headers carry.
    pub fn set_clock(&mut self, clock: Clock) {
        self.clock.get_or_insert(clock);
    }

    /// Whether every stage has ended.
    pub fn is_done(&self) -> bool {
        self.stages.iter().all(|running| running.life == Life::Ended)
    }

    /// Whether a stage has ended.
    pub fn has_ended(&self, stage: usize) -> bool {
        self.stages[stage].life == Life::Ended
    }

    /// Whether nothing comes from an output any more.
    pub fn output_has_ended(&self, stage: usize, port: PortId) -> bool {
        self.stages[stage].has_ended(port.0)
    }

    /// The id of a stage.
    pub fn id(&self, stage: usize) -> &Name {
        &self.stages[stage].stage.id
    }

    /// What a stage is.
    pub fn registration(&self, stage: usize) -> &'static Registration {
        self.stages[stage].stage.registration
    }

    /// What was sent on an output so far.
    pub fn hops(&self, stage: usize, port: PortId) -> u64 {
        self.stages[stage].stage.hops[port.0]
    }

    /// A number on an output for something that is no message of its stage.
    pub fn take_hop(&mut self, stage: usize, port: PortId) -> u64 {
        let hops = &mut self.stages[stage].stage.hops[port.0];
        *hops += 1;
        *hops - 1
    }

    /// The clock that outgoing headers carry.
    pub fn clock(&self) -> Option<Clock> {
        self.clock
    }

    /// Books of the input of a stage, for who brings messages to it from outside.
    pub fn input_books(&mut self, stage: usize, port: PortId) -> &mut realo_operator::InputBooks {
        self.stages[stage].intake.books_of(port)
    }

    /// Books of all stages that have ended, and of those outside that were heard of.
    pub fn books(&self) -> Books {
        let mut books = self.books.clone();
        for sink in self.stages.iter().filter(|running| running.role() == Role::Sink) {
            books.nodes.insert(sink.stage.id.to_string(), sink.own_books());
        }
        books
    }

    /// Messages that a stage skipped so far because it was busy.
    pub fn skipped(&self, stage: usize) -> u64 {
        self.stages[stage]
            .own_books()
            .inputs
            .values()
            .map(|books| books.skipped.total())
            .sum()
    }

    /// Takes over books of stages outside.
    pub fn merge_books(&mut self, books: &Books) {
        self.books.merge(books);
    }

    /// What is to leave, in the order in which it was sent.
    pub fn take_leaving(&mut self) -> Vec<Leaving> {
        std::mem::take(&mut self.leaving)
    }

    /// What was said of messages over links, for sinks outside.
    pub fn take_fates(&mut self) -> Vec<Fated> {
        std::mem::take(&mut self.fates)
    }

    /// What is to be printed of errors.
    pub fn take_complaints(&mut self) -> Vec<String> {
        std::mem::take(&mut self.complaints)
    }

    /// Takes what was said of messages over links: for this engine's sinks, and for those outside.
    pub fn report(&mut self, fates: Vec<Fated>) {
        self.hear(&fates);
        self.fates.extend(fates);
    }

    /// Takes what was said of messages over links elsewhere: for this engine's sinks alone.
    pub fn hear(&mut self, fates: &[Fated]) {
        for sink in self.stages.iter_mut().filter(|running| running.role() == Role::Sink) {
            sink.fates.extend(fates.iter().cloned());
        }
    }

    /// Schedules the release of a source's message.
    pub fn schedule(&mut self, stage: usize, time: Nanos, port: PortId, message: Message) {
        let key = self.key_of(time, stage, Order::Data, port, &message);
        self.push(key, What::Release(port, message));
    }

    /// Releases a source's message that was due at `time`, now.
    pub fn release(&mut self, stage: usize, port: PortId, message: Message, time: Nanos, now: Nanos) {
        // A source that could not keep up says so: what it releases late is ready late.
        let done = now.max(time);
        if self.run.is_empty() {
            self.run = message.header.run.clone();
        }
        if self.clock.is_some() {
            self.stages[stage].stage.books.late.record(now - time);
        }
        self.dispatch(stage, vec![(port, message)], time, done, done);
    }

    /// Has a stage called as if it had asked to be woken now.
    pub fn wake(&mut self, stage: usize, now: Nanos) {
        let running = &mut self.stages[stage];
        if running.life == Life::Open && running.wakes.insert((now, Name::default())) {
            let key = self.key(now, stage, Order::Wake, PortId(0), Name::default());
            self.push(key, What::Wake);
        }
    }

    /// Ends a source.
    pub fn close_source(&mut self, stage: usize, counts: Counts, now: Nanos) {
        let lines = self.stages[stage].stage.count_up(counts);
        self.complaints.extend(lines);
        self.end(stage, now);
    }

    /// Takes a message from outside; whether the input takes its type, [`Engine::step`] says.
    pub fn deliver(&mut self, stage: usize, port: PortId, message: Message) {
        if self.run.is_empty() {
            self.run = message.header.run.clone();
        }
        let running = &mut self.stages[stage];
        running.last_in[port.0] = running.last_in[port.0].max(message.header.ready);
        self.arrival(stage, port, message);
    }

    /// An input from outside has ended; what came before is still served.
    pub fn end_input(&mut self, stage: usize, port: PortId, now: Nanos) {
        let time = now.max(self.stages[stage].last_in[port.0]);
        let key = self.key(time, stage, Order::End, port, Name::default());
        self.push(key, What::End);
    }

    /// When the next event is due; the past if something can be done at once.
    pub fn next_due(&self) -> Option<Nanos> {
        match self.open.is_empty() {
            true => self.events.peek().map(|Reverse(event)| event.key.time),
            false => Some(Nanos::MIN),
        }
    }

    /// What is to be done at `now`; `None` until [`Engine::next_due`], or until something comes from outside.
    ///
    /// # Errors
    /// [`EngineError`] ends the run.
    pub fn step(&mut self, now: Nanos) -> Result<Option<Step>, EngineError> {
        loop {
            if let Some((stage, server)) = self.open.pop_front() {
                match self.serve(stage, &server, now) {
                    Some(task) => return Ok(Some(Step::Call(task))),
                    None => continue,
                }
            }
            let due = |Reverse(event): &Reverse<Event>| event.key.time <= now;
            if !self.events.peek().is_some_and(due) {
                return Ok(None);
            }
            let Some(Reverse(event)) = self.events.pop() else {
                return Ok(None);
            };
            if let Some(released) = self.handle(event)? {
                return Ok(Some(Step::Released(released)));
            }
        }
    }

    /// Takes what came of a call that was over at `done`; `took`: what is charged for it, ns. The stage stays busy until
    /// [`Engine::free`].
    ///
    /// # Errors
    /// [`EngineError::Failed`] of a stage that cannot be called again.
    pub fn complete(
        &mut self,
        ticket: &Ticket,
        mut called: Called,
        done: Nanos,
        took: Nanos,
    ) -> Result<(), EngineError> {
        let running = &mut self.stages[ticket.stage];
        if let Some(error) = &called.gone {
            return Err(EngineError::Failed {
                node: running.stage.id.to_string(),
                reason: error.to_string(),
            });
        }
        if running.life == Life::Open && running.role() == Role::Operator {
            let trigger = called.trigger(ticket.cause, running.stage.registration);
            running.stage.books.compute.entry(trigger).or_default().record(took);
        }
        let lines = running.stage.count(&mut called);
        self.complaints.extend(lines);
        self.report(called.made.fates);
        // Nobody is woken after the end.
        let ends = self.stages[ticket.stage].life == Life::Ending;
        for time in called.made.wakes.into_iter().filter(|_| !ends) {
            if self.stages[ticket.stage].wakes.insert((time, ticket.server.clone())) {
                let key = self.key(time, ticket.stage, Order::Wake, PortId(0), ticket.server.clone());
                self.push(key, What::Wake);
            }
        }
        self.dispatch(ticket.stage, called.made.sent, ticket.input, ticket.start, done);
        if ends {
            self.end(ticket.stage, done);
        }
        Ok(())
    }

    /// The call's server can take the next one at `at`.
    pub fn free(&mut self, ticket: &Ticket, at: Nanos, now: Nanos) {
        let running = &mut self.stages[ticket.stage];
        running.busy.insert(ticket.server.clone(), at);
        if at <= now {
            self.open.push_back((ticket.stage, ticket.server.clone()));
        } else {
            let key = self.key(at, ticket.stage, Order::ServerFree, PortId(0), ticket.server.clone());
            self.push(key, What::ServerFree);
        }
    }

    fn handle(&mut self, event: Event) -> Result<Option<usize>, EngineError> {
        let Key {
            time,
            stage,
            agent,
            port,
            ..
        } = event.key;
        match event.what {
            What::Release(port, message) => {
                self.release(stage, port, message, time, time);
                return Ok(Some(stage));
            }
            What::Arrive(message) => self.arrive(stage, PortId(port), message)?,
            What::ServerFree => self.open.push_back((stage, agent)),
            What::Wake => {
                let running = &mut self.stages[stage];
                running.wakes.remove(&(time, agent.clone()));
                running.late_wakes.insert((time, agent.clone()));
                self.open.push_back((stage, agent));
            }
            // Nobody waited for it.
            What::End if self.stages[stage].stage.registration.inputs[port].feedback => {}
            What::End => {
                let running = &mut self.stages[stage];
                running.open_inputs -= 1;
                let before = running.ended_outputs();
                running.ends_early = true;
                self.end_outputs(stage, &before, time);
                self.open.push_back((stage, Name::default()));
            }
        }
        Ok(None)
    }
}
