//! The process: one thread for dora, and threads for calls.

mod outbox;
mod shared;

use std::collections::{BTreeMap, BTreeSet};
use std::sync::atomic::AtomicI64;
use std::sync::{Arc, Condvar, Mutex};
use std::time::{Duration, Instant};

use dora_node_api::DoraNode;
use dora_node_api::dora_core::config::DataId;
use realo_clock::wall_now;
use realo_engine::{Engine, EngineError, Leaving, Servers, Step, Task};
use realo_operator::{Built, InputBooks, Outputs, PortId, Registration, Waker};
use realo_schemas::{Message, Nanos, wire};

use crate::Stages;
use crate::tap::tap_of_this_process;

use self::outbox::Outbox;
use super::edges::Edge;
use super::inbox::{Heard, Inbox};
use super::load::Load;
use super::marks::{End, Fates, Hello, Known};
use super::{HostError, source};
pub(super) use shared::{Shared, State};

/// How long the process waits at most without looking around, ns.
const IDLE: Nanos = 200_000_000;
/// Between two hellos that are passed on, ns.
const HELLO: Nanos = 40_000_000;
/// Between two marks with fates, ns.
const FATES: Nanos = 500_000_000;
/// What lies in dora's queues or in shared memory is lost when its sender leaves: so long after its last message it stays, ns.
const LINGER: Nanos = 1_000_000_000;
/// So long a process that ends waits for who watches the run.
const TO_SEE: Duration = Duration::from_millis(200);

/// A process that has joined dora.
pub(super) struct Joined {
    pub id: String,
    pub node: DoraNode,
    pub stages: Stages,
    /// In the order of the stages.
    pub built: Vec<Built>,
    /// By input: `node/output` behind it.
    pub froms: BTreeMap<String, String>,
    /// Outputs from which a way leads back to this process.
    pub returning: BTreeSet<String>,
    pub inbox: Inbox,
}

/// Runs the stages to their end.
pub(super) fn run(joined: Joined) -> Result<(), HostError> {
    let Joined {
        id,
        node,
        mut stages,
        built,
        froms,
        returning,
        inbox,
    } = joined;
    let tap = tap_of_this_process();
    let tapped = tap.as_ref().map(|tap| stages.let_see(tap)).unwrap_or_default();
    let edges = edges(&froms, &stages);
    let exits = exits(&stages);
    let outputs = returning.iter().filter_map(|name| stages.exits.get(name));
    let returning: BTreeSet<(usize, PortId)> = outputs.copied().collect();
    let shared = Arc::new(Shared {
        id,
        state: Mutex::new(State {
            engine: Engine::new(&stages.wiring, Servers::One),
            load: Load::of(built.len()),
            built: built.into_iter().map(Some).collect(),
            next_poll: 0,
            failed: None,
            over: false,
        }),
        work: Condvar::new(),
        outbox: Outbox::new(Some(node)),
        last_sent: AtomicI64::new(0),
        exits,
        wake: inbox.wake(),
        tap,
        tapped,
    });
    open_gateways(&shared)?;
    start_threads(&shared);
    let mut host = Host {
        shared: shared.clone(),
        inbox,
        edges,
        last_hello: 0,
        last_fates: wall_now(),
        number: 0,
        known: Known::new(&shared.id),
        ended: BTreeSet::new(),
        returning,
    };
    let ended = host.run();
    let mut state = shared.lock();
    state.over = true;
    shared.work.notify_all();
    drop(state);
    if let Some(tap) = &shared.tap {
        tap.flush(TO_SEE);
    }
    if ended.is_ok() {
        shared.leave();
    }
    ended
}

/// The inputs of the process.
fn edges(froms: &BTreeMap<String, String>, stages: &Stages) -> Vec<Edge> {
    let edge = |(name, from): (&String, &String)| {
        let inputs = stages.entries.get(name).cloned().unwrap_or_default();
        Edge::new(name, from, inputs)
    };
    froms.iter().map(edge).collect()
}

/// The process's outputs of dora by stage and port.
fn exits(stages: &Stages) -> BTreeMap<(usize, PortId), Vec<DataId>> {
    let mut exits: BTreeMap<(usize, PortId), Vec<DataId>> = BTreeMap::new();
    for (name, output) in &stages.exits {
        exits.entry(*output).or_default().push(DataId::from(name.clone()));
    }
    exits
}

/// Opens the ways to the world outside. What comes in before the process has a clock waits for the next call.
fn open_gateways(shared: &Arc<Shared>) -> Result<(), HostError> {
    let mut state = shared.lock();
    let State { engine, built, .. } = &mut *state;
    for (stage, built) in built.iter_mut().enumerate() {
        let Some(Built::Gateway(gateway)) = built else {
            continue;
        };
        let shared = shared.clone();
        let waker = Waker::new(move || {
            let mut state = shared.lock();
            if state.engine.clock().is_some() {
                let now = state.log_now();
                state.engine.wake(stage, now);
                shared.follow(&mut state, now);
            }
        });
        gateway
            .open(waker)
            .map_err(|error| HostError::Stage(format!("node `{}`: {error}", engine.id(stage))))?;
    }
    Ok(())
}

/// A thread for each source, and as many for calls as there are other stages.
fn start_threads(shared: &Arc<Shared>) {
    let mut state = shared.lock();
    for stage in 0..state.built.len() {
        let shared = shared.clone();
        match state.built[stage].take() {
            Some(Built::Source(source)) => {
                std::thread::spawn(move || source::run(&shared, stage, source));
            }
            built => {
                state.built[stage] = built;
                std::thread::spawn(move || work(&shared));
            }
        }
    }
}

/// Makes calls until the process is over.
fn work(shared: &Shared) {
    let mut state = shared.lock();
    while !state.over && state.failed.is_none() {
        let now = state.log_now();
        let task = match state.engine.step(now) {
            Ok(Some(Step::Call(task))) => task,
            Ok(Some(Step::Released(_))) => continue,
            Ok(None) => {
                state = shared.work.wait(state).unwrap_or_else(|poisoned| poisoned.into_inner());
                continue;
            }
            Err(error) => return shared.fail_in(state, HostError::Stage(error.to_string())),
        };
        let Some(built) = state.built[task.ticket.stage].take() else {
            continue;
        };
        if state.engine.next_due().is_some_and(|due| due <= now) {
            shared.work.notify_one();
        }
        let out = Outputs::at(task.ticket.start).in_real_time(state.engine.clock(), realo_clock::steady);
        let registration = state.engine.registration(task.ticket.stage);
        drop(state);
        if let Err(error) = call(shared, task, built, registration, out) {
            return shared.fail(error);
        }
        state = shared.lock();
    }
}

/// One call: its stage is busy until what it sent has left.
fn call(
    shared: &Shared,
    Task { ticket, call, fates }: Task,
    mut built: Built,
    registration: &'static Registration,
    out: Outputs,
) -> Result<(), HostError> {
    let begun = Instant::now();
    let called = call.make(&mut built, registration, out, &fates);
    let took = begun.elapsed().as_nanos() as Nanos;
    let mut state = shared.lock();
    state.built[ticket.stage] = Some(built);
    state.load.call(ticket.stage, begun.elapsed());
    state.report_load();
    let done = state.log_now().max(ticket.start);
    let completed = state.engine.complete(&ticket, called, done, took);
    completed.map_err(|error: EngineError| HostError::Stage(error.to_string()))?;
    shared.post(&mut state);
    shared.follow(&mut state, done);
    drop(state);
    shared.send_posted()?;
    let mut state = shared.lock();
    let now = state.log_now();
    state.engine.free(&ticket, now, now);
    if ticket.is_end() {
        shared.wake.give();
    }
    Ok(())
}

/// The dora thread.
struct Host {
    shared: Arc<Shared>,
    inbox: Inbox,
    edges: Vec<Edge>,
    last_hello: Nanos,
    last_fates: Nanos,
    /// Of the next mark with fates.
    number: u64,
    known: Known,
    /// Outputs that were ended.
    ended: BTreeSet<(usize, PortId)>,
    /// Outputs from which a way leads back to this process.
    returning: BTreeSet<(usize, PortId)>,
}

impl Host {
    fn run(&mut self) -> Result<(), HostError> {
        loop {
            for _ in 0..self.inbox.there() {
                if let Some(heard) = self.inbox.poll() {
                    self.hear(heard)?;
                }
            }
            self.settle()?;
            if wall_now() - self.last_fates >= FATES {
                self.pass_fates()?;
            }
            let ended = self.end_outputs()?;
            let shared = self.shared.clone();
            let mut state = shared.lock();
            if let Some(error) = state.failed.take() {
                return Err(error);
            }
            if ended && state.engine.is_done() && self.edges.iter().all(|edge| edge.complete) {
                return Ok(());
            }
            let now = state.log_now();
            if state.engine.next_due().is_some_and(|due| due <= now) {
                shared.work.notify_one();
            }
            let due = state
                .engine
                .next_due()
                .filter(|due| *due > now)
                .map(|due| state.wall_at(due));
            let edges = self.edges.iter().filter_map(|edge| edge.reorder.deadline());
            let until = edges.chain(due).min().unwrap_or(Nanos::MAX);
            let until = until.min(wall_now() + IDLE);
            state.next_poll = until;
            drop(state);
            if let Some(heard) = self.inbox.wait(until) {
                self.hear(heard)?;
            }
        }
    }

    fn hear(&mut self, heard: Heard) -> Result<(), HostError> {
        match heard {
            Heard::Input(name, row, arrived) => self.hear_message(&name, &row, arrived),
            Heard::End(name, end) => self.hear_end(&name, end),
            Heard::Closed(name) => {
                if let Some(edge) = self.edges.iter_mut().find(|edge| edge.name == name) {
                    (edge.closed, edge.heard) = (true, wall_now());
                }
                Ok(())
            }
            Heard::Failed { node, reason } => Err(HostError::Above {
                id: self.shared.id.clone(),
                source_id: node,
                reason: first_line(&reason),
            }),
            Heard::Stopped => Err(HostError::Stopped {
                id: self.shared.id.clone(),
            }),
            Heard::Trouble(trouble) => {
                eprintln!("realo: {}: dora: {trouble}", self.shared.id);
                Ok(())
            }
        }
    }

    fn hear_message(&mut self, name: &str, row: &arrow::array::ArrayRef, arrived: Nanos) -> Result<(), HostError> {
        let Some(edge) = self.edges.iter_mut().find(|edge| edge.name == name) else {
            return Ok(());
        };
        let id = &self.shared.id;
        let wrong = |reason: String| HostError::Stage(format!("{id}: input `{name}` from {}: {reason}", edge.from));
        let message = wire::from_arrow(row.as_ref()).map_err(|error| wrong(format!("not a realo message: {error}")))?;
        edge.heard = arrived;
        let shared = self.shared.clone();
        let mut state = shared.lock();
        if let Some(clock) = message.header.clock {
            state.engine.set_clock(clock);
        }
        if Hello::is_in(&message) {
            drop(state);
            return self.pass_hello();
        }
        let mut ready = Vec::new();
        let hop = message.header.hop;
        let books = match edge.inputs.first() {
            Some((stage, port)) => state.engine.input_books(*stage, *port),
            None => &mut edge.unread,
        };
        edge.reorder.offer(hop, message, arrived, books, &mut ready);
        let inputs = edge.inputs.clone();
        deliver(&mut state, &mut self.known, &inputs, ready)
            .map_err(|reason| HostError::Stage(format!("{}: input `{name}`: {reason}", shared.id)))?;
        let now = state.log_now();
        shared.follow(&mut state, now);
        Ok(())
    }

    fn hear_end(&mut self, name: &str, end: Result<End, String>) -> Result<(), HostError> {
        let Some(edge) = self.edges.iter_mut().find(|edge| edge.name == name) else {
            return Ok(());
        };
        let End {
            hops,
            books,
            fates,
            clock,
        } = end.map_err(|reason| {
            let id = &self.shared.id;
            HostError::Stage(format!("{id}: input `{name}` from {}: {reason}", edge.from))
        })?;
        (edge.end, edge.heard) = (Some(hops), wall_now());
        let mut state = self.shared.lock();
        if let Some(clock) = clock {
            state.engine.set_clock(clock);
        }
        state.engine.merge_books(&books);
        if let Some(fates) = fates {
            let new = self.known.take(fates);
            state.engine.hear(&new);
        }
        Ok(())
    }

    /// Passes a hello on, however many inputs bring one.
    fn pass_hello(&mut self) -> Result<(), HostError> {
        let now = wall_now();
        if now - self.last_hello < HELLO {
            return Ok(());
        }
        self.last_hello = now;
        self.shared.send_hello()
    }

    fn settle(&mut self) -> Result<(), HostError> {
        let now = wall_now();
        let shared = self.shared.clone();
        let mut state = shared.lock();
        for edge in self.edges.iter_mut().filter(|edge| !edge.complete) {
            let mut ready = Vec::new();
            // Taken out, so that the edge can be changed beside them.
            let mut books = match edge.inputs.first() {
                Some((stage, port)) => std::mem::take(state.engine.input_books(*stage, *port)),
                None => InputBooks::default(),
            };
            let settled = edge.settle(&shared.id, now, &mut books, &mut ready);
            if let Some((stage, port)) = edge.inputs.first() {
                *state.engine.input_books(*stage, *port) = books;
            }
            settled?;
            deliver(&mut state, &mut self.known, &edge.inputs, ready)
                .map_err(|reason| HostError::Stage(format!("{}: input `{}`: {reason}", shared.id, edge.name)))?;
            if edge.complete {
                let now = state.log_now();
                for (stage, port) in &edge.inputs {
                    state.engine.end_input(*stage, *port, now);
                }
            }
        }
        let now = state.log_now();
        shared.follow(&mut state, now);
        Ok(())
    }

    /// Sends on what was said of messages over links: down the graph there are sinks.
    fn pass_fates(&mut self) -> Result<Option<Fates>, HostError> {
        self.last_fates = wall_now();
        let shared = self.shared.clone();
        let mut state = shared.lock();
        let fates = state.engine.take_fates();
        let passed = self.known.pass();
        if fates.is_empty() && passed.is_empty() {
            return Ok(None);
        }
        let mark = Fates {
            origin: shared.id.clone(),
            number: self.number,
            fates,
            passed,
        };
        self.number += 1;
        if let Some(tap) = &shared.tap {
            for said in std::iter::once(&mark).chain(&mark.passed) {
                tap.see_fates(&said.fates);
            }
        }
        let clock = state.engine.clock();
        let open = shared.exits.keys().filter(|exit| !self.ended.contains(*exit));
        for (stage, port) in open.copied() {
            let message = mark.to_message(state.engine.take_hop(stage, port), clock);
            shared.outbox.post([Leaving { stage, port, message }]);
        }
        drop(state);
        shared.send_posted()?;
        Ok(Some(mark))
    }

    /// Ends outputs: all together once every stage has ended, for they take the books along; but one from which a way leads
    /// back as soon as its own stage has, for other stages may wait for that. Whether all of them have ended.
    fn end_outputs(&mut self) -> Result<bool, HostError> {
        let shared = self.shared.clone();
        let state = shared.lock();
        let all = state.engine.is_done();
        let may_end = |exit: &&(usize, PortId)| {
            let ended = state.engine.output_has_ended(exit.0, exit.1) && !self.ended.contains(exit);
            ended && (all || self.returning.contains(exit))
        };
        let ending: Vec<(usize, PortId)> = shared.exits.keys().filter(may_end).copied().collect();
        drop(state);
        if !ending.is_empty() {
            self.ended.extend(&ending);
            let fates = self.pass_fates()?;
            let state = shared.lock();
            let clock = state.engine.clock();
            let end = |exit: (usize, PortId)| End {
                hops: state.engine.hops(exit.0, exit.1),
                books: state.engine.books(),
                fates: fates.clone(),
                clock,
            };
            let ends: Vec<End> = ending.iter().map(|exit| end(*exit)).collect();
            drop(state);
            for (exit, end) in ending.into_iter().zip(&ends) {
                shared.end(exit, end)?;
            }
        }
        Ok(self.ended.len() == shared.exits.len())
    }
}

/// Gives messages in order to the stages that take them, and takes fates to the sinks.
fn deliver(
    state: &mut State,
    known: &mut Known,
    inputs: &[(usize, PortId)],
    ready: Vec<Message>,
) -> Result<(), String> {
    for message in ready {
        match Fates::of(&message)? {
            Some(fates) => {
                let new = known.take(fates);
                state.engine.hear(&new);
            }
            None => inputs
                .iter()
                .for_each(|(stage, port)| state.engine.deliver(*stage, *port, message.clone())),
        }
    }
    Ok(())
}

fn first_line(text: &str) -> String {
    text.lines()
        .find(|line| !line.trim().is_empty())
        .unwrap_or("it ended with an error")
        .trim()
        .to_string()
}
