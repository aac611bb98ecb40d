//! A sweep as the evaluator sees it: which box found which object.

use realo_schemas::{Box3, Boxes, GroundTruth, Header};
use realo_scoring::{
    Collector, Detection, EvaluationError, Frame, Labels, Outcome, Outline, Protocol, Scope, match_frame,
};

/// A detection that found nothing.
pub const FALSE: i32 = -1;
/// A detection that is not scored: of another class, outside of the region, on an ignored object.
pub const NOT_COUNTED: i32 = -2;
/// Nothing is known of what is there.
pub const NOT_JUDGED: i32 = -3;

/// What the evaluator says of a sweep's boxes.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Judged {
    /// For each detection and IoU of the protocol: the object that it found, else one of the codes.
    pub detections: Vec<Vec<i32>>,
    /// For each detection its super-class of the protocol; `None` where it does not count.
    pub detection_classes: Vec<Option<u8>>,
    /// The same of each object.
    pub object_classes: Vec<Option<u8>>,
}

/// The objects that a protocol scores by.
pub fn labelled<'a>(truth: &'a GroundTruth, protocol: &Protocol) -> &'a [Box3] {
    match (&truth.own, protocol.labels) {
        (Some(own), Labels::Own) => &own.boxes,
        _ => &truth.boxes,
    }
}

/// Whether the truth says what is there. A scored sweep may have no objects; a sweep that is not scored then has no labels.
pub fn is_known(truth: &GroundTruth) -> bool {
    truth.key || !truth.boxes.is_empty()
}

impl Judged {
    /// Matches what was detected with what is there at every IoU of the protocol, as if the sweep were scored.
    ///
    /// # Errors
    /// Truth and boxes that cannot be compared.
    pub fn of(
        truth: Option<&(Header, GroundTruth)>,
        boxes: Option<&(Header, Boxes)>,
        protocol: &Protocol,
    ) -> Result<Self, EvaluationError> {
        let detected = boxes.map_or(&[][..], |(_, boxes)| &boxes.0);
        let Some((header, content)) = truth.filter(|(_, truth)| is_known(truth)) else {
            return Ok(Judged {
                detections: vec![vec![NOT_JUDGED; protocol.ious.len()]; detected.len()],
                detection_classes: vec![None; detected.len()],
                object_classes: Vec::new(),
            });
        };
        let frame = frame(header, content, boxes, protocol)?;
        let objects = Places::of(
            labelled(content, protocol),
            |index| frame.truths[index].outline,
            frame.truths.len(),
        );
        let places = Places::of(
            detected,
            |index| frame.detections[index].outline,
            frame.detections.len(),
        );
        let mut judged = Judged {
            detections: vec![vec![NOT_COUNTED; protocol.ious.len()]; detected.len()],
            detection_classes: places.raw_to_counted(|index| frame.detections[index].class),
            object_classes: objects.raw_to_counted(|index| frame.truths[index].class),
        };
        let ignored = |index: &usize| frame.in_no_view.truths.binary_search(index).is_ok();
        for (index, raw) in objects.raw.iter().enumerate() {
            if let Some(raw) = raw.filter(|_| ignored(&index)) {
                judged.object_classes[raw] = None;
            }
        }
        for (number, iou) in protocol.ious.iter().enumerate() {
            for class in 0..protocol.classes.len() as u8 {
                for (detection, outcome) in match_frame(&frame, protocol, class, *iou, Scope::All) {
                    let Some(raw) = places.raw[detection] else { continue };
                    judged.detections[raw][number] = match outcome {
                        Outcome::True(object) => objects.raw[object].map_or(NOT_COUNTED, |object| object as i32),
                        Outcome::False => FALSE,
                        Outcome::Ignored => NOT_COUNTED,
                    };
                }
            }
        }
        Ok(judged)
    }
}

/// The detections of a sweep that count, as the evaluator keeps them.
///
/// # Errors
/// Truth and boxes that cannot be compared.
pub fn counted(
    (header, truth): &(Header, GroundTruth),
    boxes: &(Header, Boxes),
    protocol: &Protocol,
) -> Result<Vec<Detection>, EvaluationError> {
    Ok(frame(header, truth, Some(boxes), protocol)?.detections)
}

/// Where the boxes that count are among those that were recorded: the collector keeps their order.
struct Places {
    /// For each box that counts.
    raw: Vec<Option<usize>>,
    all: usize,
}

impl Places {
    fn of(recorded: &[Box3], counted: impl Fn(usize) -> Outline, count: usize) -> Self {
        let outlines: Vec<Outline> = recorded.iter().map(Outline::of).collect();
        let mut used = vec![false; recorded.len()];
        let find = |index| {
            let outline = counted(index);
            let raw = (0..outlines.len()).find(|raw| !used[*raw] && outlines[*raw] == outline)?;
            used[raw] = true;
            Some(raw)
        };
        Places {
            raw: (0..count).map(find).collect(),
            all: recorded.len(),
        }
    }

    fn raw_to_counted(&self, class: impl Fn(usize) -> u8) -> Vec<Option<u8>> {
        let mut classes = vec![None; self.all];
        for (index, raw) in self.raw.iter().enumerate() {
            if let Some(raw) = raw {
                classes[*raw] = Some(class(index));
            }
        }
        classes
    }
}

fn frame(
    header: &Header,
    truth: &GroundTruth,
    boxes: Option<&(Header, Boxes)>,
    protocol: &Protocol,
) -> Result<Frame, EvaluationError> {
    let mut collector = Collector::new(protocol.clone());
    let mut truth = truth.clone();
    truth.key = true;
    if let Some(own) = &mut truth.own {
        own.key = true;
    }
    collector.add_truth(header, &truth)?;
    if let Some((header, boxes)) = boxes {
        collector.add_boxes(header, boxes.clone())?;
    }
    let scenes = collector.finish().scenes;
    let mut frames = scenes.into_iter().flat_map(|scene| scene.frames);
    Ok(frames.next().unwrap_or_default())
}

#[cfg(test)]
mod tests {
    use realo_schemas::Kind;

    use super::*;

    #[test]
    fn codes_say_what_became_of_each_box() {
        let object = |class: &str, x: f64| Box3::new(class, [x, 0.0, 0.8], [4.0, 2.0, 1.6], 0.0);
        let header = |kind| Header::origin(&"run".into(), &"cav1".into(), kind, 3, 10, 20);
        let truth = GroundTruth {
            boxes: vec![object("Pole", 5.0), object("Car", 10.0), object("Car", 20.0)],
            agents: vec!["cav1".into()],
            points: vec![50, 50, 50],
            ..GroundTruth::default()
        };
        // One far off, one of no class, one 0.8 m off (IoU 0.67), one 1.6 m off (IoU 0.43), one where nothing is.
        let boxes = Boxes(vec![
            object("Car", 5000.0),
            object("Kite", 10.0),
            object("Car", 20.8),
            object("Car", 11.6),
            object("Car", 40.0),
        ]);
        let protocol = Protocol::load("default").unwrap();
        assert_eq!(protocol.ious, [0.3, 0.5]);
        let (truth, boxes) = ((header(Kind::Truth), truth), (header(Kind::Boxes), boxes));
        let judged = Judged::of(Some(&truth), Some(&boxes), &protocol).unwrap();
        assert_eq!(judged.detections, [[-2, -2], [-2, -2], [2, 2], [1, -1], [-1, -1]]);
        assert_eq!(judged.object_classes, [None, Some(0), Some(0)]);
        assert_eq!(judged.detection_classes[..3], [None, None, Some(0)]);
        let mut empty = truth.clone();
        empty.1.boxes.clear();
        empty.1.points.clear();
        assert!(!is_known(&empty.1));
        empty.1.key = true;
        let judged = Judged::of(Some(&empty), Some(&boxes), &protocol).unwrap();
        assert_eq!(
            judged.detections[4],
            [FALSE, FALSE],
            "nothing is there, and that is known"
        );
        let judged = Judged::of(None, Some(&boxes), &protocol).unwrap();
        assert!(judged.detections.iter().flatten().all(|code| *code == NOT_JUDGED));
    }
}
