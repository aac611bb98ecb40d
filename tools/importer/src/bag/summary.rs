//! What was imported of bags, in numbers and words.

use std::collections::BTreeMap;
use std::fmt;
use std::path::PathBuf;

use realo_bags::printable;
use serde::Serialize;

use crate::Residual;

/// What was imported of an agent.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct BagAgent {
    /// Its name in the log.
    pub name: String,
    /// Sweeps.
    pub sweeps: usize,
    /// Points of all sweeps.
    pub points: usize,
    /// Poses.
    pub poses: usize,
    /// Poses with a covariance.
    pub covariances: usize,
    /// Messages of its inertial unit, its receiver and its wheels.
    pub motion: [usize; 3],
    /// Sweeps with truth.
    pub truths: usize,
    /// Sweeps whose truth is of another time, and was brought to theirs.
    pub moved_truths: usize,
    /// Sweeps that are left unscored, as their truth could not be placed or is no boxes.
    pub unplaced_truths: usize,
    /// Sweeps with recorded detections.
    pub detections: usize,
    /// Height of its frame over the ground, m.
    pub height_m: f64,
    /// Its topics and frames, in words.
    pub clouds: String,
    /// Where its poses come from.
    pub pose_words: String,
    /// How times of points are read.
    pub times: String,
    /// How intensities became bytes.
    pub intensities: String,
}

/// What was imported of bags.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct BagSummary {
    /// The log.
    pub log: PathBuf,
    /// Bags, in words.
    pub bags: Vec<String>,
    /// What is missing of them or strange about them.
    pub notes: Vec<String>,
    /// What is probably not as it should be.
    pub warnings: Vec<String>,
    /// Topics of theirs that were decoded from packets.
    pub decoded: Vec<String>,
    /// Its agents.
    pub agents: Vec<BagAgent>,
    /// How the clocks were joined.
    pub clocks: Vec<String>,
    /// Boxes of truth by class.
    pub classes: BTreeMap<String, usize>,
    /// Messages that were left out, by reason.
    pub left_out: BTreeMap<String, usize>,
    /// Intensities that were limited to 0…255 after they were scaled.
    pub limited_intensities: u64,
    /// How well the clouds of two agents fit each other.
    pub residuals: Vec<Residual>,
    /// The map file that was drafted, where nobody gave one.
    pub draft: Option<String>,
    /// The world's frame, and which time counts.
    pub world: String,
}

/// What notes say of bags of which nothing is missing, as parts of them.
const WHOLE: [&str; 4] = [
    "it is a log of realo",
    "there is no metadata.yaml",
    "packets of `",
    "packets are no UDP over IPv4",
];

impl BagSummary {
    /// Whether a note says that something of a bag is missing, as of one that was cut or not closed.
    pub fn is_partial(&self) -> bool {
        let is_whole = |note: &String| WHOLE.iter().any(|part| note.contains(part));
        !self.notes.iter().all(is_whole)
    }
}

impl fmt::Display for BagAgent {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let BagAgent {
            name,
            sweeps,
            points,
            poses,
            ..
        } = self;
        write!(
            f,
            "`{name}`: {sweeps} sweeps of {}, {points} points, {poses} poses",
            printable(&self.clouds)
        )?;
        if self.truths > 0 {
            let moved = self.moved_truths;
            write!(f, ", {} sweeps with truth ({moved} moved to their time)", self.truths)?;
        }
        if self.unplaced_truths > 0 {
            let unplaced = self.unplaced_truths;
            write!(
                f,
                ", {unplaced} sweeps LEFT UNSCORED as their truth could not be placed or is no boxes (see `left out`)"
            )?;
        }
        if self.detections > 0 {
            write!(f, ", {} sweeps with detections", self.detections)?;
        }
        write!(f, "\n  poses: {}", printable(&self.pose_words))?;
        if self.covariances > 0 {
            write!(f, "; {} with a covariance", self.covariances)?;
        }
        if self.motion != [0; 3] {
            let [imu, fixes, wheels] = self.motion;
            write!(
                f,
                "\n  motion sensors: {imu} samples of the inertial unit, {fixes} positions, {wheels} speeds of the wheels"
            )?;
        }
        write!(
            f,
            "\n  frame {:.2} m over the ground; times: {}",
            self.height_m, self.times
        )?;
        write!(f, "\n  intensities: {}", self.intensities)
    }
}

impl fmt::Display for BagSummary {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let lines = |f: &mut fmt::Formatter, head: &str, lines: &[String]| {
            lines
                .iter()
                .try_for_each(|line| writeln!(f, "{head}{}", printable(line)))
        };
        lines(f, "bag: ", &self.bags)?;
        lines(f, "note: ", &self.notes)?;
        lines(f, "", &self.decoded)?;
        if let Some(draft) = &self.draft {
            writeln!(f, "without --map, this draft was taken:\n{}", draft.trim_end())?;
        }
        write!(f, "{}", self.world)?;
        for agent in &self.agents {
            write!(f, "\n{agent}")?;
        }
        for clock in &self.clocks {
            write!(f, "\n{}", printable(clock))?;
        }
        let classes: Vec<String> = self.classes.iter().map(|(class, n)| format!("{n} {class}")).collect();
        match classes.is_empty() {
            true => write!(
                f,
                "\nno truth: a run reports rates, ages, bytes and boxes, and no score"
            )?,
            false => write!(f, "\ntruth: {}", printable(&classes.join(", ")))?,
        }
        for warning in &self.warnings {
            write!(f, "\nwarning: {}", printable(warning))?;
        }
        for residual in &self.residuals {
            write!(f, "\n{residual}")?;
        }
        if self.limited_intensities > 0 {
            let limited = self.limited_intensities;
            write!(
                f,
                "\nlimited: {limited} intensities below 0 or brighter than those of the first sweeps"
            )?;
        }
        self.left_out
            .iter()
            .try_for_each(|(reason, n)| write!(f, "\nleft out: {n} × {}", printable(reason)))
    }
}
