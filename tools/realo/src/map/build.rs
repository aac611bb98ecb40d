//! `realo map build`: a map from the sweeps and poses of logs.

use std::collections::BTreeMap;
use std::path::PathBuf;

use clap::ValueEnum;
use eyre::{Result, bail};
use realo_cli::{Force, Outcome, Output, Progress, unfinished};
use realo_logs::{Log, LogError, Stream};
use realo_registration::{MAGIC, MapBuilder, MapSettings};

use super::estimated::estimate;
use super::sweeps::{Agent, Counts, add};
use super::{Description, report};

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
    /// Found by the vehicles' own sensors: odometry by IMU, wheels and sweeps, closed loops, GNSS as anchor
    Estimated,
}

impl Poses {
    /// Where the log has them; `None` where it does not.
    fn stream(self) -> Option<Stream> {
        match self {
            Poses::Recorded => Some(Stream::Pose),
            Poses::True => Some(Stream::PoseTruth),
            Poses::Estimated => None,
        }
    }
}

/// Builds and writes the map; of a log that was cut what is left is used, and the command ends with 3.
pub fn main(args: &Args) -> Result<Outcome> {
    args.force.check(&args.output, MAP)?;
    check_twice(&args.logs)?;
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
    let posed = match args.poses.stream() {
        Some(stream) => posed(&logs, &agents, stream)?,
        None => {
            let estimated = estimate(&logs, &agents, args.voxel)?;
            report::print(&estimated);
            builder.closed(estimated.closure());
            estimated.posed
        }
    };
    let sweeps = |(log, agents): (&Log, &BTreeMap<String, Agent>)| {
        agents.keys().map(|agent| log.count(agent, Stream::Points)).sum::<u64>()
    };
    let all: u64 = logs.iter().zip(&posed).map(sweeps).sum();
    let progress = Progress::new("building the map", "sweeps", Some(all as f64));
    for (log, agents) in logs.iter().zip(&posed) {
        let mut counts = Counts::default();
        add(log, agents, &mut builder, &mut counts, &progress)?;
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

/// Refuses a log that is given twice: it would count as two drives.
fn check_twice(logs: &[PathBuf]) -> Result<()> {
    let known: Vec<PathBuf> = logs
        .iter()
        .map(|log| log.canonicalize().unwrap_or_else(|_| log.clone()))
        .collect();
    for (at, log) in logs.iter().enumerate() {
        if known[..at].contains(&known[at]) {
            bail!("{}: the log is given twice; give each drive once", log.display());
        }
    }
    Ok(())
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
        if let Some(stream) = args.poses.stream() {
            log.need(agent, stream)?;
        }
    }
    Ok(wanted)
}

/// The agents of each log with the poses that it has.
fn posed(logs: &[Log], agents: &[Vec<String>], stream: Stream) -> Result<Vec<BTreeMap<String, Agent>>, LogError> {
    let of = |(log, agents): (&Log, &Vec<String>)| {
        let known = agents
            .iter()
            .map(|agent| Ok((agent.clone(), Agent::of(log, agent, stream)?)));
        known.collect()
    };
    logs.iter().zip(agents).map(of).collect()
}

/// Refuses names that no log has.
fn check_agents(args: &Args, found: &[Vec<String>]) -> Result<()> {
    let is_unknown = |name: &&String| !found.iter().flatten().any(|known| known == *name);
    match args.agents.iter().find(is_unknown) {
        Some(name) => bail!("--agents {name}: no log has an agent of that name; `realo info` lists them"),
        None => Ok(()),
    }
}
