//! What the guard counts.

use realo_operator::Counter;

pub(crate) const CORRECTED_MESSAGES: Counter = Counter::plain(
    "corrected_messages",
    "messages whose pose was corrected by objects that both see",
);
pub(crate) const CORRECTED_CLOCKS: Counter = Counter::plain(
    "corrected_clocks",
    "messages whose stamp was corrected, because what moves was not where it should be",
);
pub(crate) const PLACED_MESSAGES: Counter = Counter::plain(
    "placed_messages",
    "messages without a pose that were placed by objects that both see",
);
pub(crate) const FREE_BOXES: Counter = Counter::plain(
    "free_boxes",
    "boxes and points dropped, and boxes whose cells were dropped from a map: the ego sees free ground there",
);
pub(crate) const UNCHECKED_MESSAGES: Counter = Counter::plain(
    "unchecked_messages",
    "messages that passed as they are: without a pose, of a payload that the ego cannot compare with its own, or a map where there is no `model`, or of another one",
);
pub(crate) const CONTRADICTED_MESSAGES: Counter = Counter::loss(
    "contradicted_messages",
    "messages left out: more of what they say lies where the ego sees that nothing stands, or cannot be, than the ego can confirm",
    "messages were left out by {node}, because what they say lies where the ego sees that nothing stands, or cannot be",
    "look at the agent's pose, clock and detections; `--set {node}.enabled=false` fuses them all the same",
);
pub(crate) const UNCONFIRMED_MESSAGES: Counter = Counter::loss(
    "unconfirmed_messages",
    "messages left out: nothing of them can be confirmed, and earlier poses of their agent were wrong",
    "messages were left out by {node}, because the ego sees too little of what they say to correct their agent's poses, which were wrong before",
    "better poses of the agent; `--set {node}.enabled=false` fuses them all the same",
);
pub(crate) const DISTRUSTED_MESSAGES: Counter = Counter::loss(
    "distrusted_messages",
    "messages left out: their agent has contradicted the ego too often of late",
    "messages were left out by {node}, because their agent has said too often what the ego sees not to be so",
    "look at the agent's pose, clock and detections; `--set {node}.memory_s=…` forgets sooner",
);
pub(crate) const SCATTERED_MESSAGES: Counter = Counter::loss(
    "scattered_messages",
    "messages left out: their agent's boxes lie around the ego's, farther than two detectors differ (`place_noise_m`)",
    "messages were left out by {node}, because their agent's boxes lie around the ego's own, farther than two detectors differ",
    "look at the agent's detector; `--set {node}.place_noise_m=…` allows for more",
);
pub(crate) const IMPLAUSIBLE_BOXES: Counter = Counter::loss(
    "implausible_boxes",
    "boxes dropped: no object can have such numbers",
    "boxes were left out by {node}, because no object can have such numbers",
    realo_schemas::plausible_detection!("correct the agent that sends them"),
);
pub(crate) const EXCESS_BOXES: Counter = Counter::loss(
    "excess_boxes",
    "boxes dropped: beyond the best `max_boxes` of a message",
    "boxes were left out by {node}, because they are beyond the best `max_boxes` of a message",
    "`--set {node}.max_boxes=…`, or have the agent leave out what is not sure",
);
pub(crate) const WRONG_COVARIANCES: Counter = Counter::loss(
    "wrong_covariances",
    "messages whose pose has a covariance that is none: not finite, or with a variance below 0; taken as unknown",
    "messages say covariances of their poses that are none, which {node} takes as unknown",
    "covariances are finite, with variances of at least 0, in m² and rad²",
);
pub(crate) const FORGOTTEN_AGENTS: Counter = Counter::loss(
    "forgotten_agents",
    "agents that made room for another: beyond `max_agents`",
    "agents were forgotten by {node}, because more than `max_agents` send",
    "`--set {node}.max_agents=…`",
);
