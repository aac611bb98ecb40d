//! What of a log a layout does not hold.

use realo_logs::Stream;

use crate::options::LabelSource;
use crate::places::number;
use crate::scene::{Scene, SceneAgent};

/// That the layout has no place for which frames count.
pub const SCORED: &str = "which frames are scored: read back, all are";

/// What no layout of frames holds, of what the log has, a line each.
pub fn of_frames(scene: &Scene) -> Vec<String> {
    let has = |stream: Stream| scene.agents.iter().any(|agent| scene.log.has(&agent.name, stream));
    let info = scene.log.info();
    let labels_left = match scene.options.labels {
        LabelSource::Truth => (
            has(Stream::OwnLabels),
            "own labels of agents (--labels own writes them in place of the truth)",
        ),
        LabelSource::Own => (has(Stream::GroundTruth), "ground truth beside the own labels of agents"),
    };
    let is_motion = [Stream::Imu, Stream::Fix, Stream::Wheels].into_iter().any(has);
    let views = has(Stream::GroundTruthViews) || has(Stream::OwnLabelsViews);
    let all = [
        (true, "times and rings of points"),
        (has(Stream::Pose), "poses between the sweeps, and their covariances"),
        (
            has(Stream::Pose) && has(Stream::PoseTruth),
            "poses that agents believed; the true ones are written",
        ),
        labels_left,
        (has(Stream::Detections), "recorded detections"),
        (is_motion, "motion sensors"),
        (has(Stream::Packets), "precomputed packets"),
        (views, "views of cameras"),
        (info.map_origin.is_some(), "where the map is on the Earth"),
        (!info.clock_errors.is_empty(), "errors of clocks"),
    ];
    let lines = all.into_iter().filter(|(is_there, _)| *is_there);
    lines.map(|(_, line)| line.into()).collect()
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
