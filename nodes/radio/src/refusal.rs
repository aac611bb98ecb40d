//! Why something that came in was not taken, and what else the radio counts.

use std::collections::BTreeMap;

use realo_operator::Counter;

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

    /// What it is counted by.
    pub fn counter(self) -> &'static Counter {
        match self {
            Refusal::Malformed => &MALFORMED,
            Refusal::Oversized => &OVERSIZED,
            Refusal::Stranger => &STRANGERS,
            Refusal::Unsigned => &UNSIGNED,
            Refusal::Forged => &FORGED,
            Refusal::Replayed => &REPLAYED,
            Refusal::Future => &FUTURE,
            Refusal::OtherTimeLine => &OTHER_TIME_LINE,
            Refusal::Flood => &FLOOD,
        }
    }

    /// The counter's name.
    pub fn as_str(self) -> &'static str {
        self.counter().name
    }
}

/// All counters of the radio.
pub(crate) const COUNTERS: &[Counter] = &[
    MALFORMED,
    OVERSIZED,
    STRANGERS,
    UNSIGNED,
    FORGED,
    REPLAYED,
    FUTURE,
    OTHER_TIME_LINE,
    OVERRUN,
    FLOOD,
    NO_CLOCK,
    ALONE,
];

const MALFORMED: Counter = Counter::loss(
    "malformed",
    "frames, questions, sheets of books and packets that are none",
    "frames were refused, because they are none of this radio's",
    "both machines need the same version of realo, and keys (`{node}.key`, `{node}.trust`) on both or on neither",
);
pub(crate) const OVERSIZED: Counter = Counter::loss(
    "oversized",
    "messages above `max_bytes`; boxes of one sweep above 127 KiB, which are not sent; frames above 128 KiB, which Zenoh drops, so \
     that nobody knows whose they were",
    "messages did not cross, because they have more bytes than `{node}.max_bytes`, are boxes of more than 127 KiB, or came in frames \
     of more than 128 KiB",
    "`--set {node}.max_bytes=…` where they are received; fewer boxes in a message; frames so large are of no realo radio",
);
const STRANGERS: Counter = Counter::loss(
    "strangers",
    "frames of agents that are not trusted, and of more than 64 peers",
    "frames were refused, because their sender is not trusted, or is one more than the 64 that may be known",
    "`realo keys trust` adds an agent's key to `{node}.trust`",
);
const UNSIGNED: Counter = Counter::loss(
    "unsigned",
    "frames without a signature where it is asked for",
    "frames were refused, because they are not signed and keys are asked for here",
    "give that agent a key (`realo keys new`, `{node}.key` there), and trust it here (`realo keys trust`)",
);
const FORGED: Counter = Counter::loss(
    "forged",
    "frames with a signature that does not fit them, their sender or their receiver",
    "frames were refused, because their signature is not by the key that is trusted under their sender's name",
    "if it is the right machine, trust the key that it has now (`realo keys trust`); if not, somebody else uses its name",
);
const REPLAYED: Counter = Counter::loss(
    "replayed",
    "frames that were signed more than 10 s ago, or of an earlier start of their sender",
    "frames were refused, because they were signed more than 10 s ago, or before their sender's newest start",
    "synchronise the machines' clocks, and look whether two machines have one name",
);
const FUTURE: Counter = Counter::loss(
    "future",
    "frames that were signed more than 10 s in the future; messages of what is measured more than 1 s from now",
    "frames or messages were refused, because they are from the future: signed 10 s, or measured 1 s from now",
    "synchronise the machines' clocks",
);
const OTHER_TIME_LINE: Counter = Counter::loss(
    "other_time_line",
    "messages of peers whose time is more than 10 s off",
    "messages were refused, because their sender's time is more than 10 s off",
    "synchronise the machines' clocks; whoever plays a log needs `player.clock=wall`",
);
pub(crate) const OVERRUN: Counter = Counter::loss(
    "overrun",
    "messages that came while too many waited",
    "messages were dropped, because too many waited",
    "the machine does not keep up: play slower (`--rate`), or have fewer peers",
);
const FLOOD: Counter = Counter::loss(
    "flood",
    "words of peers about more messages than an agent has",
    "words about messages were refused, because no agent has so many",
    "do not trust that agent: it is not a realo radio, or lies",
);
pub(crate) const NO_CLOCK: Counter = Counter::loss(
    "no_clock",
    "messages that waited for their sender's time to become known until newer ones came; they count as superseded",
    "messages were not used, because their sender's time did not become known",
    "questions about the time must be answered: keys (`{node}.key`, `{node}.trust`) on both machines or on neither",
);
/// Results have the note.
pub(crate) const ALONE: Counter = Counter::plain("alone", "1 where no message of another agent came");

/// How often each happened.
pub type Refusals = BTreeMap<Refusal, u64>;
