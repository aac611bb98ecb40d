//! What became of the messages of every channel.

use std::collections::BTreeMap;

use realo_schemas::Kind;
use realo_schemas::report::{Crossing, Fate, Fated};
use serde::{Deserialize, Serialize};

use crate::Ages;

/// Messages of a channel whose fate may still change: the newest ones. A message that far behind the newest one has left
/// every stage.
const OPEN: u64 = 4096;

/// Messages by what became of them; each counts once, under the first that fits.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Fates {
    /// In at least one fusion that took place.
    pub used: u64,
    /// Skipped by a busy stage, or only in Selections that were.
    pub skipped: u64,
    /// Only in fusions that took no more collaborators.
    pub over_limit: u64,
    /// Left out by a guard.
    #[serde(default)]
    pub distrusted: u64,
    /// Older than the window when asked for.
    pub stale: u64,
    /// A newer one of its sender took its place, or it came older than what was held.
    pub superseded: u64,
    /// A stage or a fusion could not take it.
    pub rejected: u64,
    /// Never asked for, after the last query.
    pub in_flight: u64,
}

impl Fates {
    /// All messages.
    pub fn total(&self) -> u64 {
        let Fates {
            used,
            skipped,
            over_limit,
            distrusted,
            stale,
            superseded,
            rejected,
            in_flight,
        } = *self;
        used + skipped + over_limit + distrusted + stale + superseded + rejected + in_flight
    }

    /// Adds the messages of other books.
    pub fn add(&mut self, other: &Fates) {
        for (sum, other) in self.terms().into_iter().zip(other.clone().terms()) {
            *sum += *other;
        }
    }

    fn terms(&mut self) -> [&mut u64; 8] {
        [
            &mut self.used,
            &mut self.skipped,
            &mut self.over_limit,
            &mut self.distrusted,
            &mut self.stale,
            &mut self.superseded,
            &mut self.rejected,
            &mut self.in_flight,
        ]
    }
}

/// The messages of one channel.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Settled {
    /// Those that the channel delivered.
    pub fates: Fates,
    /// Those that it lost.
    pub lost: u64,
}

impl Settled {
    /// All messages.
    pub fn total(&self) -> u64 {
        self.fates.total() + self.lost
    }

    fn count(&mut self, fate: Fate) {
        let fates = &mut self.fates;
        let term = match fate {
            Fate::Used => &mut fates.used,
            Fate::Skipped => &mut fates.skipped,
            Fate::OverLimit => &mut fates.over_limit,
            Fate::Distrusted => &mut fates.distrusted,
            Fate::Stale => &mut fates.stale,
            Fate::Superseded => &mut fates.superseded,
            Fate::Lost => &mut self.lost,
            Fate::Rejected => &mut fates.rejected,
            Fate::InFlight => &mut fates.in_flight,
        };
        *term += 1;
    }
}

/// Sender, receiver, kind.
pub type ChannelKey = (String, String, Kind);

/// Joins what stages say of messages. Its size is bounded, however long the run.
#[derive(Default)]
pub struct Ledger {
    channels: BTreeMap<ChannelKey, Open>,
    ages: BTreeMap<Kind, Ages>,
}

/// A channel, while stages still speak of it.
#[derive(Default)]
struct Open {
    /// By number: the first fate that fits so far.
    fates: BTreeMap<u64, Fate>,
    settled: Settled,
}

impl Ledger {
    /// Takes what a stage said. What is said of a message long after its channel's newest one is not counted, so that it
    /// stays unaccounted, in sight.
    pub fn take(&mut self, fated: &Fated) {
        // It says nothing of what became of the message.
        if fated.entry.is_some() {
            return;
        }
        let Crossing { from, to, kind, seq } = &fated.message;
        if let Some(r#use) = fated.r#use {
            self.ages.entry(*kind).or_default().record(r#use.age_ns);
        }
        let channel = self.channels.entry((from.clone(), to.clone(), *kind)).or_default();
        let newest = channel.fates.last_key_value().map_or(0, |(newest, _)| *newest);
        if seq + OPEN <= newest {
            return;
        }
        let known = channel.fates.entry(*seq).or_insert(fated.fate);
        *known = fated.fate.min(*known);
        while let Some(first) = channel.fates.first_entry() {
            if first.key() + OPEN > newest.max(*seq) {
                break;
            }
            channel.settled.count(first.remove());
        }
    }

    /// Closes the books.
    pub fn close(self) -> (BTreeMap<ChannelKey, Settled>, BTreeMap<Kind, Ages>) {
        let settle = |(key, Open { fates, mut settled }): (ChannelKey, Open)| {
            fates.into_values().for_each(|fate| settled.count(fate));
            (key, settled)
        };
        (self.channels.into_iter().map(settle).collect(), self.ages)
    }

    /// Messages whose fate may still change.
    #[cfg(test)]
    fn open(&self) -> usize {
        self.channels.values().map(|channel| channel.fates.len()).sum()
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use realo_schemas::report::{Entry, Use};

    use super::*;

    fn fated(seq: u64, fate: Fate) -> Fated {
        Fated {
            message: Crossing {
                from: "rsu1".into(),
                to: "cav1".into(),
                kind: Kind::Boxes,
                seq,
            },
            fate,
            r#use: (fate == Fate::Used).then_some(Use { query: 3, age_ns: -7 }),
            entry: None,
        }
    }

    fn close(ledger: Ledger) -> (Settled, u64) {
        let (channels, ages) = ledger.close();
        let key = ("rsu1".to_string(), "cav1".to_string(), Kind::Boxes);
        (
            channels.get(&key).copied().unwrap_or_default(),
            ages.get(&Kind::Boxes).map_or(0, Ages::count),
        )
    }

    fn one(fate: Fate) -> Settled {
        let mut settled = Settled::default();
        settled.count(fate);
        settled
    }

    #[test]
    fn a_message_counts_once_under_the_first_fate_that_fits() {
        for a in Fate::ALL {
            for b in Fate::ALL {
                let mut ledger = Ledger::default();
                for fate in [a, b, a] {
                    ledger.take(&fated(5, fate));
                }
                let uses = [a, b, a].iter().filter(|fate| **fate == Fate::Used).count() as u64;
                assert_eq!(close(ledger), (one(a.min(b)), uses), "{a:?} {b:?}");
            }
        }
    }

    #[test]
    fn every_fate_has_a_term_of_its_own() {
        let mut all = Settled::default();
        for (n, fate) in Fate::ALL.into_iter().enumerate() {
            (0..=n).for_each(|_| all.count(fate));
        }
        let expected = Fates {
            used: 1,
            skipped: 2,
            over_limit: 3,
            distrusted: 4,
            stale: 5,
            superseded: 6,
            rejected: 8,
            in_flight: 9,
        };
        assert_eq!((all.fates, all.lost, all.total()), (expected, 7, 45));
        let mut twice = expected;
        twice.add(&expected);
        let doubled = Fates {
            used: 2,
            skipped: 4,
            over_limit: 6,
            distrusted: 8,
            stale: 10,
            superseded: 12,
            rejected: 16,
            in_flight: 18,
        };
        assert_eq!((twice, twice.total()), (doubled, 76));
    }

    #[test]
    fn that_a_message_was_sent_is_no_account_of_it() {
        let mut ledger = Ledger::default();
        let entered = |seq| Fated {
            entry: Some(Entry { bytes: 800, at_ns: 3 }),
            ..fated(seq, Fate::InFlight)
        };
        ledger.take(&entered(1));
        ledger.take(&entered(2));
        ledger.take(&fated(2, Fate::Lost));
        let (settled, _) = close(ledger);
        assert_eq!((settled.total(), settled.lost), (1, 1), "the first stays unaccounted");
    }

    #[test]
    fn a_run_of_days_is_bounded_and_what_comes_far_too_late_is_not_counted() {
        let mut ledger = Ledger::default();
        for seq in 0..20_000 {
            ledger.take(&fated(seq, Fate::InFlight));
            ledger.take(&fated(seq, Fate::Stale));
            assert!(ledger.open() <= OPEN as usize);
        }
        ledger.take(&fated(3, Fate::Used));
        ledger.take(&fated(20_000 - OPEN, Fate::Used));
        assert_eq!(ledger.open(), OPEN as usize);
        let (settled, uses) = close(ledger);
        assert_eq!((settled.fates.stale, settled.fates.used, uses), (19_999, 1, 2));
    }

    proptest! {
        #[test]
        fn the_order_in_which_stages_speak_does_not_matter(
            reported in prop::collection::vec((0u64..30, 0usize..8), 0..80),
        ) {
            let sum = |reported: &[(u64, usize)]| {
                let mut ledger = Ledger::default();
                reported.iter().for_each(|(seq, fate)| ledger.take(&fated(*seq, Fate::ALL[*fate])));
                close(ledger)
            };
            let mut min: BTreeMap<u64, usize> = BTreeMap::new();
            for (seq, fate) in &reported {
                let known = min.entry(*seq).or_insert(*fate);
                *known = (*known).min(*fate);
            }
            let mut expected = Settled::default();
            min.values().for_each(|fate| expected.count(Fate::ALL[*fate]));
            let reversed: Vec<_> = reported.iter().rev().copied().collect();
            prop_assert_eq!(sum(&reported).0, expected);
            prop_assert_eq!(sum(&reversed), sum(&reported));
        }
    }
}
