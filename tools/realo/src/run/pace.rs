//! Measures which share of a graph's rate this machine reaches.

use std::fmt;
use std::path::{Path, PathBuf};
use std::time::Duration;

use eyre::{Result, WrapErr, bail, eyre};
use realo_graph::FlatGraph;
use realo_host::{Stages, virtual_time};
use realo_logs::{Log, Stream};
use realo_operator::Role;
use realo_schemas::{Kind, to_millis, to_seconds};

use super::nodes::{argument, decided_argument, deciding, registration};
use super::{Args, Choices, Mode, machine, prepare};
use crate::tables::Show;
use crate::{registry, roles};

/// Frames that are played.
const FRAMES: usize = 20;
/// Frames are played for so long at most.
const PATIENCE: Duration = Duration::from_secs(8);
/// The share of its time that a machine can compute at most while it also hands messages on.
const COMPUTING: f64 = 0.85;

/// What a machine does of a graph's rate.
pub struct Pace {
    /// The graph's rate: sweeps of the ego a second.
    hz: f64,
    /// What this machine does of it; more than 1 where there is time left.
    share: f64,
    /// The stage that computes longest.
    slowest: String,
    /// What it takes for each frame, ms.
    slowest_ms: f64,
    /// Processor time that all stages without plug-ins take for each frame, of all cores together, ms.
    all_ms: f64,
    cores: usize,
    frames: usize,
    ego: String,
}

impl Pace {
    /// Whether the machine does the graph's whole rate.
    pub fn keeps_up(&self) -> bool {
        self.share >= 1.0
    }

    fn of(measured: &virtual_time::Pace, cores: usize, ego: &str) -> Option<Self> {
        let span = measured.span as f64;
        let (slowest, took) = measured.took.iter().max_by_key(|(_, took)| *took)?;
        let of_one = *took as f64 / span;
        let of_all = measured.computed as f64 / span / cores as f64;
        let frames = measured.frames as f64;
        (span > 0.0).then(|| Pace {
            hz: frames / to_seconds(measured.span),
            share: COMPUTING / of_one.max(of_all).max(f64::MIN_POSITIVE),
            slowest: slowest.clone(),
            slowest_ms: to_millis(*took) / frames,
            all_ms: to_millis(measured.computed) / frames,
            cores,
            frames: measured.frames,
            ego: ego.into(),
        })
    }
}

impl fmt::Display for Pace {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let does = (self.hz * self.share).min(self.hz);
        write!(f, "this machine does {does:.1} of {:.1} Hz", self.hz)?;
        if !self.keeps_up() {
            write!(f, ": {}", remedies(self.share))?;
        }
        write!(
            f,
            " ({} frames of {}: all stages without plug-ins take {:.0} ms of processor time a frame on {} cores; the slowest, `{}`, takes {:.0} ms)",
            self.frames, self.ego, self.all_ms, self.cores, self.slowest, self.slowest_ms
        )
    }
}

/// What to do where a machine does this share of a log's time.
pub fn remedies(share: f64) -> String {
    // Some time is left for what else the machine does.
    let slower = (share * 9.0).floor() / 10.0;
    let slower = match slower > 0.0 {
        true => slower,
        false => (share * 90.0).floor().max(1.0) / 100.0,
    };
    format!(
        "play with `--rate {slower}`, or take a model of int8 (--model, docs/reference/networks.md), recorded detections \
         (--recorded-detections), or --mode virtual"
    )
}

/// Plays some frames of a log in virtual time, and measures.
///
/// # Errors
/// As a run; a graph that runs in realtime only; a log without points of the ego, or with too few frames.
pub fn pace(graph: &Path, log: &Path, ego: Option<&str>, choices: &Choices) -> Result<Pace> {
    let folder = Folder::new()?;
    let args = Args {
        graphs: vec![graph.into()],
        log: vec![log.into()],
        mode: Some(Mode::Virtual),
        offline: false,
        rate: None,
        coop: None,
        ego: ego.map(String::from),
        agents: Vec::new(),
        compute: None,
        protocol: None,
        choices: choices.clone(),
        out: Some(folder.0.clone()),
        no_cost: false,
        resume: false,
        view: Default::default(),
        show: Show::default(),
    };
    let batch = prepare::batch(&args, Mode::Virtual, graph, &prepare::stem(graph))?;
    let Some(plan) = batch.plans().first() else {
        bail!("{}: no run of it", graph.display());
    };
    std::fs::create_dir_all(&plan.out).wrap_err_with(|| plan.out.display().to_string())?;
    plan.write_settings()?;
    let ego = deciding(&plan.graph, roles::EGO).find_map(|node| argument(node, decided_argument(node, roles::EGO)?));
    let ego = ego.ok_or_else(|| eyre!("{}: no node has an ego", graph.display()))?;
    if Log::open(log)?.count(&ego, Stream::Points) == 0 {
        bail!(
            "{} has no points of `{ego}`, by which frames are counted; measure with a log that has clouds",
            log.display()
        );
    }
    let sources = sources(&plan.graph);
    let stages = Stages::of(&plan.graph, &registry()).map_err(|error| eyre!(error))?;
    let measured = virtual_time::pace(&stages, FRAMES, PATIENCE, |stage, message| {
        let header = &message.header;
        header.kind == Kind::Points && *header.agent == *ego && sources.iter().any(|source| source == stage)
    })?;
    let pace = measured.and_then(|measured| Pace::of(&measured, machine::cores(), &ego));
    pace.ok_or_else(|| {
        eyre!(
            "{}: too few sweeps of {ego} to measure a rate: expected 4 or more in the log, and 2 or more played in {} s",
            log.display(),
            2 * PATIENCE.as_secs()
        )
    })
}

fn sources(graph: &FlatGraph) -> Vec<String> {
    let nodes = graph.nodes.iter();
    let sources = nodes.filter(|node| registration(node).is_some_and(|known| known.role == Role::Source));
    sources.map(|node| node.id.clone()).collect()
}

/// A folder for what nobody reads.
struct Folder(PathBuf);

impl Folder {
    fn new() -> Result<Self> {
        let path = std::env::temp_dir().join(format!("realo-pace-{}", std::process::id()));
        std::fs::create_dir_all(&path).wrap_err_with(|| path.display().to_string())?;
        Ok(Folder(path))
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_machine_does_what_its_slowest_stage_and_all_its_cores_do() {
        let measured = |stage_ms: i64, all_ms: i64| {
            let measured = virtual_time::Pace {
                frames: 20,
                span: 2_000_000_000,
                took: vec![("a".into(), 1_000_000), ("b".into(), stage_ms * 1_000_000)],
                computed: all_ms * 1_000_000,
            };
            Pace::of(&measured, 2, "car").unwrap()
        };
        let slow = measured(2_940, 3_000);
        let said = slow.to_string();
        assert!(
            said.starts_with("this machine does 5.8 of 10.0 Hz: play with `--rate 0.5`, or take a model of int8"),
            "{said}"
        );
        assert!(
            said.ends_with("(20 frames of car: all stages without plug-ins take 150 ms of processor time a frame on 2 cores; the slowest, `b`, takes 147 ms)"),
            "{said}"
        );
        assert!(!slow.keeps_up());
        // Each stage is fast enough, all together are not.
        assert!(!measured(200, 4_000).keeps_up());
        let fast = measured(200, 400);
        assert!(fast.keeps_up() && fast.to_string().starts_with("this machine does 10.0 of 10.0 Hz ("));
    }

    #[test]
    fn a_rate_is_never_none() {
        assert!(remedies(0.58).starts_with("play with `--rate 0.5`"));
        assert!(remedies(0.05).starts_with("play with `--rate 0.04`"));
        assert!(remedies(0.0001).starts_with("play with `--rate 0.01`"));
    }
}
