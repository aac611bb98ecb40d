use std::collections::{BTreeMap, BTreeSet};

use realo_schemas::{Clock, Message, Name, Nanos, wire};

use crate::intake::Intake;
use crate::reorder::Reorder;
use crate::stage::{Called, Stage};
use crate::{AnyOperator, AnySink, Books, Class, PortId};

use super::inbox::{Heard, Inbox};
use super::marks::{self, Mark};
use super::{DoraLink, HostError, wall_now};

/// How long an input that dora has closed may still deliver its `end` on the direct path, ns.
const GRACE: Nanos = 2_000_000_000;
/// How long a node waits at most without looking around, ns.
const IDLE: Nanos = 200_000_000;

/// Between two hellos that are passed on, ns.
const HELLO: Nanos = 40_000_000;

/// What a node runs.
pub(super) enum Body {
    Operator(Box<dyn AnyOperator>),
    Sink(Box<dyn AnySink>),
}

/// One input on dora.
struct Edge {
    port: PortId,
    from: String,
    reorder: Reorder<Message>,
    end: Option<u64>,
    /// Wall time at which dora closed the input.
    closed: Option<Nanos>,
    complete: bool,
}

/// Order of held messages: as the events of virtual time.
type Place = (Nanos, Class, PortId, Name, u64, u64);

struct Host {
    link: DoraLink,
    inbox: Inbox,
    stage: Stage,
    body: Body,
    intake: Intake,
    edges: Vec<Edge>,
    held: BTreeMap<Place, Message>,
    arrivals: u64,
    wakes: BTreeSet<Nanos>,
    clock: Option<Clock>,
    run: Name,
    above: Books,
    last_hello: Nanos,
}

pub(super) fn run(body: Body, link: DoraLink, inbox: Inbox) -> Result<(), HostError> {
    let wired = link.wired()?;
    let edges = wired.iter().enumerate().filter_map(|(port, from)| {
        let from = from.clone()?;
        Some(Edge {
            port: PortId(port),
            from,
            reorder: Reorder::new(),
            end: None,
            closed: None,
            complete: false,
        })
    });
    let mut host = Host {
        stage: Stage::new(link.id.as_str().into(), link.registration),
        intake: Intake::new(link.registration.inputs, wired.iter().map(Option::is_some).collect()),
        edges: edges.collect(),
        held: BTreeMap::new(),
        arrivals: 0,
        wakes: BTreeSet::new(),
        clock: None,
        run: Name::default(),
        above: Books::default(),
        last_hello: 0,
        link,
        inbox,
        body,
    };
    while !host.is_done() {
        host.step()?;
    }
    host.finish()
}

impl Host {
    fn is_done(&self) -> bool {
        self.edges.iter().all(|edge| edge.complete)
            && self.held.is_empty()
            && self.intake.is_idle()
            && self.wakes.is_empty()
    }

    fn log_now(&self) -> Nanos {
        self.clock.map_or(0, |clock| clock.log_at(wall_now()))
    }

    fn wall_at(&self, log: Nanos) -> Nanos {
        self.clock.map_or(0, |clock| clock.wall_at(log))
    }

    /// Hears what came, lets in what is ready, and makes one call; waits if there is nothing to do.
    fn step(&mut self) -> Result<(), HostError> {
        while let Some(heard) = self.inbox.poll() {
            self.hear(heard)?;
        }
        self.settle_edges()?;
        self.let_in()?;
        if self.serve()? {
            return Ok(());
        }
        match self.inbox.wait(self.next_deadline()) {
            Some(heard) => self.hear(heard),
            None => Ok(()),
        }
    }

    fn next_deadline(&self) -> Nanos {
        let held = self.held.first_key_value().map(|(place, _)| self.wall_at(place.0));
        let wake = self.wakes.first().map(|time| self.wall_at(*time));
        let edges = self.edges.iter().filter_map(|edge| edge.reorder.deadline());
        edges
            .chain(held)
            .chain(wake)
            .min()
            .unwrap_or(Nanos::MAX)
            .min(wall_now() + IDLE)
    }

    fn hear(&mut self, heard: Heard) -> Result<(), HostError> {
        match heard {
            Heard::Input(id, row, arrived) => self.hear_message(&id, &row, arrived),
            Heard::Closed(id) => {
                if let Some((port, _)) = self.link.registration.input(&id) {
                    self.edges
                        .iter_mut()
                        .filter(|edge| edge.port == port)
                        .for_each(|edge| edge.closed = Some(wall_now()));
                }
                Ok(())
            }
            Heard::Failed { node, reason } => Err(HostError::Above {
                id: self.link.id.clone(),
                source_id: node,
                reason: first_line(&reason),
            }),
            Heard::Stopped => Err(HostError::Stopped {
                id: self.link.id.clone(),
            }),
            Heard::Trouble(trouble) => {
                eprintln!("realo: {}: dora: {trouble}", self.link.id);
                Ok(())
            }
        }
    }

    fn hear_message(&mut self, id: &str, row: &arrow::array::ArrayRef, arrived: Nanos) -> Result<(), HostError> {
        let Some((port, declared)) = self.link.registration.input(id) else {
            return Ok(());
        };
        let Some(edge) = self.edges.iter_mut().find(|edge| edge.port == port) else {
            return Ok(());
        };
        let message = wire::from_arrow(row.as_ref()).map_err(|error| HostError::Stage {
            id: self.link.id.clone(),
            reason: format!("input `{id}` from {}: not a realo message: {error}", edge.from),
        })?;
        self.clock = self.clock.or(message.header.clock);
        let mark = Mark::of(&message).map_err(|reason| HostError::Stage {
            id: self.link.id.clone(),
            reason,
        })?;
        match mark {
            None => {}
            Some(Mark::Hello) => return self.pass_hello(),
            Some(Mark::End(end)) => {
                edge.end = Some(end.hops);
                self.above.merge(&end.books);
                return Ok(());
            }
        }
        declared.admit(&message).map_err(|wrong| HostError::Wiring {
            id: self.link.id.clone(),
            reason: wrong.to_string(),
        })?;
        self.run = message.header.run.clone();
        let mut ready = Vec::new();
        let hop = message.header.hop;
        edge.reorder
            .offer(hop, message, arrived, self.intake.books_of(port), &mut ready);
        self.hold(port, ready);
        Ok(())
    }

    /// Passes a hello on, however many inputs bring one.
    fn pass_hello(&mut self) -> Result<(), HostError> {
        let now = wall_now();
        if now - self.last_hello < HELLO {
            return Ok(());
        }
        self.last_hello = now;
        marks::send_hello(&mut self.link)
    }

    fn hold(&mut self, port: PortId, messages: Vec<Message>) {
        let class = self.link.registration.inputs[port.0].class;
        for message in messages {
            let header = &message.header;
            let place = (
                header.ready,
                class,
                port,
                header.agent.clone(),
                header.seq,
                self.arrivals,
            );
            self.arrivals += 1;
            self.held.insert(place, message);
        }
    }

    /// Gives up on what dora lost, and closes inputs that have ended.
    fn settle_edges(&mut self) -> Result<(), HostError> {
        let now = wall_now();
        for index in 0..self.edges.len() {
            let edge = &mut self.edges[index];
            if edge.complete {
                continue;
            }
            let (port, books, mut ready) = (edge.port, self.intake.books_of(edge.port), Vec::new());
            edge.reorder.expire(now, books, &mut ready);
            match (edge.end, edge.closed) {
                (Some(hops), _) if edge.reorder.is_complete(hops, now) => edge.complete = true,
                (Some(hops), _) if edge.reorder.deadline().is_some_and(|deadline| deadline <= now) => {
                    edge.reorder.finish(hops, books, &mut ready);
                    edge.complete = true;
                }
                (None, Some(closed)) if now - closed > GRACE => {
                    let source_id = edge.from.split('/').next().unwrap_or_default().to_string();
                    let reason = format!("its output {} closed without an end", edge.from);
                    return Err(HostError::Above {
                        id: self.link.id.clone(),
                        source_id,
                        reason,
                    });
                }
                _ => {}
            }
            self.hold(port, ready);
        }
        Ok(())
    }

    /// Moves held messages whose time has come to the queues.
    fn let_in(&mut self) -> Result<(), HostError> {
        let now = self.log_now();
        while let Some(first) = self.held.first_entry() {
            if first.key().0 > now {
                return Ok(());
            }
            let ((_, _, port, ..), message) = first.remove_entry();
            if let Body::Sink(sink) = &mut self.body {
                self.intake.books_of(port).received.add(&message);
                sink.accept(port, message)
                    .map_err(|error| stage_failed(&self.link.id, &error))?;
                continue;
            }
            self.intake
                .offer(&Name::default(), port, message)
                .map_err(|overflow| HostError::Stage {
                    id: self.link.id.clone(),
                    reason: overflow.to_string(),
                })?;
        }
        Ok(())
    }

    /// Makes the next call, if one is due.
    fn serve(&mut self) -> Result<bool, HostError> {
        let Body::Operator(operator) = &mut self.body else {
            return Ok(false);
        };
        let start = self.clock.map_or(0, |clock| clock.log_at(wall_now()));
        let wake = self.wakes.first().copied().filter(|time| *time <= start);
        let first = self.intake.first("");
        let wake_first = match (wake, first) {
            // A wake comes after the data and before the queries of its instant.
            (Some(at), Some((ready, class))) => at < ready || (at == ready && class == Class::Query),
            (at, None) => at.is_some(),
            (None, Some(_)) => false,
        };
        let begun = wall_now();
        let (called, input) = if wake_first {
            self.wakes.pop_first();
            (self.stage.wake(operator.as_mut(), start), wake.unwrap_or(start))
        } else {
            let Some(work) = self.intake.next("") else {
                return Ok(false);
            };
            let input = work.ready;
            (self.stage.run(operator.as_mut(), work, start), input)
        };
        let took = wall_now() - begun;
        self.stage.books.compute.record(took);
        self.follow(called, input, start)?;
        Ok(true)
    }

    fn follow(&mut self, called: Called, input: Nanos, start: Nanos) -> Result<(), HostError> {
        let done = self.log_now().max(start);
        for (port, message) in &called.failed {
            self.intake.reject(*port, message);
        }
        self.wakes.extend(called.wakes);
        for (port, mut message) in called.sent {
            message.header.clock = self.clock;
            if message.header.run.is_empty() {
                message.header.run = self.run.clone();
            }
            self.stage.stamp(port, &mut message, input, start, done);
            self.link.send(port, &message)?;
        }
        Ok(())
    }

    fn finish(mut self) -> Result<(), HostError> {
        let start = self.log_now();
        if let Body::Operator(operator) = &mut self.body {
            let called = self.stage.end(operator.as_mut(), start);
            self.follow(called, start, start)?;
        }
        self.intake.close();
        let mut own = self.stage.books.clone();
        own.inputs = self
            .intake
            .books()
            .iter()
            .map(|(port, books)| (port.to_string(), books.clone()))
            .collect();
        let mut books = self.above;
        books.nodes.insert(self.link.id.clone(), own);
        if let Body::Sink(sink) = &mut self.body {
            sink.finish(&books)
                .map_err(|error| stage_failed(&self.link.id, &error))?;
        }
        marks::send_end(&mut self.link, &self.stage.hops, &books, self.clock)
    }
}

fn stage_failed(id: &str, error: &crate::Error) -> HostError {
    HostError::Stage {
        id: id.into(),
        reason: error.to_string(),
    }
}

fn first_line(text: &str) -> String {
    text.lines()
        .find(|line| !line.trim().is_empty())
        .unwrap_or("it ended with an error")
        .trim()
        .to_string()
}
