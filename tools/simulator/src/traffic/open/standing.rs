//! Who stands: parked vehicles, and people between them.

use super::Footprint;
use crate::bodies::Class;
use crate::path::{Course, Pose2, angle_within};
use crate::place::Network;
use crate::random::Stream;
use crate::traffic::{Arrival, touch};

/// Somebody who stays where he is.
pub(super) struct Standing {
    pub class: Class,
    pub size: [f64; 3],
    pub pose: Pose2,
}

pub(super) fn stand(all: Vec<Standing>) -> impl Iterator<Item = Arrival> {
    all.into_iter()
        .map(|Standing { class, size, pose }| (None, class, size, Course::Fixed(pose)))
}

/// Cars, vans and tricycles in the bays.
pub(super) fn parked(network: &Network, things: &[Footprint], seed: u64, dense: bool) -> Vec<Standing> {
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
pub(super) fn between(network: &Network, parked: &[Standing], seed: u64) -> Vec<Standing> {
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
