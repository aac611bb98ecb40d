use std::collections::BTreeMap;

use realo_schemas::geometry::is_valid;
use realo_schemas::{Box3, Boxes, GroundTruth, Header, Name, Nanos};

use crate::{Detection, Dropped, Evaluation, Frame, Outline, Protocol, Scene, Truth};

/// Why a message cannot be scored.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum EvaluationError {
    /// A second message for a sweep.
    #[error("a second message of {what} for sweep {seq} of {agent}; the first one counts")]
    Twice {
        /// Truth or boxes.
        what: &'static str,
        /// The ego.
        agent: String,
        /// Number of the sweep.
        seq: u64,
    },
    /// Truth and boxes of one number, but of two sweeps.
    #[error(
        "sweep {seq} of {agent}: truth has stamp {truth} ns, boxes have {boxes} ns; are they of one log, and do boxes keep \
         the stamp of their sweep?"
    )]
    Stamps {
        /// The ego.
        agent: String,
        /// Number of the sweep.
        seq: u64,
        /// Stamp of the truth.
        truth: Nanos,
        /// Stamp of the boxes.
        boxes: Nanos,
    },
    /// Truth and boxes that cannot be compared.
    #[error(
        "sweep {seq} of {agent}: truth is in frame `{truth}`, boxes are in `{boxes}`; bring the boxes to the frame of the truth"
    )]
    Frames {
        /// The ego.
        agent: String,
        /// Number of the sweep.
        seq: u64,
        /// Frame of the truth.
        truth: Name,
        /// Frame of the boxes.
        boxes: Name,
    },
}

/// Joins truth and boxes by (agent, seq), whose stamps must agree, in any order of arrival, and keeps what the protocol counts.
pub struct Collector {
    protocol: Protocol,
    egos: BTreeMap<Name, Ego>,
}

#[derive(Default)]
struct Ego {
    sweeps: BTreeMap<u64, Sweep>,
    dropped_detections: Dropped,
    dropped_truths: Dropped,
}

#[derive(Default)]
struct Sweep {
    truth: Option<TruthPart>,
    boxes: Option<BoxesPart>,
    detections: Vec<Detection>,
    processed: bool,
}

struct TruthPart {
    stamp: Nanos,
    frame: Name,
    key: bool,
    ego_footprint: Option<[f64; 4]>,
    truths: Vec<Truth>,
}

/// Boxes that wait for the truth of their sweep.
struct BoxesPart {
    stamp: Nanos,
    frame: Name,
    boxes: Vec<Box3>,
}

impl Collector {
    /// Nothing collected yet.
    pub fn new(protocol: Protocol) -> Self {
        Collector {
            protocol,
            egos: BTreeMap::new(),
        }
    }

    /// Takes the truth of a sweep.
    ///
    /// # Errors
    /// [`EvaluationError`] if there was one for this sweep, or if boxes that wait for it have another stamp or frame.
    pub fn add_truth(&mut self, header: &Header, truth: &GroundTruth) -> Result<(), EvaluationError> {
        let ego = self.egos.entry(header.agent.clone()).or_default();
        let sweep = ego.sweeps.entry(header.seq).or_default();
        if sweep.truth.is_some() {
            return Err(twice("truth", header));
        }
        let truths = if truth.key {
            counted_truths(truth, &self.protocol, &mut ego.dropped_truths)
        } else {
            Vec::new()
        };
        sweep.truth = Some(TruthPart {
            stamp: header.stamp,
            frame: header.frame.clone(),
            key: truth.key,
            ego_footprint: truth.ego_footprint,
            truths,
        });
        join(sweep, header, &self.protocol, &mut ego.dropped_detections)
    }

    /// Takes the boxes of a sweep.
    ///
    /// # Errors
    /// [`EvaluationError`] if there were some for this sweep, or if its truth has another stamp or frame.
    pub fn add_boxes(&mut self, header: &Header, Boxes(boxes): Boxes) -> Result<(), EvaluationError> {
        let ego = self.egos.entry(header.agent.clone()).or_default();
        let sweep = ego.sweeps.entry(header.seq).or_default();
        if sweep.boxes.is_some() || sweep.processed {
            return Err(twice("boxes", header));
        }
        sweep.boxes = Some(BoxesPart {
            stamp: header.stamp,
            frame: header.frame.clone(),
            boxes,
        });
        join(sweep, header, &self.protocol, &mut ego.dropped_detections)
    }

    /// What was collected, a scene for each ego that has truth. Sweeps without boxes count as skipped.
    pub fn finish(self) -> Evaluation {
        let mut scenes = Vec::new();
        let mut orphans = 0;
        for (agent, ego) in self.egos {
            let mut scene = Scene {
                ego: agent.to_string(),
                dropped_detections: ego.dropped_detections,
                dropped_truths: ego.dropped_truths,
                ..Scene::default()
            };
            for (seq, sweep) in ego.sweeps {
                let Some(TruthPart { stamp, key, truths, .. }) = sweep.truth else {
                    orphans += 1;
                    continue;
                };
                let (processed, detections) = (sweep.processed, sweep.detections);
                scene.frames.push(Frame {
                    seq,
                    stamp,
                    key,
                    processed,
                    detections,
                    truths,
                });
            }
            if !scene.frames.is_empty() {
                scenes.push(scene);
            }
        }
        if let Some(scene) = scenes.first_mut() {
            scene.boxes_without_truth = orphans;
        }
        Evaluation {
            protocol: self.protocol,
            scenes,
        }
    }
}

fn twice(what: &'static str, header: &Header) -> EvaluationError {
    EvaluationError::Twice {
        what,
        agent: header.agent.to_string(),
        seq: header.seq,
    }
}

/// Keeps what counts of a sweep once both parts are there.
fn join(sweep: &mut Sweep, header: &Header, protocol: &Protocol, dropped: &mut Dropped) -> Result<(), EvaluationError> {
    let (Some(truth), Some(_)) = (&sweep.truth, &sweep.boxes) else {
        return Ok(());
    };
    let Some(BoxesPart { stamp, frame, boxes }) = sweep.boxes.take() else {
        return Ok(());
    };
    // A sweep whose boxes are refused counts as skipped, so that all of its objects are missed.
    comparable(truth, stamp, frame, header)?;
    sweep.processed = true;
    if truth.key {
        sweep.detections = counted_detections(&boxes, truth.ego_footprint, protocol, dropped);
    }
    Ok(())
}

fn comparable(truth: &TruthPart, stamp: Nanos, frame: Name, header: &Header) -> Result<(), EvaluationError> {
    let (agent, seq) = (header.agent.to_string(), header.seq);
    if stamp != truth.stamp {
        return Err(EvaluationError::Stamps {
            agent,
            seq,
            truth: truth.stamp,
            boxes: stamp,
        });
    }
    if frame != truth.frame {
        return Err(EvaluationError::Frames {
            agent,
            seq,
            truth: truth.frame.clone(),
            boxes: frame,
        });
    }
    Ok(())
}

/// The class of a box that counts by itself and by its place.
fn counted(object: &Box3, protocol: &Protocol, dropped: &mut Dropped) -> Option<u8> {
    if !is_valid(object) {
        dropped.invalid += 1;
        return None;
    }
    let Some(class) = protocol.class_of(&object.class) else {
        *dropped.classes.entry(object.class.to_string()).or_default() += 1;
        return None;
    };
    if !protocol.takes_in(object) {
        dropped.outside += 1;
        return None;
    }
    Some(class)
}

fn counted_truths(truth: &GroundTruth, protocol: &Protocol, dropped: &mut Dropped) -> Vec<Truth> {
    let mut truths = Vec::with_capacity(truth.boxes.len());
    for (index, object) in truth.boxes.iter().enumerate() {
        let Some(class) = counted(object, protocol, dropped) else {
            continue;
        };
        let points = truth
            .points_of_all(index)
            .zip(truth.points_of_ego(index))
            .map(|(all, ego)| [all, ego]);
        if points.is_some_and(|[all, _]| all < protocol.min_points) {
            dropped.few_points += 1;
            continue;
        }
        truths.push(Truth {
            class,
            outline: Outline::of(object),
            points,
        });
    }
    truths
}

fn counted_detections(
    boxes: &[Box3],
    ego_footprint: Option<[f64; 4]>,
    protocol: &Protocol,
    dropped: &mut Dropped,
) -> Vec<Detection> {
    let own = |object: &Box3| {
        ego_footprint.is_some_and(|[x0, x1, y0, y1]| {
            (x0..=x1).contains(&object.center[0]) && (y0..=y1).contains(&object.center[1])
        })
    };
    let mut detections = Vec::with_capacity(boxes.len());
    for object in boxes {
        let Some(class) = counted(object, protocol, dropped) else {
            continue;
        };
        if own(object) {
            dropped.own_body += 1;
            continue;
        }
        detections.push(Detection {
            class,
            score: object.score,
            outline: Outline::of(object),
        });
    }
    detections
}

/// Scores recorded boxes after the fact; the same as the operator does in a graph.
///
/// # Errors
/// The first message that cannot be scored.
pub fn evaluate(
    truths: impl IntoIterator<Item = (Header, GroundTruth)>,
    boxes: impl IntoIterator<Item = (Header, Boxes)>,
    protocol: &Protocol,
) -> Result<Evaluation, EvaluationError> {
    let mut collector = Collector::new(protocol.clone());
    for (header, truth) in truths {
        collector.add_truth(&header, &truth)?;
    }
    for (header, boxes) in boxes {
        collector.add_boxes(&header, boxes)?;
    }
    Ok(collector.finish())
}
