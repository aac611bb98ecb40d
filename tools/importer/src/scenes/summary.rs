//! What was imported of a scene, in numbers and words.

use std::collections::BTreeMap;
use std::fmt;
use std::path::{Path, PathBuf};

use serde::Serialize;

use super::Residual;
use crate::clouds::LOOKED_AT;
use crate::faults::listed;

/// What was imported of an agent.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct AgentSummary {
    /// Its folder.
    pub folder: String,
    /// Its name in the log.
    pub name: String,
    /// Sweeps.
    pub sweeps: usize,
    /// Points of all sweeps.
    pub points: usize,
    /// Labels of its own side.
    pub labels: usize,
    /// Height of its LiDAR over the ground, m; 0 where each sweep has its own.
    pub height_m: f64,
    /// How its intensities became bytes.
    pub intensities: String,
    /// How times of its points are read, where its files leave that open.
    pub times: String,
    /// Sweeps whose file has no pose of the LiDAR, by the key of another pose that was taken for it.
    pub poses_of: BTreeMap<String, usize>,
}

/// What was imported of a scene.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct SceneSummary {
    /// Its name.
    pub scene: String,
    /// The log; `None` if it was not written.
    pub log: Option<PathBuf>,
    /// Whether the log was there already and is as it was; then only the frames that it should have are known.
    pub was_there: bool,
    /// Its agents.
    pub agents: Vec<AgentSummary>,
    /// Frames that are in the log.
    pub frames: usize,
    /// Frames that were left out, because something of them is missing or damaged.
    pub incomplete_frames: usize,
    /// What is missing or damaged of them, by cause.
    pub missing: BTreeMap<String, Vec<String>>,
    /// Boxes of the ground truths of all agents.
    pub truth_boxes: usize,
    /// Sweeps that are not scored, for their files say so.
    pub unscored: usize,
    /// Labels of all sides by class.
    pub classes: BTreeMap<String, usize>,
    /// Labels that were dropped, as they have no size or are of no object.
    pub dropped_labels: usize,
    /// Intensities that were limited to 0…255 after they were scaled.
    pub limited_intensities: usize,
    /// How well the clouds of two agents fit each other.
    pub residuals: Vec<Residual>,
    /// Folders of agents that were not wanted: what only they labelled is in no ground truth.
    pub unwanted: Vec<String>,
    /// What the data set does not say, a line each.
    pub assumed: Vec<String>,
    /// Whether the data set has labels of all agents together, which are the truth.
    pub has_given_truth: bool,
    /// What is strange in files, and was taken, by cause.
    pub noted: BTreeMap<String, Vec<String>>,
}

impl fmt::Display for SceneSummary {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        if self.was_there {
            return write!(
                f,
                "scene `{}`: its log is there and stays as it is (--resume)",
                self.scene
            );
        }
        write!(f, "scene `{}`: {} frames", self.scene, self.frames)?;
        for agent in &self.agents {
            let AgentSummary {
                folder,
                name,
                sweeps,
                points,
                labels,
                ..
            } = agent;
            write!(
                f,
                "\n`{folder}` is `{name}`: {sweeps} sweeps, {points} points, {labels} labels"
            )?;
            if agent.height_m > 0.0 {
                write!(f, ", LiDAR {:.2} m over the ground", agent.height_m)?;
            }
            write!(f, "\nintensities of `{name}`: {}", agent.intensities)?;
            if !agent.times.is_empty() {
                write!(f, "\ntimes of points of `{name}`: {}", agent.times)?;
            }
        }
        let classes: Vec<String> = self.classes.iter().map(|(class, n)| format!("{n} {class}")).collect();
        write!(f, "\nlabels: {}", classes.join(", "))?;
        let from = match self.has_given_truth {
            true => "the cooperative labels",
            false => "the labels of all agents together",
        };
        write!(f, "\ntruth: {} boxes, {from}", self.truth_boxes)?;
        if self.unscored > 0 {
            write!(f, "\nnot scored: {} sweeps, as their files say", self.unscored)?;
        }
        self.lacks(f)?;
        for line in &self.assumed {
            write!(f, "\nassumed: {line}")?;
        }
        for AgentSummary {
            name, sweeps, poses_of, ..
        } in &self.agents
        {
            for (key, count) in poses_of {
                write!(
                    f,
                    "\nassumed: in {count} of {sweeps} sweeps of `{name}` the LiDAR is where `{key}` says its vehicle is, because the \
                     files have no pose of the LiDAR (--pose-key)"
                )?;
            }
        }
        for residual in &self.residuals {
            write!(f, "\n{residual}")?;
        }
        self.left_out(f)
    }
}

impl SceneSummary {
    /// Of a scene whose log is there already.
    pub fn there(scene: &str, log: &Path, frames: usize) -> Self {
        SceneSummary {
            scene: scene.into(),
            log: Some(log.into()),
            frames,
            was_there: true,
            ..SceneSummary::default()
        }
    }

    /// Whose labels the ground truth lacks.
    fn lacks(&self, f: &mut fmt::Formatter) -> fmt::Result {
        if self.has_given_truth {
            return Ok(());
        }
        if !self.unwanted.is_empty() {
            let left = self.unwanted.join("`, `");
            write!(f, "\nthe truth lacks what only `{left}` labelled (--agents)")?;
        }
        let sweeps: usize = self.agents.iter().map(|agent| agent.sweeps).sum();
        if self.agents.len() > 1 && self.frames > 1 && sweeps == self.frames {
            return write!(
                f,
                "\nNO FRAME IS OF TWO AGENTS: sweeps of one time must have one number; numbers are no stamps"
            );
        }
        for AgentSummary { name, sweeps, .. } in &self.agents {
            let gone = self.frames.saturating_sub(*sweeps);
            if gone > 0 {
                let frames = self.frames;
                write!(
                    f,
                    "\nthe truth of {gone} of {frames} frames lacks what only `{name}` labelled: it has no sweep there"
                )?;
            }
        }
        Ok(())
    }

    fn left_out(&self, f: &mut fmt::Formatter) -> fmt::Result {
        if self.dropped_labels > 0 {
            write!(
                f,
                "\ndropped: {} labels without a size, or of no object",
                self.dropped_labels
            )?;
        }
        if self.limited_intensities > 0 {
            let limited = self.limited_intensities;
            write!(
                f,
                "\nlimited: {limited} intensities below 0 or brighter than those of the first {LOOKED_AT} sweeps"
            )?;
        }
        if !self.noted.is_empty() {
            write!(f, "\nnote: taken as it is:\n{}", listed(&self.noted))?;
        }
        if self.incomplete_frames > 0 {
            let (frames, missing) = (self.incomplete_frames, listed(&self.missing));
            write!(f, "\nleft out: {frames} frames; missing or damaged:\n{missing}")?;
        }
        Ok(())
    }
}
