//! Least squares: the motion that brings a collaborator's objects to the ego's.

use nalgebra::{Matrix3, Vector2, Vector3};
use realo_assignment::{AssignmentError, Costs, FORBIDDEN, assign};

use crate::objects::Object;
use crate::shift::{Shift, half_turn};

/// How sure places, headings and poses are before anything is compared.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Noise {
    /// Standard deviation of the distance of two detections of one object along an axis, m.
    pub place_m: f64,
    /// Standard deviation of the difference of two headings of one object, rad.
    pub heading_rad: f64,
    /// Standard deviation of a collaborator's place along an axis, m: a weak one, as wrong poses are to be found.
    pub pose_m: f64,
    /// Standard deviation of a collaborator's heading, rad.
    pub pose_rad: f64,
}

/// How sure a collaborator's pose is in the ego's frame, as both say of their own.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Stated {
    /// Standard deviation of its place along an axis, m.
    pub place_m: f64,
    /// Standard deviation of its heading, rad.
    pub heading_rad: f64,
}

/// Beyond so many standard deviations a pair loses its say.
const TAIL: f64 = 2.0;
/// How far a pair may be apart in each step of a fit, m.
const GATES: [f64; 4] = [3.0, 2.0, 1.5, 1.2];
/// The last of them, at which pairs count.
pub const GATE_M: f64 = GATES[GATES.len() - 1];
/// What a motion has to lower the cost by to be believed: a shift, and a shift with a turn.
const WORTH: [f64; 2] = [9.0, 16.0];

/// Headings are taken to be no surer than this, rad.
const SURE_RAD: f64 = 1e-3;

/// The objects of both sides, and which may be the same.
#[derive(Debug)]
pub struct Scene<'a> {
    /// The ego's.
    pub ego: &'a [Object],
    /// The collaborator's, as it places them.
    pub theirs: &'a [Object],
    alike: Vec<bool>,
}

impl<'a> Scene<'a> {
    /// A scene of both sides' objects.
    pub fn new(ego: &'a [Object], theirs: &'a [Object]) -> Self {
        let alike = ego
            .iter()
            .flat_map(|own| theirs.iter().map(move |other| own.is_like(other)));
        let alike = alike.collect();
        Scene { ego, theirs, alike }
    }

    /// Whether an object of the ego and one of the collaborator may be the same.
    pub fn is_alike(&self, own: usize, other: usize) -> bool {
        self.alike[own * self.theirs.len() + other]
    }

    /// How much a pair of them says, 0 to 1.
    pub fn weight(&self, own: usize, other: usize) -> f64 {
        (self.ego[own].score * self.theirs[other].score).max(0.0).sqrt()
    }

    /// The mean of their places, m; `None` without any.
    pub fn middle(&self) -> Option<Vector2<f64>> {
        let sum: Vector2<f64> = self.theirs.iter().map(|object| object.center).sum();
        (!self.theirs.is_empty()).then(|| sum / self.theirs.len() as f64)
    }

    /// Their places after a motion.
    pub fn placed(&self, shift: &Shift) -> Vec<Vector2<f64>> {
        let place = shift.mover();
        self.theirs.iter().map(|object| place(&object.center)).collect()
    }

    /// Pairs (ego's, theirs) that are each other's nearest within a gate, m.
    fn nearest(&self, placed: &[Vector2<f64>], gate: f64) -> Vec<(usize, usize)> {
        let mut of_theirs: Vec<Option<(f64, usize)>> = vec![None; self.theirs.len()];
        let mut of_ego: Vec<Option<(f64, usize)>> = vec![None; self.ego.len()];
        for (own, object) in self.ego.iter().enumerate() {
            for (other, at) in placed.iter().enumerate() {
                let distance = (object.center - at).norm_squared();
                if distance > gate * gate || !self.is_alike(own, other) {
                    continue;
                }
                let nearer = |known: &Option<(f64, usize)>| known.is_none_or(|(best, _)| distance < best);
                if nearer(&of_ego[own]) {
                    of_ego[own] = Some((distance, other));
                }
                if nearer(&of_theirs[other]) {
                    of_theirs[other] = Some((distance, own));
                }
            }
        }
        let mutual = of_ego.iter().enumerate().filter_map(|(own, best)| {
            let other = (*best)?.1;
            (of_theirs[other]?.1 == own).then_some((own, other))
        });
        mutual.collect()
    }

    /// The pairs of the smallest sum of distances after a motion, by ego's object.
    ///
    /// # Errors
    /// [`AssignmentError`] for more objects than an assignment takes.
    pub fn pairs(&self, shift: &Shift) -> Result<Vec<(usize, usize)>, AssignmentError> {
        let placed = self.placed(shift);
        let cost = |own: usize, other: usize| {
            let distance = (self.ego[own].center - placed[other]).norm();
            match distance < GATE_M && self.is_alike(own, other) {
                true => distance,
                false => FORBIDDEN,
            }
        };
        assign(&Costs::of(self.ego.len(), self.theirs.len(), cost)?, GATE_M)
    }

    /// How well a motion explains both sides: what its pairs say, each the more the nearer it brings its two.
    pub fn support(&self, shift: &Shift, pairs: &[(usize, usize)]) -> f64 {
        let of = |(own, other): &(usize, usize)| {
            let apart = (self.ego[*own].center - shift.place(&self.theirs[*other].center)).norm() / GATE_M;
            self.weight(*own, *other) * (1.0 - apart * apart).max(0.0)
        };
        pairs.iter().map(of).sum()
    }

    /// Improves a motion in steps of narrower gates; the pairs of the last step.
    pub fn refine(&self, start: Shift, noise: &Noise) -> (Shift, Vec<(usize, usize)>) {
        let mut shift = start;
        for gate in GATES {
            let pairs = self.nearest(&self.placed(&shift), gate);
            if pairs.is_empty() {
                break;
            }
            shift = Normal::of(self, &shift, &pairs, noise).step(shift, Freedom::Turn);
        }
        let pairs = self.nearest(&self.placed(&shift), GATE_M);
        (shift, pairs)
    }
}

/// What a motion may do.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Freedom {
    Shift,
    Turn,
}

/// The normal equations of a set of pairs about a motion, and what it costs.
struct Normal {
    information: Matrix3<f64>,
    pull: Vector3<f64>,
    cost: f64,
}

impl Normal {
    fn of(scene: &Scene, shift: &Shift, pairs: &[(usize, usize)], noise: &Noise) -> Self {
        let prior = Vector3::new(noise.pose_m, noise.pose_m, noise.pose_rad).map(|sigma| 1.0 / (sigma * sigma));
        let off = Vector3::new(shift.by.x, shift.by.y, shift.turn);
        let mut normal = Normal {
            information: Matrix3::from_diagonal(&prior),
            pull: -prior.component_mul(&off),
            cost: 0.0,
        };
        for (own, other) in pairs {
            let (ego, theirs) = (&scene.ego[*own], &scene.theirs[*other]);
            let at = shift.place(&theirs.center);
            let arm = at - shift.pivot - shift.by;
            let away = ego.center - at;
            let weight = normal.weigh(
                away.norm_squared() / (noise.place_m * noise.place_m),
                scene.weight(*own, *other),
            );
            let weight = weight / (noise.place_m * noise.place_m);
            normal.add(&Vector3::new(1.0, 0.0, -arm.y), away.x, weight);
            normal.add(&Vector3::new(0.0, 1.0, arm.x), away.y, weight);
            if ego.is_long() && theirs.is_long() {
                let turn = half_turn(ego.yaw - theirs.yaw - shift.turn);
                let square = turn * turn / (noise.heading_rad * noise.heading_rad);
                let weight = normal.weigh(square, scene.weight(*own, *other));
                normal.add(
                    &Vector3::new(0.0, 0.0, 1.0),
                    turn,
                    weight / (noise.heading_rad * noise.heading_rad),
                );
            }
        }
        normal
    }

    /// The weight of a squared distance in standard deviations (Cauchy), whose cost is added.
    fn weigh(&mut self, square: f64, weight: f64) -> f64 {
        let ratio = 1.0 + square / (TAIL * TAIL);
        self.cost += weight * TAIL * TAIL * libm::log(ratio);
        weight / ratio
    }

    fn add(&mut self, row: &Vector3<f64>, away: f64, weight: f64) {
        self.information += row * row.transpose() * weight;
        self.pull += row * (away * weight);
    }

    /// One step of Gauss and Newton.
    fn step(&self, mut shift: Shift, freedom: Freedom) -> Shift {
        let mut information = self.information;
        if freedom == Freedom::Shift {
            information.fixed_view_mut::<1, 2>(2, 0).fill(0.0);
            information.fixed_view_mut::<2, 1>(0, 2).fill(0.0);
        }
        // The prior keeps it positive; numbers that are no numbers move nothing.
        let Some(by) = information.cholesky().map(|factor| factor.solve(&self.pull)) else {
            return shift;
        };
        if by.iter().all(|number| number.is_finite()) {
            shift.by += by.fixed_rows::<2>(0);
            if freedom == Freedom::Turn {
                shift.turn += by[2];
            }
        }
        shift
    }
}

impl Stated {
    /// The noise of objects with the pose's own in the place of a weak one, which it is at most: nobody is moved farther for stating nothing.
    fn prior(&self, noise: &Noise) -> Noise {
        Noise {
            pose_m: self.place_m.min(noise.pose_m),
            pose_rad: self.heading_rad.min(noise.pose_rad).max(SURE_RAD),
            ..*noise
        }
    }
}

impl Noise {
    /// How unlikely a motion is by the noise of poses, as a sum of squares in standard deviations.
    fn cost(&self, shift: &Shift) -> f64 {
        let turns = shift.turn / self.pose_rad;
        shift.by.norm_squared() / (self.pose_m * self.pose_m) + turns * turns
    }
}

/// A motion that pairs of objects ask for.
#[derive(Clone, Debug, PartialEq)]
pub struct Fit {
    /// The motion; none where the pairs do not ask for one.
    pub shift: Shift,
    /// Pairs (ego's, theirs) after it.
    pub pairs: Vec<(usize, usize)>,
    /// Covariance of shift (m²) and turn (rad²).
    pub covariance: Matrix3<f64>,
    /// See [`Scene::support`].
    pub support: f64,
    /// Mean square of the pairs' distances along an axis, m²; 0 without pairs.
    pub residual: f64,
}

/// The simplest motion that explains the pairs of a refined one: none, a shift, or a shift and a turn, each if it lowers the cost by more
/// than chance does. So exact poses stay as they are. Poses that are said to be less sure than objects are moved as far as is likely by that.
///
/// # Errors
/// [`AssignmentError`] for more objects than an assignment takes.
pub fn fit(scene: &Scene, refined: &Shift, noise: &Noise, stated: Option<&Stated>) -> Result<Fit, AssignmentError> {
    let pairs = scene.pairs(refined)?;
    let settle = |noise: &Noise, mut shift: Shift, freedom: Freedom| {
        for _ in 0..4 {
            shift = Normal::of(scene, &shift, &pairs, noise).step(shift, freedom);
        }
        (Normal::of(scene, &shift, &pairs, noise).cost, shift)
    };
    let none = Shift::none(refined.pivot);
    let mut best = (Normal::of(scene, &none, &pairs, noise).cost, none);
    let moved = [
        settle(noise, Shift { turn: 0.0, ..*refined }, Freedom::Shift),
        settle(noise, *refined, Freedom::Turn),
    ];
    for ((cost, shift), worth) in moved.into_iter().zip(WORTH) {
        if cost + worth < best.0 {
            best = (cost + worth, shift);
        }
    }
    let mut prior = *noise;
    if let Some(stated) = stated.filter(|stated| stated.place_m > noise.place_m) {
        let as_stated = stated.prior(noise);
        let (cost, shift) = settle(&as_stated, *refined, Freedom::Turn);
        let cost = cost + as_stated.cost(&shift);
        if cost < best.0 {
            (best, prior) = ((cost, shift), as_stated);
        }
    }
    let shift = best.1;
    let pairs = scene.pairs(&shift)?;
    let squares: f64 = pairs
        .iter()
        .map(|(own, other)| {
            let away = scene.ego[*own].center - shift.place(&scene.theirs[*other].center);
            0.5 * away.norm_squared()
        })
        .sum();
    let residual = squares / pairs.len().max(1) as f64;
    let information = Normal::of(scene, &shift, &pairs, &prior).information;
    let spread = (residual / (noise.place_m * noise.place_m)).max(1.0);
    let covariance = information.try_inverse().unwrap_or_else(Matrix3::identity) * spread;
    Ok(Fit {
        shift,
        support: scene.support(&shift, &pairs),
        pairs,
        covariance,
        residual,
    })
}
