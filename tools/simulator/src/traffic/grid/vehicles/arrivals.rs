//! Who comes, and which way he takes.

use super::{Traffic, Vehicle};
use crate::bodies::Class;
use crate::random::Stream;
use crate::traffic::following::WARM_UP;
use crate::traffic::grid::network::{Network, RoadLane, Turn};

impl<'a> Traffic<'a> {
    /// Mean distance from one vehicle to the next, m.
    pub(super) fn gap(&self, lane: &RoadLane) -> f64 {
        if lane.cycles {
            2.2 * self.plan.gap
        } else {
            self.plan.gap
        }
    }

    /// Puts vehicles on a stretch of a lane's straight way.
    pub(super) fn fill(&mut self, lane: usize, from: f64, to: f64, gap: f64, draws: &mut Stream) {
        let mut at = to - draws.between(0.0, gap);
        while at > from {
            let mut vehicle = self.vehicle(lane, -WARM_UP);
            let straight = self.plan.network.lanes[lane].ways[0];
            if at > self.plan.network.lanes[lane].stop {
                vehicle.way = straight;
                vehicle.path = self.plan.network.ways[straight].path.clone();
                vehicle.granted = false;
            }
            at -= vehicle.length / 2.0;
            vehicle.s = at;
            vehicle.v = vehicle.desired * 0.6;
            at -= vehicle.length / 2.0 + 9.0 + draws.exponential((gap - 15.0).max(2.0));
            self.vehicles.push(vehicle);
        }
    }

    pub(super) fn vehicle(&mut self, lane: usize, t: f64) -> Vehicle {
        let number = self.next_number;
        self.next_number += 1;
        let mut draws = Stream::new(self.plan.seed, "vehicle", number);
        let network = self.plan.network;
        let class = class_for(&network.lanes[lane], lane_has_middle(network, lane), &mut draws);
        let size = class.size(&mut draws);
        let desired = match class {
            Class::Bicycle => draws.between(3.6, 5.6),
            Class::Scooter => draws.between(5.5, 7.5),
            Class::Truck | Class::Bus => draws.between(8.5, 11.5),
            _ => draws.between(9.5, 13.5),
        };
        let way = choose_way(network, lane, class, &mut draws);
        Vehicle {
            number,
            class,
            length: size[0],
            size,
            way,
            leg: 0.0,
            path: network.ways[way].path.clone(),
            s: size[0] / 2.0,
            v: desired * 0.8,
            desired,
            headway: draws.between(1.0, 1.6),
            accelerate: if class.long() { 0.9 } else { draws.between(1.2, 1.8) },
            granted: false,
            first_arm: network.lanes[lane].arm,
            first: t,
            ticks: Vec::new(),
            gone: false,
            draws,
        }
    }

    pub(super) fn arrive(&mut self, t: f64) {
        for index in 0..self.arrivals.len() {
            if self.arrivals[index].0 > t {
                continue;
            }
            let lane = &self.plan.network.lanes[index];
            let room = |v: &Vehicle| self.way(v).lane != index || v.rear() > 16.0 + v.desired;
            let turning = |v: &Vehicle| {
                let way = self.way(v);
                self.stays(v) && way.exit_arm == lane.arm && v.at() > way.path.length() - 40.0
            };
            if !self.vehicles.iter().all(|v| room(v) && !turning(v)) {
                continue;
            }
            let vehicle = self.vehicle(index, t);
            let pause = self.gap(lane) / vehicle.desired;
            let (next, draws) = &mut self.arrivals[index];
            *next = t + 1.0 + draws.exponential(pause);
            self.vehicles.push(vehicle);
        }
    }
}

/// Whether lanes lie between this one and the road's middle.
fn lane_has_middle(network: &Network, lane: usize) -> bool {
    let own = &network.lanes[lane];
    network
        .lanes
        .iter()
        .any(|other| other.arm == own.arm && other.offset < own.offset)
}

fn class_for(lane: &RoadLane, outer: bool, draws: &mut Stream) -> Class {
    let draw = draws.unit();
    if lane.cycles {
        return if draw < 0.6 { Class::Bicycle } else { Class::Scooter };
    }
    match draw {
        d if d < 0.10 => Class::Van,
        d if d < 0.13 => Class::Motorcycle,
        d if d < 0.19 && outer => Class::Truck,
        d if d < 0.25 && outer => Class::Bus,
        _ => Class::Car,
    }
}

pub(super) fn choose_way(network: &Network, lane: usize, class: Class, draws: &mut Stream) -> usize {
    let ways = &network.lanes[lane].ways;
    let draw = draws.unit();
    let turn = match draw {
        d if d < 0.16 => Turn::Left,
        d if d < 0.36 => Turn::Right,
        _ => Turn::Straight,
    };
    let chosen = ways
        .iter()
        .find(|way| network.ways[**way].turn == turn && !class.long());
    *chosen.unwrap_or(&ways[0])
}
