//! What was imported, in numbers and words.

use std::collections::BTreeMap;
use std::fmt;

use serde::Serialize;

use crate::clouds::LOOKED_AT;
use crate::faults::listed;

/// What was imported.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Summary {
    /// Pairs of sweeps.
    pub pairs: usize,
    /// Pairs that were left out, for something of them is missing or damaged.
    pub incomplete_pairs: usize,
    /// What is missing or damaged of them, by cause.
    pub missing: BTreeMap<String, Vec<String>>,
    /// What is wrong with entries of lists that no pair needs, by cause.
    pub unneeded: BTreeMap<String, Vec<String>>,
    /// Points of all clouds.
    pub points: usize,
    /// Labels of the vehicle's sweeps.
    pub vehicle_boxes: usize,
    /// Labels of the roadside sweeps.
    pub roadside_boxes: usize,
    /// Cooperative labels: the ground truth.
    pub truth_boxes: usize,
    /// Labels without extent, which were annotated in the image only.
    pub placeholders_dropped: usize,
    /// Sweeps that stand in several pairs and were taken once.
    pub repeated_sweeps: usize,
    /// What is assumed, a line each.
    pub assumed: Vec<String>,
    /// How well the clouds of both fit each other in the map; `None` where too little is seen by both.
    pub overlap: Option<String>,
    /// How the intensities of each agent became bytes.
    pub intensities: Vec<String>,
    /// Intensities that were limited to 0…255 after they were scaled.
    pub limited_intensities: usize,
}

impl fmt::Display for Summary {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        writeln!(f, "{} pairs, {} points", self.pairs, self.points)?;
        writeln!(
            f,
            "labels: {} of the vehicle, {} of the roadside unit, {} cooperative",
            self.vehicle_boxes, self.roadside_boxes, self.truth_boxes
        )?;
        write!(
            f,
            "dropped: {} placeholder labels, {} repeated sweeps",
            self.placeholders_dropped, self.repeated_sweeps
        )?;
        for line in &self.assumed {
            write!(f, "\nassumed: {line}")?;
        }
        if let Some(overlap) = &self.overlap {
            write!(f, "\n{overlap}")?;
        }
        for rule in &self.intensities {
            write!(f, "\nintensities {rule}")?;
        }
        if self.limited_intensities > 0 {
            let limited = self.limited_intensities;
            write!(
                f,
                "\nlimited: {limited} intensities below 0 or brighter than those of the first {LOOKED_AT} pairs"
            )?;
        }
        if self.incomplete_pairs > 0 {
            let (pairs, missing) = (self.incomplete_pairs, listed(&self.missing));
            write!(f, "\nleft out: {pairs} pairs; missing or damaged:\n{missing}")?;
        }
        if !self.unneeded.is_empty() {
            let entries = listed(&self.unneeded);
            write!(
                f,
                "\nnote: entries that were skipped, and that no pair needs:\n{entries}"
            )?;
        }
        Ok(())
    }
}
