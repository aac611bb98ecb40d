use std::fmt;
use std::path::Path;
use std::time::Instant;

use eyre::{Result, bail};
use realo_cli::Progress;
use realo_exporter::{export, exporter};
use realo_importer::{Imported, SceneSummary, importer};
use realo_logs::Log;
use rustix::time::{ClockId, clock_gettime};
use serde::Serialize;

use super::detector::spread;
use super::framework::folder;

const ROUNDS: usize = 7;
const AGENTS: [&str; 4] = ["cav1", "cav2", "rsu1", "rsu2"];
const SECONDS: f64 = 4.0;
/// Goal for points a second and core.
const GOAL_POINTS: f64 = 10e6;
/// Goal for a frame of four agents, ms.
const GOAL_FRAME_MS: f64 = 60.0;

/// OPV2V's folders become a log: labels joined, points counted in boxes, clouds levelled and compressed.
#[derive(Serialize)]
pub struct Import {
    agents: usize,
    frames: usize,
    /// Of all sweeps.
    points: usize,
    /// Points a second of one core's time, from the quickest and the median round.
    best: f64,
    median: f64,
    /// Wall time of a frame of all agents, one job.
    frame_minimum_ms: f64,
    frame_median_ms: f64,
}

/// Imports a simulated log of four agents, written in the layout of OPV2V, again and again.
pub fn bench(progress: &Progress) -> Result<Import> {
    let folder = folder()?;
    let [original, scene, log] = ["import.mcap", "scene", "imported.mcap"].map(|name| folder.join(name));
    let simulated = realo_simulator::Options {
        seed: 901,
        seconds: SECONDS,
        agents: AGENTS.map(String::from).into(),
        ..realo_simulator::Options::default()
    };
    crate::simulate::write(&simulated, &original)?;
    let kind = exporter("opv2v")?;
    export(
        kind,
        &Log::open(&original)?,
        &scene,
        &realo_exporter::Options::default(),
        true,
        &mut |_, _| {},
    )?;
    progress.count("rounds", ROUNDS as f64);
    // A warm-up, which does not count.
    let summary = import(&scene, &log)?;
    let (mut cpu, mut wall) = (Vec::new(), Vec::new());
    for _ in 0..ROUNDS {
        let (began, before) = (Instant::now(), cpu_seconds());
        import(&scene, &log)?;
        cpu.push(cpu_seconds() - before);
        wall.push(began.elapsed().as_secs_f64());
        progress.add(1.0);
    }
    let points: usize = summary.agents.iter().map(|agent| agent.points).sum();
    let [(best, median), (frame, frame_median)] = [&cpu, &wall].map(|seconds| spread(seconds));
    let of_frame = |seconds: f64| seconds * 1e3 / summary.frames as f64;
    std::fs::remove_dir_all(&scene)?;
    [original, log].iter().try_for_each(std::fs::remove_file)?;
    Ok(Import {
        agents: summary.agents.len(),
        frames: summary.frames,
        points,
        best: points as f64 / best,
        median: points as f64 / median,
        frame_minimum_ms: of_frame(frame),
        frame_median_ms: of_frame(frame_median),
    })
}

fn import(scene: &Path, log: &Path) -> Result<SceneSummary> {
    let importer = importer("opv2v")?;
    let mut options = importer.kind().defaults();
    importer.kind().set(&mut options, "jobs", "1")?;
    match importer.job(scene, log, &options)?.run(&mut |_, _, _| {})? {
        Imported::Scenes(mut scenes, _) if scenes.len() == 1 => Ok(scenes.remove(0)),
        other => bail!("expected one scene, found {other}"),
    }
}

/// Time of the process on all cores so far, s.
fn cpu_seconds() -> f64 {
    let time = clock_gettime(ClockId::ProcessCPUTime);
    time.tv_sec as f64 + time.tv_nsec as f64 * 1e-9
}

impl fmt::Display for Import {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let Import {
            agents,
            frames,
            points,
            best,
            median,
            frame_minimum_ms,
            frame_median_ms,
        } = self;
        writeln!(
            f,
            "OPV2V's layout to a log, {frames} frames of {agents} agents, {points} points, one job, {ROUNDS} rounds"
        )?;
        writeln!(
            f,
            "points a second and core, millions: best {:.1}, median {:.1} (goal {:.0})",
            best / 1e6,
            median / 1e6,
            GOAL_POINTS / 1e6
        )?;
        write!(
            f,
            "a frame, ms: best {frame_minimum_ms:.1}, median {frame_median_ms:.1} (goal {GOAL_FRAME_MS:.0})"
        )
    }
}
