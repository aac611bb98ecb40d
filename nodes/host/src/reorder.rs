//! Puts the messages of one dora edge back in order and counts what dora lost, repeated or shuffled.

use std::collections::{BTreeMap, BTreeSet};

use realo_operator::InputBooks;

/// One edge's messages in order of `hop`.
#[derive(Debug, Default)]
pub(crate) struct Reorder<T> {
    next: u64,
    early: BTreeMap<u64, T>,
    given_up: BTreeSet<u64>,
    /// Wall time, ns, since when `next` is missed.
    missing_since: Option<i64>,
}

impl<T> Reorder<T> {
    /// How long a missing hop is waited for, ns.
    pub const PATIENCE: i64 = 20_000_000;
    /// Hops that were given up and would be known if they came.
    const REMEMBERED: u64 = 4096;

    pub fn new() -> Self {
        Reorder {
            next: 0,
            early: BTreeMap::new(),
            given_up: BTreeSet::new(),
            missing_since: None,
        }
    }

    /// Takes in a message at wall time `now`; what can be handed on goes to `ready`.
    pub fn offer(&mut self, hop: u64, item: T, now: i64, books: &mut InputBooks, ready: &mut Vec<T>) {
        if self.given_up.contains(&hop) {
            // Came after it had been counted as lost: dropped, and stays lost.
            return;
        }
        if hop < self.next || self.early.contains_key(&hop) {
            books.transport_repeated += 1;
            return;
        }
        if self.early.keys().next_back().is_some_and(|newest| hop < *newest) {
            books.transport_reordered += 1;
        }
        self.early.insert(hop, item);
        self.hand_on(now, ready);
    }

    /// Gives up on hops that have been missing for too long.
    pub fn expire(&mut self, now: i64, books: &mut InputBooks, ready: &mut Vec<T>) {
        while self.missing_since.is_some_and(|since| now - since >= Self::PATIENCE) {
            let Some(first) = self.early.keys().next().copied() else {
                break;
            };
            self.give_up_before(first, books);
            self.hand_on(now, ready);
        }
    }

    /// When [`Self::expire`] has something to do, in wall time.
    pub fn deadline(&self) -> Option<i64> {
        self.missing_since.map(|since| since + Self::PATIENCE)
    }

    /// The edge ends after `count` messages: whether all of them were handed on.
    pub fn is_complete(&self, count: u64) -> bool {
        self.next >= count
    }

    /// Gives up on everything up to `count`.
    pub fn finish(&mut self, count: u64, books: &mut InputBooks, ready: &mut Vec<T>) {
        while self.next < count {
            let first = self.early.keys().next().copied().unwrap_or(count);
            self.give_up_before(first, books);
            self.hand_on(0, ready);
        }
        self.missing_since = None;
    }

    fn give_up_before(&mut self, hop: u64, books: &mut InputBooks) {
        books.transport_lost += hop - self.next;
        self.given_up
            .extend(self.next.max(hop.saturating_sub(Self::REMEMBERED))..hop);
        while self.given_up.len() as u64 > Self::REMEMBERED {
            self.given_up.pop_first();
        }
        self.next = hop;
        self.missing_since = None;
    }

    fn hand_on(&mut self, now: i64, ready: &mut Vec<T>) {
        let before = self.next;
        while let Some(item) = self.early.remove(&self.next) {
            ready.push(item);
            self.next += 1;
        }
        self.missing_since = match (self.early.is_empty(), self.next == before) {
            (true, _) => None,
            (false, true) => self.missing_since.or(Some(now)),
            (false, false) => Some(now),
        };
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn feed(hops: &[(i64, u64)], count: u64) -> (Vec<u64>, InputBooks) {
        let (mut reorder, mut books, mut ready) = (Reorder::new(), InputBooks::default(), Vec::new());
        for (now, hop) in hops {
            reorder.expire(*now, &mut books, &mut ready);
            reorder.offer(*hop, *hop, *now, &mut books, &mut ready);
        }
        reorder.finish(count, &mut books, &mut ready);
        (ready, books)
    }

    #[test]
    fn waits_for_a_missing_hop_and_then_gives_up() {
        let (order, books) = feed(&[(0, 0), (1, 2), (2, 1)], 3);
        assert_eq!(
            (order, books.transport_reordered, books.transport_lost),
            (vec![0, 1, 2], 1, 0)
        );
        let late = Reorder::<u64>::PATIENCE + 1;
        let (order, books) = feed(&[(0, 0), (1, 2), (1 + late, 3), (2 + late, 1)], 4);
        assert_eq!(
            (order, books.transport_lost, books.transport_repeated),
            (vec![0, 2, 3], 1, 0)
        );
    }

    #[test]
    fn a_gap_of_any_size_is_given_up_at_once() {
        let far = 1 << 60;
        let (order, books) = feed(
            &[
                (0, 0),
                (1, far),
                (Reorder::<u64>::PATIENCE + 1, far + 1),
                (0, far - 1),
                (0, 5),
            ],
            far + 2,
        );
        assert_eq!((order, books.transport_lost), (vec![0, far, far + 1], far - 1));
        assert_eq!(
            books.transport_repeated, 1,
            "of what was given up long ago nothing is known"
        );
    }

    #[test]
    fn an_edge_is_complete_when_its_last_hop_came_and_a_gap_is_waited_for() {
        let (mut reorder, mut books, mut ready) = (Reorder::new(), InputBooks::default(), Vec::new());
        assert!(reorder.is_complete(0) && reorder.deadline().is_none());
        reorder.offer(0, 0, 5, &mut books, &mut ready);
        assert!(reorder.is_complete(1) && !reorder.is_complete(2));
        reorder.offer(2, 2, 7, &mut books, &mut ready);
        reorder.offer(3, 3, 9, &mut books, &mut ready);
        let late = 7 + Reorder::<u64>::PATIENCE;
        assert_eq!(reorder.deadline(), Some(late), "since it was first missed");
        reorder.expire(late - 1, &mut books, &mut ready);
        assert_eq!(ready, [0]);
        reorder.expire(late, &mut books, &mut ready);
        assert_eq!(
            (ready.as_slice(), books.transport_lost, reorder.deadline()),
            (&[0, 2, 3][..], 1, None)
        );
        reorder.offer(2, 2, 30, &mut books, &mut ready);
        assert_eq!((books.transport_repeated, ready.len()), (1, 3));
    }

    proptest! {
        #[test]
        fn hands_on_in_order_and_accounts_for_every_hop(
            hops in proptest::collection::vec((0i64..30_000_000, 0u64..40), 0..120)
        ) {
            let mut now = 0;
            let timed: Vec<_> = hops.iter().map(|(dt, hop)| { now += dt; (now, *hop) }).collect();
            let (order, books) = feed(&timed, 40);
            prop_assert!(order.windows(2).all(|pair| pair[0] < pair[1]));
            prop_assert_eq!(order.len() as u64 + books.transport_lost, 40);
        }
    }
}
