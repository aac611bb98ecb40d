//! Replays a log into both lanes of a graph: the ego's, and that of the agents that collaborate with it.
//!
//! Messages leave in order of their time on the log's line; at equal times poses go first, then clouds, recorded
//! detections, packets, truth. A thread reads ahead, so that reading a cloud delays no release. A log that was cut is played
//! up to the cut and counted as `log_truncated`. Body frames that tilt are levelled by their poses
//! (`docs/reference/log-format.md`, "Level frames"); those that are level pass as they are. Messages whose stamps are of another clock than
//! the log's are left out and counted (`clock_off`). A roadside unit that does not move has its pose at all times.

mod ahead;
mod counters;
mod feed;
mod joins;
mod nearest;
mod plan;
mod standing;
mod truth;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::thread;

use realo_logs::{Log, LogError, Stream};
use realo_operator::{Counter, Counts, Describe, Error, NoInput, Outputs, PortId, Settings, Source};
use realo_schemas::{
    AgentState, Boxes, Clock, GroundTruth, Header, Kind, Message, Name, Nanos, Packet, Payload, PointCloud,
    from_seconds,
};
use rustix::process::{getpriority_process, setpriority_process};
use serde::{Deserialize, Serialize};

use ahead::{Taker, ahead};
use counters::{Counters, LOG_TRUNCATED, RUNS_ALONE};
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

/// Who goes first at equal times.
const ORDER: [PortId; 8] = [
    Output::EGO_POSES,
    Output::POSES,
    Output::EGO_CLOUDS,
    Output::CLOUDS,
    Output::EGO_RECORDED,
    Output::RECORDED,
    Output::PACKETS,
    Output::TRUTH,
];

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

/// Settings of the player.
#[derive(Clone, Debug, PartialEq, Settings, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Settings {
    /// Path of the log.
    #[setting(default = "../target/realo/demo.mcap", role = "log")]
    pub log: PathBuf,
    /// Name of the ego; empty: the first eligible agent.
    #[setting(role = "ego")]
    pub ego: String,
    /// The agent whose sensors alone are played, and which is the ego then; empty: those of all.
    #[setting(role = "own")]
    pub agent: String,
    /// Log: its own times; wall: moved to wall time, at the same place of the log on all machines.
    #[setting(default = TimeLine::Log)]
    pub clock: TimeLine,
    /// With clock=wall, how much stamps are ahead of the wall clock: a clock that is off.
    pub skew_ms: f64,
    /// Who collaborates: all, v2v, v2i or i2i.
    #[setting(default = Coop::All, role = "coop")]
    pub coop: Coop,
    /// Who may take part; empty: all.
    #[setting(role = "agents")]
    pub agents: Vec<String>,
    /// Poses that are sent: recorded or true.
    #[setting(default = PoseSource::Recorded)]
    pub pose: PoseSource,
    /// Ready times are stamps, poses are exact where known.
    #[setting(role = "offline")]
    pub offline: bool,
    /// Whether sweeps have their points.
    #[setting(default = true, role = "points")]
    pub points: bool,
    /// Recorded detections: optional, required or off.
    #[setting(default = Detections::Optional, role = "detections")]
    pub detections: Detections,
    /// Whether the log's packets of the collaborators are played, and their sweeps without points.
    #[setting(role = "precomputed")]
    pub precomputed: bool,
    /// Leaves out sweeps of collaborators than which so many are nearer; null: none; in virtual time over perfect links.
    pub fused_at_most: Option<usize>,
    /// Seconds of log time per second, in a realtime run.
    #[setting(default = 1.0, role = "rate")]
    pub rate: f64,
    /// Passes over the log.
    #[setting(default = 1)]
    pub repeat: u32,
    /// Seconds that are left out at the log's beginning.
    pub start: f64,
    /// Seconds that are played; null: all.
    pub duration: Option<f64>,
    /// Name of the run, in every header.
    #[setting(default = "run")]
    pub run: String,
}

/// What the log has next, `None` at its end.
type Next = Result<Option<Release>, LogError>;

/// The source that replays a log.
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
    /// By agent, how many numbers a slot takes, of poses and of all else: numbers go on where the player starts again.
    per_pass: BTreeMap<Name, [u64; 2]>,
    /// Known with the first message: how far the log is moved, and by how many passes.
    moved: Option<(Nanos, u64)>,
}

impl Wall {
    /// Moves a message.
    fn shift(&mut self, (time, port, mut message): Release) -> Release {
        let slots = self.slots;
        let most = self.per_pass.values().flatten().copied().max().unwrap_or(0);
        let (shift, passes) = *self.moved.get_or_insert_with(|| {
            let count = slots.until(realo_clock::wall());
            let passes = count.rem_euclid((NUMBERS / most.max(1)).max(1) as Nanos);
            (count * slots.slot, passes as u64)
        });
        let shift = shift + self.skew;
        message.header.stamp += shift;
        message.header.ready += shift;
        let [poses, others] = self.per_pass.get(&message.header.agent).copied().unwrap_or_default();
        message.header.seq += passes
            * if message.header.kind == Kind::AgentState {
                poses
            } else {
                others
            };
        (time + shift, port, message)
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
}

impl Describe for Player {
    type Settings = Settings;
    type Input = NoInput;
    type Output = Output;
    const NAME: &'static str = "player";
    const ABOUT: &'static str = "replays a log's sweeps, poses, recorded detections and ground truth";
    const COUNTERS: &'static [Counter] = counters::ALL;
    fn examine(settings: &Settings) -> Result<(), Error> {
        check(settings)
    }
}

impl Source for Player {
    fn new(settings: Settings) -> Result<Self, Error> {
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

    fn next(&mut self) -> Result<Option<(Nanos, PortId, Message)>, Error> {
        if self.ended {
            return Ok(None);
        }
        let next = self.releases.take().ok_or("player: the reading thread stopped")??;
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
        return Err(no_log(&settings.log).into());
    }
    let log = Log::open(&settings.log)?;
    if log.truncation().is_some() {
        counters.add(&LOG_TRUNCATED, "", 1, 0);
    }
    let ego = if settings.agent.is_empty() {
        &settings.ego
    } else {
        &settings.agent
    };
    let plan = plan(&log, ego, settings.coop, &settings.agents)?;
    let cast = plan.runs.into_iter().next().ok_or("a plan has at least one run")?;
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

/// Everything but the log, which may not be made yet.
fn check(settings: &Settings) -> Result<(), Error> {
    let positive = |value: f64| value.is_finite() && value > 0.0;
    if !positive(settings.rate) {
        return Err(format!("player: `rate` must be a positive number, found {}", settings.rate).into());
    }
    if settings.clock == TimeLine::Wall && (settings.rate != 1.0 || settings.offline) {
        let (rate, offline) = (settings.rate, settings.offline);
        return Err(format!(
            "player: `clock=wall`: expected `rate` 1 and not `offline`, found rate {rate}, offline {offline}: leave them, or clock=log"
        )
        .into());
    }
    if settings.skew_ms != 0.0 && !(settings.clock == TimeLine::Wall && settings.skew_ms.abs() <= 1e7) {
        let found = settings.skew_ms;
        return Err(format!("player: `skew_ms` needs clock=wall, and must be within ±1e7, found {found}").into());
    }
    if settings.repeat == 0 {
        return Err("player: `repeat` must be at least 1, found 0".into());
    }
    if settings.precomputed && settings.repeat > 1 {
        let found = settings.repeat;
        return Err(format!(
            "player: `precomputed`: packets say their own number and time, so that `repeat` must be 1, found {found}"
        )
        .into());
    }
    if settings.precomputed && settings.offline {
        return Err(
            "player: `precomputed`: packets were made with poses and at times as recorded, which `offline` does not \
                    play: leave one of the two"
                .into(),
        );
    }
    if !settings.start.is_finite() || settings.start < 0.0 {
        return Err(format!("player: `start` must not be negative, found {}", settings.start).into());
    }
    match settings.duration {
        Some(duration) if !positive(duration) => {
            Err(format!("player: `duration` must be a positive number, found {duration}").into())
        }
        _ => Ok(()),
    }
}

fn no_log(path: &Path) -> String {
    let path = path.display();
    format!(
        "there is no log `{path}`; make one with `realo-lab simulate --scenario intersection --seed 1 --seconds 10 -o {path}`"
    )
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
    }
    Ok(())
}

/// Log times between which sweeps are played.
fn window(log: &Log, settings: &Settings) -> Result<(Nanos, Nanos), Error> {
    let (first, last) = log
        .span()
        .ok_or_else(|| format!("`{}` has no messages", log.path().display()))?;
    let from = first.saturating_add(from_seconds(settings.start));
    if from > last {
        let (start, length) = (settings.start, (last - first) as f64 * 1e-9);
        return Err(format!("player: `start` is {start} s, but the log has only {length:.3} s").into());
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
                Ok(Some((_, _, message))) => points(&message.payload),
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

/// What a payload takes of memory, in points.
fn points(payload: &Payload) -> usize {
    match payload {
        Payload::PointCloud(cloud) => cloud.len(),
        Payload::Packet(packet) => packet.bytes.len() / POINT_BYTES,
        _ => 0,
    }
}
