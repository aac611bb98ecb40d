use std::collections::BTreeMap;

use realo_schemas::geometry::{Footprint, normalize_yaw};
use realo_schemas::{Box3, Nanos};
use serde::{Deserialize, Serialize};

use crate::{Identities, Protocol};

/// A rectangle on the ground plane, in the ego's body frame.
///
/// Whole numbers, so that frames are small and come back bit by bit from any file: pooled runs are scored exactly.
/// Rounding moves an edge by less than a micrometre; what is too large for a number takes the largest one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Outline {
    /// Centre (x, y), µm.
    pub center: [i32; 2],
    /// Extent along the heading, µm.
    pub length: i32,
    /// Extent across the heading, µm.
    pub width: i32,
    /// Heading in (-π, π], 10 nrad.
    pub yaw: i32,
}

const METRE: f64 = 1e6;
const RADIAN: f64 = 1e8;

impl Outline {
    /// The outline of a centre, extents (m) and heading (rad).
    pub fn new([x, y]: [f64; 2], length: f64, width: f64, yaw: f64) -> Self {
        // A cast saturates.
        let metres = |value: f64| (value * METRE).round() as i32;
        let yaw = (normalize_yaw(yaw) * RADIAN).round() as i32;
        Outline {
            center: [metres(x), metres(y)],
            length: metres(length),
            width: metres(width),
            yaw,
        }
    }

    /// The outline of a box.
    pub fn of(object: &Box3) -> Self {
        Outline::new(
            [object.center[0], object.center[1]],
            object.length,
            object.width,
            object.yaw,
        )
    }

    /// Centre (x, y), m.
    pub fn center_m(&self) -> [f64; 2] {
        self.center.map(|value| f64::from(value) / METRE)
    }

    pub(crate) fn footprint(&self) -> Footprint {
        let [length, width] = [self.length, self.width].map(|value| f64::from(value) / METRE);
        Footprint::new(self.center_m(), length, width, f64::from(self.yaw) / RADIAN)
    }
}

/// A detection that counts: `[class, score, x, y, length, width, yaw]` in files, in the units of [`Outline`].
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(from = "DetectionRow", into = "DetectionRow")]
pub struct Detection {
    /// Number of its super-class in the protocol.
    pub class: u8,
    /// Confidence.
    pub score: f32,
    /// Where it lies.
    pub outline: Outline,
}

/// An object that counts: `[class, x, y, length, width, yaw, [points of all agents, points of the ego] | null]` in files,
/// in the units of [`Outline`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(from = "TruthRow", into = "TruthRow")]
pub struct Truth {
    /// Number of its super-class in the protocol.
    pub class: u8,
    /// Where it lies.
    pub outline: Outline,
    /// Points of all agents of the mode and of the ego alone on it; `None` where the log does not say.
    pub points: Option<[u64; 2]>,
}

type DetectionRow = (u8, f32, i32, i32, i32, i32, i32);
type TruthRow = (u8, i32, i32, i32, i32, i32, Option<[u64; 2]>);

impl From<DetectionRow> for Detection {
    fn from((class, score, x, y, length, width, yaw): DetectionRow) -> Self {
        Detection {
            class,
            score,
            outline: Outline {
                center: [x, y],
                length,
                width,
                yaw,
            },
        }
    }
}

impl From<Detection> for DetectionRow {
    fn from(Detection { class, score, outline }: Detection) -> Self {
        (
            class,
            score,
            outline.center[0],
            outline.center[1],
            outline.length,
            outline.width,
            outline.yaw,
        )
    }
}

impl From<TruthRow> for Truth {
    fn from((class, x, y, length, width, yaw, points): TruthRow) -> Self {
        Truth {
            class,
            outline: Outline {
                center: [x, y],
                length,
                width,
                yaw,
            },
            points,
        }
    }
}

impl From<Truth> for TruthRow {
    fn from(Truth { class, outline, points }: Truth) -> Self {
        (
            class,
            outline.center[0],
            outline.center[1],
            outline.length,
            outline.width,
            outline.yaw,
            points,
        )
    }
}

/// One sweep of the ego: what was detected and what is there, as far as the protocol counts it.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Frame {
    /// Number of the sweep.
    pub seq: u64,
    /// Its reference time.
    pub stamp: Nanos,
    /// Whether the frame is scored.
    pub key: bool,
    /// Whether boxes came for it; a key frame without them misses all its objects.
    pub processed: bool,
    /// Detections; empty unless the frame is scored.
    pub detections: Vec<Detection>,
    /// Objects; empty unless the frame is scored.
    pub truths: Vec<Truth>,
    /// Those of them that are in no view, where the protocol ignores such.
    #[serde(default, skip_serializing_if = "InNoView::is_empty")]
    pub in_no_view: InNoView,
    /// Identities and velocities of both, where detections of the scene have identities.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub identities: Option<Identities>,
}

/// Which detections and objects of a frame are in no view: indices, ascending.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct InNoView {
    /// Of the detections.
    pub detections: Vec<usize>,
    /// Of the objects.
    pub truths: Vec<usize>,
}

impl InNoView {
    fn is_empty(&self) -> bool {
        self.detections.is_empty() && self.truths.is_empty()
    }
}

/// How many boxes of scored frames were ignored because they are in no view.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Ignored {
    /// Detections; those that found an object that counts are true nevertheless.
    pub detections: u64,
    /// Objects.
    pub objects: u64,
}

/// Boxes of scored frames that do not count, and why.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Dropped {
    /// Boxes that no object can have: not finite, without extent or above 100 m, more than 10 km away.
    pub invalid: u64,
    /// Outside the region.
    pub outside: u64,
    /// Detections centred in the ego's own footprint.
    pub own_body: u64,
    /// Objects with too few points of all agents.
    pub few_points: u64,
    /// By name: classes that the protocol does not know.
    pub classes: BTreeMap<String, u64>,
}

impl Dropped {
    pub(crate) fn add(&mut self, other: &Dropped) {
        self.invalid += other.invalid;
        self.outside += other.outside;
        self.own_body += other.own_body;
        self.few_points += other.few_points;
        for (class, count) in &other.classes {
            *self.classes.entry(class.clone()).or_default() += count;
        }
    }
}

/// The frames of one ego in one log.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Scene {
    /// The log; intervals resample logs. Empty until the caller names it: an operator does not know its log.
    pub name: String,
    /// The ego.
    pub ego: String,
    /// By `seq`.
    pub frames: Vec<Frame>,
    /// Detections that do not count.
    pub dropped_detections: Dropped,
    /// Objects that do not count.
    pub dropped_truths: Dropped,
    /// Messages with boxes for which no truth came.
    pub boxes_without_truth: u64,
    /// Scored frames without a view, where the protocol asks for views: everything in them counts.
    #[serde(default, skip_serializing_if = "is_none")]
    pub frames_without_views: u64,
}

fn is_none(count: &u64) -> bool {
    *count == 0
}

impl Scene {
    /// Whether the log reports the ego's points on every object.
    pub(crate) fn knows_points(&self) -> bool {
        self.frames
            .iter()
            .flat_map(|frame| &frame.truths)
            .all(|truth| truth.points.is_some())
    }
}

/// What was collected for scoring; evaluations of one protocol can be pooled.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Evaluation {
    /// What counts as an object, what as found.
    pub protocol: Protocol,
    /// The logs and egos.
    pub scenes: Vec<Scene>,
}

impl Evaluation {
    /// The same frames in up to so many blocks of neighbouring scored frames, each as if it were a log: for intervals where there
    /// is one log. Blocks of several egos hold the same frames.
    pub fn blocks(&self, most: usize) -> Evaluation {
        let mut keys: Vec<u64> = self
            .scenes
            .iter()
            .flat_map(|scene| scene.frames.iter().filter(|frame| frame.key).map(|frame| frame.seq))
            .collect();
        keys.sort_unstable();
        keys.dedup();
        let blocks = most.min(keys.len()).max(1);
        // A frame that is not scored goes with the scored one after it.
        let block = |frame: &Frame| {
            let at = keys
                .partition_point(|key| *key < frame.seq)
                .min(keys.len().saturating_sub(1));
            at * blocks / keys.len().max(1)
        };
        let split = |scene: &Scene| {
            let mut parts: BTreeMap<usize, Vec<Frame>> = BTreeMap::new();
            for frame in &scene.frames {
                parts.entry(block(frame)).or_default().push(frame.clone());
            }
            let part = |(number, frames): (usize, Vec<Frame>)| Scene {
                name: format!("{}, block {number:03}", scene.name),
                ego: scene.ego.clone(),
                frames,
                ..Scene::default()
            };
            parts.into_iter().map(part).collect::<Vec<_>>()
        };
        let mut scenes: Vec<Scene> = self.scenes.iter().flat_map(split).collect();
        scenes.sort_by(|a, b| (&a.name, &a.ego).cmp(&(&b.name, &b.ego)));
        Evaluation {
            protocol: self.protocol.clone(),
            scenes,
        }
    }
}

/// Evaluations that cannot be pooled.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum PoolError {
    /// Nothing to pool.
    #[error("there is no evaluation to pool")]
    Empty,
    /// Two protocols.
    #[error("evaluations of two protocols cannot be pooled: `{0}` and `{1}` differ; evaluate both by one of them")]
    Protocols(String, String),
}

/// All scenes of several evaluations, ordered by name and ego.
///
/// # Errors
/// [`PoolError`] if there are none, or of different protocols.
pub fn pool(evaluations: Vec<Evaluation>) -> Result<Evaluation, PoolError> {
    let mut evaluations = evaluations.into_iter();
    let mut pooled = evaluations.next().ok_or(PoolError::Empty)?;
    for other in evaluations {
        if other.protocol != pooled.protocol {
            return Err(PoolError::Protocols(pooled.protocol.name, other.protocol.name));
        }
        pooled.scenes.extend(other.scenes);
    }
    pooled.scenes.sort_by(|a, b| (&a.name, &a.ego).cmp(&(&b.name, &b.ego)));
    Ok(pooled)
}

#[cfg(test)]
mod tests {
    use realo_schemas::geometry::iou;

    use super::*;

    #[test]
    fn an_outline_lies_where_its_box_does() {
        for yaw in [-3.0, -0.7, 0.0, 1.1, 3.1] {
            let exact = Footprint::new([12.5, -7.25], 4.6, 1.9, yaw);
            let rounded = Outline::new([12.5, -7.25], 4.6, 1.9, yaw).footprint();
            assert!(iou(&exact, &rounded) > 1.0 - 1e-5, "{yaw}");
        }
    }
}
