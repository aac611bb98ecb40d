//! How well identities and velocities are known, of scenes whose detections have identities.

use std::collections::BTreeMap;

use realo_schemas::Box3;
use realo_schemas::geometry::{Footprint, iou};
use serde::{Deserialize, Serialize};

use crate::hota::{Hota, THRESHOLDS, Tallies, Tally, TrackedFrame, add, tallies};
use crate::{Evaluation, Frame, Protocol, Scene};

/// Identity and velocity of a detection or an object: `[identity | null, [vx, vy] | null]` in files, mm/s in the ego's body frame.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(from = "IdentityRow", into = "IdentityRow")]
pub struct Identity {
    /// Identity over time.
    pub track: Option<u64>,
    /// Velocity along x and y, mm/s; what is too large for a number takes the largest one.
    pub velocity: Option<[i32; 2]>,
}

type IdentityRow = (Option<u64>, Option<[i32; 2]>);

impl From<IdentityRow> for Identity {
    fn from((track, velocity): IdentityRow) -> Self {
        Identity { track, velocity }
    }
}

impl From<Identity> for IdentityRow {
    fn from(Identity { track, velocity }: Identity) -> Self {
        (track, velocity)
    }
}

impl Identity {
    /// Of a box.
    pub fn of(object: &Box3) -> Self {
        let known = object
            .velocity
            .filter(|velocity| velocity.iter().all(|along| along.is_finite()));
        Identity {
            track: object.track,
            // A cast saturates.
            velocity: known.map(|[x, y, _]| [x, y].map(|along| (1000.0 * along).round() as i32)),
        }
    }
}

/// Identities of the detections and objects of a frame, in their order.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Identities {
    /// Of the detections.
    pub detections: Vec<Identity>,
    /// Of the objects.
    pub truths: Vec<Identity>,
}

/// How well the identities and velocities of a class are known.
///
/// HOTA and its parts are those of TrackEval (Luiten et al. 2021): means over overlaps of 0.05 to 0.95, of all scenes together. The
/// overlap is the rotated IoU on the ground plane. A detection or object without identity has one of its own.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct TrackScores {
    /// Higher order tracking accuracy, at the best of the min scores.
    #[serde(rename = "HOTA")]
    pub hota: f64,
    /// Detection accuracy.
    #[serde(rename = "DetA")]
    pub detection: f64,
    /// Association accuracy.
    #[serde(rename = "AssA")]
    pub association: f64,
    /// Localization accuracy.
    #[serde(rename = "LocA")]
    pub localization: f64,
    /// Detections of lower scores are left out: of 0, 0.1, … 0.9 the one of the best HOTA, of equal ones the lowest.
    pub min_score: f64,
    /// Mean size of the error of the velocity of detections on objects, m/s; `None` where no pair has both velocities.
    pub velocity_error: Option<f64>,
    /// The same of objects that move at 1 m/s or more.
    pub velocity_error_moving: Option<f64>,
    /// Pairs of detection and object, overlapping by the protocol's smallest IoU, whose velocities are both known.
    pub velocities: u64,
    /// Those of them that move.
    pub velocities_moving: u64,
    /// Times that an object is found under another identity than the last time, by pairs that overlap as above; unknown of results of
    /// an earlier version.
    #[serde(default)]
    pub identity_changes: Option<u64>,
    /// Those of them to an identity under which another object was found last: tracks that swap.
    #[serde(default)]
    pub identity_swaps: Option<u64>,
}

/// The scores of identities by class; `None` where no scene has detections and objects with identities.
pub(crate) fn tracking(evaluation: &Evaluation) -> Option<BTreeMap<String, TrackScores>> {
    let known = |identities: &[Identity]| identities.iter().any(|identity| identity.track.is_some());
    let is_tracked = |scene: &&Scene| {
        let mut all = scene.frames.iter().filter_map(|frame| frame.identities.as_ref());
        let truths = all.clone().any(|identities| known(&identities.truths));
        truths && all.any(|identities| known(&identities.detections))
    };
    let scenes: Vec<&Scene> = evaluation.scenes.iter().filter(is_tracked).collect();
    if scenes.is_empty() {
        return None;
    }
    let protocol = &evaluation.protocol;
    let of_class = |class: usize| {
        let all = (0..MIN_SCORES).map(|tenths| at_min_score(&scenes, protocol, class as u8, f64::from(tenths) / 10.0));
        // The first of equals, as `max_by` would give the last.
        let best = all.reduce(|best, other| if other.hota > best.hota { other } else { best });
        best.unwrap_or_default()
    };
    let classes = protocol.classes.iter().enumerate();
    Some(
        classes
            .map(|(number, class)| (class.name.clone(), of_class(number)))
            .collect(),
    )
}

/// Min scores that are tried.
const MIN_SCORES: u8 = 10;
/// What is slower stands, m/s.
const MOVES_MPS: f64 = 1.0;

fn at_min_score(scenes: &[&Scene], protocol: &Protocol, class: u8, min_score: f64) -> TrackScores {
    let mut sum: Tallies = [Tally::default(); THRESHOLDS];
    let mut velocities = Velocities::default();
    let (mut changes, mut swaps) = (0, 0);
    let overlapping = protocol.ious.iter().copied().fold(1.0, f64::min);
    for scene in scenes {
        let frames: Vec<(&Frame, Places)> = scene
            .frames
            .iter()
            .filter(|frame| frame.key)
            .map(|frame| (frame, Places::of(frame, class, min_score)))
            .collect();
        let mut numbers = Numbers::default();
        let tracked: Vec<TrackedFrame> = frames
            .iter()
            .map(|(frame, places)| numbers.frame(frame, places))
            .collect();
        let (tallies, pairs) = tallies(&tracked);
        add(&mut sum, &tallies);
        let mut histories = Histories::default();
        for (((frame, places), tracked), pairs) in frames.iter().zip(&tracked).zip(pairs) {
            let columns = places.detections.len();
            let pairs = pairs
                .into_iter()
                .filter(|(truth, at)| tracked.overlaps[truth * columns + at] >= overlapping);
            pairs.for_each(|(truth, detection)| {
                velocities.add(frame, places.truths[truth], places.detections[detection]);
                histories.add(
                    frame.identities.as_ref(),
                    places.truths[truth],
                    places.detections[detection],
                );
            });
        }
        changes += histories.changes;
        swaps += histories.swaps;
    }
    let Hota {
        hota,
        detection,
        association,
        localization,
    } = Hota::of(&sum);
    TrackScores {
        hota,
        detection,
        association,
        localization,
        min_score,
        velocity_error: velocities.all.mean(),
        velocity_error_moving: velocities.moving.mean(),
        velocities: velocities.all.count,
        velocities_moving: velocities.moving.count,
        identity_changes: Some(changes),
        identity_swaps: Some(swaps),
    }
}

/// Places of a class's detections and objects in a frame, without those in no view.
struct Places {
    detections: Vec<usize>,
    truths: Vec<usize>,
}

impl Places {
    fn of(frame: &Frame, class: u8, min_score: f64) -> Self {
        let in_view = |unseen: &[usize], place: &usize| unseen.binary_search(place).is_err();
        let detections = (0..frame.detections.len()).filter(|place| {
            let detection = &frame.detections[*place];
            let counts = detection.class == class && f64::from(detection.score) >= min_score;
            counts && in_view(&frame.in_no_view.detections, place)
        });
        let truths = (0..frame.truths.len())
            .filter(|place| frame.truths[*place].class == class && in_view(&frame.in_no_view.truths, place));
        Places {
            detections: detections.collect(),
            truths: truths.collect(),
        }
    }
}

/// Identities of one scene, numbered from 0 in the order in which they are met.
#[derive(Default)]
struct Numbers {
    detections: Numbered,
    truths: Numbered,
}

#[derive(Default)]
struct Numbered {
    known: BTreeMap<u64, usize>,
    count: usize,
}

impl Numbered {
    /// The numbers of the identities of one frame; who has none, or one that another has in this frame, gets a number of its own.
    fn of(&mut self, identities: impl Iterator<Item = Identity>) -> Vec<usize> {
        let mut numbers: Vec<usize> = Vec::new();
        for identity in identities {
            let known = identity.track.and_then(|track| self.known.get(&track)).copied();
            let number = known.filter(|number| !numbers.contains(number)).unwrap_or_else(|| {
                let new = self.count;
                self.count += 1;
                if let Some(track) = identity.track.filter(|_| known.is_none()) {
                    self.known.insert(track, new);
                }
                new
            });
            numbers.push(number);
        }
        numbers
    }
}

impl Numbers {
    fn frame(&mut self, frame: &Frame, places: &Places) -> TrackedFrame {
        let identity = |all: fn(&Identities) -> &Vec<Identity>, place: usize| {
            let identities = frame.identities.as_ref();
            identities
                .and_then(|identities| all(identities).get(place))
                .copied()
                .unwrap_or_default()
        };
        let detected = places
            .detections
            .iter()
            .map(|place| identity(|all| &all.detections, *place));
        let objects = places.truths.iter().map(|place| identity(|all| &all.truths, *place));
        let footprint = |place: &usize| frame.detections[*place].outline.footprint();
        let footprints: Vec<Footprint> = places.detections.iter().map(footprint).collect();
        let overlaps = places.truths.iter().flat_map(|place| {
            let object = frame.truths[*place].outline.footprint();
            footprints
                .iter()
                .map(move |footprint| iou(footprint, &object))
                .collect::<Vec<f64>>()
        });
        TrackedFrame {
            overlaps: overlaps.collect(),
            detections: self.detections.of(detected),
            truths: self.truths.of(objects),
        }
    }
}

/// Under which identities the objects of a scene were found so far.
#[derive(Default)]
struct Histories {
    /// The last identity of each object.
    last: BTreeMap<u64, u64>,
    /// The last object of each identity.
    owner: BTreeMap<u64, u64>,
    changes: u64,
    swaps: u64,
}

impl Histories {
    /// A pair of object and detection; says nothing where one of them has no identity.
    fn add(&mut self, identities: Option<&Identities>, truth: usize, detection: usize) {
        let track = |all: &[Identity], place: usize| all.get(place)?.track;
        let pair = identities.map(|all| (track(&all.truths, truth), track(&all.detections, detection)));
        let Some((Some(object), Some(identity))) = pair else {
            return;
        };
        let before = self.last.insert(object, identity);
        let owner = self.owner.insert(identity, object);
        if before.is_some_and(|before| before != identity) {
            self.changes += 1;
            self.swaps += u64::from(owner.is_some_and(|owner| owner != object));
        }
    }
}

/// Errors of velocities.
#[derive(Default)]
struct Velocities {
    all: Mean,
    moving: Mean,
}

#[derive(Default)]
struct Mean {
    sum: f64,
    count: u64,
}

impl Mean {
    fn add(&mut self, value: f64) {
        self.sum += value;
        self.count += 1;
    }

    fn mean(&self) -> Option<f64> {
        (self.count > 0).then(|| self.sum / self.count as f64)
    }
}

impl Velocities {
    fn add(&mut self, frame: &Frame, truth: usize, detection: usize) {
        let Some(identities) = &frame.identities else { return };
        let velocity =
            |all: &[Identity], place: usize| all.get(place)?.velocity.map(|mm| mm.map(|v| f64::from(v) / 1000.0));
        let (Some(object), Some(detected)) = (
            velocity(&identities.truths, truth),
            velocity(&identities.detections, detection),
        ) else {
            return;
        };
        let error = libm::hypot(detected[0] - object[0], detected[1] - object[1]);
        self.all.add(error);
        if libm::hypot(object[0], object[1]) >= MOVES_MPS {
            self.moving.add(error);
        }
    }
}

#[cfg(test)]
mod tests;
