//! `realo precompute`: a log with what some agents send computed beforehand.

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::{Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use eyre::{Result, WrapErr, bail, eyre};
use realo_cli::{Force, Outcome, Output, Progress, unfinished};
use realo_host::{Stages, virtual_time};
use realo_logs::{Log, LogCopy, Precomputed, SentPacket, Stream};
use realo_schemas::{Header, Kind, Message, Name, Nanos, Packet, Payload};

use crate::run::{self, LaneRun};
use crate::tables::Show;
use crate::{demo, registry};

/// Adds to a log what agents send, so that a run computes for its ego alone
#[derive(clap::Args)]
pub struct Args {
    /// The log
    pub log: PathBuf,
    /// Dataflow file whose lane of the other agents computes
    pub graph: PathBuf,
    /// Agents whose messages are computed [default: all but the ego]
    #[arg(long, value_delimiter = ',')]
    pub agent: Vec<String>,
    /// The ego, which matters to senders that project [default: the first vehicle that is none of --agent]
    #[arg(long)]
    pub ego: Option<String>,
    /// Where the copy of the log goes that has the messages
    #[arg(short, long)]
    pub output: PathBuf,
    #[allow(missing_docs, reason = "clap would print it")]
    #[command(flatten)]
    pub force: Force,
    /// How long stages take: a TOML file of stage = ns [default: as measured, one agent at a time on this machine]
    #[arg(long)]
    pub compute: Option<PathBuf>,
    #[allow(missing_docs, reason = "clap would print it")]
    #[command(flatten)]
    pub choices: run::Choices,
}

/// Computes, and writes the copy.
pub fn main(args: &Args) -> Result<Outcome> {
    args.force.check(&args.output, Output::Log)?;
    unfinished::end_with_signals(&args.output);
    if args.log.ends_with(demo::FILE) && !args.log.exists() {
        demo::make(&args.log)?;
    }
    let log = Log::open(&args.log)?;
    if let Some(cut) = log.truncation() {
        bail!("{}: {cut}; precompute a log that is whole", args.log.display());
    }
    let (ego, agents) = cast(args, &log)?;
    let lane = run::lane(&run::Args {
        compute: args.compute.clone(),
        ..lane_args(&args.graph, &args.log, &ego, &agents, &args.choices)
    })?;
    let precomputed = precomputed(args, &log, &lane, &agents);
    let copy = LogCopy::begin(&log, &args.output, &precomputed, &agents)?;
    if !copy.strange().is_empty() {
        let topics = copy.strange().join(", ");
        eprintln!(
            "realo: {}: not copied, for realo does not read them: {topics}",
            args.log.display()
        );
    }
    let mut spool = Spool::create(&args.output)?;
    let progress = Progress::new("computing", "packets", expected_packets(&log, &agents));
    compute(&lane, &agents, |header, packet| {
        progress.add(1.0);
        spool.keep(header, packet)
    })?;
    progress.finish();
    let sent = write(copy, spool)?;
    unfinished::done(&args.output);
    show(&sent, &agents);
    println!("{}", args.output.display());
    Ok(Outcome::Complete)
}

/// What the copy will say of its packets: those of these agents, and the log's own that were computed alike.
fn precomputed(args: &Args, log: &Log, lane: &LaneRun, agents: &[String]) -> Precomputed {
    let known = log.info().precomputed.as_ref();
    let kept = known.filter(|known| known.difference(&lane.described).is_none());
    if let (Some(known), None) = (known, kept) {
        eprintln!(
            "realo: {}: what it has of {known} was computed otherwise and is left out",
            args.log.display()
        );
    }
    let kept = kept.map(|known| known.agents.clone()).unwrap_or_default();
    let all = log.info().agents.iter().map(|agent| agent.name.clone());
    let stem = |path: &Path| path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    Precomputed {
        graph: stem(&args.graph),
        agents: all
            .filter(|agent| agents.contains(agent) || kept.contains(agent))
            .collect(),
        compute: args.compute.as_deref().map_or("measured".into(), stem),
        lane: lane.described.clone(),
    }
}

fn show(sent: &Sent, agents: &[String]) {
    for agent in agents {
        let (packets, bytes, nanos) = sent.get(&**agent).copied().unwrap_or_default();
        let mean = |sum: f64| if packets == 0 { 0.0 } else { sum / packets as f64 };
        println!(
            "{agent}: {packets} packets of {:.1} KB, {:.1} ms after their sweeps",
            mean(bytes as f64 / 1e3),
            mean(nanos as f64 / 1e6)
        );
    }
}

/// A packet for each sweep of the agents, unless some give none.
fn expected_packets(log: &Log, agents: &[String]) -> Option<f64> {
    let sweeps = agents.iter().map(|agent| log.count(agent, Stream::Points));
    Some(sweeps.sum::<u64>() as f64).filter(|sweeps| *sweeps > 0.0)
}

/// The ego, and whose messages are computed.
fn cast(args: &Args, log: &Log) -> Result<(String, Vec<String>)> {
    for agent in &args.agent {
        log.need_agent(agent)?;
    }
    let plan = realo_player::plan(
        log,
        args.ego.as_deref().unwrap_or_default(),
        realo_player::Coop::All,
        &[],
    )?;
    let mut egos = plan.runs.into_iter().map(|run| run.ego);
    let anybody = log.info().agents.iter().map(|agent| agent.name.clone());
    let ego = egos.find(|ego| !args.agent.contains(ego)).or_else(|| {
        anybody
            .clone()
            .find(|name| args.ego.is_none() && !args.agent.contains(name))
    });
    let Some(ego) = ego else {
        bail!(
            "--agent: expected somebody of {} left as the ego, which computes by itself, found {}; precompute the others first, \
             then the last one in a second go",
            anybody.collect::<Vec<_>>().join(", "),
            args.agent.join(", ")
        );
    };
    let agents: Vec<String> = match args.agent.is_empty() {
        true => anybody.filter(|agent| *agent != ego).collect(),
        false => args.agent.clone(),
    };
    if agents.is_empty() {
        bail!("{}: expected an agent beside {ego}, found none", log.path().display());
    }
    Ok((ego, agents))
}

/// What runs the lane of agents that send to an ego.
pub(crate) fn lane_args(graph: &Path, log: &Path, ego: &str, agents: &[String], choices: &run::Choices) -> run::Args {
    let mut all = vec![ego.to_string()];
    all.extend(agents.iter().cloned());
    run::Args {
        graphs: vec![graph.into()],
        log: vec![log.into()],
        mode: Some(run::Mode::Virtual),
        offline: false,
        rate: None,
        coop: None,
        ego: Some(ego.into()),
        agents: all,
        compute: None,
        protocol: None,
        choices: choices.clone(),
        out: None,
        no_cost: false,
        resume: false,
        view: Default::default(),
        show: Show::default(),
    }
}

/// Runs the lane; gives all packets of the agents to `keep`.
pub(crate) fn compute(
    lane: &LaneRun,
    agents: &[String],
    mut keep: impl FnMut(&Header, &Packet) -> Result<()>,
) -> Result<()> {
    let stages = Stages::of(&lane.graph, &registry()).map_err(|error| eyre!(error))?;
    let mut failed = None;
    let observer = |stage: &str, output: &str, message: &Message| {
        let is_sent = (stage, output) == (&*lane.stage, &*lane.output);
        if !is_sent || !agents.iter().any(|agent| **agent == *message.header.agent) || failed.is_some() {
            return;
        }
        if let Payload::Packet(packet) = &message.payload {
            failed = keep(&message.header, packet).err();
        }
    };
    // The measured times are those of one agent's computer, which has this machine for itself.
    match &lane.compute {
        None => virtual_time::measure(&stages, Some(Box::new(observer)))?,
        Some(profile) => virtual_time::run(&stages, profile, Some(Box::new(observer)))?,
    };
    failed.map_or(Ok(()), Err)
}

/// Packets, bytes and time after the sweeps of each agent.
type Sent = BTreeMap<Name, (u64, u64, Nanos)>;

fn write(mut copy: LogCopy, mut spool: Spool) -> Result<Sent> {
    let mut sent = Sent::new();
    for kept in spool.in_order() {
        let packet = spool.packet(&kept)?;
        let entry = sent.entry(kept.agent.clone()).or_default();
        *entry = (entry.0 + 1, entry.1 + kept.length as u64, entry.2 + kept.took);
        copy.add(&kept.agent, kept.stamp, kept.ready, &packet)?;
    }
    copy.finish()?;
    Ok(sent)
}

/// Packets on the way to the log: written as they come, for nothing may compute beside what is measured.
struct Spool {
    path: PathBuf,
    file: File,
    length: u64,
    kept: Vec<Kept>,
}

/// A packet of the spool.
#[derive(Clone)]
struct Kept {
    agent: Name,
    stamp: Nanos,
    ready: Nanos,
    /// Since its sweep was there.
    took: Nanos,
    seq: u64,
    kind: Kind,
    frame: Name,
    codec: Vec<String>,
    at: u64,
    length: usize,
}

impl Spool {
    fn create(output: &Path) -> Result<Self> {
        let mut name = output.file_name().unwrap_or_default().to_os_string();
        name.push(format!(".{}.packets", std::process::id()));
        let path = output.with_file_name(name);
        let mut options = File::options();
        let file = options.read(true).write(true).create(true).truncate(true).open(&path);
        let file = file.wrap_err_with(|| format!("{}", path.display()))?;
        // Whoever clears up leaves what somebody writes.
        let _ = file.try_lock();
        Ok(Spool {
            path,
            file,
            length: 0,
            kept: Vec::new(),
        })
    }

    fn keep(&mut self, header: &Header, packet: &Packet) -> Result<()> {
        let written = self.file.write_all(&packet.bytes);
        written.map_err(|error| {
            eyre!(
                "writing packets beside the log, `{}`, failed after {} bytes: {error}; nothing of it was left: free space there, or \
                 choose another place",
                self.path.display(),
                self.length
            )
        })?;
        let sweep = header.trace.first().map_or(header.ready, |stage| stage.input);
        self.kept.push(Kept {
            agent: header.agent.clone(),
            stamp: header.stamp,
            ready: header.ready,
            took: header.ready - sweep,
            seq: header.seq,
            kind: header.kind,
            frame: header.frame.clone(),
            codec: packet.codec.clone(),
            at: self.length,
            length: packet.bytes.len(),
        });
        self.length += packet.bytes.len() as u64;
        Ok(())
    }

    fn in_order(&self) -> Vec<Kept> {
        let mut kept = self.kept.clone();
        kept.sort_by_key(|kept| kept.ready);
        kept
    }

    fn packet(&mut self, kept: &Kept) -> Result<SentPacket> {
        let mut bytes = vec![0; kept.length];
        let read = self.file.seek(SeekFrom::Start(kept.at));
        read.and_then(|_| self.file.read_exact(&mut bytes))
            .wrap_err_with(|| format!("{}", self.path.display()))?;
        Ok(SentPacket {
            seq: kept.seq,
            kind: kept.kind,
            frame: kept.frame.to_string(),
            codec: kept.codec.clone(),
            bytes,
        })
    }
}

impl Drop for Spool {
    fn drop(&mut self) {
        let _ = fs::remove_file(&self.path);
    }
}
