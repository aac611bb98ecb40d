//! Documents that stages send to the `results` sink, as JSON in a [`crate::Report`].

use serde::{Deserialize, Serialize};

use crate::{Header, Kind, Name, Nanos, Report};

/// One message, as accounting names it.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub struct MessageId {
    /// Its sender.
    pub agent: String,
    /// Its kind.
    pub kind: Kind,
    /// Its number, per agent and kind.
    pub seq: u64,
}

impl MessageId {
    /// The message of a header.
    pub fn of(header: &Header) -> Self {
        MessageId {
            agent: header.agent.to_string(),
            kind: header.kind,
            seq: header.seq,
        }
    }
}

/// What the bank did at one query, or at the end.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct BankReport {
    /// `seq` of the query; `None` in the report that closes the bank's books.
    pub query: Option<u64>,
    /// The agent that asked.
    pub agent: String,
    /// Entries of the Selection.
    pub selected: Vec<Selected>,
    /// Messages that left the bank since the last report.
    pub departed: Vec<Departed>,
}

/// An entry of a Selection.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Selected {
    /// The message.
    #[serde(flatten)]
    pub message: MessageId,
    /// The query's ready minus the message's stamp, ns.
    pub age_ns: Nanos,
}

/// A message that left the bank.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Departed {
    /// The message.
    #[serde(flatten)]
    pub message: MessageId,
    /// Why it counts as it does, unless a fusion used it.
    pub fate: Fate,
}

/// How a message that no fusion used left the bank.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Fate {
    /// It was selected; whether a fusion used it the fusion's reports say.
    Unused,
    /// Older than the window when it was asked for.
    Stale,
    /// A newer one of its sender took its place, or it came older than what was held.
    Superseded,
    /// Of another payload than what it was to be fused with.
    Rejected,
    /// Still held, never asked for, after the last query.
    InFlight,
}

/// One fusion that took place.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct FusionReport {
    /// `seq` of the ego's message.
    pub query: u64,
    /// The ego.
    pub agent: String,
    /// Entries beyond the number that the fusion takes.
    pub over_limit: Vec<MessageId>,
    /// Entries that the fusion could not use: without pose, or of another payload.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub rejected: Vec<MessageId>,
}

/// What crossed a link.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct LinkReport {
    /// Every channel that carried or refused something, ordered by (from, to, kind).
    pub channels: Vec<Channel>,
}

/// One direction between two agents, one kind.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Channel {
    /// Sender.
    pub from: String,
    /// Receiver.
    pub to: String,
    /// Kind of the content.
    pub kind: Kind,
    /// Messages that entered the channel.
    pub sent: u64,
    /// Their bytes.
    pub bytes: u64,
    /// Messages that the channel lost.
    pub lost: u64,
    /// Extra copies that the channel made.
    pub duplicated: u64,
    /// Messages that the range gate kept out; not part of `sent`.
    pub out_of_range: u64,
}

/// A report as a payload.
pub fn to_report<T: Serialize>(topic: &str, document: &T) -> Report {
    let json = serde_json::to_string(document).expect("report documents have text keys only");
    Report {
        topic: Name::from(topic),
        json,
    }
}

/// Reads a report's document.
///
/// # Errors
/// Says which topic did not have the expected fields.
pub fn from_report<'a, T: Deserialize<'a>>(report: &'a Report) -> Result<T, String> {
    serde_json::from_str(&report.json).map_err(|error| format!("report `{}`: {error}", report.topic))
}
