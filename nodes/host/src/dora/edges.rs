//! The inputs of a process: each edge's messages in order, and its end.

use realo_operator::{InputBooks, PortId};
use realo_schemas::{Message, Nanos};

use crate::reorder::Reorder;

use super::HostError;

/// How long an input that dora has closed may still deliver its `end` on the direct path, ns.
const GRACE: Nanos = 2_000_000_000;

/// One input of a process.
pub(super) struct Edge {
    /// Its name.
    pub name: String,
    /// `node/output` behind it.
    pub from: String,
    /// The stages that take what comes here.
    pub inputs: Vec<(usize, PortId)>,
    pub reorder: Reorder<Message>,
    /// How much was sent in all.
    pub end: Option<u64>,
    /// Wall time at which dora closed the input.
    pub closed: Option<Nanos>,
    pub complete: bool,
    /// Where nobody takes what comes here.
    pub unread: InputBooks,
}

impl Edge {
    pub fn new(name: &str, from: &str, inputs: Vec<(usize, PortId)>) -> Self {
        Edge {
            name: name.into(),
            from: from.into(),
            inputs,
            reorder: Reorder::new(),
            end: None,
            closed: None,
            complete: false,
            unread: InputBooks::default(),
        }
    }

    /// Gives up on what dora lost, and closes the edge if it has ended; what can be handed on goes to `ready`.
    ///
    /// # Errors
    /// An input that closed without an end.
    pub fn settle(
        &mut self,
        id: &str,
        now: Nanos,
        books: &mut InputBooks,
        ready: &mut Vec<Message>,
    ) -> Result<(), HostError> {
        self.reorder.expire(now, books, ready);
        match (self.end, self.closed) {
            (Some(hops), _) if self.reorder.is_complete(hops, now) => self.complete = true,
            (Some(hops), _) if self.reorder.deadline().is_some_and(|deadline| deadline <= now) => {
                self.reorder.finish(hops, books, ready);
                self.complete = true;
            }
            (None, Some(closed)) if now - closed > GRACE => {
                return Err(HostError::Above {
                    id: id.into(),
                    source_id: self.from.split('/').next().unwrap_or_default().to_string(),
                    reason: format!("its output {} closed without an end", self.from),
                });
            }
            _ => {}
        }
        Ok(())
    }
}
