//! What an agent knows of its own bulk on the way to a peer: how long it took, by what the peer acknowledged.

use std::collections::BTreeMap;

use realo_schemas::report::OnAir;
use realo_schemas::{Kind, Nanos};

use crate::protocol::{Offer, Outcome, Report, is_bulk};

/// Messages of which it is not known what became of them, at most; of more the oldest are forgotten.
const OPEN: usize = 64;
/// A crossing counts as at least so long: the round trip is not known better.
const SHORTEST: Nanos = 100_000;

/// Messages that were offered, and words about those that crossed or did not.
#[derive(Debug, Default)]
pub(super) struct Air {
    /// Bytes, and when it was offered, once that is known.
    open: BTreeMap<(Kind, u64), (usize, Option<Nanos>)>,
    /// When the last one had crossed.
    crossed: Option<Nanos>,
    words: Vec<OnAir>,
}

impl Air {
    /// A message was offered; when, [`Air::looked`] says.
    pub fn offered(&mut self, offer: &Offer) {
        if is_bulk(offer.kind) {
            self.open.insert((offer.kind, offer.seq), (offer.bytes.len(), None));
            if self.open.len() > OPEN {
                self.open.pop_first();
            }
        }
    }

    /// What goes out was asked for now, soon after it was offered.
    pub fn looked(&mut self, now: Nanos) {
        for (_, offered) in self.open.values_mut() {
            offered.get_or_insert(now);
        }
    }

    /// Messages left the sender's hands; `round_trip`: what a message without bytes takes there and back.
    pub fn reported(&mut self, reported: &[Report], round_trip: Option<Nanos>, now: Nanos) {
        for Report { kind, seq, outcome } in reported {
            let Some((bytes, offered)) = self.open.remove(&(*kind, *seq)) else {
                continue;
            };
            let mut word = OnAir {
                bytes: bytes as u64,
                ..OnAir::default()
            };
            match (outcome, offered) {
                (Outcome::Sent, Some(offered)) => {
                    let took = now - offered - round_trip.unwrap_or(0);
                    word.air_ns = took.max(SHORTEST);
                    word.span_ns = self.crossed.map_or(0, |before| now - before);
                    // Who else sends shows in the time that its own bytes take.
                    word.busy_ns = word.air_ns.min(word.span_ns);
                    self.crossed = Some(now);
                }
                (Outcome::Sent, None) => continue,
                (Outcome::Superseded | Outcome::Late | Outcome::Lost, _) => word.dropped = true,
            }
            self.words.push(word);
        }
    }

    /// The words since the last call.
    pub fn take(&mut self) -> Vec<OnAir> {
        std::mem::take(&mut self.words)
    }
}

#[cfg(test)]
mod tests {
    use bytes::Bytes;

    use super::*;

    const MS: Nanos = 1_000_000;

    fn offer(kind: Kind, seq: u64) -> Offer {
        Offer {
            kind,
            seq,
            stamp: 0,
            born: 0,
            bytes: Bytes::from_static(&[0; 1000]),
        }
    }

    fn report(seq: u64, outcome: Outcome) -> Report {
        let kind = Kind::Features;
        Report { kind, seq, outcome }
    }

    #[test]
    fn a_map_takes_what_it_took_beyond_a_round_trip_and_one_that_was_replaced_was_dropped() {
        let mut air = Air::default();
        for (seq, outcome) in [(0, Outcome::Sent), (1, Outcome::Superseded), (2, Outcome::Sent)] {
            let begun = 100 * seq as Nanos * MS;
            air.offered(&offer(Kind::Features, seq));
            air.offered(&offer(Kind::Boxes, seq));
            air.looked(begun);
            air.looked(begun + 50 * MS);
            air.reported(&[report(seq, outcome)], Some(40 * MS), begun + 70 * MS);
        }
        let word = |dropped, times: [Nanos; 3]| {
            let [air_ns, span_ns, busy_ns] = times.map(|time| time * MS);
            OnAir {
                bytes: 1000,
                dropped,
                air_ns,
                span_ns,
                busy_ns,
            }
        };
        let expected = [
            word(false, [30, 0, 0]),
            word(true, [0, 0, 0]),
            word(false, [30, 200, 30]),
        ];
        assert_eq!(air.take(), expected);
        assert_eq!(air.take(), []);
    }

    #[test]
    fn forgets_messages_of_which_nothing_is_heard() {
        let mut air = Air::default();
        (0..1000).for_each(|seq| air.offered(&offer(Kind::Features, seq)));
        assert_eq!(air.open.len(), OPEN);
        air.reported(&[report(5, Outcome::Sent)], None, MS);
        assert_eq!(air.take(), []);
    }
}
