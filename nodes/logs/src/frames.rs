//! The tree of frames that `/tf_static` and `/tf` of a log span.

use std::collections::{BTreeMap, BTreeSet};

use nalgebra::Isometry3;
use realo_schemas::geometry::interpolate;
use realo_schemas::{Nanos, is_same_stamp, to_seconds};

use crate::pose::decode_transforms;
use crate::words::millis;
use crate::{LogError, MAX_GAP, McapFile, Schema};

/// Topics of transforms; what is on the first holds for all times.
const STATIC: &str = "/tf_static";
/// Frames that come one by one are at most this many.
const MOST_FRAMES: usize = 65_536;
pub(crate) const TOPICS: [&str; 2] = [STATIC, "/tf"];
/// Frames by their name, and how each lies in its parent.
#[derive(Debug, Default)]
pub struct Frames {
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

/// Why no way leads from a frame to another.
#[derive(Clone, Debug, PartialEq)]
pub enum NoWay {
    /// At this time no transform is near enough, in words.
    Gap(String),
    /// At no time, in words.
    Never(String),
}

/// The way from a frame to another.
#[derive(Debug, PartialEq)]
pub struct Way {
    /// Brings what lies in the one frame into the other.
    pub to_from_from: Isometry3<f64>,
    /// Topics whose transforms lead there.
    pub by: BTreeSet<&'static str>,
}

impl Frames {
    /// All transforms of a file.
    pub(crate) fn read(file: &McapFile) -> Result<Self, LogError> {
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

    /// Adds a transform, on `/tf_static` if it holds for all times. A leading `/` of a frame counts for nothing. Returns false for a frame
    /// too many, which is left out.
    pub fn insert(
        &mut self,
        is_static: bool,
        stamp: Nanos,
        parent: &str,
        child: &str,
        parent_from_child: Isometry3<f64>,
    ) -> bool {
        let child = bare(child);
        if self.edges.len() >= MOST_FRAMES && !self.edges.contains_key(child) {
            return false;
        }
        let topic = TOPICS[usize::from(!is_static)];
        self.add(topic, stamp, bare(parent), child, parent_from_child);
        true
    }

    /// Leaves out moving transforms before a time, except the last two of each frame, by which it goes on.
    pub fn forget(&mut self, before: Nanos) {
        for edge in self.edges.values_mut().filter(|edge| edge.topic != STATIC) {
            let kept = edge.at.range(..before).rev().nth(1).map(|(at, _)| *at);
            if let Some(kept) = kept {
                edge.at = edge.at.split_off(&kept);
            }
        }
    }

    /// Each frame with its parent, and whether it is fixed to it.
    pub fn parents(&self) -> impl Iterator<Item = (&str, &str, bool)> {
        self.edges
            .iter()
            .map(|(child, edge)| (child.as_str(), edge.parent.as_str(), edge.topic == STATIC))
    }

    fn add(&mut self, topic: &'static str, stamp: Nanos, parent: &str, child: &str, pose: Isometry3<f64>) {
        let new = || Edge {
            parent: parent.into(),
            topic,
            at: BTreeMap::new(),
            other: None,
            contradiction: None,
        };
        let back = self
            .edges
            .get_mut(parent)
            .filter(|back| back.parent == child && parent != child);
        let inverse = back.and_then(|back| {
            let reason = back.contradicts(parent, topic, stamp, &pose.inverse())?;
            let reason = format!("{reason}; the second is given as `{parent}` → `{child}`");
            Some(back.contradiction.get_or_insert(reason).clone())
        });
        let edge = self.edges.entry(child.into()).or_insert_with(new);
        if edge.parent != parent {
            edge.other = Some(parent.into());
            return;
        }
        if edge.contradiction.is_none() {
            edge.contradiction = inverse.or_else(|| edge.contradicts(child, topic, stamp, &pose));
        }
        // What holds for all times is kept once, however often it is said: by its earliest stamp.
        if edge.topic == STATIC {
            if edge.at.keys().next().is_some_and(|first| *first <= stamp) {
                return;
            }
            edge.at.clear();
        }
        edge.at.entry(stamp).or_insert(pose);
    }

    /// How to bring what lies in `from` into `to`, at a time.
    ///
    /// # Errors
    /// Why nothing leads there at this time, or at any.
    pub fn way(&self, to: &str, from: &str, stamp: Nanos) -> Result<Way, NoWay> {
        let (up, down) = (self.ancestors(from, stamp), self.ancestors(to, stamp));
        let common = up
            .iter()
            .find_map(|step| Some((step, down.iter().find(|other| other.frame == step.frame)?)));
        let Some((up, down)) = common else {
            let stopped = [up, down]
                .into_iter()
                .find_map(|steps| steps.into_iter().find_map(|step| step.stopped));
            return Err(stopped.unwrap_or_else(|| NoWay::Never(self.tree())));
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
    stopped: Option<NoWay>,
}

fn is_same(one: &Isometry3<f64>, other: &Isometry3<f64>) -> bool {
    let apart = (one.translation.vector - other.translation.vector).norm();
    apart <= SAME[0] && one.rotation.angle_to(&other.rotation) <= SAME[1]
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
        let place = |p: &Isometry3<f64>| {
            let [x, y, z] = p.translation.vector.into();
            format!("({x:.3}, {y:.3}, {z:.3}) m")
        };
        (!is_same(known, pose)).then(|| {
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

    /// The pose at a stamp by the rule of recorded poses: interpolated over gaps of at most [`MAX_GAP`], and carried on for as long
    /// by the last two. Between two equal transforms a frame does not move, so a gap of any length is bridged.
    fn pose(&self, child: &str, stamp: Nanos) -> Result<Isometry3<f64>, NoWay> {
        if let Some(other) = &self.other {
            let reason = format!("`{child}` has two parents, `{}` and `{other}`", self.parent);
            return Err(NoWay::Never(reason));
        }
        if let Some(reason) = &self.contradiction {
            return Err(NoWay::Never(reason.clone()));
        }
        if self.topic == STATIC {
            let only = self.at.values().next().copied();
            return only.ok_or_else(|| NoWay::Never(format!("`{child}` has no transform")));
        }
        let mut earlier = self.at.range(..=stamp).rev();
        let mut later = self.at.range(stamp..);
        let (before, after) = (earlier.next(), later.next());
        let is_here = |(at, _): &(&Nanos, &Isometry3<f64>)| is_same_stamp(**at, stamp);
        if let Some((_, here)) = before.into_iter().chain(after).find(is_here) {
            return Ok(*here);
        }
        let (from, to) = match (before, after) {
            (Some(before), Some(after)) => (Some(before), Some(after)),
            (Some(last), None) => (earlier.next(), Some(last)),
            (None, first) => (first, later.next()),
        };
        let (Some((t0, a)), Some((t1, b))) = (from, to) else {
            return Err(self.gap(child, stamp));
        };
        let step = t1.saturating_sub(*t0);
        let beyond = stamp.saturating_sub(*t1).max(t0.saturating_sub(stamp));
        let is_still = is_same(a, b);
        let bridged = match after {
            Some(_) if before.is_some() => is_still || step <= MAX_GAP,
            // What stands still goes on as its transforms came.
            _ if is_still => beyond <= MAX_GAP.max(step),
            None => step.max(beyond) <= MAX_GAP,
            Some(_) => false,
        };
        match bridged {
            true => Ok(interpolate(
                a,
                b,
                to_seconds(stamp.saturating_sub(*t0)) / to_seconds(step),
            )),
            false => Err(self.gap(child, stamp)),
        }
    }

    /// Where the transforms around a stamp are.
    fn gap(&self, child: &str, stamp: Nanos) -> NoWay {
        let before = self.at.range(..=stamp).next_back().map(|(at, _)| *at);
        let after = self.at.range(stamp..).next().map(|(at, _)| *at);
        let place = match (before, after) {
            (Some(before), Some(after)) => format!("are {} ms apart there", millis(after.saturating_sub(before))),
            (Some(last), None) => format!("end {} ms earlier", millis(stamp.saturating_sub(last))),
            (None, Some(first)) => format!("begin {} ms later", millis(first.saturating_sub(stamp))),
            (None, None) => "are missing".into(),
        };
        NoWay::Gap(format!(
            "transforms of `{child}` on {} {place}, at most {} ms are bridged",
            self.topic,
            millis(MAX_GAP)
        ))
    }
}

/// The name of a frame without the slash that ROS 1 begins it with.
pub fn bare(frame: &str) -> &str {
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

    /// map → base → lidar, base → body; base moves by 10 m/s and says so every 100 ms for 2 s, but not between 0.5 and 0.9 s.
    fn frames() -> Frames {
        let mut frames = Frames::default();
        frames.add("/tf_static", 5, "base", "lidar", pose(1.0, std::f64::consts::FRAC_PI_2));
        frames.add("/tf_static", 5, "base", "body", pose(-2.0, 0.0));
        for tenth in (0..=20).filter(|tenth| !(6..9).contains(tenth)) {
            frames.add("/tf", tenth * SECOND / 10, "map", "base", pose(tenth as f64, 0.0));
        }
        frames
    }

    #[test]
    fn what_is_said_again_and_again_takes_no_more_memory() {
        let mut frames = Frames::default();
        for second in 0..100 {
            assert!(frames.insert(true, second * SECOND, "base", "lidar", pose(1.0, 0.0)));
            // On both topics: it is static, as it was said first.
            assert!(frames.insert(false, second * SECOND + 1, "/base", "lidar", pose(1.0, 0.0)));
        }
        assert_eq!(frames.edges["lidar"].at.len(), 1);
        for number in 1..MOST_FRAMES {
            assert!(frames.insert(false, 0, "base", &format!("frame{number}"), pose(1.0, 0.0)));
        }
        assert!(!frames.insert(false, 0, "base", "one too many", pose(1.0, 0.0)));
        assert!(frames.insert(false, 1, "base", "frame7", pose(1.0, 0.0)));
        assert_eq!(frames.edges.len(), MOST_FRAMES);
    }

    fn reason(found: Result<Way, NoWay>) -> String {
        match found {
            Err(NoWay::Gap(reason) | NoWay::Never(reason)) => reason,
            Ok(way) => panic!("{way:?}"),
        }
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
    fn moving_frames_are_interpolated_and_carried_on_over_the_gaps_of_poses() {
        let x = |stamp: Nanos| {
            let way = frames()
                .way("map", "lidar", stamp)
                .map(|way| (way.to_from_from.translation.x, way.by.len()));
            way.map(|(x, topics)| ((x * 1e6).round() / 1e6, topics))
        };
        assert_eq!(x(SECOND / 4), Ok((3.5, 2)));
        assert_eq!(x(SECOND), Ok((11.0, 2)));
        assert_eq!(x(SECOND / 2 + 500), Ok((6.0, 2)), "a stamp that was rounded");
        assert_eq!(x(2 * SECOND + MAX_GAP), Ok((22.5, 2)), "it goes on as it moved");
        for (stamp, words) in [
            (7 * SECOND / 10, "transforms of `base` on /tf are 400 ms apart there"),
            (
                2 * SECOND + 2 * MAX_GAP,
                "end 300 ms earlier, at most 150 ms are bridged",
            ),
            (-SECOND / 100, "begin 10 ms later"),
        ] {
            match x(stamp) {
                Err(NoWay::Gap(reason)) => assert!(reason.contains(words), "{reason}"),
                other => panic!("{stamp}: {other:?}"),
            }
        }
        assert!(x(Nanos::MIN).is_err() && x(Nanos::MAX).is_err());
    }

    #[test]
    fn what_is_forgotten_does_not_change_what_comes_later() {
        let mut short = frames();
        short.forget(3 * SECOND / 2);
        let kept: Vec<Nanos> = short.edges["base"].at.keys().map(|at| at * 10 / SECOND).collect();
        assert_eq!(kept, [13, 14, 15, 16, 17, 18, 19, 20]);
        for stamp in [3 * SECOND / 2, 2 * SECOND + MAX_GAP] {
            assert_eq!(short.way("map", "lidar", stamp), frames().way("map", "lidar", stamp));
        }
        assert!(short.way("map", "lidar", SECOND).is_err());
        short.forget(Nanos::MAX);
        assert_eq!(short.edges["base"].at.len(), 2);
        assert!(short.way("base", "lidar", 0).is_ok(), "what is static stays");
    }

    #[test]
    fn a_frame_that_does_not_move_is_there_between_its_transforms() {
        let mut mount = Frames::default();
        for second in [1, 2] {
            mount.add("/tf", second * SECOND, "body", "lidar", pose(1.0, 0.0));
        }
        let is_known = |tenths: Nanos| mount.way("body", "lidar", tenths * SECOND / 10).is_ok();
        assert_eq!(
            [-1, 0, 5, 15, 25, 30, 31].map(is_known),
            [false, true, true, true, true, true, false]
        );
        let mut once = Frames::default();
        once.add("/tf", SECOND, "body", "lidar", pose(1.0, 0.0));
        assert!(once.way("body", "lidar", SECOND).is_ok() && once.way("body", "lidar", SECOND + 2_000).is_err());
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
            let error = reason(two.way("map", "lidar", SECOND));
            let names = format!("`{parent}` → `{child}` has two values");
            assert!(error.contains(&names) && error.contains("leave one"), "{error}");
        }
    }

    #[test]
    fn a_transform_and_its_inverse_have_one_value() {
        let way = |x: f64| {
            let mut both = Frames::default();
            both.add("/tf_static", 0, "body", "lidar", pose(1.0, 0.5));
            let back = pose(1.0, 0.5).inverse() * pose(x, 0.0);
            both.add("/tf_static", 1, "lidar", "body", back);
            both.way("body", "lidar", 0)
        };
        assert!(way(0.0).is_ok());
        let error = reason(way(1.0));
        for part in [
            "`body` → `lidar` has two values",
            "1.000 m and 0.00° apart",
            "given as `lidar` → `body`",
        ] {
            assert!(error.contains(part), "no `{part}` in {error}");
        }
    }

    #[test]
    fn says_where_the_tree_does_not_lead() {
        let error = reason(frames().way("rsu1/body", "lidar", 0));
        assert!(
            error.contains("have only map → base, base → body, base → lidar"),
            "{error}"
        );
        let error = reason(Frames::default().way("body", "lidar", 0));
        assert_eq!(error, "/tf_static and /tf hold no transform");
        let mut two = frames();
        two.add("/tf", 0, "map", "lidar", pose(0.0, 0.0));
        let error = reason(two.way("body", "lidar", 0));
        assert_eq!(error, "`lidar` has two parents, `base` and `map`");
        let mut ring = Frames::default();
        ring.add("/tf_static", 0, "a", "b", pose(1.0, 0.0));
        ring.add("/tf_static", 0, "b", "a", pose(1.0, 0.0));
        assert!(ring.way("c", "a", 0).is_err());
    }
}
