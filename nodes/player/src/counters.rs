//! What the player counts.

use std::sync::{Arc, Mutex, MutexGuard};

use realo_operator::{Counter, Counts};
use realo_schemas::report::SensorClock;

/// What was counted, for the thread that reads ahead and for who asks.
#[derive(Clone, Default)]
pub struct Counters(Arc<Mutex<Counts>>);

impl Counters {
    /// Adds `n` of `of` things of an agent; see [`Counts::add`].
    pub fn add(&self, counter: &'static Counter, agent: &str, n: u64, of: u64) {
        self.lock().add(counter, agent, n, of);
    }

    /// Adds what was lost of an agent, and says what was found of the first.
    pub fn lost(&self, counter: &'static Counter, agent: &str, n: u64, of: u64, found: impl FnOnce() -> String) {
        let mut counts = self.lock();
        counts.add(counter, agent, n, of);
        if n > 0 {
            counts.found(counter, agent, found);
        }
    }

    /// Says what is known of a sensor's clock.
    pub fn clock(&self, clock: SensorClock) {
        self.lock().clocks.push(clock);
    }

    /// What was lost of an agent so far.
    pub fn of(&self, counter: &'static Counter, agent: &str) -> u64 {
        let counts = self.lock();
        let known = counts.losses.get(counter.name).and_then(|loss| loss.agents.get(agent));
        known.map_or(0, |share| share.count)
    }

    /// Adds one message of an agent to several counters at once, and what is wrong with it by the first that says so.
    pub fn judged<const N: usize>(
        &self,
        agent: &str,
        wrong: [(&'static Counter, bool); N],
        found: impl FnOnce() -> String,
    ) {
        let mut counts = self.lock();
        for (counter, is_wrong) in wrong {
            counts.add(counter, agent, u64::from(is_wrong), 1);
        }
        if let Some((counter, _)) = wrong.iter().find(|(_, is_wrong)| *is_wrong) {
            counts.found(counter, agent, found);
        }
    }

    /// All so far.
    pub fn get(&self) -> Counts {
        self.lock().clone()
    }

    fn lock(&self) -> MutexGuard<'_, Counts> {
        self.0.lock().unwrap_or_else(|poisoned| poisoned.into_inner())
    }
}

/// All of them.
pub const ALL: &[Counter] = &[
    LOG_TRUNCATED,
    RUNS_ALONE,
    UNDECLARED,
    POSES_UNUSABLE,
    WRONG_COVARIANCES,
    POSES_JUMP,
    MOTION_UNUSABLE,
    NO_POSE,
    TRANSFORMS_DIFFER,
    LEVELLED,
    TILTED_POSES,
    CLOCK_OFF,
    CLOCK_AHEAD,
    STAMPS_REBASED,
    STAMPS_LEFT_OUT,
    STAMPS_DIFFER,
    NO_COMMON_TIME,
    SWEEPS_MISSING,
    SWEEPS_OF_ONE_TOPIC,
    POSES_HELD,
    DETECTIONS_WITHOUT_SWEEP,
    DETECTIONS_WITHOUT_INFO,
    DETECTION_HEADINGS,
    TRUTH_HEADINGS,
    TRUTH_WITHOUT_SWEEP,
    TRUTH_WITHOUT_INFO,
    TRUTH_NOT_JOINED,
    INVALID_TRUTH,
    INTENSITIES_LIMITED,
    SWEEPS_WITHOUT_DETECTIONS,
    TRACKS_DIFFER,
    TRACKS_SPLIT,
    TRACKS_DOUBLED,
    TRUTH_DOUBLED,
    TRUTH_SHIFTED,
    TRUTH_PARTIAL,
    TOO_FAR,
];

// Results know these by their names, and have the notes.
pub const LOG_TRUNCATED: Counter = Counter::plain(
    "log_truncated",
    "1 if the log is cut; summed over pooled runs, while `logs_cut` names each log once",
);
pub const RUNS_ALONE: Counter = Counter::plain("runs_alone", "1 if no agent of the log may collaborate with the ego");

pub const UNDECLARED: Counter = Counter::log_fault(
    "undeclared",
    "messages of agents that have poses and sweeps in the log, while its record does not name them; not played",
    realo_logs::UNDECLARED[0],
    realo_logs::UNDECLARED[1],
);
pub const LEVELLED: Counter = Counter::loss(
    "levelled",
    "sweeps of agents whose body frames tilt, [levelled while played](log-format.md#level-frames)",
    "sweeps were levelled while played, by the poses of the log",
    "`realo-lab import log` makes a level copy",
);
pub const NO_POSE: Counter = Counter::log_fault(
    "no_pose",
    "sweeps not sent: their points are in another frame than the body, and no transform on `/tf` is near enough to bring them there",
    "sweeps were left out, because no transform brings their points to the body frame at their stamps",
    "write transforms on /tf at 10 Hz or more, from before the first sweep to after the last, or points in the body frame",
);
pub const POSES_UNUSABLE: Counter = Counter::log_fault(
    "poses_unusable",
    "poses of the log in another frame than the map's, with numbers that are not finite or a quaternion that is not of length 1; \
     not sent",
    "poses of the log cannot be used and were left out",
    "`realo info` says how many of which topic",
);
pub const WRONG_COVARIANCES: Counter = Counter::log_fault(
    "wrong_covariances",
    "poses of the log played with an unknown covariance, because theirs has a number that is not finite, above 10¹², or a variance \
     below 0",
    "poses have a covariance that cannot be right, and were played as if it were unknown",
    realo_logs::WRONG_COVARIANCES[1],
);
pub const POSES_JUMP: Counter = Counter::log_fault(
    "poses_jump",
    "poses more than 5 m from the pose before, reached at more than 150 m/s",
    "poses jump faster than any vehicle drives, so that sweeps near them are misplaced",
    "leave out poses without a fix, and smooth the others",
);
pub const MOTION_UNUSABLE: Counter = Counter::loss(
    "motion_unusable",
    "measurements of IMUs, receivers and wheels in a frame that nothing places, with numbers that no sensor gives, or on the Earth \
     while the log does not say where its [map](log-format.md#motion) is; not sent",
    realo_logs::MOTION_UNUSABLE[0],
    realo_logs::MOTION_UNUSABLE[1],
);
pub const TRANSFORMS_DIFFER: Counter = Counter::log_fault(
    "transforms_differ",
    "sweeps with points in the map's frame that a transform on `/tf` brought to the body, more than 0.5 m or 2° off the agent's pose",
    realo_logs::TRANSFORMS_DIFFER[0],
    realo_logs::TRANSFORMS_DIFFER[1],
);
pub const TILTED_POSES: Counter = Counter::loss(
    "tilted_poses",
    "poses that were played although they tilt by more than 0.25°: beside precomputed packets, or of agents that the log says are \
     not to be levelled",
    "poses are not level and were played as they are, beside precomputed packets or since the log says that it is not to be \
     levelled",
    "networks look for the ground at z = 0 (docs/reference/log-format.md, \"Level frames\")",
);
pub const CLOCK_OFF: Counter = Counter::log_fault(
    "clock_off",
    "messages left out: their [stamps](log-format.md#clocks) are of another clock than the log times",
    "messages were left out, because their stamps are of another clock than that of the log",
    "set the sensor's clock to the recorder's, or take that difference from the stamps when the log is written \
     (docs/reference/log-format.md, \"Clocks\")",
);
pub const STAMPS_REBASED: Counter = Counter::loss(
    "stamps_rebased",
    "messages that got another stamp, because the clock that gave theirs steps or counts something else (`stamps=rebase`)",
    "messages got other stamps, because the clock that gave theirs steps or counts something else than the log's times",
    "set the sensor's clock; `--stamps drop` leaves them out",
);
pub const STAMPS_LEFT_OUT: Counter = Counter::loss(
    "stamps_left_out",
    "messages not sent, because their stamps repeat, run backwards, stand still, are early, or with `stamps=drop` follow a step of the \
     clock",
    "messages were left out, because their stamps are wrong and nothing is to say what is right",
    "look at the program that gives the stamps; `--stamps rebase` leaves out only what nothing can date",
);
pub const CLOCK_AHEAD: Counter = Counter::log_fault(
    "clock_ahead",
    "messages played although their stamps are 50 ms to 1 s later than their [log times](log-format.md#clocks)",
    "messages were played although their stamps are later than the times at which they were logged",
    "no message is logged before it is measured, so the agent's clock is ahead of the recorder's: set it, or take that difference \
     from the stamps when the log is written (docs/reference/log-format.md, \"Clocks\")",
);
pub const STAMPS_DIFFER: Counter = Counter::log_fault(
    "stamps_differ",
    "messages whose publish time is not the stamp of their header, which counts",
    "messages have a publish time that is not the stamp of their header, which was used",
    "write the stamp as both (docs/reference/log-format.md, \"Frames, units, times\")",
);
pub const NO_COMMON_TIME: Counter = Counter::log_fault(
    "no_common_time",
    "sweeps of a collaborator that has no sweep while the ego has some",
    "sweeps have no time in common with those of the ego, so that none of them can be fused",
    "record the agents at the same time; if they were, the clock of one is off: move its stamps and log times when the log is \
     written",
);
pub const SWEEPS_MISSING: Counter = Counter::log_fault(
    "sweeps_missing",
    "sweeps that there would be at an agent's rate where it has none while others have some or its own poses go on: gaps of more \
     than 0.5 s and five periods, before its first and after its last",
    realo_logs::SWEEPS_MISSING[0],
    realo_logs::SWEEPS_MISSING[1],
);
pub const SWEEPS_OF_ONE_TOPIC: Counter = Counter::log_fault(
    "sweeps_of_one_topic",
    "sweeps that one of the topics `points` and `sweeps` of an agent has and the other has not",
    realo_logs::SWEEPS_OF_TWO_TOPICS[0],
    realo_logs::SWEEPS_OF_TWO_TOPICS[1],
);
pub const POSES_HELD: Counter = Counter::plain(
    "poses_held",
    "poses sent of [roadside units that do not move](log-format.md#poses), in the place of those of the log, which do not reach \
     all sweeps",
);
pub const DETECTIONS_WITHOUT_INFO: Counter = Counter::log_fault(
    "detections_without_info",
    "recorded detections whose companion (`detections_info`) has another stamp, played without it",
    "messages of recorded detections were played without velocities and covariances, because no message of `detections_info` has \
     their stamp",
    "write the `detections` and the `detections_info` of a sweep with the same stamp",
);
pub const DETECTION_HEADINGS: Counter = Counter::log_fault(
    "detection_headings",
    "recorded detections whose `yaw` in `detections_info` is more than 0.02 rad off their quaternion, or beyond ±4π; the `yaw` counts",
    "recorded detections have another heading by the `yaw` of their companion than by their quaternion, or a `yaw` beyond ±4π, and the \
     `yaw` was used",
    realo_logs::WRONG_HEADINGS[1],
);
pub const TRUTH_HEADINGS: Counter = Counter::log_fault(
    "truth_headings",
    "the same of ground truth and own labels",
    "objects of the ground truth have another heading by the `yaw` of their companion than by their quaternion, or a `yaw` beyond ±4π, \
     and the `yaw` was used",
    realo_logs::WRONG_HEADINGS[1],
);
pub const TRUTH_WITHOUT_SWEEP: Counter = Counter::log_fault(
    "truth_without_sweep",
    "messages of the ego's ground truth or own labels whose stamp is that of no sweep, beside sweeps that have none",
    "messages of ground truth were left out, because no sweep or no companion has their stamp",
    "truth and its `_info` need the stamp of the sweep that they label; `realo info` says how far off they are",
);
pub const TRUTH_WITHOUT_INFO: Counter = Counter::log_fault(
    "truth_without_info",
    "messages of ground truth or own labels, and of their `_info`, whose counterpart with the same stamp is missing",
    "messages of ground truth or own labels were left out, because the message or its `_info` with the same stamp is missing",
    "write both of each sweep, with one stamp",
);
pub const TRUTH_NOT_JOINED: Counter = Counter::log_fault(
    "truth_not_joined",
    "sweeps of the ego that were scored without the points that a collaborator has on objects, because its truth lies near none of \
     them although it has sweeps there, or because it has none at all; where these are more than 2 and more than 2 % of all",
    "sweeps of the ego were scored without the truth of {agent}, which has none near them: objects that {agent} alone sees are not \
     counted, and detections of them count as wrong",
    "write its truth for each of its sweeps, with stamps of the ego's clock; `realo info` says how far off they are",
);
pub const INVALID_TRUTH: Counter = Counter::log_fault(
    "invalid_truth",
    "boxes of the ego's ground truth and own labels that are not scored: not finite, without extent or above 100 m, more than 10 km \
     away, or with a score outside [0, 1]",
    "objects of the ground truth were not scored, because no object can have such numbers",
    realo_schemas::plausible_box!("correct the program that wrote them"),
);
pub const DETECTIONS_WITHOUT_SWEEP: Counter = Counter::log_fault(
    "detections_without_sweep",
    "recorded detections whose stamp is that of no sweep; not sent",
    "messages of recorded detections were left out, because no sweep has their stamp",
    "detections need the stamp of the sweep that they were made from; `realo info` says how far off they are",
);
pub const INTENSITIES_LIMITED: Counter = Counter::loss(
    "intensities_limited",
    "intensities of points that did not fit after [scaling](log-format.md#messages) and were limited to 0…255",
    "intensities of points did not fit and were limited to 0…255",
    "`realo info` says how they are scaled, by the first ten sweeps: write them as bytes",
);
pub const SWEEPS_WITHOUT_DETECTIONS: Counter = Counter::log_fault(
    "sweeps_without_detections",
    "sweeps without recorded detections, of an agent that has some",
    realo_logs::SWEEPS_WITHOUT_DETECTIONS[0],
    realo_logs::SWEEPS_WITHOUT_DETECTIONS[1],
);
pub const TRACKS_DIFFER: Counter = Counter::log_fault(
    "tracks_differ",
    "positions of [tracks](log-format.md#tracks) that two agents both have, more than 5 m apart; of tracks of which most are, where \
     these are more than 2 % of all",
    "positions of tracks that both agents have are more than 5 m apart, so that points of one agent count for wrong objects of the other",
    "tracks of {agent} name different objects: give an object the same track in the truth of all agents, and no other object that \
     track",
);
pub const TRACKS_SPLIT: Counter = Counter::log_fault(
    "tracks_split",
    "positions at which two agents both have an object, within 1 m, with two [tracks](log-format.md#tracks) or none, where these are \
     more than 2 % of all",
    "objects that both have are of two tracks or of none, so that points of collaborators do not count for them",
    "give an object the same track in the truth of all agents",
);
pub const TRACKS_DOUBLED: Counter = Counter::log_fault(
    "tracks_doubled",
    "objects of ground truth that have the [track](log-format.md#tracks) of another one of the same message, where these are more \
     than 2 % of all",
    "objects of the ground truth have the track of another one of the same message, so that points count for the wrong objects",
    "give each object a track of its own, or none",
);
pub const TRUTH_DOUBLED: Counter = Counter::log_fault(
    "truth_doubled",
    "objects of ground truth that lie within 0.2 m of another one of their class of the same message, where these are more than 2 % \
     of all",
    "objects of the ground truth are there twice at the same place, so that one of two detections counts as missing",
    "write each object once",
);
pub const TRUTH_SHIFTED: Counter = Counter::log_fault(
    "truth_shifted",
    "positions at which two agents both have a parked object, by [track](log-format.md#tracks), more than 1 m apart by the poses of the \
     two; where the median of all parked objects is",
    realo_logs::TRUTH_SHIFTED[0],
    realo_logs::TRUTH_SHIFTED[1],
);
pub const TRUTH_PARTIAL: Counter = Counter::log_fault(
    "truth_partial",
    "objects that a collaborator's truth has up to 50 m ahead of the ego and 30 m beside, and the ego's truth has not, where these are \
     more than 2 % of all; not where the ego's labels have views",
    "objects ahead of the ego are in the truth of others alone, so that whoever finds them by cooperation is counted as wrong",
    "the ego's truth must have all objects around it, those too that it does not see (docs/reference/log-format.md)",
);
pub const TOO_FAR: Counter = Counter::loss(
    "too_far",
    "sweeps of collaborators that were not played, because the fusion takes fewer agents (`fused_at_most`) and others were nearer to the \
     ego",
    "sweeps were not computed and do not count as sent, because the fusion takes fewer agents and others were nearer to the ego",
    "`--set {node}.fused_at_most=null` computes them too",
);
