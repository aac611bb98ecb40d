//! What a log holds around the stamp of an ego's sweep: poses, truth and points.

use nalgebra::{Isometry3, Point3};
use realo_logs::{Attitude, Entry, Log, LogError, MAX_GAP, Standing, Stream, levelled_while_played, pose_track};
use realo_schemas::geometry::{Motion, PoseTrack, relative};
use realo_schemas::{GroundTruth, Nanos, PointCloud, is_same_stamp};

/// A sweep further from the ego's says nothing about the same scene.
const WINDOW: Nanos = 500_000_000;
/// Poses are read this far around a sweep's stamp at least.
const POSES: Nanos = 1_000_000_000;

/// The longest gap between an agent's poses that a run bridged, ns: what was set of the agent's lane, else the max of what was set
/// where the lane is unknown, else the default of the operator `sync`. `set`: the arguments that were changed, as a result has them.
pub fn max_gap(set: &str, is_ego: bool) -> Nanos {
    let [own, other] = if is_ego { ["ego", "others"] } else { ["others", "ego"] };
    let gaps = || set.split(',').filter_map(gap_of_lane);
    let of_own = gaps().filter(|(lane, _)| *lane == own).map(|(_, gap)| gap).max();
    let unknown = gaps().filter(|(lane, _)| ![own, other].contains(lane));
    let of_unknown = unknown.map(|(_, gap)| gap).max();
    of_own.or(of_unknown).unwrap_or(MAX_GAP)
}

/// The first part of a stage's name and its `max_gap_ms`, ns, if the setting is one.
fn gap_of_lane(setting: &str) -> Option<(&str, Nanos)> {
    let (key, value) = setting.trim().split_once('=')?;
    let stage = key.strip_suffix(".max_gap_ms")?;
    let millis: u32 = value.parse().ok()?;
    Some((stage.split('.').next()?, Nanos::from(millis) * 1_000_000))
}

/// The poses of an agent around a stamp, exact ones if wanted and there, else what it believed: as a run joins them, with gaps
/// of at most `max_gap` ns, and those of a roadside unit that does not move at all times.
pub fn poses(log: &Log, agent: &str, stamp: Nanos, exact: bool, max_gap: Nanos) -> Result<PoseTrack, LogError> {
    let stream = pose_stream(log, agent, exact);
    let reach = max_gap.max(POSES) + WINDOW;
    let mut track = PoseTrack::new(4 * reach, max_gap);
    if !log.has(agent, stream) {
        return Ok(track);
    }
    if Standing::read(log, agent, stream)?.is_some() {
        return pose_track(log, agent, stream, max_gap);
    }
    let (from, until) = (stamp.saturating_sub(reach), stamp.saturating_add(reach));
    let mut reader = log.read(&[(agent, stream)], from, until)?;
    while let Some(entry) = reader.next()? {
        // What is no pose was counted when the log was played.
        if let Ok(state) = entry.pose() {
            track.insert(entry.stamp(), state.map_from_body);
        }
    }
    Ok(track)
}

/// What makes an agent's frames level as the player does; `None` where they stay as they are.
pub fn attitude(log: &Log, agent: &str, exact: bool) -> Result<Option<Attitude>, LogError> {
    match levelled_while_played(log)?.contains_key(agent) {
        true => Attitude::read(log, agent, pose_stream(log, agent, exact)).map(Some),
        false => Ok(None),
    }
}

/// Exact poses if wanted and there, else those that the agent believed.
fn pose_stream(log: &Log, agent: &str, exact: bool) -> Stream {
    match exact && log.has(agent, Stream::PoseTruth) {
        true => Stream::PoseTruth,
        false => Stream::Pose,
    }
}

/// Whether an agent has a sweep of this stamp, with points or without.
pub fn has_sweep(log: &Log, agent: &str, stamp: Nanos) -> Result<bool, LogError> {
    let Some(stream) = [Stream::Sweeps, Stream::Points]
        .into_iter()
        .find(|stream| log.has(agent, *stream))
    else {
        return Ok(false);
    };
    Ok(at(log, agent, stream, stamp)?.is_some())
}

/// What the log says is there at an agent's sweep, level as it was played, with the agent's own points; nothing where it does
/// not say.
pub fn truth(log: &Log, agent: &str, stamp: Nanos) -> Result<GroundTruth, LogError> {
    let mut truth = GroundTruth {
        agents: vec![agent.into()],
        ..GroundTruth::default()
    };
    if !log.has(agent, Stream::GroundTruth) {
        return Ok(truth);
    }
    let (boxes, info) = (
        at(log, agent, Stream::GroundTruth, stamp)?,
        at(log, agent, Stream::GroundTruthInfo, stamp)?,
    );
    if let Some((boxes, info)) = boxes.zip(info) {
        let mut found = boxes.boxes()?;
        let info = info.info(&mut found)?;
        if let Some(attitude) = attitude(log, agent, true)? {
            attitude.boxes(stamp, &mut found.0);
        }
        (truth.boxes, truth.key) = (found.0, info.key);
        truth.points = info.points.unwrap_or_default();
    }
    Ok(truth)
}

/// The message of a stream that the agent has, of this stamp.
fn at(log: &Log, agent: &str, stream: Stream, stamp: Nanos) -> Result<Option<Entry>, LogError> {
    let (from, until) = (stamp.saturating_sub(WINDOW), stamp.saturating_add(2 * WINDOW));
    let mut reader = log.read(&[(agent, stream)], from, until)?;
    while let Some(entry) = reader.next()? {
        if is_same_stamp(entry.stamp(), stamp) {
            return Ok(Some(entry));
        }
    }
    Ok(None)
}

/// The sweep of an agent whose stamp is nearest, the earlier one of equals; `None` without any nearby.
pub fn nearest(log: &Log, agent: &str, stamp: Nanos) -> Result<Option<Entry>, LogError> {
    if !log.has(agent, Stream::Points) {
        return Ok(None);
    }
    // A sweep is in the log from its end on, which lies after its stamp.
    let (from, until) = (stamp.saturating_sub(WINDOW), stamp.saturating_add(2 * WINDOW));
    let mut reader = log.read(&[(agent, Stream::Points)], from, until)?;
    let mut nearest: Option<Entry> = None;
    let distance = |entry: &Entry| (entry.stamp() - stamp).abs();
    while let Some(entry) = reader.next()? {
        if distance(&entry) <= WINDOW && nearest.as_ref().is_none_or(|best| distance(&entry) < distance(best)) {
            nearest = Some(entry);
        }
    }
    Ok(nearest)
}

/// A sweep's points in the ego's body frame, m; the agent's own motion during the sweep is removed where its poses allow.
pub fn in_ego_frame(
    cloud: &PointCloud,
    stamp: Nanos,
    track: &PoseTrack,
    map_from_ego: &Isometry3<f64>,
    map_from_agent: &Isometry3<f64>,
) -> Vec<[f32; 3]> {
    let ego_from_agent = relative(map_from_ego, map_from_agent);
    let [x, y, z] = at_stamp(cloud, stamp, track);
    let points = x.iter().zip(&y).zip(&z).map(|((x, y), z)| [*x, *y, *z]);
    points
        .filter(|point| point.iter().all(|v| v.is_finite()))
        .map(|point| {
            (ego_from_agent * Point3::from(point.map(f64::from)))
                .cast::<f32>()
                .into()
        })
        .collect()
}

fn at_stamp(cloud: &PointCloud, stamp: Nanos, track: &PoseTrack) -> [Vec<f32>; 3] {
    let ends = cloud.time.iter().min().zip(cloud.time.iter().max());
    let motion = ends.and_then(|(first, last)| Motion::new(track, stamp, Nanos::from(*first), Nanos::from(*last)));
    match motion {
        Some(motion) => motion.at_stamp([&cloud.x, &cloud.y, &cloud.z], &cloud.time),
        None => [cloud.x.to_vec(), cloud.y.to_vec(), cloud.z.to_vec()],
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_gap_that_a_run_bridged_is_that_of_the_settings_of_the_agents_lane() {
        for (set, ego, others) in [
            ("", 150, 150),
            ("fusion.bank.window_ms=300", 150, 150),
            ("v2x.link.range_m=1000, sync.max_gap_ms=400", 400, 400),
            ("ego.sync.max_gap_ms=250, others.sync.max_gap_ms=500", 250, 500),
            ("ego.sense.sync.max_gap_ms=250", 250, 150),
            ("others.sense.sync.max_gap_ms=100", 150, 100),
            ("sync.max_gap_ms=400, ego.sync.max_gap_ms=200", 200, 400),
        ] {
            let found = [true, false].map(|is_ego| max_gap(set, is_ego) / 1_000_000);
            assert_eq!(found, [ego, others], "{set}");
        }
    }
}
