use std::collections::BTreeMap;

use realo_operator::{Counter, Describe, Error, Inputs, Operator, Outputs, Settings};
use realo_schemas::{Boxes, Header, Name, Nanos};
use serde::{Deserialize, Serialize};

use crate::{Limits, Noise, Order, Outcome, Tracks};

/// Settings of [`Tracker`].
#[derive(Clone, Debug, PartialEq, Settings, Serialize, Deserialize)]
pub struct Settings {
    /// Standard deviation of a box's centre, m; boxes that have a covariance use that.
    #[setting(default = 0.2, range = 0.01..=10.0)]
    pub position_noise_m: f64,
    /// Standard deviation of a long box's heading, degrees.
    #[setting(default = 3.0, range = 0.1..=90.0)]
    pub heading_noise_deg: f64,
    /// Whether velocities that a detector gives are measurements; false: they are dropped, and boxes' ways alone count.
    #[setting(default = true)]
    pub detector_velocities: bool,
    /// Standard deviation of a velocity that a detector gives a box, m/s.
    #[setting(default = 0.5, range = 0.01..=100.0)]
    pub velocity_noise_mps: f64,
    /// Standard deviation of the speed of long objects before anything is known of it, m/s; short ones have a quarter.
    #[setting(default = 8.0, range = 0.1..=100.0)]
    pub speed_mps: f64,
    /// Standard deviation of what the velocity of long objects changes within 1 s, m/s; short ones have a quarter.
    #[setting(default = 1.5, range = 0.01..=100.0)]
    pub acceleration_mps: f64,
    /// Standard deviation of what a turn rate changes within 1 s, degrees/s.
    #[setting(default = 15.0, range = 0.1..=360.0)]
    pub turn_deg_s: f64,
    /// Track and box are a pair up to so many standard deviations.
    #[setting(default = 3.5, range = 1.0..=20.0)]
    pub gate: f64,
    /// Track and box are a pair up to this distance on the ground, m.
    #[setting(default = 4.0, range = 0.1..=100.0)]
    pub max_distance_m: f64,
    /// Sweeps in which a track was seen before its velocity is given.
    #[setting(default = 3, range = 2..=100)]
    pub min_hits: u32,
    /// Whether centres of boxes are then those of their tracks, which err less; false: they stay as they were detected.
    #[setting(default = true)]
    pub filter_centers: bool,
    /// Tracks that are not seen for longer end, ms.
    #[setting(default = 600, range = 1..=60_000)]
    pub max_gap_ms: u32,
    /// Tracks that are not seen for up to this time are given as boxes where they should be, ms; 0: boxes are seen or not there.
    #[setting(range = 0..=60_000)]
    pub coast_ms: u32,
    /// Tracks of an agent at the same time, and boxes of a message that may have one, the best.
    #[setting(default = 512, range = 1..=2048)]
    pub max_tracks: usize,
    /// Agents that are tracked at the same time; the one that was silent longest makes room.
    #[setting(default = 256, range = 1..=100_000)]
    pub max_agents: usize,
}

/// Tracks would end while they coast.
#[derive(Debug, thiserror::Error)]
#[error("setting `coast_ms`: expected up to `max_gap_ms` = {gap}, found {coast}")]
pub struct CoastError {
    gap: u32,
    coast: u32,
}

/// Gives the boxes of each agent velocities and identities (constant speed and turn rate, Kalman filter in `map`).
#[derive(Describe)]
#[stage(counters(
    TRACKED_BOXES,
    BEGUN_TRACKS,
    UNTRACKED_BOXES,
    COASTED_BOXES,
    GAPS,
    REPEATED_STAMPS,
    LATE_STAMPS,
    RESTARTS,
    UNPLACED_MESSAGES,
    FORGOTTEN_AGENTS
))]
pub struct Tracker {
    limits: Limits,
    detector_velocities: bool,
    max_agents: usize,
    agents: BTreeMap<Name, Stream>,
    /// Messages so far.
    messages: u64,
}

/// The tracks of one agent, and the number of its last message.
#[derive(Default)]
struct Stream {
    tracks: Tracks,
    last: u64,
}

const TRACKED_BOXES: Counter = Counter::plain("tracked_boxes", "boxes that were paired with a track");
const BEGUN_TRACKS: Counter = Counter::plain("begun_tracks", "tracks that began with a box");
const UNTRACKED_BOXES: Counter = Counter::loss(
    "untracked_boxes",
    "boxes that passed without a track: of numbers that no object has, or beyond the best `max_tracks`",
    "boxes passed {node} without identity and velocity, because no object can have such numbers, or they are beyond the best \
     `max_tracks`",
    "`--set {node}.max_tracks=…`, or leave out what is not sure before {node}",
);
const COASTED_BOXES: Counter = Counter::plain("coasted_boxes", "boxes of tracks that were not seen (`coast_ms`)");
const GAPS: Counter = Counter::plain(
    "gaps",
    "messages later than tracks live (`max_gap_ms`): all of the agent's have ended",
);
const REPEATED_STAMPS: Counter = Counter::loss(
    "repeated_stamps",
    "messages with the stamp of the one before: passed as they are",
    "messages of boxes had the stamp of the one before, and passed {node} as they are",
    "a clock that stands still, or a sweep that comes twice: look at the agent's stamps",
);
const LATE_STAMPS: Counter = Counter::loss(
    "late_stamps",
    "messages with an earlier stamp than the one before: passed as they are",
    "messages of boxes had an earlier stamp than the one before, and passed {node} as they are",
    "a clock that runs backwards, or messages out of order: look at the agent's stamps",
);
const RESTARTS: Counter = Counter::loss(
    "restarts",
    "messages so much earlier than the one before that tracking began anew",
    "messages of boxes had a stamp so much earlier than the one before that {node} began anew",
    "a clock was set back: look at the agent's stamps",
);
const UNPLACED_MESSAGES: Counter = Counter::loss(
    "unplaced_messages",
    "messages without a pose in `map`: passed as they are",
    "messages of boxes have no pose, and passed {node} without identities and velocities",
    "put {node} behind `localization`",
);
const FORGOTTEN_AGENTS: Counter = Counter::loss(
    "forgotten_agents",
    "agents that made room for another: beyond `max_agents`",
    "agents were forgotten by {node}, because more than `max_agents` send",
    "`--set {node}.max_agents=…`",
);

/// What comes in.
#[derive(Debug, Inputs)]
pub enum Input {
    /// Detections of a sweep, without duplicates, with the pose of their frame.
    #[port(latest)]
    Boxes(Header, Boxes),
}

/// What it sends.
#[derive(Debug, Outputs)]
pub enum Output {
    /// The same boxes, with identities, and with the velocities and centres of their tracks where those are known.
    Tracked(Header, Boxes),
}

/// Milliseconds as nanoseconds.
fn nanos(millis: u32) -> Nanos {
    Nanos::from(millis) * 1_000_000
}

impl Operator for Tracker {
    fn build(settings: Settings) -> Result<Self, Error> {
        let (gap, coast) = (settings.max_gap_ms, settings.coast_ms);
        if coast > gap {
            return Err(CoastError { gap, coast }.into());
        }
        Ok(Tracker {
            limits: Limits {
                noise: Noise {
                    position_m: settings.position_noise_m,
                    heading_rad: settings.heading_noise_deg.to_radians(),
                    velocity_mps: settings.velocity_noise_mps,
                    speed_mps: settings.speed_mps,
                    acceleration_mps: settings.acceleration_mps,
                    turn_rps: settings.turn_deg_s.to_radians(),
                },
                gate: settings.gate,
                max_distance_m: settings.max_distance_m,
                min_hits: settings.min_hits,
                filter_centers: settings.filter_centers,
                max_gap: nanos(gap),
                coast: nanos(coast),
                max_tracks: settings.max_tracks,
            },
            detector_velocities: settings.detector_velocities,
            max_agents: settings.max_agents,
            agents: BTreeMap::new(),
            messages: 0,
        })
    }

    fn on_input(&mut self, input: Input, out: &mut Outputs<Output>) -> Result<(), Error> {
        let Input::Boxes(header, Boxes(mut boxes)) = input;
        let agent = header.agent.clone();
        let is_placed = header.pose.is_some();
        out.count_of(&UNPLACED_MESSAGES, &agent, u64::from(!is_placed), 1);
        if let Some(pose) = &header.pose {
            if !self.detector_velocities {
                boxes.iter_mut().for_each(|object| object.velocity = None);
            }
            let limits = self.limits;
            let stream = self.stream(&agent, out);
            let outcome = stream.follow(header.stamp, &pose.map_from_frame, &mut boxes, &limits)?;
            count(&agent, boxes.len() as u64, &outcome, out);
            boxes.extend(outcome.coasted);
        }
        out.send(Output::Tracked(header, Boxes(boxes)));
        Ok(())
    }
}

impl Tracker {
    /// The tracks of an agent; of a new one too many, the agent that was silent longest is forgotten.
    fn stream(&mut self, agent: &Name, out: &mut Outputs<Output>) -> &mut Tracks {
        self.messages += 1;
        if !self.agents.contains_key(agent) && self.agents.len() >= self.max_agents {
            let silent = self.agents.iter().min_by_key(|(_, stream)| stream.last);
            if let Some(silent) = silent.map(|(name, _)| name.clone()) {
                self.agents.remove(&silent);
                out.count(&FORGOTTEN_AGENTS, &silent, 1);
            }
        }
        let stream = self.agents.entry(agent.clone()).or_default();
        stream.last = self.messages;
        &mut stream.tracks
    }
}

fn count(agent: &str, boxes: u64, outcome: &Outcome, out: &mut Outputs<Output>) {
    let is = |order| u64::from(outcome.order == order);
    out.count(&TRACKED_BOXES, agent, outcome.paired);
    out.count(&BEGUN_TRACKS, agent, outcome.begun);
    out.count_of(&UNTRACKED_BOXES, agent, outcome.untracked, boxes);
    out.count(&COASTED_BOXES, agent, outcome.coasted.len() as u64);
    out.count(&GAPS, agent, is(Order::Gap));
    out.count_of(&REPEATED_STAMPS, agent, is(Order::Repeated), 1);
    out.count_of(&LATE_STAMPS, agent, is(Order::Late), 1);
    out.count_of(&RESTARTS, agent, is(Order::Restart), 1);
}

#[cfg(test)]
mod tests;
