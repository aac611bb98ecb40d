//! Traffic on roads at any angle.

mod flow;
mod lanes;
mod signals;
mod strollers;

use flow::{FlowPlan, drive};
use lanes::Lanes;
use strollers::Ways;

use super::{Arrival, Demand, Driven, touch};
use crate::bodies::Class;
use crate::options::Error;
use crate::path::{Course, Pose2, TICK, angle_within};
use crate::place::{Network, Scenery};
use crate::random::Stream;

/// Middle and extent of what stands in the place.
type Footprint = (Pose2, [f64; 3]);

/// How far beyond a log its traffic goes, s.
const MARGIN: f64 = 0.5;

/// Everybody who is about until `until`.
pub(super) fn crowd(demand: &Demand, network: &Network, until: f64) -> Result<Vec<Arrival>, Error> {
    let Demand {
        place,
        seed,
        dense,
        seconds,
        ..
    } = *demand;
    let mix = &network.mix;
    let lanes = Lanes::new(network);
    let signals = flow::signals(network, seed);
    let things: Vec<Footprint> = place.fixtures.iter().map(|fixture| fixture.footprint()).collect();
    let (walkers, walked) = strollers::walk(&Ways {
        network,
        things: &things,
        crossings: &lanes.crossings,
        signals: &signals,
        seed,
        dense,
        until,
    });
    let plan = |seed: u64, until: f64, stay| FlowPlan {
        network,
        lanes: &lanes,
        signals: &signals,
        walked: &walked,
        mix,
        dense,
        seed,
        until,
        stay,
    };
    let parked = parked(network, &things, seed, dense);
    let between = between(network, &parked, seed);
    let chosen = choose(place, network, &parked, seed, seconds, |s, until| {
        drive(&plan(s, until, &[]))
    });
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
    crowd.extend(stand(parked));
    crowd.extend(stand(between));
    Ok(crowd)
}

/// Draws traffic until two of its cars make good cavs: near each other and the first roadside unit for most of the
/// first ten seconds, come by different lanes, moving, and at an angle to many others. Returns the traffic's own seed and
/// the cars' numbers.
fn choose(
    place: &Scenery,
    network: &Network,
    parked: &[Standing],
    seed: u64,
    seconds: f64,
    run: impl Fn(u64, f64) -> Vec<Driven>,
) -> Option<(u64, [u64; 2])> {
    const GOOD: f64 = 1.6;
    const ATTEMPTS: u64 = 8;
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

/// The two cars that go best together, the one that shows more first, and how well.
fn best_pair(
    place: &Scenery,
    network: &Network,
    parked: &[Standing],
    driven: &[Driven],
    horizon: f64,
) -> Option<(f64, [u64; 2])> {
    const TOGETHER: f64 = 65.0;
    /// What it is worth if all others stand askew to a car.
    const ASKEW: f64 = 0.5;
    let (rsu, _) = place.roadside(false);
    let near = network.mix.near;
    let times: Vec<f64> = (0..=20).map(|k| horizon * f64::from(k) / 20.0).collect();
    let track = |vehicle: &Driven| -> Option<Vec<Pose2>> {
        let motion = &vehicle.motion;
        // Poses are asked for a little before the first and after the last sweep.
        motion.at(-0.3)?;
        motion.at(horizon + MARGIN - TICK)?;
        times.iter().map(|t| motion.at(*t).map(|state| state.pose)).collect()
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
    let around = Around::new(driven, parked, &times);
    let candidates: Vec<(&Driven, Vec<Pose2>, f64)> = driven
        .iter()
        .filter(|vehicle| vehicle.class == Class::Car)
        .filter_map(|vehicle| {
            let poses = track(vehicle)?;
            let worth = worth(&poses) + ASKEW * around.askew(&poses);
            Some((vehicle, poses, worth))
        })
        .collect();
    let within = |a: &Pose2, b: &Pose2, reach: f64| {
        let (dx, dy) = (a.x - b.x, a.y - b.y);
        dx * dx + dy * dy < reach * reach
    };
    let mut best: Option<(f64, [u64; 2])> = None;
    for (i, (first, a, worth_a)) in candidates.iter().enumerate() {
        for (second, b, worth_b) in &candidates[i + 1..] {
            if first.came_by == second.came_by {
                continue;
            }
            let together = (0..times.len())
                .filter(|k| {
                    let (p, q) = (&a[*k], &b[*k]);
                    within(p, q, TOGETHER) && within(p, &rsu, near) && within(q, &rsu, near)
                })
                .count();
            let score = together as f64 / times.len() as f64 + worth_a + worth_b;
            if best.is_none_or(|(min, _)| score > min) {
                let [worthier, other] = if worth_a < worth_b {
                    [second, first]
                } else {
                    [first, second]
                };
                best = Some((score, [worthier.number, other.number]));
            }
        }
    }
    best
}

/// Where vehicles are at some of the looks at a pair of cars.
struct Around(Vec<(usize, Vec<Pose2>)>);

impl Around {
    /// Each so many looks count.
    const EVERY: usize = 5;

    fn new(driven: &[Driven], parked: &[Standing], times: &[f64]) -> Self {
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

/// Somebody who stays where he is.
struct Standing {
    class: Class,
    size: [f64; 3],
    pose: Pose2,
}

fn stand(all: Vec<Standing>) -> impl Iterator<Item = Arrival> {
    all.into_iter()
        .map(|Standing { class, size, pose }| (None, class, size, Course::Fixed(pose)))
}

/// Cars, vans and tricycles in the bays.
fn parked(network: &Network, things: &[Footprint], seed: u64, dense: bool) -> Vec<Standing> {
    let mix = &network.mix;
    let share = mix.parked[usize::from(dense)];
    let mut all = Vec::new();
    for (index, road) in network.roads.iter().enumerate() {
        let mut draws = Stream::new(seed, "parked", index as u64);
        for (pose, angle) in road.stands() {
            let class = match draws.unit() {
                u if u < mix.vans[0] => Class::Van,
                u if u < mix.vans[0] + mix.tricycles[0] => Class::Tricycle,
                _ => Class::Car,
            };
            let size = class.labelled_size(&mut draws);
            let (taken, backwards) = (draws.chance(share), draws.chance(0.25));
            let scatter = [(); 3].map(|()| draws.normal().clamp(-2.0, 2.0));
            if !taken {
                continue;
            }
            let along = angle == 0.0;
            let turn = if backwards && !along { std::f64::consts::PI } else { 0.0 };
            // Only cars behind each other have room ahead.
            let room = if along { 0.1 } else { 0.03 };
            let stand = pose.at(room * scatter[0], 0.05 * scatter[1]);
            let pose = Pose2 {
                heading: pose.heading + turn + 0.014 * scatter[2],
                ..stand
            };
            // Where roads meet at a sharp angle, their last bays may lie in each other or end early,
            // and what grows at their edge may reach into one.
            let corners = [(0.5, 0.5), (0.5, -0.5), (-0.5, 0.5), (-0.5, -0.5)];
            let paved = corners.iter().all(|(u, v)| {
                let corner = pose.at(u * size[0], v * size[1]);
                network.surface.off_road(corner.x, corner.y) < 0.4
            });
            let meets = |(thing, extent): &Footprint| touch(pose, size, *thing, *extent);
            let parks_in = |other: &Standing| touch(pose, size, other.pose, other.size);
            if paved && !things.iter().any(meets) && !all.iter().any(parks_in) {
                all.push(Standing { class, size, pose });
            }
        }
    }
    all
}

/// People in the gaps between neighbouring bays of which one is taken: half hidden, and at least 5 cm from every vehicle.
fn between(network: &Network, parked: &[Standing], seed: u64) -> Vec<Standing> {
    const CLEAR: f64 = 0.05;
    let wider = |size: [f64; 3]| [size[0] + 2.0 * CLEAR, size[1] + 2.0 * CLEAR, size[2]];
    let mut all: Vec<Standing> = Vec::new();
    for (index, road) in network.roads.iter().enumerate() {
        let mut draws = Stream::new(seed, "between", index as u64);
        for pair in road.stands().windows(2) {
            let [(a, angle), (b, _)] = [pair[0], pair[1]];
            let (here, child) = (draws.chance(network.mix.between), draws.chance(0.25));
            let (ahead, aside, turned) = (draws.unit(), draws.between(-0.1, 0.1), draws.chance(0.5));
            let class = if child { Class::Child } else { Class::Pedestrian };
            let size = class.labelled_size(&mut draws);
            let (dx, dy) = (b.x - a.x, b.y - a.y);
            // The last bay of one side and the first of the other are no neighbours.
            if !here || dx * dx + dy * dy > 49.0 || angle_within(a.heading - b.heading).abs() > 0.5 {
                continue;
            }
            let middle = Pose2 {
                x: 0.5 * (a.x + b.x),
                y: 0.5 * (a.y + b.y),
                heading: a.heading,
            };
            // In a row of cars behind each other one looks over the road, beside them along them.
            let (at, heading) = match angle == 0.0 {
                true => (middle.at(aside, 1.3 * ahead - 0.65), std::f64::consts::FRAC_PI_2),
                false => (middle.at(3.8 * ahead - 1.9, 0.5 * aside), 0.0),
            };
            let turn = if turned { std::f64::consts::PI } else { 0.0 };
            let pose = Pose2 {
                heading: middle.heading + heading + turn,
                ..at
            };
            let near = |other: &Standing| {
                let (dx, dy) = (other.pose.x - pose.x, other.pose.y - pose.y);
                dx * dx + dy * dy < 16.0
            };
            let meets = |other: &Standing| touch(pose, wider(size), other.pose, other.size);
            if parked.iter().any(near) && !parked.iter().chain(&all).any(meets) {
                all.push(Standing { class, size, pose });
            }
        }
    }
    all
}

#[cfg(test)]
mod tests;
