//! What a stage sends, and its end, on their way along the wires.

use std::cmp::Reverse;

use realo_operator::{PortId, Role};
use realo_schemas::report::{Fate, Fated};
use realo_schemas::{Message, Name, Nanos};

use super::running::Life;
use super::{Engine, Leaving};
use crate::event::{Event, Key, Order, What};

impl Engine {
    /// Sends messages on; they arrive when they are ready.
    pub(super) fn dispatch(
        &mut self,
        stage: usize,
        sent: Vec<(PortId, Message)>,
        input: Nanos,
        start: Nanos,
        done: Nanos,
    ) {
        for (port, mut message) in sent {
            if self.stages[stage].is_closed(port.0) {
                self.report(Fated::of(&message.header, Fate::InFlight).into_iter().collect());
                continue;
            }
            if self.clock.is_some() {
                message.header.clock = self.clock;
            }
            if message.header.run.is_empty() {
                message.header.run = self.run.clone();
            }
            let running = &mut self.stages[stage];
            running.stage.stamp(port, &mut message, input, start, done);
            running.last_out[port.0] = running.last_out[port.0].max(message.header.ready);
            let consumers = running.consumers[port.0].clone();
            if running.leaves[port.0] {
                let message = message.clone();
                self.leaving.push(Leaving { stage, port, message });
            }
            let mut consumers = consumers.into_iter().peekable();
            let mut left = Some(message);
            while let Some((to, input)) = consumers.next() {
                let message = if consumers.peek().is_some() {
                    left.clone()
                } else {
                    left.take()
                };
                if let Some(message) = message {
                    self.arrival(to, input, message);
                }
            }
        }
    }

    pub(super) fn arrival(&mut self, stage: usize, port: PortId, message: Message) {
        let order = self.stages[stage].stage.registration.inputs[port.0].class.into();
        let key = self.key_of(message.header.ready, stage, order, port, &message);
        self.push(key, What::Arrive(message));
    }

    /// A stage has ended: so do the wires behind it.
    pub(super) fn end(&mut self, stage: usize, now: Nanos) {
        let running = &mut self.stages[stage];
        let before = running.ended_outputs();
        running.life = Life::Ended;
        if running.role() != Role::Sink {
            let (id, own) = (running.stage.id.to_string(), running.own_books());
            self.books.nodes.insert(id, own);
        }
        self.end_outputs(stage, &before, now);
        for sink in 0..self.stages.len() {
            if self.stages[sink].role() == Role::Sink {
                self.open.push_back((sink, Name::default()));
            }
        }
    }

    /// Ends the wires behind outputs that have ended and had not `before`.
    pub(super) fn end_outputs(&mut self, stage: usize, before: &[bool], now: Nanos) {
        for (output, before) in before.iter().enumerate() {
            if *before || !self.stages[stage].has_ended(output) {
                continue;
            }
            let time = now.max(self.stages[stage].last_out[output]);
            for (to, input) in self.stages[stage].consumers[output].clone() {
                let key = self.key(time, to, Order::End, input, Name::default());
                self.push(key, What::End);
            }
        }
    }

    pub(super) fn key_of(&mut self, time: Nanos, stage: usize, order: Order, port: PortId, of: &Message) -> Key {
        let header = &of.header;
        Key {
            kind: Some(header.kind),
            seq: header.seq,
            ..self.key(time, stage, order, port, header.agent.clone())
        }
    }

    pub(super) fn key(&mut self, time: Nanos, stage: usize, order: Order, port: PortId, agent: Name) -> Key {
        self.emissions += 1;
        Key {
            time,
            stage,
            order,
            port: port.0,
            agent,
            kind: None,
            seq: 0,
            emission: self.emissions,
        }
    }

    pub(super) fn push(&mut self, key: Key, what: What) {
        self.events.push(Reverse(Event { key, what }));
    }
}
