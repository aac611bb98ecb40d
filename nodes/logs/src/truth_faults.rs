//! Truth whose tracks do not say which objects of two agents are one, or that has objects twice, elsewhere or not at all.

mod finding;
mod pair;

use std::collections::BTreeMap;

use nalgebra::{Isometry3, Point2, Point3};
use realo_schemas::geometry::{PoseTrack, is_plausible};
use realo_schemas::{Box3, Nanos};

use crate::{Log, LogError, Stream, pose_track};
use finding::finding;
pub use finding::{TruthFault, TruthFinding};
use pair::Pair;

/// Truths further apart in time are not compared, ns.
const TOGETHER: Nanos = 200_000_000;
/// An object that two agents place further apart is two objects, m.
const APART: f64 = 5.0;
/// Max offset between the places at which two agents have a parked object, m.
const MAX_OFFSET_M: f64 = 1.0;
/// Max way of a parked object by an agent's truth, m.
const MAX_DRIFT_M: f64 = 0.5;
/// Min positions of a track to judge whether it is parked.
const MIN_POSITIONS: usize = 5;
/// Objects of one class that two agents place nearer than this are one, m.
const SAME_PLACE: f64 = 1.0;
/// So many positions of tracks tell whether two agents number objects alike.
const ENOUGH: usize = 2_000;
/// Objects of one class and message that lie nearer than this are one, m.
const TWICE: f64 = 0.2;
/// Truth has all objects so far ahead of its agent, m, whatever the region is that is scored.
const AHEAD: f64 = 50.0;
/// And so far to each side, m.
const BESIDE: f64 = 30.0;
/// Poses further apart say nothing of what lies between, ns.
const GAP: Nanos = 1_000_000_000;
/// Of more objects than one in so many a fault is reported: labels are made by people.
const ONE_IN: usize = 50;

/// What is said of parked objects that two agents have at different places, after how many of how many: what happened, and what to
/// try.
pub const TRUTH_SHIFTED: [&str; 2] = [
    "positions of parked objects differ by more than 1 m between the truth of the two agents, and so does what they share",
    "the poses of one agent do not fit its boxes and sweeps: write poses of the frame that boxes and sweeps are in, all in one map",
];

/// An object, where its agent says that it is in the map.
struct Placed {
    track: Option<u64>,
    class: String,
    place: Point2<f64>,
    height: f64,
}

/// An agent's truth at a time.
struct Truth {
    stamp: Nanos,
    body_from_map: Isometry3<f64>,
    objects: Vec<Placed>,
}

impl Truth {
    /// How many objects of another agent's truth lie ahead and are not in this one, and how many lie there. The agent itself, which
    /// the other sees, is none.
    fn lacks(&self, others: &[Placed]) -> [usize; 2] {
        let ahead = others.iter().filter(|other| {
            let [x, y] = (self.body_from_map * Point3::new(other.place.x, other.place.y, other.height))
                .xy()
                .coords
                .into();
            (APART..AHEAD).contains(&x) && y.abs() < BESIDE
        });
        let is_there = |other: &Placed| {
            let mut own = self.objects.iter();
            own.any(|own| (own.track.is_some() && own.track == other.track) || (own.place - other.place).norm() < APART)
        };
        let (there, lacking): (Vec<&Placed>, Vec<&Placed>) = ahead.partition(|other| is_there(other));
        [lacking.len(), lacking.len() + there.len()]
    }
}

/// Where an agent's tracks were first, and how far from there at most, m.
#[derive(Default)]
struct Movement(BTreeMap<u64, (Point2<f64>, f64)>);

impl Movement {
    fn add(&mut self, objects: &[Placed]) {
        for object in objects {
            let Some(track) = object.track else { continue };
            let (first, farthest) = self.0.entry(track).or_insert((object.place, 0.0));
            *farthest = farthest.max((object.place - *first).norm());
        }
    }

    fn is_parked(&self, track: u64) -> bool {
        self.0.get(&track).is_some_and(|(_, farthest)| *farthest <= MAX_DRIFT_M)
    }
}

/// What is wrong with ground truth that has points, which are joined by tracks.
///
/// # Errors
/// A log that cannot be read.
pub fn truth_faults(log: &Log) -> Result<Vec<TruthFinding>, LogError> {
    let agents = agents_with_truth(log)?;
    if agents.len() < 2 {
        return Ok(Vec::new());
    }
    let wanted: Vec<(&str, Stream)> = agents.iter().map(|(agent, _)| (*agent, Stream::GroundTruth)).collect();
    let mut reader = log.read_all(&wanted)?;
    let mut truths = Truths {
        agents: agents.iter().map(|_| AgentTruth::default()).collect(),
        pairs: BTreeMap::new(),
    };
    while !truths.are_enough()
        && let Some(entry) = reader.next()?
    {
        let Some(index) = agents.iter().position(|(agent, _)| **agent == *entry.agent) else {
            continue;
        };
        if let (Some(map_from_body), Ok(boxes)) = (agents[index].1.at(entry.stamp()), entry.boxes()) {
            truths.add(index, entry.stamp(), &map_from_body, boxes.0);
        }
    }
    let names: Vec<&str> = agents.iter().map(|(agent, _)| *agent).collect();
    Ok(truths.findings(log, &names))
}

/// Agents whose truth counts points, each with where it was.
fn agents_with_truth(log: &Log) -> Result<Vec<(&str, PoseTrack)>, LogError> {
    let mut agents = Vec::new();
    for agent in &log.info().agents {
        let streams = [Stream::PoseTruth, Stream::Pose];
        let poses = streams.into_iter().find(|stream| log.has(&agent.name, *stream));
        if let Some(poses) = poses.filter(|_| log.has(&agent.name, Stream::GroundTruth))
            && counts_points(log, &agent.name)?
        {
            agents.push((agent.name.as_str(), pose_track(log, &agent.name, poses, GAP)?));
        }
    }
    Ok(agents)
}

/// What the truth of one agent is like.
#[derive(Default)]
struct AgentTruth {
    newest: Option<Truth>,
    doubled: usize,
    twice: usize,
    all: usize,
    movement: Movement,
}

/// The truth of all agents, as far as it has been read.
struct Truths {
    agents: Vec<AgentTruth>,
    pairs: BTreeMap<[usize; 2], Pair>,
}

impl Truths {
    /// Whether more would show nothing else.
    fn are_enough(&self) -> bool {
        let count = self.agents.len();
        self.pairs.len() == count * (count - 1) / 2 && self.pairs.values().all(|pair| pair.positions >= ENOUGH)
    }

    fn add(&mut self, index: usize, stamp: Nanos, map_from_body: &Isometry3<f64>, boxes: Vec<Box3>) {
        let agent = &mut self.agents[index];
        agent.doubled += repeated(&boxes);
        agent.all += boxes.len();
        let placed = |object: Box3| {
            let place = map_from_body * Point3::from(object.center);
            Placed {
                track: object.track,
                class: object.class.to_lowercase(),
                place: place.xy(),
                height: place.z,
            }
        };
        let objects: Vec<Placed> = boxes.into_iter().filter(is_plausible).map(placed).collect();
        agent.twice += at_one_place(&objects);
        agent.movement.add(&objects);
        let own = Truth {
            stamp,
            body_from_map: map_from_body.inverse(),
            objects,
        };
        self.compare(index, &own);
        self.agents[index].newest = Some(own);
    }

    /// Compares an agent's truth with what others had at nearly the same time.
    fn compare(&mut self, index: usize, own: &Truth) {
        let others = self.agents.iter().enumerate().filter(|(other, _)| *other != index);
        for (other, known) in others {
            let near = |known: &&Truth| known.stamp.abs_diff(own.stamp) <= TOGETHER.unsigned_abs();
            if let Some(known) = known.newest.as_ref().filter(near) {
                let pair = self.pairs.entry([index.min(other), index.max(other)]).or_default();
                pair.compare(&own.objects, &known.objects);
                let (first, second) = if index < other { (own, known) } else { (known, own) };
                for (of, (own, other)) in pair.lacking.iter_mut().zip([(first, second), (second, first)]) {
                    let [lacking, all] = own.lacks(&other.objects);
                    (of[0], of[1]) = (of[0] + lacking, of[1] + all);
                }
            }
        }
    }

    fn findings(&self, log: &Log, names: &[&str]) -> Vec<TruthFinding> {
        let mut faults = Vec::new();
        for (agent, name) in self.agents.iter().zip(names) {
            let found = [(TruthFault::Doubled, agent.doubled), (TruthFault::Twice, agent.twice)];
            let of_agent = found.map(|(fault, count)| finding(vec![name.to_string()], fault, count, agent.all));
            faults.extend(of_agent.into_iter().flatten());
        }
        for (pair, known) in &self.pairs {
            faults.extend(self.findings_of_pair(log, names, *pair, known));
        }
        faults
    }

    fn findings_of_pair(&self, log: &Log, names: &[&str], pair: [usize; 2], known: &Pair) -> Vec<TruthFinding> {
        let agents: Vec<String> = pair.iter().map(|index| names[*index].to_string()).collect();
        let mut faults = Vec::new();
        let (apart, median) = known.apart();
        faults.extend(finding(
            agents.clone(),
            TruthFault::Apart(median),
            apart,
            known.positions,
        ));
        let is_parked = |track| pair.iter().all(|index| self.agents[*index].movement.is_parked(track));
        if let Some((median, shifted, of)) = known.shifted(is_parked) {
            faults.extend(finding(agents.clone(), TruthFault::Shifted(median), shifted, of));
        }
        let of = known.positions + known.split;
        faults.extend(finding(agents.clone(), TruthFault::Split, known.split, of));
        let [first, second] = known.lacking;
        let reversed: Vec<String> = agents.iter().rev().cloned().collect();
        for (agents, [count, of]) in [(agents, first), (reversed, second)] {
            // Labels of what a camera shows are not all that there is.
            if !log.has(&agents[0], Stream::GroundTruthViews) {
                faults.extend(finding(agents, TruthFault::Lacking, count, of));
            }
        }
        faults
    }
}

/// Whether an agent's truth says how many points it has on objects, by its first message.
fn counts_points(log: &Log, agent: &str) -> Result<bool, LogError> {
    if !log.has(agent, Stream::GroundTruthInfo) {
        return Ok(false);
    }
    let first = |stream| log.read_all(&[(agent, stream)])?.next();
    let (Some(boxes), Some(info)) = (first(Stream::GroundTruth)?, first(Stream::GroundTruthInfo)?) else {
        return Ok(false);
    };
    // What cannot be read is reported where it is played.
    let points = boxes.boxes().and_then(|mut boxes| info.info(&mut boxes));
    Ok(points.is_ok_and(|info| info.points.is_some()))
}

/// Objects whose track another one of the message has.
fn repeated(objects: &[Box3]) -> usize {
    let mut seen = BTreeMap::new();
    for track in objects.iter().filter_map(|object| object.track) {
        *seen.entry(track).or_insert(0) += 1;
    }
    seen.values().filter(|count| **count > 1).sum()
}

/// Objects that lie at the place of another one of their class.
fn at_one_place(objects: &[Placed]) -> usize {
    let twice = objects.iter().enumerate().filter(|(index, one)| {
        let mut others = objects.iter().enumerate();
        others.any(|(other, known)| {
            other != *index && known.class == one.class && (known.place - one.place).norm() < TWICE
        })
    });
    twice.count()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn placed(objects: &[(Option<u64>, f64)]) -> Vec<Placed> {
        let one = |(track, x): &(Option<u64>, f64)| Placed {
            track: *track,
            class: "car".into(),
            place: Point2::new(*x, 0.0),
            height: 0.0,
        };
        objects.iter().map(one).collect()
    }

    #[test]
    fn tracks_are_compared_one_by_one() {
        let own = placed(&[(Some(1), 0.0), (Some(2), 10.0), (Some(3), 20.0), (Some(4), 30.0)]);
        let mut alike = Pair::default();
        alike.compare(&own, &placed(&[(Some(4), 30.4), (Some(2), 10.0), (Some(9), 50.0)]));
        assert_eq!((alike.positions, alike.split, alike.apart().0), (2, 0, 0));

        // One of three has the track of another object, which has one of its own.
        let mut swapped = Pair::default();
        swapped.compare(
            &own,
            &placed(&[(Some(1), 0.0), (Some(2), 10.0), (Some(4), 20.3), (Some(8), 30.3)]),
        );
        assert_eq!((swapped.positions, swapped.split), (3, 0));
        assert_eq!(swapped.apart().0, 1);

        let mut split = Pair::default();
        split.compare(
            &own,
            &placed(&[(Some(101), 0.2), (None, 10.2), (Some(3), 20.0), (Some(105), 90.0)]),
        );
        assert_eq!((split.positions, split.split, split.apart().0), (1, 2, 0));
    }

    #[test]
    fn parked_objects_show_that_poses_do_not_fit() {
        let shifted = |far: f64, speed: f64, parked: u64| {
            let (mut pair, mut movement) = (Pair::default(), Movement::default());
            for message in 0..10 {
                let moved = speed * f64::from(message);
                let own = placed(&[(Some(1), moved), (Some(2), 10.0 + moved), (Some(3), 40.0)]);
                let others = placed(&[
                    (Some(1), moved + far),
                    (Some(2), 10.0 + moved + far),
                    (Some(3), 40.0 + far),
                ]);
                pair.compare(&own, &others);
                movement.add(&own);
            }
            pair.shifted(|track| movement.is_parked(track) && track <= parked)
        };
        assert_eq!(shifted(3.0, 0.0, 3), Some((3.0, 30, 30)));
        assert_eq!(shifted(0.9, 0.0, 3), None);
        assert_eq!(shifted(7.0, 0.0, 3), None, "these are of different objects");
        assert_eq!(shifted(3.0, 1.0, 3), None, "one parked object is not enough");
        assert_eq!(shifted(3.0, 0.0, 1), None);
    }

    #[test]
    fn truth_lacks_what_others_have_ahead() {
        let truth = |objects: &[(Option<u64>, f64)]| Truth {
            stamp: 0,
            body_from_map: Isometry3::translation(-100.0, 0.0, 0.0),
            objects: placed(objects),
        };
        // At 100 m the agent itself, behind it another one, far ahead a third.
        let others = placed(&[
            (Some(9), 100.5),
            (Some(1), 80.0),
            (Some(2), 112.0),
            (Some(3), 130.0),
            (None, 155.0),
        ]);
        assert_eq!(truth(&[(Some(2), 112.3)]).lacks(&others), [1, 2]);
        assert_eq!(truth(&[(None, 112.3), (Some(3), 90.0)]).lacks(&others), [0, 2]);
        assert_eq!(truth(&[]).lacks(&others), [2, 2]);
    }

    #[test]
    fn objects_that_are_there_twice_are_counted() {
        let objects = placed(&[(Some(1), 0.0), (Some(2), 0.1), (Some(3), 0.4), (None, 5.0)]);
        assert_eq!(at_one_place(&objects), 2);
    }

    #[test]
    fn a_fault_is_reported_of_more_than_one_object_in_fifty() {
        let of = |count| finding(Vec::new(), TruthFault::Split, count, 1000).is_some();
        assert_eq!([of(0), of(20), of(21)], [false, false, true]);
    }
}
