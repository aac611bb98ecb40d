//! The objects of an agent at its sweeps.

use std::collections::BTreeMap;

use nalgebra::Isometry3;
use realo_bags::map_file::{MapFile, way};
use realo_bags::messages::{Object, Objects};
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
    /// Rising: stamp, log time, objects.
    frames: Vec<(Nanos, Nanos, Vec<Placed>)>,
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
}

impl Timeline {
    /// Brings the objects of all messages to the world.
    pub fn new(
        messages: Vec<At<Objects>>,
        topic: &str,
        agent: &Agent,
        map: &MapFile,
        frames: &Frames,
        track: &Track,
        faults: &mut Counted,
    ) -> Self {
        let mut placed: Vec<(Nanos, Nanos, Vec<Placed>)> = Vec::new();
        for At { log_time, said } in messages {
            let mut objects = Vec::new();
            for object in said.objects {
                match world_from(&object.frame, said.stamp, agent, map, frames, track) {
                    Ok(world_from_frame) => objects.push(Placed {
                        world_from_object: world_from_frame * object.frame_from_object,
                        object,
                    }),
                    Err(reason) => faults.add(topic, reason),
                }
            }
            placed.push((said.stamp, log_time, objects));
        }
        placed.sort_by_key(|(stamp, ..)| *stamp);
        placed.dedup_by_key(|(stamp, ..)| *stamp);
        Timeline { frames: placed }
    }

    /// The objects at a stamp; `bridge`: those of a track are interpolated. `None` where no message is near.
    pub fn at(&self, stamp: Nanos, bridge: bool, world_from_body: &Isometry3<f64>, map: &MapFile) -> Option<AtSweep> {
        let next = self.frames.partition_point(|(at, ..)| *at < stamp);
        let around = &self.frames[next.saturating_sub(1)..self.frames.len().min(next + 1)];
        let nearest = around.iter().min_by_key(|(at, ..)| (at - stamp).abs())?;
        let off = (nearest.0 - stamp).abs();
        let body_from_world = world_from_body.inverse();
        let boxed = |placed: &Placed| placed.boxed(&body_from_world, map);
        if off <= SAME {
            return Some(AtSweep {
                log_time: nearest.1,
                boxes: nearest.2.iter().map(boxed).collect(),
                is_moved: false,
            });
        }
        if bridge
            && let [(t0, _, a), (t1, log_time, b)] = around
            && (*t0..=*t1).contains(&stamp)
            && t1 - t0 <= BRIDGED
        {
            let by_track: BTreeMap<&str, &Placed> =
                b.iter().map(|placed| (placed.object.track.as_str(), placed)).collect();
            let share = to_seconds(stamp - t0) / to_seconds(t1 - t0);
            let between = |placed: &Placed| {
                let later = by_track
                    .get(placed.object.track.as_str())
                    .filter(|_| !placed.object.track.is_empty())?;
                Some(Placed {
                    world_from_object: interpolate(&placed.world_from_object, &later.world_from_object, share),
                    object: placed.object.clone(),
                })
            };
            let moved: Vec<Placed> = a.iter().filter_map(between).collect();
            // Objects without a track cannot be followed: the nearest message has them.
            if nearest.2.iter().all(|placed| !placed.object.track.is_empty()) {
                return Some(AtSweep {
                    log_time: *log_time,
                    boxes: moved.iter().map(boxed).collect(),
                    is_moved: true,
                });
            }
        }
        (off <= NEAR).then(|| AtSweep {
            log_time: nearest.1,
            boxes: nearest.2.iter().map(boxed).collect(),
            is_moved: true,
        })
    }
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
