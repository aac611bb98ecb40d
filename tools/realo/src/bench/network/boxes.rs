//! Whether a network of bytes finds the boxes that it finds in f32.

use std::fmt;

use eyre::{Result, ensure};
use realo_bev::Decoder;
use realo_kernels::agents::Agent;
use realo_kernels::canvas::Canvas;
use realo_methods::Model;
use realo_methods::network::{Heads, Network, NetworkOptions};
use realo_nn::anchors::Anchors;
use realo_nn::model::Precision;
use realo_nn::weights::Weights;
use realo_schemas::Box3;
use realo_schemas::geometry::{Footprint, iou};
use serde::Serialize;

/// Candidates before suppression of duplicates, in f32: their smallest score is the threshold of both.
const CANDIDATES: usize = 800;
/// Spread of scores before the sigmoid and of deltas, about those of trained detectors. Heads are linear, so that it does not
/// matter whether their weights or their results are brought to it; those that nobody trained give numbers of any size.
const SCORES: f32 = 1.5;
const DELTAS: f32 = 0.2;
/// What counts as the same box.
const SAME_SCORE: f32 = 0.02;
const SAME_IOU: f64 = 0.95;

/// Boxes after suppression in int8 beside those in f32, of one frame.
#[derive(Clone, Debug, Serialize)]
pub struct Agreement {
    model: String,
    /// In f32.
    boxes: usize,
    /// In int8.
    boxes_int8: usize,
    /// Share of the boxes in f32 that one of int8 overlaps by more than half.
    matched: f64,
    /// Share of these whose score is within 0.02 and whose IoU is at least 0.95.
    same: f64,
    /// Of the matched ones.
    max_score_difference: f32,
    /// Of the matched ones.
    min_iou: f64,
    median_iou: f64,
    /// What int8 changes in a score before the sigmoid and in a delta, root mean square, over their spread.
    noise: [f64; 2],
}

/// Whose weights a network has.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Trained {
    /// They are trained: boxes are those above the model's threshold.
    Yes,
    /// Nobody trained them: heads are brought to the spread of trained ones, boxes are the best ones.
    No,
}

/// Compares the boxes of a frame of an agent alone.
pub fn agreement(
    model: &Model,
    weights: &Weights,
    trained: Trained,
    canvas: &Canvas,
    threads: usize,
) -> Result<Agreement> {
    let heads = |precision| -> Result<Heads> {
        let options = NetworkOptions {
            precision: Some(precision),
            threads,
            ..NetworkOptions::default()
        };
        let mut network = Network::new(model, weights, options)?;
        let map = network.encode(canvas)?;
        let map = match model.arch.fuses() {
            true => network.fuse(&[Agent::beside(&map)])?,
            false => map,
        };
        Ok(network.heads(&map)?.clone())
    };
    let (mut single, mut bytes) = (heads(Precision::F32)?, heads(Precision::Int8)?);
    let anchors = Anchors::of(model);
    let threshold = match trained {
        Trained::Yes => model.score_threshold,
        Trained::No => {
            spread([&mut single.scores, &mut bytes.scores], SCORES);
            spread([&mut single.deltas, &mut bytes.deltas], DELTAS);
            threshold(&single.scores, anchors.classes.len())
        }
    };
    let decoder = Decoder::new(anchors, threshold);
    let boxes = |heads: &Heads| -> Vec<Box3> {
        let boxes = decoder.decode(&heads.scores, &heads.deltas).boxes;
        let kept = realo_nms::nms(&boxes, &realo_nms::Config::default(), None).kept;
        kept.iter().map(|index| boxes[*index as usize].clone()).collect()
    };
    let noise = [
        noise(&single.scores, &bytes.scores),
        noise(&single.deltas, &bytes.deltas),
    ];
    let (single, bytes) = (boxes(&single), boxes(&bytes));
    ensure!(!single.is_empty(), "{}: expected boxes in f32, found none", model.name);
    Ok(compared(&model.name, &single, &bytes, noise))
}

/// The score that so many anchors exceed.
fn threshold(logits: &[f32], classes: usize) -> f32 {
    let max = |scores: &[f32]| scores.iter().copied().fold(f32::NEG_INFINITY, f32::max);
    let mut max: Vec<f32> = logits.chunks_exact(classes).map(max).collect();
    max.sort_by(|a, b| b.total_cmp(a));
    let logit = max[CANDIDATES.min(max.len() - 1)];
    1.0 / (1.0 + (-logit).exp())
}

/// How far numbers in int8 are off, over the spread of those in f32.
fn noise(single: &[f32], bytes: &[f32]) -> f64 {
    let square = |numbers: &mut dyn Iterator<Item = f64>| numbers.map(|number| number * number).sum::<f64>();
    let mean = single.iter().map(|number| f64::from(*number)).sum::<f64>() / single.len() as f64;
    let off = square(&mut single.iter().zip(bytes).map(|(a, b)| f64::from(a - b)));
    (off / square(&mut single.iter().map(|number| f64::from(*number) - mean))).sqrt()
}

/// Brings the first numbers to a mean of 0 and a spread, and the second ones in the same way.
fn spread([first, second]: [&mut [f32]; 2], wanted: f32) {
    let count = first.len() as f64;
    let mean = first.iter().map(|number| f64::from(*number)).sum::<f64>() / count;
    let squares = first.iter().map(|number| (f64::from(*number) - mean).powi(2));
    let factor = f64::from(wanted) / (squares.sum::<f64>() / count).sqrt();
    for number in first.iter_mut().chain(second) {
        *number = ((f64::from(*number) - mean) * factor) as f32;
    }
}

fn compared(model: &str, single: &[Box3], bytes: &[Box3], noise: [f64; 2]) -> Agreement {
    let footprints: Vec<Footprint> = bytes.iter().map(Footprint::of).collect();
    let pair = |object: &Box3| {
        let own = Footprint::of(object);
        let ious = footprints
            .iter()
            .zip(bytes)
            .map(|(other, found)| (iou(&own, other), found.score));
        ious.max_by(|a, b| a.0.total_cmp(&b.0))
            .filter(|(iou, _)| *iou > 0.5)
            .map(|(iou, score)| (iou, (score - object.score).abs()))
    };
    let pairs: Vec<(f64, f32)> = single.iter().filter_map(pair).collect();
    let same = pairs
        .iter()
        .filter(|(iou, score)| *iou >= SAME_IOU && *score <= SAME_SCORE)
        .count();
    let mut ious: Vec<f64> = pairs.iter().map(|(iou, _)| *iou).collect();
    ious.sort_by(f64::total_cmp);
    Agreement {
        model: model.into(),
        boxes: single.len(),
        boxes_int8: bytes.len(),
        matched: pairs.len() as f64 / single.len() as f64,
        same: same as f64 / single.len() as f64,
        max_score_difference: pairs.iter().map(|(_, score)| *score).fold(0.0, f32::max),
        min_iou: ious.first().copied().unwrap_or(0.0),
        median_iou: ious.get(ious.len() / 2).copied().unwrap_or(0.0),
        noise,
    }
}

impl fmt::Display for Agreement {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        write!(
            f,
            "boxes of {}: {} in f32, {} in int8; {:.1} % lie over one of int8, {:.1} % are the same; of those that lie over one, \
             scores differ by {:.4} at most, IoU is {:.3} at least, {:.3} in the middle; noise {:.1} % of scores, {:.1} % of deltas",
            self.model,
            self.boxes,
            self.boxes_int8,
            100.0 * self.matched,
            100.0 * self.same,
            self.max_score_difference,
            self.min_iou,
            self.median_iou,
            100.0 * self.noise[0],
            100.0 * self.noise[1]
        )
    }
}
