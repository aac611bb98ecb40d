//! `realo map build`: a map from the sweeps and poses of logs.

use std::collections::BTreeMap;
use std::path::PathBuf;

use clap::ValueEnum;
use eyre::{Result, bail};
use realo_cli::{Force, Outcome, Output, Progress, unfinished};
use realo_logs::{AgentKind, Entry, Log, LogError, MAX_GAP, Stream, pose_track};
use realo_registration::{MAGIC, MapBuilder, MapSettings, PosedSweep};
use realo_schemas::Nanos;
use realo_schemas::geometry::{Motion, PoseTrack};
use realo_sync::{OwnBody, clean};

use super::Description;

/// What recorded poses are taken to be off by where they do not say it: on the ground and up, m, and the heading, rad.
const UNKNOWN: [f64; 3] = [0.05, 0.1, 1.2e-3];
/// Larger variances are none, m² and rad².
const MAX_VARIANCE: f64 = 1e8;

/// How high LiDARs are where a log does not say, m: on vehicles, on roadside units. It matters only to what was seen empty.
const SENSOR_HEIGHTS: [f64; 2] = [1.9, 5.0];

const MAP: Output = Output::Known {
    name: "a map",
    begins: |head| head.starts_with(MAGIC),
};

/// Builds a map from one or more drives; what moves is left out
#[derive(clap::Args)]
pub struct Args {
    /// Logs with sweeps and poses in one frame
    #[arg(required = true)]
    logs: Vec<PathBuf>,
    /// Where the map goes
    #[arg(short, long)]
    output: PathBuf,
    #[allow(missing_docs, reason = "clap would print it")]
    #[command(flatten)]
    force: Force,
    /// Poses that place the sweeps
    #[arg(long, value_enum, default_value_t = Poses::Recorded)]
    poses: Poses,
    /// Agents whose sweeps are used [default: all]
    #[arg(long, value_delimiter = ',')]
    agents: Vec<String>,
    /// Side of a voxel, m: 0.05 to 10
    #[arg(long, default_value_t = MapSettings::default().voxel_m)]
    voxel: f64,
    /// Points farther than this are left out, m
    #[arg(long, default_value_t = MapSettings::default().range_m[1])]
    range: f64,
}

#[derive(Clone, Copy, ValueEnum)]
enum Poses {
    /// As each agent believed
    Recorded,
    /// Exact, where the log has them
    True,
}

impl Poses {
    fn stream(self) -> Stream {
        match self {
            Poses::Recorded => Stream::Pose,
            Poses::True => Stream::PoseTruth,
        }
    }
}

/// Sweeps that were not used as they should be.
#[derive(Default)]
struct Counts {
    no_pose: u64,
    unplaced: u64,
    not_deskewed: u64,
}

/// Builds and writes the map; of a log that was cut what is left is used, and the command ends with 3.
pub fn main(args: &Args) -> Result<Outcome> {
    args.force.check(&args.output, MAP)?;
    unfinished::end_with_signals(&args.output);
    let mut outcome = Outcome::Complete;
    let logs: Vec<Log> = args.logs.iter().map(Log::open).collect::<Result<_, _>>()?;
    for log in &logs {
        if let Some(cut) = log.truncation() {
            eprintln!("realo: {}: {cut}", log.path().display());
            outcome = Outcome::Partial;
        }
    }
    let settings = MapSettings {
        voxel_m: args.voxel,
        range_m: [MapSettings::default().range_m[0], args.range],
        ..MapSettings::default()
    };
    let mut builder = MapBuilder::new(settings, one_frame(&logs)?)?;
    let agents: Vec<Vec<String>> = logs.iter().map(|log| agents_of(args, log)).collect::<Result<_>>()?;
    check_agents(args, &agents)?;
    let sweeps =
        |(log, agents): (&Log, &Vec<String>)| agents.iter().map(|agent| log.count(agent, Stream::Points)).sum::<u64>();
    let all: u64 = logs.iter().zip(&agents).map(sweeps).sum();
    let progress = Progress::new("building the map", "sweeps", Some(all as f64));
    for (log, agents) in logs.iter().zip(&agents) {
        let mut counts = Counts::default();
        add(log, agents, args.poses, &mut builder, &mut counts, &progress)?;
        counts.report(log);
    }
    progress.rename("deciding what stands still", "cells");
    let map = builder.finish(|done, all| progress.of(done as f64, all as f64))?;
    progress.finish();
    map.write(&args.output)?;
    unfinished::done(&args.output);
    println!("{}", Description::of(args.output.display().to_string(), &map));
    Ok(outcome)
}

/// The frame in which all logs give their poses.
fn one_frame(logs: &[Log]) -> Result<&str> {
    let Some((first, others)) = logs.split_first() else {
        bail!("expected a log or more, found none");
    };
    let frame = &first.info().map_frame;
    if let Some(other) = others.iter().find(|log| log.info().map_frame != *frame) {
        bail!(
            "{}: its poses are in frame `{}`, those of {} in `{frame}`: a map has one frame; build a map of each",
            other.path().display(),
            other.info().map_frame,
            first.path().display()
        );
    }
    Ok(frame)
}

/// The agents of a log whose sweeps are used.
fn agents_of(args: &Args, log: &Log) -> Result<Vec<String>> {
    let names = log.info().agents.iter().map(|agent| &agent.name);
    let wanted = names.filter(|name| match args.agents.is_empty() {
        true => log.has(name, Stream::Points),
        false => args.agents.contains(name),
    });
    let wanted: Vec<String> = wanted.cloned().collect();
    if args.agents.is_empty() && wanted.is_empty() {
        bail!("{}: expected an agent with sweeps, found none", log.path().display());
    }
    for agent in &wanted {
        log.need(agent, Stream::Points)?;
        log.need(agent, args.poses.stream())?;
    }
    Ok(wanted)
}

/// Refuses names that no log has.
fn check_agents(args: &Args, found: &[Vec<String>]) -> Result<()> {
    let is_unknown = |name: &&String| !found.iter().flatten().any(|known| known == *name);
    match args.agents.iter().find(is_unknown) {
        Some(name) => bail!("--agents {name}: no log has an agent of that name; `realo info` lists them"),
        None => Ok(()),
    }
}

/// Adds the sweeps of a log, in order of time.
fn add(
    log: &Log,
    agents: &[String],
    poses: Poses,
    builder: &mut MapBuilder,
    counts: &mut Counts,
    progress: &Progress,
) -> Result<()> {
    if agents.is_empty() {
        return Ok(());
    }
    let mut known: BTreeMap<&str, Agent> = BTreeMap::new();
    for agent in agents {
        known.insert(agent, Agent::of(log, agent, poses.stream())?);
    }
    let wanted: Vec<(&str, Stream)> = agents.iter().map(|agent| (&**agent, Stream::Points)).collect();
    let mut reader = log.read_all(&wanted)?;
    while let Some(entry) = reader.next()? {
        if let Some(agent) = known.get(&*entry.agent) {
            agent.add(&entry, builder, counts)?;
        }
        progress.add(1.0);
    }
    Ok(())
}

/// What must be known of an agent to use its sweeps.
struct Agent {
    track: PoseTrack,
    sigmas: [f64; 3],
    sensor: [f64; 3],
    own_body: Option<OwnBody>,
}

impl Agent {
    fn of(log: &Log, name: &str, stream: Stream) -> Result<Self, LogError> {
        let info = log.info().agent(name);
        let is_vehicle = info.is_none_or(|info| info.kind == AgentKind::Vehicle);
        let [vehicle, roadside] = SENSOR_HEIGHTS;
        let unknown = [0.0, 0.0, if is_vehicle { vehicle } else { roadside }];
        Ok(Agent {
            track: pose_track(log, name, stream, MAX_GAP)?,
            sigmas: sigmas(log, name, stream)?,
            sensor: info.and_then(|info| info.sensor_position).unwrap_or(unknown),
            own_body: is_vehicle.then_some(OwnBody::V2X_REAL),
        })
    }

    /// Adds a sweep, without the agent's motion and body.
    fn add(&self, entry: &Entry, builder: &mut MapBuilder, counts: &mut Counts) -> Result<()> {
        let stamp = entry.stamp();
        let Some(map_from_body) = self.track.at(stamp) else {
            counts.no_pose += 1;
            return Ok(());
        };
        let cloud = match entry.cloud() {
            Err(LogError::Unplaced { .. }) => {
                counts.unplaced += 1;
                return Ok(());
            }
            cloud => cloud?,
        };
        let times = [cloud.time.iter().min(), cloud.time.iter().max()];
        let [first, last] = times.map(|time| time.map_or(0, |time| Nanos::from(*time)));
        let motion = Motion::new(&self.track, stamp, first, last);
        counts.not_deskewed += u64::from(motion.is_none());
        let cloud = clean(&cloud, self.own_body, motion.as_ref()).cloud;
        builder.add(&PosedSweep {
            agent: &entry.agent,
            stamp,
            cloud: &cloud,
            map_from_body: &map_from_body,
            sensor: self.sensor,
            sigmas: self.sigmas,
        })?;
        Ok(())
    }
}

/// Standard deviations of an agent's poses in the mean, as [`PosedSweep::sigmas`] has them.
fn sigmas(log: &Log, agent: &str, stream: Stream) -> Result<[f64; 3], LogError> {
    if stream == Stream::PoseTruth {
        return Ok([0.0; 3]);
    }
    let (mut sums, mut poses) = ([0.0; 3], 0.0);
    let mut reader = log.read_all(&[(agent, stream)])?;
    while let Some(entry) = reader.next()? {
        let Ok(state) = entry.pose() else { continue };
        let said = state.covariance.map(|of| [0.5 * (of[0] + of[7]), of[14], of[35]]);
        // False for what is not a number too.
        let said = said.filter(|of| of.iter().all(|variance| (0.0..=MAX_VARIANCE).contains(variance)));
        let variances = said.unwrap_or(UNKNOWN.map(|sigma| sigma * sigma));
        sums.iter_mut().zip(variances).for_each(|(sum, of)| *sum += of);
        poses += 1.0;
    }
    Ok(match poses > 0.0 {
        true => sums.map(|sum| (sum / poses).sqrt()),
        false => UNKNOWN,
    })
}

impl Counts {
    fn report(&self, log: &Log) {
        let path = log.path().display();
        for (count, what) in [
            (
                self.no_pose,
                "sweeps were left out, for no pose is known at their stamps",
            ),
            (
                self.unplaced,
                "sweeps were left out, for no transform brings them to the body frame",
            ),
            (
                self.not_deskewed,
                "sweeps keep the agent's motion, for no poses are known during them",
            ),
        ] {
            if count > 0 {
                eprintln!("realo: {path}: {count} {what}");
            }
        }
    }
}
