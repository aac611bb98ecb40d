//! Traffic on roads at any angle.

mod flow;
mod lanes;
mod signals;
mod strollers;

use flow::{Driven, FlowPlan, drive};
use lanes::Lanes;
use strollers::Ways;

use super::{Arrival, Demand};
use crate::bodies::Class;
use crate::options::Error;
use crate::path::{Course, Pose2, TICK, angle_within};
use crate::place::{Network, Scenery};
use crate::random::Stream;

/// How far beyond a log its traffic goes, s.
const MARGIN: f64 = 0.5;

/// Everybody who is about until `until`.
pub(super) fn crowd(demand: &Demand, network: &Network, until: f64) -> Result<Vec<Arrival>, Error> {
    let Demand {
        place,
        seed,
        dense,
        seconds,
    } = *demand;
    let custom = &network.custom;
    let lanes = Lanes::new(network);
    let signals = flow::signals(network, seed);
    let (walkers, walked) = strollers::walk(&Ways {
        network,
        crossings: &lanes.crossings,
        signals: &signals,
        seed,
        count: custom.walkers[usize::from(dense)],
        until,
    });
    let plan = |seed: u64, until: f64, stay| FlowPlan {
        network,
        lanes: &lanes,
        signals: &signals,
        walked: &walked,
        custom,
        dense,
        seed,
        until,
        stay,
    };
    let chosen = choose(place, network, seed, seconds, |s, until| drive(&plan(s, until, &[])));
    let (traffic_seed, cavs) = chosen.ok_or(Error::NoRoom {
        scenario: place.scenario.name(),
        place: place.number,
        seed,
    })?;
    let mut crowd = Vec::new();
    for vehicle in drive(&plan(traffic_seed, until, &cavs)) {
        let cav = cavs.iter().position(|number| *number == vehicle.number);
        crowd.push((cav, vehicle.class, vehicle.size, Course::Moving(vehicle.motion)));
    }
    crowd.extend(walkers.into_iter().map(|w| (None, w.class, w.size, w.course)));
    crowd.extend(parked(network, seed, dense));
    Ok(crowd)
}

/// Draws traffic until two of its cars make good cavs: near each other and the first roadside unit for most of the
/// first ten seconds, come by different lanes, and moving. Returns the traffic's own seed and the cars' numbers.
fn choose(
    place: &Scenery,
    network: &Network,
    seed: u64,
    seconds: f64,
    run: impl Fn(u64, f64) -> Vec<Driven>,
) -> Option<(u64, [u64; 2])> {
    const GOOD: f64 = 1.03;
    const ATTEMPTS: u64 = 8;
    let horizon = seconds.min(10.0);
    let mut best: Option<(f64, u64, [u64; 2])> = None;
    for attempt in 0..ATTEMPTS {
        let traffic_seed = Stream::new(seed, "traffic", attempt).bits();
        let driven = run(traffic_seed, horizon + MARGIN);
        if let Some((score, numbers)) = best_pair(place, network, &driven, horizon)
            && best.is_none_or(|(least, ..)| score > least)
        {
            best = Some((score, traffic_seed, numbers));
        }
        if best.is_some_and(|(score, ..)| score >= GOOD) {
            break;
        }
    }
    best.map(|(_, traffic_seed, numbers)| (traffic_seed, numbers))
}

/// The two cars that go best together, and how well.
fn best_pair(place: &Scenery, network: &Network, driven: &[Driven], horizon: f64) -> Option<(f64, [u64; 2])> {
    const TOGETHER: f64 = 65.0;
    let (rsu, _) = place.roadside(false);
    let near = network.custom.near;
    let times: Vec<f64> = (0..=20).map(|k| horizon * f64::from(k) / 20.0).collect();
    let track = |vehicle: &Driven| -> Option<Vec<Pose2>> {
        let course = Course::Moving(vehicle.motion.clone());
        // Poses are asked for a little before the first and after the last sweep.
        course.at(-0.3)?;
        course.at(horizon + MARGIN - TICK)?;
        times.iter().map(|t| course.at(*t).map(|state| state.pose)).collect()
    };
    let candidates: Vec<(&Driven, Vec<Pose2>)> = driven
        .iter()
        .filter(|vehicle| vehicle.class == Class::Car)
        .filter_map(|vehicle| track(vehicle).map(|poses| (vehicle, poses)))
        .collect();
    let within = |a: &Pose2, b: &Pose2, reach: f64| {
        let (dx, dy) = (a.x - b.x, a.y - b.y);
        dx * dx + dy * dy < reach * reach
    };
    // What moves and turns shows more of the world than what stands.
    let worth = |poses: &[Pose2]| {
        let steps = poses.windows(2).map(|p| {
            let (dx, dy) = (p[1].x - p[0].x, p[1].y - p[0].y);
            (
                (dx * dx + dy * dy).sqrt(),
                angle_within(p[1].heading - p[0].heading).abs(),
            )
        });
        let (gone, turned) = steps.fold((0.0, 0.0), |sum, step| (sum.0 + step.0, sum.1 + step.1));
        0.02 * (gone / horizon).min(6.0) + 0.06 * f64::min(turned, 1.5)
    };
    let mut best: Option<(f64, [u64; 2])> = None;
    for (i, (first, a)) in candidates.iter().enumerate() {
        for (second, b) in &candidates[i + 1..] {
            if first.first_lane == second.first_lane {
                continue;
            }
            let together = (0..times.len())
                .filter(|k| {
                    let (p, q) = (&a[*k], &b[*k]);
                    within(p, q, TOGETHER) && within(p, &rsu, near) && within(q, &rsu, near)
                })
                .count();
            let score = together as f64 / times.len() as f64 + worth(a) + worth(b);
            if best.is_none_or(|(least, _)| score > least) {
                best = Some((score, [first.number, second.number]));
            }
        }
    }
    best
}

/// Cars and vans in the bays.
fn parked(network: &Network, seed: u64, dense: bool) -> Vec<Arrival> {
    let custom = &network.custom;
    let share = custom.parked[usize::from(dense)];
    let mut all = Vec::new();
    for (index, road) in network.roads.iter().enumerate() {
        let mut draws = Stream::new(seed, "parked", index as u64);
        for (pose, angle) in road.stands() {
            let class = if draws.chance(custom.vans[0]) {
                Class::Van
            } else {
                Class::Car
            };
            let size = class.size(&mut draws);
            let (taken, backwards) = (draws.chance(share), draws.chance(0.25));
            let scatter = [(); 3].map(|()| draws.normal().clamp(-2.0, 2.0));
            if !taken {
                continue;
            }
            let along = angle == 0.0;
            let turn = if backwards && !along { std::f64::consts::PI } else { 0.0 };
            let room = if along { 0.05 } else { 0.1 };
            let stand = pose.at(0.1 * scatter[0], room * scatter[1]);
            let stand = Pose2 {
                heading: pose.heading + turn + 0.014 * scatter[2],
                ..stand
            };
            all.push((None, class, size, Course::Fixed(stand)));
        }
    }
    all
}

#[cfg(test)]
mod tests;
