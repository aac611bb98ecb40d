//! The inputs of a process: each edge's messages in order, and its end.

use realo_operator::{InputBooks, PortId};
use realo_schemas::{Message, Nanos};

use crate::reorder::Reorder;

use super::HostError;

/// What is missing at the end of an input, or the end itself once dora has closed it, may be so late, ns: messages, ends and
/// closings come on ways of their own.
const GRACE: Nanos = 5_000_000_000;

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
    /// dora has closed the input.
    pub closed: bool,
    /// Wall time of what came last.
    pub heard: Nanos,
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
            closed: false,
            heard: 0,
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
        let late = now - self.heard > GRACE;
        match self.end {
            Some(hops) if self.reorder.is_complete(hops) => self.complete = true,
            Some(hops) if late => {
                self.reorder.finish(hops, books, ready);
                self.complete = true;
            }
            None if self.closed && late => {
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

#[cfg(test)]
mod tests {
    use realo_schemas::{Boxes, Header, Kind};

    use super::*;

    /// Seconds of wall time, ns.
    const SECOND: Nanos = 1_000_000_000;

    struct Rig {
        edge: Edge,
        books: InputBooks,
        ready: Vec<Message>,
    }

    impl Rig {
        fn new() -> Self {
            Rig {
                edge: Edge::new("boxes", "far.away/out", Vec::new()),
                books: InputBooks::default(),
                ready: Vec::new(),
            }
        }

        fn hear(&mut self, hop: u64, now: Nanos) {
            let header = Header::origin(&"run".into(), &"a".into(), Kind::Boxes, hop, 0, 0);
            let message = Message::new(header, Boxes::default());
            let Rig { edge, books, ready } = self;
            edge.heard = now;
            edge.reorder.offer(hop, message, now, books, ready);
        }

        fn settle(&mut self, now: Nanos) -> Result<bool, String> {
            let Rig { edge, books, ready } = self;
            let settled = edge.settle("me", now, books, ready);
            settled.map(|()| edge.complete).map_err(|error| error.to_string())
        }

        fn hops(&self) -> Vec<u64> {
            self.ready.iter().map(|message| message.header.seq).collect()
        }
    }

    #[test]
    fn an_edge_is_complete_with_its_last_message_and_its_end() {
        let mut rig = Rig::new();
        rig.hear(0, 0);
        rig.hear(1, 0);
        assert_eq!(rig.settle(100 * SECOND), Ok(false), "it may go on");
        rig.edge.end = Some(2);
        rig.edge.closed = true;
        assert_eq!(rig.settle(100 * SECOND), Ok(true));
        assert_eq!((rig.hops(), rig.books.transport_lost), (vec![0, 1], 0));
    }

    #[test]
    fn what_is_missing_at_the_end_is_waited_for_and_given_up() {
        let mut rig = Rig::new();
        rig.hear(0, SECOND);
        rig.edge.end = Some(3);
        assert_eq!(rig.settle(SECOND + GRACE), Ok(false));
        assert_eq!(rig.settle(SECOND + GRACE + 1), Ok(true));
        assert_eq!((rig.hops(), rig.books.transport_lost), (vec![0], 2));
    }

    #[test]
    fn a_hop_that_is_missing_on_the_way_is_given_up_before_the_end() {
        let mut rig = Rig::new();
        rig.hear(1, 0);
        assert_eq!((rig.settle(1), rig.hops()), (Ok(false), vec![]));
        assert_eq!(rig.settle(Reorder::<Message>::PATIENCE), Ok(false));
        assert_eq!((rig.hops(), rig.books.transport_lost), (vec![1], 1));
    }

    #[test]
    fn an_input_that_closes_without_an_end_fails_the_process_after_a_grace() {
        let mut rig = Rig::new();
        rig.edge.heard = SECOND;
        assert_eq!(rig.settle(SECOND + GRACE + 1), Ok(false), "it may go on");
        rig.edge.closed = true;
        assert_eq!(rig.settle(SECOND + GRACE), Ok(false));
        let error = rig.settle(SECOND + GRACE + 1).unwrap_err();
        assert_eq!(
            error,
            "me: node `far.away` failed: its output far.away/out closed without an end"
        );
        rig.edge.end = Some(0);
        assert_eq!(rig.settle(SECOND + GRACE + 1), Ok(true), "the end came after all");
    }
}
