//! What two agents on machines of their own make of links and peers that fail.

use std::fmt;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::time::{Duration, Instant};

use eyre::{Result, WrapErr, bail, eyre};
use linkemu::{ADDRESSES, Ground, Link, Machines};
use realo_cli::program::beside;
use realo_cli::{Outcome, Progress};
use realo_clock::wall;
use realo_results::{Fates, read_run};
use realo_schemas::{Kind, Nanos, from_seconds};
use serde::Serialize;

use super::framework::{demo_log, folder};

/// Of a pass of the demo log, s.
const PASS: f64 = 10.0;
/// Sweeps of an agent a second.
const RATE: f64 = 10.0;
/// What it takes at most until the players of both graphs are asked for their first message, s.
const STARTUP: f64 = 10.0;
/// Until something happens, from when both graphs begin to play.
const LATER: Duration = Duration::from_secs(3);
/// A run takes so long at most.
const LONGEST: Duration = Duration::from_secs(120);
/// What the link carried counts over so many looks at it.
const LOOKS: usize = 10;
const LOOK: Duration = Duration::from_millis(500);
/// Fused may be worse than the ego alone by so much, of mAP.
const WORSE: f64 = 0.02;
/// The radio may take so much memory, MB.
const MOST_MEMORY: f64 = 250.0;
/// What a fault says is offered may be off by this share.
const OFF: f64 = 0.05;

/// All faults.
#[derive(Serialize)]
pub struct Faults {
    /// mAP of the ego alone at IoU 0.3 and 0.5, of the strategies below.
    alone: [f64; 2],
    passes: u32,
    rows: Vec<Row>,
}

/// What became of the vehicle's run.
#[derive(Default, Serialize)]
struct Row {
    fault: String,
    /// Frames of the ego that gave boxes, of those that it had.
    frames: [u64; 2],
    /// What the roadside unit gave its radio while it played, Mbit/s.
    offered: Option<f64>,
    /// What the link carried from there at most, over 5 s, Mbit/s.
    carried: f64,
    sent: u64,
    /// What became of it, beside what was lost.
    fates: Fates,
    lost: u64,
    /// What the vehicle refused, of messages, frames and questions.
    refused: u64,
    /// `None`: there are no books.
    unaccounted: Option<i64>,
    /// Age of what was used, ms: median and 95 %.
    age_ms: Option<[f64; 2]>,
    /// The roadside unit's clock minus the vehicle's, as the vehicle found it at the end, ms.
    clock_ms: Option<f64>,
    /// mAP at IoU 0.3 and 0.5.
    accuracy: Option<[f64; 2]>,
    /// Largest resident memory of the vehicle's radio, MB.
    memory_mb: f64,
    /// Where it is not as it must be.
    broken: Vec<String>,
}

/// The graphs' machines.
#[derive(Clone, Copy, PartialEq)]
enum Side {
    Vehicle = 0,
    Roadside = 1,
}

/// Something that happens while both graphs play.
#[derive(Clone, Copy)]
enum Event {
    Set(&'static str, f64),
    /// The machine's wall clock is set so many ms ahead of the true one.
    Clock(Side, f64),
    Kill(Side),
    /// With further settings.
    Start(Side, &'static [&'static str]),
}

/// One of the faults.
struct Fault {
    name: &'static str,
    graph: &'static str,
    /// From the beginning on.
    link: &'static [(&'static str, f64)],
    /// Each so much later than the one before.
    events: &'static [(Duration, Event)],
    /// Settings of both graphs, and of the roadside unit's alone.
    set: [&'static [&'static str]; 2],
    /// Whether both sign what they send.
    signed: bool,
    /// What the roadside unit offers, Mbit/s, where the name says so.
    offers: Option<f64>,
}

const CALM: Fault = Fault {
    name: "none",
    graph: "late_fusion",
    link: &[],
    events: &[],
    set: [&[], &[]],
    signed: false,
    offers: None,
};

const ROADSIDE_KILLED: &[(Duration, Event)] = &[
    (LATER, Event::Kill(Side::Roadside)),
    (Duration::from_secs(2), Event::Start(Side::Roadside, &[])),
];

const FAULTS: &[Fault] = &[
    CALM,
    Fault {
        name: "1 % of packets lost",
        link: &[("loss", 0.01)],
        ..CALM
    },
    Fault {
        name: "10 % lost",
        link: &[("loss", 0.1)],
        ..CALM
    },
    Fault {
        name: "50 % lost",
        link: &[("loss", 0.5)],
        ..CALM
    },
    Fault {
        name: "jitter of 60 ms, reordering",
        link: &[("jitter", 60.0)],
        ..CALM
    },
    Fault {
        name: "10 % of packets twice",
        link: &[("duplicate", 0.1)],
        ..CALM
    },
    Fault {
        name: "cut for 5 s",
        events: &[
            (LATER, Event::Set("cut", 1.0)),
            (Duration::from_secs(5), Event::Set("cut", 0.0)),
        ],
        ..CALM
    },
    Fault {
        name: "roadside unit killed, back after 2 s",
        events: ROADSIDE_KILLED,
        ..CALM
    },
    Fault {
        name: "vehicle killed, back after 2 s",
        events: &[
            (LATER, Event::Kill(Side::Vehicle)),
            (Duration::from_secs(2), Event::Start(Side::Vehicle, &[])),
        ],
        ..CALM
    },
    Fault {
        name: "10 % lost, signed",
        link: &[("loss", 0.1)],
        signed: true,
        ..CALM
    },
    Fault {
        name: "roadside unit killed, back after 2 s, signed",
        events: ROADSIDE_KILLED,
        signed: true,
        ..CALM
    },
    Fault {
        name: "roadside unit's clock 200 ms ahead",
        set: [&[], &["player.skew_ms=200"]],
        ..CALM
    },
    Fault {
        name: "roadside unit's clock 2 s behind",
        set: [&[], &["player.skew_ms=-2000"]],
        ..CALM
    },
    Fault {
        name: "roadside unit's clock set 200 ms ahead, then 200 ms behind",
        events: &[
            (LATER, Event::Clock(Side::Roadside, 200.0)),
            (Duration::from_secs(4), Event::Clock(Side::Roadside, -200.0)),
        ],
        ..CALM
    },
    Fault {
        name: "vehicle's clock set 200 ms ahead, then 200 ms behind",
        events: &[
            (LATER, Event::Clock(Side::Vehicle, 200.0)),
            (Duration::from_secs(4), Event::Clock(Side::Vehicle, -200.0)),
        ],
        ..CALM
    },
    Fault {
        name: "vehicle's clock set an hour back",
        events: &[(LATER, Event::Clock(Side::Vehicle, -3_600_000.0))],
        ..CALM
    },
    Fault {
        name: "roadside unit killed, back after 2 s with its clock 200 ms ahead",
        events: &[
            (LATER, Event::Kill(Side::Roadside)),
            (
                Duration::from_secs(2),
                Event::Start(Side::Roadside, &["player.skew_ms=200"]),
            ),
        ],
        ..CALM
    },
    Fault {
        name: "33 Mbit/s of clouds offered to 27",
        graph: "early_fusion",
        // A fifth of a millimetre.
        set: [&["ego.sender.step_m=0.0002"], &[]],
        offers: Some(33.0),
        ..CALM
    },
    Fault {
        name: "64 Mbit/s of clouds offered to 27",
        graph: "early_fusion",
        // A micrometre, hardly compressed.
        set: [&["ego.sender.step_m=0.000001", "ego.sender.zstd=-7"], &[]],
        offers: Some(64.0),
        ..CALM
    },
];

/// Runs the faults whose names have `only` in them, in passes of the log: 27 Mbit/s, 20 ms, BBR. With the boxes that the log
/// recorded where `recorded`, with those of the network otherwise.
pub fn bench(seconds: f64, only: &str, recorded: bool, progress: &Progress) -> Result<Faults> {
    let chosen: Vec<&Fault> = FAULTS.iter().filter(|fault| fault.name.contains(only)).collect();
    let Some(first) = chosen.first() else {
        let known: Vec<&str> = FAULTS.iter().map(|fault| fault.name).collect();
        bail!("--only {only}: no fault is named so; there are: {}", known.join("; "));
    };
    let detections: &[&str] = if recorded { &["--recorded-detections"] } else { &[] };
    let passes = (seconds / PASS).ceil().max(1.0) as u32;
    // While this process has one thread.
    Ground::find()
        .wrap_err("packets are lost and processes are told apart in namespaces alone: run it as root, on Linux")?;
    let (log, folder) = (demo_log()?, folder()?.join("faults"));
    // Another bench beside this one has other faults, and so another folder.
    let out = folder_of(first, &folder).join("alone");
    let program = beside("realo")?;
    let mut alone = Command::new(&program);
    alone.args([
        "run",
        "dataflows/no_fusion.yml",
        "--mode",
        "virtual",
        "--ego",
        "cav1",
        "--log",
    ]);
    let output = alone
        .arg(&log)
        .arg("--out")
        .arg(&out)
        .args(detections)
        .stdin(Stdio::null())
        .output()?;
    if !output.status.success() {
        bail!("the ego alone: {}", String::from_utf8_lossy(&output.stderr).trim());
    }
    let Some(alone) = accuracy(&out)? else {
        bail!("{}: the log has no ground truth", log.display());
    };
    progress.count("faults", chosen.len() as f64);
    let row = |fault: &Fault| {
        let found = run(fault, passes, detections, &log, &folder);
        progress.add(1.0);
        match found {
            Ok(row) => row.checked(fault, passes, alone),
            Err(error) => Row::failed(fault, &error),
        }
    };
    let rows = chosen.into_iter().map(row).collect();
    Ok(Faults { alone, passes, rows })
}

impl Faults {
    /// Says where a row is not as it must be.
    pub fn check(&self) -> Outcome {
        let broken = self.rows.iter().filter(|row| !row.broken.is_empty());
        let lines: Vec<String> = broken
            .map(|row| format!("{}: {}", row.fault, row.broken.join("; ")))
            .collect();
        lines.iter().for_each(|line| eprintln!("realo-lab: {line}"));
        if lines.is_empty() {
            Outcome::Complete
        } else {
            Outcome::Failed
        }
    }
}

impl Row {
    /// Of a run that came to no end, or to a bad one.
    fn failed(fault: &Fault, error: &eyre::Report) -> Row {
        Row {
            fault: fault.name.into(),
            broken: vec![format!("{error:#}")],
            ..Row::default()
        }
    }

    fn checked(mut self, fault: &Fault, passes: u32, alone: [f64; 2]) -> Row {
        let mut broken = Vec::new();
        let ([processed, of], all) = (self.frames, (f64::from(passes) * PASS * RATE) as u64);
        if processed != of || of != all {
            broken.push(format!(
                "expected all {all} of the ego's frames, found {processed} of {of}"
            ));
        }
        match self.unaccounted {
            Some(0) => {}
            Some(unaccounted) => broken.push(format!("the books do not add up: {unaccounted} unaccounted")),
            None => broken.push("expected books of what the roadside unit sent, found none".into()),
        }
        if self.refused > 0 || self.fates.rejected > 0 {
            let (refused, rejected) = (self.refused, self.fates.rejected);
            broken.push(format!(
                "expected nothing refused, found {refused}, and {rejected} messages rejected"
            ));
        }
        let worse = |found: [f64; 2]| found.iter().zip(&alone).any(|(found, alone)| *found < alone - WORSE);
        if self.accuracy.is_none_or(worse) {
            broken.push(format!(
                "expected mAP below that of the ego alone, {}, by {WORSE} at most, found {}",
                pair(Some(alone), 3),
                pair(self.accuracy, 3)
            ));
        }
        if !(0.0 < self.memory_mb && self.memory_mb < MOST_MEMORY) {
            broken.push(format!(
                "expected a radio below {MOST_MEMORY} MB, found {:.0}",
                self.memory_mb
            ));
        }
        if let Some(offers) = fault.offers
            && !self.offered.is_some_and(|offered| (offered / offers - 1.0).abs() < OFF)
        {
            broken.push(format!(
                "expected {offers} Mbit/s offered, found {}",
                number(self.offered, 1)
            ));
        }
        self.broken = broken;
        self
    }
}

/// Two graphs, and what runs them.
struct Stage<'a> {
    fault: &'a Fault,
    passes: u32,
    detections: &'a [&'a str],
    machines: Machines,
    log: &'a Path,
    folder: PathBuf,
}

impl Stage<'_> {
    fn out(&self, side: Side) -> PathBuf {
        self.folder.join(name(side))
    }

    /// What its run complains of.
    fn said(&self, side: Side) -> PathBuf {
        self.folder.join(format!("{}.txt", name(side)))
    }

    fn start(&self, side: Side, more: &[&str]) -> Result<Child> {
        let Fault { graph, set, signed, .. } = self.fault;
        let mut command = self.machines.command(side as usize, beside("realo")?);
        command.args(["run", &format!("dataflows/{graph}.{}.yml", name(side))]);
        command
            .arg("--log")
            .arg(self.log)
            .arg("--out")
            .arg(self.out(side))
            .args(self.detections);
        // A roadside unit plays until it is stopped.
        let passes = if side == Side::Vehicle { self.passes } else { 100 };
        let mut settings = vec![format!("player.repeat={passes}"), "log.points=false".into()];
        settings.extend(set[0].iter().map(|set| set.to_string()));
        if side == Side::Roadside {
            settings.push(format!("v2x.connect=tcp/{}:7447", ADDRESSES[Side::Vehicle as usize]));
            settings.extend(set[1].iter().map(|set| set.to_string()));
        }
        if *signed {
            settings.push(format!("v2x.key={}", self.folder.join(key_of(side)).display()));
            settings.push(format!("v2x.trust={}", self.folder.join(TRUST).display()));
        }
        settings.extend(more.iter().map(|set| set.to_string()));
        settings.iter().for_each(|set| {
            command.args(["--set", set]);
        });
        std::fs::create_dir_all(&self.folder)?;
        let said = std::fs::File::create(self.said(side))?;
        let command = command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(said);
        Ok(command.process_group(0).spawn()?)
    }
}

impl Drop for Stage<'_> {
    /// Graphs do not outlive their machines.
    fn drop(&mut self) {
        for side in [Side::Vehicle, Side::Roadside] {
            let _ = self.machines.kill(side as usize);
        }
    }
}

fn name(side: Side) -> &'static str {
    match side {
        Side::Vehicle => "vehicle",
        Side::Roadside => "roadside",
    }
}

fn agent(side: Side) -> &'static str {
    match side {
        Side::Vehicle => "cav1",
        Side::Roadside => "rsu1",
    }
}

/// Whom both believe.
const TRUST: &str = "trust.toml";

fn key_of(side: Side) -> String {
    format!("{}.key", agent(side))
}

/// Makes the keys of both, as on two machines.
fn make_keys(folder: &Path) -> Result<()> {
    let _ = std::fs::remove_dir_all(folder);
    std::fs::create_dir_all(folder)?;
    let keys = |args: &[&str]| -> Result<()> {
        let mut command = Command::new(beside("realo")?);
        let output = command.arg("keys").args(args).current_dir(folder).output()?;
        match output.status.success() {
            true => Ok(()),
            false => bail!("realo keys: {}", String::from_utf8_lossy(&output.stderr).trim()),
        }
    };
    for side in [Side::Vehicle, Side::Roadside] {
        keys(&["new", agent(side)])?;
        keys(&["trust", &format!("{}.pub", agent(side)), "--list", TRUST])?;
    }
    Ok(())
}

/// Where a fault's runs lie.
fn folder_of(fault: &Fault, all: &Path) -> PathBuf {
    all.join(fault.name.replace([' ', '%', ',', '\'', '/'], "_"))
}

fn run(fault: &Fault, passes: u32, detections: &[&str], log: &Path, folder: &Path) -> Result<Row> {
    let folder = folder_of(fault, folder);
    if fault.signed {
        make_keys(&folder)?;
    }
    let (machines, link) = super::radio::machines(fault.link, "bbr")?;
    let stage = Stage {
        fault,
        passes,
        detections,
        machines,
        log,
        folder,
    };
    let _ = std::fs::remove_dir_all(stage.out(Side::Vehicle));
    let over = AtomicBool::new(false);
    let (played, watched) = std::thread::scope(|scope| {
        let watch = scope.spawn(|| watch(&stage.machines, &link, &over));
        let played = play(&stage, &link);
        over.store(true, Relaxed);
        (played, watch.join())
    });
    played?;
    let watched = watched.map_err(|_| eyre!("nobody watched the link"))?;
    row(fault, &stage.out(Side::Vehicle), &watched)
}

/// Both graphs, from start to end, and what happens to them.
fn play(stage: &Stage, link: &Link) -> Result<()> {
    let [mut at, _] =
        realo_player::next_pass(stage.log, wall() + from_seconds(STARTUP)).map_err(|error| eyre!("{error}"))?;
    // Every run has its fault at the same place of the log.
    wait_until(at - from_seconds(STARTUP) - realo_player::LEAD);
    let mut children = [stage.start(Side::Vehicle, &[])?, stage.start(Side::Roadside, &[])?];
    for (after, event) in stage.fault.events {
        at += after.as_nanos() as Nanos;
        wait_until(at);
        match *event {
            Event::Set(what, value) => drop(link.set(what, value)),
            Event::Clock(side, ms) => stage.machines.set_clock(side as usize, ms)?,
            Event::Kill(side) => {
                stage.machines.kill(side as usize)?;
                let _ = children[side as usize].wait();
            }
            Event::Start(side, more) => children[side as usize] = stage.start(side, more)?,
        }
    }
    let [vehicle, roadside] = &mut children;
    let begun = Instant::now();
    let status = loop {
        if let Some(status) = vehicle.try_wait()? {
            break status;
        }
        if begun.elapsed() > LONGEST {
            stage.machines.kill(Side::Vehicle as usize)?;
        }
        std::thread::sleep(Duration::from_millis(200));
    };
    stage.machines.kill(Side::Roadside as usize)?;
    roadside.wait()?;
    if !status.success() {
        let said = std::fs::read_to_string(stage.said(Side::Vehicle)).unwrap_or_default();
        bail!("the vehicle's run ended with {status}: {}", said.trim());
    }
    Ok(())
}

fn wait_until(at: Nanos) {
    let left = u64::try_from(at - wall()).unwrap_or(0);
    std::thread::sleep(Duration::from_nanos(left));
}

/// What was seen of a run.
struct Watched {
    /// Largest resident memory of the vehicle's radio, bytes.
    memory: u64,
    /// Most that the link carried to the vehicle over some looks, bits/s.
    carried: f64,
}

fn watch(machines: &Machines, link: &Link, over: &AtomicBool) -> Watched {
    let (mut memory, mut looks, mut carried) = (0, Vec::new(), 0.0_f64);
    while !over.load(Relaxed) {
        memory = memory.max(machines.memory_of(Side::Vehicle as usize, "radio"));
        let bytes = link.counts()[Side::Roadside as usize].bytes;
        looks.push((Instant::now(), bytes));
        if let Some((then, before)) = looks.len().checked_sub(LOOKS + 1).map(|at| looks[at]) {
            carried = carried.max(8.0 * (bytes - before) as f64 / then.elapsed().as_secs_f64());
        }
        std::thread::sleep(LOOK);
    }
    Watched { memory, carried }
}

fn row(fault: &Fault, out: &Path, watched: &Watched) -> Result<Row> {
    let result = read_run(out)?.result;
    let kind = if fault.graph == "early_fusion" {
        Kind::Points
    } else {
        Kind::Boxes
    };
    let [vehicle, roadside] = [Side::Vehicle, Side::Roadside].map(agent);
    let books = result
        .links
        .get(&format!("{roadside}-{vehicle}"))
        .and_then(|link| link.get(kind.as_str()));
    let accounted = books.and_then(|books| books.accounted);
    let age = result.age_ms.by_kind.get(kind.as_str());
    let peer = result.peers.iter().find(|peer| peer.name == roadside);
    let offered = books.filter(|books| books.sent > 0);
    Ok(Row {
        fault: fault.name.into(),
        frames: [result.frames.processed, result.frames.total],
        offered: offered.map(|books| 8e-6 * RATE * books.bytes as f64 / books.sent as f64),
        carried: watched.carried * 1e-6,
        sent: books.map_or(0, |books| books.sent),
        fates: accounted.map_or(Fates::default(), |accounted| accounted.fates),
        lost: books.map_or(0, |books| books.lost),
        refused: result.peers.iter().flat_map(|peer| peer.refused.values()).sum(),
        unaccounted: accounted.map(|accounted| accounted.unaccounted),
        age_ms: age.and_then(|age| Some([age.p50?, age.p95?])),
        clock_ms: peer.and_then(|peer| peer.clock_ms),
        accuracy: accuracy(out)?,
        memory_mb: watched.memory as f64 * 1e-6,
        broken: Vec::new(),
    })
}

/// mAP at IoU 0.3 and 0.5.
fn accuracy(out: &Path) -> Result<Option<[f64; 2]>> {
    let accuracy = read_run(out)?.result.accuracy;
    let of = |iou: &str| accuracy.as_ref()?.sorted.mean_ap.get(iou).copied().flatten();
    Ok(of("0.3").zip(of("0.5")).map(|(one, other)| [one, other]))
}

fn pair(numbers: Option<[f64; 2]>, digits: usize) -> String {
    match numbers {
        Some([one, other]) => format!("{one:.digits$} / {other:.digits$}"),
        None => "–".into(),
    }
}

fn number(number: Option<f64>, digits: usize) -> String {
    number.map_or("–".into(), |number| format!("{number:.digits$}"))
}

impl fmt::Display for Faults {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        writeln!(
            f,
            "| fault (27 Mbit/s, 20 ms, BBR; {} s) | ego's frames | offered, Mbit/s | carried | sent | used | lost | refused | \
             unaccounted | age, ms, p50 / p95 | clock, ms | mAP at IoU 0.3 / 0.5 | radio, MB |\n\
             |---|---|---|---|---|---|---|---|---|---|---|---|---|",
            f64::from(self.passes) * PASS
        )?;
        for row in &self.rows {
            writeln!(
                f,
                "| {} | {} of {} | {} | {:.1} | {} | {} | {} | {} | {} | {} | {} | {} | {:.0} |",
                row.fault,
                row.frames[0],
                row.frames[1],
                number(row.offered, 1),
                row.carried,
                row.sent,
                row.fates.used,
                row.lost,
                row.refused + row.fates.rejected,
                number(row.unaccounted.map(|unaccounted| unaccounted as f64), 0),
                pair(row.age_ms, 0),
                number(row.clock_ms, 0),
                pair(row.accuracy, 3),
                row.memory_mb
            )?;
        }
        write!(f, "the ego alone: {}", pair(Some(self.alone), 3))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const ALONE: [f64; 2] = [0.8, 0.7];

    /// A run of two passes in which all is as it must be.
    fn good() -> Row {
        Row {
            fault: "none".into(),
            frames: [200, 200],
            offered: Some(64.5),
            carried: 20.0,
            sent: 200,
            fates: Fates {
                used: 199,
                ..Fates::default()
            },
            lost: 1,
            refused: 0,
            unaccounted: Some(0),
            age_ms: None,
            clock_ms: None,
            accuracy: Some([0.781, 0.9]),
            memory_mb: 100.0,
            broken: Vec::new(),
        }
    }

    fn faults(row: Row) -> Faults {
        let fault = Fault {
            offers: Some(64.0),
            ..CALM
        };
        Faults {
            alone: ALONE,
            passes: 2,
            rows: vec![row.checked(&fault, 2, ALONE)],
        }
    }

    #[test]
    fn a_bench_in_which_all_is_as_it_must_be_succeeds() {
        let found = faults(good());
        assert_eq!(found.rows[0].broken, Vec::<String>::new());
        assert_eq!(found.check(), Outcome::Complete);
    }

    #[test]
    fn a_condition_that_is_not_met_is_named_and_fails_the_bench() {
        type Breaks = fn(&mut Row);
        let broken: [(Breaks, &str); 11] = [
            (
                |row| row.frames[0] = 199,
                "all 200 of the ego's frames, found 199 of 200",
            ),
            (|row| row.frames = [100, 100], "found 100 of 100"),
            (|row| row.unaccounted = Some(-1), "-1 unaccounted"),
            (|row| row.unaccounted = None, "expected books"),
            (|row| row.refused = 2, "expected nothing refused, found 2"),
            (|row| row.fates.rejected = 3, "and 3 messages rejected"),
            (
                |row| row.accuracy = Some([0.779, 0.9]),
                "0.800 / 0.700, by 0.02 at most, found 0.779 / 0.900",
            ),
            (|row| row.accuracy = Some([0.9, 0.679]), "found 0.900 / 0.679"),
            (|row| row.accuracy = None, "found –"),
            (|row| row.memory_mb = 251.0, "below 250 MB, found 251"),
            (|row| row.offered = Some(60.0), "64 Mbit/s offered, found 60.0"),
        ];
        for (breaks, expected) in broken {
            let mut row = good();
            breaks(&mut row);
            let found = faults(row);
            assert!(
                found.rows[0].broken.iter().any(|text| text.contains(expected)),
                "{expected}"
            );
            assert_eq!(found.check(), Outcome::Failed, "{expected}");
        }
    }

    #[test]
    fn a_radio_whose_memory_was_never_seen_is_none_whose_memory_is_bounded() {
        let found = faults(Row {
            memory_mb: 0.0,
            ..good()
        });
        assert_eq!(found.rows[0].broken.len(), 1);
    }
}
