//! `realo latency`: how long an agent's messages take to another machine.

use std::collections::BTreeMap;
use std::fs::{self, OpenOptions};
use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, channel};
use std::time::{Duration, Instant};

use clap::ArgGroup;
use eyre::{Result, WrapErr, bail, eyre};
use realo_cli::{Force, Outcome, Output};
use realo_logs::Log;
use realo_operator::Waker;
use realo_radio::clock::{steady, wall, wall_now};
use realo_radio::course::{Came, Course};
use realo_radio::keys::{Own, Trusted};
use realo_radio::network::{Network, Taken};
use realo_radio::offset::Estimate;
use realo_radio::protocol::{Arrived, Offer, Settings};
use realo_radio::refusal::{Refusal, Refusals};
use realo_radio::seal::Seal;
use realo_radio::session::Place;
use realo_radio::station::{Event, Station};
use realo_radio::{Endpoint, body};
use realo_schemas::report::Phase;
use realo_schemas::{Clock, Kind, Name, Nanos, to_millis};
use serde::Serialize;

use crate::{demo, precompute, run};
use realo_cli::paper::{Crossing, PaperTimes};

/// Between two messages, unless the one before takes longer.
const PERIOD: Duration = Duration::from_millis(100);
/// A message that is not back after so long is lost.
const PATIENCE: Duration = Duration::from_secs(10);
/// How long the other end is looked for.
const MEETING: Duration = Duration::from_secs(20);
/// First messages of a kind, which find out what the way carries and do not count.
const FIRST: usize = 3;
/// Largest message.
const LARGEST: usize = 64 << 20;

/// Measures how long a log's messages take to a peer and back, and writes what the way is like as a trace for `link`
///
/// The peer runs `realo latency --listen tcp/0.0.0.0:7447`, which sends back what comes until it is stopped.
#[derive(clap::Args)]
#[command(group(ArgGroup::new("end").required(true).args(["peer", "listen"])))]
pub struct Args {
    /// Address of the other end
    #[arg(long, requires = "log")]
    peer: Option<Endpoint>,
    /// Is the other end, at this address
    #[arg(long, conflicts_with_all = ["log", "graph", "agent", "messages", "output", "json"])]
    listen: Option<Endpoint>,
    /// The log whose messages are sent
    #[arg(long)]
    log: Option<PathBuf>,
    /// Graphs whose lanes of the other agents make the messages
    #[arg(long, default_values = ["dataflows/late_fusion.yml", "dataflows/attfuse.yml", "dataflows/early_fusion.yml"])]
    graph: Vec<PathBuf>,
    /// Whose messages [default: the first agent that is not the ego]
    #[arg(long)]
    agent: Option<String>,
    /// Messages of each kind
    #[arg(long, default_value_t = 100, value_parser = clap::value_parser!(u16).range(1..))]
    messages: u16,
    /// Where the trace goes
    #[arg(short, long, default_value = "channel.csv")]
    output: PathBuf,
    #[allow(missing_docs, reason = "clap would print it")]
    #[command(flatten)]
    force: Force,
    /// Prints JSON
    #[arg(long)]
    json: bool,
    /// File of this end's private key: all is signed, and only what a trusted end signed counts
    #[arg(long, requires = "trust")]
    key: Option<PathBuf>,
    /// File of the agents that are trusted
    #[arg(long, requires = "key")]
    trust: Option<PathBuf>,
    /// File of further settings of Zenoh
    #[arg(long)]
    zenoh: Option<PathBuf>,
    #[command(flatten)]
    choices: run::Choices,
}

/// Measures, or answers.
pub fn main(args: &Args) -> Result<Outcome> {
    match (&args.peer, &args.log) {
        (Some(peer), Some(log)) => {
            args.force.check(&args.output, Output::TRACE)?;
            let is_new = open_for_trace(&args.output)?;
            let measured = measure(args, peer, log);
            if measured.is_err() && is_new {
                let _ = fs::remove_file(&args.output);
            }
            measured
        }
        _ => answer(args),
    }
}

/// Finds out, before anything is measured, whether the trace can be written; what is there stays. Whether the file is new.
fn open_for_trace(path: &Path) -> Result<bool> {
    let is_new = !path.exists();
    let opened = OpenOptions::new().write(true).create(true).truncate(false).open(path);
    opened.wrap_err_with(|| {
        format!(
            "{}: the trace cannot be written there; name another file (--output)",
            path.display()
        )
    })?;
    Ok(is_new)
}

/// One end of the way.
struct End {
    network: Network,
    woken: Receiver<()>,
}

impl End {
    fn open(args: &Args, usual_name: &str) -> Result<End> {
        let site = "realo-latency";
        let own = args.key.as_deref().map(Own::read).transpose()?;
        let name = own.as_ref().map_or(Name::from(usual_name), |own| own.agent.clone());
        let seal = match (own, &args.trust) {
            (Some(own), Some(trust)) => Some(Seal::new(site, own, Trusted::read(trust)?)),
            _ => None,
        };
        let place = Place {
            site: site.into(),
            agent: name.clone(),
            listen: args.listen.iter().cloned().collect(),
            connect: args.peer.iter().cloned().collect(),
            zenoh: args.zenoh.clone().unwrap_or_default(),
            ..Place::default()
        };
        let settings = Settings {
            deadline: PATIENCE.as_nanos() as Nanos,
            ..Settings::default()
        };
        let (wake, woken) = channel();
        let waker = Waker::new(move || {
            let _ = wake.send(());
        });
        let station = Station::new(name, settings, LARGEST, wall() as u64, seal);
        let network = Network::join(&place, station, waker)?;
        network.set_clock(Clock::live(wall_now()));
        Ok(End { network, woken })
    }

    /// What came until now, waiting at most so long for it.
    fn take(&self, wait: Duration) -> Taken {
        let _ = self.woken.recv_timeout(wait);
        self.network.take()
    }

    fn send(&self, kind: Kind, seq: u64, bytes: Vec<u8>) {
        let is_taken = self.network.offer(Offer {
            kind,
            seq,
            stamp: wall_now(),
            born: steady(),
            bytes: bytes.into(),
        });
        if !is_taken {
            eprintln!("realo: a message of {kind} did not go out: too many wait");
        }
    }
}

/// Sends back what comes, with the time at which it was here.
fn answer(args: &Args) -> Result<Outcome> {
    let end = End::open(args, "listening-end")?;
    eprintln!("realo: answers `realo latency --peer tcp/ADDRESS:PORT --log LOG` until it is stopped");
    loop {
        for event in end.take(Duration::from_millis(100)).events {
            if let Event::Arrived(_, Arrived { kind, seq, bytes, .. }, _) = event {
                let here = wall_now().to_le_bytes();
                end.send(kind, seq, [&here[..], &bytes].concat());
            }
        }
    }
}

/// A message that went there and back, ns.
#[derive(Clone, Copy)]
struct Round {
    there_and_back: Nanos,
    /// By both clocks.
    there: Nanos,
}

/// Median, 95th and 99th of 100, ms.
#[derive(Serialize)]
struct Spread {
    p50: f64,
    p95: f64,
    p99: f64,
}

/// What was found of a kind.
#[derive(Serialize)]
struct Row {
    kind: Kind,
    /// Mean size.
    kilobytes: f64,
    sent: usize,
    came_back: usize,
    half_of_round_trip_ms: Option<Spread>,
    one_way_ms: Option<Spread>,
}

/// What is printed.
#[derive(Serialize)]
struct Found {
    peer: String,
    /// The peer's clock minus this one's, and what that is likely off by.
    clock_ms: f64,
    clock_uncertainty_ms: f64,
    kinds: Vec<Row>,
    trace: PathBuf,
}

fn measure(args: &Args, peer: &Endpoint, log: &Path) -> Result<Outcome> {
    let messages = messages(args, log)?;
    let end = End::open(args, "measuring-end")?;
    let until = Instant::now() + MEETING;
    let known = loop {
        let taken = end.take(Duration::from_millis(100));
        let known = taken
            .reports
            .iter()
            .find_map(|report| Some((report.peer.clone(), report.clock?)));
        if let Some(known) = known {
            break known;
        }
        if Instant::now() > until {
            let mut refused = Refusals::new();
            for (why, count) in taken.reports.iter().flat_map(|report| &report.refused) {
                *refused.entry(*why).or_default() += count;
            }
            bail!("{peer}: {}", why_nobody_answers(&refused, args.key.is_some()));
        }
    };
    let mut asking = Asking {
        end,
        clock: known.1,
        course: Course::default(),
        // Greater than that of an earlier call.
        seq: (wall_now() / 1000) as u64,
    };
    let kinds = messages.iter().map(|(kind, bodies)| asking.circulate(*kind, bodies));
    let found = Found {
        peer: known.0.to_string(),
        kinds: kinds.collect(),
        clock_ms: to_millis(asking.clock.offset),
        clock_uncertainty_ms: to_millis(asking.clock.uncertainty),
        trace: args.output.clone(),
    };
    asking.end.network.leave();
    match args.json {
        true => println!("{}", serde_json::to_string_pretty(&found)?),
        false => found.print(),
    }
    let trace = Phase::trace(&asking.course.close());
    fs::write(&args.output, trace).wrap_err_with(|| format!("{}", args.output.display()))?;
    let is_whole = found.kinds.iter().all(|row| row.came_back == row.sent);
    Ok(if is_whole { Outcome::Complete } else { Outcome::Partial })
}

/// What keeps two ends from meeting, and what to do about it.
fn why_nobody_answers(refused: &Refusals, signs: bool) -> String {
    let Some((most, _)) = refused.iter().max_by_key(|(_, count)| **count) else {
        let trusting = if signs {
            ", with a --trust that has this end's key"
        } else {
            ""
        };
        return format!("nobody answers; run `realo latency --listen tcp/0.0.0.0:PORT` there{trusting}");
    };
    let mend = match most {
        Refusal::Stranger => "the list at --trust has no key of it: `realo keys trust AGENT.pub`",
        Refusal::Unsigned => "it signs nothing: give it --key and --trust too, or take them from this end",
        Refusal::Forged => "the list at --trust has another key of it: `realo keys trust` of the one that it has now",
        Refusal::Replayed | Refusal::Future => "its clock and this one differ by more than 10 s: set them",
        Refusal::Malformed | Refusal::Oversized | Refusal::OtherTimeLine | Refusal::Flood => {
            "is it another version of realo? both ends have to be of one"
        }
    };
    let counts: Vec<String> = refused
        .iter()
        .map(|(why, count)| format!("{count} {}", why.as_str()))
        .collect();
    format!("what comes from there is refused ({}): {mend}", counts.join(", "))
}

/// By kind, what an agent sends in the graphs.
fn messages(args: &Args, log: &Path) -> Result<BTreeMap<Kind, Vec<Vec<u8>>>> {
    if log.ends_with(demo::FILE) && !log.exists() {
        demo::make(log)?;
    }
    let opened = Log::open(log)?;
    if let Some(agent) = &args.agent {
        opened.need_agent(agent)?;
    }
    let names = || opened.info().agents.iter().map(|known| known.name.clone());
    let ego = names().find(|name| Some(name) != args.agent.as_ref());
    let agent = args
        .agent
        .clone()
        .or_else(|| names().find(|name| Some(name) != ego.as_ref()));
    let (Some(ego), Some(agent)) = (ego, agent) else {
        bail!(
            "{}: expected two agents, one that sends and one that it is for",
            log.display()
        );
    };
    let mut messages: BTreeMap<Kind, Vec<Vec<u8>>> = BTreeMap::new();
    for graph in &args.graph {
        eprintln!("realo: what {agent} sends in {}", graph.display());
        let agents = [agent.clone()];
        let lane = run::lane(&precompute::lane_args(graph, log, &ego, &agents, &args.choices))?;
        precompute::compute(&lane, &agents, |header, packet| {
            let all = messages.entry(header.kind).or_default();
            if all.len() < usize::from(args.messages) {
                all.push(body::to_bytes(packet, 0)?.to_vec());
            }
            Ok(())
        })?;
    }
    match messages.is_empty() {
        true => Err(eyre!("{}: {agent} sends nothing in these graphs", log.display())),
        false => Ok(messages),
    }
}

/// The end that asks.
struct Asking {
    end: End,
    clock: Estimate,
    course: Course,
    seq: u64,
}

impl Asking {
    /// Has messages go there and back, one after the other, some more often than once if there are few.
    fn circulate(&mut self, kind: Kind, bodies: &[Vec<u8>]) -> Row {
        let mut rounds = Vec::new();
        for (n, body) in bodies.iter().cycle().take(FIRST + bodies.len()).enumerate() {
            let begun = Instant::now();
            let round = self.round(kind, body);
            if n >= FIRST {
                rounds.extend(round);
            }
            std::thread::sleep((begun + PERIOD).saturating_duration_since(Instant::now()));
        }
        let bytes: usize = bodies.iter().map(Vec::len).sum();
        Row {
            kind,
            kilobytes: bytes as f64 / bodies.len() as f64 / 1e3,
            sent: bodies.len(),
            came_back: rounds.len(),
            half_of_round_trip_ms: spread(rounds.iter().map(|round| round.there_and_back / 2)),
            one_way_ms: spread(rounds.iter().map(|round| round.there)),
        }
    }

    /// Has a message go there and back; `None` if it does not come back.
    fn round(&mut self, kind: Kind, body: &[u8]) -> Option<Round> {
        self.seq += 1;
        let (seq, given, until) = (self.seq, wall_now(), Instant::now() + PATIENCE);
        self.end.send(kind, seq, body.to_vec());
        while let Some(left) = until.checked_duration_since(Instant::now()) {
            let taken = self.end.take(left.min(Duration::from_millis(100)));
            let now = wall_now();
            if let Some(clock) = taken.reports.iter().find_map(|report| report.clock) {
                self.clock = clock;
            }
            let back = taken.events.iter().find_map(|event| match event {
                Event::Arrived(_, message, _) if (message.kind, message.seq) == (kind, seq) => Some(message),
                _ => None,
            });
            let Some(back) = back else { continue };
            let here = Nanos::from_le_bytes(*back.bytes.first_chunk()?) - self.clock.offset;
            self.course.came(
                now,
                &Came {
                    bytes: back.bytes.len(),
                    on_the_way: Some(now - here),
                    took: back.took,
                },
            );
            return Some(Round {
                there_and_back: now - given,
                there: here - given,
            });
        }
        self.course.lost(wall_now(), 1);
        None
    }
}

fn spread(times: impl Iterator<Item = Nanos>) -> Option<Spread> {
    let mut times: Vec<f64> = times.map(to_millis).collect();
    times.sort_by(f64::total_cmp);
    let last = times.len().checked_sub(1)?;
    let at = |share: f64| times[(last as f64 * share).round() as usize];
    Some(Spread {
        p50: at(0.5),
        p95: at(0.95),
        p99: at(0.99),
    })
}

impl Found {
    fn print(&self) {
        let Found {
            peer,
            clock_ms,
            clock_uncertainty_ms,
            kinds,
            trace,
        } = self;
        println!(
            "{peer}: its clock is {clock_ms:.2} ± {clock_uncertainty_ms:.2} ms ahead of this one; ms as p50 / p95 / p99"
        );
        println!(
            "{:<10} {:>9} {:>11}  {:<24} {:<24} the paper, Wi-Fi",
            "", "KB", "came back", "half of the round trip", "one way, by both clocks"
        );
        for row in kinds {
            let of = |spread: &Option<Spread>| match spread {
                Some(Spread { p50, p95, p99 }) => format!("{p50:.1} / {p95:.1} / {p99:.1}"),
                None => "–".into(),
            };
            let paper = PaperTimes::get().message(row.kind);
            println!(
                "{:<10} {:>9.2} {:>11}  {:<24} {:<24} {}",
                row.kind.to_string(),
                row.kilobytes,
                format!("{} of {}", row.came_back, row.sent),
                of(&row.half_of_round_trip_ms),
                of(&row.one_way_ms),
                paper.map_or(String::new(), |Crossing { kilobytes, ms, .. }| format!(
                    "{ms} of {kilobytes} KB"
                )),
            );
        }
        println!(
            "{}: the way from {peer}, a trace for `[channel]` of a link profile",
            trace.display()
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn who_is_not_met_is_reported_what_is_in_the_way() {
        let refused = |all: &[(Refusal, u64)]| all.iter().copied().collect::<Refusals>();
        for (all, signs, expected) in [
            (
                &[][..],
                false,
                "nobody answers; run `realo latency --listen tcp/0.0.0.0:PORT` there",
            ),
            (&[], true, "with a --trust that has this end's key"),
            (
                &[(Refusal::Stranger, 57)],
                true,
                "(57 strangers): the list at --trust has no key of it",
            ),
            (
                &[(Refusal::Malformed, 1), (Refusal::Unsigned, 9)],
                true,
                "(1 malformed, 9 unsigned): it signs nothing",
            ),
            (&[(Refusal::Future, 3)], true, "(3 future): its clock"),
        ] {
            let said = why_nobody_answers(&refused(all), signs);
            assert!(said.contains(expected), "{said}");
        }
    }
}
