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
    /// More reports about its messages than an agent can have.
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
    UNSENT_BOXES,
    OVERSIZED_FRAMES,
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
    "frames, questions, sheets of books and packets that cannot be read",
    "frames were refused, because they cannot be read as frames of a realo radio",
    "both machines need the same version of realo, and keys (`{node}.key`, `{node}.trust`) on both or on neither",
);
const OVERSIZED: Counter = Counter::loss(
    "oversized",
    "messages of peers above `max_bytes`",
    "messages were refused, because they have more bytes than `{node}.max_bytes` here",
    "`--set {node}.max_bytes=…` takes larger ones",
);
pub(crate) const UNSENT_BOXES: Counter = Counter::loss(
    "unsent_boxes",
    "messages of boxes or states that were not sent, because they are above 127 KiB",
    "messages were not sent, because the boxes of one sweep take more than 127 KiB",
    "send fewer boxes in a message: raise the min score or lower the max boxes of the stages before {node}",
);
pub(crate) const OVERSIZED_FRAMES: Counter = Counter::loss(
    "oversized_frames",
    "frames above 128 KiB, which Zenoh drops, so that nobody knows whose they were",
    "frames were dropped, because they have more than 128 KiB, which no realo radio sends",
    "look which other program publishes on `{node}.site`, and choose another site",
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
    "messages of peers whose time is more than 10 s away from the time here",
    "messages were refused, because their sender's time is more than 10 s away from the time here",
    "synchronise the machines' clocks; on a machine that plays a log set `player.clock=wall`",
);
pub(crate) const OVERRUN: Counter = Counter::loss(
    "overrun",
    "messages that came while too many waited",
    "messages were dropped, because too many waited",
    "the machine does not keep up: play slower (`--rate`), or have fewer peers",
);
const FLOOD: Counter = Counter::loss(
    "flood",
    "reports of peers about more messages than an agent can have",
    "reports about messages were refused, because their sender reports on more messages than an agent can have",
    "no realo radio does that: take that agent's key out of `{node}.trust`, and look what runs there",
);
pub(crate) const NO_CLOCK: Counter = Counter::loss(
    "no_clock",
    "messages that waited for their sender's time to become known until newer ones came; they count as superseded",
    "messages were not used, because the difference between their sender's clock and the clock here did not become known in time",
    "the radios measure it by questions and answers: look whether messages pass in both directions, and give keys (`{node}.key`, \
     `{node}.trust`) to both machines or to neither",
);
/// Results have the note.
pub(crate) const ALONE: Counter = Counter::plain("alone", "1 where no message of another agent came");

/// How often each happened.
pub type Refusals = BTreeMap<Refusal, u64>;
