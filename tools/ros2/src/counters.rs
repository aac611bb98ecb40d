//! What is counted of what comes in; a loss makes a note in the results of the run.

use realo_operator::Counter;

/// All of them.
pub const ALL: &[Counter] = &[
    CLOUDS,
    POSES,
    LOST,
    OVERRUN,
    UNREADABLE,
    STAMPS_ZERO,
    STAMPS_OFF,
    STAMPS_BACK,
    NO_POSE,
    NO_WAY,
    SILENT,
    WITHOUT_TIMES,
    INTENSITIES_LIMITED,
];

pub const CLOUDS: Counter = Counter::plain("clouds", "clouds that were taken");
pub const POSES: Counter = Counter::plain("poses", "poses that were taken");
pub const LOST: Counter = Counter::loss(
    "lost",
    "messages that their publishers numbered and that did not arrive",
    "messages were lost between the publisher and `{node}`",
    "`reliability=reliable` has them sent again, if the publisher is reliable too; `sysctl -w net.core.rmem_max=16777216` gives bursts room",
);
pub const OVERRUN: Counter = Counter::loss(
    "overrun",
    "messages that arrived and were dropped, because newer ones came before they were taken",
    "messages were dropped at `{node}`, because the graph did not take them in time",
    "`realo doctor` says whether this machine keeps up",
);
pub const UNREADABLE: Counter = Counter::loss(
    "unreadable",
    "messages whose bytes are not what their type says, or whose fields do not fit",
    "messages could not be read",
    "look at the fields of the cloud: x, y and z are needed",
);
pub const STAMPS_ZERO: Counter = Counter::loss(
    "stamps_zero",
    "messages left out, because their stamp is 0",
    "messages have a stamp of 0 and were left out",
    "let the driver write stamps, or write `clock: log` in the map file to take the time of arrival",
);
pub const STAMPS_OFF: Counter = Counter::loss(
    "stamps_off",
    "messages left out, because their stamps are of another clock than this machine's: more than 1 s later or 2 s earlier than their arrival",
    "messages were left out, because their stamps are of another clock than this machine's",
    "set the sensor's clock (PTP, NTP), add `offset: SECONDS` to the agent in the map file, or write `clock: log` there to take the time of arrival",
);
pub const STAMPS_BACK: Counter = Counter::loss(
    "stamps_back",
    "messages left out, because their stamp is not later than the one before",
    "messages have a stamp that is not later than the one before, and were left out",
    "look whether two programs publish the topic",
);
pub const NO_POSE: Counter = Counter::loss(
    "no_pose",
    "clouds left out, because no pose is within a second, so that nothing says which way is up",
    "clouds were left out, because there was no pose near their stamps",
    "poses must come as long as clouds do; `realo-ros2 topics` lists what is published",
)
.quiet_up_to(2);
pub const NO_WAY: Counter = Counter::loss(
    "no_way",
    "messages left out, because no transform leads from their frame to the agent's or the world's",
    "messages were left out, because no transform leads where they belong",
    "publish the transform on /tf or /tf_static, or write `mounts` or another `world` in the map file",
)
.quiet_up_to(2);
pub const SILENT: Counter = Counter::loss(
    "silent",
    "times that a topic had no message for `silent_s`",
    "times nothing came on a topic for long",
    "`realo-ros2 topics` lists what is published",
);
pub const WITHOUT_TIMES: Counter = Counter::plain(
    "without_times",
    "clouds without a field of times: motion during their sweeps is not removed",
);
pub const INTENSITIES_LIMITED: Counter =
    Counter::plain("intensities_limited", "points whose intensity was limited to 0 to 255");
