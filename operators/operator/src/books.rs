use std::collections::{BTreeMap, BTreeSet};

use hdrhistogram::Histogram;
use realo_schemas::report::{Channel, Fate, SensorClock};
use realo_schemas::{Kind, Message, Nanos};
use serde::{Deserialize, Serialize};

use crate::counter::newest;
use crate::{Counts, Loss};

/// What the nodes of a graph counted; travels in `end` and meets in the sinks.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Books {
    /// By node id.
    pub nodes: BTreeMap<String, NodeBooks>,
}

impl Books {
    /// Takes over the nodes that are not known yet.
    pub fn merge(&mut self, other: &Books) {
        for (id, node) in &other.nodes {
            self.nodes.entry(id.clone()).or_insert_with(|| node.clone());
        }
    }
}

/// What one node counted.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct NodeBooks {
    /// Operator or node name.
    pub name: String,
    /// By input port.
    pub inputs: BTreeMap<String, InputBooks>,
    /// By output port: messages sent.
    pub outputs: BTreeMap<String, Tally>,
    /// The operator's own counters, e.g. `nan_points`.
    pub counters: BTreeMap<String, u64>,
    /// More about those of them that are losses, and about losses that have not happened.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub losses: BTreeMap<String, Loss>,
    /// What it knows of the clocks of agents' sensors.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub clocks: Vec<SensorClock>,
    /// What fates mean at this node.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub explained: BTreeMap<Fate, String>,
    /// Calls that failed: by a message or a set of them that the operator could not take, by a wake, or by the end of the
    /// stream.
    pub errors: u64,
    /// Failed calls by a wake or by the end of the stream; part of `errors`.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub other_errors: u64,
    /// The first error: its place and why.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub first_error: Option<String>,
    /// Time that its calls took, ns, by what triggered them (an input's name or `wake`; ` > OUTPUTS` follows for calls
    /// that sent something): measured in realtime, the profile's in virtual time.
    pub compute: BTreeMap<String, Durations>,
    /// Time that steps of its calls took, ns, by name; measured in realtime only.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub steps: BTreeMap<String, Durations>,
    /// Of a source in realtime: how late it released its messages, ns.
    pub late: Durations,
    /// What crossed the channels of a link.
    pub channels: Vec<Channel>,
}

fn is_zero(number: &u64) -> bool {
    *number == 0
}

impl NodeBooks {
    /// Takes over what was counted.
    pub fn count(&mut self, counts: Counts) {
        for (counter, n) in counts.counters {
            let count = self.counters.entry(counter.into_owned()).or_default();
            *count = count.saturating_add(n);
        }
        for (counter, loss) in counts.losses {
            self.losses.entry(counter.into_owned()).or_default().add(&loss);
        }
        newest(&mut self.clocks, counts.clocks);
    }

    /// Counts what a channel carried.
    pub fn carried(&mut self, channel: Channel) {
        let same =
            |known: &&mut Channel| (&known.from, &known.to, known.kind) == (&channel.from, &channel.to, channel.kind);
        match self.channels.iter_mut().find(same) {
            Some(known) => known.traffic.add(&channel.traffic),
            None => self.channels.push(channel),
        }
    }
}

/// What one input counted.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct InputBooks {
    /// Messages that reached the stage.
    pub received: Tally,
    /// Messages skipped because the stage was busy.
    pub skipped: Tally,
    /// Parts of incomplete sets that were discarded.
    pub unjoined: Tally,
    /// Messages that dora did not deliver, or delivered too late to be put in order.
    pub transport_lost: u64,
    /// Messages that dora delivered more than once.
    pub transport_repeated: u64,
    /// Messages that dora delivered out of order and that were put in order again.
    pub transport_reordered: u64,
    /// Whether the stage says what becomes of the messages that come here over a link, and of which kinds.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub accounts: Vec<Kind>,
    /// Of such an input, the receivers of what came over a link.
    #[serde(default, skip_serializing_if = "BTreeSet::is_empty")]
    pub receivers: BTreeSet<String>,
}

/// Messages per agent and kind.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Tally(pub BTreeMap<String, BTreeMap<Kind, u64>>);

impl Tally {
    /// Counts a message.
    pub fn add(&mut self, message: &Message) {
        let kinds = match self.0.get_mut(&*message.header.agent) {
            Some(kinds) => kinds,
            None => self.0.entry(message.header.agent.to_string()).or_default(),
        };
        *kinds.entry(message.header.kind).or_default() += 1;
    }

    /// Messages in all.
    pub fn total(&self) -> u64 {
        self.0.values().flat_map(|kinds| kinds.values()).sum()
    }
}

/// A distribution of durations, to three significant digits.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(from = "Vec<(u64, u64)>", into = "Vec<(u64, u64)>")]
pub struct Durations(Histogram<u64>);

/// A histogram without bounds takes every number.
const RESIZES: &str = "the histogram grows with what it records";

impl Default for Durations {
    fn default() -> Self {
        Durations(Histogram::new(3).expect("3 is a number of digits that the histogram knows"))
    }
}

impl From<Vec<(u64, u64)>> for Durations {
    fn from(counts: Vec<(u64, u64)>) -> Self {
        let mut durations = Durations::default();
        for (nanos, count) in counts {
            durations.0.record_n(nanos, count).expect(RESIZES);
        }
        durations
    }
}

impl From<Durations> for Vec<(u64, u64)> {
    fn from(durations: Durations) -> Self {
        durations
            .0
            .iter_recorded()
            .map(|v| (v.value_iterated_to(), v.count_at_value()))
            .collect()
    }
}

impl Durations {
    /// Adds a duration; a negative one counts as 0.
    pub fn record(&mut self, duration: Nanos) {
        self.0.record(duration.max(0) as u64).expect(RESIZES);
    }

    /// Number of durations.
    pub fn count(&self) -> u64 {
        self.0.len()
    }

    /// The duration that a share of all do not exceed, `None` without any.
    pub fn quantile(&self, share: f64) -> Option<Nanos> {
        (!self.0.is_empty()).then(|| self.0.value_at_quantile(share) as Nanos)
    }

    /// The largest duration.
    pub fn max(&self) -> Option<Nanos> {
        (!self.0.is_empty()).then(|| self.0.max() as Nanos)
    }

    /// Adds all durations of another distribution.
    pub fn merge(&mut self, other: &Durations) {
        self.0 += &other.0;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn durations_keep_three_digits_and_survive_their_sparse_form() {
        let mut durations = Durations::default();
        for nanos in [0, 1, 41_700_000, 97_000_000, 3_600_000_000_000, -5] {
            durations.record(nanos);
        }
        let close = |a: Nanos, b: f64| (a as f64 / b - 1.0).abs() < 1e-3;
        assert!(close(durations.quantile(0.6).unwrap(), 41_700_000.0));
        assert!(close(durations.max().unwrap(), 3.6e12));
        let back = Durations::from(Vec::from(durations.clone()));
        assert_eq!(back.quantile(0.6), durations.quantile(0.6));
        assert_eq!((back.count(), back.max()), (6, durations.max()));
        let mut sum = Durations::default();
        sum.merge(&durations);
        assert_eq!(sum.count(), 6);
    }
}
