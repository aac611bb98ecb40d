//! A training: its files, its steps, its scores.

use std::fs::{File, TryLockError};
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::sync::mpsc::Receiver;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use realo_methods::Kernels;
use realo_methods::Model;
use realo_nn::model::{Frame, ModelFile};
use realo_nn::weights::{Weights, sha256};

use super::source::{Filling, Source};
use super::time::{Pace, Time};
use super::{Data, News, Observer, Progress, TrainOptions, Trained, option};
use crate::TrainError;
use crate::checkpoint::{Checkpoint, TrainingPlan, write_weights};
use crate::compressor;
use crate::curve::{Curve, Point};
use crate::data::{Batch, Frames, LATER, REACH, Sampling, Supply, left_out_once, write_whole};
use crate::freeze::{Frozen, listed};
use crate::fusing::{Start, beginning, fuses, start};
use crate::layers::Arithmetic;
use crate::loss::LossWeights;
use crate::network::Network;
use crate::optimizer::AdamW;
use crate::random::Stream;
use crate::scored::{Before, Comparison, Scored};
use crate::teacher::Teacher;
use crate::validate::{Validation, decoys, validate, validate_fusion};

/// Simulated frames that are searched for an object of each class before training begins; of logs all are.
const SEARCHED: usize = 100;

/// The last of so many parts of the steps see the whole range alone. A batch of squares is normed by what squares are like, and one
/// of far ones, where little is, hardly as the far parts of a whole grid: weights have to learn what they will meet, and so have the
/// running statistics. Without that a detector misses what is far.
const WHOLE: u64 = 3;

/// What a training goes on from.
pub const CHECKPOINT: &str = "checkpoint.safetensors";

/// A training that is set up.
pub struct Training<'a> {
    options: &'a TrainOptions,
    model: Model,
    sampling: Sampling,
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

/// Refuses a model that sees what frames of training data do not hold.
pub(crate) fn check_frames_suit(model: &Model) -> Result<(), TrainError> {
    let reason = match model {
        _ if model.frame != Frame::Body => {
            "its frame is `lidar`, and frames of training data are those of the agents' bodies".to_string()
        }
        _ if model.pillars.intensity => "it looks at intensity, which frames of training data do not hold".to_string(),
        _ if [model.grid.x, model.grid.y]
            .as_flattened()
            .iter()
            .any(|metres| metres.abs() > REACH) =>
        {
            format!(
                "its grid reaches beyond {REACH} m from the agent, where frames of training data hold no points: make it smaller"
            )
        }
        _ => return Ok(()),
    };
    Err(TrainError::Model {
        model: model.name.clone(),
        reason,
    })
}

/// What must not change between the parts of a training.
fn plan(options: &TrainOptions, model: &Model, data: &str, [from, teacher]: [Option<String>; 2]) -> TrainingPlan {
    TrainingPlan {
        model: model.clone(),
        frozen: Frozen::of(model, &options.freeze),
        seed: options.seed,
        batch: options.batch,
        steps: options.steps,
        frozen_norms: options.frozen_norms,
        parts: options.parts,
        optimizer: options.optimizer,
        augmentation: options.augmentation.clone(),
        data: data.into(),
        from,
        teacher,
    }
}

/// What batches are made of; every frame is used as often as the others.
fn sampling(
    options: &TrainOptions,
    model: &Model,
    frames: &Arc<dyn Frames>,
    supply: Supply,
    teacher: Option<Arc<Teacher>>,
) -> Sampling {
    let samples = options.steps * options.batch as u64;
    Sampling {
        frames: frames.clone(),
        model: model.clone(),
        augmentation: options.augmentation.clone(),
        seed: options.seed,
        batch: options.batch,
        uses: samples.div_ceil(frames.len() as u64).max(1),
        parts: options.parts,
        whole_from: options.steps - options.steps / WHOLE,
        supply: Arc::new(Mutex::new(supply)),
        teacher,
    }
}

impl<'a> Training<'a> {
    /// Reads or makes all that it needs; the observer hears what is left out.
    pub fn new(options: &'a TrainOptions, observer: &mut Observer) -> Result<Self, TrainError> {
        let (model, files) = Model::read_with_files(&options.model)?;
        let start = start(&model, options.from.as_deref(), options.seed)?;
        Self::begun(options, (model, files), start, observer)
    }

    /// As [`Training::new`], with random numbers also in an encoder that is another file's: steps that are timed and forgotten.
    pub fn at_random(options: &'a TrainOptions) -> Result<Self, TrainError> {
        let read = Model::read_with_files(&options.model)?;
        Self::begun(options, read, None, &mut |_| ControlFlow::Continue(()))
    }

    fn begun(
        options: &'a TrainOptions,
        (model, files): (Model, Vec<ModelFile>),
        start: Option<Start>,
        observer: &mut Observer,
    ) -> Result<Self, TrainError> {
        check_frames_suit(&model)?;
        if Frozen::of(&model, &options.freeze).is_all(&model) {
            return Err(option(
                "freeze",
                "parts that leave something to learn",
                listed(&options.freeze),
            ));
        }
        let checkpoint = options.output.join(CHECKPOINT);
        if weights(&model, &options.output).contains(&checkpoint) {
            let reason = "its `name`, `weights` or `encoder` is `checkpoint`, whose place its weights would take: name them otherwise".into();
            return Err(TrainError::Model {
                model: model.name,
                reason,
            });
        }
        let source = Source::open(&options.data, fuses(&model))?;
        let validation = Scored::of(options, &source.frames)?;
        say_left_out(&source.frames, &validation, observer);
        let from = start.as_ref().map(|start| start.identity.clone());
        let teacher = options.teacher.as_deref().map(|file| Teacher::of(file, &model));
        let teacher = teacher.transpose()?.map(Arc::new);
        let taught_by = teacher.as_ref().map(|teacher| teacher.identity().to_string());
        let plan = plan(options, &model, &source.name, [from, taught_by]);
        let lock = lock(&options.output)?;
        let weights = start.as_ref().map(|start| &*start.weights);
        let mut state = state(options, &model, weights, plan, &checkpoint)?;
        if let (Some(weights), false) = (weights, options.resume) {
            compressor::begin(&mut state.network, weights, options.seed, &source.frames)?;
        }
        state.network.arithmetic = options.arithmetic.unwrap_or_else(Arithmetic::fastest);
        state.network.frozen_norms = options.frozen_norms;
        let sampling = sampling(options, &model, &source.frames, state.supply.clone(), teacher);
        let mut filling = Filling::default();
        filling
            .threads
            .extend(source.missing.map(|frames| frames.fill(filling.stop.clone())));
        let training = Training {
            options,
            model,
            sampling,
            filling,
            state,
            start: start.map(|start| start.weights),
            validation,
            checkpoint,
            due: 0,
            _lock: lock,
        };
        training.check_classes()?;
        copy_model(files, &options.output)?;
        Ok(training)
    }

    /// Every class of the model needs an object.
    fn check_classes(&self) -> Result<(), TrainError> {
        let mut missing: Vec<&str> = self.model.classes.iter().map(|class| class.name.as_str()).collect();
        let frames = match self.options.data {
            Data::Simulated { .. } => self.sampling.frames.len().min(SEARCHED),
            Data::Logged { .. } => self.sampling.frames.len(),
        };
        for index in 0..frames {
            let frame = self.sampling.frames.load(index)?;
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

    /// `before`: the score that the training is compared with.
    pub fn run(mut self, before: Option<Before>, observer: &mut Observer) -> Result<Trained, TrainError> {
        let time = Time::new(self.options.minutes);
        let (batches, loader) = self.sampling.clone().start(self.state.optimizer.steps);
        let ended = self.steps(&batches, &time, before.as_ref(), observer)?.is_break();
        // The loader ends when nobody listens.
        drop(batches);
        let _ = loader.join();
        let weights = self.save(&self.state)?;
        let steps = self.state.optimizer.steps;
        // What was fitted into a time ends with it: the learning rate fell with the time.
        let complete = steps >= self.options.steps || (self.options.fit_steps && !ended);
        if complete {
            write_sums(&self.options.model, &self.model, &self.options.output)?;
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

    /// Steps until the last one, the end of the time or the observer's word, which it gives, and says how far they are.
    fn steps(
        &mut self,
        batches: &Receiver<Result<Batch, TrainError>>,
        time: &Time,
        before: Option<&Before>,
        observer: &mut Observer,
    ) -> Result<ControlFlow<()>, TrainError> {
        let mut saved = Instant::now();
        // A step may throw the weights far away and show it only in the next one's loss, so a state waits for that.
        let mut waiting: Option<Checkpoint> = None;
        let mut pace = Pace::default();
        let mut validations = self.first_validation(before)?;
        let first = self.state.optimizer.steps;
        while self.state.optimizer.steps < self.options.steps && !time.is_over() {
            let start = Instant::now();
            if let (true, Some(share)) = (self.options.fit_steps, time.share()) {
                self.due = first + ((self.options.steps - first) as f64 * share) as u64;
            }
            let batch = batches.recv().map_err(|_| TrainError::Stopped)??;
            let waited = start.elapsed().as_secs_f64();
            let point = self.step(&batch, start)?;
            let maps = batch.parties.iter().map(Vec::len).sum();
            if let Some(state) = waiting.take() {
                self.save(&state)?;
            }
            pace.add(point.seconds, waited);
            if self.is_due() {
                validations.push((self.state.optimizer.steps, self.validate(&self.state.network)?));
                self.search_decoys()?;
            }
            let steps_left = (self.options.steps - self.state.optimizer.steps) as f64 * pace.seconds;
            let said = observer(&News::Step(&Progress {
                point,
                maps,
                steps: self.options.steps,
                seconds_per_step: pace.seconds,
                waiting: pace.waiting,
                left: Duration::from_secs_f64(steps_left.min(time.left())),
                validations: &validations,
            }));
            validations.clear();
            if said.is_break() {
                return Ok(said);
            }
            if saved.elapsed().as_secs_f64() > self.options.checkpoint_minutes * 60.0 {
                waiting = Some(self.state.clone());
                saved = Instant::now();
            }
        }
        Ok(ControlFlow::Continue(()))
    }

    /// What is learnt in addition is measured by where it began.
    fn first_validation(&self, before: Option<&Before>) -> Result<Vec<(u64, Validation)>, TrainError> {
        let begins =
            self.options.from.is_some() && self.state.optimizer.steps == 0 && self.options.validate_every.is_some();
        if !begins {
            return Ok(Vec::new());
        }
        let first = match before.filter(|before| before.begins) {
            Some(before) => before.score.clone(),
            None => self.validate(&self.state.network)?,
        };
        Ok(vec![(0, first)])
    }

    /// Whether a validation comes after this step.
    fn is_due(&self) -> bool {
        let steps = self.state.optimizer.steps;
        self.options
            .validate_every
            .is_some_and(|every| steps.is_multiple_of(every))
    }

    /// Mean seconds of a step, by steps that are forgotten: on parts and on the whole range, each for so long.
    pub fn pace(mut self, seconds: f64) -> Result<f64, TrainError> {
        let whole = self.timed(0, seconds)?;
        if self.options.parts == 0.0 {
            return Ok(whole);
        }
        let parts = self.timed(u64::MAX, seconds)?;
        let share = 1.0 / WHOLE as f64;
        Ok(whole * share + parts * (1.0 - share))
    }

    fn timed(&mut self, whole_from: u64, seconds: f64) -> Result<f64, TrainError> {
        let sampling = Sampling {
            whole_from,
            ..self.sampling.clone()
        };
        let (batches, loader) = sampling.start(0);
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
        let weights = match fuses(&self.model) {
            true => LossWeights::of_fusion(),
            false => LossWeights::default(),
        };
        let pass = network.pass(batch, &weights)?;
        let class = pass.losses.iter().map(|loss| loss.class).sum::<f64>();
        let regression = pass.losses.iter().map(|loss| loss.regression).sum::<f64>();
        if !(class + regression + pass.lesson).is_finite() {
            return Err(self.diverged(step, class + regression));
        }
        let rate = how.rate_at(step.max(self.due), self.options.steps);
        let gradient = optimizer.step(network, &pass.gradients, rate, how)?;
        if !gradient.is_finite() {
            return Err(self.diverged(step, class + regression));
        }
        let point = Point {
            step,
            class,
            regression,
            lesson: pass.lesson,
            gradient,
            rate,
            seconds: start.elapsed().as_secs_f64(),
        };
        curve.points.push(point);
        Ok(point)
    }

    /// The score that the training is compared with, if it is: of the weights of `from`; of a training that begins with random
    /// numbers, of the weights beside the model file, where there are some that this training does not write.
    pub fn before(&self, observer: &mut Observer) -> Result<Option<Before>, TrainError> {
        if !self.options.compare {
            return Ok(None);
        }
        let before = match &self.start {
            Some(_) if self.state.optimizer.steps == 0 => Some(self.scored(&self.state.network, true)?),
            Some(start) => Some(self.scored(&self.network_of(start)?, true)?),
            None if self.writes_beside_model() => None,
            // Weights that cannot be loaded are not what the user would lose.
            None => match realo_methods::load(&self.options.model, Kernels::auto(1)) {
                Ok(loaded) => Some(self.scored(&self.network_of(&loaded.weights)?, false)?),
                Err(_) => None,
            },
        };
        if let Some(before) = &before {
            let _ = observer(&News::Before(before));
        }
        Ok(before)
    }

    /// Whether weights beside the model file are what this training writes: a resumed one may be given its own copy of the model.
    fn writes_beside_model(&self) -> bool {
        let found = |paths: Vec<PathBuf>| -> Vec<PathBuf> {
            let paths = paths.iter();
            paths.filter_map(|path| path.canonicalize().ok()).collect()
        };
        let own = found(weights(&self.model, &self.options.output));
        let beside = found(self.model.weights_beside(&self.options.model));
        beside.iter().any(|path| own.contains(path))
    }

    /// Has the frames made on which the network is scored, if it is.
    pub fn make_validation_frames(&self) -> Result<(), TrainError> {
        let frames = &self.validation.frames;
        let scored = if self.options.compare { frames.len() } else { 0 };
        (0..scored).try_for_each(|index| frames.load(index).map(drop))
    }

    fn network_of(&self, weights: &Weights) -> Result<Network, TrainError> {
        let mut network = beginning(&self.model, weights, self.options.seed)?;
        network.arithmetic = self.state.network.arithmetic;
        Ok(network)
    }

    fn scored(&self, network: &Network, begins: bool) -> Result<Before, TrainError> {
        Ok(Before {
            frames: self.validation.name.clone(),
            begins,
            score: self.validate(network)?,
        })
    }

    fn validate(&self, network: &Network) -> Result<Validation, TrainError> {
        let frames = &self.validation.frames;
        match fuses(&self.model) {
            true => validate_fusion(network, frames),
            false => validate(network, frames),
        }
    }

    /// Has later samples hold what is now taken for an object and is none.
    fn search_decoys(&mut self) -> Result<(), TrainError> {
        if self.sampling.augmentation.decoys == 0 {
            return Ok(());
        }
        let steps = self.state.optimizer.steps;
        let mut draws = Stream::new(self.options.seed, "decoys", steps);
        let found = decoys(&self.state.network, &self.sampling.frames, &mut draws)?;
        self.state.supply.add(steps + LATER, found);
        let mut supply = self.sampling.supply.lock().unwrap_or_else(PoisonError::into_inner);
        *supply = self.state.supply.clone();
        Ok(())
    }

    fn diverged(&self, step: u64, loss: f64) -> TrainError {
        TrainError::Diverged {
            step,
            loss,
            saved: self.checkpoint.exists(),
        }
    }

    /// Writes everything; each file is replaced as a whole.
    fn save(&self, state: &Checkpoint) -> Result<PathBuf, TrainError> {
        let output = |name: &str| self.options.output.join(name);
        if let (false, Some(point)) = (state.network.is_finite(), state.curve.points.last()) {
            return Err(self.diverged(point.step, point.loss()));
        }
        state.write(&self.checkpoint)?;
        let weights = weights(&self.model, &self.options.output);
        write_weights(&state.network, &weights)?;
        write_whole(&output("curve.csv"), state.curve.to_csv().as_bytes())?;
        write_whole(&output("curve.svg"), state.curve.to_svg().as_bytes())?;
        Ok(weights.into_iter().next().expect("a model has weights"))
    }
}

/// Puts a model file, and those that it extends, beside its weights, so that the folder can be given to `realo run --model`.
pub fn copy_model(files: Vec<ModelFile>, folder: &Path) -> Result<(), TrainError> {
    for (path, text) in files {
        // Sums are those of the weights that it began with.
        let text = without_sums(&text);
        let beside = folder.join(path.file_name().unwrap_or_default());
        // A training that goes on may have been given its own copy.
        if !std::fs::read(&beside).is_ok_and(|there| there == text) {
            write_whole(&beside, &text)?;
        }
    }
    Ok(())
}

/// Adds the sums of the finished weights in a folder to its copy of a model file.
pub fn write_sums(file: &Path, model: &Model, folder: &Path) -> Result<(), TrainError> {
    let file = folder.join(file.file_name().unwrap_or_default());
    let unreadable = |path: &Path| {
        let path = path.to_path_buf();
        move |error| TrainError::Write { path, error }
    };
    let mut text = without_sums(&std::fs::read(&file).map_err(unreadable(&file))?);
    text.truncate(text.trim_ascii_end().len());
    text.extend(b"\n\n[sha256]   # of the files of weights, which are checked when they are loaded\n");
    for path in weights(model, folder) {
        let sum = sha256(&std::fs::read(&path).map_err(unreadable(&path))?);
        let stem = path.file_stem().unwrap_or_default().to_string_lossy();
        text.extend(format!("{stem} = \"{sum}\"\n").into_bytes());
    }
    write_whole(&file, &text)
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
            let mut network = match start {
                Some(start) => beginning(model, start, options.seed)?,
                None => Network::random(model, options.seed)?,
            };
            network.freeze(&plan.frozen);
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

/// Says what of the frames of training and validation is left out, each once.
fn say_left_out(trained: &Arc<dyn Frames>, validation: &Scored, observer: &mut Observer) {
    let left_out = left_out_once(&**trained, &*validation.frames);
    if !left_out.is_empty() {
        let _ = observer(&News::LeftOut(&left_out));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_grid_that_frames_do_not_fill_is_refused() {
        let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../models/lite.toml");
        let mut model = Model::read(&file).unwrap();
        check_frames_suit(&model).unwrap();
        model.grid.y = [-38.4, 128.4];
        let error = check_frames_suit(&model).unwrap_err().to_string();
        assert!(error.contains("`lite`") && error.contains("beyond 128 m"), "{error}");
    }

    #[test]
    fn sums_are_taken_out_of_a_model_file_and_nothing_else() {
        let text = "name = \"a\"\n[sha256] # of files\na = \"00\"\n\n[arch]\nkind = \"fcooper\"";
        let left = "name = \"a\"\n[arch]\nkind = \"fcooper\"";
        assert_eq!(without_sums(text.as_bytes()), left.as_bytes());
        assert_eq!(without_sums(left.as_bytes()), left.as_bytes());
    }
}
