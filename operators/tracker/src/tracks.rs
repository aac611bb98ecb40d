//! The objects of one stream of boxes.

use nalgebra::{Isometry3, Matrix2, Point3, Vector2, Vector3};
use realo_assignment::{AssignmentError, Costs, FORBIDDEN, assign};
use realo_schemas::geometry::{detection_fault, transform_box};
use realo_schemas::{Box3, Nanos, to_seconds};

use crate::Motion;
use crate::motion::{Noise, Seen};

/// What a stream's tracks may do.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Limits {
    /// How sure boxes and objects are.
    pub noise: Noise,
    /// A pair farther apart is not made, in standard deviations.
    pub gate: f64,
    /// A pair farther apart on the ground is not made, m.
    pub max_distance_m: f64,
    /// Sweeps in which a track was seen before its velocity is given.
    pub min_hits: u32,
    /// Whether centres of boxes are then those of their tracks.
    pub filter_centers: bool,
    /// A track that is not seen for longer ends, ns.
    pub max_gap: Nanos,
    /// A track that is not seen is given as a box of its own for so long, ns; 0: never.
    pub coast: Nanos,
    /// Tracks at the same time, and boxes of a message that may have one.
    pub max_tracks: usize,
}

/// How a message's stamp stands to the last one of its stream.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Order {
    /// Later, by no more than a gap that tracks survive; or the first.
    Next,
    /// Later than tracks survive: all of them have ended.
    Gap,
    /// The same again.
    Repeated,
    /// Earlier.
    Late,
    /// So much earlier that a clock was set back: all tracks have ended.
    Restart,
}

/// What became of a message's boxes.
#[derive(Clone, Debug, PartialEq)]
pub struct Outcome {
    /// How its stamp stands to the last.
    pub order: Order,
    /// Boxes that were paired with a track.
    pub paired: u64,
    /// Boxes that began a track.
    pub begun: u64,
    /// Boxes that have no track: of numbers that no object has, or beyond `max_tracks`.
    pub untracked: u64,
    /// Boxes of tracks that were not seen.
    pub coasted: Vec<Box3>,
}

/// An object over time.
#[derive(Clone, Debug)]
struct Track {
    id: u64,
    motion: Motion,
    noise: Noise,
    /// Stamp of the last box.
    seen: Nanos,
    /// Boxes so far.
    hits: u32,
    /// The last box, in `map`.
    last: Box3,
}

/// The tracks of one stream.
#[derive(Clone, Debug, Default)]
pub struct Tracks {
    tracks: Vec<Track>,
    /// The last track's id.
    newest: u64,
    /// The last stamp.
    stamp: Option<Nanos>,
}

/// A box's length above which it moves along its heading, and is longer than wide by [`ELONGATED`], m.
const LONG_M: f64 = 2.5;
/// See [`LONG_M`].
const ELONGATED: f64 = 1.5;
/// What a short object has of the speed and the changes of speed of a long one: people walk.
const SHORT: f64 = 0.25;
/// Boxes of different classes are of one object if the longer is no longer than so many times the other.
const ALIKE: f64 = 2.0;

impl Tracks {
    /// Gives the boxes of a message identities and velocities. They are in a frame whose pose in `map` is given; on the way out
    /// velocities are too.
    ///
    /// Boxes of a repeated or late message stay as they are.
    ///
    /// # Errors
    /// [`AssignmentError`] if `max_tracks` is more than an assignment takes.
    pub fn follow(
        &mut self,
        stamp: Nanos,
        map_from_frame: &Isometry3<f64>,
        boxes: &mut [Box3],
        limits: &Limits,
    ) -> Result<Outcome, AssignmentError> {
        let order = self.order(stamp, limits.max_gap);
        let mut outcome = Outcome {
            order,
            paired: 0,
            begun: 0,
            untracked: 0,
            coasted: Vec::new(),
        };
        if matches!(order, Order::Repeated | Order::Late) {
            return Ok(outcome);
        }
        let since = self.stamp.replace(stamp).map_or(0, |last| stamp.saturating_sub(last));
        if matches!(order, Order::Gap | Order::Restart) {
            self.tracks.clear();
        }
        self.tracks.retain(|track| stamp - track.seen <= limits.max_gap);
        for track in &mut self.tracks {
            track.motion.predict(to_seconds(since), &track.noise);
        }
        let candidates = candidates(map_from_frame, boxes, limits);
        outcome.untracked = (boxes.len() - candidates.len()) as u64;
        for object in boxes.iter_mut() {
            object.track = None;
        }
        let pairs = self.pairs(&candidates, limits)?;
        let mut is_paired = vec![false; candidates.len()];
        for (track, place) in pairs {
            let candidate = &candidates[place];
            is_paired[place] = true;
            self.tracks[track].take(stamp, candidate);
            self.tracks[track].describe(map_from_frame, &mut boxes[candidate.index], limits);
            outcome.paired += 1;
        }
        outcome.coasted = self.coasted(stamp, map_from_frame, limits);
        for candidate in candidates
            .iter()
            .zip(is_paired)
            .filter(|(_, paired)| !paired)
            .map(|(one, _)| one)
        {
            if self.tracks.len() >= limits.max_tracks {
                outcome.untracked += 1;
                continue;
            }
            let track = self.begin(stamp, candidate, limits);
            track.describe(map_from_frame, &mut boxes[candidate.index], limits);
            outcome.begun += 1;
        }
        Ok(outcome)
    }

    /// Number of tracks.
    pub fn len(&self) -> usize {
        self.tracks.len()
    }

    /// Whether there is no track.
    pub fn is_empty(&self) -> bool {
        self.tracks.is_empty()
    }

    fn order(&self, stamp: Nanos, max_gap: Nanos) -> Order {
        let Some(last) = self.stamp else { return Order::Next };
        match stamp.saturating_sub(last) {
            0 => Order::Repeated,
            later if later > max_gap => Order::Gap,
            later if later > 0 => Order::Next,
            earlier if earlier >= -max_gap => Order::Late,
            _ => Order::Restart,
        }
    }

    /// Pairs of (track, candidate).
    fn pairs(&self, candidates: &[Candidate], limits: &Limits) -> Result<Vec<(usize, usize)>, AssignmentError> {
        let cost = |track: usize, place: usize| {
            let (track, candidate) = (&self.tracks[track], &candidates[place]);
            if !track.is_like(&candidate.object) {
                return FORBIDDEN;
            }
            let [metres, deviations] = track.motion.distance(&candidate.seen);
            match metres < limits.max_distance_m && deviations <= limits.gate {
                true => metres,
                false => FORBIDDEN,
            }
        };
        let costs = Costs::of(self.tracks.len(), candidates.len(), cost)?;
        assign(&costs, limits.max_distance_m)
    }

    fn begin(&mut self, stamp: Nanos, candidate: &Candidate, limits: &Limits) -> &Track {
        self.newest += 1;
        let mut noise = limits.noise;
        if candidate.seen.heading.is_none() {
            noise.speed_mps *= SHORT;
            noise.acceleration_mps *= SHORT;
        }
        self.tracks.push(Track {
            id: self.newest,
            motion: Motion::of(&candidate.seen, &noise),
            noise,
            seen: stamp,
            hits: 1,
            last: candidate.object.clone(),
        });
        &self.tracks[self.tracks.len() - 1]
    }

    /// Boxes of tracks that were not seen at this stamp, where they should be by now; the surer the shorter ago they were seen.
    fn coasted(&self, stamp: Nanos, map_from_frame: &Isometry3<f64>, limits: &Limits) -> Vec<Box3> {
        let frame_from_map = map_from_frame.inverse();
        let unseen = self.tracks.iter().filter(|track| {
            let ago = stamp - track.seen;
            ago > 0 && ago <= limits.coast && track.hits >= limits.min_hits
        });
        let coasted = unseen.map(|track| {
            let seconds = to_seconds(stamp - track.seen);
            let share = 1.0 - (stamp - track.seen) as f64 / (limits.coast as f64 + 1.0);
            let (position, mut there) = (track.motion.position(), track.last.clone());
            there.center = [position.x, position.y, there.center[2]];
            there.yaw += track.motion.turn_rate() * seconds;
            there.score = (f64::from(there.score) * share) as f32;
            let mut object = transform_box(&frame_from_map, &there);
            track.describe(map_from_frame, &mut object, limits);
            object
        });
        coasted.collect()
    }
}

impl Track {
    /// Whether a box may be of its object.
    fn is_like(&self, object: &Box3) -> bool {
        let [shorter, longer] = match self.last.length < object.length {
            true => [self.last.length, object.length],
            false => [object.length, self.last.length],
        };
        self.last.class == object.class || longer <= ALIKE * shorter
    }

    fn take(&mut self, stamp: Nanos, candidate: &Candidate) {
        self.motion.correct(&candidate.seen, &self.noise);
        self.seen = stamp;
        self.hits = self.hits.saturating_add(1);
        self.last = candidate.object.clone();
    }

    /// Says in a box, in a frame whose pose is given, whose it is and how it moves.
    fn describe(&self, map_from_frame: &Isometry3<f64>, object: &mut Box3, limits: &Limits) {
        object.track = Some(self.id);
        if self.hits < limits.min_hits {
            return;
        }
        let (position, velocity) = (self.motion.position(), self.motion.velocity());
        let in_map = Vector3::new(velocity.x, velocity.y, 0.0);
        object.velocity = Some((map_from_frame.rotation.inverse() * in_map).into());
        if limits.filter_centers {
            let in_map = Point3::new(position.x, position.y, self.last.center[2]);
            object.center = map_from_frame.inverse_transform_point(&in_map).into();
        }
    }
}

/// A box that may have a track.
struct Candidate {
    /// Its place among the message's boxes.
    index: usize,
    /// The box in `map`.
    object: Box3,
    seen: Seen,
}

/// The best boxes that an object can have, in their order.
fn candidates(map_from_frame: &Isometry3<f64>, boxes: &[Box3], limits: &Limits) -> Vec<Candidate> {
    let mut sound: Vec<usize> = (0..boxes.len())
        .filter(|index| detection_fault(&boxes[*index]).is_none())
        .collect();
    if sound.len() > limits.max_tracks {
        sound.sort_by(|a, b| boxes[*b].score.total_cmp(&boxes[*a].score));
        sound.truncate(limits.max_tracks);
        sound.sort_unstable();
    }
    let candidate = |index: usize| {
        let object = transform_box(map_from_frame, &boxes[index]);
        let is_long = object.length > LONG_M && object.length > ELONGATED * object.width;
        let seen = Seen {
            center: Vector2::new(object.center[0], object.center[1]),
            covariance: covariance_of(&object, &limits.noise),
            heading: is_long.then_some(object.yaw),
            velocity: object.velocity.map(|[x, y, _]| Vector2::new(x, y)),
        };
        Candidate { index, object, seen }
    };
    sound.into_iter().map(candidate).collect()
}

/// Covariance of a box's centre: its own where it says one that can be, else that of the filter's noise.
fn covariance_of(object: &Box3, noise: &Noise) -> Matrix2<f64> {
    let usual = Matrix2::identity() * (noise.position_m * noise.position_m);
    let Some(own) = object.covariance else { return usual };
    let own = Matrix2::new(own[0], own[1], own[1], own[4]);
    // A detector that is sure to the millimetre is not believed, nor one that knows nothing to more than 100 m.
    let floor = Matrix2::identity() * 1e-4;
    let is_covariance = own[(0, 0)] >= 0.0 && own[(1, 1)] >= 0.0 && own.determinant() >= 0.0 && own.trace() < 1e4;
    if is_covariance { own + floor } else { usual }
}

#[cfg(test)]
mod tests;
