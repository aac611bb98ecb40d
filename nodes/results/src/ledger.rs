//! The books of what the bank and the fusion did with each message.

use std::collections::{BTreeMap, VecDeque};

use realo_schemas::report::{BankReport, Fate, FusionReport, MessageId, Selected};
use realo_schemas::{Kind, Nanos};
use serde::{Deserialize, Serialize};

use crate::Ages;

/// Messages by what became of them in bank and fusion; each counts once, under the first that fits.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Fates {
    /// In at least one fusion that took place.
    pub used: u64,
    /// Only in Selections whose query a busy stage passed over, or passed over itself.
    pub skipped: u64,
    /// Only in fusions that took no more collaborators.
    pub over_limit: u64,
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
        self.used + self.skipped + self.over_limit + self.stale + self.superseded + self.rejected + self.in_flight
    }

    /// Adds the messages of other books.
    pub fn add(&mut self, other: &Fates) {
        self.used += other.used;
        self.skipped += other.skipped;
        self.over_limit += other.over_limit;
        self.stale += other.stale;
        self.superseded += other.superseded;
        self.rejected += other.rejected;
        self.in_flight += other.in_flight;
    }
}

/// What is known of a message that a Selection had, until it has left the bank and all its queries are decided.
#[derive(Default)]
struct Life {
    used: bool,
    over_limit: bool,
    rejected: bool,
    /// Queries that had it and are not decided.
    open: u32,
    departed: bool,
}

/// A query that the bank answered.
struct Asked {
    query: u64,
    selected: Vec<Selected>,
}

/// One ego's queries that are not decided. Bank and fusion report in the order of queries, but on two edges.
#[derive(Default)]
struct Queries {
    /// The bank has reported, the fusion has not.
    asked: VecDeque<Asked>,
    /// The fusion's report came before the bank's.
    fused: VecDeque<FusionReport>,
}

/// Joins the reports of bank and fusion; holds only what is not decided.
#[derive(Default)]
pub struct Ledger {
    lives: BTreeMap<MessageId, Life>,
    queries: BTreeMap<String, Queries>,
    fates: BTreeMap<(String, Kind), Fates>,
    ages: BTreeMap<Kind, Ages>,
}

impl Ledger {
    /// Takes what the bank reports.
    pub fn bank(&mut self, report: BankReport) {
        for selected in &report.selected {
            self.lives.entry(selected.message.clone()).or_default().open += 1;
        }
        if let Some(query) = report.query {
            let queries = self.queries.entry(report.agent.clone()).or_default();
            let selected = report.selected;
            queries.asked.push_back(Asked { query, selected });
            if let Some(at) = queries.fused.iter().position(|fused| fused.query == query) {
                // The bank's reports of those before it never came.
                let fused = queries.fused.drain(..=at).next_back();
                fused.into_iter().for_each(|fused| self.decide(&fused));
            }
        }
        for departed in report.departed {
            self.depart(departed.message, departed.fate);
        }
    }

    /// Takes what the fusion reports.
    pub fn fusion(&mut self, report: FusionReport) {
        let queries = self.queries.entry(report.agent.clone()).or_default();
        if !queries.asked.iter().any(|asked| asked.query == report.query) {
            return queries.fused.push_back(report);
        }
        // The bank's reports of fusions before this one would have come by now.
        queries.fused.clear();
        self.decide(&report);
    }

    /// Closes the books: queries that no fusion answered were passed over.
    pub fn close(mut self) -> (BTreeMap<(String, Kind), Fates>, BTreeMap<Kind, Ages>) {
        let left: Vec<Asked> = self.queries.values_mut().flat_map(|q| q.asked.drain(..)).collect();
        left.into_iter().for_each(|asked| self.pass_over(asked));
        // Without the report that closes the bank, what was selected last never departed.
        for (id, life) in std::mem::take(&mut self.lives) {
            self.count(id, &life);
        }
        (self.fates, self.ages)
    }

    /// Messages and queries that are not decided.
    pub fn open(&self) -> usize {
        let queries = self.queries.values().map(|q| q.asked.len() + q.fused.len());
        self.lives.len() + queries.sum::<usize>()
    }

    /// A fusion took place: its query is decided, and those before it were passed over.
    fn decide(&mut self, fused: &FusionReport) {
        let Some(queries) = self.queries.get_mut(&fused.agent) else {
            return;
        };
        let Some(at) = queries.asked.iter().position(|asked| asked.query == fused.query) else {
            return;
        };
        let mut decided: Vec<Asked> = queries.asked.drain(..=at).collect();
        let Some(asked) = decided.pop() else {
            return;
        };
        decided.into_iter().for_each(|passed| self.pass_over(passed));
        for Selected { message, age_ns } in asked.selected {
            self.fuse(message, age_ns, fused);
        }
    }

    fn fuse(&mut self, message: MessageId, age: Nanos, fused: &FusionReport) {
        let life = self.lives.entry(message.clone()).or_default();
        if fused.over_limit.contains(&message) {
            life.over_limit = true;
        } else if fused.rejected.contains(&message) {
            life.rejected = true;
        } else {
            life.used = true;
            self.ages.entry(message.kind).or_default().record(age);
        }
        self.answered(message);
    }

    fn pass_over(&mut self, asked: Asked) {
        asked
            .selected
            .into_iter()
            .for_each(|selected| self.answered(selected.message));
    }

    fn answered(&mut self, message: MessageId) {
        let Some(life) = self.lives.get_mut(&message) else {
            return;
        };
        life.open = life.open.saturating_sub(1);
        self.settle(message);
    }

    fn depart(&mut self, message: MessageId, fate: Fate) {
        if let Some(life) = self.lives.get_mut(&message) {
            life.departed = true;
            return self.settle(message);
        }
        let fates = self.fates.entry((message.agent, message.kind)).or_default();
        match fate {
            Fate::Stale => fates.stale += 1,
            Fate::Superseded => fates.superseded += 1,
            Fate::Rejected => fates.rejected += 1,
            Fate::InFlight => fates.in_flight += 1,
            // It was selected, but that report never came: it stays unaccounted, in sight.
            Fate::Unused => {}
        }
    }

    fn settle(&mut self, message: MessageId) {
        let decided = |life: &Life| life.departed && life.open == 0;
        if self.lives.get(&message).is_some_and(decided)
            && let Some(life) = self.lives.remove(&message)
        {
            self.count(message, &life);
        }
    }

    fn count(&mut self, message: MessageId, life: &Life) {
        let fates = self.fates.entry((message.agent, message.kind)).or_default();
        match (life.used, life.over_limit, life.rejected) {
            (true, _, _) => fates.used += 1,
            (_, true, _) => fates.over_limit += 1,
            (_, _, true) => fates.rejected += 1,
            _ => fates.skipped += 1,
        }
    }
}

#[cfg(test)]
mod tests {
    use realo_schemas::report::Departed;

    use super::*;

    fn id(seq: u64) -> MessageId {
        MessageId {
            agent: "rsu1".into(),
            kind: Kind::Boxes,
            seq,
        }
    }

    fn bank(query: Option<u64>, selected: &[u64], departed: &[(u64, Fate)]) -> BankReport {
        let selected = selected.iter().map(|seq| Selected {
            message: id(*seq),
            age_ns: 1_000_000 * *seq as i64,
        });
        let departed = departed.iter().map(|(seq, fate)| Departed {
            message: id(*seq),
            fate: *fate,
        });
        BankReport {
            query,
            agent: "cav1".into(),
            selected: selected.collect(),
            departed: departed.collect(),
        }
    }

    fn fusion(query: u64, over_limit: &[u64], rejected: &[u64]) -> FusionReport {
        FusionReport {
            query,
            agent: "cav1".into(),
            over_limit: over_limit.iter().map(|seq| id(*seq)).collect(),
            rejected: rejected.iter().map(|seq| id(*seq)).collect(),
        }
    }

    fn close(ledger: Ledger) -> (Fates, u64) {
        let (mut fates, ages) = ledger.close();
        let ages = ages.get(&Kind::Boxes).map_or(0, Ages::count);
        (fates.remove(&("rsu1".into(), Kind::Boxes)).unwrap_or_default(), ages)
    }

    #[test]
    fn a_message_counts_once_under_the_first_term_that_fits() {
        struct Case {
            /// Query, over its limit, rejected; `None`: passed over.
            outcomes: &'static [Option<(bool, bool)>],
            expected: Fates,
        }
        let one = |set: fn(&mut Fates)| {
            let mut fates = Fates::default();
            set(&mut fates);
            fates
        };
        const FUSED: Option<(bool, bool)> = Some((false, false));
        const OVER: Option<(bool, bool)> = Some((true, false));
        const REJECTED: Option<(bool, bool)> = Some((false, true));
        let cases = [
            Case {
                outcomes: &[FUSED],
                expected: one(|f| f.used = 1),
            },
            Case {
                outcomes: &[FUSED, FUSED],
                expected: one(|f| f.used = 1),
            },
            Case {
                outcomes: &[None, FUSED, OVER],
                expected: one(|f| f.used = 1),
            },
            Case {
                outcomes: &[REJECTED, FUSED],
                expected: one(|f| f.used = 1),
            },
            Case {
                outcomes: &[None],
                expected: one(|f| f.skipped = 1),
            },
            Case {
                outcomes: &[None, None],
                expected: one(|f| f.skipped = 1),
            },
            Case {
                outcomes: &[None, OVER],
                expected: one(|f| f.over_limit = 1),
            },
            Case {
                outcomes: &[OVER, REJECTED],
                expected: one(|f| f.over_limit = 1),
            },
            Case {
                outcomes: &[REJECTED, None],
                expected: one(|f| f.rejected = 1),
            },
        ];
        for (number, Case { outcomes, expected }) in cases.into_iter().enumerate() {
            for fusion_first in [false, true] {
                let mut ledger = Ledger::default();
                for (query, outcome) in (0..).zip(outcomes) {
                    let asked = bank(Some(query), &[5], &[]);
                    let report = outcome.map(|(over, rejected)| {
                        fusion(query, if over { &[5] } else { &[] }, if rejected { &[5] } else { &[] })
                    });
                    if fusion_first {
                        report.iter().for_each(|report| ledger.fusion(report.clone()));
                    }
                    ledger.bank(asked);
                    if !fusion_first {
                        report.into_iter().for_each(|report| ledger.fusion(report));
                    }
                }
                ledger.bank(bank(None, &[], &[(5, Fate::Unused)]));
                assert_eq!(close(ledger).0, expected, "case {number}, fusion first: {fusion_first}");
            }
        }
    }

    #[test]
    fn what_no_query_took_counts_by_its_fate_in_the_bank() {
        let mut ledger = Ledger::default();
        ledger.bank(bank(
            Some(0),
            &[],
            &[
                (1, Fate::Stale),
                (2, Fate::Superseded),
                (3, Fate::Superseded),
                (6, Fate::Rejected),
            ],
        ));
        ledger.bank(bank(None, &[], &[(4, Fate::InFlight)]));
        assert_eq!(ledger.open(), 1, "the query whose fusion may still come");
        let expected = Fates {
            stale: 1,
            superseded: 2,
            rejected: 1,
            in_flight: 1,
            ..Fates::default()
        };
        assert_eq!(close(ledger), (expected, 0));
    }

    #[test]
    fn ages_are_those_of_data_that_were_used() {
        let mut ledger = Ledger::default();
        ledger.bank(bank(Some(0), &[1], &[]));
        ledger.bank(bank(Some(1), &[1, 2, 3], &[]));
        ledger.fusion(fusion(1, &[3], &[]));
        ledger.bank(bank(
            None,
            &[],
            &[(1, Fate::Unused), (2, Fate::Unused), (3, Fate::Unused)],
        ));
        let (fates, ages) = close(ledger);
        assert_eq!((fates.used, fates.over_limit, ages), (2, 1, 2));
    }

    #[test]
    fn holds_little_however_long_the_run() {
        let mut ledger = Ledger::default();
        for query in 0..10_000u64 {
            let departed = if query > 0 {
                vec![(query - 1, Fate::Unused)]
            } else {
                vec![]
            };
            ledger.bank(bank(Some(query), &[query], &departed));
            if query % 3 != 0 {
                ledger.fusion(fusion(query, &[], &[]));
            }
            assert!(ledger.open() <= 6, "{} after query {query}", ledger.open());
        }
        let fates = close(ledger).0;
        assert_eq!((fates.used, fates.skipped), (6_666, 3_334));
    }

    #[test]
    fn keeps_books_when_reports_are_lost() {
        // The bank's report of query 1 is lost, and the one that closes its books.
        let mut ledger = Ledger::default();
        ledger.bank(bank(Some(0), &[0], &[]));
        ledger.fusion(fusion(0, &[], &[]));
        ledger.fusion(fusion(1, &[], &[]));
        ledger.bank(bank(Some(2), &[2], &[(0, Fate::Unused), (1, Fate::Unused)]));
        ledger.fusion(fusion(2, &[], &[]));
        assert_eq!(ledger.open(), 1, "message 2, which has not departed");
        assert_eq!(close(ledger).0.total(), 2, "message 1 is not accounted for");
    }
}
