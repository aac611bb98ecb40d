//! What of a log a layout does not hold.

use std::fmt;

use realo_logs::Stream;

use crate::options::LabelSource;
use crate::places::number;
use crate::scene::{Scene, SceneAgent};

/// That the layout has no place for which frames count.
pub const SCORED: &str = "which frames are scored: read back, all are";

/// What no layout of frames holds, of what a log may have.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Lost {
    /// When and by which beam each point was measured.
    PointTimes,
    /// Poses between the sweeps, with their covariances.
    PosesBetween,
    /// Poses that agents believed, beside the true ones.
    BelievedPoses,
    /// Boxes of the other source of labels.
    OtherLabels(LabelSource),
    /// What the log has of detectors.
    Detections,
    /// What it has of inertial units, receivers and wheels.
    MotionSensors,
    /// What it has of packets.
    Packets,
    /// Where labels could be.
    Views,
    /// Where the map is on the Earth.
    MapOrigin,
    /// How wrong the clocks of agents are.
    ClockErrors,
}

impl fmt::Display for Lost {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(match self {
            Lost::PointTimes => "times and rings of points",
            Lost::PosesBetween => "poses between the sweeps, and their covariances",
            Lost::BelievedPoses => "poses that agents believed; the true ones are written",
            Lost::OtherLabels(LabelSource::Truth) => {
                "own labels of agents (--labels own writes them in place of the truth)"
            }
            Lost::OtherLabels(LabelSource::Own) => "ground truth beside the own labels of agents",
            Lost::Detections => "recorded detections",
            Lost::MotionSensors => "motion sensors",
            Lost::Packets => "precomputed packets",
            Lost::Views => "views of cameras",
            Lost::MapOrigin => "where the map is on the Earth",
            Lost::ClockErrors => "errors of clocks",
        })
    }
}

/// What no layout of frames holds, of what the log has.
pub fn of_frames(scene: &Scene) -> Vec<Lost> {
    let has = |stream: Stream| scene.agents.iter().any(|agent| scene.log.has(&agent.name, stream));
    let info = scene.log.info();
    let labels = scene.options.labels;
    let other_labels = match labels {
        LabelSource::Truth => has(Stream::OwnLabels),
        LabelSource::Own => has(Stream::GroundTruth),
    };
    let is_motion = [Stream::Imu, Stream::Fix, Stream::Wheels].into_iter().any(has);
    let views = has(Stream::GroundTruthViews) || has(Stream::OwnLabelsViews);
    let all = [
        (true, Lost::PointTimes),
        (has(Stream::Pose), Lost::PosesBetween),
        (has(Stream::Pose) && has(Stream::PoseTruth), Lost::BelievedPoses),
        (other_labels, Lost::OtherLabels(labels)),
        (has(Stream::Detections), Lost::Detections),
        (is_motion, Lost::MotionSensors),
        (has(Stream::Packets), Lost::Packets),
        (views, Lost::Views),
        (info.map_origin.is_some(), Lost::MapOrigin),
        (!info.clock_errors.is_empty(), Lost::ClockErrors),
    ];
    let there = all.into_iter().filter(|(is_there, _)| *is_there);
    there.map(|(_, lost)| lost).collect()
}

/// The height of LiDARs, where it was assumed.
pub fn assumed_heights(scene: &Scene) -> Vec<String> {
    let unknown = scene.agents.iter().filter(|agent| !agent.is_height_known);
    let line = |agent: &SceneAgent| {
        let (name, height) = (&agent.name, agent.height);
        format!("the LiDAR of {name} is {height} m over the ground, for the log does not say it (--height)")
    };
    unknown.map(line).collect()
}

/// The outline that is inside of all agents' own, in whole mm, as the option of an import.
pub fn footprint<'a>(agents: impl Iterator<Item = &'a SceneAgent>) -> Option<String> {
    let inner =
        |[a0, a1, a2, a3]: [f64; 4], [b0, b1, b2, b3]: [f64; 4]| [a0.max(b0), a1.min(b1), a2.max(b2), a3.min(b3)];
    let inwards = |metres: f64| (1e3 * metres).trunc() / 1e3;
    let common = agents.map(|agent| agent.outline().map(inwards)).reduce(inner);
    let [x0, x1, y0, y1] = common.filter(|[x0, x1, y0, y1]| x0 < x1 && y0 < y1)?;
    Some(format!(" --footprint {}", [x0, x1, y0, y1].map(number).join(",")))
}
