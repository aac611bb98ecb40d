//! Who carries the sensors, and when they start.

use realo_schemas::{Nanos, from_seconds};

use crate::bodies::Class;
use crate::options::{Options, Phase};
use crate::path::{Course, Pose2};
use crate::place::{Scenery, VergeKind};
use crate::random::Stream;
use crate::traffic::{Traffic, User};

/// What carries an agent: a road user, or a pole at a pose and height of the ground.
#[derive(Clone, Copy)]
pub(super) enum Carrier {
    Car(usize),
    Stand((Pose2, f64)),
}

/// Road users that are cav1, cav2, …, at most `count`: the two that the traffic chose, then cars that stay for the whole
/// log, those that drive before those that are parked, nearest to the first one in the log's middle.
pub(super) fn cars(traffic: &Traffic, seconds: f64, count: usize) -> Vec<usize> {
    let mut cars: Vec<usize> = traffic.cavs.to_vec();
    if count <= cars.len() {
        return cars;
    }
    let place = |user: &User| user.course.at(0.5 * seconds).map(|state| state.pose);
    let first = place(&traffic.users[cars[0]]);
    let mut others: Vec<(bool, f64, usize)> = Vec::new();
    for (index, user) in traffic.users.iter().enumerate() {
        let stays = [-0.4, seconds + 0.4].iter().all(|t| user.course.at(*t).is_some());
        let (Some(here), Some(first)) = (place(user), first) else {
            continue;
        };
        if user.class == Class::Car && stays && !cars.contains(&index) {
            let (dx, dy) = (here.x - first.x, here.y - first.y);
            others.push((matches!(user.course, Course::Fixed(_)), dx * dx + dy * dy, index));
        }
    }
    others.sort_by(|a, b| a.0.cmp(&b.0).then(a.1.total_cmp(&b.1)).then(a.2.cmp(&b.2)));
    cars.extend(others.into_iter().map(|(.., index)| index));
    cars.truncate(count);
    cars
}

/// Where rsu1, rsu2, … stand, at most `count`: the two of the place, then beside the roads within 150 m of the first, each
/// as far from all before it as can be, looking along the road towards the first.
pub(super) fn stands(place: &Scenery, count: usize) -> Vec<(Pose2, f64)> {
    const STEP: f64 = 5.0;
    const AROUND: f64 = 150.0;
    let mut stands = vec![place.roadside(false), place.roadside(true)];
    let first = stands[0].0;
    let square = |a: Pose2, b: Pose2| (a.x - b.x) * (a.x - b.x) + (a.y - b.y) * (a.y - b.y);
    let mut free: Vec<Pose2> = Vec::new();
    for verge in place.verges.iter().filter(|verge| verge.kind != VergeKind::Kerb) {
        let spots = (verge.length() / STEP) as usize;
        free.extend((0..=spots).map(|k| verge.pose(k as f64 * STEP, 0.2)));
    }
    free.retain(|pose| square(*pose, first) < AROUND * AROUND);
    while stands.len() < count {
        let lonely = |pose: &Pose2| {
            stands
                .iter()
                .map(|(other, _)| square(*pose, *other))
                .fold(f64::MAX, f64::min)
        };
        let Some(best) = free.iter().max_by(|a, b| lonely(a).total_cmp(&lonely(b))).copied() else {
            break;
        };
        if lonely(&best) < STEP * STEP {
            break;
        }
        let (sin, cos) = libm::sincos(best.heading);
        let away = (first.x - best.x) * cos + (first.y - best.y) * sin < 0.0;
        let heading = best.heading + if away { std::f64::consts::PI } else { 0.0 };
        stands.push((Pose2 { heading, ..best }, place.walk_height(best.x, best.y)));
    }
    stands
}

/// Start of the first sweep of an agent beyond the first four; when all spread, anywhere in the period.
pub(super) fn late_phase(options: &Options, stream: usize) -> Nanos {
    let mut draws = Stream::new(options.seed, "phases", stream as u64);
    let within = match options.phase {
        Phase::Locked => 0.000_9,
        Phase::Spread => 0.1,
    };
    from_seconds(draws.between(0.0, within))
}

/// Start of the first sweep after [`EPOCH`] of cav1, cav2, rsu1 and rsu2, ns.
pub(super) fn phases(options: &Options) -> [Nanos; 4] {
    let mut draws = Stream::new(options.seed, "phases", 0);
    match options.phase {
        Phase::Locked => [(); 4].map(|()| from_seconds(draws.between(0.0, 0.000_9))),
        Phase::Spread => {
            // Slots of 25 ms, each used within 8 ms: at least 17 ms apart, over the end of the period as well.
            let mut slots = [0.0, 0.025, 0.05, 0.075];
            for i in (1..4).rev() {
                slots.swap(i, draws.below(i + 1));
            }
            slots.map(|slot| from_seconds(slot + draws.between(0.0, 0.008)))
        }
    }
}
