//! One agent: where it is, and its clouds in its body frame.

use std::collections::VecDeque;

use nalgebra::{Isometry3, Translation3, UnitQuaternion};
use realo_bags::map_file::{AgentMap, Height, PoseSource, way};
use realo_bags::messages::Pose;
use realo_logs::cloud::{CloudReader, Reading};
use realo_logs::{Frames, bare};
use realo_schemas::geometry::{PoseTrack, level_from_body};
use realo_schemas::{AgentState, Name, Nanos, PointCloud, PoseStatus};

use crate::heads::Heads;

/// Attitudes further from a cloud say nothing of it, ns.
const NEAR: Nanos = 1_000_000_000;
/// Poses are kept for so long, ns.
const KEPT: Nanos = 2_000_000_000;
/// Stamps of transforms that wait for the rest of their way, at most.
const WAITING: usize = 64;

/// Why a message is left out.
#[derive(Debug, PartialEq)]
pub enum Lack {
    /// No pose is near.
    Pose,
    /// No transform leads where it belongs.
    Way(String),
    /// Its content does not fit.
    Content(String),
}

/// A pose as the graph takes it, with its stamp.
pub type Placed = (Nanos, AgentState);

/// One agent.
pub struct Agent {
    /// Its name.
    pub name: Name,
    /// Whether it is the ego.
    pub is_ego: bool,
    /// Which topics and frames it has.
    pub map: AgentMap,
    world: String,
    height: f64,
    /// World from its frame.
    track: PoseTrack,
    heads: Heads,
    newest_cloud: Option<Nanos>,
    newest_pose: Option<Nanos>,
    /// Stamps of transforms on its way whose rest may still come.
    pending: VecDeque<Nanos>,
    /// Numbers of the next cloud and pose.
    pub next: [u64; 2],
}

impl Agent {
    /// An agent of a map file.
    ///
    /// # Errors
    /// What a bag may leave open and a sensor that goes on may not.
    pub fn new(name: &str, map: &AgentMap, world: &str, is_ego: bool) -> Result<Self, String> {
        let wrong = |what: &str| Err(format!("agents.{name}: {what}"));
        let Height::Meters(height) = map.height else {
            return wrong(
                "height: expected metres, as `height: 0.3`, found `ground`: no sweep has been seen yet; `realo-lab import bag` prints what it \
                 measured in a recording",
            );
        };
        if map.clouds.len() != 1 {
            return wrong(&format!(
                "clouds: expected one topic, found {}; merge them before, as Autoware's concatenation does",
                map.clouds.len()
            ));
        }
        Ok(Agent {
            name: name.into(),
            is_ego,
            map: map.clone(),
            world: world.into(),
            height,
            track: PoseTrack::new(KEPT, NEAR),
            heads: Heads::default(),
            newest_cloud: None,
            newest_pose: None,
            pending: VecDeque::new(),
            next: [0; 2],
        })
    }

    /// What is added to its stamps, ns.
    pub fn offset(&self) -> Nanos {
        (self.map.offset.unwrap_or(0.0) * 1e9).round() as Nanos
    }

    /// Whether a cloud is later than the one before; takes its stamp.
    pub fn is_later_cloud(&mut self, stamp: Nanos) -> bool {
        is_later(&mut self.newest_cloud, stamp)
    }

    /// Body from the agent's frame, where that is turned so in the world.
    fn body_from_frame(&self, world_from_frame: &UnitQuaternion<f64>) -> Isometry3<f64> {
        Isometry3::from_parts(
            Translation3::new(0.0, 0.0, self.height),
            level_from_body(world_from_frame),
        )
    }

    /// World from its frame at a cloud, as far as is known by now.
    fn frame_at(&self, frames: &Frames, stamp: Nanos) -> Result<Isometry3<f64>, Lack> {
        if let PoseSource::Fixed(pose) = &self.map.pose {
            return Ok(*pose);
        }
        if self.stands_still(frames) {
            return way(frames, &self.world, &self.map.frame, stamp).map_err(Lack::Way);
        }
        let newest = self.track.newest().ok_or(Lack::Pose)?;
        // How a body nodded says little of how it will.
        let known = self.track.at(stamp).filter(|_| stamp <= newest);
        let nearest = || self.track.nearest(stamp).filter(|_| stamp - newest <= NEAR);
        known.or_else(nearest).ok_or(Lack::Pose)
    }

    /// Whether transforms alone place it, and none of them moves.
    fn stands_still(&self, frames: &Frames) -> bool {
        self.map.pose == PoseSource::Tf && self.moving_edges(frames).is_some_and(|moving| moving.is_empty())
    }

    /// The frames on the way from its frame up to the world that move, its own first; `None` where no way leads there.
    fn moving_edges<'a>(&'a self, frames: &'a Frames) -> Option<Vec<&'a str>> {
        let (mut frame, mut moving) = (bare(&self.map.frame), Vec::new());
        let all: Vec<(&str, &str, bool)> = frames.parents().collect();
        // A tree is no deeper than it has frames.
        for _ in 0..=all.len() {
            if frame == bare(&self.world) {
                return Some(moving);
            }
            let (_, parent, is_static) = all.iter().find(|(child, ..)| *child == frame)?;
            if !is_static {
                moving.push(frame);
            }
            frame = parent;
        }
        None
    }

    /// A cloud in the body frame, how many intensities were limited, and, of an agent that stands still, its pose.
    pub fn cloud(
        &mut self,
        frames: &Frames,
        reader: &CloudReader,
    ) -> Result<(PointCloud, u64, Option<AgentState>), Lack> {
        let stamp = reader.stamp;
        let world_from_frame = self.frame_at(frames, stamp)?;
        let mount = self.map.mount(frames, reader.frame, stamp).map_err(Lack::Way)?;
        let (scale, times) = self.heads.of(reader).map_err(Lack::Content)?;
        let reading = Reading {
            scale,
            times,
            to: Some(self.body_from_frame(&world_from_frame.rotation) * mount),
        };
        let (cloud, limited) = reader.cloud(&reading).map_err(Lack::Content)?;
        let is_still = matches!(self.map.pose, PoseSource::Fixed(_)) || self.stands_still(frames);
        let state = is_still.then(|| self.state(&world_from_frame, None));
        Ok((cloud, limited, state))
    }

    /// A pose of a topic; `None` of one that is not later than the one before.
    pub fn pose(&mut self, frames: &Frames, said: Pose) -> Result<Option<Placed>, Lack> {
        let (stamp, frame) = (said.stamp, bare(&said.frame));
        let world_from_given = match frame == bare(&self.world) || frame.is_empty() {
            true => Isometry3::identity(),
            false => way(frames, &self.world, frame, stamp).map_err(|reason| {
                Lack::Way(format!(
                    "poses are in `{frame}`, and nothing leads to the world `{}`: {reason}",
                    self.world
                ))
            })?,
        };
        let own = bare(&self.map.frame);
        let child = said.child.as_deref().map(bare).filter(|child| *child != own);
        // As when a bag is imported, a child without a transform is taken as the agent's frame.
        let child_from_own = child.and_then(|child| way(frames, child, own, stamp).ok());
        let world_from_frame = world_from_given * said.frame_from_child * child_from_own.unwrap_or_default();
        Ok(self.place(stamp, &world_from_frame, said.covariance))
    }

    /// Takes note of transforms, and gives the poses that are known by them; and how many were given up, with the reason of the last:
    /// nothing led to the world for a second, or too many wait.
    pub fn transforms(&mut self, frames: &Frames, changed: &[(&str, Nanos)]) -> (Vec<Placed>, Option<(u64, String)>) {
        if self.map.pose != PoseSource::Tf {
            return (Vec::new(), None);
        }
        let Some(lowest) = self
            .moving_edges(frames)
            .and_then(|moving| moving.first().map(|frame| frame.to_string()))
        else {
            return (Vec::new(), None);
        };
        let new = changed.iter().filter(|(child, _)| bare(child) == lowest.as_str());
        self.pending.extend(new.map(|(_, stamp)| *stamp));
        let (mut placed, mut given_up) = (Vec::new(), None);
        let newest = self.pending.iter().copied().max().unwrap_or(0);
        let room = self.pending.len().saturating_sub(WAITING);
        for (number, stamp) in std::mem::take(&mut self.pending).into_iter().enumerate() {
            match way(frames, &self.world, &self.map.frame, stamp) {
                Ok(pose) => placed.extend(self.place(stamp, &pose, None)),
                Err(_) if newest - stamp < NEAR && number >= room => self.pending.push_back(stamp),
                Err(error) => given_up = Some((given_up.map_or(1, |(count, _)| count + 1), error)),
            }
        }
        (placed, given_up)
    }

    fn place(
        &mut self,
        stamp: Nanos,
        world_from_frame: &Isometry3<f64>,
        covariance: Option<Box<[f64; 36]>>,
    ) -> Option<Placed> {
        is_later(&mut self.newest_pose, stamp).then(|| {
            self.track.insert(stamp, *world_from_frame);
            (stamp, self.state(world_from_frame, covariance))
        })
    }

    fn state(&self, world_from_frame: &Isometry3<f64>, covariance: Option<Box<[f64; 36]>>) -> AgentState {
        let body_from_frame = self.body_from_frame(&world_from_frame.rotation);
        let is_right = |numbers: &[f64; 36]| (0..6).all(|axis| numbers[7 * axis] >= 0.0);
        AgentState {
            map_from_body: world_from_frame * body_from_frame.inverse(),
            covariance: covariance.filter(|numbers| is_right(numbers)),
            velocity: None,
            angular_rate: None,
            status: PoseStatus::Recorded,
        }
    }
}

fn is_later(newest: &mut Option<Nanos>, stamp: Nanos) -> bool {
    let is_later = newest.is_none_or(|newest| stamp > newest);
    if is_later {
        *newest = Some(stamp);
    }
    is_later
}

#[cfg(test)]
mod tests {
    use realo_bags::map_file::MapFile;

    use super::*;

    const MS: Nanos = 1_000_000;
    const SECOND: Nanos = 1_000 * MS;

    fn agent(pose: &str) -> Agent {
        let text =
            format!("agents:\n  car:\n    clouds: /points\n    frame: base_link\n    height: 0.5\n    pose: {pose}\n");
        let map = MapFile::parse(&text).unwrap();
        Agent::new("car", &map.agents["car"], &map.world, true).unwrap()
    }

    fn at(x: f64, pitch: f64) -> Isometry3<f64> {
        Isometry3::from_parts(
            Translation3::new(x, 0.0, 0.5),
            UnitQuaternion::from_euler_angles(0.0, pitch, 0.0),
        )
    }

    fn said(stamp: Nanos, frame: &str, pose: Isometry3<f64>) -> Pose {
        Pose {
            stamp,
            frame: frame.into(),
            child: None,
            frame_from_child: pose,
            covariance: None,
        }
    }

    #[test]
    fn a_body_is_level_and_on_the_ground() {
        let mut agent = agent("/pose");
        let frames = Frames::default();
        let (_, state) = agent.pose(&frames, said(SECOND, "map", at(3.0, 0.1))).unwrap().unwrap();
        let found = state.map_from_body;
        assert!(
            (found.translation.vector - nalgebra::Vector3::new(3.0, 0.0, 0.0)).norm() < 1e-12,
            "{found}"
        );
        assert!(found.rotation.angle() < 1e-12);
        let again = agent.pose(&frames, said(SECOND, "map", at(3.0, 0.1))).unwrap();
        assert!(again.is_none(), "a stamp counts once");
        let lack = agent.pose(&frames, said(2 * SECOND, "odom", at(3.0, 0.1))).unwrap_err();
        let Lack::Way(reason) = lack else { panic!("{lack:?}") };
        assert!(
            reason.contains("poses are in `odom`, and nothing leads to the world `map`"),
            "{reason}"
        );
    }

    #[test]
    fn an_attitude_holds_for_a_second_at_most() {
        let mut car = agent("/pose");
        let frames = Frames::default();
        assert_eq!(car.frame_at(&frames, SECOND), Err(Lack::Pose));
        car.pose(&frames, said(SECOND, "map", at(3.0, 0.1))).unwrap();
        assert_eq!(car.frame_at(&frames, 2 * SECOND), Ok(at(3.0, 0.1)));
        assert_eq!(car.frame_at(&frames, 2 * SECOND + 1), Err(Lack::Pose));
        assert_eq!(
            agent("[1, 2, 0, 0.5]")
                .frame_at(&frames, 0)
                .map(|pose| pose.translation.x),
            Ok(1.0)
        );
    }

    #[test]
    fn transforms_give_poses_once_the_whole_way_is_there() {
        let mut agent = agent("tf");
        let mut frames = Frames::default();
        let mut tell = |frames: &mut Frames, parent: &str, child: &str, stamp: Nanos, x: f64| {
            frames.insert(false, stamp, parent, child, at(x, 0.0));
            agent.transforms(frames, &[(child, stamp)])
        };
        assert_eq!(
            tell(&mut frames, "odom", "base_link", SECOND, 1.0),
            (vec![], None),
            "odom is nowhere yet"
        );
        assert_eq!(
            tell(&mut frames, "map", "odom", SECOND, 10.0),
            (vec![], None),
            "it moves with its lowest frame"
        );
        let found = tell(&mut frames, "odom", "base_link", SECOND + 20 * MS, 1.2);
        assert!(
            found == (vec![], None),
            "one transform of odom says nothing of later: {found:?}"
        );
        let (found, _) = tell(&mut frames, "map", "odom", SECOND + 100 * MS, 10.0);
        let stamps: Vec<Nanos> = found.iter().map(|(stamp, _)| *stamp).collect();
        assert_eq!(stamps, [SECOND + 20 * MS]);
        assert!((found[0].1.map_from_body.translation.x - 11.2).abs() < 1e-9);
        assert_eq!(tell(&mut frames, "odom", "base_link", 5 * SECOND, 1.2), (vec![], None));
        let (_, given_up) = tell(&mut frames, "odom", "base_link", 7 * SECOND, 1.2);
        let (count, reason) = given_up.unwrap();
        assert!(count == 1 && reason.contains("transforms of `odom`"), "{reason}");
        // Of too many that wait the oldest are given up.
        let mut of_200_hz = |n: Nanos| tell(&mut frames, "odom", "base_link", 8 * SECOND + 5 * n * MS, 1.2).1;
        let given_up: u64 = (0..WAITING as Nanos + 10).filter_map(|n| Some(of_200_hz(n)?.0)).sum();
        assert_eq!(given_up, 11, "that of 7 s, and ten of the others");
    }

    #[test]
    fn what_stands_still_by_transforms_has_a_pose_with_each_cloud() {
        let mut frames = Frames::default();
        frames.insert(true, 0, "map", "base_link", at(4.0, 0.0));
        let mast = agent("tf");
        assert!(mast.stands_still(&frames));
        assert_eq!(
            mast.frame_at(&frames, 77 * SECOND).map(|pose| pose.translation.x),
            Ok(4.0)
        );
        assert!(!agent("/pose").stands_still(&frames));
    }

    #[test]
    fn what_a_live_agent_needs_is_named() {
        let parse = |text: &str| {
            let map = MapFile::parse(text).unwrap();
            Agent::new("car", &map.agents["car"], &map.world, true)
                .map(|_| ())
                .unwrap_err()
        };
        let error = parse("agents:\n  car: {clouds: /points, frame: base_link, pose: tf}\n");
        assert!(error.contains("agents.car: height: expected metres"), "{error}");
        let error = parse("agents:\n  car: {clouds: [/a, /b], frame: base_link, pose: tf, height: 1}\n");
        assert!(error.contains("expected one topic, found 2"), "{error}");
    }
}
