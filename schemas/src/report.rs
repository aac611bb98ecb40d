//! What stages say of messages that cross a link, and documents as JSON in a [`crate::Report`].

use serde::{Deserialize, Serialize};

use crate::{Header, Kind, Name, Nanos, Report};

/// What became of a message that crossed a link. The first that fits is the message's fate, so that joining what several
/// stages say of it is a minimum.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Fate {
    /// In at least one fusion that took place.
    Used,
    /// Passed over by a busy stage, or only in Selections that were.
    Skipped,
    /// Only in fusions that took no more collaborators.
    OverLimit,
    /// Older than the window when asked for.
    Stale,
    /// A newer one of its sender took its place, or it came older than what was held.
    Superseded,
    /// The channel dropped it.
    Lost,
    /// A stage or a fusion could not take it.
    Rejected,
    /// Never asked for, after the last query.
    InFlight,
}

impl Fate {
    /// All, in the order in which they are tried.
    pub const ALL: [Fate; 8] = [
        Fate::Used,
        Fate::Skipped,
        Fate::OverLimit,
        Fate::Stale,
        Fate::Superseded,
        Fate::Lost,
        Fate::Rejected,
        Fate::InFlight,
    ];
}

/// One message to one receiver, as accounting names it.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub struct Crossing {
    /// Its sender.
    pub from: String,
    /// Its receiver.
    pub to: String,
    /// Its kind.
    pub kind: Kind,
    /// Its number, per sender and kind.
    pub seq: u64,
}

impl Crossing {
    /// The message of a header; `None` for one that crossed no link.
    pub fn of(header: &Header) -> Option<Self> {
        Some(Crossing {
            from: header.agent.to_string(),
            to: header.to.as_ref()?.to_string(),
            kind: header.kind,
            seq: header.seq,
        })
    }
}

/// A fusion in which a message took part.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Use {
    /// Number of the ego's message.
    pub query: u64,
    /// From the message's stamp to when the ego's message was ready, ns; offline it may be negative.
    pub age_ns: Nanos,
}

/// What a stage said of a message.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Fated {
    /// The message.
    #[serde(flatten)]
    pub message: Crossing,
    /// What became of it.
    pub fate: Fate,
    /// Of [`Fate::Used`], the fusion.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub r#use: Option<Use>,
}

/// What one channel carried.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Channel {
    /// Sender.
    pub from: String,
    /// Receiver.
    pub to: String,
    /// What was sent.
    pub kind: Kind,
    /// What crossed.
    #[serde(flatten)]
    pub traffic: Traffic,
}

/// Messages and bytes of one channel.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Traffic {
    /// Messages that entered the channel.
    pub sent: u64,
    /// Their payload bytes.
    pub bytes: u64,
    /// Extra copies that the channel delivered.
    pub duplicated: u64,
    /// Messages that were not sent because the receiver was out of range.
    pub out_of_range: u64,
}

impl Traffic {
    /// Adds the traffic of other books.
    pub fn add(&mut self, other: &Traffic) {
        self.sent += other.sent;
        self.bytes += other.bytes;
        self.duplicated += other.duplicated;
        self.out_of_range += other.out_of_range;
    }
}

/// A report of a document.
pub fn to_report<T: Serialize>(topic: &str, document: &T) -> Report {
    let json = serde_json::to_string(document).expect("report documents have text keys only");
    Report {
        topic: Name::from(topic),
        json,
    }
}

/// The document of a report.
///
/// # Errors
/// What JSON says against it, with the topic.
pub fn from_report<'a, T: Deserialize<'a>>(report: &'a Report) -> Result<T, String> {
    serde_json::from_str(&report.json).map_err(|error| format!("report `{}`: {error}", report.topic))
}
