use realo_operator::{Counter, Describe, Error, Inputs, Operator, Outputs, Settings};
use realo_schemas::geometry::{Region, box_fault};
use realo_schemas::{Boxes, Header};
use serde::{Deserialize, Serialize};

use crate::{Index, Ties, nms_filled};

/// Settings of [`Nms`].
#[derive(Clone, Debug, PartialEq, Settings, Serialize, Deserialize)]
pub struct Settings {
    /// IoU above which the worse box is dropped.
    #[setting(default = 0.15, range = 0.0..=1.0)]
    pub threshold: f64,
    /// Boxes of a lower score are dropped.
    #[setting(range = ..=1.0)]
    pub min_score: f32,
    /// Boxes that enter suppression, the best ones.
    #[setting(default = 1000, range = 1..)]
    pub max_boxes: usize,
    /// Whether only boxes of one class suppress each other.
    pub per_class: bool,
    /// How neighbours are found: `grid`, `rtree` or `brute`, with one result.
    #[setting(default = Index::Grid)]
    pub index: Index,
    /// Which of several boxes of one score goes first: the `first` or the `last`.
    #[setting(default = Ties::First)]
    pub ties: Ties,
    /// IoU, at least `threshold`, above which boxes of a class have a say, each by its score, in where a kept one lies; 1 =
    /// none has.
    #[setting(default = 1.0, range = 0.0..=1.0)]
    pub vote: f64,
    /// [x min, x max, y min, y max] in m: boxes not all inside are dropped before; [] = none.
    pub region: Vec<f64>,
}

/// Settings that do not fit each other.
#[derive(Debug, thiserror::Error)]
pub enum NmsError {
    /// A vote below the threshold, or above 1.
    #[error("setting `vote`: expected an IoU from `threshold`, {min}, to 1, found {found}")]
    Vote {
        /// The threshold.
        min: f64,
        /// The vote.
        found: f64,
    },
    /// A region that is not one.
    #[error("setting `region`: {0}")]
    Region(String),
}

/// Drops the worse of boxes that overlap (rotated IoU on the ground plane).
#[derive(Describe)]
#[stage(counters(INVALID_BOXES, OUTSIDE_BOXES, LOW_SCORE_BOXES, OVER_LIMIT_BOXES, SUPPRESSED_BOXES))]
pub struct Nms {
    settings: Settings,
    region: Option<Region>,
    /// What fills gaps of the frame that comes next.
    fill: Boxes,
}

const INVALID_BOXES: Counter = Counter::loss(
    "invalid_boxes",
    "boxes dropped: not finite, without extent or above 100 m, more than 10 km away, or with a score outside [0, 1]",
    "boxes were left out by {node}, because no object can have such numbers",
    realo_schemas::plausible_box!("correct the stage that sends them to {node}"),
);
const OUTSIDE_BOXES: Counter = Counter::plain("outside_boxes", "boxes dropped: not wholly in the region");
const LOW_SCORE_BOXES: Counter = Counter::plain("low_score_boxes", "boxes dropped: below the min score");
const OVER_LIMIT_BOXES: Counter = Counter::loss(
    "over_limit_boxes",
    "boxes that did not enter: beyond the best `max_boxes`",
    "boxes were left out by {node}, because they are beyond the best `max_boxes` of a frame",
    "`--set {node}.max_boxes=…`, or leave out what is not sure with `{node}.min_score`",
);
const SUPPRESSED_BOXES: Counter = Counter::plain("suppressed_boxes", "boxes dropped because they overlap a better one");

/// What comes in.
#[derive(Debug, Inputs)]
pub enum Input {
    /// Boxes that only fill gaps: one that a box of `proposals` suppresses is dropped, whatever its score, and has no vote.
    #[port(latest, joined("frame"), optional)]
    Fill(Header, Boxes),
    /// Detections in any order, one frame.
    #[port(latest, joined("frame"))]
    Proposals(Header, Boxes),
}

/// What it sends.
#[derive(Debug, Outputs)]
pub enum Output {
    /// The boxes without duplicates, best score first.
    Boxes(Header, Boxes),
}

impl Operator for Nms {
    fn build(settings: Settings) -> Result<Self, Error> {
        let [min, found] = [settings.threshold, settings.vote];
        if !(min..=1.0).contains(&found) {
            return Err(NmsError::Vote { min, found }.into());
        }
        let region = Region::from_list(&settings.region).map_err(NmsError::Region)?;
        Ok(Nms {
            settings,
            region,
            fill: Boxes::default(),
        })
    }

    fn on_input(&mut self, input: Input, out: &mut Outputs<Output>) -> Result<(), Error> {
        let (header, Boxes(boxes)) = match input {
            Input::Fill(_, boxes) => {
                self.fill = boxes;
                return Ok(());
            }
            Input::Proposals(header, boxes) => (header, boxes),
        };
        let Boxes(fill) = std::mem::take(&mut self.fill);
        let outcome = nms_filled(&boxes, &fill, &self.settings, self.region.as_ref());
        let (agent, all) = (header.agent.clone(), (boxes.len() + fill.len()) as u64);
        out.count_of(&INVALID_BOXES, &agent, outcome.invalid, all);
        if outcome.invalid > 0 {
            let first = boxes.iter().chain(&fill).find_map(box_fault);
            out.found(&INVALID_BOXES, &agent, || {
                format!("the first has {}", first.unwrap_or_default())
            });
        }
        out.count(&OUTSIDE_BOXES, &agent, outcome.outside);
        out.count(&LOW_SCORE_BOXES, &agent, outcome.low_score);
        out.count_of(&OVER_LIMIT_BOXES, &agent, outcome.over_limit, all);
        out.count(&SUPPRESSED_BOXES, &agent, outcome.suppressed);
        out.send(Output::Boxes(header, Boxes(outcome.boxes)));
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use realo_schemas::{AgentState, Box3, Kind, Message, PoseStatus};

    use super::*;

    fn car(x: f64, y: f64, score: f32) -> Box3 {
        Box3 {
            center: [x, y, 0.8],
            length: 4.5,
            width: 1.9,
            height: 1.6,
            yaw: 0.2,
            velocity: None,
            class: "Car".into(),
            score,
            track: None,
            covariance: None,
        }
    }

    fn header() -> Header {
        Header::origin(&"run".into(), &"cav1".into(), Kind::Boxes, 7, 1000, 1000)
    }

    fn run(settings: Settings, boxes: Vec<Box3>) -> (Vec<Box3>, Outputs<Output>) {
        let mut operator = Nms::new(settings).unwrap();
        let mut out = Outputs::at(1000);
        operator
            .on_message(Input::PROPOSALS, Message::new(header(), Boxes(boxes)), &mut out)
            .unwrap();
        let (port, message) = out.take_sent().remove(0);
        assert_eq!(port, Output::BOXES);
        let (sent, Boxes(kept)) = message.into_parts().unwrap();
        assert_eq!(sent, header());
        (kept, out)
    }

    #[test]
    fn keeps_the_best_of_overlapping_boxes_in_order_of_score() {
        let boxes = vec![
            car(0.0, 0.0, 0.5),
            car(30.0, 0.0, 0.6),
            car(0.3, 0.1, 0.9),
            car(-30.0, 0.0, 0.6),
        ];
        let (kept, out) = run(Settings::default(), boxes.clone());
        assert_eq!(kept, [boxes[2].clone(), boxes[1].clone(), boxes[3].clone()]);
        assert_eq!(out.counted("suppressed_boxes"), 1);
    }

    #[test]
    fn what_is_suppressed_has_a_say_where_it_is_asked() {
        let boxes = vec![car(0.4, 0.0, 0.3), car(0.0, 0.0, 0.9), car(30.0, 0.0, 0.6)];
        let voting = |vote| {
            let settings = Settings {
                vote,
                ..Settings::default()
            };
            run(settings, boxes.clone()).0
        };
        assert_eq!(voting(1.0), [boxes[1].clone(), boxes[2].clone()]);
        let [first, second] = &voting(0.3)[..] else {
            panic!("two boxes")
        };
        assert!((first.center[0] - 0.1).abs() < 1e-6 && first.score == 0.9, "{first:?}");
        assert_eq!(*second, boxes[2]);
        let unlike = Settings {
            vote: 1.5,
            ..Settings::default()
        };
        let error = Nms::new(unlike).err().unwrap().to_string();
        assert!(error.contains("`vote`") && error.contains("1.5"), "{error}");
    }

    #[test]
    fn keeps_the_first_of_equal_boxes() {
        let mut second = car(0.0, 0.0, 1.0);
        second.track = Some(2);
        let (kept, _) = run(Settings::default(), vec![car(0.0, 0.0, 1.0), second.clone()]);
        assert_eq!(kept, [car(0.0, 0.0, 1.0)]);
        let (kept, _) = run(
            Settings {
                ties: Ties::Last,
                ..Settings::default()
            },
            vec![car(0.0, 0.0, 1.0), second.clone()],
        );
        assert_eq!(kept, [second]);
    }

    #[test]
    fn rejects_and_counts_invalid_boxes() {
        let mut bad = vec![
            car(f64::NAN, 0.0, 0.9),
            car(0.0, 0.0, f32::NAN),
            car(0.0, 0.0, 1.5),
            car(0.0, 0.0, -0.1),
        ];
        bad.push(Box3 {
            length: 0.0,
            ..car(0.0, 0.0, 1.0)
        });
        bad.push(Box3 {
            width: -1.0,
            ..car(0.0, 0.0, 1.0)
        });
        bad.push(Box3 {
            yaw: f64::INFINITY,
            ..car(0.0, 0.0, 1.0)
        });
        bad.push(car(1e30, 0.0, 0.5));
        bad.push(Box3 {
            length: 101.0,
            ..car(0.0, 0.0, 1.0)
        });
        bad.push(car(0.0, 0.0, 0.5));
        let (kept, out) = run(Settings::default(), bad);
        assert_eq!(kept, [car(0.0, 0.0, 0.5)]);
        assert_eq!(out.counted("invalid_boxes"), 9);
    }

    #[test]
    fn drops_boxes_outside_the_region_before_they_suppress() {
        let settings = Settings {
            region: vec![-100.0, 100.0, -40.0, 40.0],
            ..Settings::default()
        };
        let (kept, out) = run(settings, vec![car(98.5, 0.0, 0.9), car(97.0, 0.0, 0.5)]);
        assert_eq!(kept, [car(97.0, 0.0, 0.5)]);
        assert_eq!(out.counted("outside_boxes"), 1);
    }

    #[test]
    fn takes_only_the_best_boxes_and_at_least_the_least_score() {
        let boxes = vec![
            car(0.0, 0.0, 0.2),
            car(20.0, 0.0, 0.4),
            car(40.0, 0.0, 0.3),
            car(60.0, 0.0, 0.1),
        ];
        let (kept, out) = run(
            Settings {
                max_boxes: 2,
                min_score: 0.2,
                ..Settings::default()
            },
            boxes.clone(),
        );
        assert_eq!(kept, [boxes[1].clone(), boxes[2].clone()]);
        assert_eq!(
            (out.counted("low_score_boxes"), out.counted("over_limit_boxes")),
            (1, 1)
        );
        assert_eq!(run(Settings::default(), vec![car(0.0, 0.0, 0.0)]).0.len(), 1);
    }

    #[test]
    fn classes_suppress_each_other_by_default() {
        let walker = Box3 {
            class: "Pedestrian".into(),
            ..car(0.2, 0.0, 0.8)
        };
        let boxes = vec![car(0.0, 0.0, 0.9), walker.clone(), car(0.1, 0.0, 0.7)];
        assert_eq!(run(Settings::default(), boxes.clone()).0, [car(0.0, 0.0, 0.9)]);
        let (kept, _) = run(
            Settings {
                per_class: true,
                ..Settings::default()
            },
            boxes,
        );
        assert_eq!(kept, [car(0.0, 0.0, 0.9), walker]);
    }

    #[test]
    fn what_fills_comes_where_no_other_box_is_and_has_no_vote() {
        let mut operator = Nms::new(Settings {
            vote: 0.3,
            ..Settings::default()
        })
        .unwrap();
        let proposals = [car(0.0, 0.0, 0.3), car(60.0, 0.0, 0.2)];
        let fill = [car(0.5, 0.0, 0.9), car(30.0, 0.0, 0.8), car(30.2, 0.0, 0.7)];
        let mut run = |fill: Option<&[Box3]>| {
            let mut out = Outputs::at(1000);
            if let Some(fill) = fill {
                let message = Message::new(header(), Boxes(fill.to_vec()));
                operator.on_message(Input::FILL, message, &mut out).unwrap();
            }
            let message = Message::new(header(), Boxes(proposals.to_vec()));
            operator.on_message(Input::PROPOSALS, message, &mut out).unwrap();
            let Boxes(kept) = out.take_sent().remove(0).1.into_parts().unwrap().1;
            kept
        };
        assert_eq!(
            run(Some(&fill)),
            [fill[1].clone(), proposals[0].clone(), proposals[1].clone()]
        );
        assert_eq!(run(None), proposals);
    }

    #[test]
    fn passes_an_empty_list_on() {
        assert_eq!(run(Settings::default(), Vec::new()).0, []);
    }

    #[test]
    fn refuses_settings_and_payloads_that_make_no_sense() {
        let refused = |settings: Settings| Nms::new(settings).err().unwrap().to_string();
        assert!(
            refused(Settings {
                threshold: 1.5,
                ..Settings::default()
            })
            .contains("`threshold`")
        );
        assert!(
            refused(Settings {
                max_boxes: 0,
                ..Settings::default()
            })
            .contains("`max_boxes`")
        );
        assert!(
            refused(Settings {
                region: vec![1.0],
                ..Settings::default()
            })
            .contains("`region`")
        );
        for min_score in [f32::NAN, 1.1] {
            let error = refused(Settings {
                min_score,
                ..Settings::default()
            });
            assert!(error.contains("`min_score`"), "{error}");
        }
        let state = AgentState {
            map_from_body: Default::default(),
            covariance: None,
            velocity: None,
            angular_rate: None,
            status: PoseStatus::Truth,
        };
        let mut operator = Nms::new(Settings::default()).unwrap();
        let error = operator
            .on_message(Input::PROPOSALS, Message::new(header(), state), &mut Outputs::at(0))
            .unwrap_err();
        assert!(
            error.to_string().contains("expected a Boxes, found a AgentState"),
            "{error}"
        );
    }
}
