//! `realo train`: the detector, or V2X-ViT's fusion behind one, on the CPU.

use std::ops::Range;
use std::path::PathBuf;

use eyre::{Result, bail};
use realo_nn::model::Model;
use realo_training::data::Augmentation;
use realo_training::layers::Arithmetic;
use realo_training::optimizer::OptimizerSettings;
use realo_training::{Data, TrainOptions, Validation, train};

use crate::Outcome;
use crate::progress::Progress;

/// Trains a model on frames drawn straight from simulator seeds, or from logs with ground truth
#[derive(clap::Args)]
pub struct Args {
    /// The model file
    #[arg(default_value = "models/lite.toml")]
    model: PathBuf,
    /// Begin with the weights of this model file; a V2X-ViT model keeps its encoder
    #[arg(long, value_name = "MODEL")]
    from: Option<PathBuf>,
    /// Folder of the results: checkpoint, weights, curve (CSV and SVG)
    #[arg(long, default_value = "target/realo/training")]
    out: PathBuf,
    /// Folder of the training frames; what is missing is made
    #[arg(long, default_value = "target/realo/frames")]
    cache: PathBuf,
    /// Go on from the checkpoint in the folder of the results
    #[arg(long)]
    resume: bool,
    /// Steps in all; the learning rate falls until then [default: 20000, or what fits into --minutes]
    #[arg(long)]
    steps: Option<u64>,
    /// Fit the steps into so many minutes and validate at the end; with --steps: stop then, to be resumed
    #[arg(long)]
    minutes: Option<f64>,
    /// Frames of logs instead of simulator seeds
    #[arg(long, conflicts_with_all = ["seeds", "per_seed"])]
    log: Vec<PathBuf>,
    /// Simulator seeds, first..end; 0 to 799 are for training
    #[arg(long, default_value = "0..800", value_parser = seeds)]
    seeds: Range<u64>,
    /// Frames of a seed, at least a second apart
    #[arg(long, default_value_t = 3)]
    per_seed: usize,
    /// Samples of a step
    #[arg(long, default_value_t = 2)]
    batch: usize,
    /// Seed of all draws
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Greatest learning rate
    #[arg(long, default_value_t = 2e-3)]
    rate: f64,
    /// Batch norms keep the statistics of the weights of --from, which are then the same for parts of the range and for the whole
    #[arg(long, requires = "from")]
    frozen_norms: bool,
    /// Probability that a step sees parts of the range, of the first two thirds of the steps: squares turned by any angle, at two
    /// fifths of the cost; of a V2X-ViT model half of the range
    #[arg(long, default_value_t = 0.75)]
    parts: f64,
    /// Steps from one validation (seeds 800 to 811) to the next
    #[arg(long)]
    validate_every: Option<u64>,
    /// Minutes from one checkpoint to the next
    #[arg(long, default_value_t = 3.0)]
    checkpoint_minutes: f64,
    /// Threads [default: all]
    #[arg(long)]
    threads: Option<usize>,
    /// Numbers of the convolutions' products, bf16 or f32 [default: bf16 where the CPU has instructions for it]
    #[arg(long)]
    arithmetic: Option<Arithmetic>,
}

/// Steps where neither they nor a time is given.
const STEPS: u64 = 20_000;

/// Trains and says where the results are.
pub fn main(args: &Args) -> Result<Outcome> {
    let progress = Progress::new("preparing to train", "", None);
    let mut begun = false;
    let trained = train(&args.options()?, |far| {
        if !std::mem::replace(&mut begun, true) {
            progress.rename("training", "steps");
            progress.begin(far.point.step as f64, far.steps as f64);
        }
        show(&progress, far);
    })?;
    progress.finish();
    let (steps, weights) = (trained.steps, trained.weights.display());
    if let Some((frames, validation)) = &trained.validation {
        println!("validation on {frames}: {}", scores(validation));
    }
    if trained.complete {
        println!("{steps} steps: weights in {weights}");
        return Ok(Outcome::Complete);
    }
    println!(
        "{steps} of {} steps: weights so far in {weights}; add --resume to go on",
        trained.of_steps
    );
    Ok(Outcome::Partial)
}

impl Args {
    fn options(&self) -> Result<TrainOptions> {
        let data = if self.log.is_empty() {
            Data::Simulated {
                cache: self.cache.clone(),
                seeds: self.seeds.clone(),
                per_seed: self.per_seed,
            }
        } else {
            Data::Logged {
                cache: self.cache.clone(),
                logs: self.log.clone(),
            }
        };
        Ok(TrainOptions {
            model: self.model.clone(),
            from: self.from.clone(),
            output: self.out.clone(),
            resume: self.resume,
            data,
            steps: self.steps.unwrap_or(STEPS),
            minutes: self.minutes,
            fit_steps: self.steps.is_none() && self.minutes.is_some(),
            seed: self.seed,
            batch: self.batch,
            parts: self.parts,
            frozen_norms: self.frozen_norms,
            checkpoint_minutes: self.checkpoint_minutes,
            validate_every: self.validate_every,
            optimizer: OptimizerSettings {
                rate: self.rate,
                ..OptimizerSettings::default()
            },
            augmentation: Augmentation::of(&Model::read(&self.model)?),
            threads: self.threads,
            arithmetic: self.arithmetic,
        })
    }
}

pub(crate) fn seeds(text: &str) -> Result<Range<u64>> {
    let parts = text
        .split_once("..")
        .and_then(|(a, b)| Some(a.parse().ok()?..b.parse().ok()?));
    match parts {
        Some(seeds) if !seeds.is_empty() => Ok(seeds),
        _ => bail!("expected first..end, as 0..800, found `{text}`"),
    }
}

fn show(progress: &Progress, far: &realo_training::Progress) {
    let point = far.point;
    progress.set((point.step + 1) as f64);
    progress.say(format!(
        "loss {:.3} (scores {:.3}, boxes {:.3}), {:.2} s of a step for data",
        point.loss(),
        point.class,
        point.regression,
        far.waiting,
    ));
    for (steps, validation) in far.validations {
        let (pace, waiting) = (far.seconds_per_step, far.waiting);
        let scores = scores(validation);
        progress.beside(|| println!("step {steps}, {pace:.2} s each, {waiting:.2} of it for data: {scores}"));
    }
}

pub(crate) fn scores(validation: &Validation) -> String {
    let percent = |ap: Option<f64>| ap.map_or("none".into(), |ap| format!("{:.3}", ap));
    let class = validation.classes.iter().map(|class| {
        let reached = class.reached.iter().map(|(way, ap)| format!("{way} {}", percent(*ap)));
        let reached = reached.collect::<Vec<_>>().join(", ");
        format!("{} AP@{} {reached}", class.name, class.iou)
    });
    class.collect::<Vec<_>>().join("; ")
}
