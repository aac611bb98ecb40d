//! Replays a log into both lanes of a graph: the ego's, and that of the agents that collaborate with it.
//!
//! | output | type | content |
//! |---|---|---|
//! | `ego_clouds` | PointCloud | the ego's sweeps |
//! | `ego_poses` | AgentState | the ego's poses, as recorded or true |
//! | `ego_recorded` | Boxes | detections recorded for the ego's sweeps; same seq and stamp |
//! | `clouds` | PointCloud | the collaborators' sweeps |
//! | `poses` | AgentState | their poses |
//! | `recorded` | Boxes | their recorded detections |
//! | `truth` | GroundTruth | one for each of the ego's sweeps, in its true body frame |
//! | `packets` | Packet | with `precomputed`, what the collaborators give to the link; their sweeps then have no points |
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
use std::time::{SystemTime, UNIX_EPOCH};

use realo_logs::{Log, LogError, Stream};
use realo_operator::{Argument, Counter, Counts, Decided, Describe, Error, Lane, Port, PortId, Source};
use realo_schemas::{Clock, Kind, Message, Name, Nanos, Payload, PayloadType, from_seconds};
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

mod ports {
    use realo_operator::PortId;

    pub const EGO_CLOUDS: PortId = PortId(0);
    pub const EGO_POSES: PortId = PortId(1);
    pub const EGO_RECORDED: PortId = PortId(2);
    pub const CLOUDS: PortId = PortId(3);
    pub const POSES: PortId = PortId(4);
    pub const RECORDED: PortId = PortId(5);
    pub const TRUTH: PortId = PortId(6);
    pub const PACKETS: PortId = PortId(7);
    /// Who goes first at equal times.
    pub const ORDER: [PortId; 8] = [
        EGO_POSES,
        POSES,
        EGO_CLOUDS,
        CLOUDS,
        EGO_RECORDED,
        RECORDED,
        PACKETS,
        TRUTH,
    ];
}

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
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// Path of the log.
    pub log: PathBuf,
    /// Name of the ego; empty: the first eligible agent.
    pub ego: String,
    /// The agent whose sensors alone are played, and which is the ego then; empty: those of all.
    pub agent: String,
    /// What the log's time lies on.
    pub clock: TimeLine,
    /// How much stamps are ahead of the wall clock, ms.
    pub skew_ms: f64,
    /// Who collaborates.
    pub coop: Coop,
    /// Who may take part; empty: all.
    pub agents: Vec<String>,
    /// Which poses are sent.
    pub pose: PoseSource,
    /// Ready times are stamps, poses are exact where known.
    pub offline: bool,
    /// Whether sweeps have their points.
    pub points: bool,
    /// What to do about recorded detections.
    pub detections: Detections,
    /// Whether the collaborators' messages are played that the log has precomputed.
    pub precomputed: bool,
    /// Collaborators that the fusion of the graph takes, for sweeps to be left out that it cannot take because so many others
    /// are nearer; only where every message arrives at once. `None`: all sweeps are played.
    pub fused_at_most: Option<usize>,
    /// Seconds of log time per second, in a realtime run.
    pub rate: f64,
    /// Passes over the log.
    pub repeat: u32,
    /// Seconds of the log that are left out at its beginning.
    pub start: f64,
    /// Seconds of the log that are played; all by default.
    pub duration: Option<f64>,
    /// Name of the run.
    pub run: String,
}

impl Default for Config {
    fn default() -> Self {
        Config {
            log: "../target/realo/demo.mcap".into(),
            ego: String::new(),
            agent: String::new(),
            clock: TimeLine::Log,
            skew_ms: 0.0,
            coop: Coop::All,
            agents: Vec::new(),
            pose: PoseSource::Recorded,
            offline: false,
            points: true,
            detections: Detections::Optional,
            precomputed: false,
            fused_at_most: None,
            rate: 1.0,
            repeat: 1,
            start: 0.0,
            duration: None,
            run: "run".into(),
        }
    }
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
    let config = Config {
        log: log.into(),
        clock: TimeLine::Wall,
        ..Config::default()
    };
    let (feed, _) = feed(&config, &Counters::default())?;
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
            let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
            let count = slots.until(since.as_nanos() as Nanos);
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

impl Describe for Player {
    type Config = Config;
    const NAME: &'static str = "player";
    const ABOUT: &'static str = "replays a log's sweeps, poses, recorded detections and ground truth";
    const ARGUMENTS: &'static [Argument] = &[
        Argument {
            name: "log",
            about: "path of the log",
        },
        Argument {
            name: "ego",
            about: "name of the ego; empty: the first eligible agent",
        },
        Argument {
            name: "agent",
            about: "the agent whose sensors alone are played, and which is the ego then; empty: those of all",
        },
        Argument {
            name: "clock",
            about: "log: its own times; wall: moved to wall time, at the same place of the log on all machines",
        },
        Argument {
            name: "skew_ms",
            about: "with clock=wall, how much stamps are ahead of the wall clock: a clock that is off",
        },
        Argument {
            name: "coop",
            about: "who collaborates: all, v2v, v2i or i2i",
        },
        Argument {
            name: "agents",
            about: "who may take part; empty: all",
        },
        Argument {
            name: "pose",
            about: "poses that are sent: recorded or true",
        },
        Argument {
            name: "offline",
            about: "ready times are stamps, poses are exact where known",
        },
        Argument {
            name: "points",
            about: "whether sweeps have their points",
        },
        Argument {
            name: "detections",
            about: "recorded detections: optional, required or off",
        },
        Argument {
            name: "precomputed",
            about: "whether the log's packets of the collaborators are played, and their sweeps without points",
        },
        Argument {
            name: "fused_at_most",
            about: "leaves out sweeps of collaborators than which so many are nearer; null: none; in virtual time over perfect links",
        },
        Argument {
            name: "rate",
            about: "seconds of log time per second, in a realtime run",
        },
        Argument {
            name: "repeat",
            about: "passes over the log",
        },
        Argument {
            name: "start",
            about: "seconds that are left out at the log's beginning",
        },
        Argument {
            name: "duration",
            about: "seconds that are played; null: all",
        },
        Argument {
            name: "run",
            about: "name of the run, in every header",
        },
    ];
    const INPUTS: &'static [Port] = &[];
    const OUTPUTS: &'static [Port] = &[
        Port::new("ego_clouds", &[PayloadType::PointCloud], "the ego's sweeps").of(Lane::Ego),
        Port::new("ego_poses", &[PayloadType::AgentState], "the ego's poses").of(Lane::Ego),
        Port::new(
            "ego_recorded",
            &[PayloadType::Boxes],
            "detections recorded for the ego's sweeps",
        )
        .of(Lane::Ego),
        Port::new("clouds", &[PayloadType::PointCloud], "the collaborators' sweeps").of(Lane::Others),
        Port::new("poses", &[PayloadType::AgentState], "the collaborators' poses").of(Lane::Others),
        Port::new(
            "recorded",
            &[PayloadType::Boxes],
            "detections recorded for the collaborators' sweeps",
        )
        .of(Lane::Others),
        Port::new(
            "truth",
            &[PayloadType::GroundTruth],
            "ground truth for each of the ego's sweeps",
        )
        .of(Lane::Ego),
        Port::new(
            "packets",
            &[PayloadType::Packet],
            "what the collaborators give to the link, if it is precomputed",
        )
        .of(Lane::Others),
    ];
    const COUNTERS: &'static [Counter] = counters::ALL;
    const DECIDED: &'static [(Decided, &'static str)] = &[
        (Decided::Log, "log"),
        (Decided::Ego, "ego"),
        (Decided::Own, "agent"),
        (Decided::Coop, "coop"),
        (Decided::Agents, "agents"),
        (Decided::Offline, "offline"),
        (Decided::Rate, "rate"),
        (Decided::Points, "points"),
        (Decided::Detections, "detections"),
        (Decided::Precomputed, "precomputed"),
    ];

    fn examine(config: &Config) -> Result<(), Error> {
        check(config)
    }
}

impl Source for Player {
    fn new(config: Config) -> Result<Self, Error> {
        let counters = Counters::default();
        let (feed, cast) = feed(&config, &counters)?;
        let wall = (config.clock == TimeLine::Wall).then(|| Wall {
            slots: Slots::of(&feed),
            skew: (config.skew_ms * 1e6) as Nanos,
            per_pass: feed.per_pass(),
            moved: None,
        });
        let releases = read_ahead(feed)?;
        Ok(Player {
            releases,
            counters,
            rate: config.rate,
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
fn feed(config: &Config, counters: &Counters) -> Result<(Feed, PlannedRun), Error> {
    check(config)?;
    if !config.log.exists() {
        return Err(no_log(&config.log).into());
    }
    let log = Log::open(&config.log)?;
    if log.truncation().is_some() {
        counters.add(&LOG_TRUNCATED, "", 1, 0);
    }
    let ego = if config.agent.is_empty() {
        &config.ego
    } else {
        &config.agent
    };
    let plan = plan(&log, ego, config.coop, &config.agents)?;
    let cast = plan.runs.into_iter().next().ok_or("a plan has at least one run")?;
    if cast.collaborators.is_empty() {
        counters.add(&RUNS_ALONE, "", 1, 0);
    }
    need_topics(&log, &cast, config)?;
    let (from, until) = window(&log, config)?;
    let script = Script {
        log,
        run: config.run.as_str().into(),
        cast: cast.clone(),
        offline: config.offline,
        true_poses: config.pose == PoseSource::True,
        points: config.points,
        detections: config.detections != Detections::Off,
        precomputed: config.precomputed,
        fused_at_most: config.fused_at_most,
        alone: !config.agent.is_empty(),
        repeat: config.repeat,
        from,
        until,
        slot: (config.clock == TimeLine::Wall).then_some(SLOT),
        counters: counters.clone(),
    };
    Ok((Feed::new(script)?, cast))
}

/// Everything but the log, which may not be made yet.
fn check(config: &Config) -> Result<(), Error> {
    let positive = |value: f64| value.is_finite() && value > 0.0;
    if !positive(config.rate) {
        return Err(format!("player: `rate` must be a positive number, found {}", config.rate).into());
    }
    if config.clock == TimeLine::Wall && (config.rate != 1.0 || config.offline) {
        let (rate, offline) = (config.rate, config.offline);
        return Err(format!(
            "player: `clock=wall`: expected `rate` 1 and not `offline`, found rate {rate}, offline {offline}: leave them, or clock=log"
        )
        .into());
    }
    if config.skew_ms != 0.0 && !(config.clock == TimeLine::Wall && config.skew_ms.abs() <= 1e7) {
        let found = config.skew_ms;
        return Err(format!("player: `skew_ms` needs clock=wall, and must be within ±1e7, found {found}").into());
    }
    if config.repeat == 0 {
        return Err("player: `repeat` must be at least 1, found 0".into());
    }
    if config.precomputed && config.repeat > 1 {
        let found = config.repeat;
        return Err(format!(
            "player: `precomputed`: packets say their own number and time, so that `repeat` must be 1, found {found}"
        )
        .into());
    }
    if config.precomputed && config.offline {
        return Err(
            "player: `precomputed`: packets were made with poses and at times as recorded, which `offline` does not \
                    play: leave one of the two"
                .into(),
        );
    }
    if !config.start.is_finite() || config.start < 0.0 {
        return Err(format!("player: `start` must not be negative, found {}", config.start).into());
    }
    match config.duration {
        Some(duration) if !positive(duration) => {
            Err(format!("player: `duration` must be a positive number, found {duration}").into())
        }
        _ => Ok(()),
    }
}

fn no_log(path: &Path) -> String {
    let path = path.display();
    format!(
        "there is no log `{path}`; make one with `realo simulate --scenario intersection --seed 1 --seconds 10 -o {path}`"
    )
}

fn need_topics(log: &Log, cast: &PlannedRun, config: &Config) -> Result<(), LogError> {
    let played = if config.agent.is_empty() { usize::MAX } else { 1 };
    for agent in cast.agents().take(played) {
        let exact = config.offline && log.has(agent, Stream::PoseTruth);
        let pose = if config.pose == PoseSource::True || exact {
            Stream::PoseTruth
        } else {
            Stream::Pose
        };
        log.need(agent, pose)?;
        let precomputed = config.precomputed && agent != cast.ego;
        let bare = (precomputed || !config.points) && log.has(agent, Stream::Sweeps);
        log.need(agent, if bare { Stream::Sweeps } else { Stream::Points })?;
        if precomputed {
            log.need(agent, Stream::Packets)?;
        }
        if config.detections == Detections::Required {
            log.need(agent, Stream::Detections)?;
        }
    }
    Ok(())
}

/// Log times between which sweeps are played.
fn window(log: &Log, config: &Config) -> Result<(Nanos, Nanos), Error> {
    let (first, last) = log
        .span()
        .ok_or_else(|| format!("`{}` has no messages", log.path().display()))?;
    let from = first.saturating_add(from_seconds(config.start));
    if from > last {
        let (start, length) = (config.start, (last - first) as f64 * 1e-9);
        return Err(format!("player: `start` is {start} s, but the log has only {length:.3} s").into());
    }
    let until = config
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn arguments_are_the_keys_of_the_configuration() {
        let keys: Vec<String> = realo_operator::config::defaults::<Config>().keys().cloned().collect();
        let names: Vec<&str> = Player::ARGUMENTS.iter().map(|argument| argument.name).collect();
        assert_eq!(keys, names);
    }
}
