use std::collections::BTreeMap;

use realo_operator::{Counter, Describe, Error, Inputs, Operator, Outputs, Settings};
use realo_schemas::{AgentState, Header, Kind, Motion, Name, Nanos, PointCloud, Pose};
use realo_time_offset::{Sensor, StampFault, StampRule};
use serde::{Deserialize, Serialize};

use crate::agent_track::Unposed;
use crate::clocks::{AgentClocks, ClockRules, fault_words};
use crate::{AgentTrack, Cleaned, OwnBody, Pairing, clean};

const NANOS_PER_MILLI: Nanos = 1_000_000;

/// A stamp may lie so far after its message's arrival, ns; more would block the agent's stream until then.
const AHEAD: Nanos = 1_000_000_000;

/// A pose that is due is awaited so long, ns: it and a sweep that exist at the same time may overtake each other.
const OVERTAKING: Nanos = 2_000_000;

const NAN_POINTS: Counter = Counter::plain("nan_points", "points left out: not finite");
const OWN_BODY_POINTS: Counter = Counter::plain("own_body_points", "points left out: on the agent's own body");
const DUPLICATE: Counter = Counter::log_fault(
    "duplicate",
    "sweeps dropped: of the last one's stamp",
    "sweeps were dropped, because they have the stamp of the one before",
    "the log has sweeps twice (a recording that was looped or merged with itself?): leave one of each",
);
const OUT_OF_ORDER: Counter = Counter::log_fault(
    "out_of_order",
    "sweeps dropped: older than the last one",
    "sweeps were dropped, because their stamps are older than that of the one before",
    "stamps must rise: write the log in their order, or look whether it was looped",
);
const NO_POSE: Counter = Counter::log_fault(
    "no_pose",
    "sweeps dropped: their pose never became known",
    "sweeps were dropped, because no pose was known at their stamps",
    "poses must be at most `max_gap_ms` apart and span the sweeps: record them at 10 Hz or more, or bridge longer gaps with \
     `--set {node}.max_gap_ms=…`",
);
const LATE_POSE: Counter = Counter::loss(
    "late_pose",
    "sweeps dropped: their pose came, but later than `patience_ms`",
    "sweeps were dropped, because their poses came too late",
    "`--set {node}.patience_ms=…` waits longer; in realtime `--rate 0.5` gives a busy machine more time",
);
const NOT_DESKEWED: Counter = Counter::loss(
    "not_deskewed",
    "sweeps passed on although the motion during them is not known",
    "sweeps keep the distortion by the agent's motion, because no poses are known before and after them",
    "write poses at 10 Hz or more, from before the first sweep to after the last",
);
const CLOCK_STEPS: Counter = Counter::loss(
    "clock_steps",
    "steps of 0.2 s or more of the clocks that stamp sweeps and poses",
    "times a clock stepped by 0.2 s or more, or messages began to arrive later by as much",
    "set the clock before the run, and slowly during it; `--stamps rebase` gives stamps as if it had not stepped",
);
const STAMPS_REBASED: Counter = Counter::loss(
    "stamps_rebased",
    "sweeps and poses that got another stamp (`stamps=rebase`)",
    "sweeps and poses got other stamps, because the clock that gave theirs steps or counts something else",
    "set the sensor's clock; `--stamps drop` leaves them out",
);
const STAMPS_LEFT_OUT: Counter = Counter::loss(
    "stamps_left_out",
    "sweeps and poses dropped for their stamps (`stamps=drop` or `rebase`)",
    "sweeps and poses were left out, because their stamps are wrong",
    "set the sensor's clock; `--stamps rebase` gives stamps by their arrival, where a clock steps or counts something else",
);

/// Settings of sync.
#[derive(Clone, Debug, PartialEq, Settings, Serialize, Deserialize)]
pub struct Settings {
    /// Own body as x min, x max, y min, y max in the body frame, m, for all agents alike (`footprint` of the log is not used here); [] for
    /// none.
    #[setting(default = [OwnBody::V2X_REAL.x, OwnBody::V2X_REAL.y].concat())]
    pub own_body: Vec<f32>,
    /// Whether the agent's motion within a sweep is removed.
    #[setting(default = true)]
    pub deskew: bool,
    /// How long a sweep waits for its pose, ms.
    #[setting(default = 100, range = 0..=3_600_000)]
    pub patience_ms: u32,
    /// Longest time between or beyond poses that is bridged, ms.
    #[setting(default = 150, range = 0..=3_600_000)]
    pub max_gap_ms: u32,
    /// Messages whose stamps step, repeat, run backwards, stand still, count from boot, or are TAI, GPS time or 1,024 weeks off:
    /// `drop_far` refuses stamps more than 1 s ahead and takes all others as they are, `drop` leaves them out, `rebase` gives stamps
    /// by their arrival, `trust` takes all as they are.
    #[setting(role = "stamps")]
    pub stamps: StampRule,
    /// Least time from a sweep's last point to its arrival, ms: from, to. An offset of the clock is known no better.
    #[setting(default = vec![0.0, 200.0])]
    pub lidar_delay_ms: Vec<f64>,
    /// Least time from a sample of the inertial unit to its arrival, ms: from, to.
    #[setting(default = vec![0.0, 4.0])]
    pub imu_delay_ms: Vec<f64>,
}

/// What sync cannot take.
#[derive(Debug, thiserror::Error)]
pub enum SyncError {
    /// A pose that is not one.
    #[error("expected a finite pose with a quaternion of length 1, found {0}")]
    Pose(String),
    /// A clock that is ahead, s.
    #[error("the stamp lies {0:.3} s after the arrival, at most 1 s is allowed; the agent's clock is wrong")]
    Ahead(f64),
    /// An outline that is not one.
    #[error("setting `own_body`: expected x min, x max, y min, y max in metres, or [], found {0:?}")]
    OwnBody(Vec<f32>),
    /// Delays that are none.
    #[error(
        "setting `{0}`: expected the smallest and the largest least delay in ms, such as [0, 4], each 0 to 10,000, found {1:?}"
    )]
    Delay(&'static str, Vec<f64>),
}

/// Orders sweeps, pairs them with poses, removes the agent's own motion and body from them.
#[derive(Describe)]
#[stage(counters(
    NAN_POINTS,
    OWN_BODY_POINTS,
    DUPLICATE,
    OUT_OF_ORDER,
    NO_POSE,
    LATE_POSE,
    NOT_DESKEWED,
    CLOCK_STEPS,
    STAMPS_REBASED,
    STAMPS_LEFT_OUT
))]
pub struct Sync {
    settings: SweepRules,
    stamps: StampRule,
    rules: ClockRules,
    tracks: BTreeMap<Name, AgentTrack>,
    clocks: BTreeMap<Name, AgentClocks>,
}

#[derive(Clone, Copy)]
struct SweepRules {
    own_body: Option<OwnBody>,
    deskew: bool,
    patience: Nanos,
    max_gap: Nanos,
}

/// What comes in.
#[derive(Debug, Inputs)]
pub enum Input {
    /// Poses of the agents, at any rate.
    #[port(state)]
    Poses(Header, AgentState),
    /// Raw sweeps.
    #[port(latest)]
    Clouds(Header, PointCloud),
    /// What motion sensors measured: the clock of the inertial unit is compared with that of the poses.
    #[port(optional)]
    Motion(Header, Motion),
}

/// What it sends.
#[derive(Debug, Outputs)]
pub enum Output {
    /// Sweeps in the body frame at their stamp, with its pose.
    Sweeps(Header, PointCloud),
    /// Pose and motion at each sweep's stamp.
    States(Header, AgentState),
}

impl Sync {
    /// The clocks of an agent.
    fn clocks(&mut self, agent: &Name) -> &mut AgentClocks {
        let rules = self.rules;
        self.clocks
            .entry(agent.clone())
            .or_insert_with(|| AgentClocks::new(rules))
    }

    /// The stamp that a message goes on with; `None` for one that is left out, which is counted.
    fn stamp(&mut self, sensor: Sensor, header: &Header, lasts: Nanos, out: &mut Outputs<Output>) -> Option<Nanos> {
        let (agent, stamp, arrival) = (&header.agent, header.stamp, header.ready);
        let watched = self.clocks(agent).take(sensor, stamp, lasts, arrival);
        let is = |wrong: bool| u64::from(wrong);
        let words = || fault_words(sensor, &watched, stamp, arrival);
        // Steps are no share of the messages.
        for (counter, wrong, of) in [
            (&CLOCK_STEPS, watched.fault == Some(StampFault::Jump), 0),
            (&STAMPS_REBASED, watched.stamp.is_some_and(|right| right != stamp), 1),
            (&STAMPS_LEFT_OUT, watched.stamp.is_none(), 1),
        ] {
            out.count_of(counter, agent, is(wrong), of);
            if wrong {
                out.found(counter, agent, words);
            }
        }
        watched.stamp
    }

    /// Refuses a stamp that would block the agent's stream, unless all are to be trusted.
    fn not_ahead(&self, header: &Header, now: Nanos) -> Result<(), SyncError> {
        let ahead = header.stamp.saturating_sub(now);
        if ahead > AHEAD && self.stamps != StampRule::Trust {
            return Err(SyncError::Ahead(realo_schemas::to_seconds(ahead)));
        }
        Ok(())
    }

    fn pose(&mut self, mut header: Header, state: AgentState, out: &mut Outputs<Output>) -> Result<(), SyncError> {
        let t = &state.map_from_body.translation.vector;
        let q = state.map_from_body.rotation.quaternion();
        if !(t.iter().all(|v| v.is_finite()) && (q.norm() - 1.0).abs() < 1e-6) {
            return Err(SyncError::Pose(format!("{t:?} and {q:?}")));
        }
        let Some(stamp) = self.stamp(Sensor::Poses, &header, 0, out) else {
            return Ok(());
        };
        self.clocks(&header.agent).turn_of_pose(header.stamp, &state);
        header.stamp = stamp;
        self.not_ahead(&header, out.now())?;
        let max_gap = self.settings.max_gap;
        let track = self
            .tracks
            .entry(header.agent.clone())
            .or_insert_with(|| AgentTrack::new(max_gap));
        track.insert(header.stamp, state);
        settle(&header.agent, track.settled(), track.has_true_poses(), out);
        self.settings.release(track, out, false);
        Ok(())
    }

    fn cloud(&mut self, mut header: Header, cloud: PointCloud, out: &mut Outputs<Output>) -> Result<(), SyncError> {
        let lasts = span(&cloud).map_or(0, |[_, last]| Nanos::from(last).max(0));
        let Some(stamp) = self.stamp(Sensor::Lidar, &header, lasts, out) else {
            return Ok(());
        };
        header.stamp = stamp;
        self.not_ahead(&header, out.now())?;
        let max_gap = self.settings.max_gap;
        let track = self
            .tracks
            .entry(header.agent.clone())
            .or_insert_with(|| AgentTrack::new(max_gap));
        let newest = track.newest.unwrap_or(Nanos::MIN);
        let is = |wrong: bool| u64::from(wrong);
        out.count_of(&DUPLICATE, &header.agent, is(header.stamp == newest), 1);
        out.count_of(&OUT_OF_ORDER, &header.agent, is(header.stamp < newest), 1);
        if header.stamp <= newest {
            return Ok(());
        }
        track.newest = Some(header.stamp);
        let (now, agent) = (out.now(), header.agent.clone());
        if let Some((header, _)) = track.wait(now, header, cloud) {
            track.give_up(header.stamp);
        }
        settle(&agent, track.settled(), track.has_true_poses(), out);
        self.settings.release(track, out, false);
        if !track.waiting.is_empty() {
            out.wake_at(now.saturating_add(OVERTAKING));
            out.wake_at(now.saturating_add(self.settings.patience));
        }
        Ok(())
    }
}

impl SweepRules {
    /// Sends an agent's sweeps that can go on, oldest first; none overtakes another.
    fn release(self, track: &mut AgentTrack, out: &mut Outputs<Output>, at_end: bool) {
        while let Some((came, header, cloud)) = track.waiting.front() {
            let waited = out.now().saturating_sub(*came);
            let gives_up = at_end || waited >= self.patience;
            let last = span(cloud).map_or(0, |[_, last]| Nanos::from(last));
            let may_be_overtaken = !gives_up && waited < OVERTAKING;
            if may_be_overtaken && track.misses_pose(header.stamp.saturating_add(last), *came) {
                break;
            }
            let pairing = track.pair(header.stamp, span(cloud), self.deskew, gives_up);
            if pairing.is_none() && !gives_up {
                break;
            }
            let Some((_, header, cloud)) = track.waiting.pop_front() else {
                break;
            };
            match pairing {
                None => track.give_up(header.stamp),
                Some(pairing) => {
                    count_pose(&header.agent, [0, 0], out);
                    self.send(header, &cloud, pairing, out);
                }
            }
        }
    }

    fn send(self, header: Header, cloud: &PointCloud, pairing: Pairing, out: &mut Outputs<Output>) {
        let Pairing { state, motion } = pairing;
        let agent = header.agent.clone();
        out.count_of(&NOT_DESKEWED, &agent, u64::from(self.deskew && motion.is_none()), 1);
        let Cleaned { cloud, nan, own_body } = clean(cloud, self.own_body, motion.as_ref());
        out.count(&NAN_POINTS, &agent, nan);
        out.count(&OWN_BODY_POINTS, &agent, own_body);
        let pose = Pose {
            map_from_frame: state.map_from_body,
            covariance: state.covariance.clone(),
        };
        let header = Header {
            pose: Some(pose),
            ..header
        };
        let state_header = Header {
            kind: Kind::AgentState,
            ..header.clone()
        };
        out.send(Output::States(state_header, state));
        out.send(Output::Sweeps(header, cloud));
    }
}

/// Counts sweeps that were given up: only what comes later says whether the log has no pose of them, or it was late.
fn settle(agent: &Name, sweeps: Vec<Unposed>, by_truth: bool, out: &mut Outputs<Output>) {
    for sweep in sweeps {
        let late = u64::from(sweep.is_late);
        count_pose(agent, [1 - late, late], out);
        if !sweep.is_late {
            let of = if by_truth {
                "; these are the poses of `pose_truth`"
            } else {
                ""
            };
            out.found(&NO_POSE, agent, || sweep.lack + of);
        }
    }
}

/// Counts one sweep whose pose is missing, late or neither.
fn count_pose(agent: &Name, [missing, late]: [u64; 2], out: &mut Outputs<Output>) {
    out.count_of(&NO_POSE, agent, missing, 1);
    out.count_of(&LATE_POSE, agent, late, 1);
}

/// A range of least delays, ms.
fn delay(name: &'static str, setting: &[f64]) -> Result<[f64; 2], SyncError> {
    match *setting {
        [from, to] if from >= 0.0 && from <= to && to <= 1e4 => Ok([from, to]),
        _ => Err(SyncError::Delay(name, setting.into())),
    }
}

/// Min and max time of a sweep's points, ns from its stamp.
fn span(cloud: &PointCloud) -> Option<[i32; 2]> {
    let [first, last] = cloud
        .time
        .iter()
        .fold([i32::MAX, i32::MIN], |[lo, hi], t| [lo.min(*t), hi.max(*t)]);
    (first <= last).then_some([first, last])
}

impl Operator for Sync {
    fn build(settings: Settings) -> Result<Self, Error> {
        let own_body = match settings.own_body[..] {
            [] => None,
            [x0, x1, y0, y1] if x0 <= x1 && y0 <= y1 => Some(OwnBody {
                x: [x0, x1],
                y: [y0, y1],
            }),
            _ => return Err(SyncError::OwnBody(settings.own_body).into()),
        };
        let nanos = |millis: u32| Nanos::from(millis) * NANOS_PER_MILLI;
        let (patience, max_gap) = (nanos(settings.patience_ms), nanos(settings.max_gap_ms));
        let rules = ClockRules {
            handling: settings.stamps.handling(),
            lidar_delay: delay("lidar_delay_ms", &settings.lidar_delay_ms)?,
            imu_delay: delay("imu_delay_ms", &settings.imu_delay_ms)?,
        };
        let stamps = settings.stamps;
        let settings = SweepRules {
            own_body,
            deskew: settings.deskew,
            patience,
            max_gap,
        };
        Ok(Sync {
            settings,
            stamps,
            rules,
            tracks: BTreeMap::new(),
            clocks: BTreeMap::new(),
        })
    }

    fn on_input(&mut self, input: Input, out: &mut Outputs<Output>) -> Result<(), Error> {
        match input {
            Input::Poses(header, state) => self.pose(header, state, out)?,
            Input::Clouds(header, cloud) => self.cloud(header, cloud, out)?,
            Input::Motion(header, motion) => self.clocks(&header.agent).take_motion(&header, &motion),
        }
        Ok(())
    }

    fn on_wake(&mut self, _now: Nanos, out: &mut Outputs<Output>) -> Result<(), Error> {
        self.tracks
            .values_mut()
            .for_each(|track| self.settings.release(track, out, false));
        Ok(())
    }

    fn on_end(&mut self, out: &mut Outputs<Output>) -> Result<(), Error> {
        for (agent, track) in &mut self.tracks {
            self.settings.release(track, out, true);
            settle(agent, track.unposed(), track.has_true_poses(), out);
        }
        for (agent, clocks) in &mut self.clocks {
            clocks.report(agent).into_iter().for_each(|clock| out.clock(clock));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests;
