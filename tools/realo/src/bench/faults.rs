//! What two agents on machines of their own make of links and peers that fail.

use std::fmt;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use eyre::{Result, WrapErr, bail};
use linkemu::{ADDRESSES, Ground, Machines};
use realo_results::read_run;
use realo_schemas::Kind;
use serde::Serialize;

use super::framework::{demo_log, folder};

/// Of a pass of the demo log, s.
const PASS: f64 = 10.0;
/// From the start of both graphs until something happens: both play by then.
const LATER: Duration = Duration::from_secs(17);
/// A run takes so long at most.
const LONGEST: Duration = Duration::from_secs(120);

/// All faults.
#[derive(Serialize)]
pub struct Faults {
    /// mAP of the ego alone at IoU 0.3 and 0.5, of the strategies below.
    alone: [f64; 2],
    passes: u32,
    rows: Vec<Row>,
}

/// What became of the vehicle's run.
#[derive(Serialize)]
struct Row {
    fault: String,
    /// Frames of the ego that gave boxes, of those that it had.
    frames: [u64; 2],
    sent: u64,
    used: u64,
    lost: u64,
    unaccounted: i64,
    /// Age of what was used, ms: median and 95 %.
    age_ms: Option<[f64; 2]>,
    /// mAP at IoU 0.3 and 0.5.
    accuracy: Option<[f64; 2]>,
    /// Greatest resident memory of the vehicle's radio, MB.
    memory_mb: f64,
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
    Kill(Side),
    Start(Side),
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
}

const CALM: Fault = Fault {
    name: "none",
    graph: "late_fusion",
    link: &[],
    events: &[],
    set: [&[], &[]],
};

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
        name: "cut for 5 s",
        events: &[
            (LATER, Event::Set("cut", 1.0)),
            (Duration::from_secs(5), Event::Set("cut", 0.0)),
        ],
        ..CALM
    },
    Fault {
        name: "roadside unit killed, back after 2 s",
        events: &[
            (LATER, Event::Kill(Side::Roadside)),
            (Duration::from_secs(2), Event::Start(Side::Roadside)),
        ],
        ..CALM
    },
    Fault {
        name: "vehicle killed, back after 2 s",
        events: &[
            (LATER, Event::Kill(Side::Vehicle)),
            (Duration::from_secs(2), Event::Start(Side::Vehicle)),
        ],
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
        name: "33 Mbit/s of clouds offered to 27",
        graph: "early_fusion",
        // A fifth of a millimetre.
        set: [&["ego.sender.step_m=0.0002"], &[]],
        ..CALM
    },
];

/// Runs the faults whose names have `only` in them, in passes of the log: 27 Mbit/s, 20 ms, BBR.
pub fn bench(seconds: f64, only: &str) -> Result<Faults> {
    let chosen: Vec<&Fault> = FAULTS.iter().filter(|fault| fault.name.contains(only)).collect();
    if chosen.is_empty() {
        let known: Vec<&str> = FAULTS.iter().map(|fault| fault.name).collect();
        bail!("--only {only}: no fault is named so; there are: {}", known.join("; "));
    }
    let passes = (seconds / PASS).ceil().max(1.0) as u32;
    // While this process has one thread.
    Ground::find()
        .wrap_err("packets are lost and processes are told apart in namespaces alone: run it as root, on Linux")?;
    let (log, folder) = (demo_log()?, folder()?.join("faults"));
    let out = folder.join("alone");
    let program = std::env::current_exe()?;
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
    let output = alone.arg(&log).arg("--out").arg(&out).stdin(Stdio::null()).output()?;
    if !output.status.success() {
        bail!("the ego alone: {}", String::from_utf8_lossy(&output.stderr).trim());
    }
    let Some(alone) = accuracy(&out)? else {
        bail!("{}: the log has no ground truth", log.display());
    };
    let rows = chosen
        .into_iter()
        .map(|fault| run(fault, passes, &log, &folder))
        .collect::<Result<_>>()?;
    Ok(Faults { alone, passes, rows })
}

/// Two graphs, and what runs them.
struct Stage<'a> {
    fault: &'a Fault,
    passes: u32,
    machines: Machines,
    log: &'a Path,
    folder: PathBuf,
}

impl Stage<'_> {
    fn out(&self, side: Side) -> PathBuf {
        self.folder.join(name(side))
    }

    fn start(&self, side: Side) -> Result<Child> {
        let Fault { graph, set, .. } = self.fault;
        let mut command = self.machines.command(side as usize, std::env::current_exe()?);
        command.args(["run", &format!("dataflows/{graph}.{}.yml", name(side))]);
        command.arg("--log").arg(self.log).arg("--out").arg(self.out(side));
        // A roadside unit plays until it is stopped.
        let passes = if side == Side::Vehicle { self.passes } else { 100 };
        let mut settings = vec![format!("player.repeat={passes}"), "log.points=false".into()];
        settings.extend(set[0].iter().map(|set| set.to_string()));
        if side == Side::Roadside {
            settings.push(format!("v2x.connect=tcp/{}:7447", ADDRESSES[Side::Vehicle as usize]));
            settings.extend(set[1].iter().map(|set| set.to_string()));
        }
        settings.iter().for_each(|set| {
            command.args(["--set", set]);
        });
        let command = command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
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

fn run(fault: &Fault, passes: u32, log: &Path, folder: &Path) -> Result<Row> {
    let (machines, link) = super::radio::machines(fault.link, "bbr")?;
    let stage = Stage {
        fault,
        passes,
        machines,
        log,
        folder: folder.join(fault.name.replace([' ', '%', ',', '\'', '/'], "_")),
    };
    let _ = std::fs::remove_dir_all(stage.out(Side::Vehicle));
    let mut children = [stage.start(Side::Vehicle)?, stage.start(Side::Roadside)?];
    for (after, event) in fault.events {
        std::thread::sleep(*after);
        match *event {
            Event::Set(what, value) => drop(link.set(what, value)),
            Event::Kill(side) => {
                stage.machines.kill(side as usize)?;
                let _ = children[side as usize].wait();
            }
            Event::Start(side) => children[side as usize] = stage.start(side)?,
        }
    }
    let [vehicle, roadside] = &mut children;
    let (begun, mut memory) = (Instant::now(), 0);
    let status = loop {
        if let Some(status) = vehicle.try_wait()? {
            break status;
        }
        memory = memory.max(stage.machines.memory_of(Side::Vehicle as usize, "radio"));
        if begun.elapsed() > LONGEST {
            stage.machines.kill(Side::Vehicle as usize)?;
        }
        std::thread::sleep(Duration::from_millis(200));
    };
    stage.machines.kill(Side::Roadside as usize)?;
    roadside.wait()?;
    if !status.success() {
        bail!("{}: the vehicle's run ended with {status}", fault.name);
    }
    row(fault, &stage.out(Side::Vehicle), memory)
}

fn row(fault: &Fault, out: &Path, memory: u64) -> Result<Row> {
    let result = read_run(out)?.result;
    let kind = if fault.graph == "early_fusion" {
        Kind::Points
    } else {
        Kind::Boxes
    };
    let books = result
        .links
        .get("rsu1-cav1")
        .and_then(|link| link.get(&kind.to_string()));
    let accounted = books.and_then(|books| books.accounted);
    let age = result.age_ms.by_kind.get(kind.as_str());
    Ok(Row {
        fault: fault.name.into(),
        frames: [result.frames.processed, result.frames.total],
        sent: books.map_or(0, |books| books.sent),
        used: accounted.map_or(0, |accounted| accounted.fates.used),
        lost: books.map_or(0, |books| books.lost),
        unaccounted: accounted.map_or(0, |accounted| accounted.unaccounted),
        age_ms: age.and_then(|age| Some([age.p50?, age.p95?])),
        accuracy: accuracy(out)?,
        memory_mb: memory as f64 * 1e-6,
    })
}

/// mAP at IoU 0.3 and 0.5.
fn accuracy(out: &Path) -> Result<Option<[f64; 2]>> {
    let accuracy = read_run(out)?.result.accuracy;
    let of = |iou: &str| accuracy.as_ref()?.sorted.mean_ap.get(iou).copied().flatten();
    Ok(of("0.3").zip(of("0.5")).map(|(one, other)| [one, other]))
}

impl fmt::Display for Faults {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        writeln!(
            f,
            "| fault (27 Mbit/s, 20 ms, BBR; {} s) | ego's frames | sent | used | lost | unaccounted | age, ms, p50 / p95 | \
             mAP at IoU 0.3 / 0.5 | radio, MB |\n|---|---|---|---|---|---|---|---|---|",
            f64::from(self.passes) * PASS
        )?;
        let pair = |numbers: Option<[f64; 2]>, digits: usize| match numbers {
            Some([one, other]) => format!("{one:.digits$} / {other:.digits$}"),
            None => "–".into(),
        };
        for row in &self.rows {
            writeln!(
                f,
                "| {} | {} of {} | {} | {} | {} | {} | {} | {} | {:.0} |",
                row.fault,
                row.frames[0],
                row.frames[1],
                row.sent,
                row.used,
                row.lost,
                row.unaccounted,
                pair(row.age_ms, 0),
                pair(row.accuracy, 3),
                row.memory_mb
            )?;
        }
        write!(f, "the ego alone: {}", pair(Some(self.alone), 3))
    }
}
