//! What heads say, as boxes.

use realo_nn::anchors::Anchors;
use realo_nn::decode::{Detection, candidates};
use realo_schemas::geometry::is_valid;
use realo_schemas::{Box3, Name};

/// From the numbers of the heads to boxes.
#[derive(Clone, Debug)]
pub struct Decoder {
    anchors: Anchors,
    classes: Vec<Name>,
    threshold: f32,
}

/// The boxes of a frame.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Decoded {
    /// Boxes above the threshold, best first.
    pub boxes: Vec<Box3>,
    /// Boxes above the threshold beyond the 1,000 best.
    pub over_limit: u64,
    /// Boxes with numbers that are not finite.
    pub invalid: u64,
}

impl Decoder {
    /// Boxes that a frame gives at most.
    pub const MOST: usize = 1000;

    /// Boxes that score more than `threshold`, by the anchors of a head.
    pub fn new(anchors: Anchors, threshold: f32) -> Self {
        Decoder {
            classes: anchors.classes.iter().map(|class| class.name.as_str().into()).collect(),
            anchors,
            threshold,
        }
    }

    /// The boxes of scores and deltas, `[rows, columns, anchors * classes]` and `[rows, columns, anchors * 7]`.
    ///
    /// # Panics
    /// If the maps' sizes are not those of the anchors.
    pub fn decode(&self, scores: &[f32], deltas: &[f32]) -> Decoded {
        let found = candidates(&self.anchors, scores, deltas, self.threshold, Self::MOST);
        let decoded = found.detections.len();
        let boxes = found.detections.iter().map(|detection| self.boxed(detection));
        let boxes: Vec<Box3> = boxes.filter(is_valid).collect();
        Decoded {
            invalid: (decoded - boxes.len()) as u64,
            over_limit: found.over_limit,
            boxes,
        }
    }

    fn boxed(&self, detection: &Detection) -> Box3 {
        let [x, y, z, height, width, length, yaw] = detection.hwl.map(f64::from);
        Box3 {
            center: [x, y, z],
            length,
            width,
            height,
            yaw: realo_schemas::geometry::normalize_yaw(yaw),
            velocity: None,
            class: self.classes[detection.class].clone(),
            score: detection.score,
            track: None,
            covariance: None,
        }
    }
}
