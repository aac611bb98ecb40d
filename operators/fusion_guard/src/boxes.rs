//! What becomes of a collaborator's boxes.

use nalgebra::{Isometry3, Matrix3, Vector2};
use realo_assignment::AssignmentError;
use realo_schemas::geometry::detection_fault;
use realo_schemas::{Box3, Boxes, Payload};

use crate::clock::ahead_s;
use crate::fit::{Fit, Noise, Scene, Stated};
use crate::objects::{Object, objects, surest};
use crate::record::Record;
use crate::search::{Found, Reach, search};
use crate::shift::{Shift, variance_at};
use crate::verdict::{Apart, Reason, Shares, weigh_pose, weigh_scatter, weigh_trust};
use crate::view::{Seen, View};

/// What a guard assumes, and how much it looks at.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Limits {
    /// How sure things are.
    pub noise: Noise,
    /// How far poses may be off.
    pub reach: Reach,
    /// How far clocks may be off, s; 0: they are not looked at.
    pub clock_s: f64,
    /// Boxes of a message that are looked at, the best; the others are dropped.
    pub max_boxes: usize,
    /// Boxes of each side that are compared, the best.
    pub max_objects: usize,
    /// Whether boxes are moved by their velocities to the ego's time.
    pub moves: bool,
}

/// What the ego knows, in its frame.
pub struct Ego<'a> {
    /// Its objects, and those of collaborators that it has confirmed.
    pub objects: &'a [Object],
    /// How many of them, the first, are its own.
    pub own: usize,
    /// What its sweep shows, where it is known.
    pub view: Option<&'a View>,
}

/// Where a message is from.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Origin {
    /// From the frame of its boxes to the ego's, as poses say.
    pub ego_from_sender: Isometry3<f64>,
    /// Where its agent is in the ego's frame, m.
    pub sender: Vector2<f64>,
    /// The ego's stamp less the message's, s.
    pub age_s: f64,
    /// How sure its place is in the ego's frame, as it and the ego say themselves; `None` where it says nothing.
    pub stated: Option<Stated>,
}

/// What was found of a message.
#[derive(Clone, Debug, PartialEq)]
pub struct Judgement {
    /// Why it is left out.
    pub reason: Option<Reason>,
    /// How its boxes are moved on the ground of the ego's frame.
    pub shift: Shift,
    /// Covariance of shift (m²) and turn (rad²), where the ego could find it.
    pub covariance: Option<Matrix3<f64>>,
    /// How much earlier than its stamp the message is, s.
    pub ahead_s: f64,
    /// What the ego could check.
    pub shares: Shares,
    /// What has to be added to heights, m.
    pub rise: f64,
    /// What is kept, in the message's frame, in its order.
    pub kept: Payload,
    /// Of boxes the same as objects, after the motion.
    pub objects: Vec<Object>,
    /// Boxes or points that there were.
    pub all: u64,
    /// Those of them dropped because the ego sees that nothing is there.
    pub free: u64,
    /// Indices in the message of the boxes dropped as free; empty for points.
    pub free_indices: Vec<usize>,
    /// Boxes dropped because no object can have such numbers.
    pub implausible: u64,
    /// Boxes dropped beyond the best `max_boxes`.
    pub excess: u64,
}

/// Fastest that objects are taken to move, by which an old box may lie behind its object, m/s.
const FAST_MPS: f64 = 15.0;
/// What speaks against a motion for each metre and radian, in units of support; a box where nothing stands counts [`AGAINST`].
const AGAINST_METRE: f64 = 0.06;
const AGAINST_RADIAN: f64 = 2.0;
const AGAINST: f64 = 0.5;
/// A shift up to this is small: it needs less to be believed, m.
const SMALL_M: f64 = 1.0;
/// Support that a small and a large shift need, pairs, and by how much they have to be better than any other.
const SUPPORT: [f64; 2] = [1.2, 1.8];
const PAIRS: [usize; 2] = [2, 3];
const CLEAR: [f64; 2] = [0.0, 0.6];

/// What a message says.
pub struct Said<'a> {
    /// Its boxes, in its frame.
    pub boxes: &'a [Box3],
    /// Boxes of impossible size or place that were found in its map.
    pub impossible: usize,
}

/// Judges what a message says.
///
/// # Errors
/// [`AssignmentError`] for more objects than an assignment takes.
pub fn judge(
    said: &Said,
    ego: &Ego,
    origin: &Origin,
    record: &Record,
    limits: &Limits,
) -> Result<Judgement, AssignmentError> {
    let boxes = said.boxes;
    let (theirs, found, is_found, ahead) = placed(boxes, ego, origin, record, limits)?;
    let shift = if is_found {
        found.fit.shift
    } else {
        Shift::none(origin.sender)
    };
    let pairs = Scene::new(ego.objects, &theirs).pairs(&shift)?;
    let seen = sort(&theirs, ego, &shift, &pairs, origin.age_s);
    let mut shares = Shares::of(&theirs, &seen).with_impossible(said.impossible);
    if is_found {
        // Pairs of a wrong pose are chance, and nobody is charged with how another one's boxes scatter.
        let own = pairs
            .iter()
            .filter(|(mine, _)| *mine < ego.own)
            .copied()
            .collect::<Vec<_>>();
        shares.apart = apart(ego.objects, &theirs, &shift, &own, limits.noise.place_m);
    }
    let mut after = record.clone();
    after.observe(shares.confirmed(), shares.contradicted);
    after.observe_apart(&shares.apart);
    let pose_m = record.pose_error_m(origin.stated.map(|stated| stated.place_m));
    let scatter = after.scatter();
    let reason = shares.reason(is_found, after.trust(), scatter, pose_m);
    let mut judgement = Judgement {
        reason,
        shift,
        covariance: is_found.then_some(found.fit.covariance),
        ahead_s: ahead,
        shares,
        rise: 0.0,
        kept: Boxes(Vec::new()).into(),
        objects: Vec::new(),
        all: boxes.len() as u64,
        free: 0,
        free_indices: Vec::new(),
        implausible: boxes.iter().filter(|object| detection_fault(object).is_some()).count() as u64,
        excess: 0,
    };
    judgement.excess = (boxes.len() - theirs.len()) as u64 - judgement.implausible;
    let unseen = weigh_trust(after.trust()) * if is_found { 1.0 } else { weigh_pose(pose_m) };
    judgement.keep(boxes, theirs, &seen, &found.fit, [weigh_scatter(scatter), unseen]);
    Ok(judgement)
}

/// Their objects at the ego's time by the clock that fits best, where they lie best, whether enough speaks for it, and how far their clock is
/// ahead, s.
fn placed(
    boxes: &[Box3],
    ego: &Ego,
    origin: &Origin,
    record: &Record,
    limits: &Limits,
) -> Result<(Vec<Object>, Found, bool, f64), AssignmentError> {
    let mut ahead = record.clock_s();
    let seconds = if limits.moves { origin.age_s + ahead } else { 0.0 };
    let all = |seconds: f64| objects(boxes, &origin.ego_from_sender, seconds, limits.max_boxes);
    let mut theirs = all(seconds);
    let (mut found, mut is_found) = place(&theirs, ego, origin, limits)?;
    if limits.moves && limits.clock_s > 0.0 {
        let scene = Scene::new(ego.objects, &theirs);
        if let Some(more) = ahead_s(&scene, &found.fit.shift, limits.clock_s) {
            ahead += more;
            theirs = all(seconds + more);
            (found, is_found) = place(&theirs, ego, origin, limits)?;
        }
    }
    Ok((theirs, found, is_found, ahead))
}

/// What the ego knows of one of their boxes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Known {
    /// It has it too.
    Paired,
    /// Something stands there.
    Something,
    /// Nothing stands there, though an object that moves may have been there when it was seen.
    Left,
    /// Nothing stands there.
    Free,
    /// It cannot see the place.
    Unseen,
}

/// The best place of their objects, and whether enough speaks for it.
fn place(theirs: &[Object], ego: &Ego, origin: &Origin, limits: &Limits) -> Result<(Found, bool), AssignmentError> {
    let best = |objects: &[Object]| -> Vec<Object> {
        let surest = surest(objects, limits.max_objects).into_iter();
        surest.map(|index| objects[index].clone()).collect()
    };
    let (own, theirs) = (best(ego.objects), best(theirs));
    let scene = Scene::new(&own, &theirs);
    let penalty = |shift: &Shift| {
        let free = |object: &&Object| {
            let is_free = |view: &View| view.of_moved(object, &shift.place(&object.center), shift.turn) == Seen::Free;
            ego.view.is_some_and(is_free)
        };
        let against: f64 = theirs.iter().filter(free).map(|object| object.score).sum();
        AGAINST * against + AGAINST_METRE * shift.metres() + AGAINST_RADIAN * shift.turn.abs()
    };
    let found = search(
        &scene,
        origin.sender,
        &limits.reach,
        &limits.noise,
        origin.stated.as_ref(),
        penalty,
    )?;
    let middle = scene.middle().unwrap_or_default();
    let moved = (found.fit.shift.place(&middle) - middle).norm();
    let size = usize::from(moved > SMALL_M);
    let better = found.fit.support - penalty(&found.fit.shift) - found.runner_up;
    let is_found = found.fit.pairs.len() >= PAIRS[size] && found.fit.support >= SUPPORT[size] && better >= CLEAR[size];
    Ok((found, is_found))
}

/// How far pairs are apart after a motion.
fn apart(own: &[Object], theirs: &[Object], shift: &Shift, pairs: &[(usize, usize)], place_m: f64) -> Apart {
    let mut apart = Apart::default();
    for (mine, other) in pairs.iter().map(|(mine, other)| (&own[*mine], &theirs[*other])) {
        if !(mine.is_long() && other.is_long()) {
            continue;
        }
        let away = mine.center - shift.place(&other.center);
        let (sin, cos) = libm::sincos(mine.yaw);
        let across = cos * away.y - sin * away.x;
        apart.far += f64::from(u8::from(across.abs() > place_m));
        apart.pairs += 1.0;
    }
    apart
}

/// What the ego knows of each of their objects.
fn sort(theirs: &[Object], ego: &Ego, shift: &Shift, pairs: &[(usize, usize)], age_s: f64) -> Vec<Known> {
    let mut is_paired = vec![false; theirs.len()];
    let mut is_taken = vec![false; ego.objects.len()];
    for (own, other) in pairs {
        (is_paired[*other], is_taken[*own]) = (true, true);
    }
    let known = |(index, object): (usize, &Object)| {
        if is_paired[index] {
            return Known::Paired;
        }
        let at = shift.place(&object.center);
        match ego.view.map(|view| view.of_moved(object, &at, shift.turn)) {
            Some(Seen::Something) => Known::Something,
            Some(Seen::Free) => {
                let reach = 1.0 + FAST_MPS * age_s.abs();
                let mut free = ego.objects.iter().zip(&is_taken).filter(|(_, taken)| !**taken);
                let has_left = free.any(|(own, _)| own.is_like(object) && (own.center - at).norm() < reach);
                if has_left { Known::Left } else { Known::Free }
            }
            _ => Known::Unseen,
        }
    };
    theirs.iter().enumerate().map(known).collect()
}

impl Judgement {
    /// Keeps what the ego does not contradict, with `weights` of all, and of what it cannot confirm.
    fn keep(&mut self, boxes: &[Box3], theirs: Vec<Object>, seen: &[Known], fit: &Fit, [all, unconfirmed]: [f64; 2]) {
        let mut list = Vec::new();
        let is_moved = self.covariance.is_some() && fit.shift != Shift::none(fit.shift.pivot);
        for (mut object, known) in theirs.into_iter().zip(seen) {
            if matches!(known, Known::Free | Known::Left) {
                self.free += 1;
                self.free_indices.push(object.index);
                continue;
            }
            let at = self.shift.place(&object.center);
            let mut weight = all * if *known == Known::Paired { 1.0 } else { unconfirmed };
            if is_moved {
                weight *= weigh_pose(variance_at(&fit.covariance, &fit.shift.pivot, &at).sqrt());
            }
            let mut kept = boxes[object.index].clone();
            kept.score = (f64::from(kept.score) * weight) as f32;
            list.push(kept);
            object.center = at;
            object.yaw += self.shift.turn;
            object.score *= weight;
            self.objects.push(object);
        }
        self.kept = Boxes(list).into();
    }
}
