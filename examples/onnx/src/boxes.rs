//! Detections that a network gives.

use realo_bev::counters::OVER_LIMIT_BOXES;
use realo_operator::{Counter, Settings};
use realo_schemas::geometry::{is_valid, normalize_yaw};
use realo_schemas::{Box3, Boxes};
use serde::{Deserialize, Serialize};

use crate::network::{Network, NetworkError, Wanted};

/// Boxes of a frame, at most.
pub const MOST: usize = 1000;

/// Settings of a network that gives boxes.
#[derive(Clone, Debug, PartialEq, Settings, Serialize, Deserialize)]
pub struct Detections {
    /// Names of the network's classes, in the order of its scores, separated by commas.
    #[setting(default = ["vehicle", "pedestrian", "truck"].map(String::from).to_vec())]
    pub classes: Vec<String>,
    /// Min score of a box.
    #[setting(default = 0.1, range = 0.0..=1.0)]
    pub score_threshold: f32,
    /// Order of the sizes of a box: `lwh` or `hwl`.
    pub order: Order,
}

/// Order of the sizes of a box.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Order {
    /// Length, width, height, as OpenPCDet.
    #[default]
    Lwh,
    /// Height, width, length, as OpenCOOD.
    Hwl,
}

/// Centre, sizes and heading of each box.
pub const BOXES: Wanted = Wanted::floats("boxes", &["boxes", "7"]);
/// The score of each class, 0 to 1.
pub const SCORES: Wanted = Wanted::floats("scores", &["boxes", "classes"]);
/// What a network gives.
pub const OUTPUTS: &[Wanted] = &[BOXES, SCORES];

/// Counts boxes that no object can have.
pub const INVALID_BOXES: Counter = Counter::loss(
    "invalid_boxes",
    "boxes dropped: not finite, without extent or above 100 m, or with a score outside [0, 1]",
    "boxes were left out, because they are not finite, or have no size or one above 100 m, or no score in [0, 1]",
    "scores are expected after the sigmoid, sizes in metres, in the order of the setting `order`",
);
/// What stages that give boxes count.
pub const COUNTERS: &[Counter] = &[OVER_LIMIT_BOXES, INVALID_BOXES];

/// Reads detections.
pub struct Decoder {
    settings: Detections,
    /// How far boxes are raised, m.
    height: f64,
}

/// The boxes of a frame.
#[derive(Debug)]
pub struct Decoded {
    /// Those above the min score, best first.
    pub boxes: Boxes,
    /// Those above it beyond the best.
    pub over_limit: u64,
    /// Those that no object can have.
    pub invalid: u64,
}

impl Decoder {
    /// For what a network gives; its z counts from so far above the ground (m).
    ///
    /// # Errors
    /// Another number of scores than classes.
    pub fn of(network: &Network, settings: Detections, height: f64) -> Result<Self, NetworkError> {
        let classes = settings.classes.len();
        match network.fixed_output(SCORES.name, 0) {
            Some(fixed) if fixed != classes => Err(network.output_error(format!(
                "expected {SCORES} with {classes} numbers a box, one for each of `classes={}`, found {fixed}",
                settings.classes.join(",")
            ))),
            _ => Ok(Decoder { settings, height }),
        }
    }

    /// The boxes of numbers `[boxes, 7]` and scores `[boxes, classes]`.
    ///
    /// # Errors
    /// Sizes that do not go together.
    pub fn decode(
        &self,
        network: &Network,
        ([count, numbers], boxes): ([usize; 2], Vec<f32>),
        ([scored, classes], scores): ([usize; 2], Vec<f32>),
    ) -> Result<Decoded, NetworkError> {
        let expected = self.settings.classes.len();
        if (numbers, classes, scored) != (7, expected, count) {
            return Err(network.output_error(format!(
                "expected {BOXES} and {SCORES}, of {expected} classes, found [{count}, {numbers}] and [{scored}, {classes}]"
            )));
        }
        let (mut best, mut not_finite) = (Vec::<(f32, usize, usize)>::new(), 0);
        for (index, scores) in scores.chunks_exact(classes).enumerate() {
            if !scores.iter().all(|score| score.is_finite()) {
                not_finite += 1;
                continue;
            }
            let (mut class, mut score) = (0, f32::NEG_INFINITY);
            for (number, value) in scores.iter().enumerate() {
                if *value > score {
                    (class, score) = (number, *value);
                }
            }
            if score > self.settings.score_threshold {
                best.push((score, index, class));
            }
        }
        // Of equal scores in the network's order.
        best.sort_by(|a, b| b.0.total_cmp(&a.0));
        let over_limit = best.len().saturating_sub(MOST) as u64;
        best.truncate(MOST);
        let all = best.len();
        let boxes = boxes.as_chunks::<7>().0;
        let boxed = best
            .into_iter()
            .map(|(score, index, class)| self.boxed(&boxes[index], score, class));
        let boxes: Vec<Box3> = boxed.filter(is_valid).collect();
        Ok(Decoded {
            over_limit,
            invalid: not_finite + (all - boxes.len()) as u64,
            boxes: Boxes(boxes),
        })
    }

    fn boxed(&self, numbers: &[f32; 7], score: f32, class: usize) -> Box3 {
        let [x, y, z, a, width, b, yaw] = numbers.map(f64::from);
        let [length, width, height] = match self.settings.order {
            Order::Lwh => [a, width, b],
            Order::Hwl => [b, width, a],
        };
        let name = self.settings.classes[class].as_str();
        let object = Box3::new(
            name,
            [x, y, z + self.height],
            [length, width, height],
            normalize_yaw(yaw),
        );
        Box3 { score, ..object }
    }
}
