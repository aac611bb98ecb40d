use std::fmt;
use std::path::{Path, PathBuf};

use eyre::{Result, ensure, eyre};
use realo_cli::Progress;
use realo_methods::Model;
use realo_training::data::{Augmentation, Frames, SimulatedFrames};
use realo_training::{Data, TrainOptions, train};
use serde::Serialize;

use super::detector::spread;
use super::peer::Peer;

/// The detector, and a fusion of two agents' maps.
const MODELS: [(&str, usize); 2] = [("lite", 1), ("lite-attfuse", 2)];
const BATCH: usize = 2;
const SEEDS: std::ops::Range<u64> = 0..24;
/// Turns of each.
const ROUNDS: usize = 3;
/// Steps of a turn, and how many of them warm up.
const STEPS: u64 = 12;
const WARM_UP: u64 = 2;

/// Seconds of training steps.
#[derive(Serialize)]
pub struct Train {
    threads: usize,
    networks: Vec<Network>,
}

#[derive(Serialize)]
struct Network {
    model: &'static str,
    agents: usize,
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

/// Times steps of `realo-lab train` at full range, data and all; with an interpreter also PyTorch's of the same networks.
pub fn bench(python: Option<&Path>, shown: &Progress) -> Result<Train> {
    let folder = super::framework::folder()?;
    let cache = folder.join("frames");
    // Before anything is timed. They serve the detector too.
    let frames = SimulatedFrames::new(&cache, SEEDS, 1)?.with_earlier();
    shown.count("frames", frames.len() as f64);
    for index in 0..frames.len() {
        frames.load(index)?;
        shown.add(1.0);
    }
    shown.count("steps", (MODELS.len() * ROUNDS) as f64 * STEPS as f64);
    let bench = Bench {
        folder,
        cache,
        threads: std::thread::available_parallelism().map_or(1, |n| n.get()),
    };
    let networks = MODELS.map(|(model, agents)| bench.network(model, agents, python, shown));
    Ok(Train {
        threads: bench.threads,
        networks: networks.into_iter().collect::<Result<_>>()?,
    })
}

struct Bench {
    folder: PathBuf,
    cache: PathBuf,
    threads: usize,
}

impl Bench {
    fn network(&self, name: &'static str, agents: usize, python: Option<&Path>, shown: &Progress) -> Result<Network> {
        let file = self.model(name, agents)?;
        let mut peer = python.map(|python| self.peer(&file, agents, python)).transpose()?;
        let (mut ours, mut theirs) = (Vec::new(), Vec::new());
        for round in 0..ROUNDS {
            let output = self.folder.join(format!("train_{name}_{round}"));
            // A checkpoint of an earlier bench would be gone on from, or refused.
            let _ = std::fs::remove_dir_all(&output);
            train(&self.options(&file, output)?, |progress| {
                shown.add(1.0);
                // An ego that nobody is near makes fewer maps.
                if progress.point.step >= WARM_UP && progress.maps == BATCH * agents {
                    ours.push(progress.point.seconds);
                }
            })?;
            for _ in WARM_UP..STEPS {
                if let Some(peer) = &mut peer {
                    theirs.push(peer.run()?);
                }
            }
        }
        ensure!(!ours.is_empty(), "{name}: no step had samples of {agents} agents");
        let (minimum, median) = spread(&ours);
        let peer = peer.map(|peer| {
            let (least, middle) = spread(&theirs);
            PeerStep {
                name: peer.name.clone(),
                minimum: least,
                median: middle,
                ratio: median / middle,
                goal: 0.8,
            }
        });
        Ok(Network {
            model: name,
            agents,
            minimum,
            median,
            peer,
        })
    }

    /// A shipped model, as one that fuses no more agents than these.
    fn model(&self, name: &str, agents: usize) -> Result<PathBuf> {
        let shipped = Path::new("models").join(format!("{name}.toml"));
        let (model, files) = Model::read_with_files(&shipped)?;
        if !model.arch.fuses() {
            return Ok(shipped);
        }
        // A model extends one that lies beside it.
        for (path, bytes) in files {
            let beside = path.file_name().ok_or_else(|| eyre!("{}: no name", path.display()))?;
            std::fs::write(self.folder.join(beside), bytes)?;
        }
        let file = self.folder.join(format!("{name}-{agents}.toml"));
        let arch = format!("[arch]\nkind = \"{}\"\nagents = {agents}\n", model.arch.name());
        std::fs::write(
            &file,
            format!("extends = \"{name}.toml\"\nname = \"{name}-{agents}\"\n{arch}"),
        )?;
        Ok(file)
    }

    /// A turn's training, which begins anew and neither validates nor keeps what it has until its end.
    fn options(&self, model: &Path, output: PathBuf) -> Result<TrainOptions> {
        let data = Data::Simulated {
            cache: self.cache.clone(),
            seeds: SEEDS,
            per_seed: 1,
        };
        let usual = TrainOptions::new(model.into(), None, output, data)?;
        Ok(TrainOptions {
            steps: STEPS,
            batch: BATCH,
            parts: 0.0,
            checkpoint_minutes: 60.0,
            compare: false,
            augmentation: Augmentation {
                alone: 0.0,
                ..usual.augmentation.clone()
            },
            ..usual
        })
    }

    fn peer(&self, model: &Path, agents: usize, python: &Path) -> Result<Peer> {
        let model = Model::read(model)?;
        let anchors = model.rotations.len() * model.classes.len();
        // A score of each class and seven numbers of the box for each anchor.
        let outputs = anchors * (model.classes.len() + 7);
        let mut reported = super::network::reported(&model, self.threads, BATCH * agents, outputs);
        reported["agents"] = agents.into();
        Peer::start(python, "training", &reported)
    }
}

impl fmt::Display for Train {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        for network in &self.networks {
            let Network {
                model,
                agents,
                minimum,
                median,
                peer,
            } = network;
            writeln!(
                f,
                "models/{model}, batch {BATCH}, maps of {agents} for each sample, full range, {} threads: min {minimum:.3} s a step, \
                 median {median:.3} s",
                self.threads
            )?;
            if let Some(peer) = peer {
                let PeerStep {
                    name,
                    minimum,
                    median,
                    ratio,
                    goal,
                } = peer;
                writeln!(
                    f,
                    "{name}, without data and loss: min {minimum:.3} s, median {median:.3} s; ours is {ratio:.2} of it (medians; goal {goal})"
                )?;
            }
        }
        match self.networks.iter().any(|network| network.peer.is_some()) {
            true => Ok(()),
            false => write!(f, "add --python PYTHON, one with torch, to compare"),
        }
    }
}
