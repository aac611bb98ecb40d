use std::fmt;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use eyre::{Result, WrapErr, bail, eyre};
use realo_cli::program::beside;
use realo_cli::{Progress, demo};
use realo_logs::{Log, LogInfo, LogWriter, Stream};
use realo_schemas::{Nanos, from_seconds};
use realo_simulator::Options;
use serde::Serialize;

/// Numbers of agents that are measured.
const SIZES: [usize; 3] = [2, 4, 8];

/// What the graph itself costs in realtime.
#[derive(Serialize)]
pub struct Framework {
    /// A run of late fusion for each number of agents.
    runs: Vec<Measured>,
}

/// One realtime run; times in ms from the sweep's last point to fused boxes, modelled link time taken out.
#[derive(Serialize)]
struct Measured {
    agents: usize,
    p50: f64,
    p95: f64,
    p99: f64,
    /// Achieved rate of fused frames.
    rate_hz: f64,
    /// Messages that dora lost.
    transport_lost: u64,
}

/// Runs late fusion of recorded detections in realtime at 10 Hz with 2, 4 and 8 agents, clouds included.
pub fn bench(seconds: f64, progress: &Progress) -> Result<Framework> {
    let folder = folder()?;
    let demo = demo_log()?;
    let mut runs = Vec::new();
    progress.count("sizes", SIZES.len() as f64);
    for agents in SIZES {
        let log = folder.join(format!("agents_{agents}.mcap"));
        clone_agents(&demo, &log, agents, seconds)?;
        let out = folder.join(format!("agents_{agents}"));
        let output = Command::new(beside("realo")?)
            .args([
                "run",
                "dataflows/late_fusion.yml",
                "--recorded-detections",
                "--ego",
                "cav1",
                "--log",
            ])
            .arg(&log)
            .arg("--out")
            .arg(&out)
            .stdin(Stdio::null())
            .output()?;
        if !output.status.success() {
            bail!(
                "the run with {agents} agents failed: {}",
                String::from_utf8_lossy(&output.stderr)
            );
        }
        let run = realo_results::read_run(&out)?;
        let framework = run.timing.latency_ms.get("framework");
        let of = |pick: fn(&realo_results::Spread) -> Option<f64>| {
            framework
                .and_then(pick)
                .ok_or_else(|| eyre!("the run with {agents} agents has no latency"))
        };
        runs.push(Measured {
            agents,
            p50: of(|spread| spread.p50)?,
            p95: of(|spread| spread.p95)?,
            p99: of(|spread| spread.p99)?,
            rate_hz: run.timing.rate_hz.unwrap_or(0.0),
            transport_lost: run.result.transport.total_lost,
        });
        progress.add(1.0);
    }
    Ok(Framework { runs })
}

/// Where benches keep what they make.
pub(super) fn folder() -> Result<PathBuf> {
    let folder = std::path::absolute("target/realo/bench")?;
    std::fs::create_dir_all(&folder).wrap_err_with(|| format!("{}", folder.display()))?;
    Ok(folder)
}

/// The demo log, made if it is missing.
pub(super) fn demo_log() -> Result<PathBuf> {
    let path = std::path::absolute(Path::new("target").join(demo::FILE))?;
    demo::make(&path, |path| crate::simulate::write(&Options::demo(), path))?;
    Ok(path)
}

/// Writes the first `seconds` of a log with `agents` agents: its own, then copies of its last one.
pub(super) fn clone_agents(from: &Path, to: &Path, agents: usize, seconds: f64) -> Result<()> {
    let log = Log::open(from)?;
    let known = &log.info().agents;
    let last = known.last().ok_or_else(|| eyre!("{}: no agents", from.display()))?;
    let mut info = LogInfo::new(format!("{} (agents copied for a bench)", log.info().source), Vec::new());
    info.agents.extend(known.iter().take(agents).cloned());
    for copy in known.len()..agents {
        let mut agent = last.clone();
        agent.name = format!("{}copy{copy}", last.name);
        info.agents.push(agent);
    }
    let copies = |name: &str| -> Vec<String> {
        let of = |agent: &str| agent == name || (name == last.name && agent.starts_with(&format!("{name}copy")));
        info.agents
            .iter()
            .map(|agent| agent.name.clone())
            .filter(|agent| of(agent))
            .collect()
    };
    let mut writer = LogWriter::create_atomic(to, &info)?;
    let streams = [Stream::Pose, Stream::Points, Stream::Detections, Stream::DetectionsInfo];
    let wanted: Vec<(&str, Stream)> = known
        .iter()
        .take(agents)
        .flat_map(|agent| streams.map(|stream| (agent.name.as_str(), stream)))
        .collect();
    let (first, _) = log.span().ok_or_else(|| eyre!("{}: empty", from.display()))?;
    let until: Nanos = first + from_seconds(seconds);
    let mut reader = log.read(&wanted, first, until)?;
    let mut detections = None;
    while let Some(entry) = reader.next()? {
        let (stamp, ready) = (entry.stamp(), entry.ready());
        for agent in copies(&entry.agent) {
            match entry.stream {
                Stream::Pose => writer.pose(&agent, stamp, ready, &entry.pose()?)?,
                Stream::Points => writer.cloud(&agent, stamp, ready, &entry.cloud()?)?,
                Stream::Detections => detections = Some(entry.boxes()?),
                Stream::DetectionsInfo => {
                    if let Some(boxes) = &mut detections {
                        entry.info(boxes)?;
                        writer.detections(&agent, stamp, ready, boxes)?;
                    }
                }
                _ => {}
            }
        }
    }
    writer.finish()?;
    Ok(())
}

impl fmt::Display for Framework {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        writeln!(
            f,
            "from the last point to fused boxes, realtime on dora, late fusion at 10 Hz (goal: p50 at most 8 ms, p95 at most 20)"
        )?;
        write!(f, "  agents   p50 ms   p95 ms   p99 ms   rate Hz   lost by dora")?;
        for run in &self.runs {
            let Measured {
                agents,
                p50,
                p95,
                p99,
                rate_hz,
                transport_lost,
            } = run;
            write!(
                f,
                "\n  {agents:>6} {p50:>8.2} {p95:>8.2} {p99:>8.2} {rate_hz:>9.2} {transport_lost:>14}"
            )?;
        }
        Ok(())
    }
}
