//! Where an agent's frame is in the world, over time.

use std::collections::BTreeMap;

use nalgebra::{Isometry3, Matrix6, Translation3, UnitQuaternion, Vector3};
use realo_bags::Bag;
use realo_bags::map_file::{PoseSource, way};
use realo_bags::messages::{Attitude, Fix, Kind, Pose};
use realo_logs::{MapOrigin, bare};
use realo_schemas::geometry::interpolate;
use realo_schemas::{Nanos, to_millis, to_seconds};

use super::agents::{Agent, Topic, with_others};
use super::small::{At, BagSmall, Small};
use super::{Counted, Import};
use crate::ImportError;

/// Poses farther apart are not bridged, ns.
const BRIDGED: Nanos = 1_500_000_000;
/// Poses go on for so long beyond their ends, ns.
const BEYOND: Nanos = 150_000_000;
/// Poses farther apart than a run bridges are written at the sweeps too, ns.
const SPARSE: Nanos = 120_000_000;
/// An attitude is of the same time as a position, ns.
const SAME_TIME: Nanos = 100_000_000;
/// Poses of one stamp that differ by no more are one, m and rad.
const SAME_PLACE: f64 = 1e-3;
const SAME_TURN: f64 = 1e-4;
/// A larger variance says that nothing is known, m² or rad².
const MOST_VARIANCE: f64 = 1e12;
/// A course is known where a vehicle went on by so much, m.
const MOVED: f64 = 0.5;

/// Where a frame is over time, by stamps as the bag has them.
pub struct Track {
    /// Rising by stamp: stamp, log time, world from frame.
    pub poses: Vec<(Nanos, Nanos, Isometry3<f64>)>,
    /// Whether it stands still, so that its only pose holds at all times.
    pub is_fixed: bool,
    /// How it was found, in words.
    pub words: String,
    /// Covariances of poses by their stamps, where the bag has them.
    pub covariances: BTreeMap<Nanos, Box<[f64; 36]>>,
    /// How many poses differ from an earlier one of the same stamp, and by how much at most, m.
    pub contradicted: (usize, f64),
}

impl Track {
    fn fixed(pose: Isometry3<f64>, words: String) -> Self {
        Track {
            poses: vec![(0, 0, pose)],
            is_fixed: true,
            words,
            covariances: BTreeMap::new(),
            contradicted: (0, 0.0),
        }
    }

    fn moving(mut poses: Vec<(Nanos, Nanos, Isometry3<f64>)>, words: String) -> Self {
        poses.sort_by_key(|(stamp, ..)| *stamp);
        let (mut count, mut most) = (0, 0.0_f64);
        poses.dedup_by(|(stamp, _, pose), (at, _, first)| {
            let is_again = stamp == at;
            let metres = (pose.translation.vector - first.translation.vector).norm();
            if is_again && (metres > SAME_PLACE || pose.rotation.angle_to(&first.rotation) > SAME_TURN) {
                (count, most) = (count + 1, most.max(metres));
            }
            is_again
        });
        Track {
            poses,
            is_fixed: false,
            words,
            covariances: BTreeMap::new(),
            contradicted: (count, most),
        }
    }

    /// World from frame at a time; `None` where no poses are near.
    pub fn at(&self, stamp: Nanos) -> Option<Isometry3<f64>> {
        if self.is_fixed {
            return self.poses.first().map(|(.., pose)| *pose);
        }
        let next = self.poses.partition_point(|(at, ..)| *at < stamp);
        let place = next.clamp(1, self.poses.len().saturating_sub(1).max(1));
        let (t0, _, a) = self.poses.get(place - 1)?;
        let Some((t1, _, b)) = self.poses.get(place) else {
            return ((stamp - t0).abs() <= BEYOND).then_some(*a);
        };
        let beyond = stamp.saturating_sub(*t1).max(t0.saturating_sub(stamp));
        let is_near = t1 - t0 <= BRIDGED && beyond <= BEYOND;
        is_near.then(|| interpolate(a, b, to_seconds(stamp - t0) / to_seconds(t1 - t0)))
    }

    /// The pose whose stamp is nearest: its stamp and log time.
    pub fn nearest(&self, stamp: Nanos) -> Option<[Nanos; 2]> {
        let next = self.poses.partition_point(|(at, ..)| *at < stamp);
        let around = self.poses[next.saturating_sub(1)..].iter().take(2);
        around
            .map(|(at, log_time, _)| [*at, *log_time])
            .min_by_key(|[at, _]| at.abs_diff(stamp))
    }

    /// Whether poses are too far apart for a run, so that each sweep needs one of its own.
    pub fn is_sparse(&self) -> bool {
        self.is_fixed || self.step().is_none_or(|step| step > SPARSE)
    }

    /// Median time from a pose to the next, ns; `None` with fewer than two.
    fn step(&self) -> Option<Nanos> {
        let mut steps: Vec<Nanos> = self.poses.array_windows().map(|[(a, ..), (b, ..)]| b - a).collect();
        steps.sort_unstable();
        steps.get(steps.len() / 2).copied()
    }

    /// Median time between poses, in words.
    pub fn step_words(&self) -> String {
        match self.step() {
            Some(step) if step > SPARSE => {
                format!(", {:.0} ms apart and interpolated at the sweeps", to_millis(step))
            }
            _ => String::new(),
        }
    }
}

/// Where the world is on the Earth, by the map file or by the first position of any agent.
pub fn origin(import: &Import, small: &Small) -> Result<Option<[f64; 3]>, ImportError> {
    let first = || {
        let fixes = small.agents.iter().flat_map(|agent| &agent.fixes);
        fixes.filter_map(|fix| fix.said.geodetic).next()
    };
    let origin = import.map.map_origin.or_else(first);
    origin
        .map(|origin| MapOrigin::new(origin).map(|_| origin))
        .transpose()
        .map_err(|reason| ImportError::Option(format!("map_origin: {reason}")))
}

/// The poses of an agent.
///
/// # Errors
/// No pose is there, or none leads to the world: what is there instead.
pub fn track(
    import: &Import,
    small: &Small,
    place: usize,
    origin: Option<[f64; 3]>,
    faults: &mut Counted,
) -> Result<Track, ImportError> {
    let agent = &import.agents[place];
    let bag = &small.bags[agent.bag];
    let wrong = |reason: String| {
        let path = import.joined.bags[agent.bag].path();
        ImportError::content(
            path,
            format!("agent `{}`: {reason}{}", agent.name, elsewhere(import, agent)),
        )
    };
    let ours = &small.agents[place];
    let track = match (&agent.map.pose, &agent.pose) {
        (PoseSource::Fixed(pose), _) => Track::fixed(*pose, "it stands still, by the map file".into()),
        (_, Some(topic)) if topic.kind == Kind::NavSatFix => {
            let origin = origin.and_then(|origin| MapOrigin::new(origin).ok());
            let origin = origin.ok_or_else(|| wrong(format!("expected positions on `{}`, found none", topic.name)))?;
            of_fixes(agent, bag, &ours.fixes, &ours.attitudes, &origin, &topic.name)
        }
        (_, Some(topic)) => of_poses(import, agent, bag, &ours.poses, topic, faults).map_err(wrong)?,
        (_, None) => of_transforms(import, agent, bag, ours.heads[0].stamps[0][0], faults).map_err(wrong)?,
    };
    match track.poses.is_empty() {
        true => Err(wrong(format!("expected poses, found none in {}", track.words))),
        false => Ok(track),
    }
}

/// Where poses may be instead: in a file that no agent has.
fn elsewhere(import: &Import, agent: &Agent) -> String {
    let has_poses = |bag: &dyn Bag| {
        let kinds = bag
            .connections()
            .iter()
            .filter_map(|connection| Kind::named(&connection.kind));
        kinds.into_iter().any(|kind| kind == Kind::Transforms || kind.is_pose())
    };
    with_others(&import.files, &import.joined, agent.bag, has_poses)
        .map_or(String::new(), |other| format!("; or are they in another file? {other}"))
}

/// Poses of a topic, in the world and of the agent's frame.
fn of_poses(
    import: &Import,
    agent: &Agent,
    bag: &BagSmall,
    said: &[At<Pose>],
    topic: &Topic,
    faults: &mut Counted,
) -> Result<Track, String> {
    let (mut poses, mut covariances) = (Vec::new(), BTreeMap::new());
    let mut words = BTreeWords::default();
    let world = bare(&import.map.world);
    for At { log_time, said } in said {
        let stamp = said.stamp;
        let frame = bare(&said.frame);
        let world_from_frame = match frame == world || frame.is_empty() {
            true => Ok(Isometry3::identity()),
            false => way(&bag.frames, world, frame, stamp),
        };
        let child_from_frame = child_from_frame(agent, bag, said, &mut words);
        match world_from_frame {
            Ok(from) => {
                let pose = from * said.frame_from_child * child_from_frame;
                if let Some(known) = covariance(said, &from, &child_from_frame) {
                    covariances.entry(stamp).or_insert(known);
                }
                poses.push((stamp, *log_time, pose));
            }
            Err(reason) => faults.add(
                &topic.name,
                format!("poses are in `{frame}`, and nothing leads to the world `{world}`: {reason}"),
            ),
        }
    }
    if poses.is_empty() {
        return Err(no_poses(import, said, topic));
    }
    Ok(Track {
        covariances,
        ..Track::moving(poses, format!("`{}` ({}){words}", topic.name, words_of(topic.kind)))
    })
}

/// Where the agent's frame lies in the frame that a message gives the pose of.
fn child_from_frame(agent: &Agent, bag: &BagSmall, said: &Pose, words: &mut BTreeWords) -> Isometry3<f64> {
    let frame = &agent.map.frame;
    let child = said.child.as_deref().map(bare).filter(|child| *child != bare(frame));
    let Some(child) = child else {
        return Isometry3::identity();
    };
    way(&bag.frames, child, frame, said.stamp).unwrap_or_else(|_| {
        words.add(format!(
            "its child `{child}` is taken as `{frame}`: no transform leads there"
        ));
        Isometry3::identity()
    })
}

/// Why a topic gives no pose of the world.
fn no_poses(import: &Import, said: &[At<Pose>], topic: &Topic) -> String {
    let frames: std::collections::BTreeSet<&str> = said.iter().map(|pose| bare(&pose.said.frame)).take(100).collect();
    let frames: Vec<&str> = frames.into_iter().collect();
    match frames[..] {
        [] => format!(
            "expected poses on `{}`, found none that can be read; name another topic, or `pose: tf`",
            topic.name
        ),
        _ => format!(
            "its poses are in `{}`, expected the world `{}`, and no transform leads there; write `world: {}` in the map file",
            frames.join("` and `"),
            import.map.world,
            frames[0]
        ),
    }
}

/// The covariance of a pose in the world, where its message has one.
fn covariance(
    said: &Pose,
    world_from_frame: &Isometry3<f64>,
    child_from_frame: &Isometry3<f64>,
) -> Option<Box<[f64; 36]>> {
    let arm = (world_from_frame * said.frame_from_child).rotation * child_from_frame.translation.vector;
    let moved = moved_covariance(said.covariance.as_ref()?, &world_from_frame.rotation, &arm)?;
    Some(Box::new(moved))
}

/// The covariance of a pose whose frame is turned, and whose origin is moved by `arm` in the new frame, m: over x, y, z and
/// rotations about them, row-major. `None` of one that no pose can have.
fn moved_covariance(covariance: &[f64; 36], turn: &UnitQuaternion<f64>, arm: &Vector3<f64>) -> Option<[f64; 36]> {
    let turn = turn.to_rotation_matrix();
    let mut jacobian = Matrix6::zeros();
    jacobian.fixed_view_mut::<3, 3>(0, 0).copy_from(turn.matrix());
    jacobian.fixed_view_mut::<3, 3>(3, 3).copy_from(turn.matrix());
    jacobian
        .fixed_view_mut::<3, 3>(0, 3)
        .copy_from(&(-arm.cross_matrix() * turn.matrix()));
    let given = Matrix6::from_row_slice(covariance);
    let symmetric = (given + given.transpose()) * 0.5;
    let is_one = (given - symmetric).abs().max() <= 1e-6 * given.abs().max()
        && symmetric
            .diagonal()
            .iter()
            .all(|variance| (0.0..=MOST_VARIANCE).contains(variance));
    let moved = jacobian * symmetric * jacobian.transpose();
    let moved = (moved + moved.transpose()) * 0.5;
    let numbers: [f64; 36] = moved.transpose().as_slice().try_into().ok()?;
    is_one.then_some(numbers)
}

/// Remarks, each once.
#[derive(Default)]
struct BTreeWords(std::collections::BTreeSet<String>);

impl BTreeWords {
    fn add(&mut self, words: String) {
        if self.0.len() < 4 {
            self.0.insert(words);
        }
    }
}

impl std::fmt::Display for BTreeWords {
    fn fmt(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
        self.0.iter().try_for_each(|words| write!(f, "; {words}"))
    }
}

fn words_of(kind: Kind) -> &'static str {
    match kind {
        Kind::Odometry => "Odometry",
        Kind::PoseStamped => "PoseStamped",
        _ => "PoseWithCovarianceStamped",
    }
}

fn of_transforms(
    import: &Import,
    agent: &Agent,
    bag: &BagSmall,
    first: Nanos,
    faults: &mut Counted,
) -> Result<Track, String> {
    let (world, frame) = (bare(&import.map.world), bare(&agent.map.frame));
    let words = format!("transforms from `{world}` to `{frame}`");
    let mut poses = Vec::new();
    let mut reason = String::new();
    for (stamp, log_time) in &bag.moving {
        match way(&bag.frames, world, frame, *stamp) {
            Ok(pose) => poses.push((*stamp, *log_time, pose)),
            Err(error) => reason = error,
        }
    }
    let lost = bag.moving.len() - poses.len();
    if lost > 0 && !poses.is_empty() {
        faults.add(
            "/tf",
            format!("no way from `{world}` to `{frame}` at some stamps: {reason}"),
        );
    }
    let moves = |poses: &[(Nanos, Nanos, Isometry3<f64>)]| {
        let first = poses[0].2;
        poses
            .iter()
            .any(|(.., pose)| (pose.translation.vector - first.translation.vector).norm() > 0.01)
    };
    if !poses.is_empty() && moves(&poses) {
        return Ok(Track::moving(poses, words));
    }
    // Where nothing moves, one transform holds at all times.
    match poses
        .first()
        .map(|(.., pose)| Ok(*pose))
        .unwrap_or_else(|| way(&bag.frames, world, frame, first))
    {
        Ok(pose) => Ok(Track::fixed(pose, format!("{words}, which stand still"))),
        Err(_) if poses.is_empty() && !bag.moving.is_empty() => Err(format!(
            "expected transforms from the world `{world}` to `{frame}`: {reason}; name a topic of poses as `pose`, or another `world` or `frame`"
        )),
        Err(reason) => Err(format!(
            "expected transforms from the world `{world}` to `{frame}`: {reason}; name a topic of poses as `pose`, or write [x, y, z, yaw] \
             if it stands still"
        )),
    }
}

/// Positions of an antenna, with attitudes of an inertial unit or the course.
fn of_fixes(
    agent: &Agent,
    bag: &BagSmall,
    fixes: &[At<Fix>],
    attitudes: &[Attitude],
    origin: &MapOrigin,
    topic: &str,
) -> Track {
    let mut words = BTreeWords::default();
    let frame = &agent.map.frame;
    let known = rotations(frame, bag, attitudes, &mut words);
    let places: Vec<(Nanos, Nanos, Vector3<f64>, &str)> = fixes
        .iter()
        .filter_map(|fix| {
            let place = Vector3::from(origin.to_map(fix.said.geodetic?));
            Some((fix.said.stamp, fix.log_time, place, fix.said.frame.as_str()))
        })
        .collect();
    let courses = courses(&places);
    let by = if known.is_empty() { "course" } else { "inertial unit" };
    let mut poses = Vec::new();
    for (stamp, log_time, place, antenna) in &places {
        let rotation = match nearest(&known, *stamp) {
            Some((at, rotation)) if (at - stamp).abs() <= SAME_TIME => rotation,
            Some(_) => continue,
            None => match nearest(&courses, *stamp) {
                Some((_, rotation)) => rotation,
                None => {
                    words.add("it never moved, so its heading is taken as east".into());
                    UnitQuaternion::identity()
                }
            },
        };
        let lever = match bare(antenna) == bare(frame) {
            true => Vector3::zeros(),
            false => way(&bag.frames, frame, antenna, *stamp).map_or_else(
                |_| {
                    words.add(format!(
                        "the antenna's frame `{antenna}` is taken as `{frame}`: no transform leads there"
                    ));
                    Vector3::zeros()
                },
                |pose| pose.translation.vector,
            ),
        };
        let origin = Translation3::from(place - rotation * lever);
        poses.push((*stamp, *log_time, Isometry3::from_parts(origin, rotation)));
    }
    Track::moving(poses, format!("positions on `{topic}`, attitude by the {by}{words}"))
}

/// Rotations of the agent's frame in the world, by its inertial unit, in order of time.
fn rotations(
    frame: &str,
    bag: &BagSmall,
    attitudes: &[Attitude],
    words: &mut BTreeWords,
) -> Vec<(Nanos, UnitQuaternion<f64>)> {
    let mut known = Vec::new();
    for attitude in attitudes {
        let Some(world_from_unit) = attitude.world_from_unit else {
            continue;
        };
        let frame_from_unit = match bare(&attitude.frame) == bare(frame) {
            true => UnitQuaternion::identity(),
            false => way(&bag.frames, frame, &attitude.frame, attitude.stamp).map_or_else(
                |_| {
                    words.add(format!(
                        "the unit's frame `{}` is taken as `{frame}`: no transform leads there",
                        attitude.frame
                    ));
                    UnitQuaternion::identity()
                },
                |pose| pose.rotation,
            ),
        };
        known.push((attitude.stamp, world_from_unit * frame_from_unit.inverse()));
    }
    known.sort_by_key(|(stamp, _)| *stamp);
    known
}

fn nearest<T: Copy>(known: &[(Nanos, T)], stamp: Nanos) -> Option<(Nanos, T)> {
    let next = known.partition_point(|(at, _)| *at < stamp);
    let around = known[next.saturating_sub(1)..].iter().take(2);
    around.min_by_key(|(at, _)| (at - stamp).abs()).copied()
}

/// Headings by where a vehicle went, in the middle of each step.
fn courses(places: &[(Nanos, Nanos, Vector3<f64>, &str)]) -> Vec<(Nanos, UnitQuaternion<f64>)> {
    let mut courses = Vec::new();
    let Some(mut anchor) = places.first() else {
        return courses;
    };
    for place in places {
        let step = place.2 - anchor.2;
        if step.xy().norm() >= MOVED {
            let yaw = libm::atan2(step.y, step.x);
            let middle = anchor.0 + (place.0 - anchor.0) / 2;
            courses.push((middle, UnitQuaternion::from_euler_angles(0.0, 0.0, yaw)));
            anchor = place;
        }
    }
    courses
}

#[cfg(test)]
mod tests {
    use super::*;

    fn along(x: f64) -> Isometry3<f64> {
        Isometry3::translation(x, 0.0, 0.0)
    }

    #[test]
    fn poses_are_bridged_and_end() {
        let ms = 1_000_000;
        let poses = [(0, 0.0), (100, 1.0), (200, 2.0), (3000, 9.0)].map(|(t, x)| (t * ms, t * ms, along(x)));
        let track = Track::moving(poses.into(), String::new());
        let x = |t: Nanos| track.at(t * ms).map(|pose| pose.translation.vector.x);
        for (t, expected) in [
            (50, Some(0.5)),
            (100, Some(1.0)),
            (-100, Some(-1.0)),
            (-200, None),
            (1000, None),
            (3000, None),
        ] {
            assert_eq!(x(t), expected, "{t}");
        }
        assert!(!track.is_sparse() && track.contradicted == (0, 0.0));
        let twice = [(0, 0.0), (100, 1.0), (100, 1.0), (100, 4.0), (200, 2.0)].map(|(t, x)| (t * ms, t * ms, along(x)));
        let twice = Track::moving(twice.into(), String::new());
        assert_eq!((twice.poses.len(), twice.contradicted), (3, (1, 3.0)));
        assert_eq!(twice.at(100 * ms), Some(along(1.0)), "the first counts");
        let one = Track::moving(vec![(0, 0, along(1.0))], String::new());
        assert!(one.at(100 * ms).is_some() && one.at(200 * ms).is_none() && one.is_sparse());
        assert!(Track::moving(Vec::new(), String::new()).at(0).is_none());
        assert_eq!(Track::fixed(along(4.0), String::new()).at(1 << 60), Some(along(4.0)));
    }

    #[test]
    fn covariances_turn_with_their_frame_and_grow_with_the_arm() {
        let mut covariance = [0.0; 36];
        for (axis, variance) in [4.0, 1.0, 0.25, 0.0, 0.0, 0.01].into_iter().enumerate() {
            covariance[7 * axis] = variance;
        }
        let turn = UnitQuaternion::from_euler_angles(0.0, 0.0, std::f64::consts::FRAC_PI_2);
        let still = moved_covariance(&covariance, &turn, &Vector3::zeros()).unwrap();
        for (axis, variance) in [1.0, 4.0, 0.25, 0.0, 0.0, 0.01].into_iter().enumerate() {
            assert!((still[7 * axis] - variance).abs() < 1e-12, "{axis}");
        }
        // 10 m ahead along y of the new frame, an error of the heading of 0.1 rad is 1 m aside.
        let moved = moved_covariance(&covariance, &turn, &Vector3::new(0.0, 10.0, 0.0)).unwrap();
        assert!((moved[0] - 2.0).abs() < 1e-12 && (moved[7] - 4.0).abs() < 1e-12);
        assert!((moved[5] + 0.1).abs() < 1e-12 && (moved[30] + 0.1).abs() < 1e-12);
        covariance[1] = 0.5;
        assert!(
            moved_covariance(&covariance, &turn, &Vector3::zeros()).is_none(),
            "it is not symmetric"
        );
        (covariance[1], covariance[0]) = (0.0, -1.0);
        assert!(
            moved_covariance(&covariance, &turn, &Vector3::zeros()).is_none(),
            "a variance is below 0"
        );
    }

    #[test]
    fn a_course_is_where_a_vehicle_went() {
        let place = |t: Nanos, x: f64, y: f64| (t, t, Vector3::new(x, y, 0.0), "gps");
        let found = courses(&[
            place(0, 0.0, 0.0),
            place(10, 0.0, 0.1),
            place(20, 0.0, 1.0),
            place(30, 1.0, 1.0),
        ]);
        let yaws: Vec<(Nanos, f64)> = found.iter().map(|(t, q)| (*t, q.euler_angles().2)).collect();
        assert_eq!(yaws.iter().map(|(t, _)| *t).collect::<Vec<_>>(), [10, 25]);
        assert!((yaws[0].1 - std::f64::consts::FRAC_PI_2).abs() < 1e-12 && yaws[1].1.abs() < 1e-12);
        assert!(courses(&[]).is_empty());
    }
}
