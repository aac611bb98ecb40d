use crate::matching::Overlaps;
use crate::{Counts, Evaluation, Outcome, Protocol, Scene, Scope, average_precision};

/// The order in which detections enter a precision-recall curve.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Order {
    /// All detections of all frames by score; equal scores in order of scenes and frames. The usual one.
    Sorted,
    /// By score within a frame only, frame after frame, as the evaluation of V2X-Real does.
    V2xReal,
}

/// A detection that is true or false.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Entry {
    /// Number of the log.
    pub log: usize,
    pub score: f32,
    pub hit: bool,
}

/// All detections of one class at one IoU, in the order of `Order::V2xReal`, and the objects to find.
#[derive(Clone, Debug, Default)]
pub(crate) struct Sequence {
    pub entries: Vec<Entry>,
    /// Objects in each log.
    pub totals: Vec<u64>,
    /// Objects in frames for which boxes came.
    pub processed_total: u64,
    /// By range: an object and what found it at the object's place, a false detection at its own.
    pub bins: Vec<Counts>,
    /// By the ego's own points on an object, where they are known; a false detection is in none.
    pub bins_by_points: Vec<Counts>,
}

impl Sequence {
    pub fn total(&self) -> u64 {
        self.totals.iter().sum()
    }

    pub fn hit_count(&self) -> u64 {
        self.entries.iter().filter(|entry| entry.hit).count() as u64
    }

    /// The entries, best first by `order`.
    pub fn ordered(&self, order: Order) -> Vec<Entry> {
        let mut entries = self.entries.clone();
        if order == Order::Sorted {
            entries.sort_by(|a, b| b.score.total_cmp(&a.score));
        }
        entries
    }

    pub fn average_precision(&self, order: Order, total: u64) -> Option<f64> {
        let hits: Vec<bool> = self.ordered(order).iter().map(|entry| entry.hit).collect();
        average_precision(&hits, total)
    }
}

/// Names of the logs, each once, in order of appearance.
pub(crate) fn logs(evaluation: &Evaluation) -> Vec<&str> {
    let mut names: Vec<&str> = Vec::new();
    for scene in &evaluation.scenes {
        if !names.contains(&scene.name.as_str()) {
            names.push(&scene.name);
        }
    }
    names
}

/// The sequences of a scope, by class and IoU.
pub(crate) fn sequences(evaluation: &Evaluation, scope: Scope) -> Vec<Vec<Sequence>> {
    let (protocol, logs) = (&evaluation.protocol, logs(evaluation));
    let empty = Sequence {
        totals: vec![0; logs.len()],
        bins: vec![Counts::default(); protocol.range_edges.len()],
        bins_by_points: vec![Counts::default(); protocol.point_edges.len()],
        ..Sequence::default()
    };
    let mut sequences = vec![vec![empty; protocol.ious.len()]; protocol.classes.len()];
    for scene in &evaluation.scenes {
        if scope == Scope::Seen && !scene.knows_points() {
            continue;
        }
        let log = logs.iter().position(|name| *name == scene.name).unwrap_or(0);
        add_scene(&mut sequences, scene, log, protocol, scope);
    }
    sequences
}

fn add_scene(sequences: &mut [Vec<Sequence>], scene: &Scene, log: usize, protocol: &Protocol, scope: Scope) {
    for frame in scene.frames.iter().filter(|frame| frame.key) {
        for (class, per_iou) in sequences.iter_mut().enumerate() {
            let overlaps = Overlaps::new(frame, class as u8);
            let counts = |truth: usize| scope.counts(frame, truth, protocol);
            let point_bin = |truth: usize| frame.truths[truth].points.map(|[_, own]| protocol.point_bin(own));
            for (sequence, iou) in per_iou.iter_mut().zip(&protocol.ious) {
                for truth in overlaps.truths.iter().copied().filter(|truth| counts(*truth)) {
                    sequence.totals[log] += 1;
                    sequence.processed_total += u64::from(frame.processed);
                    sequence.bins[protocol.range_bin(frame.truths[truth].outline.center_m())].total += 1;
                    if let Some(bin) = point_bin(truth) {
                        sequence.bins_by_points[bin].total += 1;
                    }
                }
                let outcomes = overlaps.matched(frame, *iou, scope, protocol);
                for (detection, outcome) in overlaps.detections.iter().zip(outcomes) {
                    let detection = &frame.detections[*detection];
                    match outcome {
                        Outcome::Ignored => continue,
                        Outcome::True(truth) => {
                            sequence.bins[protocol.range_bin(frame.truths[truth].outline.center_m())].true_positives +=
                                1;
                            if let Some(bin) = point_bin(truth) {
                                sequence.bins_by_points[bin].true_positives += 1;
                            }
                        }
                        Outcome::False => {
                            sequence.bins[protocol.range_bin(detection.outline.center_m())].false_positives += 1
                        }
                    }
                    let hit = matches!(outcome, Outcome::True(_));
                    sequence.entries.push(Entry {
                        log,
                        score: detection.score,
                        hit,
                    });
                }
            }
        }
    }
}
