//! Traffic of the two places on a grid.

mod lights;
mod network;
mod vehicles;
mod walkers;
mod zones;

use lights::Lights;
use vehicles::{TrafficPlan, drive};

use super::{Arrival, Demand, Driven};
use crate::bodies::Class;
use crate::path::{Course, Pose2};
use crate::place::{BAY, BAYS, Grid, Roads, Scenery};
use crate::random::Stream;

/// Everybody who is about until `until`.
pub(super) fn crowd(demand: &Demand, roads: &Roads, until: f64) -> Vec<Arrival> {
    let Demand {
        place,
        seed,
        dense,
        seconds,
        ..
    } = *demand;
    let lights = Lights::new(roads.grid, seed);
    let network = network::Network::new(roads);
    let gap = gap(roads.grid, dense);
    let (walkers, crossings) = walkers::walk(roads, &lights, seed, dense, until);
    let plan = |seed: u64, until: f64, stay| TrafficPlan {
        network: &network,
        lights: &lights,
        crossings: &crossings,
        seed,
        gap,
        until,
        stay,
    };
    let (traffic_seed, cavs) = choose_traffic(place, roads, seed, seconds, |s, until| drive(&plan(s, until, &[])));
    let driven = drive(&plan(traffic_seed, until, &cavs));
    let mut crowd = Vec::new();
    for vehicle in driven {
        let cav = cavs.iter().position(|number| *number == vehicle.number);
        crowd.push((cav, vehicle.class, vehicle.size, Course::Moving(vehicle.motion)));
    }
    crowd.extend(walkers.into_iter().map(|w| (None, w.class, w.size, w.course)));
    crowd.extend(
        parked(roads, seed, dense)
            .into_iter()
            .map(|(class, size, pose)| (None, class, size, Course::Fixed(pose))),
    );
    crowd
}

/// Mean distance from one car to the next in a lane, m.
fn gap(grid: Grid, dense: bool) -> f64 {
    match (grid, dense) {
        (Grid::Intersection, false) => 80.0,
        (Grid::Intersection, true) => 38.0,
        (Grid::Corridor, false) => 70.0,
        (Grid::Corridor, true) => 27.0,
    }
}

/// Draws traffic until two of its cars make good cavs: both near the junction, in sight of each other and of the
/// first roadside unit for most of the first ten seconds. Returns the traffic's own seed and the cars' numbers.
fn choose_traffic(
    place: &Scenery,
    roads: &Roads,
    seed: u64,
    seconds: f64,
    run: impl Fn(u64, f64) -> Vec<Driven>,
) -> (u64, [u64; 2]) {
    const GOOD: f64 = 1.05;
    const ATTEMPTS: u64 = 10;
    let horizon = seconds.min(10.0);
    let mut best = (f64::NEG_INFINITY, 0, [0; 2]);
    for attempt in 0..ATTEMPTS {
        let traffic_seed = Stream::new(seed, "traffic", attempt).bits();
        let driven = run(traffic_seed, horizon);
        if let Some((score, numbers)) = best_pair(place, roads, &driven, horizon)
            && score > best.0
        {
            best = (score, traffic_seed, numbers);
        }
        if best.0 >= GOOD {
            break;
        }
    }
    (best.1, best.2)
}

fn best_pair(place: &Scenery, roads: &Roads, driven: &[Driven], horizon: f64) -> Option<(f64, [u64; 2])> {
    let (rsu, _) = place.roadside(false);
    let times: Vec<f64> = (0..=20).map(|k| horizon * f64::from(k) / 20.0).collect();
    let track = |vehicle: &Driven| -> Option<Vec<[f64; 2]>> {
        let course = Course::Moving(vehicle.motion.clone());
        times
            .iter()
            .map(|t| course.at(*t).map(|state| [state.pose.x, state.pose.y]))
            .collect()
    };
    let candidates: Vec<(&Driven, Vec<[f64; 2]>)> = driven
        .iter()
        .filter(|vehicle| vehicle.class == Class::Car)
        .filter_map(|vehicle| track(vehicle).map(|places| (vehicle, places)))
        .collect();
    let near = |a: [f64; 2], b: [f64; 2]| (a[0] - b[0]) * (a[0] - b[0]) + (a[1] - b[1]) * (a[1] - b[1]) < 65.0 * 65.0;
    let gone = |places: &[[f64; 2]]| {
        let steps = places
            .windows(2)
            .map(|p| ((p[1][0] - p[0][0]).abs() + (p[1][1] - p[0][1]).abs()).min(20.0));
        steps.sum::<f64>() / horizon
    };
    let stop_distance = |vehicle: &Driven| roads.stop(vehicle.came_by % 2);
    let approaching = |vehicle: &Driven, places: &[[f64; 2]]| {
        let along = if vehicle.came_by.is_multiple_of(2) {
            places[0][0].abs()
        } else {
            places[0][1].abs()
        };
        let before = along > stop_distance(vehicle);
        let inward = match vehicle.came_by {
            0 => places[0][0] > 0.0,
            1 => places[0][1] > 0.0,
            2 => places[0][0] < 0.0,
            _ => places[0][1] < 0.0,
        };
        before && inward
    };
    let mut best: Option<(f64, [u64; 2])> = None;
    for (first, a) in candidates
        .iter()
        .filter(|(vehicle, places)| approaching(vehicle, places))
    {
        for (second, b) in candidates
            .iter()
            .filter(|(vehicle, _)| vehicle.came_by != first.came_by)
        {
            let together = (0..times.len())
                .filter(|k| near(a[*k], b[*k]) && near(a[*k], [rsu.x, rsu.y]) && near(b[*k], [rsu.x, rsu.y]))
                .count();
            let share = together as f64 / times.len() as f64;
            let moving = 0.03 * gone(a).min(6.0) + 0.01 * gone(b).min(6.0);
            let score = share + moving - if approaching(second, b) { 0.0 } else { 0.15 };
            if best.is_none_or(|(min, _)| score > min) {
                best = Some((score, [first.number, second.number]));
            }
        }
    }
    best
}

/// Cars and vans in the bays.
fn parked(roads: &Roads, seed: u64, dense: bool) -> Vec<(Class, [f64; 3], Pose2)> {
    let mut all = Vec::new();
    let share = match (roads.grid, dense) {
        (_, false) => 0.25,
        (Grid::Intersection, true) => 0.45,
        (Grid::Corridor, true) => 0.62,
    };
    for arm in roads.arms() {
        let axis = arm % 2;
        if !roads.bays[axis] {
            continue;
        }
        for side in [-1.0, 1.0] {
            let mut draws = Stream::new(seed, "parked", 2 * *arm as u64 + u64::from(side > 0.0));
            let outward = *arm as f64 * std::f64::consts::FRAC_PI_2;
            let (sin, cos) = libm::sincos(outward);
            let mut along = BAYS[0] + 0.8;
            loop {
                let class = if draws.chance(0.14) { Class::Van } else { Class::Car };
                let size = class.size(&mut draws);
                let (gap, slack, turn) = (draws.between(0.7, 1.8), draws.normal(), draws.normal());
                along += size[0] / 2.0;
                if along + size[0] / 2.0 > BAYS[1] - 0.5 {
                    break;
                }
                if draws.chance(share) {
                    let across = side * (roads.half[axis] + 0.5 * BAY + 0.02 * slack.clamp(-2.0, 2.0));
                    // Traffic on the left of an outward view comes in.
                    let heading = outward + if side > 0.0 { std::f64::consts::PI } else { 0.0 };
                    let pose = Pose2 {
                        x: along * cos - across * sin,
                        y: along * sin + across * cos,
                        heading: heading + 0.008 * turn.clamp(-2.0, 2.0),
                    };
                    all.push((class, size, pose));
                }
                along += size[0] / 2.0 + gap;
            }
        }
    }
    all
}

#[cfg(test)]
mod tests;
