//! Books of links, edges and nodes.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::Fates;

/// What crossed one link, of one kind.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct LinkBooks {
    /// Messages that entered the channel.
    pub sent: u64,
    /// Their bytes.
    pub bytes: u64,
    /// Messages that the channel lost.
    pub lost: u64,
    /// Extra copies that the channel made; no messages.
    pub duplicated: u64,
    /// Messages that the range gate kept out; not part of `sent`.
    pub out_of_range: u64,
    /// What became of the others, where a fusion of the ego takes them.
    #[serde(flatten, default, skip_serializing_if = "Option::is_none")]
    pub accounted: Option<Accounted>,
}

/// The terms that, with `lost`, make up `sent`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Accounted {
    /// By what became of them.
    #[serde(flatten)]
    pub fates: Fates,
    /// `sent` - `lost` - the terms: 0, unless dora lost messages or reports between stages.
    pub unaccounted: i64,
}

impl LinkBooks {
    /// Adds what another run says of the same channel; it is accounted for only if both are.
    pub fn add(&mut self, other: &LinkBooks) {
        self.sent += other.sent;
        self.bytes += other.bytes;
        self.lost += other.lost;
        self.duplicated += other.duplicated;
        self.out_of_range += other.out_of_range;
        self.accounted = self.accounted.zip(other.accounted).map(|(mut sum, other)| {
            sum.fates.add(&other.fates);
            sum.unaccounted += other.unaccounted;
            sum
        });
    }
}

/// What dora did to messages between nodes; apart from the links' books.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Transport {
    /// By `<node>.<input>`: inputs to which something happened.
    pub edges: BTreeMap<String, EdgeBooks>,
    /// Messages that were not delivered, of all inputs.
    pub total_lost: u64,
}

/// What dora did on one edge.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct EdgeBooks {
    /// Not delivered, or too late to be put in order.
    pub lost: u64,
    /// Delivered more than once.
    pub repeated: u64,
    /// Delivered out of order, and put in order again.
    pub reordered: u64,
}

impl Transport {
    /// Adds what happened on an edge.
    pub fn add(&mut self, edge: &str, books: &EdgeBooks) {
        if *books == EdgeBooks::default() {
            return;
        }
        let sum = self.edges.entry(edge.into()).or_default();
        sum.lost += books.lost;
        sum.repeated += books.repeated;
        sum.reordered += books.reordered;
        self.total_lost += books.lost;
    }
}
