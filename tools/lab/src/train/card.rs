//! The card of weights: where they are from and what they reach. Its words are the recipe's, all else is measured.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use eyre::Result;
use realo_methods::Model;
use realo_nn::layers::Layers;
use realo_training::Validation;
use realo_training::data::Frames;
use realo_training::recipe::{Made, Recipe, Stage};

use super::recipe::hours;
use crate::measure::{Tree, machine};
use crate::score;

/// What a card says.
pub struct Card<'a> {
    /// The stage.
    pub made: &'a Made,
    /// The stages that led to it, in order, itself last.
    way: Vec<&'a Made>,
    model: Model,
    recipe: String,
    commit: String,
    machine: String,
    /// What it reaches.
    pub score: Validation,
}

impl<'a> Card<'a> {
    /// Scores the weights of a stage.
    ///
    /// # Errors
    /// Weights or frames that are not to be had.
    pub fn new(recipe: &Recipe, all: &'a [Made], made: &'a Made, frames: &Arc<dyn Frames>) -> Result<Self> {
        let folder = recipe
            .file
            .parent()
            .filter(|folder| *folder != Path::new(""))
            .unwrap_or(Path::new("."));
        let here = machine();
        Ok(Card {
            made,
            way: way(all, made),
            model: Model::read(&made.file)?,
            recipe: recipe.file.display().to_string(),
            commit: Tree::of(folder.into()).map_or("of no repository".into(), |tree| tree.commit()),
            machine: format!("{}, {} threads", here.cpu, here.threads),
            score: score::of_card(&made.file, frames)?,
        })
    }

    /// Where it is written: beside the weights.
    pub fn path(&self) -> PathBuf {
        self.made.file.with_extension("md")
    }

    /// Files that ship, and their names there.
    pub fn files(&self) -> Result<Vec<(PathBuf, String)>> {
        let folder = self.made.file.parent().unwrap_or(Path::new(""));
        let stem = self.stem();
        let mut files: Vec<(PathBuf, String)> = self
            .made
            .weights
            .keys()
            .filter(|name| **name == format!("{}.safetensors", self.model.own_weights()))
            .map(|name| (folder.join(name), name.clone()))
            .collect();
        files.push((self.made.file.clone(), format!("{stem}.toml")));
        files.push((self.path(), format!("{stem}.md")));
        if let Some(curve) = self.curve() {
            files.push((curve, format!("{stem}.svg")));
        }
        Ok(files)
    }

    fn stem(&self) -> String {
        self.made.file.file_stem().unwrap_or_default().to_string_lossy().into()
    }

    /// The picture of the last training on its way.
    fn curve(&self) -> Option<PathBuf> {
        let trained = self.way.iter().rev().find(|made| made.stage.mean.is_empty())?;
        Some(trained.file.parent()?.join("curve.svg"))
    }

    /// The card, in Markdown.
    pub fn markdown(&self) -> String {
        let stem = self.stem();
        let text = self.made.stage.card.as_ref();
        let about = text.map_or("", |text| text.about.trim());
        let numbers: usize = Layers::of(&self.model).tensors().map(|spec| spec.count()).sum();
        let own = format!("{}.safetensors", self.model.own_weights());
        let file = |(name, sum): (&String, &String)| match *name == own {
            true => format!("`{name}`, sha256 `{sum}`"),
            false => format!("the encoder's in `{name}`"),
        };
        let files: Vec<String> = self.made.weights.iter().map(file).collect();
        let seconds: f64 = self.way.iter().map(|made| made.seconds).sum();
        let mut card = format!(
            "<!-- Written by `realo-lab train {}`: what is edited here is lost. -->\n# `{stem}`\n\n{about}\n\n",
            self.recipe
        );
        card += "| | |\n|---|---|\n";
        card += &format!("| model | [{stem}.toml]({stem}.toml), {numbers} numbers |\n");
        card += &format!("| weights | {} |\n", files.join("; "));
        card += &format!(
            "| made by | `realo-lab train {}` |\n| commit | {} |\n",
            self.recipe, self.commit
        );
        card += &format!("| time of all steps | {} on {} |\n\n", hours(seconds), self.machine);
        card +=
            "## Stages\n\nEach begins with the weights of the one that it names, the first with random numbers.\n\n";
        card += &self.stages();
        card += &format!(
            "\nData: {}. Products of convolutions in {}.\n\n## Scores\n\n{}\n\n{}\n",
            self.made.data,
            self.made.arithmetic,
            score::about(&stem, &self.model),
            score::table(&self.score)
        );
        if self.curve().is_some() {
            card += &format!("![Loss and learning rate of the last training]({stem}.svg)\n\n");
        }
        let limits = text.map_or(&[][..], |text| &text.limits);
        if !limits.is_empty() {
            card += "## Limits\n\n";
            limits.iter().for_each(|limit| card += &format!("- {}\n", limit.trim()));
        }
        card.trim_end().to_string() + "\n"
    }

    fn stages(&self) -> String {
        let mut lines = String::from(
            "| stage | begins with | steps × samples | max rate | squares | stays as it is | time |\n|---|---|---:|---:|---:|---|---:|\n",
        );
        for made in &self.way {
            let stage = &made.stage;
            lines += &match stage.steps {
                Some(steps) => format!(
                    "| {} | {} | {steps} × {} | {} | {} | {} | {} |\n",
                    stage.name,
                    stage.from.as_deref().unwrap_or("random numbers"),
                    stage.batch,
                    stage.rate.map_or("usual".into(), |rate| format!("{rate:e}")),
                    stage.parts,
                    stays(stage),
                    hours(made.seconds)
                ),
                None => format!(
                    "| {} | the mean of {} | – | – | – | – | – |\n",
                    stage.name,
                    stage.mean.join(" and ")
                ),
            };
        }
        lines
    }
}

/// What of a network a stage leaves as it is.
fn stays(stage: &Stage) -> String {
    let mut parts: Vec<String> = stage.freeze.iter().map(|part| part.to_string()).collect();
    let tuned = stage.frozen_norms.unwrap_or(stage.from.is_some());
    parts.extend(tuned.then(|| "norms".to_string()));
    match parts.is_empty() {
        true => "–".into(),
        false => parts.join(", "),
    }
}

/// The stages that led to one, in order.
fn way<'a>(all: &'a [Made], last: &'a Made) -> Vec<&'a Made> {
    let mut needed = BTreeSet::from([last.stage.name.as_str()]);
    let mut way = Vec::new();
    for made in all.iter().rev() {
        if needed.contains(made.stage.name.as_str()) {
            let stage = &made.stage;
            needed.extend(
                stage
                    .from
                    .iter()
                    .chain(&stage.teacher)
                    .chain(&stage.mean)
                    .map(String::as_str),
            );
            way.push(made);
        }
    }
    way.reverse();
    way
}
