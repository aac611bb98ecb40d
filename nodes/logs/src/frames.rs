//! The tree of frames that `/tf_static` and `/tf` of a log span.

use std::collections::{BTreeMap, BTreeSet};

use nalgebra::Isometry3;
use realo_schemas::{Nanos, to_seconds};

use crate::pose::decode_transforms;
use crate::{LogError, McapFile, Schema};

/// Topics of transforms; what is on the first holds for all times.
const STATIC: &str = "/tf_static";
const TOPICS: [&str; 2] = [STATIC, "/tf"];
/// Before the first and behind the last transform of a frame, these hold for so long.
const REACH: Nanos = 100_000_000;

/// Frames of a log by their name.
#[derive(Debug, Default)]
pub(crate) struct Frames {
    edges: BTreeMap<String, Edge>,
}

/// How a frame lies in its parent.
#[derive(Debug)]
struct Edge {
    parent: String,
    topic: &'static str,
    /// Rising by time.
    at: BTreeMap<Nanos, Isometry3<f64>>,
    /// Another parent that the log says it has.
    other: Option<String>,
    /// Why no value of it can be believed: the log gives two for one time.
    contradiction: Option<String>,
}

/// Transforms that differ by less are one: texts and single precision round by less, m and rad.
const SAME: [f64; 2] = [1e-3, 1e-4];

/// The way from a frame to another.
#[derive(Debug, PartialEq)]
pub(crate) struct Way {
    pub to_from_from: Isometry3<f64>,
    /// Topics whose transforms lead there.
    pub by: BTreeSet<&'static str>,
}

impl Frames {
    /// All transforms of a file.
    pub fn read(file: &McapFile) -> Result<Self, LogError> {
        let mut frames = Frames::default();
        let topics: BTreeMap<u16, &'static str> = file
            .channels()
            .iter()
            .filter(|(_, channel)| channel.schema == Schema::TfMessage.name() && channel.encoding == "cdr")
            .filter_map(|(id, channel)| Some((*id, TOPICS.into_iter().find(|topic| *topic == channel.topic)?)))
            .collect();
        let mut messages = file.messages(topics.keys().copied().collect(), 0..u64::MAX)?;
        while let Some(message) = messages.next()? {
            let topic = topics[&message.channel];
            let transforms = decode_transforms(message.data()).map_err(|reason| LogError::Content {
                topic: topic.into(),
                log_time: message.log_time.min(Nanos::MAX as u64) as Nanos,
                reason,
            })?;
            for t in transforms {
                frames.add(topic, t.stamp, bare(t.parent), bare(t.child), t.parent_from_child);
            }
        }
        Ok(frames)
    }

    fn add(&mut self, topic: &'static str, stamp: Nanos, parent: &str, child: &str, pose: Isometry3<f64>) {
        let new = || Edge {
            parent: parent.into(),
            topic,
            at: BTreeMap::new(),
            other: None,
            contradiction: None,
        };
        let edge = self.edges.entry(child.into()).or_insert_with(new);
        if edge.parent != parent {
            edge.other = Some(parent.into());
            return;
        }
        if edge.contradiction.is_none() {
            edge.contradiction = edge.contradicts(child, topic, stamp, &pose);
        }
        edge.at.entry(stamp).or_insert(pose);
    }

    /// How to bring what lies in `from` into `to`, at a time.
    pub fn way(&self, to: &str, from: &str, stamp: Nanos) -> Result<Way, String> {
        let (up, down) = (self.ancestors(from, stamp), self.ancestors(to, stamp));
        let common = up
            .iter()
            .find_map(|step| Some((step, down.iter().find(|other| other.frame == step.frame)?)));
        let Some((up, down)) = common else {
            let stopped = [up, down]
                .into_iter()
                .find_map(|steps| steps.into_iter().find_map(|step| step.stopped));
            return Err(stopped.unwrap_or_else(|| self.tree()));
        };
        Ok(Way {
            to_from_from: down.this_from_start.inv_mul(&up.this_from_start),
            by: up.by.union(&down.by).copied().collect(),
        })
    }

    /// The frame itself, its parent, and so on to the root.
    fn ancestors<'a>(&'a self, frame: &'a str, stamp: Nanos) -> Vec<Step<'a>> {
        let mut steps = vec![Step {
            frame,
            this_from_start: Isometry3::identity(),
            by: BTreeSet::new(),
            stopped: None,
        }];
        // A tree is no deeper than it has frames.
        for _ in 0..self.edges.len() {
            let last = steps.len() - 1;
            let Some(edge) = self.edges.get(steps[last].frame) else {
                break;
            };
            match edge.pose(steps[last].frame, stamp) {
                Err(reason) => {
                    steps[last].stopped = Some(reason);
                    break;
                }
                Ok(parent_from_this) => {
                    let mut by = steps[last].by.clone();
                    by.insert(edge.topic);
                    let this_from_start = parent_from_this * steps[last].this_from_start;
                    steps.push(Step {
                        frame: &edge.parent,
                        this_from_start,
                        by,
                        stopped: None,
                    });
                }
            }
        }
        steps
    }

    fn tree(&self) -> String {
        const SHOWN: usize = 8;
        if self.edges.is_empty() {
            return format!("{} hold no transform", TOPICS.join(" and "));
        }
        let edges = self.edges.iter().take(SHOWN);
        let edges: Vec<String> = edges
            .map(|(child, edge)| format!("{} → {child}", edge.parent))
            .collect();
        let more = if self.edges.len() > SHOWN { ", …" } else { "" };
        format!("{} have only {}{more}", TOPICS.join(" and "), edges.join(", "))
    }
}

struct Step<'a> {
    frame: &'a str,
    this_from_start: Isometry3<f64>,
    by: BTreeSet<&'static str>,
    /// Why the way does not go on from here.
    stopped: Option<String>,
}

impl Edge {
    /// Why a transform cannot be true beside the known ones: what is static has one value, what moves one at a time.
    fn contradicts(&self, child: &str, topic: &str, stamp: Nanos, pose: &Isometry3<f64>) -> Option<String> {
        let known = match self.topic == STATIC || topic == STATIC {
            true => self.at.values().next(),
            false => self.at.get(&stamp),
        }?;
        let apart = (pose.translation.vector - known.translation.vector).norm();
        let turned = known.rotation.angle_to(&pose.rotation);
        let same = apart <= SAME[0] && turned <= SAME[1];
        let place = |p: &Isometry3<f64>| {
            let [x, y, z] = p.translation.vector.into();
            format!("({x:.3}, {y:.3}, {z:.3}) m")
        };
        (!same).then(|| {
            format!(
                "`{}` → `{child}` has two values, {} on {} and {} on {topic}, {apart:.3} m and {:.2}° apart; two publishers tell \
                 it: leave one of them in the log",
                self.parent,
                place(known),
                self.topic,
                place(pose),
                turned.to_degrees()
            )
        })
    }

    fn pose(&self, child: &str, stamp: Nanos) -> Result<Isometry3<f64>, String> {
        if let Some(other) = &self.other {
            return Err(format!("`{child}` has two parents, `{}` and `{other}`", self.parent));
        }
        if let Some(reason) = &self.contradiction {
            return Err(reason.clone());
        }
        let before = self.at.range(..=stamp).next_back();
        let after = self.at.range(stamp..).next();
        match (before, after) {
            (Some((_, only)), _) | (_, Some((_, only))) if self.topic == STATIC => Ok(*only),
            (Some((t0, a)), Some((t1, b))) if t1 > t0 => {
                let part = (stamp - t0) as f64 / (t1 - t0) as f64;
                // Opposite headings have no middle.
                Ok(a.try_lerp_slerp(b, part, 1e-9)
                    .unwrap_or(if part < 0.5 { *a } else { *b }))
            }
            (Some((at, near)), _) | (_, Some((at, near))) if stamp.abs_diff(*at) <= REACH as u64 => Ok(*near),
            (Some((at, _)), _) | (_, Some((at, _))) => Err(format!(
                "the transform of `{child}` on {} nearest to {:.3} s is of {:.3} s",
                self.topic,
                to_seconds(stamp),
                to_seconds(*at)
            )),
            (None, None) => Err(format!("`{child}` has no transform")),
        }
    }
}

/// ROS 1 begins names with a slash.
pub(crate) fn bare(frame: &str) -> &str {
    frame.strip_prefix('/').unwrap_or(frame)
}

#[cfg(test)]
mod tests {
    use nalgebra::{Point3, Translation3, UnitQuaternion, Vector3};

    use super::*;

    const SECOND: Nanos = 1_000_000_000;

    fn pose(x: f64, yaw: f64) -> Isometry3<f64> {
        Isometry3::from_parts(
            Translation3::new(x, 0.0, 0.0),
            UnitQuaternion::from_euler_angles(0.0, 0.0, yaw),
        )
    }

    /// map → base → lidar, base → body; base moves by 10 m/s.
    fn frames() -> Frames {
        let mut frames = Frames::default();
        frames.add("/tf_static", 5, "base", "lidar", pose(1.0, std::f64::consts::FRAC_PI_2));
        frames.add("/tf_static", 5, "base", "body", pose(-2.0, 0.0));
        for second in 0..3 {
            frames.add("/tf", second * SECOND, "map", "base", pose(10.0 * second as f64, 0.0));
        }
        frames
    }

    #[test]
    fn goes_up_to_the_common_frame_and_down_again() {
        let way = frames().way("body", "lidar", 100 * SECOND).unwrap();
        assert_eq!(way.by, BTreeSet::from(["/tf_static"]));
        let point = way.to_from_from * Point3::new(1.0, 0.0, 0.0);
        assert!((point.coords - Vector3::new(3.0, 1.0, 0.0)).norm() < 1e-12, "{point}");
        let back = frames().way("lidar", "body", 0).unwrap().to_from_from * point;
        assert!((back.coords - Vector3::x()).norm() < 1e-12, "{back}");
        let same = frames().way("body", "body", 0).unwrap();
        assert_eq!((same.to_from_from, same.by.len()), (Isometry3::identity(), 0));
    }

    #[test]
    fn moving_frames_are_interpolated_and_reach_a_tenth_of_a_second() {
        let x = |stamp: Nanos| {
            let way = frames()
                .way("map", "lidar", stamp)
                .map(|way| (way.to_from_from.translation.x, way.by.len()));
            way.map(|(x, topics)| ((x * 1e6).round() / 1e6, topics))
        };
        assert_eq!(x(SECOND / 4), Ok((3.5, 2)));
        assert_eq!(x(SECOND), Ok((11.0, 2)));
        assert_eq!(x(2 * SECOND + REACH), Ok((21.0, 2)));
        assert_eq!(x(-REACH), Ok((1.0, 2)));
        for stamp in [2 * SECOND + REACH + 1, -REACH - 1] {
            let error = x(stamp).unwrap_err();
            assert!(error.contains("transform of `base` on /tf nearest to"), "{error}");
        }
        assert!(x(Nanos::MIN).is_err() && x(Nanos::MAX).is_err());
    }

    #[test]
    fn a_transform_of_two_values_is_refused_and_the_same_twice_is_fine() {
        let mut twice = frames();
        let quarter = std::f64::consts::FRAC_PI_2;
        twice.add("/tf_static", 9, "base", "lidar", pose(1.0, quarter + 1e-9));
        twice.add("/tf", SECOND, "map", "base", pose(10.0, 0.0));
        let way = twice.way("map", "lidar", SECOND).unwrap();
        assert!((way.to_from_from.translation.vector - Vector3::new(11.0, 0.0, 0.0)).norm() < 1e-9);
        for (topic, stamp, parent, child, x) in [
            ("/tf_static", 9, "base", "lidar", 3.0),
            ("/tf", 9, "base", "lidar", 3.0),
            ("/tf", SECOND, "map", "base", 11.0),
        ] {
            let mut two = frames();
            two.add(topic, stamp, parent, child, pose(x, 0.0));
            let error = two.way("map", "lidar", SECOND).unwrap_err();
            let names = format!("`{parent}` → `{child}` has two values");
            assert!(error.contains(&names) && error.contains("leave one"), "{error}");
        }
    }

    #[test]
    fn says_where_the_tree_does_not_lead() {
        let error = frames().way("rsu1/body", "lidar", 0).unwrap_err();
        assert!(
            error.contains("have only map → base, base → body, base → lidar"),
            "{error}"
        );
        let error = Frames::default().way("body", "lidar", 0).unwrap_err();
        assert_eq!(error, "/tf_static and /tf hold no transform");
        let mut two = frames();
        two.add("/tf", 0, "map", "lidar", pose(0.0, 0.0));
        let error = two.way("body", "lidar", 0).unwrap_err();
        assert_eq!(error, "`lidar` has two parents, `base` and `map`");
        let mut ring = Frames::default();
        ring.add("/tf_static", 0, "a", "b", pose(1.0, 0.0));
        ring.add("/tf_static", 0, "b", "a", pose(1.0, 0.0));
        assert!(ring.way("c", "a", 0).is_err());
    }
}
