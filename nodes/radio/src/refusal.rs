//! Why something that came in was not taken.

use std::collections::BTreeMap;

/// Why a frame was not taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Refusal {
    /// No frame, question, answer or sheet.
    Malformed,
    /// More bytes than any frame, or a message of more bytes than are taken.
    Oversized,
    /// An agent that is not trusted, or one more than there may be.
    Stranger,
    /// Not signed, though signatures are asked for.
    Unsigned,
    /// The signature is not its sender's, or of something else.
    Forged,
    /// Signed too long ago, or of an earlier start of its sender: it was sent before, or two agents have one name.
    Replayed,
    /// Signed, or measured, in the future.
    Future,
    /// Of a time line that has nothing to do with this agent's.
    OtherTimeLine,
    /// More words about its messages than an agent has.
    Flood,
}

impl Refusal {
    /// All.
    pub const ALL: [Refusal; 9] = [
        Refusal::Malformed,
        Refusal::Oversized,
        Refusal::Stranger,
        Refusal::Unsigned,
        Refusal::Forged,
        Refusal::Replayed,
        Refusal::Future,
        Refusal::OtherTimeLine,
        Refusal::Flood,
    ];

    /// The counter's name.
    pub fn as_str(self) -> &'static str {
        match self {
            Refusal::Malformed => "malformed",
            Refusal::Oversized => "oversized",
            Refusal::Stranger => "strangers",
            Refusal::Unsigned => "unsigned",
            Refusal::Forged => "forged",
            Refusal::Replayed => "replayed",
            Refusal::Future => "future",
            Refusal::OtherTimeLine => "other_time_line",
            Refusal::Flood => "flood",
        }
    }
}

/// How often each happened.
pub type Refusals = BTreeMap<Refusal, u64>;
