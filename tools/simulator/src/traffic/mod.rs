//! Everybody on the road: who there is, and where he is at any time.

mod lights;
mod network;
mod vehicles;
mod walkers;
mod zones;

use lights::Lights;
use vehicles::{Driven, TrafficPlan, drive};

use crate::Scenario;
use crate::bodies::Class;
use crate::path::{Course, Pose2, State};
use crate::place::{BAY, BAYS, Scenery};
use crate::random::Stream;
use crate::solid::Solid;

/// One road user.
pub(crate) struct User {
    /// Identity over the whole log.
    pub track: u64,
    pub class: Class,
    /// Length, width, height, m.
    pub size: [f64; 3],
    pub solid: Solid,
    pub course: Course,
}

/// All road users of a simulation.
pub(crate) struct Traffic {
    pub users: Vec<User>,
    /// Indices of the vehicles that are cav1 and cav2.
    pub cavs: [usize; 2],
}

/// Height of the ground and its slope along and across the heading, under somebody.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Footing {
    pub z: f64,
    pub slope: [f64; 2],
}

impl User {
    /// The ground under the user at a state.
    pub fn footing(&self, place: &Scenery, state: &State) -> Footing {
        footing(place, self.class, self.size, state.pose)
    }
}

/// Walkers stand upright on pavement and road; vehicles lie on the road's slope between their wheels.
pub(crate) fn footing(place: &Scenery, class: Class, size: [f64; 3], pose: Pose2) -> Footing {
    let Pose2 { x, y, heading } = pose;
    if class.walks() {
        return Footing {
            z: place.walk_height(x, y),
            slope: [0.0; 2],
        };
    }
    let (sin, cos) = libm::sincos(heading);
    let (base, track) = (0.3 * size[0], 0.4 * size[1]);
    let at = |u: f64, v: f64| place.road_height(x + u * cos - v * sin, y + u * sin + v * cos);
    let along = (at(base, 0.0) - at(-base, 0.0)) / (2.0 * base);
    let across = (at(0.0, track) - at(0.0, -track)) / (2.0 * track);
    Footing {
        z: at(0.0, 0.0),
        slope: [along, across],
    }
}

/// What the traffic of a simulation depends on.
pub(crate) struct Demand<'a> {
    pub place: &'a Scenery,
    pub seed: u64,
    pub dense: bool,
    /// Length of the log, s.
    pub seconds: f64,
}

impl Traffic {
    /// Lets everybody go about until past the log's end.
    pub fn new(demand: &Demand) -> Self {
        let Demand {
            place,
            seed,
            dense,
            seconds,
        } = *demand;
        let roads = &place.roads;
        let lights = Lights::new(roads.scenario, seed);
        let network = network::Network::new(roads);
        let until = seconds + 0.5;
        let gap = gap(roads.scenario, dense);
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
        let (traffic_seed, cavs) = choose_traffic(place, seed, seconds, |s, until| drive(&plan(s, until, &[])));
        let driven = drive(&plan(traffic_seed, until, &cavs));
        let mut crowd = Vec::new();
        for vehicle in driven {
            let cav = cavs.iter().position(|number| *number == vehicle.number);
            crowd.push((cav, vehicle.class, vehicle.size, Course::Moving(vehicle.motion)));
        }
        crowd.extend(walkers.into_iter().map(|w| (None, w.class, w.size, w.course)));
        crowd.extend(
            parked(place, seed, dense)
                .into_iter()
                .map(|(class, size, pose)| (None, class, size, Course::Fixed(pose))),
        );
        crowd.retain(|(_, _, _, course)| !over_before(course, -0.5));
        Self::assemble(crowd, seed, until)
    }

    /// Gives everybody the size that is labelled and the rounded body that sensors of newer places meet.
    pub fn round_off(&mut self, seed: u64) {
        for (index, user) in self.users.iter_mut().enumerate() {
            let mut draws = Stream::new(seed, "shape", index as u64);
            user.size = user.class.labelled_size(user.size, &mut draws);
            user.solid = user.class.shape(user.size, &mut draws);
        }
    }

    fn assemble(crowd: Vec<Arrival>, seed: u64, until: f64) -> Self {
        let kept = without_overlaps(crowd, until);
        let mut cavs = [0; 2];
        let mut users = Vec::with_capacity(kept.len());
        for (index, (cav, class, size, course)) in kept.into_iter().enumerate() {
            if let Some(cav) = cav {
                cavs[cav] = index;
            }
            let solid = class.body(size, &mut Stream::new(seed, "body", index as u64));
            users.push(User {
                track: index as u64 + 1,
                class,
                size,
                solid,
                course,
            });
        }
        Traffic { users, cavs }
    }
}

/// Mean distance from one car to the next in a lane, m.
fn gap(scenario: Scenario, dense: bool) -> f64 {
    match (scenario, dense) {
        (Scenario::Intersection, false) => 80.0,
        (Scenario::Intersection, true) => 38.0,
        (Scenario::Corridor, false) => 70.0,
        (Scenario::Corridor, true) => 27.0,
    }
}

/// Somebody before he is admitted: which cav he is, class, size, course.
type Arrival = (Option<usize>, Class, [f64; 3], Course);

fn over_before(course: &Course, t: f64) -> bool {
    match course {
        Course::Fixed(_) => false,
        Course::Moving(motion) => motion.first + motion.ticks.len() as f64 * crate::path::TICK < t,
    }
}

/// Draws traffic until two of its cars make good cavs: both near the junction, in sight of each other and of the
/// first roadside unit for most of the first ten seconds. Returns the traffic's own seed and the cars' numbers.
fn choose_traffic(place: &Scenery, seed: u64, seconds: f64, run: impl Fn(u64, f64) -> Vec<Driven>) -> (u64, [u64; 2]) {
    const GOOD: f64 = 1.05;
    const ATTEMPTS: u64 = 10;
    let horizon = seconds.min(10.0);
    let mut best = (f64::NEG_INFINITY, 0, [0; 2]);
    for attempt in 0..ATTEMPTS {
        let traffic_seed = Stream::new(seed, "traffic", attempt).bits();
        let driven = run(traffic_seed, horizon);
        if let Some((score, numbers)) = best_pair(place, &driven, horizon)
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

fn best_pair(place: &Scenery, driven: &[Driven], horizon: f64) -> Option<(f64, [u64; 2])> {
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
    let stop_distance = |vehicle: &Driven| place.roads.stop(vehicle.arm % 2);
    let approaching = |vehicle: &Driven, places: &[[f64; 2]]| {
        let along = if vehicle.arm.is_multiple_of(2) {
            places[0][0].abs()
        } else {
            places[0][1].abs()
        };
        let before = along > stop_distance(vehicle);
        let inward = match vehicle.arm {
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
        for (second, b) in candidates.iter().filter(|(vehicle, _)| vehicle.arm != first.arm) {
            let together = (0..times.len())
                .filter(|k| near(a[*k], b[*k]) && near(a[*k], [rsu.x, rsu.y]) && near(b[*k], [rsu.x, rsu.y]))
                .count();
            let share = together as f64 / times.len() as f64;
            let moving = 0.03 * gone(a).min(6.0) + 0.01 * gone(b).min(6.0);
            let score = share + moving - if approaching(second, b) { 0.0 } else { 0.15 };
            if best.is_none_or(|(least, _)| score > least) {
                best = Some((score, [first.number, second.number]));
            }
        }
    }
    best
}

/// Cars and vans in the bays.
fn parked(place: &Scenery, seed: u64, dense: bool) -> Vec<(Class, [f64; 3], Pose2)> {
    let mut all = Vec::new();
    let share = match (place.roads.scenario, dense) {
        (_, false) => 0.25,
        (Scenario::Intersection, true) => 0.45,
        (Scenario::Corridor, true) => 0.62,
    };
    for arm in place.roads.arms() {
        let axis = arm % 2;
        if !place.roads.bays[axis] {
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
                    let across = side * (place.roads.half[axis] + 0.5 * BAY + 0.02 * slack.clamp(-2.0, 2.0));
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

/// Leaves out whoever would touch somebody else at some time: a walker before a vehicle, the later before the
/// earlier, never a cav. Rare, because everybody already minds the others.
fn without_overlaps(crowd: Vec<Arrival>, until: f64) -> Vec<Arrival> {
    let mut out = vec![false; crowd.len()];
    let rank = |i: usize| (crowd[i].0.is_some(), !crowd[i].1.walks(), std::cmp::Reverse(i));
    for (i, j) in overlaps(&crowd, until) {
        if !out[i] && !out[j] {
            let loser = if rank(i) < rank(j) { i } else { j };
            out[loser] = true;
        }
    }
    let mut keep = out.iter().map(|out| !out);
    let mut crowd = crowd;
    crowd.retain(|_| keep.next().unwrap_or(true));
    crowd
}

/// Pairs that touch at some time, each with the first time's order.
fn overlaps(crowd: &[Arrival], until: f64) -> Vec<(usize, usize)> {
    let steps = ((until + 0.5) / 0.1).ceil() as usize;
    let mut pairs = Vec::new();
    for k in 0..=steps {
        let t = k as f64 * 0.1 - 0.5;
        let mut there: Vec<(usize, Pose2, [f64; 3])> = crowd
            .iter()
            .enumerate()
            .filter_map(|(i, (_, _, size, course))| course.at(t).map(|state| (i, state.pose, *size)))
            .collect();
        there.sort_by(|a, b| a.1.x.total_cmp(&b.1.x));
        for (n, (i, a, size_a)) in there.iter().enumerate() {
            for (j, b, size_b) in there[n + 1..].iter().take_while(|other| other.1.x - a.x < 13.0) {
                if touch(*a, *size_a, *b, *size_b) && !pairs.contains(&(*i.min(j), *i.max(j))) {
                    pairs.push((*i.min(j), *i.max(j)));
                }
            }
        }
    }
    pairs
}

/// Whether two footprints overlap (separating axes).
pub(crate) fn touch(a: Pose2, size_a: [f64; 3], b: Pose2, size_b: [f64; 3]) -> bool {
    let (dx, dy) = (b.x - a.x, b.y - a.y);
    let reach = |size: [f64; 3]| 0.5 * (size[0] * size[0] + size[1] * size[1]).sqrt();
    let sum = reach(size_a) + reach(size_b);
    if dx * dx + dy * dy > sum * sum {
        return false;
    }
    let (sin, cos) = libm::sincos(b.heading - a.heading);
    let (sin, cos) = (sin.abs(), cos.abs());
    let apart = |heading: f64, own: [f64; 3], other: [f64; 3]| {
        let (s, c) = libm::sincos(heading);
        let (along, across) = ((dx * c + dy * s).abs(), (dy * c - dx * s).abs());
        along > 0.5 * (own[0] + other[0] * cos + other[1] * sin)
            || across > 0.5 * (own[1] + other[0] * sin + other[1] * cos)
    };
    !apart(a.heading, size_a, size_b) && !apart(b.heading, size_b, size_a)
}

#[cfg(test)]
mod tests;
