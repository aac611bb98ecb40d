//! Tracks of poses.

use nalgebra::Isometry3;
use realo_schemas::geometry::{PoseTrack, interpolate};
use realo_schemas::{Nanos, to_seconds};

use crate::drive::Piece;

/// Poses that are farther apart are not bridged, ns.
const MAX_GAP: Nanos = 150_000_000;

/// A track that bridges no breaks.
pub(crate) fn empty() -> PoseTrack {
    PoseTrack::new(Nanos::MAX, MAX_GAP)
}

/// The odometry of a piece.
pub(crate) fn odometry(piece: &Piece) -> PoseTrack {
    let mut track = empty();
    piece.track.iter().for_each(|(stamp, pose)| track.insert(*stamp, *pose));
    track
}

/// Adds a piece's poses by its keyframes' poses in `map`: between two keyframes both carry them, weighted by time.
pub(crate) fn add_corrected(track: &mut PoseTrack, piece: &Piece, keyframes: &[Isometry3<f64>]) {
    for (stamp, odom_from_body) in &piece.track {
        let after = piece.keyframes.partition_point(|keyframe| keyframe.stamp <= *stamp);
        let by = |at: usize| keyframes[at] * piece.keyframes[at].odom_from_body.inv_mul(odom_from_body);
        let pose = match (after.checked_sub(1), after < piece.keyframes.len()) {
            (None, _) => by(0),
            (Some(last), false) => by(last),
            (Some(before), true) => {
                let [from, to] = [before, after].map(|at| piece.keyframes[at].stamp);
                let share = to_seconds(stamp - from) / to_seconds(to - from);
                interpolate(&by(before), &by(after), share)
            }
        };
        track.insert(*stamp, pose);
    }
}
