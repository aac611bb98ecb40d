//! Rotated non-maximum suppression on the ground plane.
//!
//! A box is dropped if a kept one of better score (at equal scores: of lower index) has an IoU above the threshold with
//! it. Before that: invalid boxes (NaN, an extent that is not positive, a score outside [0, 1]) are rejected and counted,
//! boxes outside the region and below the smallest score are dropped, and only the best `max_boxes` stay candidates. With `vote`,
//! a kept box is then moved to the mean of itself and the candidates that overlap it: several views of an object, of one
//! network's anchors or of several agents whose poses are a little off, err less than the best of them. Boxes on a second input
//! only fill gaps between the others.

mod grid;
mod operator;
mod rtree;
mod suppress;
mod vote;

use std::collections::BTreeMap;

use grid::Neighbours;
use realo_schemas::Box3;
use realo_schemas::geometry::{Footprint, Region, is_plausible};

pub use operator::{Input, Nms, NmsError, Output, Settings};
pub use suppress::{Index, Ties, order, suppress};
use vote::vote;

/// What suppression did with a list of boxes.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Outcome {
    /// Indices of the kept boxes, best score first.
    pub kept: Vec<u32>,
    /// The kept boxes, after the vote.
    pub boxes: Vec<Box3>,
    /// Boxes that no object can have: see [`is_plausible`].
    pub invalid: u64,
    /// Boxes outside the region.
    pub outside: u64,
    /// Boxes below the smallest score.
    pub low_score: u64,
    /// Boxes beyond the largest number.
    pub over_limit: u64,
    /// Duplicates.
    pub suppressed: u64,
}

/// Suppresses duplicates among boxes of one frame.
pub fn nms(boxes: &[Box3], settings: &Settings, region: Option<&Region>) -> Outcome {
    nms_filled(boxes, &[], settings, region)
}

/// The same, with boxes that only fill gaps: whatever their scores, they come after all others, and have no vote. Indices go on behind
/// those of the others.
pub fn nms_filled(boxes: &[Box3], fill: &[Box3], settings: &Settings, region: Option<&Region>) -> Outcome {
    let mut outcome = Outcome::default();
    let all = || boxes.iter().chain(fill);
    let mut candidates: Vec<u32> = Vec::with_capacity(boxes.len() + fill.len());
    for (object, index) in all().zip(0u32..) {
        if !is_plausible(object) {
            outcome.invalid += 1;
        } else if region.is_some_and(|region| !region.contains_box(object)) {
            outcome.outside += 1;
        } else if object.score < settings.min_score {
            outcome.low_score += 1;
        } else {
            candidates.push(index);
        }
    }
    let objects: Vec<&Box3> = all().collect();
    let of = |i: u32| objects[candidates[i as usize] as usize];
    let scores: Vec<f32> = (0..).take(candidates.len()).map(|i| of(i).score).collect();
    let footprints: Vec<Footprint> = (0..).take(candidates.len()).map(|i| Footprint::of(of(i))).collect();
    let first = candidates.partition_point(|index| (*index as usize) < boxes.len());
    let voters = candidates_in_order(&scores[..first], settings);
    let filling = candidates_in_order(&scores[first..], settings);
    let order: Vec<u32> = voters
        .iter()
        .copied()
        .chain(filling.iter().map(|i| i + first as u32))
        .collect();
    outcome.over_limit = (scores.len() - order.len()) as u64;
    let mut kept = if settings.per_class {
        suppress_per_class(&footprints, &order, |i| &*of(i).class, settings)
    } else {
        suppress(&footprints, &order, settings.threshold, settings.index)
    };
    outcome.suppressed = (order.len() - kept.len()) as u64;
    if !filling.is_empty() {
        kept.sort_by(|a, b| scores[*b as usize].total_cmp(&scores[*a as usize]));
    }
    let object = |i: u32| (of(i), &footprints[i as usize]);
    outcome.boxes = match settings.vote < 1.0 {
        true => {
            let neighbours = Neighbours::new(&footprints, &voters);
            let voted = |i: &u32| match (*i as usize) < first {
                true => vote(object(*i), neighbours.of(*i).into_iter().map(object), settings.vote),
                false => of(*i).clone(),
            };
            kept.iter().map(voted).collect()
        }
        false => kept.iter().map(|i| of(*i).clone()).collect(),
    };
    outcome.kept = kept.into_iter().map(|i| candidates[i as usize]).collect();
    outcome
}

/// Suppresses duplicates among footprints of one frame, whatever their classes: indices of the kept ones, best score
/// first. Scores must not be NaN.
pub fn keep(footprints: &[Footprint], scores: &[f32], settings: &Settings) -> Vec<u32> {
    suppress(
        footprints,
        &candidates_in_order(scores, settings),
        settings.threshold,
        settings.index,
    )
}

fn candidates_in_order(scores: &[f32], settings: &Settings) -> Vec<u32> {
    let mut order = order(scores, settings.ties);
    order.truncate(settings.max_boxes);
    order
}

fn suppress_per_class<'a>(
    footprints: &[Footprint],
    order: &[u32],
    class: impl Fn(u32) -> &'a str,
    settings: &Settings,
) -> Vec<u32> {
    let mut classes: BTreeMap<&str, Vec<u32>> = BTreeMap::new();
    for &index in order {
        classes.entry(class(index)).or_default().push(index);
    }
    let mut is_kept = vec![false; footprints.len()];
    for members in classes.values() {
        for index in suppress(footprints, members, settings.threshold, settings.index) {
            is_kept[index as usize] = true;
        }
    }
    order.iter().copied().filter(|index| is_kept[*index as usize]).collect()
}
