//! The bank itself: which message a query takes, and where every message went.

use std::collections::{BTreeMap, BTreeSet};

use realo_schemas::{Header, Message, Name, Nanos, OFFLINE_REACH, PayloadType, to_millis};

use crate::sender::{Departed, Sender};

/// Messages that are held of a sender; more than a query that waits for its turn can still ask for.
const HELD: usize = 16;

/// Why a message cannot be held.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum BankError {
    /// A stamp that lies after the message's arrival.
    #[error(
        "{message}: the stamp is {by_ms} ms after its arrival, max {limit_ms} (setting `ahead_ms`); the sender's clock is wrong"
    )]
    Ahead {
        /// The message.
        message: String,
        /// By how much, ms.
        by_ms: f64,
        /// The limit, ms.
        limit_ms: f64,
    },
    /// A payload that the ego's cannot be fused with.
    #[error(
        "{message}: found {found}, expected {expected} as the ego's queries have; wire outputs of one type to `ego` and `others`"
    )]
    Payload {
        /// The message.
        message: String,
        /// What the ego asks with.
        expected: PayloadType,
        /// What came.
        found: PayloadType,
    },
    /// One agent too many.
    #[error("{message}: {limit} other agents are known already (setting `max_agents`)")]
    Agents {
        /// The message.
        message: String,
        /// The limit.
        limit: usize,
    },
}

/// What became of a message that came in.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Taken {
    /// It is held, and will depart.
    Held {
        /// Whether its stamp is newer than those of all before of its sender.
        newest: bool,
    },
    /// A copy of one that was seen before.
    Repeated,
    /// The ego's own.
    FromEgo,
}

/// A query's answer.
#[derive(Clone, Debug, PartialEq)]
pub struct Answer {
    /// What to fuse, ordered by agent.
    pub entries: Vec<Message>,
    /// What left the bank since the last query.
    pub departed: Departed,
}

/// Holds what collaborators sent.
pub struct Bank {
    /// Largest age online, ns; inclusive.
    pub window: Nanos,
    /// Whether the nearest stamp is taken instead of the newest.
    pub offline: bool,
    /// How far a stamp may lie after the message's arrival, ns.
    pub ahead: Nanos,
    /// Agents that are known at the same time.
    pub max_agents: usize,
    /// Agents unheard of for longer are forgotten, ns.
    pub forget: Nanos,
    /// Messages held of a sender at the same time.
    held: usize,
    ego: Option<Name>,
    /// What the ego asks with, once it has asked.
    payload: Option<PayloadType>,
    senders: BTreeMap<Name, Sender>,
    departed: Departed,
}

impl Bank {
    /// An empty bank.
    pub fn new(window: Nanos, offline: bool, ahead: Nanos, max_agents: usize, forget: Nanos) -> Self {
        let (held, ego, payload) = (HELD, None, None);
        let (senders, departed) = (BTreeMap::new(), Departed::new());
        Bank {
            window,
            offline,
            ahead,
            max_agents,
            forget,
            held,
            ego,
            payload,
            senders,
            departed,
        }
    }

    /// Learns what the ego asks with; what is held of other payloads departs as rejected.
    pub fn expect(&mut self, payload: PayloadType) {
        if self.payload != Some(payload) {
            self.payload = Some(payload);
            for sender in self.senders.values_mut() {
                sender.keep_only(payload, &mut self.departed);
            }
        }
    }

    /// Takes a collaborator's message; `message.header.ready` is when it came.
    ///
    /// # Errors
    /// [`BankError`] if its payload is not that of the queries, its stamp lies in the future, or it is of one agent too
    /// many.
    pub fn insert(&mut self, message: Message) -> Result<Taken, BankError> {
        let header = &message.header;
        if self.ego.as_ref() == Some(&header.agent) {
            return Ok(Taken::FromEgo);
        }
        let found = message.payload.payload_type();
        if let Some(expected) = self.payload.filter(|expected| *expected != found) {
            return Err(BankError::Payload {
                message: header.to_string(),
                expected,
                found,
            });
        }
        let by = header.stamp.saturating_sub(header.ready);
        if by > self.ahead {
            let (by_ms, limit_ms) = (to_millis(by), to_millis(self.ahead));
            return Err(BankError::Ahead {
                message: header.to_string(),
                by_ms,
                limit_ms,
            });
        }
        if !self.senders.contains_key(&header.agent) && self.senders.len() >= self.max_agents {
            return Err(BankError::Agents {
                message: header.to_string(),
                limit: self.max_agents,
            });
        }
        let sender = self.senders.entry(header.agent.clone()).or_insert_with(Sender::new);
        sender.last = sender.last.max(header.ready);
        if !sender.is_new(header) {
            return Ok(Taken::Repeated);
        }
        let newest = sender.follow(header);
        sender.hold(message, self.held, self.offline, &mut self.departed);
        Ok(Taken::Held { newest })
    }

    /// Senders of whom a message is to be expected within `patience` of a query.
    pub fn awaited(&self, query: &Header, patience: Nanos) -> BTreeSet<Name> {
        let senders = self.senders.iter().filter(|(name, _)| **name != query.agent);
        let due = senders.filter(|(_, sender)| sender.is_due(query.ready, self.window, patience));
        due.map(|(name, _)| name.clone()).collect()
    }

    /// Answers a query of the ego with what was ready at `asked` (offline: near its stamp) of all but those that are `fused`
    /// already. Queries come in the order of `asked` (offline: of their stamps).
    pub fn answer(&mut self, query: &Header, asked: Nanos, fused: &BTreeSet<Name>) -> Answer {
        self.learn_ego(&query.agent);
        let oldest = query.ready.saturating_sub(self.window);
        let mut entries = Vec::new();
        for (name, sender) in &mut self.senders {
            let wanted = !fused.contains(name);
            let selected = match self.offline {
                true => sender.nearest(query.stamp, OFFLINE_REACH, wanted, &mut self.departed),
                false => sender.newest(asked, oldest, wanted, &mut self.departed),
            };
            entries.extend(selected);
        }
        self.forget_before(query.ready.saturating_sub(self.forget));
        Answer {
            entries,
            departed: std::mem::take(&mut self.departed),
        }
    }

    /// What it held of the ego itself, before it knew who that is, never counts.
    fn learn_ego(&mut self, ego: &Name) {
        if self.ego.as_ref() != Some(ego) {
            self.senders.remove(ego);
            self.ego = Some(ego.clone());
        }
    }

    fn forget_before(&mut self, time: Nanos) {
        let (departed, offline) = (&mut self.departed, self.offline);
        self.senders.retain(|_, sender| {
            let keep = sender.last >= time;
            if !keep {
                sender.leave(offline, departed);
            }
            keep
        });
    }

    /// Closes the books: everything that is still held departs.
    pub fn close(&mut self) -> Departed {
        for sender in self.senders.values_mut() {
            sender.leave(self.offline, &mut self.departed);
        }
        self.senders.clear();
        std::mem::take(&mut self.departed)
    }

    /// Number of agents that it knows.
    pub fn agents(&self) -> usize {
        self.senders.len()
    }
}

#[cfg(test)]
mod tests;
