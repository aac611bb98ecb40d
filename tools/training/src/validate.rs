//! How good a network is on frames that it was not trained on.

use std::path::Path;
use std::sync::Arc;

use crate::targets::Object;
use realo_kernels::agents::Agent;
use realo_methods::network::Network as Inference;
use realo_methods::{Kernels, Model, Pillarer, load};
use realo_nn::anchors::{Anchors, Hwl};
use realo_nn::decode::{Detection, candidates};
use realo_nn::weights::Weights;
use realo_schemas::geometry::{Footprint, iou, iou_exceeds};

use crate::TrainError;
use crate::data::{
    AgentSweep, Augmentation, Cast, Decoys, Frame, Frames, MapEncoder, Member, Party, Project, Scene, gather, near,
};
use crate::fusing::fuses;
use crate::layers::{MapShape, with_numbers};
use crate::network::{Network, inner};
use crate::random::Stream;
use crate::tape::Tape;
use crate::train::check_frames_suit;

/// A box is left out if it overlaps more than this with a better one.
const SUPPRESSED: f64 = 0.15;
const MOST_CANDIDATES: usize = 1000;
/// Scores from which boxes count; the curve of precision and recall needs low ones too.
const THRESHOLD: f32 = 0.1;

/// Average precision by class, for several ways to perceive.
#[derive(Clone, Debug, PartialEq)]
pub struct Validation {
    /// Frames that were looked at; each from every vehicle.
    pub frames: usize,
    /// For each class its name, the IoU from which a box is right, and what was reached.
    pub classes: Vec<ClassScore>,
}

impl Validation {
    /// Mean over classes and ways with objects; `None` without any.
    pub fn mean(&self) -> Option<f64> {
        let classes: Vec<f64> = self.classes.iter().filter_map(ClassScore::mean).collect();
        (!classes.is_empty()).then(|| classes.iter().sum::<f64>() / classes.len() as f64)
    }
}

impl ClassScore {
    /// Mean over the ways with objects; `None` without any.
    pub fn mean(&self) -> Option<f64> {
        let reached: Vec<f64> = self.reached.iter().filter_map(|(_, ap)| *ap).collect();
        (!reached.is_empty()).then(|| reached.iter().sum::<f64>() / reached.len() as f64)
    }
}

/// Average precision of one class: all detections by score, the area under the curve made monotonous.
#[derive(Clone, Debug, PartialEq)]
pub struct ClassScore {
    /// Name.
    pub name: String,
    /// Smallest IoU on the ground plane.
    pub iou: f64,
    /// Each way by name, and what was reached on objects with at least 5 points of those who take part.
    pub reached: Vec<(&'static str, Option<f64>)>,
}

/// The ways of a detector: an ego alone, and the clouds of all within 70 m in one.
const OF_DETECTORS: [&str; 2] = ["alone", "merged"];

/// The ways of a fusion: an ego alone, and with the maps of others within 70 m, brought to its frame by them as points or by
/// the fusion as maps.
const OF_FUSIONS: [&str; 3] = ["alone", "by sender", "by receiver"];

/// Scores a network in training on frames, with each vehicle of a frame as ego.
///
/// # Errors
/// [`TrainError`] if a frame cannot be had or a layer fails.
pub fn validate(network: &Network, frames: &Arc<dyn Frames>) -> Result<Validation, TrainError> {
    let model = network.model();
    validate_by(model, frames, |scene| {
        let sample = scene.sample(model);
        let objects = sample.objects.clone();
        let (pillars, _) = gather(model, vec![sample]);
        Ok((detect(network, &pillars)?, objects))
    })
}

/// Frames that are searched for decoys.
const SEARCHED: usize = 48;

/// What a network in training takes for objects in some frames where none are.
///
/// # Errors
/// [`TrainError`] if a frame cannot be had or a layer fails.
pub(crate) fn decoys(network: &Network, frames: &Arc<dyn Frames>, draws: &mut Stream) -> Result<Decoys, TrainError> {
    let (model, how, mut decoys) = (network.model(), Augmentation::none(), Decoys::default());
    for _ in 0..SEARCHED {
        let frame = frames.load(draws.below(frames.len()))?;
        let cast = Cast::draw(&frame, &how, draws);
        let parts = cast.parts(&frame, &how, draws);
        let scene = Scene::new(&frame, &parts, model, &how, draws);
        let (pillars, _) = gather(model, vec![scene.clone().sample(model)]);
        decoys.add(&scene, &detect(network, &pillars)?);
    }
    Ok(decoys)
}

/// Scores what finds boxes on frames, with each vehicle of a frame as ego; `detect`: the boxes of a scene, best first and
/// without duplicates, and its objects.
///
/// # Errors
/// [`TrainError`] if a frame cannot be had, and those of `detect`.
pub(crate) fn validate_by(
    model: &Model,
    frames: &Arc<dyn Frames>,
    mut detect: impl FnMut(Scene) -> Result<(Vec<Detection>, Vec<Object>), TrainError>,
) -> Result<Validation, TrainError> {
    let mut books = Books::new(model, &OF_DETECTORS);
    each_scene(model, frames, |merged, scene| {
        let (found, objects) = detect(scene)?;
        books.add(usize::from(merged), &found, &objects);
        Ok(())
    })?;
    Ok(books.close(frames.len()))
}

/// Scores a network that learns to fuse on frames, with each vehicle of a frame as ego.
///
/// # Errors
/// [`TrainError`] if a frame cannot be had or the network does not run.
pub(crate) fn validate_fusion(network: &Network, frames: &Arc<dyn Frames>) -> Result<Validation, TrainError> {
    let model = network.model();
    let encoder = MapEncoder::new(model, &network.weights()?, rayon::current_num_threads())?;
    validate_maps(model, encoder, frames)
}

/// As [`validate_fusion`], of maps and boxes that an inference network makes.
fn validate_maps(model: &Model, mut encoder: MapEncoder, frames: &Arc<dyn Frames>) -> Result<Validation, TrainError> {
    let anchors = Anchors::of(model);
    let mut books = Books::new(model, &OF_FUSIONS);
    let (how, mut draws) = (Augmentation::none(), Stream::new(0, "validation", 0));
    for index in 0..frames.len() {
        let frame = frames.load(index)?;
        for (ego, _) in vehicles(&frame) {
            let mut others = near(&frame, ego);
            others.truncate(model.arch.agents() - 1);
            let all = || others.iter().map(|other| (*other, false)).collect();
            let parties = [
                (Vec::new(), Project::Receiver),
                (all(), Project::Sender),
                (all(), Project::Receiver),
            ];
            for (way, (others, project)) in parties.into_iter().enumerate() {
                let party = Party {
                    ego,
                    others,
                    project,
                    blind: false,
                };
                let view = party.view(&frame, model, &how, &mut draws);
                let maps = encoder.run(&view)?;
                let heads = encoder.detect(&maps)?;
                let found = boxes(&anchors, &heads.scores, &heads.deltas);
                books.add(way, &found, &view.scene.objects_within(&model.grid).0);
            }
        }
    }
    Ok(books.close(frames.len()))
}

/// Scores the weights of a model file by the kernels that run it, on frames, with each vehicle of a frame as ego.
///
/// # Errors
/// [`TrainError`] if model, weights or a frame cannot be had, or frames are not what the model sees.
pub fn score(file: &Path, kernels: Kernels, frames: &Arc<dyn Frames>) -> Result<Validation, TrainError> {
    let loaded = load(file, kernels)?;
    let (model, weights) = (&*loaded.model, &*loaded.weights);
    check_frames_suit(model)?;
    match fuses(model) {
        true => validate_maps(model, MapEncoder::of(model, weights, loaded.network), frames),
        false => score_network(model, weights, loaded.network, frames),
    }
}

/// Scores a network that sees clouds, those of others merged into the ego's.
///
/// # Errors
/// As [`score`].
pub(crate) fn score_network(
    model: &Model,
    weights: &Weights,
    mut network: Inference,
    frames: &Arc<dyn Frames>,
) -> Result<Validation, TrainError> {
    let mut pillarer = Pillarer::beside(&network, model, weights);
    let anchors = Anchors::of(model);
    validate_by(model, frames, |scene| {
        let (canvas, _) = pillarer.run(&scene.points());
        let map = network.encode_own(canvas)?;
        let map = match model.arch.fuses() {
            true => network.fuse(&[Agent::beside(&map)])?,
            false => map,
        };
        let heads = network.heads(&map)?;
        let found = boxes(&anchors, &heads.scores, &heads.deltas);
        Ok((found, scene.objects_within(&model.grid).0))
    })
}

/// What was found and what was there, by way and class.
struct Books<'a> {
    model: &'a Model,
    ways: Vec<(&'static str, Vec<Ledger>)>,
}

impl<'a> Books<'a> {
    fn new(model: &'a Model, ways: &[&'static str]) -> Self {
        let empty = |way: &&'static str| (*way, vec![Ledger::default(); model.classes.len()]);
        Books {
            model,
            ways: ways.iter().map(empty).collect(),
        }
    }

    fn add(&mut self, way: usize, found: &[Detection], objects: &[Object]) {
        for (class, ledger) in self.ways[way].1.iter_mut().enumerate() {
            ledger.add(found, objects, class, min_iou(&self.model.classes[class].name));
        }
    }

    fn close(self, frames: usize) -> Validation {
        let classes = self.model.classes.iter().enumerate();
        let classes = classes.map(|(index, class)| {
            let reached = |(way, ledgers): &(&'static str, Vec<Ledger>)| (*way, ledgers[index].average_precision());
            ClassScore {
                name: class.name.clone(),
                iou: min_iou(&class.name),
                reached: self.ways.iter().map(reached).collect(),
            }
        });
        Validation {
            frames,
            classes: classes.collect(),
        }
    }
}

fn vehicles(frame: &Frame) -> impl Iterator<Item = (usize, &AgentSweep)> {
    let agents = frame.agents.iter().enumerate();
    agents.filter(|(_, agent)| !agent.roadside)
}

/// Looks at every frame as each of its vehicles sees it, alone and with the clouds of all within 70 m.
///
/// # Errors
/// [`TrainError`] if a frame cannot be had, and those of `look`.
pub(crate) fn each_scene(
    model: &Model,
    frames: &Arc<dyn Frames>,
    mut look: impl FnMut(bool, Scene) -> Result<(), TrainError>,
) -> Result<(), TrainError> {
    for index in 0..frames.len() {
        let frame = frames.load(index)?;
        for (ego, _) in vehicles(&frame) {
            for (merged, others) in [(false, Vec::new()), (true, near(&frame, ego))] {
                let (cast, how) = (Cast { ego, others }, Augmentation::none());
                let mut draws = Stream::new(0, "validation", 0);
                let parts = cast.parts(&frame, &how, &mut draws);
                look(merged, Scene::new(&frame, &parts, model, &how, &mut draws))?;
            }
        }
    }
    Ok(())
}

/// The overlaps that are customary.
fn min_iou(class: &str) -> f64 {
    if class == "pedestrian" { 0.3 } else { 0.5 }
}

/// Boxes of a batch of one, best first.
fn detect(network: &Network, pillars: &Arc<crate::layers::PillarBatch>) -> Result<Vec<Detection>, TrainError> {
    let heads = network.forward(&mut Tape::forward_only(), pillars, &[vec![Member::EGO]], false)?;
    let cells = |map: &candle_core::Tensor| {
        let shape = MapShape::of(map.shape())?;
        with_numbers(map, |values| Ok(inner(&shape, values, 0)))
    };
    let (scores, deltas) = (cells(&heads.scores)?, cells(&heads.deltas)?);
    Ok(boxes(&Anchors::of(network.model()), &scores, &deltas))
}

/// The boxes that heads tell, best first.
pub(crate) fn boxes(anchors: &Anchors, scores: &[f32], deltas: &[f32]) -> Vec<Detection> {
    suppress(candidates(anchors, scores, deltas, THRESHOLD, MOST_CANDIDATES).detections)
}

/// The outline of a box on the ground plane.
pub(crate) fn footprint(hwl: &Hwl<f64>) -> Footprint {
    Footprint::new([hwl[0], hwl[1]], hwl[5], hwl[4], hwl[6])
}

/// Keeps what overlaps little with everything better.
fn suppress(detections: Vec<Detection>) -> Vec<Detection> {
    let mut kept: Vec<(Footprint, Detection)> = Vec::new();
    for detection in detections.into_iter().filter(|d| d.hwl.iter().all(|v| v.is_finite())) {
        let outline = footprint(&detection.hwl.map(f64::from));
        if !kept.iter().any(|(better, _)| iou_exceeds(better, &outline, SUPPRESSED)) {
            kept.push((outline, detection));
        }
    }
    kept.into_iter().map(|(_, detection)| detection).collect()
}

/// What was found of one class, over all frames.
#[derive(Clone, Debug, Default)]
struct Ledger {
    /// Score, and whether it was right.
    found: Vec<(f32, bool)>,
    objects: usize,
}

impl Ledger {
    /// Each detection takes the free object that it overlaps with most.
    fn add(&mut self, found: &[Detection], objects: &[Object], class: usize, min: f64) {
        let mut free: Vec<Footprint> = objects
            .iter()
            .filter(|o| o.class == class)
            .map(|o| footprint(&o.hwl))
            .collect();
        self.objects += free.len();
        for detection in found.iter().filter(|d| d.class == class) {
            let outline = footprint(&detection.hwl.map(f64::from));
            let overlaps = free.iter().map(|object| iou(object, &outline)).enumerate();
            let best = overlaps
                .max_by(|a, b| a.1.total_cmp(&b.1))
                .filter(|(_, overlap)| *overlap >= min);
            self.found.push((detection.score, best.is_some()));
            if let Some((index, _)) = best {
                free.swap_remove(index);
            }
        }
    }

    /// `None` without objects.
    fn average_precision(&self) -> Option<f64> {
        let mut found = self.found.clone();
        found.sort_by(|a, b| b.0.total_cmp(&a.0));
        let hits: Vec<bool> = found.into_iter().map(|(_, hit)| hit).collect();
        realo_scoring::average_precision(&hits, self.objects as u64)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(x: f64, class: usize) -> Object {
        Object {
            class,
            hwl: [x, 0.0, 1.0, 1.5, 2.0, 4.0, 0.0],
        }
    }

    fn found(x: f32, score: f32) -> Detection {
        Detection {
            class: 0,
            score,
            hwl: [x, 0.0, 1.0, 1.5, 2.0, 4.0, 0.0],
        }
    }

    #[test]
    fn average_precision_is_the_area_by_hand() {
        let mut ledger = Ledger::default();
        let objects = [at(0.0, 0), at(10.0, 0), at(20.0, 0), at(30.0, 1)];
        // Right, wrong, right, the same object again: precision 1, 1/2, 2/3, 1/2; recall 1/3, 2/3.
        let detections = [found(0.1, 0.9), found(50.0, 0.8), found(10.2, 0.7), found(0.0, 0.6)];
        ledger.add(&detections, &objects, 0, 0.5);
        assert_eq!(ledger.average_precision(), Some((1.0 + 2.0 / 3.0) / 3.0));
        assert_eq!(Ledger::default().average_precision(), None);
    }

    #[test]
    fn suppression_keeps_the_best_of_those_that_overlap() {
        let mut bad = found(7.0, 0.95);
        bad.hwl[3] = f32::NAN;
        let kept = suppress(vec![found(0.0, 0.9), bad, found(1.0, 0.8), found(9.0, 0.7)]);
        assert_eq!(kept, [found(0.0, 0.9), found(9.0, 0.7)]);
    }
}
