//! The training loop.

mod source;
mod time;
mod training;

use std::ops::ControlFlow;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use realo_methods::Model;

pub use self::source::{frames, validation_frames};
use self::training::Training;
pub(crate) use self::training::{CHECKPOINT, check_frames_suit, copy_model, write_sums};
use crate::TrainError;
use crate::checkpoint::Checkpoint;
use crate::curve::Point;
use crate::data::{Augmentation, LeftOut, LoggedData};
use crate::freeze::Part;
use crate::layers::Arithmetic;
use crate::memory::keep_freed_pages;
use crate::optimizer::OptimizerSettings;
use crate::scored::{Before, Comparison};
use crate::validate::Validation;

/// Simulator seeds from here on are for validation and tests.
const TRAINING_SEEDS: u64 = 800;

/// What is trained, on what, for how long.
#[derive(Clone, Debug)]
pub struct TrainOptions {
    /// The model file.
    pub model: PathBuf,
    /// The model file with weights to begin with; missing tensors begin at random, a missing
    /// compressor as the principal components of the encoder's maps.
    pub from: Option<PathBuf>,
    /// The model file of a detector whose maps of all points together are an example for the map that the heads read.
    pub teacher: Option<PathBuf>,
    /// Folder of the results: `checkpoint.safetensors`, the model's files of weights, `curve.csv`, `curve.svg`.
    pub output: PathBuf,
    /// Whether to go on from the checkpoint that is there.
    pub resume: bool,
    /// Where frames come from.
    pub data: Data,
    /// Steps in all; the learning rate falls until then.
    pub steps: u64,
    /// Stop after so many minutes; the rest is for a later run that resumes.
    pub minutes: Option<f64>,
    /// Takes as many steps as fit into the minutes, by some that are timed first. A training that is resumed keeps the
    /// number that was found.
    pub fit_steps: bool,
    /// Of all draws.
    pub seed: u64,
    /// Samples of a step.
    pub batch: usize,
    /// Parts of the network that stay as they are; an encoder that is another file's does in any case.
    pub freeze: Vec<Part>,
    /// Whether batch norms take the statistics of the weights that are begun with, and leave them, in place of each batch's.
    pub frozen_norms: bool,
    /// Probability that a step sees parts of the range, before the last third of the steps: squares, turned by any angle.
    pub parts: f64,
    /// Minutes from one checkpoint to the next.
    pub checkpoint_minutes: f64,
    /// Steps from one validation to the next; none without.
    pub validate_every: Option<u64>,
    /// Whether the weights that are begun with and the last ones are scored, on the same frames.
    pub compare: bool,
    /// Frames of logs on which the network is scored, in place of simulator seeds or of the logs of the training.
    pub validation: Option<LoggedData>,
    /// How weights are moved.
    pub optimizer: OptimizerSettings,
    /// How samples are drawn.
    pub augmentation: Augmentation,
    /// Threads of the layers; all cores by default.
    pub threads: Option<usize>,
    /// Of the products of convolutions; by default what the CPU computes fastest. A training may be resumed in the other one.
    pub arithmetic: Option<Arithmetic>,
}

/// Samples of a step, unless others are asked for.
pub const BATCH: usize = 2;
/// Simulator seeds for training.
pub const SEEDS: std::ops::Range<u64> = 0..TRAINING_SEEDS;
/// Frames of a simulator seed, unless more are asked for.
pub const PER_SEED: usize = 3;
/// Probability that a step sees parts of the range, unless another is asked for.
pub const PARTS: f64 = 0.75;
/// Steps where neither they nor a time is given.
const STEPS: u64 = 20_000;
/// Max learning rate from random numbers, and of a fusion behind an encoder.
const RATE: f64 = 2e-3;
/// Max learning rate of a network that begins with good weights: a few steps at the other one ruin them.
const TUNING_RATE: f64 = 5e-4;

impl TrainOptions {
    /// A usual training of a model.
    ///
    /// # Errors
    /// [`TrainError::ModelFile`].
    pub fn new(model: PathBuf, from: Option<PathBuf>, output: PathBuf, data: Data) -> Result<Self, TrainError> {
        let read = Model::read(&model)?;
        // What is behind another file's encoder begins with random numbers.
        let is_tuned = from.is_some() && read.encoder.is_none();
        Ok(TrainOptions {
            model,
            from,
            teacher: None,
            output,
            resume: false,
            data,
            steps: STEPS,
            minutes: None,
            fit_steps: false,
            seed: 0,
            batch: BATCH,
            freeze: Vec::new(),
            frozen_norms: is_tuned,
            parts: PARTS,
            checkpoint_minutes: 3.0,
            validate_every: None,
            compare: true,
            validation: None,
            optimizer: OptimizerSettings {
                rate: if is_tuned { TUNING_RATE } else { RATE },
                ..OptimizerSettings::default()
            },
            augmentation: Augmentation::of(&read),
            threads: None,
            arithmetic: None,
        })
    }
}

/// Where frames come from.
#[derive(Clone, Debug)]
pub enum Data {
    /// Simulator seeds, kept in a folder.
    Simulated {
        /// The folder.
        cache: PathBuf,
        /// Seeds; 0 to 799 are for training.
        seeds: std::ops::Range<u64>,
        /// Frames of a seed, 1 to 10.
        per_seed: usize,
    },
    /// Logs with ground truth; their frames are kept in a folder.
    Logged {
        /// The folder.
        cache: PathBuf,
        /// Which frames.
        logged: LoggedData,
    },
}

/// How far a training is.
#[derive(Clone, Copy, Debug)]
pub struct Progress<'a> {
    /// The step that was done.
    pub point: Point,
    /// Maps of agents that were made in it.
    pub maps: usize,
    /// Steps in all.
    pub steps: u64,
    /// Mean time of a step lately, s.
    pub seconds_per_step: f64,
    /// Of it, waiting for data, s.
    pub waiting: f64,
    /// Until the last step or the end of the time, whichever comes first.
    pub left: Duration,
    /// Validations since the last step, each with the steps that were done before it.
    pub validations: &'a [(u64, Validation)],
}

/// What a training came to.
#[derive(Clone, Debug)]
pub struct Trained {
    /// Steps that were done in all.
    pub steps: u64,
    /// All steps of the schedule.
    pub of_steps: u64,
    /// Whether they are all.
    pub complete: bool,
    /// How good it was and is, of a training that is complete and was asked to compare.
    pub comparison: Option<Comparison>,
    /// The file of weights.
    pub weights: PathBuf,
}

/// What a training says while it goes on.
#[derive(Clone, Debug)]
pub enum News<'a> {
    /// What of the logs it neither learns from nor is scored on; before anything else, and only if there is something.
    LeftOut(&'a [LeftOut]),
    /// The score of the weights that it is compared with; before the first step.
    Before(&'a Before),
    /// A step was done.
    Step(&'a Progress<'a>),
}

type Observer<'a> = dyn FnMut(&News) -> ControlFlow<()> + Send + 'a;

/// Trains until the last step or the end of the time.
///
/// # Errors
/// [`TrainError`]; whatever it is, the last checkpoint is unharmed.
pub fn train(options: &TrainOptions, mut progress: impl FnMut(&Progress) + Send) -> Result<Trained, TrainError> {
    train_with(options, |news| {
        if let News::Step(far) = news {
            progress(far);
        }
        ControlFlow::Continue(())
    })
}

/// As [`train`]; `observer` hears all that there is to say, and may end the training after a step, for a later run that resumes.
///
/// # Errors
/// As [`train`].
pub fn train_with(
    options: &TrainOptions,
    mut observer: impl FnMut(&News) -> ControlFlow<()> + Send,
) -> Result<Trained, TrainError> {
    check(options)?;
    keep_freed_pages();
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(options.threads.unwrap_or(0))
        .build()
        .map_err(|error| option("threads", "a number of threads that can be started", error))?;
    pool.install(|| match options.fit_steps {
        true => {
            let (options, before) = fitted(options, &mut observer)?;
            // What is left out was said.
            Training::new(&options, &mut |_| ControlFlow::Continue(()))?.run(before, &mut observer)
        }
        false => {
            let training = Training::new(options, &mut observer)?;
            let before = training.before(&mut observer)?;
            training.run(before, &mut observer)
        }
    })
}

/// Mean seconds of a step of a training, by some that are forgotten with their folder; `seconds`: for so long each kind of steps is
/// timed.
///
/// # Errors
/// As [`train`].
pub(crate) fn pace(options: &TrainOptions, seconds: f64) -> Result<f64, TrainError> {
    check(options)?;
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(options.threads.unwrap_or(0))
        .build()
        .map_err(|error| option("threads", "a number of threads that can be started", error))?;
    let pace = pool.install(|| Training::at_random(options)?.pace(seconds));
    let _ = std::fs::remove_dir_all(&options.output);
    pace
}

/// Share of the time that goes into what is timed first, at each of the two sizes of samples.
const PILOT: f64 = 0.04;
/// Share of the time that is left for the last validation where none before it was timed.
const VALIDATING: f64 = 0.1;
/// As much more than the first validation is left for the last one: frames that were made lie in the cache then, but the
/// machine may be busier.
const RESERVE: f64 = 1.25;

/// As many steps as fit into the time, and the score of the weights that they begin with.
fn fitted(options: &TrainOptions, observer: &mut Observer) -> Result<(TrainOptions, Option<Before>), TrainError> {
    let begin = Instant::now();
    let minutes = options
        .minutes
        .ok_or_else(|| option("fit_steps", "minutes to fit them into", "none"))?;
    let seconds = minutes * 60.0;
    let model = Model::read(&options.model)?;
    let planned = match options.resume {
        true => Some(Checkpoint::read(&options.output.join(CHECKPOINT), &model)?.plan.steps),
        false => None,
    };
    let options_of_plan = TrainOptions {
        steps: planned.unwrap_or(options.steps),
        ..options.clone()
    };
    let training = Training::new(&options_of_plan, observer)?;
    // Frames that are not there yet are made once, which is no part of what the last validation takes.
    training.make_validation_frames()?;
    let since = Instant::now();
    let before = training.before(observer)?;
    let reserved = match &before {
        Some(_) => since.elapsed().as_secs_f64() * RESERVE,
        None => seconds * VALIDATING,
    };
    let left = || seconds - reserved - begin.elapsed().as_secs_f64();
    let steps = match planned {
        Some(steps) => steps,
        None => {
            let pace = training.pace(seconds * PILOT)?;
            (left() / pace).max(1.0) as u64
        }
    };
    let options = TrainOptions {
        steps,
        // Some steps are made however little is left.
        minutes: Some(left().max(1.0) / 60.0),
        ..options.clone()
    };
    Ok((options, before))
}

pub(crate) fn option(field: &'static str, expected: &'static str, found: impl std::fmt::Display) -> TrainError {
    TrainError::Option {
        field,
        expected,
        found: found.to_string(),
    }
}

fn check(options: &TrainOptions) -> Result<(), TrainError> {
    // A batch of more samples fits no memory.
    if !(1..=256).contains(&options.batch) {
        return Err(option("batch", "1 to 256", options.batch));
    }
    if options.steps == 0 {
        return Err(option("steps", "at least 1", 0));
    }
    // The times of a million years are no settings.
    let is_time = |minutes: f64| (0.0..1e9).contains(&minutes);
    if let Some(minutes) = options.minutes.filter(|minutes| *minutes == 0.0 || !is_time(*minutes)) {
        return Err(option("minutes", "a time of more than 0", minutes));
    }
    let trained = match &options.data {
        Data::Logged { logged, .. } => Some(logged),
        Data::Simulated { .. } => None,
    };
    let mut logged = trained.into_iter().chain(&options.validation);
    if let Some(logged) = logged.find(|logged| !is_time(logged.apart)) {
        return Err(option("apart", "seconds", logged.apart));
    }
    if !is_time(options.checkpoint_minutes) {
        return Err(option("checkpoint_minutes", "a time", options.checkpoint_minutes));
    }
    if let Some(threads) = options.threads.filter(|threads| *threads > 1024) {
        return Err(option("threads", "at most 1024", threads));
    }
    if let Some(arithmetic) = options.arithmetic.filter(|arithmetic| !arithmetic.is_available()) {
        let expected = "f32: this CPU has no instructions for products of bf16";
        return Err(option("arithmetic", expected, arithmetic));
    }
    if options.frozen_norms && options.from.is_none() {
        let expected = "not without `from`: norms of random weights have no statistics yet";
        return Err(option("frozen_norms", expected, true));
    }
    if options.validate_every == Some(0) {
        return Err(option("validate_every", "at least 1", 0));
    }
    let rate = options.optimizer.rate;
    if !(rate > 0.0 && rate.is_finite()) {
        return Err(option("rate", "a number greater than 0", rate));
    }
    if !(0.0..=1.0).contains(&options.parts) {
        return Err(option("parts", "a probability", options.parts));
    }
    match &options.data {
        Data::Simulated { seeds, .. } if seeds.end > TRAINING_SEEDS => Err(option(
            "seeds",
            "an end of at most 800: the seeds from there on are for validation and tests",
            format!("{seeds:?}"),
        )),
        Data::Simulated { seeds, .. } if seeds.is_empty() => Err(option("seeds", "at least one", format!("{seeds:?}"))),
        Data::Simulated { per_seed, .. } if !(1..=10).contains(per_seed) => {
            Err(option("per_seed", "1 to 10", per_seed))
        }
        _ => Ok(()),
    }
}
