use std::fmt;
use std::path::{Path, PathBuf};

use eyre::Result;
use realo_cli::Progress;
use realo_methods::Model;
use realo_training::data::{Frames, SimulatedFrames};
use realo_training::{Data, TrainOptions, train};
use serde::Serialize;
use serde_json::json;

use super::detector::spread;
use super::peer::Peer;

const MODEL: &str = "models/lite.toml";
const BATCH: usize = 2;
const SEEDS: std::ops::Range<u64> = 0..24;
/// Turns of each.
const ROUNDS: usize = 3;
/// Steps of a turn, and how many of them warm up.
const STEPS: u64 = 12;
const WARM_UP: u64 = 2;

/// Seconds of a training step.
#[derive(Serialize)]
pub struct Train {
    threads: usize,
    minimum: f64,
    median: f64,
    peer: Option<PeerStep>,
}

#[derive(Serialize)]
struct PeerStep {
    name: String,
    minimum: f64,
    median: f64,
    /// Our median over theirs.
    ratio: f64,
    goal: f64,
}

/// Times steps of `realo-lab train` at full range, data and all; with an interpreter also PyTorch's of the same network.
pub fn bench(python: Option<&Path>, shown: &Progress) -> Result<Train> {
    let threads = std::thread::available_parallelism().map_or(1, |n| n.get());
    let folder = super::framework::folder()?;
    let cache = folder.join("frames");
    let frames = SimulatedFrames::new(&cache, SEEDS, 1)?;
    // Before anything is timed.
    shown.count("frames", frames.len() as f64);
    for index in 0..frames.len() {
        frames.load(index)?;
        shown.add(1.0);
    }
    let mut peer = python.map(|python| peer(python, threads)).transpose()?;
    let (mut ours, mut theirs) = (Vec::new(), Vec::new());
    shown.count("steps", (ROUNDS as u64 * STEPS) as f64);
    for round in 0..ROUNDS {
        let output = folder.join(format!("train_{round}"));
        // A checkpoint of an earlier bench would be gone on from, or refused.
        let _ = std::fs::remove_dir_all(&output);
        train(&options(&cache, output)?, |progress| {
            shown.add(1.0);
            if progress.point.step >= WARM_UP {
                ours.push(progress.point.seconds);
            }
        })?;
        for _ in WARM_UP..STEPS {
            if let Some(peer) = &mut peer {
                theirs.push(peer.run()?);
            }
        }
    }
    let (minimum, median) = spread(&ours);
    let peer = peer.map(|peer| {
        let (min, middle) = spread(&theirs);
        PeerStep {
            name: peer.name.clone(),
            minimum: min,
            median: middle,
            ratio: median / middle,
            goal: 1.0,
        }
    });
    Ok(Train {
        threads,
        minimum,
        median,
        peer,
    })
}

/// A turn's training, which begins anew and neither validates nor keeps what it has until its end.
fn options(cache: &Path, output: PathBuf) -> Result<TrainOptions> {
    let data = Data::Simulated {
        cache: cache.into(),
        seeds: SEEDS,
        per_seed: 1,
    };
    Ok(TrainOptions {
        steps: STEPS,
        batch: BATCH,
        parts: 0.0,
        checkpoint_minutes: 60.0,
        compare: false,
        ..TrainOptions::new(MODEL.into(), None, output, data)?
    })
}

fn peer(python: &Path, threads: usize) -> Result<Peer> {
    let model = Model::read(Path::new(MODEL))?;
    let anchors = model.rotations.len() * model.classes.len();
    let reported = json!({
        "threads": threads,
        "batch": BATCH,
        "rows": model.grid.rows(),
        "columns": model.grid.columns(),
        "channels": model.pillars.channels,
        "backbone": model.backbone,
        "shrink": model.shrink,
        // A score of each class and seven numbers of the box for each anchor.
        "outputs": anchors * (model.classes.len() + 7),
    });
    Peer::start(python, "training", &reported)
}

impl fmt::Display for Train {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        writeln!(
            f,
            "models/lite, batch {BATCH}, full range, {} threads: min {:.3} s a step, median {:.3} s",
            self.threads, self.minimum, self.median
        )?;
        match &self.peer {
            Some(peer) => write!(
                f,
                "{}, without data and loss: min {:.3} s, median {:.3} s; ours is {:.2} of it (medians; goal {})",
                peer.name, peer.minimum, peer.median, peer.ratio, peer.goal
            ),
            None => write!(f, "add --python PYTHON, one with torch, to compare"),
        }
    }
}
