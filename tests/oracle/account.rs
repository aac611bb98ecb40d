//! What both sides must agree on.

use std::collections::BTreeMap;

use realo_schemas::Nanos;

use crate::world::Said;

/// A message of an agent.
pub type Id = (String, u64);

pub fn id(said: &Said) -> Id {
    (said.agent.clone(), said.seq)
}

/// How often something happened that only some worlds reach.
pub type Reached = BTreeMap<&'static str, u64>;

/// Adds what happened, or did not.
pub fn add(reached: &mut Reached, what: &'static str, happened: bool) {
    *reached.entry(what).or_default() += u64::from(happened);
}

/// A Selection.
#[derive(Clone, Debug, PartialEq)]
pub struct Answer {
    /// The ego's message that asked.
    pub query: u64,
    /// When the Selection was there.
    pub ready: Nanos,
    /// What it holds, and how old that was for the query.
    pub entries: Vec<(Id, Nanos)>,
}

/// A place in the ego's frame, m; equal to another if they agree to 5 mm, for f32 cross.
#[derive(Clone, Copy, Debug)]
pub struct Place(pub [f64; 2]);

impl PartialEq for Place {
    fn eq(&self, other: &Self) -> bool {
        let away = |axis: usize| (self.0[axis] - other.0[axis]).abs();
        away(0) < 5e-3 && away(1) < 5e-3
    }
}

/// A fusion that took place.
#[derive(Clone, Debug, PartialEq)]
pub struct Fusion {
    /// The ego's message.
    pub query: u64,
    /// When its outcome was there.
    pub ready: Nanos,
    /// Where its boxes or points are.
    pub content: Vec<Place>,
    /// What took part, and how old that was for the query.
    pub used: Vec<(Id, Nanos)>,
}

/// The books of one channel.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
#[allow(missing_docs)]
pub struct Line {
    /// Whether a stage says what becomes of its messages; if none does, all terms but `lost` are 0.
    pub accounted: bool,
    pub out_of_range: u64,
    pub sent: u64,
    pub bytes: u64,
    pub duplicated: u64,
    pub used: u64,
    pub skipped: u64,
    pub over_limit: u64,
    pub distrusted: u64,
    pub stale: u64,
    pub superseded: u64,
    pub lost: u64,
    pub rejected: u64,
    pub in_flight: u64,
}

impl Line {
    /// The terms of which each message has one.
    pub fn terms(&self) -> [(&'static str, u64); 9] {
        [
            ("used", self.used),
            ("skipped", self.skipped),
            ("over_limit", self.over_limit),
            ("distrusted", self.distrusted),
            ("stale", self.stale),
            ("superseded", self.superseded),
            ("lost", self.lost),
            ("rejected", self.rejected),
            ("in_flight", self.in_flight),
        ]
    }
}

/// One run.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Account {
    /// In the order in which they were given.
    pub selections: Vec<Answer>,
    /// In the order in which they took place.
    pub fusions: Vec<Fusion>,
    /// By `<from>-<to>.<kind>`.
    pub channels: BTreeMap<String, Line>,
    /// Sweeps that the encoder did not send, because it did not know where the ego is.
    pub no_ego_state: u64,
    /// Sweeps that the encoder could not take.
    pub errors: u64,
    /// Messages that a stage skipped because it was busy, and parts of sets that were discarded.
    pub skipped: BTreeMap<String, u64>,
}

impl Account {
    /// The first difference to what the oracle says.
    pub fn difference(&self, oracle: &Account) -> Option<String> {
        first("Selection", &self.selections, &oracle.selections)
            .or_else(|| first("fusion", &self.fusions, &oracle.fusions))
            .or_else(|| differing("stage", &self.skipped, &oracle.skipped))
            .or_else(|| first("no_ego_state", &[self.no_ego_state], &[oracle.no_ego_state]))
            .or_else(|| first("errors", &[self.errors], &[oracle.errors]))
            .or_else(|| differing("channel", &self.channels, &oracle.channels))
    }
}

fn first<T: std::fmt::Debug + PartialEq>(what: &str, driver: &[T], oracle: &[T]) -> Option<String> {
    let at = (0..driver.len().max(oracle.len())).find(|at| driver.get(*at) != oracle.get(*at))?;
    let (driver, oracle) = (driver.get(at), oracle.get(at));
    Some(format!("{what} number {at}:\n  driver {driver:?}\n  oracle {oracle:?}"))
}

fn differing<T: std::fmt::Debug + PartialEq>(
    what: &str,
    driver: &BTreeMap<String, T>,
    oracle: &BTreeMap<String, T>,
) -> Option<String> {
    let name = driver
        .keys()
        .chain(oracle.keys())
        .find(|name| driver.get(*name) != oracle.get(*name))?;
    let (driver, oracle) = (driver.get(name), oracle.get(name));
    Some(format!("{what} {name}:\n  driver {driver:?}\n  oracle {oracle:?}"))
}
