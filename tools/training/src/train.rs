//! The training loop.

use std::fs::{File, TryLockError};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use realo_nn::loss;
use realo_nn::model::{Frame, Model, ModelFile};
use realo_nn::weights::{Weights, sha256};

use crate::TrainError;
use crate::checkpoint::{Checkpoint, TrainingPlan, write_weights};
use crate::curve::{Curve, Point};
use crate::data::{
    Augmentation, Batch, Frames, Input, LATER, LoggedFrames, MapEncoder, Recipe, SimulatedFrames, Supply, write_whole,
};
use crate::fusing::{beginning, learns_to_fuse, start};
use crate::layers::Arithmetic;
use crate::memory::keep_freed_pages;
use crate::network::Network;
use crate::optimizer::{AdamW, OptimizerSettings};
use crate::random::Stream;
use crate::scored::{Comparison, FRAMES_APART, Scored};
use crate::validate::{Validation, decoys, validate, validate_fusion};

/// Simulated frames that are searched for an object of each class before training begins; of logs all are.
const SEARCHED: usize = 100;

/// The last of so many parts of the steps see the whole range alone. A batch of squares is normed by what squares are like, and one
/// of far ones, where little is, hardly as the far parts of a whole grid: weights have to learn what they will meet, and so have the
/// running statistics. Without that a detector misses what is far.
const WHOLE: u64 = 3;

/// Simulator seeds from here on are for validation and tests.
const TRAINING_SEEDS: u64 = 800;

/// What is trained, on what, for how long.
#[derive(Clone, Debug)]
pub struct TrainOptions {
    /// The model file.
    pub model: PathBuf,
    /// The model file with weights to begin with; of a model that learns to fuse, those of the encoder, which stay, and of
    /// the heads.
    pub from: Option<PathBuf>,
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
    /// Whether batch norms take the statistics of the weights that are begun with, and leave them, in place of each batch's.
    pub frozen_norms: bool,
    /// Probability that a step sees parts of the range, before the last third of the steps: squares, turned by any angle; of a model that learns to fuse half of
    /// the range along x.
    pub parts: f64,
    /// Minutes from one checkpoint to the next.
    pub checkpoint_minutes: f64,
    /// Steps from one validation to the next; none without.
    pub validate_every: Option<u64>,
    /// Whether the weights that are begun with and the last ones are scored, on the same frames.
    pub compare: bool,
    /// Logs on whose frames the network is scored, in place of simulator seeds or of the logs of the training.
    pub validation_logs: Vec<PathBuf>,
    /// How weights are moved.
    pub optimizer: OptimizerSettings,
    /// How samples are drawn.
    pub augmentation: Augmentation,
    /// Threads of the layers; all cores by default.
    pub threads: Option<usize>,
    /// Of the products of convolutions; by default what the CPU computes fastest. A training may be resumed in the other one.
    pub arithmetic: Option<Arithmetic>,
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
        /// The logs.
        logs: Vec<PathBuf>,
        /// Min time between two frames of a log, s.
        apart: f64,
    },
}

/// How far a training is.
#[derive(Clone, Copy, Debug)]
pub struct Progress<'a> {
    /// The step that was done.
    pub point: Point,
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

/// Trains until the last step or the end of the time.
///
/// # Errors
/// [`TrainError`]; whatever it is, the last checkpoint is unharmed.
pub fn train(options: &TrainOptions, progress: impl FnMut(&Progress) + Send) -> Result<Trained, TrainError> {
    check(options)?;
    keep_freed_pages();
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(options.threads.unwrap_or(0))
        .build()
        .map_err(|error| option("threads", "a number of threads that can be started", error))?;
    pool.install(|| match options.fit_steps {
        true => {
            let (options, before) = fitted(options)?;
            Training::new(&options)?.run(before, progress)
        }
        false => {
            let training = Training::new(options)?;
            let before = training.before()?;
            training.run(before, progress)
        }
    })
}

/// Share of the time that goes into what is timed first, at each of the two sizes of samples.
const PILOT: f64 = 0.04;
/// Share of the time that is left for the last validation where none before it was timed.
const VALIDATING: f64 = 0.1;
/// As much more than the first validation is left for the last one: frames that were made lie in the cache then, but the
/// machine may be busier.
const RESERVE: f64 = 1.25;

/// As many steps as fit into the time, and the score of the weights that they begin with.
fn fitted(options: &TrainOptions) -> Result<(TrainOptions, Option<Validation>), TrainError> {
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
    let training = Training::new(&options_of_plan)?;
    let since = Instant::now();
    let before = training.before()?;
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
    if let Data::Logged { apart, .. } = &options.data
        && !is_time(*apart)
    {
        return Err(option("apart", "seconds", apart));
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

/// What a training goes on from.
const CHECKPOINT: &str = "checkpoint.safetensors";

struct Training<'a> {
    options: &'a TrainOptions,
    model: Model,
    recipe: Recipe,
    filling: Filling,
    state: Checkpoint,
    /// The weights of `from`.
    start: Option<Arc<Weights>>,
    /// What the network is scored on.
    validation: Scored,
    checkpoint: PathBuf,
    /// The step that would be due by the time, where steps were fitted into it.
    due: u64,
    /// Held as long as the folder is written to.
    _lock: File,
}

/// Makes a folder, if it is not there, and keeps other trainings out of it.
fn lock(folder: &Path) -> Result<File, TrainError> {
    let failed = |path: &Path, error| TrainError::Write {
        path: path.into(),
        error,
    };
    std::fs::create_dir_all(folder).map_err(|error| failed(folder, error))?;
    let path = folder.join("training.lock");
    // Whatever has that name is not emptied.
    let file = File::options().create(true).append(true).open(&path);
    let file = file.map_err(|error| failed(&path, error))?;
    match file.try_lock() {
        Ok(()) => Ok(file),
        Err(TryLockError::WouldBlock) => Err(TrainError::Busy { folder: folder.into() }),
        Err(TryLockError::Error(error)) => Err(failed(&path, error)),
    }
}

/// The frames that options ask for.
struct Source {
    frames: Arc<dyn Frames>,
    name: String,
    /// Frames that may have to be made yet.
    missing: Option<SimulatedFrames>,
}

impl Source {
    /// `earlier`: whether simulated frames have earlier sweeps too.
    fn open(data: &Data, earlier: bool) -> Result<Self, TrainError> {
        match data {
            Data::Simulated { cache, seeds, per_seed } => {
                let mut frames = SimulatedFrames::new(cache, seeds.clone(), *per_seed)?;
                let world = crate::data::world();
                let mut name = format!("simulator seeds {seeds:?}, {per_seed} frames each, {world}");
                if earlier {
                    frames = frames.with_earlier();
                    name.push_str(" and earlier");
                }
                Ok(Source {
                    frames: Arc::new(frames.clone()),
                    name,
                    missing: Some(frames),
                })
            }
            Data::Logged { cache, logs, apart } => {
                let frames = LoggedFrames::new(cache, logs, *apart)?;
                if frames.is_empty() {
                    return Err(option(
                        "logs",
                        "logs with sweeps at the stamps of their ground truth",
                        format!("{logs:?}"),
                    ));
                }
                let spacing = match *apart == FRAMES_APART {
                    true => String::new(),
                    false => format!(", {apart} s apart"),
                };
                Ok(Source {
                    name: format!("logs {logs:?}, {}{spacing}", frames.identity()),
                    frames: Arc::new(frames),
                    missing: None,
                })
            }
        }
    }
}

/// Threads that make frames; they end with the training.
#[derive(Default)]
struct Filling {
    stop: Arc<AtomicBool>,
    threads: Vec<std::thread::JoinHandle<Result<(), TrainError>>>,
}

impl Drop for Filling {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        for thread in self.threads.drain(..) {
            // The loader meets the same error where it matters.
            let _ = thread.join();
        }
    }
}

/// Refuses a model that sees what frames of training data do not hold.
pub(crate) fn check_frames_suit(model: &Model) -> Result<(), TrainError> {
    let reason = match model {
        _ if model.frame != Frame::Body => {
            "its frame is `lidar`, and frames of training data are those of the agents' bodies"
        }
        _ if model.pillars.intensity => "it looks at intensity, which frames of training data do not hold",
        _ => return Ok(()),
    };
    Err(TrainError::Model {
        model: model.name.clone(),
        reason: reason.into(),
    })
}

impl<'a> Training<'a> {
    fn new(options: &'a TrainOptions) -> Result<Self, TrainError> {
        let (model, files) = Model::read_with_files(&options.model)?;
        check_frames_suit(&model)?;
        let checkpoint = options.output.join(CHECKPOINT);
        if weights(&model, &options.output).contains(&checkpoint) {
            let reason = "its `name`, `weights` or `encoder` is `checkpoint`, whose place its weights would take: name them otherwise".into();
            return Err(TrainError::Model {
                model: model.name,
                reason,
            });
        }
        let start = start(&model, options.from.as_deref(), options.seed)?;
        let source = Source::open(&options.data, learns_to_fuse(&model))?;
        let plan = TrainingPlan {
            model: model.clone(),
            seed: options.seed,
            batch: options.batch,
            steps: options.steps,
            frozen_norms: options.frozen_norms,
            parts: options.parts,
            optimizer: options.optimizer,
            augmentation: options.augmentation.clone(),
            data: source.name.clone(),
            from: start.as_ref().map(|start| start.identity.clone()),
        };
        let lock = lock(&options.output)?;
        let weights = start.as_ref().map(|start| &*start.weights);
        let mut state = state(options, &model, weights, plan, &checkpoint)?;
        state.network.arithmetic = options.arithmetic.unwrap_or_else(Arithmetic::fastest);
        state.network.frozen_norms = options.frozen_norms;
        let maps = match learns_to_fuse(&model) {
            true => Some(MapEncoder::new(&model, &state.network.weights()?, 1)?),
            false => None,
        };
        // Every frame is used as often as the others.
        let samples = options.steps * options.batch as u64;
        let uses = samples.div_ceil(source.frames.len() as u64).max(1);
        let recipe = Recipe {
            frames: source.frames.clone(),
            model: model.clone(),
            augmentation: options.augmentation.clone(),
            seed: options.seed,
            batch: options.batch,
            uses,
            parts: options.parts,
            whole_from: options.steps - options.steps / WHOLE,
            supply: Arc::new(Mutex::new(state.supply.clone())),
            encoder: maps.map(|maps| Arc::new(Mutex::new(maps))),
        };
        let mut filling = Filling::default();
        filling
            .threads
            .extend(source.missing.map(|frames| frames.fill(filling.stop.clone())));
        let validation = Scored::of(options, &recipe.frames)?;
        let training = Training {
            options,
            model,
            recipe,
            filling,
            state,
            start: start.map(|start| start.weights),
            validation,
            checkpoint,
            due: 0,
            _lock: lock,
        };
        training.check_classes()?;
        training.copy_model(files)?;
        Ok(training)
    }

    /// The model file, and those that it extends, beside its weights, so that the folder can be given to `realo run --model`.
    fn copy_model(&self, files: Vec<ModelFile>) -> Result<(), TrainError> {
        for (path, text) in files {
            // Sums are those of the weights that it began with.
            let text = without_sums(&text);
            let beside = self.options.output.join(path.file_name().unwrap_or_default());
            // A training that goes on may have been given its own copy.
            if !std::fs::read(&beside).is_ok_and(|there| there == text) {
                write_whole(&beside, &text)?;
            }
        }
        Ok(())
    }

    /// Adds the sums of the finished weights to the copy of the model file.
    fn write_sums(&self) -> Result<(), TrainError> {
        let file = self
            .options
            .output
            .join(self.options.model.file_name().unwrap_or_default());
        let unreadable = |path: &Path| {
            let path = path.to_path_buf();
            move |error| TrainError::Write { path, error }
        };
        let mut text = without_sums(&std::fs::read(&file).map_err(unreadable(&file))?);
        text.extend(b"\n[sha256]   # of the files of weights, which are checked when they are loaded\n");
        for path in weights(&self.model, &self.options.output) {
            let sum = sha256(&std::fs::read(&path).map_err(unreadable(&path))?);
            let stem = path.file_stem().unwrap_or_default().to_string_lossy();
            text.extend(format!("{stem} = \"{sum}\"\n").into_bytes());
        }
        write_whole(&file, &text)
    }

    /// Every class of the model needs an object.
    fn check_classes(&self) -> Result<(), TrainError> {
        let mut missing: Vec<&str> = self.model.classes.iter().map(|class| class.name.as_str()).collect();
        let frames = match self.options.data {
            Data::Simulated { .. } => self.recipe.frames.len().min(SEARCHED),
            Data::Logged { .. } => self.recipe.frames.len(),
        };
        for index in 0..frames {
            let frame = self.recipe.frames.load(index)?;
            let has = |class: &str| {
                let objects = frame.agents.iter().flat_map(|agent| &agent.objects);
                let mut counted = objects.filter(|object| object.points >= 5);
                counted.any(|object| frame.classes[object.class] == class)
            };
            missing.retain(|class| !has(class));
            if missing.is_empty() {
                return Ok(());
            }
        }
        Err(TrainError::AbsentClass {
            class: missing.join("`, `"),
            frames,
        })
    }

    /// `before`: the score of the weights that the training began with.
    fn run(
        mut self,
        before: Option<Validation>,
        mut progress: impl FnMut(&Progress) + Send,
    ) -> Result<Trained, TrainError> {
        let begin = Instant::now();
        let budget = self
            .options
            .minutes
            .map(|minutes| Duration::from_secs_f64(minutes * 60.0));
        let (batches, loader) = self.recipe.clone().start(self.state.optimizer.steps);
        let mut saved = Instant::now();
        // A step may throw the weights far away and show it only in the next one's loss, so a state waits for that.
        let mut waiting: Option<Checkpoint> = None;
        let mut pace = Pace::default();
        let mut validations = Vec::new();
        // What is learnt in addition is measured by where it began.
        if self.options.from.is_some() && self.state.optimizer.steps == 0 && self.options.validate_every.is_some() {
            let first = match &before {
                Some(before) => before.clone(),
                None => self.validate(&self.state.network)?,
            };
            validations.push((0, first));
        }
        let first = self.state.optimizer.steps;
        while self.state.optimizer.steps < self.options.steps && budget.is_none_or(|budget| begin.elapsed() < budget) {
            let start = Instant::now();
            if let (true, Some(budget)) = (self.options.fit_steps, budget) {
                let share = begin.elapsed().as_secs_f64() / budget.as_secs_f64();
                self.due = first + ((self.options.steps - first) as f64 * share) as u64;
            }
            let batch = batches.recv().map_err(|_| TrainError::Stopped)??;
            let waited = start.elapsed().as_secs_f64();
            let point = self.step(&batch, start)?;
            if let Some(state) = waiting.take() {
                self.save(&state)?;
            }
            pace.add(point.seconds, waited);
            let due = self
                .options
                .validate_every
                .is_some_and(|every| self.state.optimizer.steps.is_multiple_of(every));
            if due {
                validations.push((self.state.optimizer.steps, self.validate(&self.state.network)?));
                self.search_decoys()?;
            }
            let steps_left = (self.options.steps - self.state.optimizer.steps) as f64 * pace.seconds;
            let time_left = budget.map_or(f64::INFINITY, |budget| {
                (budget.saturating_sub(begin.elapsed())).as_secs_f64()
            });
            progress(&Progress {
                point,
                steps: self.options.steps,
                seconds_per_step: pace.seconds,
                waiting: pace.waiting,
                left: Duration::from_secs_f64(steps_left.min(time_left)),
                validations: &validations,
            });
            validations.clear();
            if saved.elapsed().as_secs_f64() > self.options.checkpoint_minutes * 60.0 {
                waiting = Some(self.state.clone());
                saved = Instant::now();
            }
        }
        // The loader ends when nobody listens.
        drop(batches);
        let _ = loader.join();
        let weights = self.save(&self.state)?;
        let steps = self.state.optimizer.steps;
        // What was fitted into a time ends with it: the learning rate fell with the time.
        let complete = steps >= self.options.steps || self.options.fit_steps;
        if complete {
            self.write_sums()?;
        }
        let comparison = match complete && self.options.compare {
            true => Some(Comparison {
                frames: self.validation.name.clone(),
                before,
                after: self.validate(&self.state.network)?,
            }),
            false => None,
        };
        drop(self.filling);
        Ok(Trained {
            steps,
            of_steps: self.options.steps,
            complete,
            comparison,
            weights,
        })
    }

    /// Mean seconds of a step, by steps that are forgotten: on parts and on the whole range, each for so long.
    fn pace(mut self, seconds: f64) -> Result<f64, TrainError> {
        let whole = self.timed(0, seconds)?;
        if self.options.parts == 0.0 {
            return Ok(whole);
        }
        let parts = self.timed(u64::MAX, seconds)?;
        let share = 1.0 / WHOLE as f64;
        Ok(whole * share + parts * (1.0 - share))
    }

    fn timed(&mut self, whole_from: u64, seconds: f64) -> Result<f64, TrainError> {
        let recipe = Recipe {
            whole_from,
            ..self.recipe.clone()
        };
        let (batches, loader) = recipe.start(0);
        let mut step = |start: Instant| -> Result<f64, TrainError> {
            let batch = batches.recv().map_err(|_| TrainError::Stopped)??;
            self.step(&batch, start)?;
            Ok(start.elapsed().as_secs_f64())
        };
        // The first one waits for the loader to begin.
        step(Instant::now())?;
        let (begin, mut times) = (Instant::now(), Vec::new());
        while times.len() < 3 || begin.elapsed().as_secs_f64() < seconds {
            times.push(step(Instant::now())?);
        }
        drop(batches);
        let _ = loader.join();
        Ok(times.iter().sum::<f64>() / times.len() as f64)
    }

    fn step(&mut self, batch: &Batch, start: Instant) -> Result<Point, TrainError> {
        let Checkpoint {
            network,
            optimizer,
            curve,
            ..
        } = &mut self.state;
        let step = optimizer.steps;
        let how = &self.options.optimizer;
        let weights = loss::LossWeights::default();
        let pass = match &batch.input {
            Input::Points(pillars) => network.pass(pillars, &batch.targets, &weights)?,
            Input::Maps(samples) => network.pass_on_maps(samples, &batch.targets, &weights)?,
        };
        let class = pass.losses.iter().map(|loss| loss.class).sum::<f64>();
        let regression = pass.losses.iter().map(|loss| loss.regression).sum::<f64>();
        if !(class + regression).is_finite() {
            return Err(TrainError::Diverged {
                step,
                loss: class + regression,
            });
        }
        let rate = how.rate_at(step.max(self.due), self.options.steps);
        let gradient = optimizer.step(network, &pass.gradients, rate, how)?;
        if !gradient.is_finite() {
            return Err(TrainError::Diverged {
                step,
                loss: class + regression,
            });
        }
        let point = Point {
            step,
            class,
            regression,
            gradient,
            rate,
            seconds: start.elapsed().as_secs_f64(),
        };
        curve.points.push(point);
        Ok(point)
    }

    /// The score of the weights of `from`, where before and after are compared.
    fn before(&self) -> Result<Option<Validation>, TrainError> {
        let Some(start) = self.start.as_ref().filter(|_| self.options.compare) else {
            return Ok(None);
        };
        if self.state.optimizer.steps == 0 {
            return self.validate(&self.state.network).map(Some);
        }
        let mut network = beginning(&self.model, start, self.options.seed)?;
        network.arithmetic = self.state.network.arithmetic;
        self.validate(&network).map(Some)
    }

    fn validate(&self, network: &Network) -> Result<Validation, TrainError> {
        let frames = &self.validation.frames;
        match self.recipe.encoder {
            Some(_) => validate_fusion(network, frames),
            None => validate(network, frames),
        }
    }

    /// Has later samples hold what is now taken for an object and is none.
    fn search_decoys(&mut self) -> Result<(), TrainError> {
        if self.recipe.augmentation.decoys == 0 {
            return Ok(());
        }
        let steps = self.state.optimizer.steps;
        let mut draws = Stream::new(self.options.seed, "decoys", steps);
        let found = decoys(&self.state.network, &self.recipe.frames, &mut draws)?;
        self.state.supply.add(steps + LATER, found);
        let mut supply = self.recipe.supply.lock().unwrap_or_else(PoisonError::into_inner);
        *supply = self.state.supply.clone();
        Ok(())
    }

    /// Writes everything; each file is replaced as a whole.
    fn save(&self, state: &Checkpoint) -> Result<PathBuf, TrainError> {
        let output = |name: &str| self.options.output.join(name);
        if let (false, Some(point)) = (state.network.is_finite(), state.curve.points.last()) {
            return Err(TrainError::Diverged {
                step: point.step,
                loss: point.loss(),
            });
        }
        state.write(&self.checkpoint)?;
        let weights = weights(&self.model, &self.options.output);
        write_weights(&state.network, &weights)?;
        write_whole(&output("curve.csv"), state.curve.to_csv().as_bytes())?;
        write_whole(&output("curve.svg"), state.curve.to_svg().as_bytes())?;
        Ok(weights.into_iter().next().expect("a model has weights"))
    }
}

/// A model file without its table `sha256`, with all else as it was written.
fn without_sums(text: &[u8]) -> Vec<u8> {
    let mut is_sums = false;
    let lines = text.split_inclusive(|byte| *byte == b'\n').filter(|line| {
        let line = line.trim_ascii();
        if line.starts_with(b"[") {
            is_sums = line.starts_with(b"[sha256]");
        }
        !is_sums
    });
    lines.flatten().copied().collect()
}

/// The files of weights that a model in a folder asks for.
fn weights(model: &Model, folder: &Path) -> Vec<PathBuf> {
    model.weights_beside(&folder.join(&model.name))
}

/// The frames of a few validation seeds.
///
/// # Errors
/// [`TrainError::Write`] if there can be no folder for them.
pub fn validation_frames(data: &Data) -> Result<Arc<dyn Frames>, TrainError> {
    let (Data::Simulated { cache, .. } | Data::Logged { cache, .. }) = data;
    Ok(Arc::new(SimulatedFrames::new(cache, 800..812, 1)?))
}

/// The frames of some data.
///
/// # Errors
/// [`TrainError`] if there can be no folder for them, or logs have none.
pub fn frames(data: &Data) -> Result<Arc<dyn Frames>, TrainError> {
    Ok(Source::open(data, false)?.frames)
}

/// `start`: the weights to begin with.
fn state(
    options: &TrainOptions,
    model: &Model,
    start: Option<&Weights>,
    plan: TrainingPlan,
    path: &Path,
) -> Result<Checkpoint, TrainError> {
    let refuse = |reason: String| TrainError::Checkpoint {
        path: path.into(),
        reason,
    };
    match (options.resume, path.exists()) {
        (true, false) => Err(refuse("there is none to resume from".into())),
        (false, true) => Err(refuse(
            "a training is there already; resume it or choose another folder".into(),
        )),
        (false, false) => {
            if let Some(weights) = weights(model, &options.output).iter().find(|file| file.exists()) {
                let weights = weights.display();
                return Err(refuse(format!(
                    "there is none, but there are weights, {weights}, that a training would overwrite; choose another folder"
                )));
            }
            let network = match start {
                Some(start) => beginning(model, start, options.seed)?,
                None => Network::random(model, options.seed)?,
            };
            Ok(Checkpoint {
                optimizer: AdamW::new(&network),
                network,
                curve: Curve::default(),
                supply: Supply::default(),
                plan,
            })
        }
        (true, true) => {
            let state = Checkpoint::read(path, model)?;
            match &state.plan.differences(&plan)[..] {
                [] => Ok(Checkpoint { plan, ..state }),
                found => Err(refuse(found.join("; "))),
            }
        }
    }
}

/// Running means of the times of a step.
#[derive(Default)]
struct Pace {
    seconds: f64,
    waiting: f64,
    steps: u32,
}

impl Pace {
    fn add(&mut self, seconds: f64, waiting: f64) {
        self.steps = (self.steps + 1).min(50);
        let share = 1.0 / f64::from(self.steps);
        self.seconds += share * (seconds - self.seconds);
        self.waiting += share * (waiting - self.waiting);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sums_are_taken_out_of_a_model_file_and_nothing_else() {
        let text = "name = \"a\"\n[sha256] # of files\na = \"00\"\n\n[arch]\nkind = \"fcooper\"";
        let left = "name = \"a\"\n[arch]\nkind = \"fcooper\"";
        assert_eq!(without_sums(text.as_bytes()), left.as_bytes());
        assert_eq!(without_sums(left.as_bytes()), left.as_bytes());
    }
}
