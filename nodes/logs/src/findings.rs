//! What is wrong with a log that can be read: what a run of it would stumble over, or score wrongly.

use std::collections::BTreeMap;

use nalgebra::Point3;
use realo_schemas::geometry::PoseTrack;
use realo_schemas::{Nanos, to_seconds};

use crate::timing::{self, AgentTimes, Times};
use crate::{Log, LogError, Standing, Stream};

/// Truths further apart in time are not compared, ns.
const TOGETHER: Nanos = 200_000_000;
/// An object that two agents place further apart is two objects, m.
const APART: f64 = 5.0;
/// So many positions of tracks tell whether two agents number objects alike.
const ENOUGH: usize = 2_000;
/// Poses further apart say nothing of what lies between, ns.
const GAP: Nanos = 1_000_000_000;

/// Where an agent says tracks are, in the map.
type Places = BTreeMap<u64, Point3<f64>>;

/// Agents of a pair that place the tracks that both have at different places.
#[derive(Clone, Debug, PartialEq)]
pub struct TrackConflict {
    /// The two agents.
    pub agents: [String; 2],
    /// How often both had a track at the same time.
    pub shared: usize,
    /// How often it was more than 5 m apart.
    pub apart: usize,
    /// Median of the distances, m.
    pub median: f64,
}

impl std::fmt::Display for TrackConflict {
    fn fmt(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
        let [one, other] = &self.agents;
        write!(
            f,
            "tracks of `{one}` and `{other}` name different objects: of {} positions of tracks that both have, {} lie more than \
             {APART} m apart (median {:.1} m); give an object the same track in the truth of all agents, or leave the tracks out",
            self.shared, self.apart, self.median
        )
    }
}

/// Pairs of agents whose ground truth numbers objects differently: more than half of the tracks that both have lie at
/// different places.
///
/// # Errors
/// A log that cannot be read.
pub fn track_conflicts(log: &Log) -> Result<Vec<TrackConflict>, LogError> {
    let poses = |agent: &str| {
        let streams = [Stream::PoseTruth, Stream::Pose].into_iter();
        streams.into_iter().find(|stream| log.has(agent, *stream))
    };
    let agents = log.info().agents.iter().map(|agent| agent.name.as_str());
    let agents: Vec<(&str, Stream)> = agents
        .filter(|agent| log.has(agent, Stream::GroundTruth))
        .filter_map(|agent| Some((agent, poses(agent)?)))
        .collect();
    if agents.len() < 2 {
        return Ok(Vec::new());
    }
    let mut tracks = Vec::new();
    for wanted in &agents {
        tracks.push(pose_track(log, *wanted)?);
    }
    let wanted: Vec<(&str, Stream)> = agents.iter().map(|(agent, _)| (*agent, Stream::GroundTruth)).collect();
    let mut reader = log.read_all(&wanted)?;
    let mut newest: Vec<Option<(Nanos, Places)>> = vec![None; agents.len()];
    let mut distances: BTreeMap<[usize; 2], Vec<f64>> = BTreeMap::new();
    let pairs = agents.len() * (agents.len() - 1) / 2;
    while let Some(entry) = reader.next()? {
        let Some(index) = agents.iter().position(|(agent, _)| **agent == *entry.agent) else {
            continue;
        };
        let (Some(map_from_body), Ok(boxes)) = (tracks[index].at(entry.stamp()), entry.boxes()) else {
            continue;
        };
        let place = |center: [f64; 3]| map_from_body * Point3::from(center);
        let places = boxes
            .0
            .iter()
            .filter_map(|object| Some((object.track?, place(object.center))));
        let places: Places = places.collect();
        for (other, known) in newest.iter().enumerate().filter(|(other, _)| *other != index) {
            let known = known
                .as_ref()
                .filter(|(at, _)| at.abs_diff(entry.stamp()) <= TOGETHER as u64);
            let Some((_, known)) = known else { continue };
            let between = distances.entry([index.min(other), index.max(other)]).or_default();
            let shared = places
                .iter()
                .filter_map(|(track, place)| Some((known.get(track)?, place)));
            between.extend(
                shared
                    .map(|(one, other)| (one.xy() - other.xy()).norm())
                    .filter(|far| far.is_finite()),
            );
        }
        newest[index] = Some((entry.stamp(), places));
        if distances.len() == pairs && distances.values().all(|known| known.len() >= ENOUGH) {
            break;
        }
    }
    let conflict = |(pair, mut distances): ([usize; 2], Vec<f64>)| {
        let apart = distances.iter().filter(|far| **far > APART).count();
        (2 * apart > distances.len()).then(|| {
            distances.sort_by(f64::total_cmp);
            TrackConflict {
                agents: pair.map(|index| agents[index].0.to_string()),
                shared: distances.len(),
                apart,
                median: distances[distances.len() / 2],
            }
        })
    };
    Ok(distances.into_iter().filter_map(conflict).collect())
}

fn pose_track(log: &Log, wanted: (&str, Stream)) -> Result<PoseTrack, LogError> {
    if let Some(standing) = Standing::read(log, wanted.0, wanted.1)? {
        let mut track = PoseTrack::new(Nanos::MAX, Nanos::MAX);
        let pose = standing.state.map_from_body;
        for time in [0, Nanos::MAX] {
            track.insert(time, pose);
        }
        return Ok(track);
    }
    let mut track = PoseTrack::new(Nanos::MAX, GAP);
    let mut reader = log.read_all(&[wanted])?;
    while let Some(entry) = reader.next()? {
        // What is no pose is counted when the log is played.
        if let Ok(state) = entry.pose() {
            track.insert(entry.stamp(), state.map_from_body);
        }
    }
    Ok(track)
}

/// What a run of the log would stumble over.
///
/// # Errors
/// A log that cannot be read.
pub(crate) fn problems(log: &Log) -> Result<Vec<String>, LogError> {
    let (mut problems, mut agents) = (Vec::new(), Vec::new());
    for agent in &log.info().agents {
        let mut times = AgentTimes {
            agent: agent.name.clone(),
            ..AgentTimes::default()
        };
        for stream in Stream::ALL {
            // Sweeps have the stamps of the points, in less bytes.
            let dear = stream == Stream::Points && log.has(&agent.name, Stream::Sweeps);
            if dear && log.has(&agent.name, stream) {
                let first = log.read_all(&[(&agent.name, stream)])?.next();
                let apart = first.ok().flatten().and_then(|first| first.published_apart());
                problems.extend(apart.map(|apart| two_values(&stream.topic(&agent.name), "the first message", apart)));
            }
            if dear || !log.has(&agent.name, stream) {
                continue;
            }
            match times_of(log, &agent.name, stream)? {
                Ok(known) => drop(times.streams.insert(stream, known)),
                Err(problem) => problems.push(problem),
            }
        }
        agents.push(times);
    }
    if problems.is_empty() {
        problems.extend(timing::findings(log, &agents)?);
        let conflicts = track_conflicts(log)?;
        problems.extend(conflicts.iter().map(TrackConflict::to_string));
    }
    Ok(problems)
}

/// What is wrong with messages whose publish time lies `apart` ns behind the stamp of their header.
fn two_values(topic: &str, which: &str, apart: Nanos) -> String {
    format!(
        "{topic}: the publish time of {which} is not the stamp of the header, the first lies {:.1} ms behind it: the header's counts; \
         write the stamp as both",
        apart as f64 / 1e6
    )
}

/// The times of a stream, or what is wrong with it: stamps of two values, or the first message that is there twice or starts
/// again.
fn times_of(log: &Log, agent: &str, stream: Stream) -> Result<Result<Times, String>, LogError> {
    let mut reader = log.read_all(&[(agent, stream)])?;
    let (mut times, mut apart) = (Times::new(), Vec::new());
    loop {
        match reader.next() {
            Ok(Some(entry)) => {
                times.push([entry.stamp(), entry.ready()]);
                apart.extend(entry.published_apart());
            }
            Ok(None) if apart.is_empty() => return Ok(Ok(times)),
            Ok(None) => {
                let which = format!("{} of {} messages", apart.len(), times.len());
                return Ok(Err(two_values(&stream.topic(agent), &which, apart[0])));
            }
            Err(LogError::Content {
                topic,
                log_time,
                reason,
            }) => {
                return Ok(Err(format!("{topic} at {:.3} s: {reason}", to_seconds(log_time))));
            }
            Err(error) => return Err(error),
        }
    }
}

/// Classes of the objects in the ground truth of all agents, and how often each is there.
///
/// # Errors
/// A log that cannot be read.
pub fn truth_classes(log: &Log) -> Result<BTreeMap<String, u64>, LogError> {
    let agents = log.info().agents.iter().map(|agent| agent.name.as_str());
    let wanted = agents.filter(|agent| log.has(agent, Stream::GroundTruth));
    let wanted: Vec<(&str, Stream)> = wanted.map(|agent| (agent, Stream::GroundTruth)).collect();
    let mut classes = BTreeMap::new();
    let mut reader = log.read_all(&wanted)?;
    while let Some(entry) = reader.next()? {
        for object in entry.boxes()?.0 {
            *classes.entry(object.class.to_string()).or_default() += 1;
        }
    }
    Ok(classes)
}
