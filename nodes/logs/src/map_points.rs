//! Points in the frame of the map, which transforms bring to the body: whether these are where the agent's poses are.

use realo_schemas::{Nanos, body_frame};

use crate::frames::{Frames, bare};
use crate::timing::read_stamps;
use crate::{Log, LogError, MAX_GAP, Stream, pose_track};

/// Transforms further from the pose are of another place, m and degrees: both tell where the agent believes to be.
const APART: [f64; 2] = [0.5, 2.0];

/// What is said of such sweeps, after how many of how many: what happened, and what to try.
pub const TRANSFORMS_DIFFER: [&str; 2] = [
    "sweeps were brought from the frame of the map to the body by transforms on /tf that are more than 0.5 m or 2° off the agent's \
     poses, so that the two give its place two values",
    "write the same on both, or the points in the body frame",
];

/// Sweeps whose transform and pose are apart.
#[derive(Clone, Debug, PartialEq)]
pub struct TransformsApart {
    /// How many there are.
    pub count: u64,
    /// Of so many.
    pub of: u64,
    /// How far the first is off, in words.
    pub first: String,
}

impl TransformsApart {
    /// Compares the transforms from the map to an agent's body with its poses, at its sweeps; `None` where its points are in another
    /// frame, and where all agree.
    ///
    /// # Errors
    /// A log that cannot be read.
    pub fn read(log: &Log, agent: &str) -> Result<Option<Self>, LogError> {
        let streams = [Stream::Pose, Stream::PoseTruth].into_iter();
        let poses = streams.into_iter().find(|stream| log.has(agent, *stream));
        let map = bare(&log.info().map_frame);
        let in_map = log.frame_of_points(agent)?.is_some_and(|frame| bare(&frame) == map);
        let Some(poses) = poses.filter(|_| in_map) else {
            return Ok(None);
        };
        let (frames, poses) = (Frames::read(log.file())?, pose_track(log, agent, poses, MAX_GAP)?);
        let (mut count, mut of, mut first) = (0, 0, None);
        for stamp in sweeps(log, agent)? {
            of += 1;
            let (Some(pose), Ok(way)) = (poses.at(stamp), frames.way(map, &body_frame(agent), stamp)) else {
                continue;
            };
            let far = (pose.translation.vector - way.to_from_from.translation.vector).norm();
            let turned = pose.rotation.angle_to(&way.to_from_from.rotation).to_degrees();
            if far > APART[0] || turned > APART[1] {
                count += 1;
                first.get_or_insert_with(|| format!("the first is {far:.3} m and {turned:.2}° off"));
            }
        }
        Ok(first.map(|first| TransformsApart { count, of, first }))
    }
}

/// Stamps of an agent's sweeps.
fn sweeps(log: &Log, agent: &str) -> Result<Vec<Nanos>, LogError> {
    let streams = [Stream::Sweeps, Stream::Points];
    let stream = streams.into_iter().find(|stream| log.has(agent, *stream));
    stream.map_or(Ok(Vec::new()), |stream| read_stamps(log, agent, stream))
}
