//! The receiving side: parts become messages, and are acknowledged.

use std::collections::{BTreeMap, BTreeSet};

use bytes::Bytes;
use realo_schemas::{Kind, Nanos};

use super::frame::{Acknowledgement, Head};
use super::is_bulk;
use super::window::SMALLEST;
use crate::refusal::Refusal;

/// Messages of a kind that may be incomplete at a time.
const INCOMPLETE: usize = 4;
/// Numbers of messages of a kind that are remembered, so that each is given once.
const REMEMBERED: usize = 256;
/// Parts of a message that come closer together than this share an acknowledgement.
const TOGETHER: Nanos = 1_000_000;
/// Parts that share one at most.
const SHARED: u32 = 4;
/// What a part takes of memory beside its bytes.
const PART_COSTS: usize = 128;

/// A message that came in whole.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Arrived {
    /// What it carries.
    pub kind: Kind,
    /// Its number.
    pub seq: u64,
    /// When what it reports was measured, as its sender said.
    pub stamp: Nanos,
    /// What crossed.
    pub bytes: Bytes,
    /// What its parts took at the pace at which they came, ns; 0 of one part.
    pub took: Nanos,
}

/// What a part leads to.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Received {
    /// What goes back at once.
    pub acknowledgement: Option<Acknowledgement>,
    /// A message that is complete now.
    pub message: Option<Arrived>,
}

/// What became of parts and messages that were not given.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ReceiverCounts {
    /// Messages that were given.
    pub messages: u64,
    /// Parts that had come in before, or belong to a message that had.
    pub repeated: u64,
    /// Incomplete messages that were forgotten for newer ones.
    pub forgotten: u64,
}

/// The receiving side of a way from a peer.
#[derive(Debug)]
pub struct Receiver {
    largest: usize,
    session: u64,
    kinds: BTreeMap<Kind, KindReceiver>,
    counts: ReceiverCounts,
}

/// Messages of a kind.
#[derive(Debug, Default)]
struct KindReceiver {
    incomplete: BTreeMap<u64, Incomplete>,
    /// Numbers of messages that were given, the newest of them.
    given: BTreeSet<u64>,
    /// The first number that is still remembered; older ones count as given.
    from: u64,
    /// The newest message that came in parts; older ones in parts are not given any more.
    newest: u64,
    acknowledged: Option<Nanos>,
    /// Parts since then, and the last one of them by message and place.
    silent: u32,
    unsaid: Option<(u64, u32)>,
}

#[derive(Debug)]
struct Incomplete {
    begun: Nanos,
    /// When its last part came in.
    grew: Nanos,
    stamp: Nanos,
    count: u32,
    parts: BTreeMap<u32, Bytes>,
    bytes: usize,
}

impl Incomplete {
    /// Memory that it takes.
    fn held(&self) -> usize {
        self.bytes + self.parts.len() * PART_COSTS
    }
}

impl Receiver {
    /// From a peer of whom nothing came yet; messages have at most `largest` bytes.
    pub fn new(largest: usize) -> Self {
        Receiver {
            largest,
            session: 0,
            kinds: BTreeMap::new(),
            counts: ReceiverCounts::default(),
        }
    }

    /// Takes a part that came in.
    ///
    /// # Errors
    /// [`Refusal::Replayed`] of a sender that has been started anew since, [`Refusal::Oversized`] of a message that is too large,
    /// [`Refusal::Malformed`] of one that contradicts other parts.
    pub fn take(&mut self, head: &Head, part: Bytes, now: Nanos) -> Result<Received, Refusal> {
        if head.session < self.session {
            return Err(Refusal::Replayed);
        }
        if head.session > self.session {
            self.session = head.session;
            self.kinds.clear();
        }
        let of_kind = self.kinds.entry(head.kind).or_default();
        let message = match of_kind.insert(head, part, self.largest, now)? {
            Inserted::Whole(bytes, took) => {
                self.counts.messages += 1;
                self.counts.forgotten += of_kind.forget_before(head.seq);
                Some(Arrived {
                    kind: head.kind,
                    seq: head.seq,
                    stamp: head.stamp,
                    bytes,
                    took,
                })
            }
            Inserted::Part => {
                self.counts.forgotten += of_kind.forget_most();
                None
            }
            Inserted::Again => {
                self.counts.repeated += 1;
                None
            }
        };
        Ok(Received {
            acknowledgement: head
                .asks
                .then(|| of_kind.acknowledge(head, now, message.is_some()))
                .flatten(),
            message,
        })
    }

    /// What was counted.
    pub fn counts(&self) -> ReceiverCounts {
        self.counts
    }

    /// Bytes that incomplete messages take.
    pub fn held(&self) -> usize {
        let incomplete = self.kinds.values().flat_map(|of_kind| of_kind.incomplete.values());
        incomplete.map(Incomplete::held).sum()
    }

    /// Forgets the incomplete message that takes most; `false` if there is none.
    pub fn forget_largest(&mut self) -> bool {
        let kinds = self.kinds.values_mut();
        let messages = kinds.flat_map(|of_kind| {
            let held: Vec<(usize, u64)> = (of_kind.incomplete.iter())
                .map(|(seq, message)| (message.held(), *seq))
                .collect();
            held.into_iter().max().map(|largest| (largest, of_kind))
        });
        let Some(((_, seq), of_kind)) = messages.max_by_key(|(largest, _)| *largest) else {
            return false;
        };
        of_kind.incomplete.remove(&seq);
        self.counts.forgotten += 1;
        true
    }
}

enum Inserted {
    Part,
    /// With what its parts took.
    Whole(Bytes, Nanos),
    Again,
}

impl KindReceiver {
    fn insert(&mut self, head: &Head, part: Bytes, largest: usize, now: Nanos) -> Result<Inserted, Refusal> {
        let count = head.count as usize;
        if head.seq < self.from || self.given.contains(&head.seq) || (count > 1 && head.seq < self.newest) {
            return Ok(Inserted::Again);
        }
        // Senders make no smaller parts, so that nobody can ask for a long list with a short message.
        let most = largest.div_ceil(SMALLEST);
        if part.len() > largest || count > most {
            return Err(Refusal::Oversized);
        }
        if count > 1 && (part.is_empty() || !is_bulk(head.kind)) {
            return Err(Refusal::Malformed);
        }
        if count == 1 {
            if self.incomplete.contains_key(&head.seq) {
                return Err(Refusal::Malformed);
            }
            self.given(head.seq);
            return Ok(Inserted::Whole(part, 0));
        }
        let message = self.incomplete.entry(head.seq).or_insert_with(|| Incomplete {
            begun: now,
            grew: now,
            stamp: head.stamp,
            count: head.count,
            parts: BTreeMap::new(),
            bytes: 0,
        });
        if message.count != head.count || message.stamp != head.stamp {
            return Err(Refusal::Malformed);
        }
        if message.bytes + part.len() > largest {
            return Err(Refusal::Oversized);
        }
        if message.parts.contains_key(&head.index) {
            return Ok(Inserted::Again);
        }
        message.bytes += part.len();
        message.grew = now;
        message.parts.insert(head.index, part);
        if message.parts.len() < count {
            return Ok(Inserted::Part);
        }
        let message = self.incomplete.remove(&head.seq).expect("it was just there");
        self.given(head.seq);
        self.newest = head.seq;
        let parts: Vec<Bytes> = message.parts.into_values().collect();
        // The first part is what time is counted from.
        let took = (now - message.begun) * count as Nanos / (count as Nanos - 1);
        Ok(Inserted::Whole(parts.concat().into(), took))
    }

    fn given(&mut self, seq: u64) {
        self.given.insert(seq);
        while self.given.len() > REMEMBERED {
            if let Some(oldest) = self.given.pop_first() {
                self.from = oldest + 1;
            }
        }
    }

    /// Older messages would tell of the past: their senders have given them up, or will.
    fn forget_before(&mut self, seq: u64) -> u64 {
        let newer = self.incomplete.split_off(&seq);
        std::mem::replace(&mut self.incomplete, newer).len() as u64
    }

    /// Of too many, those are forgotten of which nothing came for longest: their sender has given them up.
    fn forget_most(&mut self) -> u64 {
        let mut forgotten = 0;
        while self.incomplete.len() > INCOMPLETE {
            let stale = self
                .incomplete
                .iter()
                .min_by_key(|(seq, message)| (message.grew, **seq));
            let Some(seq) = stale.map(|(seq, _)| *seq) else { break };
            self.incomplete.remove(&seq);
            forgotten += 1;
        }
        forgotten
    }

    /// The acknowledgement of a part, unless the next part's can say it too.
    fn acknowledge(&mut self, head: &Head, now: Nanos, complete: bool) -> Option<Acknowledgement> {
        let close = self
            .acknowledged
            .is_some_and(|last| (0..TOGETHER).contains(&(now - last)));
        let waits = head.waits || complete;
        let unsaid = self.unsaid.take().filter(|(seq, _)| *seq == head.seq);
        // One that overtook this part is acknowledged together with it.
        let further = unsaid
            .map(|(_, index)| index)
            .filter(|index| index.saturating_sub(head.index) <= 32 && *index < head.count);
        let index = further.map_or(head.index, |further| further.max(head.index));
        self.silent += 1;
        if close && !waits && self.silent < SHARED {
            self.unsaid = Some((head.seq, index));
            return None;
        }
        (self.acknowledged, self.silent) = (Some(now), 0);
        Some(Acknowledgement {
            kind: head.kind,
            session: head.session,
            seq: head.seq,
            index,
            before: self.before(head.seq, index),
            sent: head.sent,
            received: now,
        })
    }

    /// Which of the 32 parts before one came in.
    fn before(&self, seq: u64, index: u32) -> u32 {
        let known = self.incomplete.get(&seq).map(|message| &message.parts);
        let arrived = |index: u32| known.is_none_or(|parts| parts.contains_key(&index));
        let back = (0..32u32).filter(|back| index.checked_sub(1 + back).is_some_and(arrived));
        back.fold(0, |bits, back| bits | 1 << back)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const MS: Nanos = 1_000_000;
    const LARGEST: usize = 1 << 20;

    fn head(seq: u64, index: u32, count: u32) -> Head {
        Head {
            kind: Kind::Points,
            asks: true,
            waits: index + 1 == count,
            session: 1,
            seq,
            index,
            count,
            sent: 0,
            stamp: seq as Nanos,
        }
    }

    fn part(text: &'static str) -> Bytes {
        Bytes::from_static(text.as_bytes())
    }

    #[test]
    fn what_overtook_a_part_is_acknowledged_with_it() {
        let mut receiver = Receiver::new(LARGEST);
        let mut take = |index| {
            let head = Head {
                waits: false,
                ..head(1, index, 8)
            };
            receiver.take(&head, part("x"), index as Nanos).unwrap().acknowledgement
        };
        assert!(take(0).is_some());
        assert_eq!([take(1), take(4), take(2)], [None; 3]);
        let reported = take(3).unwrap();
        assert_eq!((reported.index, reported.before), (4, 0b1111));
    }

    #[test]
    fn parts_in_any_order_and_number_become_a_message_once() {
        let mut receiver = Receiver::new(LARGEST);
        let parts = [(2, "ef"), (0, "ab"), (2, "ef"), (1, "cd"), (1, "cd")];
        let mut given = Vec::new();
        for (index, text) in parts {
            given.extend(receiver.take(&head(5, index, 3), part(text), 10 * MS).unwrap().message);
        }
        assert_eq!(given.len(), 1);
        assert_eq!((given[0].seq, &given[0].bytes[..]), (5, &b"abcdef"[..]));
        let counts = receiver.counts();
        assert_eq!((counts.messages, counts.repeated, receiver.held()), (1, 2, 0));
    }

    #[test]
    fn acknowledges_at_once_or_with_the_next_parts() {
        let mut receiver = Receiver::new(LARGEST);
        let mut acks = |at: Nanos, index: u32| {
            let received = receiver.take(&head(1, index, 50), part("x"), at).unwrap();
            received.acknowledgement.map(|ack| (ack.index, ack.before))
        };
        assert_eq!(acks(0, 0), Some((0, 0)));
        assert_eq!([acks(10, 1), acks(20, 2), acks(30, 3)], [None; 3]);
        assert_eq!(acks(40, 4), Some((4, 0b1111)));
        assert_eq!(acks(2 * MS, 6), Some((6, 0b11_1110)), "part 5 is missing");
        assert_eq!(acks(2 * MS + 1, 49).map(|(index, _)| index), Some(49), "the last one");
    }

    #[test]
    fn a_newer_message_makes_an_older_incomplete_one_forgotten() {
        let mut receiver = Receiver::new(LARGEST);
        receiver.take(&head(1, 0, 2), part("a"), 0).unwrap();
        receiver.take(&head(2, 0, 2), part("b"), 0).unwrap();
        assert!(receiver.take(&head(2, 1, 2), part("b"), 0).unwrap().message.is_some());
        assert_eq!((receiver.counts().forgotten, receiver.held()), (1, 0));
        for seq in 10..30 {
            receiver.take(&head(seq, 0, 2), part("a"), 0).unwrap();
        }
        assert_eq!(receiver.held(), INCOMPLETE * (1 + PART_COSTS));
    }

    #[test]
    fn an_older_small_message_is_given_once_too() {
        let mut receiver = Receiver::new(LARGEST);
        let mut small = |seq: u64| {
            let head = Head {
                kind: Kind::Boxes,
                asks: false,
                ..head(seq, 0, 1)
            };
            let received = receiver.take(&head, part("boxes"), 0).unwrap();
            assert_eq!(received.acknowledgement, None);
            received.message.is_some()
        };
        assert_eq!([7, 6, 7, 6, 8].map(&mut small), [true, true, false, false, true]);
        (9..1000).for_each(|seq| assert!(small(seq)));
        assert!(!small(5), "older than what is remembered");
    }

    #[test]
    fn a_sender_that_starts_anew_begins_anew_and_its_past_is_rejected() {
        let mut receiver = Receiver::new(LARGEST);
        assert!(receiver.take(&head(9, 0, 1), part("a"), 0).unwrap().message.is_some());
        let anew = Head {
            session: 2,
            ..head(0, 0, 1)
        };
        assert!(receiver.take(&anew, part("a"), 0).unwrap().message.is_some());
        assert_eq!(receiver.take(&head(10, 0, 1), part("a"), 0), Err(Refusal::Replayed));
    }

    #[test]
    fn what_is_too_large_or_contradicts_is_rejected_and_held_memory_is_bounded() {
        let mut receiver = Receiver::new(3 * SMALLEST);
        let zeros = |bytes: usize| Bytes::from(vec![0; bytes]);
        let rejected = |receiver: &mut Receiver, head: Head, bytes: usize, why: Refusal| {
            assert_eq!(receiver.take(&head, zeros(bytes), 0), Err(why), "{head:?}");
        };
        let (large, odd) = (Refusal::Oversized, Refusal::Malformed);
        rejected(&mut receiver, head(1, 0, 1), 3 * SMALLEST + 1, large);
        rejected(&mut receiver, head(1, 0, 4), 1, large);
        rejected(&mut receiver, head(1, 0, u32::MAX), 1, large);
        rejected(&mut receiver, head(1, 0, 3), 0, odd);
        receiver.take(&head(1, 0, 3), zeros(2 * SMALLEST), 0).unwrap();
        rejected(&mut receiver, head(1, 1, 3), SMALLEST + 1, large);
        rejected(&mut receiver, head(1, 1, 2), 6, odd);
        let moved = Head {
            stamp: 77,
            ..head(1, 1, 3)
        };
        rejected(&mut receiver, moved, 6, odd);
        rejected(&mut receiver, head(1, 0, 1), 6, odd);
        assert_eq!(receiver.held(), 2 * SMALLEST + PART_COSTS);
    }

    proptest! {
        /// Whatever a peer says of a few numbers: each message is given once, what goes back is of parts that there are, and what is
        /// kept has its bounds.
        #[test]
        fn heads_that_contradict_each_other_do_no_harm(parts in prop::collection::vec(
            (0u64..4, 1u32..40, any::<u32>(), any::<(bool, bool, bool)>(), 0i64..3, 0i64..2 * MS, 0usize..2 * SMALLEST),
            0..200,
        )) {
            let mut receiver = Receiver::new(8 * SMALLEST);
            let (mut now, mut given) = (0, BTreeSet::new());
            for (seq, count, index, (asks, waits, is_bulk), stamp, later, bytes) in parts {
                now += later;
                let head = Head {
                    kind: if is_bulk { Kind::Points } else { Kind::Boxes },
                    asks,
                    waits,
                    stamp,
                    ..head(seq, index % count, count)
                };
                if let Ok(received) = receiver.take(&head, vec![7; bytes].into(), now) {
                    prop_assert!(received.acknowledgement.is_none_or(|ack| ack.index < count && ack.seq == seq));
                    if let Some(message) = received.message {
                        prop_assert!(given.insert((message.kind, message.seq)));
                    }
                }
                prop_assert!(receiver.held() <= 2 * INCOMPLETE * (8 * SMALLEST + 40 * PART_COSTS));
            }
            while receiver.forget_largest() {}
            prop_assert_eq!(receiver.held(), 0);
        }
    }
}
