use std::collections::BTreeMap;

use realo_schemas::Nanos;
use serde::{Deserialize, Serialize};

use crate::intervals::{Intervals, intervals};
use crate::matching::Overlaps;
use crate::sequence::{Order, Sequence, sequences};
use crate::table::{Orders, Table, mean_of, table};
use crate::tracking::tracking;
use crate::{Dropped, Evaluation, Frame, Ignored, Outcome, OutsideViews, Protocol, Scene, Scope, TrackScores};

/// The table of an evaluation; all accuracies are fractions in [0, 1].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Scores {
    /// Name of the protocol.
    pub protocol: String,
    /// Against all objects of the mode; a key frame without boxes misses all of its objects.
    pub accuracy: Orders<Accuracy>,
    /// Against the objects that the ego alone sees; the others are ignored.
    pub accuracy_seen: Orders<Accuracy>,
    /// As `accuracy`, over the frames for which boxes came.
    pub accuracy_processed: Orders<Accuracy>,
    /// 95 % intervals by resampling logs; `None` with fewer than two logs.
    pub intervals: Option<Intervals>,
    /// Precision and recall by distance from the ego.
    pub by_range: Table<Vec<RangeBin>>,
    /// Recall by the ego's own points on an object: what it hardly sees others must tell it.
    pub by_points: Table<Vec<PointsBin>>,
    /// Sweeps of the ego.
    pub frames: FrameCounts,
    /// Detections that did not count.
    pub dropped_detections: Dropped,
    /// Objects that did not count.
    pub dropped_truths: Dropped,
    /// What is in no view; `None` where the protocol does not ask.
    #[serde(default)]
    pub in_no_view: Option<Ignored>,
    /// Identities and velocities by class; `None` where detections have no identities, or objects have none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub tracking: Option<BTreeMap<String, TrackScores>>,
    /// Messages with boxes for which no truth came.
    pub boxes_without_truth: u64,
    /// What a reader must know, e.g. why a value is null.
    pub notes: Vec<String>,
}

/// Average precision and what it is made from.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Accuracy {
    /// Average precision; `None` for a class without objects.
    #[serde(rename = "AP")]
    pub ap: Table<Option<f64>>,
    /// Mean over all classes, by IoU; `None` if a class has none.
    #[serde(rename = "mAP")]
    pub mean_ap: BTreeMap<String, Option<f64>>,
    /// Detections and objects.
    pub counts: Table<Counts>,
}

/// Detections that are true and false, and objects.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Counts {
    /// Detections that found an object.
    #[serde(rename = "true")]
    pub true_positives: u64,
    /// Detections that found none.
    #[serde(rename = "false")]
    pub false_positives: u64,
    /// Objects.
    pub total: u64,
}

/// Precision and recall at some distance. An object and what found it count at the object's distance, a false detection
/// at its own.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct RangeBin {
    /// Smallest distance of centres from the ego, m.
    pub from: f64,
    /// Distance that is no longer included, m; `None` in the last bin.
    pub to: Option<f64>,
    /// Detections and objects.
    #[serde(flatten)]
    pub counts: Counts,
    /// True share of the detections; `None` without any.
    pub precision: Option<f64>,
    /// Found share of the objects; `None` without any.
    pub recall: Option<f64>,
}

/// Recall of objects on which the ego has so many points of its own.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct PointsBin {
    /// Smallest points.
    pub from: u64,
    /// Points that are no longer included; `None` in the last bin.
    pub to: Option<u64>,
    /// Objects that were found.
    #[serde(rename = "true")]
    pub true_positives: u64,
    /// Objects.
    pub total: u64,
    /// Found share of the objects; `None` without any.
    pub recall: Option<f64>,
}

/// Sweeps of the ego.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct FrameCounts {
    /// All.
    pub total: u64,
    /// Those that are scored.
    pub key: u64,
    /// Scored ones for which no boxes came.
    pub skipped: u64,
}

/// The counts of one frame, of all classes.
#[derive(Clone, Debug, PartialEq)]
pub struct FrameScore {
    /// Its log.
    pub scene: String,
    /// Its ego.
    pub ego: String,
    /// Number of the sweep.
    pub seq: u64,
    /// Its reference time.
    pub stamp: Nanos,
    /// Detections and objects.
    pub counts: Table<Counts>,
}

/// Scores all scenes together.
pub fn score(evaluation: &Evaluation) -> Scores {
    let protocol = &evaluation.protocol;
    let all = sequences(evaluation, Scope::All);
    let seen = sequences(evaluation, Scope::Seen);
    let processed = |sequence: &Sequence| sequence.processed_total;
    let mut scores = Scores {
        protocol: protocol.name.clone(),
        accuracy: orders(protocol, &all, Sequence::total),
        accuracy_seen: orders(protocol, &seen, Sequence::total),
        accuracy_processed: orders(protocol, &all, processed),
        intervals: intervals(evaluation, &all, &seen),
        by_range: table(protocol, &all, |sequence| range_bins(protocol, sequence)),
        by_points: table(protocol, &all, |sequence| points_bins(protocol, sequence)),
        frames: FrameCounts::default(),
        dropped_detections: Dropped::default(),
        dropped_truths: Dropped::default(),
        in_no_view: (protocol.outside_views == OutsideViews::Ignored).then(|| ignored(evaluation)),
        tracking: tracking(evaluation),
        boxes_without_truth: 0,
        notes: Vec::new(),
    };
    for scene in &evaluation.scenes {
        let key = || scene.frames.iter().filter(|frame| frame.key);
        scores.frames.total += scene.frames.len() as u64;
        scores.frames.key += key().count() as u64;
        scores.frames.skipped += key().filter(|frame| !frame.processed).count() as u64;
        scores.dropped_detections.add(&scene.dropped_detections);
        scores.dropped_truths.add(&scene.dropped_truths);
        scores.boxes_without_truth += scene.boxes_without_truth;
    }
    scores.notes = notes(evaluation, &all, &seen);
    scores
}

fn ignored(evaluation: &Evaluation) -> Ignored {
    let frames = || evaluation.scenes.iter().flat_map(|scene| &scene.frames);
    Ignored {
        detections: frames().map(|frame| frame.in_no_view.detections.len() as u64).sum(),
        objects: frames().map(|frame| frame.in_no_view.truths.len() as u64).sum(),
    }
}

fn orders(
    protocol: &Protocol,
    sequences: &[Vec<Sequence>],
    total: impl Fn(&Sequence) -> u64 + Copy,
) -> Orders<Accuracy> {
    let accuracy = |order: Order| {
        let ap = table(protocol, sequences, |sequence| {
            sequence.average_precision(order, total(sequence))
        });
        let mean = |key: String| {
            let values = protocol.classes.iter().map(|class| ap[&class.name][&key]);
            (key.clone(), mean_of(values))
        };
        let mean_ap = protocol.ious.iter().map(|iou| mean(Protocol::iou_key(*iou))).collect();
        let counts = table(protocol, sequences, |sequence| {
            let true_positives = sequence.hit_count();
            Counts {
                true_positives,
                false_positives: sequence.entries.len() as u64 - true_positives,
                total: total(sequence),
            }
        });
        Accuracy { ap, mean_ap, counts }
    };
    Orders {
        sorted: accuracy(Order::Sorted),
        v2x_real: accuracy(Order::V2xReal),
    }
}

fn range_bins(protocol: &Protocol, sequence: &Sequence) -> Vec<RangeBin> {
    let bins = protocol.range_edges.iter().zip(&sequence.bins).enumerate();
    bins.map(|(i, (from, bin))| RangeBin {
        from: *from,
        to: protocol.range_edges.get(i + 1).copied(),
        counts: *bin,
        precision: share(bin.true_positives, bin.true_positives + bin.false_positives),
        recall: share(bin.true_positives, bin.total),
    })
    .collect()
}

fn points_bins(protocol: &Protocol, sequence: &Sequence) -> Vec<PointsBin> {
    let bins = protocol.point_edges.iter().zip(&sequence.bins_by_points).enumerate();
    bins.map(|(i, (from, bin))| PointsBin {
        from: *from,
        to: protocol.point_edges.get(i + 1).copied(),
        true_positives: bin.true_positives,
        total: bin.total,
        recall: share(bin.true_positives, bin.total),
    })
    .collect()
}

fn share(part: u64, of: u64) -> Option<f64> {
    (of > 0).then(|| part as f64 / of as f64)
}

fn notes(evaluation: &Evaluation, all: &[Vec<Sequence>], seen: &[Vec<Sequence>]) -> Vec<String> {
    let mut notes = Vec::new();
    let empty = |sequences: &[Vec<Sequence>]| -> Vec<String> {
        let classes = evaluation.protocol.classes.iter().zip(sequences);
        let empty = classes.filter(|(_, per_iou)| per_iou.first().is_none_or(|sequence| sequence.total() == 0));
        empty.map(|(class, _)| format!("`{}`", class.name)).collect()
    };
    if !evaluation
        .scenes
        .iter()
        .flat_map(|scene| &scene.frames)
        .any(|frame| frame.key)
    {
        notes.push("no frame has ground truth: nothing is scored".to_string());
        return notes;
    }
    let silent = evaluation.scenes.iter().filter(|scene| !scene.knows_points()).count();
    if silent > 0 {
        let of = evaluation.scenes.len();
        notes.push(format!(
            "{silent} of {of} scenes do not say how many points the ego has on each object: left out of accuracy_seen"
        ));
    }
    let blind: u64 = evaluation.scenes.iter().map(|scene| scene.frames_without_views).sum();
    if blind > 0 {
        let scenes = evaluation.scenes.iter();
        let of: usize = scenes
            .map(|scene| scene.frames.iter().filter(|frame| frame.key).count())
            .sum();
        notes.push(format!(
            "{blind} of {of} scored frames have no views of their labels: everything in them counts"
        ));
    }
    for (name, sequences) in [("accuracy", all), ("accuracy_seen", seen)] {
        let classes = empty(sequences);
        if !classes.is_empty() && (name == "accuracy" || silent < evaluation.scenes.len()) {
            let classes = classes.join(", ");
            notes.push(format!(
                "{name}: the scored frames have no object of class {classes}, so there is no AP of it and no mAP over all classes"
            ));
        }
    }
    notes
}

/// The counts of each scored frame.
pub fn frame_scores(evaluation: &Evaluation) -> Vec<FrameScore> {
    let protocol = &evaluation.protocol;
    let score = |scene: &Scene, frame: &Frame| FrameScore {
        scene: scene.name.clone(),
        ego: scene.ego.clone(),
        seq: frame.seq,
        stamp: frame.stamp,
        counts: frame_counts(frame, protocol),
    };
    let frames = |scene: &'_ Scene| -> Vec<FrameScore> {
        scene
            .frames
            .iter()
            .filter(|frame| frame.key)
            .map(|frame| score(scene, frame))
            .collect()
    };
    evaluation.scenes.iter().flat_map(frames).collect()
}

fn frame_counts(frame: &Frame, protocol: &Protocol) -> Table<Counts> {
    let per_class = |class: usize| {
        let overlaps = Overlaps::new(frame, class as u8);
        let counts = |iou: f64| {
            let outcomes = overlaps.matched(frame, iou, Scope::All, protocol);
            let count = |wanted: fn(&Outcome) -> bool| outcomes.iter().filter(|outcome| wanted(outcome)).count() as u64;
            let counts = |truth: &&usize| Scope::All.counts(frame, **truth, protocol);
            Counts {
                true_positives: count(|outcome| matches!(outcome, Outcome::True(_))),
                false_positives: count(|outcome| matches!(outcome, Outcome::False)),
                total: overlaps.truths.iter().filter(counts).count() as u64,
            }
        };
        protocol
            .ious
            .iter()
            .map(|iou| (Protocol::iou_key(*iou), counts(*iou)))
            .collect()
    };
    protocol
        .classes
        .iter()
        .enumerate()
        .map(|(i, class)| (class.name.clone(), per_class(i)))
        .collect()
}
