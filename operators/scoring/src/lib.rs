//! Average precision of detections against ground truth, by a protocol file; for the evaluator in a graph and after the fact.
//!
//! - A [`Protocol`] says what counts: region, rule, classes, IoUs, points.
//! - A [`Collector`] joins truth and boxes into [`Frame`]s; the frames of several runs can be [`pool`]ed exactly.
//! - [`score`] makes the table: two orders of detections, objects of all agents and those that the ego sees; and HOTA and errors of
//!   velocities where detections have identities.
//! - [`LocalizationScores`]: how far estimated poses of agents are from true ones.

mod collect;
mod frame;
pub mod hota;
mod intervals;
mod localization;
mod matching;
mod precision;
mod protocol;
mod same;
mod scores;
mod sequence;
mod table;
#[cfg(test)]
mod tests;
mod tracking;

use serde::{Deserialize, Serialize};

pub use collect::{Collector, EvaluationError, evaluate};
pub use frame::{Detection, Dropped, Evaluation, Frame, Ignored, InNoView, Outline, PoolError, Scene, Truth, pool};
pub use intervals::{Bounds, Intervals};
pub use localization::{ErrorSpread, LocalizationFrame, LocalizationScores, NEES_BAND, PoseDifference};
pub use matching::{Outcome, Scope, match_frame};
pub use precision::average_precision;
pub use protocol::{EgoKind, Labels, OutsideViews, Protocol, ProtocolError, Rule, SuperClass};
pub use same::{TruthMismatch, same_truth};
pub use scores::{Accuracy, Counts, FrameCounts, FrameScore, PointsBin, RangeBin, Scores, frame_scores, score};
pub use table::{Orders, Table};
pub use tracking::{Identities, Identity, TrackScores};

/// The wire on which boxes are scored and kept.
pub const BOXES_WIRE: &str = "the boxes that are scored";

/// The wire of the truth that they are scored against.
pub const TRUTH_WIRE: &str = "the truth that is scored";

/// Topic of the report of an evaluator.
pub const TOPIC: &str = "evaluation";

/// The document of that report.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct EvaluationReport {
    /// The table of this run.
    pub scores: Scores,
    /// What it was made from, so that runs can be pooled.
    pub evaluation: Evaluation,
}

impl From<Evaluation> for EvaluationReport {
    fn from(evaluation: Evaluation) -> Self {
        EvaluationReport {
            scores: score(&evaluation),
            evaluation,
        }
    }
}
