//! A recipe: the stages by which weights come to be, each from random numbers or from those of a stage before.

mod install;
mod make;
mod mean;

use std::collections::BTreeSet;
use std::ops::Range;
use std::path::{Path, PathBuf};

use realo_methods::Model;
use serde::{Deserialize, Serialize};

pub use self::install::install;
pub use self::make::{How, Made, Planned, RecipeNews, make, plan};
use crate::TrainError;
use crate::freeze::{Frozen, Part, listed};
use crate::scored::FRAMES_APART;
use crate::train::{BATCH, PARTS, PER_SEED, SEEDS};

/// The stages of a file, in order.
#[derive(Clone, Debug, PartialEq)]
pub struct Recipe {
    /// The file.
    pub file: PathBuf,
    /// Its stages.
    pub stages: Vec<Stage>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RecipeFile {
    stage: Vec<Stage>,
}

/// A training, or the mean of the weights of stages before.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Stage {
    /// Its name, also that of its folder.
    pub name: String,
    /// The model file, beside the recipe.
    pub model: PathBuf,
    /// The stage before, or a model file beside the recipe, with whose weights it begins; random numbers without.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub from: Option<String>,
    /// The stage before, or a model file beside the recipe, whose maps of all points together are an example.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub teacher: Option<String>,
    /// Stages before whose weights' mean this stage takes, in place of a training.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub mean: Vec<String>,
    /// Steps of the training.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub steps: Option<u64>,
    /// Max learning rate; what `realo-lab train` takes by default.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rate: Option<f64>,
    /// Samples of a step.
    #[serde(default = "batch")]
    pub batch: usize,
    /// Of all draws.
    #[serde(default)]
    pub seed: u64,
    /// Simulator seeds, first..end.
    #[serde(default = "seeds", with = "seed_range")]
    pub seeds: Range<u64>,
    /// Frames of a seed.
    #[serde(default = "per_seed")]
    pub per_seed: usize,
    /// Logs in place of simulator seeds, beside the recipe.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub log: Vec<PathBuf>,
    /// Seconds from one frame of a log to the next.
    #[serde(default = "apart")]
    pub apart: f64,
    /// Probability that a step sees a square.
    #[serde(default = "parts")]
    pub parts: f64,
    /// Parts that stay as they are.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub freeze: Vec<Part>,
    /// Whether norms keep their statistics; what `realo-lab train` does by default.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub frozen_norms: Option<bool>,
    /// Steps from one validation to the next.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub validate_every: Option<u64>,
    /// What its card says beside what is measured; a stage with a card ships.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub card: Option<CardText>,
}

/// The words of a card that nobody can measure.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CardText {
    /// What the weights are.
    pub about: String,
    /// What they cannot do, a sentence or two each.
    #[serde(default)]
    pub limits: Vec<String>,
}

fn batch() -> usize {
    BATCH
}

fn seeds() -> Range<u64> {
    SEEDS
}

fn per_seed() -> usize {
    PER_SEED
}

fn apart() -> f64 {
    FRAMES_APART
}

fn parts() -> f64 {
    PARTS
}

/// Seeds as `first..end`.
mod seed_range {
    use std::ops::Range;

    use serde::de::Error;
    use serde::{Deserialize, Deserializer, Serialize, Serializer};

    pub fn serialize<S: Serializer>(seeds: &Range<u64>, to: S) -> Result<S::Ok, S::Error> {
        format!("{seeds:?}").serialize(to)
    }

    pub fn deserialize<'de, D: Deserializer<'de>>(from: D) -> Result<Range<u64>, D::Error> {
        let text = String::deserialize(from)?;
        super::seeds_of(&text)
            .ok_or_else(|| D::Error::custom(format!("expected first..end, as 0..800, found `{text}`")))
    }
}

/// Seeds of `first..end`.
pub fn seeds_of(text: &str) -> Option<Range<u64>> {
    let (first, end) = text.split_once("..")?;
    let seeds = first.parse().ok()?..end.parse().ok()?;
    (!seeds.is_empty()).then_some(seeds)
}

/// Why a recipe is not made, or no further. What was made before stays.
#[derive(Debug, thiserror::Error)]
pub enum RecipeError {
    /// A file that cannot be read or written.
    #[error("cannot read or write `{}`: {error}", path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// What the system said.
        error: std::io::Error,
    },
    /// A file that is no recipe.
    #[error("`{}` is no recipe: {reason}", path.display())]
    Parse {
        /// The file.
        path: PathBuf,
        /// Where and why.
        reason: String,
    },
    /// A stage that asks for what cannot be.
    #[error("`{}`: stage `{stage}`: {field}: expected {expected}, found {found}", path.display())]
    Stage {
        /// The recipe.
        path: PathBuf,
        /// The stage.
        stage: String,
        /// The key.
        field: &'static str,
        /// What it takes.
        expected: String,
        /// What is there.
        found: String,
    },
    /// A stage that was made by other settings.
    #[error(
        "stage `{stage}`: `{}` was made otherwise: {differences}; remove that folder to make it anew, with all stages that begin with it, or name another --out",
        folder.display()
    )]
    Changed {
        /// The stage.
        stage: String,
        /// Its folder.
        folder: PathBuf,
        /// Which settings.
        differences: String,
    },
    /// A training whose loss is no number any more.
    #[error(
        "stage `{stage}`: diverged at step {step}, loss {loss}: give it a lower `rate` in `{}`, and the same command {}",
        path.display(),
        match saved {
            true => "goes on from its last checkpoint, which is unharmed",
            false => "begins it again: it had no checkpoint yet",
        }
    )]
    Diverged {
        /// The recipe.
        path: PathBuf,
        /// The stage.
        stage: String,
        /// The step.
        step: u64,
        /// The loss.
        loss: f64,
        /// Whether there is a checkpoint of a step before.
        saved: bool,
    },
    /// A training that failed.
    #[error("stage `{stage}`: {error}")]
    Train {
        /// The stage.
        stage: String,
        /// Why.
        error: Box<TrainError>,
    },
}

impl Recipe {
    /// Reads a recipe and checks all of its stages.
    ///
    /// # Errors
    /// [`RecipeError`] that names file, stage and key.
    pub fn read(file: &Path) -> Result<Self, RecipeError> {
        let text = std::fs::read_to_string(file).map_err(|error| RecipeError::File {
            path: file.into(),
            error,
        })?;
        let read: RecipeFile = toml::from_str(&text).map_err(|error| RecipeError::Parse {
            path: file.into(),
            reason: error.to_string(),
        })?;
        let recipe = Recipe {
            file: file.into(),
            stages: read.stage,
        };
        let mut before: Vec<&Stage> = Vec::new();
        for stage in &recipe.stages {
            recipe.check(stage, &before)?;
            before.push(stage);
        }
        Ok(recipe)
    }

    /// A file beside the recipe.
    pub fn beside(&self, path: &Path) -> PathBuf {
        self.file.parent().unwrap_or(Path::new("")).join(path)
    }

    /// A stage by its name.
    pub fn stage(&self, name: &str) -> Option<&Stage> {
        self.stages.iter().find(|stage| stage.name == name)
    }

    fn check(&self, stage: &Stage, before: &[&Stage]) -> Result<(), RecipeError> {
        let refuse = |field, expected: &str, found: &str| Err(self.refused(stage, field, expected, found));
        let letters = |byte: u8| byte.is_ascii_alphanumeric() || b"-_".contains(&byte);
        if stage.name.is_empty() || !stage.name.bytes().all(letters) {
            let found = format!("`{}`", stage.name);
            return refuse("name", "letters, digits, - and _: a folder has this name", &found);
        }
        if before.iter().any(|other| other.name == stage.name) {
            return refuse("name", "a name of its own", "that of a stage before");
        }
        match Model::read(&self.beside(&stage.model)) {
            Err(error) => return refuse("model", "a model file beside the recipe", &error.to_string()),
            Ok(model) if stage.mean.is_empty() && Frozen::of(&model, &stage.freeze).is_all(&model) => {
                return refuse("freeze", "parts that leave something to learn", &listed(&stage.freeze));
            }
            Ok(_) => {}
        }
        self.check_names(stage, before)?;
        match (stage.steps, &stage.mean[..]) {
            (None, []) => refuse("steps", "steps of a training, or `mean` of stages", "neither"),
            (Some(0), []) => refuse("steps", "at least 1", "0"),
            (Some(steps), [_, ..]) => refuse("steps", "none beside `mean`", &steps.to_string()),
            (None, [only]) => refuse("mean", "two stages at least", &format!("`{only}` alone")),
            (None, [..]) if stage.from.is_some() => refuse("from", "none beside `mean`", "one"),
            _ => Ok(()),
        }
    }

    /// Refuses a stage that names stages or files which are not there.
    fn check_names(&self, stage: &Stage, before: &[&Stage]) -> Result<(), RecipeError> {
        let names: BTreeSet<&str> = before.iter().map(|stage| &*stage.name).collect();
        let listed = match names.is_empty() {
            true => "no stage is before it".to_string(),
            false => format!("before it are {}", names.iter().copied().collect::<Vec<_>>().join(", ")),
        };
        let refuse =
            |field, expected: &str, found: &str| Err(self.refused(stage, field, expected, &format!("`{found}`")));
        let is_there = |of: &String| names.contains(&**of) || self.beside(Path::new(of)).is_file();
        for (field, of) in [("from", &stage.from), ("teacher", &stage.teacher)] {
            if let Some(of) = of.as_ref().filter(|of| !is_there(of)) {
                let expected = format!("a stage before, or a model file beside the recipe ({listed})");
                return refuse(field, &expected, of);
            }
        }
        if let Some(unknown) = stage.mean.iter().find(|of| !names.contains(&***of)) {
            return refuse("mean", &format!("stages before ({listed})"), unknown);
        }
        if let Some(log) = stage.log.iter().find(|log| !self.beside(log).is_file()) {
            return refuse("log", "logs beside the recipe", &log.display().to_string());
        }
        Ok(())
    }

    fn refused(&self, stage: &Stage, field: &'static str, expected: &str, found: &str) -> RecipeError {
        RecipeError::Stage {
            path: self.file.clone(),
            stage: stage.name.clone(),
            field,
            expected: expected.into(),
            found: found.into(),
        }
    }
}

#[cfg(test)]
mod tests;
