use realo_scoring::{Frame, Outcome, Outline, Protocol, Scope, match_frame};

/// A box that was detected, and whether it is right.
#[derive(Clone, Debug, PartialEq)]
pub struct Detected {
    /// Super-class of the protocol.
    pub class: String,
    /// Confidence in [0, 1].
    pub score: f32,
    /// Where it lies in the ego's body frame.
    pub outline: Outline,
    /// The object that it found, an index of [`Judged::there`]; `None`: it is false.
    pub found: Option<usize>,
}

/// An object of the truth.
#[derive(Clone, Debug, PartialEq)]
pub struct There {
    /// Super-class of the protocol.
    pub class: String,
    /// Where it lies in the ego's body frame.
    pub outline: Outline,
    /// Whether a detection found it.
    pub found: bool,
    /// Whether the ego alone has too few points on it to count as having seen it; `None` where the log does not say.
    pub hidden: Option<bool>,
}

/// A frame after the evaluator's own matching.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Judged {
    /// What was detected, as far as the protocol counts it.
    pub detected: Vec<Detected>,
    /// What is there, as far as the protocol counts it.
    pub there: Vec<There>,
    /// Whether something of others was fused; else the ego found alone what it found, on however few points.
    pub cooperated: bool,
}

impl Judged {
    /// Matches a frame at one IoU.
    pub fn of(frame: &Frame, protocol: &Protocol, iou: f64, cooperated: bool) -> Self {
        let name = |class: u8| protocol.classes[usize::from(class)].name.clone();
        let mut outcomes = vec![Outcome::False; frame.detections.len()];
        for class in 0..protocol.classes.len() as u8 {
            for (detection, outcome) in match_frame(frame, protocol, class, iou, Scope::All) {
                outcomes[detection] = outcome;
            }
        }
        let counts = |index: &usize| !frame.in_no_view.truths.contains(index);
        let places: Vec<usize> = (0..frame.truths.len()).filter(counts).collect();
        let there = places.iter().map(|index| There {
            class: name(frame.truths[*index].class),
            outline: frame.truths[*index].outline,
            found: outcomes.contains(&Outcome::True(*index)),
            hidden: frame.truths[*index].points.map(|[_, ego]| ego < protocol.seen_points),
        });
        let counted = frame.detections.iter().zip(&outcomes);
        let counted = counted.filter(|(_, outcome)| **outcome != Outcome::Ignored);
        let detected = counted.map(|(detection, outcome)| Detected {
            class: name(detection.class),
            score: detection.score,
            outline: detection.outline,
            found: match outcome {
                Outcome::True(truth) => places.iter().position(|index| index == truth),
                Outcome::False | Outcome::Ignored => None,
            },
        });
        Judged {
            detected: detected.collect(),
            there: there.collect(),
            cooperated,
        }
    }

    /// Whether a detection is true, on an object that the ego alone does not see, and others were heard.
    pub fn only_cooperation(&self, detection: &Detected) -> bool {
        let hidden = |object: usize| self.there[object].hidden == Some(true);
        self.cooperated && detection.found.is_some_and(hidden)
    }

    /// Detections that are true.
    pub fn hits(&self) -> usize {
        self.detected
            .iter()
            .filter(|detection| detection.found.is_some())
            .count()
    }

    /// True detections that the ego alone would not have.
    pub fn added(&self) -> usize {
        self.detected
            .iter()
            .filter(|detection| self.only_cooperation(detection))
            .count()
    }

    /// Detections that found nothing.
    pub fn wrong(&self) -> usize {
        self.detected.len() - self.hits()
    }

    /// Objects that nothing found.
    pub fn missed(&self) -> usize {
        self.there.iter().filter(|object| !object.found).count()
    }

    /// Whether it is known what only cooperation found: others were heard, and points are counted.
    pub fn knows_gain(&self) -> bool {
        self.cooperated && self.knows_points()
    }

    /// Whether the log reports the ego's points on every object.
    pub fn knows_points(&self) -> bool {
        self.there.iter().all(|object| object.hidden.is_some())
    }
}

#[cfg(test)]
mod tests {
    use realo_scoring::{Detection, InNoView, Truth};

    use super::*;

    #[test]
    fn what_no_view_shows_is_neither_there_nor_detected() {
        let at = |x: f64| Outline::new([x, 0.0], 4.0, 2.0, 0.0);
        let truth = |x: f64| Truth {
            class: 0,
            outline: at(x),
            points: None,
        };
        let detection = |x: f64| Detection {
            class: 0,
            score: 0.5,
            outline: at(x),
        };
        let frame = Frame {
            truths: vec![truth(0.0), truth(10.0), truth(20.0)],
            detections: vec![detection(0.0), detection(20.0), detection(30.0), detection(40.0)],
            in_no_view: InNoView {
                detections: vec![0, 3],
                truths: vec![0],
            },
            ..Frame::default()
        };
        let judged = Judged::of(&frame, &Protocol::load("default").unwrap(), 0.3, false);
        let found: Vec<_> = judged.detected.iter().map(|detection| detection.found).collect();
        assert_eq!(found, [Some(1), None]);
        assert_eq!((judged.hits(), judged.wrong(), judged.missed()), (1, 1, 1));
    }

    #[test]
    fn what_the_ego_has_few_points_on_is_the_gain_of_cooperation() {
        let at = |x: f64| Outline::new([x, 0.0], 4.0, 2.0, 0.0);
        let truth = |x: f64, ego: u64| Truth {
            class: 0,
            outline: at(x),
            points: Some([ego + 20, ego]),
        };
        let detection = |x: f64, score: f32| Detection {
            class: 0,
            score,
            outline: at(x),
        };
        let frame = Frame {
            truths: vec![truth(0.0, 10), truth(10.0, 9), truth(20.0, 0)],
            detections: vec![detection(10.2, 0.5), detection(0.0, 0.9), detection(40.0, 0.8)],
            ..Frame::default()
        };
        let protocol = Protocol::load("default").unwrap();
        for (cooperated, added) in [(true, 1), (false, 0)] {
            let judged = Judged::of(&frame, &protocol, 0.3, cooperated);
            let found: Vec<_> = judged.detected.iter().map(|detection| detection.found).collect();
            assert_eq!(found, [Some(1), Some(0), None]);
            assert_eq!(
                (judged.hits(), judged.added(), judged.wrong(), judged.missed()),
                (2, added, 1, 1)
            );
            assert!(judged.knows_points());
        }
    }
}
