//! Which two cars of the traffic record.

use super::MARGIN;
use super::standing::Standing;
use crate::bodies::Class;
use crate::path::{Pose2, TICK, angle_within};
use crate::place::{Network, Scenery};
use crate::random::Stream;
use crate::traffic::Driven;

/// Draws traffic until two of its cars make good cavs: near each other and the first roadside unit for most of the
/// first ten seconds, come by different lanes, moving, and at an angle to many others. Returns the traffic's own seed and
/// the cars' numbers.
pub(super) fn choose(
    place: &Scenery,
    network: &Network,
    parked: &[Standing],
    seed: u64,
    seconds: f64,
    run: impl Fn(u64, f64) -> Vec<Driven>,
) -> Option<(u64, [u64; 2])> {
    const GOOD: f64 = 1.6;
    const ATTEMPTS: u64 = 8;
    if !network.ring.is_empty() {
        return (0..ATTEMPTS).find_map(|attempt| {
            let traffic_seed = Stream::new(seed, "traffic", attempt).bits();
            let driven = run(traffic_seed, seconds + MARGIN);
            Some((traffic_seed, round_the_block(network, traffic_seed, &driven, seconds)?))
        });
    }
    let horizon = seconds.min(10.0);
    let mut best: Option<(f64, u64, [u64; 2])> = None;
    for attempt in 0..ATTEMPTS {
        let traffic_seed = Stream::new(seed, "traffic", attempt).bits();
        let driven = run(traffic_seed, horizon + MARGIN);
        if let Some((score, numbers)) = best_pair(place, network, parked, &driven, horizon)
            && best.is_none_or(|(min, ..)| score > min)
        {
            best = Some((score, traffic_seed, numbers));
        }
        if best.is_some_and(|(score, ..)| score >= GOOD) {
            break;
        }
    }
    best.map(|(_, traffic_seed, numbers)| (traffic_seed, numbers))
}

/// Two cars that never leave the ring: the first goes along the roads' lines and is nearest to where the ring begins at the
/// log's start, the other one is nearest to the first.
fn round_the_block(network: &Network, traffic_seed: u64, driven: &[Driven], seconds: f64) -> Option<[u64; 2]> {
    let begin = network.roads[network.ring[0]].line.at(20.0).0;
    let keeps = |vehicle: &&Driven| {
        let stays = [-0.3, seconds + MARGIN - TICK]
            .iter()
            .all(|t| vehicle.motion.at(*t).is_some());
        vehicle.class == Class::Car && stays && network.keeps_to_ring(traffic_seed, vehicle.number)
    };
    let there: Vec<(u64, Pose2)> = driven
        .iter()
        .filter(keeps)
        .filter_map(|vehicle| Some((vehicle.number, vehicle.motion.at(0.0)?.pose)))
        .filter(|(_, pose)| on_the_ring(network, *pose).is_some())
        .collect();
    let square = |a: &Pose2, b: &Pose2| (a.x - b.x) * (a.x - b.x) + (a.y - b.y) * (a.y - b.y);
    let ahead = there
        .iter()
        .filter(|(_, pose)| on_the_ring(network, *pose) == Some(true));
    let first = ahead.min_by(|a, b| square(&a.1, &begin).total_cmp(&square(&b.1, &begin)))?;
    let others = there.iter().filter(|(number, _)| *number != first.0);
    let other = others.min_by(|a, b| square(&a.1, &first.1).total_cmp(&square(&b.1, &first.1)))?;
    Some([first.0, other.0])
}

/// Whether somebody on a road of the ring goes along its line; `None` off the ring.
fn on_the_ring(network: &Network, pose: Pose2) -> Option<bool> {
    const LANE: f64 = 4.0;
    let near = |road: &usize| {
        let line = &network.roads[*road].line;
        let steps = (line.length() / 2.0) as usize;
        let at = (0..=steps).map(|k| line.at(2.0 * k as f64).0);
        at.min_by(|a, b| {
            (a.x - pose.x)
                .hypot(a.y - pose.y)
                .total_cmp(&(b.x - pose.x).hypot(b.y - pose.y))
        })
    };
    let nearest = network.ring.iter().filter_map(near);
    let nearest = nearest.min_by(|a, b| {
        (a.x - pose.x)
            .hypot(a.y - pose.y)
            .total_cmp(&(b.x - pose.x).hypot(b.y - pose.y))
    })?;
    let far = (nearest.x - pose.x).hypot(nearest.y - pose.y);
    (far < LANE).then(|| angle_within(nearest.heading - pose.heading).abs() < std::f64::consts::FRAC_PI_4)
}

/// A car that could record.
struct Candidate<'a> {
    vehicle: &'a Driven,
    /// Where it is at each look.
    poses: Vec<Pose2>,
    /// How much of the world it shows.
    worth: f64,
}

/// The two cars that go best together, the one that shows more first, and how well.
fn best_pair(
    place: &Scenery,
    network: &Network,
    parked: &[Standing],
    driven: &[Driven],
    horizon: f64,
) -> Option<(f64, [u64; 2])> {
    const TOGETHER: f64 = 65.0;
    let (rsu, _) = place.roadside(false);
    let near = network.mix.near;
    let candidates = candidates(parked, driven, horizon);
    let together = |a: &Candidate, b: &Candidate| {
        let looks = a.poses.iter().zip(&b.poses);
        let together = looks
            .filter(|(p, q)| within(p, q, TOGETHER) && within(p, &rsu, near) && within(q, &rsu, near))
            .count();
        together as f64 / a.poses.len() as f64
    };
    let mut best: Option<(f64, [u64; 2])> = None;
    for (i, a) in candidates.iter().enumerate() {
        for b in &candidates[i + 1..] {
            if a.vehicle.came_by == b.vehicle.came_by {
                continue;
            }
            let score = together(a, b) + a.worth + b.worth;
            if best.is_none_or(|(min, _)| score > min) {
                let [worthier, other] = if a.worth < b.worth { [b, a] } else { [a, b] };
                best = Some((score, [worthier.vehicle.number, other.vehicle.number]));
            }
        }
    }
    best
}

/// The cars that are there from the first sweep to the last.
fn candidates<'a>(parked: &[Standing], driven: &'a [Driven], horizon: f64) -> Vec<Candidate<'a>> {
    /// What it is worth if all others stand askew to a car.
    const ASKEW: f64 = 0.5;
    let times: Vec<f64> = (0..=20).map(|k| horizon * f64::from(k) / 20.0).collect();
    let around = Around::new(driven, parked, &times);
    let cars = driven.iter().filter(|vehicle| vehicle.class == Class::Car);
    let candidates = cars.filter_map(|vehicle| {
        let motion = &vehicle.motion;
        // Poses are asked for a little before the first and after the last sweep.
        motion.at(-0.3)?;
        motion.at(horizon + MARGIN - TICK)?;
        let poses: Option<Vec<Pose2>> = times.iter().map(|t| motion.at(*t).map(|state| state.pose)).collect();
        let poses = poses?;
        let worth = liveliness(&poses, horizon) + ASKEW * around.askew(&poses);
        Some(Candidate { vehicle, poses, worth })
    });
    candidates.collect()
}

/// What moves and turns shows more of the world than what stands.
fn liveliness(poses: &[Pose2], horizon: f64) -> f64 {
    let steps = poses.windows(2).map(|p| {
        let (dx, dy) = (p[1].x - p[0].x, p[1].y - p[0].y);
        (
            (dx * dx + dy * dy).sqrt(),
            angle_within(p[1].heading - p[0].heading).abs(),
        )
    });
    let (gone, turned) = steps.fold((0.0, 0.0), |sum, step| (sum.0 + step.0, sum.1 + step.1));
    0.02 * (gone / horizon).min(6.0) + 0.06 * f64::min(turned, 1.5)
}

fn within(a: &Pose2, b: &Pose2, reach: f64) -> bool {
    let (dx, dy) = (a.x - b.x, a.y - b.y);
    dx * dx + dy * dy < reach * reach
}

/// Where vehicles are at some of the looks at a pair of cars.
struct Around(Vec<(usize, Vec<Pose2>)>);

impl Around {
    /// Each so many looks count.
    const EVERY: usize = 5;

    pub(super) fn new(driven: &[Driven], parked: &[Standing], times: &[f64]) -> Self {
        let at = |look: usize| {
            let moving = driven.iter().filter_map(|vehicle| vehicle.motion.at(times[look]));
            let poses = moving
                .map(|state| state.pose)
                .chain(parked.iter().map(|standing| standing.pose));
            (look, poses.collect())
        };
        Around((0..times.len()).step_by(Self::EVERY).map(at).collect())
    }

    /// Share of those near somebody whose headings are over 20° off his axes.
    fn askew(&self, own: &[Pose2]) -> f64 {
        const NEAR: f64 = 60.0;
        const OFF: f64 = 20.0;
        let (mut askew, mut all) = (0u32, 0u32);
        for (look, others) in &self.0 {
            let own = own[*look];
            for other in others {
                let (dx, dy) = (other.x - own.x, other.y - own.y);
                let square = dx * dx + dy * dy;
                // He himself is among them.
                if !(0.01..NEAR * NEAR).contains(&square) {
                    continue;
                }
                let quarter = std::f64::consts::FRAC_PI_2;
                let off = (other.heading - own.heading).rem_euclid(quarter);
                all += 1;
                askew += u32::from(off.min(quarter - off).to_degrees() > OFF);
            }
        }
        f64::from(askew) / f64::from(all.max(1))
    }
}
