use std::collections::BTreeMap;

use realo_schemas::geometry::{View, is_plausible};
use realo_schemas::{Box3, Boxes, GroundTruth, Header, Name, Nanos};

use crate::{
    Detection, Dropped, Evaluation, Frame, Identities, Identity, InNoView, Labels, Outline, OutsideViews, Protocol,
    Scene, Truth,
};

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
    /// A protocol that scores by labels that did not come.
    #[error(
        "sweep {seq} of {agent}: protocol `{protocol}` scores what {agent}'s own side labelled, and its truth has no such \
         labels; take a log with the topic /{agent}/own_labels, another ego, or a protocol with `labels: all`"
    )]
    NoOwnLabels {
        /// The ego.
        agent: String,
        /// Number of the sweep.
        seq: u64,
        /// Name of the protocol.
        protocol: String,
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
    without_views: u64,
}

#[derive(Default)]
struct Sweep {
    truth: Option<TruthPart>,
    boxes: Option<BoxesPart>,
    detections: Vec<Detection>,
    in_no_view: InNoView,
    identities: Identities,
    processed: bool,
}

struct TruthPart {
    stamp: Nanos,
    frame: Name,
    key: bool,
    ego_footprint: Option<[f64; 4]>,
    truths: Vec<Truth>,
    views: Vec<View>,
}

/// The labels that a protocol scores by.
struct Labelled<'a> {
    boxes: &'a [Box3],
    /// Points of all agents and of the ego on each object.
    points: Box<dyn Fn(usize) -> Option<[u64; 2]> + 'a>,
    key: bool,
    /// Where they could be, where the protocol asks for that; else none.
    views: &'a [View],
}

impl<'a> Labelled<'a> {
    /// `None` where the truth has no such labels.
    fn of(truth: &'a GroundTruth, protocol: &Protocol) -> Option<Self> {
        let asked = |views: &'a [View]| match protocol.outside_views {
            OutsideViews::Counted => &[],
            OutsideViews::Ignored => views,
        };
        Some(match protocol.labels {
            Labels::All => Labelled {
                boxes: &truth.boxes,
                points: Box::new(|index| Some([truth.points_of_all(index)?, truth.points_of_ego(index)?])),
                key: truth.key,
                views: asked(&truth.views),
            },
            Labels::Own => {
                let own = truth.own.as_ref()?;
                Labelled {
                    boxes: &own.boxes,
                    points: Box::new(|index| own.points_on(index).map(|points| [points; 2])),
                    key: own.key,
                    views: asked(&own.views),
                }
            }
        })
    }
}

/// Whether no view shows a box; without views everything is shown.
fn in_no_view(object: &Box3, views: &[View]) -> bool {
    !views.is_empty() && !views.iter().any(|view| view.shows(object))
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
    /// [`EvaluationError`] if there was one for this sweep, if it has not the labels that the protocol scores by, or if boxes
    /// that wait for it have another stamp or frame.
    pub fn add_truth(&mut self, header: &Header, truth: &GroundTruth) -> Result<(), EvaluationError> {
        let ego = self.egos.entry(header.agent.clone()).or_default();
        let sweep = ego.sweeps.entry(header.seq).or_default();
        if sweep.truth.is_some() {
            return Err(twice("truth", header));
        }
        let labelled = Labelled::of(truth, &self.protocol).ok_or_else(|| EvaluationError::NoOwnLabels {
            agent: header.agent.to_string(),
            seq: header.seq,
            protocol: self.protocol.name.clone(),
        })?;
        let mut truths = Vec::new();
        if labelled.key {
            let asked = self.protocol.outside_views == OutsideViews::Ignored;
            ego.without_views += u64::from(asked && labelled.views.is_empty());
            let taken = counted_truths(&labelled, &self.protocol, &mut ego.dropped_truths);
            (truths, sweep.in_no_view.truths, sweep.identities.truths) =
                (taken.counted, taken.unseen, taken.identities);
        }
        sweep.truth = Some(TruthPart {
            stamp: header.stamp,
            frame: header.frame.clone(),
            key: labelled.key,
            ego_footprint: truth.ego_footprint,
            truths,
            views: labelled.views.to_vec(),
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
                frames_without_views: ego.without_views,
                ..Scene::default()
            };
            let mut detected = ego.sweeps.values().flat_map(|sweep| &sweep.identities.detections);
            let is_tracked = detected.any(|identity| identity.track.is_some());
            for (seq, sweep) in ego.sweeps {
                let Some(TruthPart { stamp, key, truths, .. }) = sweep.truth else {
                    orphans += 1;
                    continue;
                };
                let (processed, detections, in_no_view) = (sweep.processed, sweep.detections, sweep.in_no_view);
                scene.frames.push(Frame {
                    seq,
                    stamp,
                    key,
                    processed,
                    detections,
                    truths,
                    in_no_view,
                    identities: (is_tracked && key).then_some(sweep.identities),
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
        let taken = counted_detections(&boxes, truth, protocol, dropped);
        (sweep.detections, sweep.in_no_view.detections) = (taken.counted, taken.unseen);
        sweep.identities.detections = taken.identities;
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
    if !is_plausible(object) {
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

/// Boxes that count.
struct Taken<T> {
    counted: Vec<T>,
    /// Which of them are in no view.
    unseen: Vec<usize>,
    identities: Vec<Identity>,
}

impl<T> Taken<T> {
    fn with_room_for(boxes: usize) -> Self {
        Taken {
            counted: Vec::with_capacity(boxes),
            unseen: Vec::new(),
            identities: Vec::with_capacity(boxes),
        }
    }

    fn add(&mut self, counted: T, object: &Box3, views: &[View]) {
        if in_no_view(object, views) {
            self.unseen.push(self.counted.len());
        }
        self.counted.push(counted);
        self.identities.push(Identity::of(object));
    }
}

/// Objects that count.
fn counted_truths(labelled: &Labelled, protocol: &Protocol, dropped: &mut Dropped) -> Taken<Truth> {
    let mut taken = Taken::with_room_for(labelled.boxes.len());
    for (index, object) in labelled.boxes.iter().enumerate() {
        let Some(class) = counted(object, protocol, dropped) else {
            continue;
        };
        let points = (labelled.points)(index);
        if points.is_some_and(|[all, _]| all < protocol.min_points) {
            dropped.few_points += 1;
            continue;
        }
        let truth = Truth {
            class,
            outline: Outline::of(object),
            points,
        };
        taken.add(truth, object, labelled.views);
    }
    taken
}

/// Detections that count.
fn counted_detections(
    boxes: &[Box3],
    truth: &TruthPart,
    protocol: &Protocol,
    dropped: &mut Dropped,
) -> Taken<Detection> {
    let own = |object: &Box3| {
        truth.ego_footprint.is_some_and(|[x0, x1, y0, y1]| {
            (x0..=x1).contains(&object.center[0]) && (y0..=y1).contains(&object.center[1])
        })
    };
    let mut taken = Taken::with_room_for(boxes.len());
    for object in boxes {
        let Some(class) = counted(object, protocol, dropped) else {
            continue;
        };
        if own(object) {
            dropped.own_body += 1;
            continue;
        }
        let detection = Detection {
            class,
            score: object.score,
            outline: Outline::of(object),
        };
        taken.add(detection, object, &truth.views);
    }
    taken
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
