//! Replays a log into both lanes of a graph: the ego's, and that of the agents that collaborate with it.
//!
//! Messages leave in order of their time on the log's line; at equal times poses go first, then motion, clouds, recorded
//! detections, packets, truth. What motion sensors measured goes with the next sweep of their agent, or 0.2 s later without one. A thread reads ahead, so that reading a cloud delays no release. A log that was cut is played
//! up to the cut and counted as `log_truncated`. Body frames that tilt are levelled by their poses
//! (`docs/reference/log-format.md`, "Level frames"); those that are level pass as they are. Messages whose stamps are of another clock than
//! the log's are left out and counted (`clock_off`). A roadside unit that does not move has its pose at all times.

mod ahead;
mod counters;
mod error;
mod feed;
mod joins;
mod nearest;
mod plan;
mod standing;
mod truth;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::thread;

use realo_logs::{Log, LogError, RebasedStream, Stream};
use realo_operator::{Counts, Describe, Error, NoInput, Outputs, Settings, Source};
use realo_schemas::{
    AgentState, Boxes, Clock, GroundTruth, Header, Kind, Motion, Name, Nanos, Packet, PointCloud, from_seconds,
};
use realo_time_offset::StampRule;
use rustix::process::{getpriority_process, setpriority_process};
use serde::{Deserialize, Serialize};

use ahead::{Taker, ahead};
use counters::{Counters, LOG_TRUNCATED, RUNS_ALONE, STAMPS_LEFT_OUT, STAMPS_REBASED};
pub use error::PlayerError;
pub use feed::sweeps_per_pass;
use feed::{Feed, Release, Script};
pub use plan::{Coop, PlanError, PlannedRun, PlannedRuns, plan};

/// By how much the priority (`nice`) of the thread that reads ahead is lower than that of the process.
const LOWER: i32 = 5;

/// With wall time, a pass over a log takes a multiple of this.
const SLOT: Nanos = 5_000_000_000;
/// With wall time, numbers of messages begin below this.
const NUMBERS: u64 = 1 << 31;
/// Between the first call and the first message on wall time at least: nodes find each other meanwhile.
pub const LEAD: Nanos = 4_000_000_000;

/// Of a point in memory.
const POINT_BYTES: usize = 20;

/// Which poses are sent.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum PoseSource {
    /// What the agents believed.
    #[default]
    Recorded,
    /// The true ones.
    True,
}

/// The line on which a log's times are played.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum TimeLine {
    /// The log's own.
    #[default]
    Log,
    /// Wall time: everybody who plays the log or a part of it, on any machine, is at the same place of it.
    Wall,
}

/// What to do about recorded detections.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Detections {
    /// Sent where the log has them.
    #[default]
    Optional,
    /// An agent without any is an error.
    Required,
    /// Not read.
    Off,
}

/// What to do about motion sensors.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum MotionSensors {
    /// Sent where the log has them.
    #[default]
    Optional,
    /// An agent without any is an error.
    Required,
    /// Not read.
    Off,
}

/// Settings of the player.
#[derive(Clone, Debug, PartialEq, Settings, Serialize, Deserialize)]
pub struct Settings {
    /// Path of the log.
    #[setting(default = "../target/realo/demo.mcap", role = "log", filled)]
    pub log: PathBuf,
    /// Name of the ego; empty: the first eligible agent.
    #[setting(role = "ego")]
    pub ego: String,
    /// The agent whose sensors alone are played, and which is the ego then; empty: those of all.
    #[setting(role = "own")]
    pub agent: String,
    /// Times of messages: `log`, the log's own, or `wall`, moved to wall time, at the same place of the log on all machines.
    #[setting(default = TimeLine::Log)]
    pub clock: TimeLine,
    /// With `clock=wall`, how much stamps are ahead of the wall clock: a clock that is off.
    #[setting(range = -1e7..=1e7)]
    pub skew_ms: f64,
    /// Who collaborates: `all`, `v2v`, `v2i` or `i2i`.
    #[setting(default = Coop::All, role = "coop")]
    pub coop: Coop,
    /// Who may take part; empty: all.
    #[setting(role = "agents")]
    pub agents: Vec<String>,
    /// Poses that are sent: `recorded` or `true`.
    #[setting(default = PoseSource::Recorded)]
    pub pose: PoseSource,
    /// Ready times are stamps, poses are exact where known.
    #[setting(role = "offline")]
    pub offline: bool,
    /// Whether sweeps have their points.
    #[setting(default = true, role = "points")]
    pub points: bool,
    /// Recorded detections: `optional`, `required` or `off`.
    #[setting(default = Detections::Optional, role = "detections")]
    pub detections: Detections,
    /// Messages whose stamps are wrong: `drop_far` leaves out what is seconds off, `drop` also what repeats, runs backwards, stands
    /// still or follows a step of the clock, `rebase` gives stamps by the log's times, `trust` plays all as they are.
    #[setting(role = "stamps")]
    pub stamps: StampRule,
    /// IMU, satellite receiver and wheels: `optional`, `required` or `off`.
    #[setting(default = MotionSensors::Optional)]
    pub motion: MotionSensors,
    /// Whether the log's packets of the collaborators are played, and their sweeps without points.
    #[setting(role = "precomputed")]
    pub precomputed: bool,
    /// Plays the sweeps of so many collaborators only, those nearest to the ego; null: of all; in virtual time over perfect links.
    pub fused_at_most: Option<usize>,
    /// Seconds of log time per second, in a realtime run.
    #[setting(default = 1.0, range = 0.0<..=1e6, role = "rate")]
    pub rate: f64,
    /// Passes over the log.
    #[setting(default = 1, range = 1..=1_000_000)]
    pub repeat: u32,
    /// Seconds that are left out at the log's beginning.
    #[setting(range = 0.0..=1e9)]
    pub start: f64,
    /// Seconds that are played; null: all.
    #[setting(range = 0.0<..=1e9)]
    pub duration: Option<f64>,
    /// Name of the run, in every header.
    #[setting(default = "run")]
    pub run: String,
}

/// What the log has next, `None` at its end.
type Next = Result<Option<Release>, LogError>;

/// Replays a log's sweeps, poses, recorded detections and ground truth.
#[derive(Describe)]
#[stage(input = NoInput, counters = counters::ALL, examine = check)]
pub struct Player {
    releases: Taker<Next>,
    ended: bool,
    counters: Counters,
    rate: f64,
    cast: PlannedRun,
    wall: Option<Wall>,
}

/// Where the passes over a log lie on wall time, which depends on nothing but the log.
#[derive(Clone, Copy, Debug)]
struct Slots {
    /// The first time of the log that is played.
    from: Nanos,
    /// From one pass to the next.
    slot: Nanos,
}

impl Slots {
    fn of(feed: &Feed) -> Slots {
        Slots {
            from: feed.begins(),
            slot: feed.period(),
        }
    }

    /// By how many slots the log is moved for the pass that begins next; one that begins before [`LEAD`] is over is too near.
    fn until(&self, now: Nanos) -> Nanos {
        (now + LEAD - self.from).div_euclid(self.slot) + 1
    }
}

/// The wall time at which a player of a log with `clock=wall` begins that is started at `now`, and how long it is from one pass to the
/// next, ns.
///
/// # Errors
/// A log without messages, or with unreadable ones.
pub fn next_pass(log: &Path, now: Nanos) -> Result<[Nanos; 2], Error> {
    let settings = Settings {
        log: log.into(),
        clock: TimeLine::Wall,
        ..Settings::default()
    };
    let (feed, _) = feed(&settings, &Counters::default())?;
    let slots = Slots::of(&feed);
    Ok([slots.from + slots.until(now) * slots.slot, slots.slot])
}

/// How a log is moved to wall time: by a whole number of slots.
struct Wall {
    slots: Slots,
    skew: Nanos,
    /// By agent, how many numbers a slot takes, of poses, all else and motion: numbers go on where the player starts again.
    per_pass: BTreeMap<Name, [u64; 3]>,
    /// Known with the first message: how far the log is moved, and by how many passes.
    moved: Option<(Nanos, u64)>,
}

impl Wall {
    /// Moves a message.
    fn shift(&mut self, (time, mut output): Release) -> Release {
        let slots = self.slots;
        let most = self.per_pass.values().flatten().copied().max().unwrap_or(0);
        let (shift, passes) = *self.moved.get_or_insert_with(|| {
            let count = slots.until(realo_clock::wall());
            let passes = count.rem_euclid((NUMBERS / most.max(1)).max(1) as Nanos);
            (count * slots.slot, passes as u64)
        });
        let shift = shift + self.skew;
        let header = output.header_mut();
        header.stamp += shift;
        header.ready += shift;
        let [poses, others, motion] = self.per_pass.get(&header.agent).copied().unwrap_or_default();
        let per_pass = match header.kind {
            Kind::AgentState => poses,
            Kind::Motion => motion,
            _ => others,
        };
        header.seq += passes * per_pass;
        (time + shift, output)
    }
}

impl Player {
    /// Who takes part.
    pub fn cast(&self) -> &PlannedRun {
        &self.cast
    }
}

/// What it sends.
#[derive(Debug, Outputs)]
pub enum Output {
    /// The ego's sweeps.
    #[port(of(Ego))]
    EgoClouds(Header, PointCloud),
    /// The ego's poses.
    #[port(of(Ego))]
    EgoPoses(Header, AgentState),
    /// Detections recorded for the ego's sweeps.
    #[port(of(Ego))]
    EgoRecorded(Header, Boxes),
    /// The collaborators' sweeps.
    #[port(of(Others))]
    Clouds(Header, PointCloud),
    /// The collaborators' poses.
    #[port(of(Others))]
    Poses(Header, AgentState),
    /// Detections recorded for the collaborators' sweeps.
    #[port(of(Others))]
    Recorded(Header, Boxes),
    /// Ground truth for each of the ego's sweeps.
    #[port(of(Ego))]
    Truth(Header, GroundTruth),
    /// What the collaborators give to the link, if it is precomputed.
    #[port(of(Others))]
    Packets(Header, Packet),
    /// What the ego's motion sensors measured.
    #[port(of(Ego))]
    EgoMotion(Header, Motion),
    /// What the collaborators' motion sensors measured.
    #[port(of(Others))]
    Motion(Header, Motion),
}

impl Output {
    fn header_mut(&mut self) -> &mut Header {
        let (Output::EgoClouds(header, _)
        | Output::EgoPoses(header, _)
        | Output::EgoRecorded(header, _)
        | Output::Clouds(header, _)
        | Output::Poses(header, _)
        | Output::Recorded(header, _)
        | Output::Truth(header, _)
        | Output::Packets(header, _)
        | Output::EgoMotion(header, _)
        | Output::Motion(header, _)) = self;
        header
    }

    /// Who goes first at equal times, 0 before all others.
    fn place(&self) -> usize {
        match self {
            Output::EgoPoses(..) => 0,
            Output::Poses(..) => 1,
            Output::EgoMotion(..) => 2,
            Output::Motion(..) => 3,
            Output::EgoClouds(..) => 4,
            Output::Clouds(..) => 5,
            Output::EgoRecorded(..) => 6,
            Output::Recorded(..) => 7,
            Output::Packets(..) => 8,
            Output::Truth(..) => 9,
        }
    }
}

impl Source for Player {
    fn build(settings: Settings) -> Result<Self, Error> {
        let counters = Counters::default();
        let (feed, cast) = feed(&settings, &counters)?;
        let wall = (settings.clock == TimeLine::Wall).then(|| Wall {
            slots: Slots::of(&feed),
            skew: (settings.skew_ms * 1e6) as Nanos,
            per_pass: feed.per_pass(),
            moved: None,
        });
        let releases = read_ahead(feed)?;
        Ok(Player {
            releases,
            counters,
            rate: settings.rate,
            cast,
            wall,
            ended: false,
        })
    }

    fn next(&mut self) -> Result<Option<Release>, Error> {
        if self.ended {
            return Ok(None);
        }
        let next = self.releases.take().ok_or(PlayerError::Stopped)??;
        self.ended = next.is_none();
        Ok(match &mut self.wall {
            Some(wall) => next.map(|release| wall.shift(release)),
            None => next,
        })
    }

    fn rate(&self) -> f64 {
        self.rate
    }

    fn clock(&self, first: Nanos) -> Option<Clock> {
        self.wall.as_ref().map(|wall| Clock {
            wall_origin: first - wall.skew,
            log_origin: first,
            rate: 1.0,
        })
    }

    fn counts(&self) -> Counts {
        self.counters.get()
    }
}

/// What is played, and with whom.
fn feed(settings: &Settings, counters: &Counters) -> Result<(Feed, PlannedRun), Error> {
    check(settings)?;
    if !settings.log.exists() {
        return Err(PlayerError::NoLog(settings.log.clone()).into());
    }
    let mut log = Log::open(&settings.log)?;
    if matches!(settings.stamps, StampRule::Drop | StampRule::Rebase) {
        count_rebased(&log.rebase(settings.stamps.handling())?, counters);
    }
    if log.truncation().is_some() {
        counters.add(&LOG_TRUNCATED, "", 1, 0);
    }
    let ego = if settings.agent.is_empty() {
        &settings.ego
    } else {
        &settings.agent
    };
    let plan = plan(&log, ego, settings.coop, &settings.agents)?;
    let cast = plan.runs.into_iter().next().ok_or(PlayerError::NoRun)?;
    if cast.collaborators.is_empty() {
        counters.add(&RUNS_ALONE, "", 1, 0);
    }
    need_topics(&log, &cast, settings)?;
    let (from, until) = window(&log, settings)?;
    let script = Script {
        log,
        run: settings.run.as_str().into(),
        cast: cast.clone(),
        offline: settings.offline,
        true_poses: settings.pose == PoseSource::True,
        points: settings.points,
        detections: settings.detections != Detections::Off,
        motion: settings.motion != MotionSensors::Off,
        trusts_stamps: settings.stamps == StampRule::Trust,
        precomputed: settings.precomputed,
        fused_at_most: settings.fused_at_most,
        alone: !settings.agent.is_empty(),
        repeat: settings.repeat,
        from,
        until,
        slot: (settings.clock == TimeLine::Wall).then_some(SLOT),
        counters: counters.clone(),
    };
    Ok((Feed::new(script)?, cast))
}

/// Counts the messages of all agents that get other stamps, or are left out for theirs.
fn count_rebased(streams: &[RebasedStream], counters: &Counters) {
    for of in streams {
        let counts = [(&STAMPS_REBASED, of.moved), (&STAMPS_LEFT_OUT, of.left_out)];
        for (counter, n) in counts {
            counters.lost(counter, &of.agent, n, of.messages, || of.found.clone());
        }
        counters.clock(of.clock.clone());
    }
}

/// What no range says, of everything but the log, which may not be made yet.
fn check(settings: &Settings) -> Result<(), PlayerError> {
    let Settings {
        rate, offline, repeat, ..
    } = *settings;
    let is_wall = settings.clock == TimeLine::Wall;
    if is_wall && (rate != 1.0 || offline) {
        return Err(PlayerError::Wall { rate, offline });
    }
    if settings.skew_ms != 0.0 && !is_wall {
        return Err(PlayerError::Skew(settings.skew_ms));
    }
    match settings.precomputed {
        true if repeat > 1 => Err(PlayerError::Repeat(repeat)),
        true if offline => Err(PlayerError::Offline),
        _ => Ok(()),
    }
}

fn need_topics(log: &Log, cast: &PlannedRun, settings: &Settings) -> Result<(), LogError> {
    let played = if settings.agent.is_empty() { usize::MAX } else { 1 };
    for agent in cast.agents().take(played) {
        let exact = settings.offline && log.has(agent, Stream::PoseTruth);
        let pose = if settings.pose == PoseSource::True || exact {
            Stream::PoseTruth
        } else {
            Stream::Pose
        };
        log.need(agent, pose)?;
        let precomputed = settings.precomputed && agent != cast.ego;
        let bare = (precomputed || !settings.points) && log.has(agent, Stream::Sweeps);
        log.need(agent, if bare { Stream::Sweeps } else { Stream::Points })?;
        if precomputed {
            log.need(agent, Stream::Packets)?;
        }
        if settings.detections == Detections::Required {
            log.need(agent, Stream::Detections)?;
        }
        let has_motion = [Stream::Imu, Stream::Fix, Stream::Wheels]
            .iter()
            .any(|stream| log.has(agent, *stream));
        if settings.motion == MotionSensors::Required && !has_motion {
            log.need(agent, Stream::Fix)?;
        }
    }
    Ok(())
}

/// Log times between which sweeps are played.
fn window(log: &Log, settings: &Settings) -> Result<(Nanos, Nanos), PlayerError> {
    let (first, last) = log.span().ok_or_else(|| PlayerError::Empty(log.path().into()))?;
    let from = first.saturating_add(from_seconds(settings.start));
    if from > last {
        let (start, length) = (settings.start, (last - first) as f64 * 1e-9);
        return Err(PlayerError::Start { start, length });
    }
    let until = settings
        .duration
        .map_or(Nanos::MAX, |duration| from.saturating_add(from_seconds(duration)));
    Ok((from, until))
}

fn read_ahead(mut feed: Feed) -> Result<Taker<Next>, Error> {
    let (filler, releases) = ahead();
    let read = move || {
        // Reading may wait, the graph may not. Where the system refuses, it only reads as eagerly as the rest runs.
        let _ = getpriority_process(None).and_then(|own| setpriority_process(None, own + LOWER));
        loop {
            let next = feed.next();
            let points = match &next {
                Ok(Some((_, output))) => points(output),
                _ => 0,
            };
            let last = !matches!(next, Ok(Some(_)));
            if !filler.put(next, points) || last {
                return;
            }
        }
    };
    thread::Builder::new().name("player-read".into()).spawn(read)?;
    Ok(releases)
}

/// What a message takes of memory, in points.
fn points(output: &Output) -> usize {
    match output {
        Output::EgoClouds(_, cloud) | Output::Clouds(_, cloud) => cloud.len(),
        Output::Packets(_, packet) => packet.bytes.len() / POINT_BYTES,
        _ => 0,
    }
}
