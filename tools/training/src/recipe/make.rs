//! Makes the stages of a recipe, each in a folder of its own; what is made stays made.

use std::collections::BTreeMap;
use std::fs;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::time::Instant;

use realo_methods::{Kernels, Model, load};
use realo_nn::weights::sha256;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::mean::mean;
use super::{Recipe, RecipeError, Stage};
use crate::TrainError;
use crate::checkpoint::{Checkpoint, differences, write_weights};
use crate::data::{LoggedData, world, write_whole};
use crate::fusing::beginning;
use crate::layers::Arithmetic;
use crate::scored::MAX_GAP_MS;
use crate::train::{CHECKPOINT, Data, News, TrainOptions, copy_model, pace, train_with, write_sums};

/// What a finished stage says of itself, in its folder.
const RECORD: &str = "stage.json";

/// Where and with what a recipe is made.
#[derive(Clone, Debug)]
pub struct How {
    /// The folder of the stages' folders.
    pub out: PathBuf,
    /// The folder of frames.
    pub cache: PathBuf,
    /// Stop after so many minutes; a later call goes on.
    pub minutes: Option<f64>,
    /// Minutes from one checkpoint to the next.
    pub checkpoint_minutes: f64,
    /// Threads; all by default.
    pub threads: Option<usize>,
    /// Of the products of convolutions.
    pub arithmetic: Option<Arithmetic>,
}

/// A finished stage.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Made {
    /// What was asked for.
    pub stage: Stage,
    /// The file of its model.
    pub file: PathBuf,
    /// Each file of weights with its sha256.
    pub weights: BTreeMap<String, String>,
    /// sha256 of the weights that it began with or is the mean of, by stage or file.
    pub begun_with: BTreeMap<String, String>,
    /// Where frames came from, in words.
    pub data: String,
    /// Time of its steps, s.
    pub seconds: f64,
    /// Numbers of the products of convolutions.
    pub arithmetic: String,
}

/// What a recipe says while it is made.
#[derive(Debug)]
pub enum RecipeNews<'a> {
    /// A stage was there already.
    There(&'a Made),
    /// Files of a finished stage are gone, so it is made again, from its checkpoint where that is there.
    Gone {
        /// The stage.
        stage: &'a Stage,
        /// Their names.
        files: &'a [String],
    },
    /// A stage begins or goes on.
    Begins {
        /// The stage.
        stage: &'a Stage,
        /// Its number, from 1.
        number: usize,
        /// All stages.
        of: usize,
    },
    /// What a training says.
    Training(News<'a>),
    /// A stage is done.
    Done(&'a Made),
}

/// How long a stage will take.
#[derive(Clone, Debug)]
pub struct Planned {
    /// The stage.
    pub name: String,
    /// Its steps, and those that are done.
    pub steps: u64,
    /// Of them, done.
    pub done: u64,
    /// Seconds of a step on this machine.
    pub pace: f64,
}

impl Planned {
    /// Seconds that are left.
    pub fn left(&self) -> f64 {
        (self.steps - self.done) as f64 * self.pace
    }
}

/// Seconds for which each of the two kinds of steps is timed.
const PILOT: f64 = 4.0;

/// How long what is not made yet takes on this machine, by some steps of each training.
///
/// # Errors
/// Those of [`make`].
pub fn plan(recipe: &Recipe, how: &How) -> Result<Vec<Planned>, RecipeError> {
    let mut all = Vec::new();
    for stage in &recipe.stages {
        let Some(steps) = stage.steps else { continue };
        let folder = how.out.join(&stage.name);
        let failed = |error| failed(recipe, stage, error);
        let done = match finished(recipe, stage, &folder)? {
            Found::Whole(_) => steps,
            Found::Gone(_) | Found::None => steps_done(&recipe.beside(&stage.model), &folder).map_err(failed)?,
        };
        let pace = match done < steps {
            true => pace(&pilot(recipe, stage, how).map_err(failed)?, PILOT).map_err(failed)?,
            false => 0.0,
        };
        all.push(Planned {
            name: stage.name.clone(),
            steps,
            done,
            pace,
        });
    }
    Ok(all)
}

/// A training of the same shape that begins at random, since what it begins with may not be made yet.
fn pilot(recipe: &Recipe, stage: &Stage, how: &How) -> Result<TrainOptions, TrainError> {
    let folder = how.out.join("pilot");
    // One that was killed.
    let _ = fs::remove_dir_all(&folder);
    let asked = Stage {
        from: None,
        frozen_norms: Some(false),
        ..stage.clone()
    };
    let is_stage = |name: &&String| recipe.stages.iter().any(|stage| stage.name == **name);
    let teacher = stage.teacher.as_ref().filter(|name| !is_stage(name));
    Ok(TrainOptions {
        teacher: teacher.map(|file| recipe.beside(Path::new(file))),
        compare: false,
        validate_every: None,
        ..options(recipe, &asked, how, None, folder)?
    })
}

fn steps_done(model: &Path, folder: &Path) -> Result<u64, TrainError> {
    let path = folder.join(CHECKPOINT);
    match path.exists() {
        true => Ok(Checkpoint::read(&path, &Model::read(model)?)?.optimizer.steps),
        false => Ok(0),
    }
}

/// Makes what is not made yet, in order. `None` where the time or the observer's word ended it before the last stage was done.
///
/// # Errors
/// [`RecipeError`]; what was made before stays.
pub fn make(
    recipe: &Recipe,
    how: &How,
    observer: &mut (dyn FnMut(&RecipeNews) -> ControlFlow<()> + Send),
) -> Result<Option<Vec<Made>>, RecipeError> {
    let begin = Instant::now();
    let mut made: Vec<Made> = Vec::new();
    for (index, stage) in recipe.stages.iter().enumerate() {
        let folder = how.out.join(&stage.name);
        match finished(recipe, stage, &folder)? {
            Found::Whole(there) => {
                check_begun_with(recipe, stage, &there, &made, &folder)?;
                let _ = observer(&RecipeNews::There(&there));
                made.push(*there);
                continue;
            }
            Found::Gone(files) => _ = observer(&RecipeNews::Gone { stage, files: &files }),
            Found::None => {}
        }
        let left = how
            .minutes
            .map(|minutes| minutes - begin.elapsed().as_secs_f64() / 60.0);
        if left.is_some_and(|left| left <= 0.0) {
            return Ok(None);
        }
        let _ = observer(&RecipeNews::Begins {
            stage,
            number: index + 1,
            of: recipe.stages.len(),
        });
        let failed = |error| failed(recipe, stage, error);
        let how = How {
            minutes: left,
            ..how.clone()
        };
        let one = match stage.mean.is_empty() {
            true => train(recipe, stage, &how, &made, observer).map_err(failed)?,
            false => Some(average(recipe, stage, &how, &made).map_err(failed)?),
        };
        let Some(one) = one else { return Ok(None) };
        let text = serde_json::to_string_pretty(&one).expect("plain data");
        write_whole(&folder.join(RECORD), text.as_bytes()).map_err(failed)?;
        let _ = observer(&RecipeNews::Done(&one));
        made.push(one);
    }
    Ok(Some(made))
}

/// The model file, in the folder of a stage before or beside the recipe.
fn begins_with(recipe: &Recipe, from: &str, made: &[Made]) -> PathBuf {
    let before = made.iter().find(|made| made.stage.name == from);
    before.map_or_else(|| recipe.beside(Path::new(from)), |made| made.file.clone())
}

fn options(
    recipe: &Recipe,
    stage: &Stage,
    how: &How,
    from: Option<PathBuf>,
    output: PathBuf,
) -> Result<TrainOptions, TrainError> {
    let cache = how.cache.clone();
    let data = match stage.log.is_empty() {
        true => Data::Simulated {
            cache,
            seeds: stage.seeds.clone(),
            per_seed: stage.per_seed,
        },
        false => Data::Logged {
            cache,
            logged: LoggedData {
                logs: stage.log.iter().map(|log| recipe.beside(log)).collect(),
                apart: stage.apart,
                max_gap_ms: MAX_GAP_MS,
            },
        },
    };
    let usual = TrainOptions::new(recipe.beside(&stage.model), from, output, data)?;
    let mut optimizer = usual.optimizer;
    optimizer.rate = stage.rate.unwrap_or(optimizer.rate);
    Ok(TrainOptions {
        resume: usual.output.join(CHECKPOINT).exists(),
        steps: stage.steps.unwrap_or(usual.steps),
        minutes: how.minutes,
        seed: stage.seed,
        batch: stage.batch,
        freeze: stage.freeze.clone(),
        frozen_norms: stage.frozen_norms.unwrap_or(usual.frozen_norms),
        parts: stage.parts,
        checkpoint_minutes: how.checkpoint_minutes,
        validate_every: stage.validate_every,
        optimizer,
        threads: how.threads,
        arithmetic: how.arithmetic,
        ..usual
    })
}

fn train(
    recipe: &Recipe,
    stage: &Stage,
    how: &How,
    made: &[Made],
    observer: &mut (dyn FnMut(&RecipeNews) -> ControlFlow<()> + Send),
) -> Result<Option<Made>, TrainError> {
    let from = stage.from.as_deref().map(|from| begins_with(recipe, from, made));
    let folder = how.out.join(&stage.name);
    let teacher = stage
        .teacher
        .as_deref()
        .map(|teacher| begins_with(recipe, teacher, made));
    let options = TrainOptions {
        teacher,
        ..options(recipe, stage, how, from, folder.clone())?
    };
    // The last step may have been done just before a kill.
    let trained = train_with(&options, |news| observer(&RecipeNews::Training(news.clone())))?;
    if !trained.complete {
        return Ok(None);
    }
    let model = Model::read(&options.model)?;
    let state = Checkpoint::read(&folder.join(CHECKPOINT), &model)?;
    record(recipe, stage, how, made, state.plan.data, state.curve.seconds()).map(Some)
}

fn average(recipe: &Recipe, stage: &Stage, how: &How, made: &[Made]) -> Result<Made, TrainError> {
    let folder = how.out.join(&stage.name);
    fs::create_dir_all(&folder).map_err(|error| TrainError::Write {
        path: folder.clone(),
        error,
    })?;
    let file = recipe.beside(&stage.model);
    let (model, files) = Model::read_with_files(&file)?;
    let weights = stage.mean.iter().map(|of| {
        let file = begins_with(recipe, of, made);
        Ok((file.clone(), load(&file, Kernels::auto(1))?.weights))
    });
    let weights = weights.collect::<Result<Vec<_>, TrainError>>()?;
    let network = beginning(&model, &mean(&model, &weights)?, 0)?;
    write_weights(&network, &model.weights_beside(&folder.join(&model.name)))?;
    copy_model(files, &folder)?;
    write_sums(&file, &model, &folder)?;
    record(recipe, stage, how, made, world(), 0.0)
}

/// What a finished stage came to.
fn record(
    recipe: &Recipe,
    stage: &Stage,
    how: &How,
    made: &[Made],
    data: String,
    seconds: f64,
) -> Result<Made, TrainError> {
    let folder = how.out.join(&stage.name);
    let model = Model::read(&recipe.beside(&stage.model))?;
    let sums = |file: &Path, model: &Model| -> Result<BTreeMap<String, String>, TrainError> {
        let sum = |path: PathBuf| {
            let bytes = fs::read(&path).map_err(|error| TrainError::Read {
                path: path.clone(),
                error,
            })?;
            Ok((
                path.file_name().unwrap_or_default().to_string_lossy().into(),
                sha256(&bytes),
            ))
        };
        model.weights_beside(file).into_iter().map(sum).collect()
    };
    let mut begun_with = BTreeMap::new();
    for of in stage.from.iter().chain(&stage.teacher).chain(&stage.mean) {
        let file = begins_with(recipe, of, made);
        let sums = sums(&file, &Model::read(&file)?)?;
        begun_with.insert(of.clone(), sums.into_values().collect::<Vec<_>>().join(" "));
    }
    Ok(Made {
        stage: stage.clone(),
        file: folder.join(stage.model.file_name().unwrap_or_default()),
        weights: sums(&folder.join(&model.name), &model)?,
        begun_with,
        data,
        seconds,
        arithmetic: how.arithmetic.unwrap_or_else(Arithmetic::fastest).to_string(),
    })
}

/// What is there of a stage.
enum Found {
    /// All of it.
    Whole(Box<Made>),
    /// It was finished, and these files are gone.
    Gone(Vec<String>),
    /// It was not finished.
    None,
}

/// What a folder says of its stage.
fn finished(recipe: &Recipe, stage: &Stage, folder: &Path) -> Result<Found, RecipeError> {
    let path = folder.join(RECORD);
    let text = match fs::read_to_string(&path) {
        Ok(text) => text,
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(Found::None),
        Err(error) => return Err(RecipeError::File { path, error }),
    };
    let made: Made = serde_json::from_str(&text).map_err(|error| RecipeError::Parse {
        path: path.clone(),
        reason: format!("{error}; remove its folder to make the stage anew"),
    })?;
    // Words change no weights.
    let bare = |stage: &Stage| Stage {
        card: None,
        ..stage.clone()
    };
    let found = differences(&bare(&made.stage), &bare(stage));
    if !found.is_empty() {
        let found = found.into_iter();
        let shown = |value: Value| match value {
            Value::Null => "not given".to_string(),
            given => given.to_string(),
        };
        let found =
            found.map(|(name, was, asked)| format!("{name}: was {}, now {} is asked for", shown(was), shown(asked)));
        return Err(changed(stage, folder, found.collect::<Vec<_>>().join("; ")));
    }
    let made = Made {
        stage: stage.clone(),
        file: folder.join(recipe.beside(&stage.model).file_name().unwrap_or_default()),
        ..made
    };
    let names = made.weights.keys().cloned();
    let names = names.chain(made.file.file_name().map(|name| name.to_string_lossy().into()));
    let gone: Vec<String> = names.filter(|name| !folder.join(name).is_file()).collect();
    if !gone.is_empty() {
        return Ok(Found::Gone(gone));
    }
    for (name, was) in &made.weights {
        let path = folder.join(name);
        let bytes = fs::read(&path).map_err(|error| RecipeError::File { path, error })?;
        let is = sha256(&bytes);
        if is != *was {
            return Err(changed(
                stage,
                folder,
                format!("`{name}` had sha256 {was}, and has {is}"),
            ));
        }
    }
    Ok(Found::Whole(Box::new(made)))
}

/// What became of a stage's training.
fn failed(recipe: &Recipe, stage: &Stage, error: TrainError) -> RecipeError {
    match error {
        TrainError::Diverged { step, loss, saved } => RecipeError::Diverged {
            path: recipe.file.clone(),
            stage: stage.name.clone(),
            step,
            loss,
            saved,
        },
        error => RecipeError::Train {
            stage: stage.name.clone(),
            error: Box::new(error),
        },
    }
}

fn changed(stage: &Stage, folder: &Path, differences: String) -> RecipeError {
    RecipeError::Changed {
        stage: stage.name.clone(),
        folder: folder.into(),
        differences,
    }
}

/// A stage that is there must have begun with the weights that its stages have.
fn check_begun_with(
    recipe: &Recipe,
    stage: &Stage,
    there: &Made,
    made: &[Made],
    folder: &Path,
) -> Result<(), RecipeError> {
    for (of, sum) in &there.begun_with {
        let Some(before) = made.iter().find(|made| made.stage.name == *of) else {
            let file = recipe.beside(Path::new(of));
            if !file.is_file() {
                return Err(changed(stage, folder, format!("`{of}` with which it began is gone")));
            }
            continue;
        };
        let now = before.weights.values().cloned().collect::<Vec<_>>().join(" ");
        if now != *sum {
            return Err(changed(
                stage,
                folder,
                format!("`{of}` had sha256 {sum}, and has {now}"),
            ));
        }
    }
    Ok(())
}
