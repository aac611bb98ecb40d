//! Whether an agent's poses reach its sweeps, and roadside units that do not move.

use realo_schemas::geometry::PoseTrack;
use realo_schemas::{AgentState, Nanos, is_same_stamp};

use crate::{AgentKind, Log, LogError, LogReader, Stream};

/// Poses that are farther apart are not bridged by default, ns: the setting `max_gap_ms` of the operator `sync`.
pub const MAX_GAP: Nanos = 150_000_000;
/// Poses of a unit that does not move differ by no more, m.
const STILL: f64 = 0.05;
/// Neither do its rotations, degrees.
const STILL_DEGREES: f64 = 0.05;

/// A roadside unit all of whose poses are the same: it is there before the first and after the last too.
#[derive(Clone, Debug)]
pub struct Standing {
    /// Where it is.
    pub state: AgentState,
    /// Stamps of its poses, rising.
    pub stamps: Vec<Nanos>,
}

impl Standing {
    /// Reads the poses of an agent; `None` for vehicles, for units that move by more than 5 cm or 0.05°, and without poses.
    ///
    /// # Errors
    /// A log that cannot be read.
    pub fn read(log: &Log, agent: &str, stream: Stream) -> Result<Option<Self>, LogError> {
        match is_roadside(log, agent) && log.has(agent, stream) {
            true => Standing::of(log.read_all(&[(agent, stream)])?),
            false => Ok(None),
        }
    }

    /// Whether an agent stands still by poses whose stamps may be wrong.
    ///
    /// # Errors
    /// As [`Standing::read`].
    pub(crate) fn is_without_stamps(log: &Log, agent: &str, stream: Stream) -> Result<bool, LogError> {
        let stands = || Ok(Standing::of(log.read_unjudged(&[(agent, stream)])?)?.is_some());
        if is_roadside(log, agent) { stands() } else { Ok(false) }
    }

    fn of(mut reader: LogReader) -> Result<Option<Self>, LogError> {
        let (mut first, mut stamps): (Option<AgentState>, _) = (None, Vec::new());
        while let Some(entry) = reader.next()? {
            // What is no pose is counted when the log is played.
            let Ok(state) = entry.pose() else { continue };
            stamps.push(entry.stamp());
            match &first {
                None => first = Some(state),
                Some(first) if is_same(first, &state) => {}
                Some(_) => return Ok(None),
            }
        }
        stamps.sort_unstable();
        Ok(first.map(|state| Standing { state, stamps }))
    }
}

fn is_roadside(log: &Log, agent: &str) -> bool {
    let info = log.info().agent(agent);
    info.is_some_and(|info| info.kind == AgentKind::Roadside)
}

fn is_same(one: &AgentState, other: &AgentState) -> bool {
    let (one, other) = (&one.map_from_body, &other.map_from_body);
    let far = (one.translation.vector - other.translation.vector).norm();
    far <= STILL && one.rotation.angle_to(&other.rotation).to_degrees() <= STILL_DEGREES
}

/// Whether a pose is known at a stamp by poses at others, of rising stamps, of which gaps of at most `max_gap` are bridged.
pub fn is_posed(poses: &[Nanos], stamp: Nanos, max_gap: Nanos) -> bool {
    let next = poses.partition_point(|pose| *pose < stamp);
    let around = &poses[next.saturating_sub(1)..poses.len().min(next + 1)];
    if around.iter().any(|pose| is_same_stamp(*pose, stamp)) {
        return true;
    }
    match (next, poses.len()) {
        (0, _) | (_, 1) => false,
        (next, all) if next < all => poses[next] - poses[next - 1] <= max_gap,
        (_, all) => (poses[all - 1] - poses[all - 2]).max(stamp - poses[all - 1]) <= max_gap,
    }
}

/// The poses of an agent, over gaps of at most `max_gap` ns. A roadside unit that does not move is there at all times.
///
/// # Errors
/// A log that cannot be read.
pub fn pose_track(log: &Log, agent: &str, stream: Stream, max_gap: Nanos) -> Result<PoseTrack, LogError> {
    let parts = pose_parts(log, agent, stream, max_gap, |_, _| false)?;
    Ok(parts
        .into_iter()
        .next()
        .map_or_else(|| PoseTrack::new(Nanos::MAX, max_gap), |(_, track)| track))
}

/// The same in parts, in each of which stamps rise: a clock that is set back gives a time twice. Each with what has to be added to its
/// stamps to have log times, ns; of the first nothing is known to be added.
///
/// # Errors
/// A log that cannot be read.
pub fn pose_tracks(
    log: &Log,
    agent: &str,
    stream: Stream,
    max_gap: Nanos,
) -> Result<Vec<(Nanos, PoseTrack)>, LogError> {
    pose_parts(log, agent, stream, max_gap, |before, stamp| {
        stamp < before.saturating_sub(SET_BACK)
    })
}

/// A stamp that is so much earlier than the one before is of a clock that was set back, ns.
const SET_BACK: Nanos = 50_000_000;

/// The poses in parts, of which a new one begins where `is_new` says so of the stamp before and the next.
fn pose_parts(
    log: &Log,
    agent: &str,
    stream: Stream,
    max_gap: Nanos,
    is_new: impl Fn(Nanos, Nanos) -> bool,
) -> Result<Vec<(Nanos, PoseTrack)>, LogError> {
    let standing = Standing::read(log, agent, stream)?;
    let max_gap = if standing.is_some() { Nanos::MAX } else { max_gap };
    let mut track = PoseTrack::new(Nanos::MAX, max_gap);
    for time in [0, Nanos::MAX] {
        if let Some(standing) = &standing {
            track.insert(time, standing.state.map_from_body);
        }
    }
    let (mut parts, mut before) = (vec![(0, track)], Nanos::MIN);
    let mut reader = log.read_all(&[(agent, stream)])?;
    while let Some(entry) = reader.next()? {
        if standing.is_none() && is_new(before, entry.stamp()) {
            let behind = entry.ready().saturating_sub(entry.stamp());
            parts.push((behind, PoseTrack::new(Nanos::MAX, max_gap)));
        }
        before = entry.stamp();
        // What is no pose is counted when the log is played.
        if let (Ok(state), Some((_, track))) = (entry.pose(), parts.last_mut()) {
            track.insert(entry.stamp(), state.map_from_body);
        }
    }
    Ok(parts)
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: Nanos = 1_000_000;

    #[test]
    fn poses_reach_over_gaps_and_beyond_the_last() {
        let poses = [0, 100, 200, 500, 600];
        let poses = poses.map(|pose| pose * MS);
        let posed = |stamp: Nanos| is_posed(&poses, stamp * MS, 150 * MS);
        assert_eq!(
            [-1, 0, 50, 300, 500, 550, 700, 751].map(posed),
            [false, true, true, false, true, true, true, false]
        );
        let one = |stamp| is_posed(&[7 * MS], stamp, 150 * MS);
        assert!(one(7 * MS) && one(7 * MS - 128) && !one(8 * MS) && !is_posed(&[], 8, 150));
    }
}
