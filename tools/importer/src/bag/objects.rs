//! The objects of an agent at its sweeps.

use std::collections::BTreeMap;

use nalgebra::Isometry3;
use realo_bags::map_file::{MapFile, way};
use realo_bags::messages::{Object, Objects, TEXT};
use realo_logs::{Frames, bare, track_of};
use realo_schemas::geometry::{interpolate, yaw_of};
use realo_schemas::{Box3, Nanos, to_seconds};

use super::Counted;
use super::agents::Agent;
use super::small::At;
use super::track::Track;

/// Objects of a message are those of a sweep so near to it, ns.
const SAME: Nanos = 1_000_000;
/// Objects of no track are those of a sweep so near to it, ns.
const NEAR: Nanos = 50_000_000;
/// Objects of a track are interpolated over at most so long, ns.
const BRIDGED: Nanos = 350_000_000;

/// Objects in the world, by stamp.
pub struct Timeline {
    /// Rising by stamp.
    frames: Vec<Frame>,
    /// What is strange about their ids, in words.
    pub note: Option<String>,
}

/// All that was said of a stamp, in one message or several.
struct Frame {
    stamp: Nanos,
    /// Of the last message.
    log_time: Nanos,
    objects: Vec<Placed>,
    /// Whether all that was said could be placed and is boxes.
    is_whole: bool,
    /// Whether something was said that is no box and no text.
    has_others: bool,
    /// Classes of objects by their tracks.
    tracks: BTreeMap<String, String>,
}

#[derive(Clone)]
struct Placed {
    object: Object,
    world_from_object: Isometry3<f64>,
}

/// Objects at a sweep.
pub struct AtSweep {
    /// When they were recorded.
    pub log_time: Nanos,
    /// In the body frame.
    pub boxes: Vec<Box3>,
    /// Whether they are not of the sweep's own time, and were brought there.
    pub is_moved: bool,
    /// Whether all that was said of that time could be placed and is boxes.
    pub is_whole: bool,
}

/// Objects of one stamp that share an id.
#[derive(Default)]
struct Shared {
    /// Said in an earlier message too.
    doubled: usize,
    /// Of one class.
    of_class: usize,
    /// Of several classes.
    of_classes: usize,
}

impl Frame {
    fn new(stamp: Nanos, log_time: Nanos) -> Self {
        Frame {
            stamp,
            log_time,
            objects: Vec::new(),
            is_whole: true,
            has_others: false,
            tracks: BTreeMap::new(),
        }
    }

    /// Takes an object of a message; `earlier`: so many objects are of earlier ones.
    fn take(&mut self, placed: Placed, earlier: usize, shared: &mut Shared) {
        if self.objects[..earlier].iter().any(|other| other.is(&placed)) {
            shared.doubled += 1;
            return;
        }
        let Object { class, track, .. } = &placed.object;
        if !track.is_empty() {
            match self.tracks.insert(track.clone(), class.clone()) {
                Some(other) if other == *class => shared.of_class += 1,
                Some(_) => shared.of_classes += 1,
                None => {}
            }
        }
        self.objects.push(placed);
    }
}

impl Timeline {
    /// Brings the objects of all messages to the world. Messages of one stamp are one.
    pub fn new(
        messages: Vec<At<Objects>>,
        topic: &str,
        agent: &Agent,
        map: &MapFile,
        frames: &Frames,
        track: &Track,
        faults: &mut Counted,
    ) -> Self {
        let (mut by_stamp, mut shared) = (BTreeMap::<Nanos, Frame>::new(), Shared::default());
        for At { log_time, said } in messages {
            let frame = by_stamp.entry(said.stamp);
            let frame = frame.or_insert_with(|| Frame::new(said.stamp, log_time));
            frame.log_time = frame.log_time.max(log_time);
            let is_label = |name: &str| name == TEXT && !said.objects.is_empty();
            for (name, count) in said.others.into_iter().filter(|(name, _)| !is_label(name)) {
                let reason = format!("markers of the type {name}, which are no boxes: expected CUBE");
                faults.add_many(topic, reason, count);
                frame.has_others |= name != TEXT;
            }
            let earlier = frame.objects.len();
            for object in said.objects {
                match world_from(&object.frame, said.stamp, agent, map, frames, track) {
                    Ok(world_from_frame) => {
                        let placed = Placed {
                            world_from_object: world_from_frame * object.frame_from_object,
                            object,
                        };
                        frame.take(placed, earlier, &mut shared);
                    }
                    Err(reason) => {
                        frame.is_whole = false;
                        faults.add(topic, reason);
                    }
                }
            }
        }
        let said_twice = "objects that an earlier message of the same stamp has, too".to_string();
        faults.add_many(topic, said_twice, shared.doubled);
        Timeline::of(by_stamp, topic, &shared)
    }

    fn of(by_stamp: BTreeMap<Nanos, Frame>, topic: &str, shared: &Shared) -> Self {
        let mut frames: Vec<Frame> = by_stamp.into_values().collect();
        for frame in &mut frames {
            frame.is_whole &= !(frame.objects.is_empty() && frame.has_others);
        }
        if shared.of_classes > 0 {
            let objects = frames.iter_mut().flat_map(|frame| &mut frame.objects);
            for Object { class, track, .. } in objects.map(|placed| &mut placed.object) {
                if !track.is_empty() {
                    *track = format!("{class}/{track}");
                }
            }
        }
        let note = match (shared.of_class, shared.of_classes) {
            (0, 0) => None,
            (0, n) => Some(format!(
                "`{topic}`: {n} objects have the id of an object of another class at the same stamp: ids count for each class alone"
            )),
            (n, _) => Some(format!(
                "`{topic}`: {n} objects have the id of another object of their class at the same stamp: both stay, and tracks mix them up; \
                 give each object an id of its own"
            )),
        };
        Timeline { frames, note }
    }

    /// The objects at a stamp; `bridge`: those of a track are interpolated. `None` where no message is near.
    pub fn at(&self, stamp: Nanos, bridge: bool, world_from_body: &Isometry3<f64>, map: &MapFile) -> Option<AtSweep> {
        let next = self.frames.partition_point(|frame| frame.stamp < stamp);
        let around = &self.frames[next.saturating_sub(1)..self.frames.len().min(next + 1)];
        let nearest = around.iter().min_by_key(|frame| (frame.stamp - stamp).abs())?;
        let off = (nearest.stamp - stamp).abs();
        let body_from_world = world_from_body.inverse();
        let boxed = |placed: &Placed| placed.boxed(&body_from_world, map);
        let of_nearest = |is_moved| AtSweep {
            log_time: nearest.log_time,
            boxes: nearest.objects.iter().map(boxed).collect(),
            is_moved,
            is_whole: nearest.is_whole,
        };
        if off <= SAME {
            return Some(of_nearest(false));
        }
        if bridge
            && let [before, after] = around
            && (before.stamp..=after.stamp).contains(&stamp)
            && after.stamp - before.stamp <= BRIDGED
            // Objects without a track cannot be followed: the nearest message has them.
            && nearest.objects.iter().all(|placed| !placed.object.track.is_empty())
        {
            return Some(AtSweep {
                log_time: after.log_time,
                boxes: between(before, after, stamp).iter().map(boxed).collect(),
                is_moved: true,
                is_whole: before.is_whole && after.is_whole,
            });
        }
        (off <= NEAR).then(|| of_nearest(true))
    }
}

/// The objects of a track in both frames, at a time between.
fn between(before: &Frame, after: &Frame, stamp: Nanos) -> Vec<Placed> {
    let later = after.objects.iter();
    let by_track: BTreeMap<&str, &Placed> = later.map(|placed| (placed.object.track.as_str(), placed)).collect();
    let share = to_seconds(stamp - before.stamp) / to_seconds(after.stamp - before.stamp);
    let moved = |placed: &Placed| {
        let later = by_track
            .get(placed.object.track.as_str())
            .filter(|_| !placed.object.track.is_empty())?;
        Some(Placed {
            world_from_object: interpolate(&placed.world_from_object, &later.world_from_object, share),
            object: placed.object.clone(),
        })
    };
    before.objects.iter().filter_map(moved).collect()
}

/// World from a frame of objects.
fn world_from(
    frame: &str,
    stamp: Nanos,
    agent: &Agent,
    map: &MapFile,
    frames: &Frames,
    track: &Track,
) -> Result<Isometry3<f64>, String> {
    let (frame, world, own) = (bare(frame), bare(&map.world), bare(&agent.map.frame));
    if frame == world {
        return Ok(Isometry3::identity());
    }
    let own_from_frame = match frame == own {
        true => Some(Isometry3::identity()),
        false => agent
            .map
            .mounted()
            .find(|(known, _)| bare(known) == frame)
            .map(|(_, pose)| pose)
            .or_else(|| way(frames, own, frame, stamp).ok()),
    };
    match own_from_frame {
        Some(own_from_frame) => {
            let world_from_own = track.at(stamp).ok_or("objects at times without a pose")?;
            Ok(world_from_own * own_from_frame)
        }
        None => way(frames, world, frame, stamp)
            .map_err(|reason| format!("objects are in `{frame}`, and nothing leads to `{world}` or `{own}`: {reason}")),
    }
}

impl Placed {
    /// Whether it is the same object at the same place.
    fn is(&self, other: &Placed) -> bool {
        let (ours, theirs) = (&self.object, &other.object);
        let [a, b] = [self, other].map(|placed| &placed.world_from_object);
        (&ours.class, &ours.track, ours.size) == (&theirs.class, &theirs.track, theirs.size)
            && (a.translation.vector - b.translation.vector).norm() < 1e-6
            && a.rotation.angle_to(&b.rotation) < 1e-6
    }

    fn boxed(&self, body_from_world: &Isometry3<f64>, map: &MapFile) -> Box3 {
        let pose = body_from_world * self.world_from_object;
        let class = map.classes.get(&self.object.class).unwrap_or(&self.object.class);
        let mut boxed = Box3::new(
            class.as_str(),
            pose.translation.vector.into(),
            self.object.size,
            yaw_of(&pose.rotation),
        );
        boxed.track = track_of(&self.object.track);
        boxed.score = self.object.score as f32;
        boxed
    }
}
