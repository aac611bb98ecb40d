//! Rotated non-maximum suppression on the ground plane.
//!
//! | port | type | content |
//! |---|---|---|
//! | in `proposals` | Boxes | detections in any order, one frame |
//! | out `boxes` | Boxes | the boxes without duplicates, best score first |
//!
//! A box is dropped if a kept one of better score (at equal scores: of lower index) has an IoU above the threshold with
//! it. Before that: invalid boxes (NaN, an extent that is not positive, a score outside [0, 1]) are rejected and counted,
//! boxes outside the region and below the smallest score are dropped, and only the best `max_boxes` stay candidates. With `vote`,
//! a kept box is then moved to the mean of itself and the candidates that overlap it: several views of an object, of one
//! network's anchors or of several agents whose poses are a little off, err less than the best of them.

mod grid;
mod rtree;
mod suppress;
mod vote;

use std::collections::BTreeMap;

use grid::Neighbours;
use realo_operator::{Argument, Counter, Describe, Error, Operator, Outputs, Port, PortId, unexpected};
use realo_schemas::geometry::{Footprint, Region, box_fault, is_plausible};
use realo_schemas::{Box3, Boxes, Header, Message, PayloadType};
use serde::{Deserialize, Serialize};

pub use suppress::{Index, Ties, order, suppress};
use vote::vote;

/// Settings of [`Nms`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// IoU above which a box is a duplicate, in [0, 1].
    pub threshold: f64,
    /// Smallest score of a box.
    pub min_score: f32,
    /// Boxes that enter suppression, the best ones.
    pub max_boxes: usize,
    /// Whether only boxes of one class suppress each other.
    pub per_class: bool,
    /// How neighbours are found.
    pub index: Index,
    /// Which of several boxes of one score goes first.
    pub ties: Ties,
    /// IoU above which candidates of a kept box's class have a say in where it lies and how large it is, at least
    /// `threshold`; 1: none has.
    pub vote: f64,
    /// `[x min, x max, y min, y max]`, m, in the boxes' frame: boxes whose bottom corners do not all lie in it are
    /// dropped before suppression. Empty: no region.
    pub region: Vec<f64>,
}

impl Default for Config {
    fn default() -> Self {
        Config {
            threshold: 0.15,
            min_score: 0.0,
            max_boxes: 1000,
            per_class: false,
            index: Index::Grid,
            ties: Ties::First,
            vote: 1.0,
            region: Vec::new(),
        }
    }
}

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
pub fn nms(boxes: &[Box3], config: &Config, region: Option<&Region>) -> Outcome {
    let mut outcome = Outcome::default();
    let mut candidates: Vec<u32> = Vec::with_capacity(boxes.len());
    for (object, index) in boxes.iter().zip(0u32..) {
        if !is_plausible(object) {
            outcome.invalid += 1;
        } else if region.is_some_and(|region| !region.contains_box(object)) {
            outcome.outside += 1;
        } else if object.score < config.min_score {
            outcome.low_score += 1;
        } else {
            candidates.push(index);
        }
    }
    let scores: Vec<f32> = candidates.iter().map(|i| boxes[*i as usize].score).collect();
    let footprints: Vec<Footprint> = candidates.iter().map(|i| Footprint::of(&boxes[*i as usize])).collect();
    let order = candidates_in_order(&scores, config);
    outcome.over_limit = (scores.len() - order.len()) as u64;
    let kept = if config.per_class {
        let class = |i: u32| &*boxes[candidates[i as usize] as usize].class;
        suppress_per_class(&footprints, &order, class, config)
    } else {
        suppress(&footprints, &order, config.threshold, config.index)
    };
    outcome.suppressed = (order.len() - kept.len()) as u64;
    let object = |i: u32| (&boxes[candidates[i as usize] as usize], &footprints[i as usize]);
    outcome.boxes = match config.vote < 1.0 {
        true => {
            let neighbours = Neighbours::new(&footprints, &order);
            let voted = |i: &u32| vote(object(*i), neighbours.of(*i).into_iter().map(object), config.vote);
            kept.iter().map(voted).collect()
        }
        false => kept.iter().map(|i| object(*i).0.clone()).collect(),
    };
    outcome.kept = kept.into_iter().map(|i| candidates[i as usize]).collect();
    outcome
}

/// Suppresses duplicates among footprints of one frame, whatever their classes: indices of the kept ones, best score
/// first. Scores must not be NaN.
pub fn keep(footprints: &[Footprint], scores: &[f32], config: &Config) -> Vec<u32> {
    suppress(
        footprints,
        &candidates_in_order(scores, config),
        config.threshold,
        config.index,
    )
}

fn candidates_in_order(scores: &[f32], config: &Config) -> Vec<u32> {
    let mut order = order(scores, config.ties);
    order.truncate(config.max_boxes);
    order
}

fn suppress_per_class<'a>(
    footprints: &[Footprint],
    order: &[u32],
    class: impl Fn(u32) -> &'a str,
    config: &Config,
) -> Vec<u32> {
    let mut classes: BTreeMap<&str, Vec<u32>> = BTreeMap::new();
    for &index in order {
        classes.entry(class(index)).or_default().push(index);
    }
    let mut is_kept = vec![false; footprints.len()];
    for members in classes.values() {
        for index in suppress(footprints, members, config.threshold, config.index) {
            is_kept[index as usize] = true;
        }
    }
    order.iter().copied().filter(|index| is_kept[*index as usize]).collect()
}

/// The operator `nms`.
pub struct Nms {
    config: Config,
    region: Option<Region>,
}

const INVALID_BOXES: Counter = Counter::loss(
    "invalid_boxes",
    "boxes dropped: not finite, without extent or above 100 m, more than 10 km away, or with a score outside [0, 1]",
    "boxes were left out by {node}, because no object can have such numbers",
    "expected are finite numbers in the frame of the agent, sizes of 0 to 100 m, distances up to 10 km and scores of 0 to 1: mend \
     the stage that sends them to {node}",
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

impl Describe for Nms {
    type Config = Config;
    const NAME: &'static str = "nms";
    const ABOUT: &'static str = "drops the worse of boxes that overlap (rotated IoU on the ground plane)";
    const ARGUMENTS: &'static [Argument] = &[
        Argument {
            name: "threshold",
            about: "IoU above which the worse box is dropped, in [0, 1]",
        },
        Argument {
            name: "min_score",
            about: "boxes of a lower score are dropped",
        },
        Argument {
            name: "max_boxes",
            about: "boxes that enter suppression, the best ones",
        },
        Argument {
            name: "per_class",
            about: "whether only boxes of one class suppress each other",
        },
        Argument {
            name: "index",
            about: "how neighbours are found: grid, rtree or brute, with one result",
        },
        Argument {
            name: "ties",
            about: "which of several boxes of one score goes first: the first or the last",
        },
        Argument {
            name: "vote",
            about: "IoU, at least `threshold`, above which boxes of a class have a say, each by its score, in where a kept one lies; 1 = none has",
        },
        Argument {
            name: "region",
            about: "[x min, x max, y min, y max] in m: boxes not all inside are dropped before; [] = none",
        },
    ];
    const INPUTS: &'static [Port] =
        &[Port::new("proposals", &[PayloadType::Boxes], "detections in any order, one frame").latest()];
    const OUTPUTS: &'static [Port] = &[Port::new(
        "boxes",
        &[PayloadType::Boxes],
        "the boxes without duplicates, best score first",
    )];
    const COUNTERS: &'static [Counter] = &[
        INVALID_BOXES,
        OUTSIDE_BOXES,
        LOW_SCORE_BOXES,
        OVER_LIMIT_BOXES,
        SUPPRESSED_BOXES,
    ];
}

impl Operator for Nms {
    fn new(config: Config) -> Result<Self, Error> {
        if !(0.0..=1.0).contains(&config.threshold) {
            return Err(format!(
                "argument `threshold`: an IoU lies in [0, 1], found {}",
                config.threshold
            )
            .into());
        }
        if !(config.threshold..=1.0).contains(&config.vote) {
            let [min, found] = [config.threshold, config.vote];
            return Err(
                format!("argument `vote`: expected an IoU from `threshold`, {min}, to 1, found {found}").into(),
            );
        }
        // Above 1 no box would be left.
        if config.min_score.is_nan() || config.min_score > 1.0 {
            let found = config.min_score;
            return Err(format!("argument `min_score`: expected a score up to 1, found {found}").into());
        }
        if config.max_boxes == 0 {
            return Err("argument `max_boxes`: 0 would drop every box; give at least 1".into());
        }
        let region = Region::from_list(&config.region).map_err(|reason| format!("argument `region`: {reason}"))?;
        Ok(Nms { config, region })
    }

    fn on_input(&mut self, _port: PortId, message: Message, out: &mut Outputs) -> Result<(), Error> {
        let (header, Boxes(boxes)): (Header, Boxes) = message.into_parts().map_err(unexpected)?;
        let outcome = nms(&boxes, &self.config, self.region.as_ref());
        let (agent, all) = (header.agent.clone(), boxes.len() as u64);
        out.count_of(&INVALID_BOXES, &agent, outcome.invalid, all);
        if outcome.invalid > 0 {
            let first = boxes.iter().find_map(box_fault);
            out.found(&INVALID_BOXES, &agent, || {
                format!("the first has {}", first.unwrap_or_default())
            });
        }
        out.count(&OUTSIDE_BOXES, &agent, outcome.outside);
        out.count(&LOW_SCORE_BOXES, &agent, outcome.low_score);
        out.count_of(&OVER_LIMIT_BOXES, &agent, outcome.over_limit, all);
        out.count(&SUPPRESSED_BOXES, &agent, outcome.suppressed);
        out.send(PortId(0), Message::new(header, Boxes(outcome.boxes)));
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use realo_schemas::{AgentState, Kind, PoseStatus};

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

    fn run(config: Config, boxes: Vec<Box3>) -> (Vec<Box3>, Outputs) {
        let mut operator = Nms::new(config).unwrap();
        let mut out = Outputs::at(1000);
        operator
            .on_input(PortId(0), Message::new(header(), Boxes(boxes)), &mut out)
            .unwrap();
        let (port, message) = out.take_sent().remove(0);
        assert_eq!(port, PortId(0));
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
        let (kept, out) = run(Config::default(), boxes.clone());
        assert_eq!(kept, [boxes[2].clone(), boxes[1].clone(), boxes[3].clone()]);
        assert_eq!(out.counted("suppressed_boxes"), 1);
    }

    #[test]
    fn what_is_suppressed_has_a_say_where_it_is_asked() {
        let boxes = vec![car(0.4, 0.0, 0.3), car(0.0, 0.0, 0.9), car(30.0, 0.0, 0.6)];
        let voting = |vote| {
            let config = Config {
                vote,
                ..Config::default()
            };
            run(config, boxes.clone()).0
        };
        assert_eq!(voting(1.0), [boxes[1].clone(), boxes[2].clone()]);
        let [first, second] = &voting(0.3)[..] else {
            panic!("two boxes")
        };
        assert!((first.center[0] - 0.1).abs() < 1e-6 && first.score == 0.9, "{first:?}");
        assert_eq!(*second, boxes[2]);
        let unlike = Config {
            vote: 1.5,
            ..Config::default()
        };
        let error = Nms::new(unlike).err().unwrap().to_string();
        assert!(error.contains("`vote`") && error.contains("1.5"), "{error}");
    }

    #[test]
    fn keeps_the_first_of_equal_boxes() {
        let mut second = car(0.0, 0.0, 1.0);
        second.track = Some(2);
        let (kept, _) = run(Config::default(), vec![car(0.0, 0.0, 1.0), second.clone()]);
        assert_eq!(kept, [car(0.0, 0.0, 1.0)]);
        let (kept, _) = run(
            Config {
                ties: Ties::Last,
                ..Config::default()
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
        let (kept, out) = run(Config::default(), bad);
        assert_eq!(kept, [car(0.0, 0.0, 0.5)]);
        assert_eq!(out.counted("invalid_boxes"), 9);
    }

    #[test]
    fn drops_boxes_outside_the_region_before_they_suppress() {
        let config = Config {
            region: vec![-100.0, 100.0, -40.0, 40.0],
            ..Config::default()
        };
        let (kept, out) = run(config, vec![car(98.5, 0.0, 0.9), car(97.0, 0.0, 0.5)]);
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
            Config {
                max_boxes: 2,
                min_score: 0.2,
                ..Config::default()
            },
            boxes.clone(),
        );
        assert_eq!(kept, [boxes[1].clone(), boxes[2].clone()]);
        assert_eq!(
            (out.counted("low_score_boxes"), out.counted("over_limit_boxes")),
            (1, 1)
        );
        assert_eq!(run(Config::default(), vec![car(0.0, 0.0, 0.0)]).0.len(), 1);
    }

    #[test]
    fn classes_suppress_each_other_unless_told_otherwise() {
        let walker = Box3 {
            class: "Pedestrian".into(),
            ..car(0.2, 0.0, 0.8)
        };
        let boxes = vec![car(0.0, 0.0, 0.9), walker.clone(), car(0.1, 0.0, 0.7)];
        assert_eq!(run(Config::default(), boxes.clone()).0, [car(0.0, 0.0, 0.9)]);
        let (kept, _) = run(
            Config {
                per_class: true,
                ..Config::default()
            },
            boxes,
        );
        assert_eq!(kept, [car(0.0, 0.0, 0.9), walker]);
    }

    #[test]
    fn passes_an_empty_list_on() {
        assert_eq!(run(Config::default(), Vec::new()).0, []);
    }

    #[test]
    fn refuses_settings_and_payloads_that_make_no_sense() {
        let refused = |config: Config| Nms::new(config).err().unwrap().to_string();
        assert!(
            refused(Config {
                threshold: 1.5,
                ..Config::default()
            })
            .contains("`threshold`")
        );
        assert!(
            refused(Config {
                max_boxes: 0,
                ..Config::default()
            })
            .contains("`max_boxes`")
        );
        assert!(
            refused(Config {
                region: vec![1.0],
                ..Config::default()
            })
            .contains("`region`")
        );
        for min_score in [f32::NAN, 1.1] {
            let error = refused(Config {
                min_score,
                ..Config::default()
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
        let mut operator = Nms::new(Config::default()).unwrap();
        let error = operator
            .on_input(PortId(0), Message::new(header(), state), &mut Outputs::at(0))
            .unwrap_err();
        assert!(
            error.to_string().contains("expected a Boxes, found a AgentState"),
            "{error}"
        );
    }

    #[test]
    fn describes_every_argument() {
        let names: Vec<_> = Nms::ARGUMENTS.iter().map(|argument| argument.name).collect();
        let keys: Vec<_> = realo_operator::config::defaults::<Config>().keys().cloned().collect();
        assert_eq!(names, keys);
    }
}
