//! Who comes on to the network: where, when and what.

use super::Flow;
use super::vehicle::{Leg, Vehicle};
use crate::bodies::Class;
use crate::random::Stream;
use crate::traffic::following::WARM_UP;
use crate::traffic::open::lanes::Kind;

impl<'a> Flow<'a> {
    /// Mean distance from one vehicle to the next, m.
    pub(super) fn gap(&self, lane: usize) -> f64 {
        let gap = self.plan.mix.gap[usize::from(self.plan.dense)];
        match self.lane(lane).kind {
            Kind::Cycle => 2.4 * gap,
            // Entries are less busy than what they lead to.
            Kind::Drive if self.ends(lane) => 3.0 * gap,
            _ => gap,
        }
    }

    /// Puts vehicles on a lane.
    pub(super) fn fill(&mut self, lane: usize, draws: &mut Stream) {
        let length = self.lane(lane).path.length();
        let gap = self.gap(lane);
        let mut at = length - 6.0 - draws.between(0.0, gap);
        while at > 8.0 {
            let mut vehicle = self.vehicle(lane, at, -WARM_UP);
            vehicle.v *= 0.6;
            at -= vehicle.length() + 8.0 + draws.exponential((gap - 14.0).max(2.0));
            self.vehicles.push(vehicle);
        }
    }

    pub(super) fn vehicle(&mut self, lane: usize, at: f64, t: f64) -> Vehicle {
        let number = self.next_number;
        self.next_number += 1;
        let mut draws = Stream::new(self.plan.seed, "vehicle", number);
        let class = self.class_for(lane, &mut draws);
        let size = class.labelled_size(&mut draws);
        let top = match class {
            Class::Bicycle => draws.between(3.8, 5.8),
            Class::Scooter => draws.between(5.5, 7.5),
            Class::Tricycle => draws.between(5.0, 9.0),
            Class::Truck | Class::Articulated | Class::Bus => draws.between(21.0, 24.5),
            _ => draws.between(26.0, 37.0),
        };
        let eager = draws.between(0.8, 1.08);
        let length = self.lane(lane).path.length();
        let leg = Leg {
            lane,
            way: [0.0, length],
            on: [0.0, length],
            leaving: None,
        };
        let mut vehicle = Vehicle {
            number,
            class,
            size,
            path: self.lane(lane).path.clone(),
            legs: vec![leg],
            leg: 0,
            granted: 1,
            s: at,
            v: (eager * self.lane(lane).limit).min(top) * 0.85,
            eager,
            top,
            headway: draws.between(1.0, 1.6),
            accelerate: if class.long() { 0.9 } else { draws.between(1.2, 1.8) },
            first_lane: lane,
            first: t,
            ticks: Vec::new(),
            settled: t,
            gone: false,
            draws,
        };
        self.look_ahead(&mut vehicle);
        vehicle
    }

    fn class_for(&self, number: usize, draws: &mut Stream) -> Class {
        let draw = draws.unit();
        let lane = self.lane(number);
        if lane.kind == Kind::Cycle {
            return if draw < 0.6 { Class::Bicycle } else { Class::Scooter };
        }
        let mix = self.plan.mix;
        let mixed = lane
            .road
            .is_some_and(|road| self.plan.network.roads[road].section.cycle == 0.0);
        let share = |class: Class, share: f64| match lane.outer && self.carries(class, number, 0) {
            true => share,
            false => 0.0,
        };
        let trailers = share(Class::Articulated, mix.trailers);
        let riders = if mixed && lane.outer { mix.riders } else { 0.0 };
        let shares = [
            (Class::Van, mix.vans[1]),
            (Class::Articulated, mix.long * 0.6 * trailers),
            (Class::Truck, share(Class::Truck, mix.long * 0.6 * (1.0 - trailers))),
            (Class::Bus, share(Class::Bus, mix.long * 0.4)),
            (Class::Motorcycle, 0.03),
            (Class::Tricycle, if lane.outer { mix.tricycles[1] } else { 0.0 }),
            (Class::Bicycle, riders * 0.7),
            (Class::Scooter, riders * 0.3),
        ];
        let mut sum = 0.0;
        for (class, share) in shares {
            sum += share;
            // Riders keep off fast roads.
            let slow = matches!(class, Class::Bicycle | Class::Scooter | Class::Tricycle) && lane.limit > 20.0;
            if draw < sum && !slow {
                return class;
            }
        }
        Class::Car
    }

    pub(super) fn arrive(&mut self, t: f64) {
        for index in 0..self.arrivals.len() {
            let lane = self.lane(index);
            if !lane.source || self.arrivals[index].0 > t {
                continue;
            }
            let mut vehicle = self.vehicle(index, 3.0, t);
            vehicle.s = vehicle.length() / 2.0 + 0.5;
            let reach = vehicle.length() + 6.0 + 1.3 * vehicle.v;
            // Nobody comes in where others have just come in, or are about to turn round.
            let room = |v: &Vehicle| {
                v.legs[v.leg.saturating_sub(1)..].iter().all(|leg| {
                    let beside = leg.way[0] < v.front() && leg.way[1] > v.rear();
                    let here = leg.lane == index && beside && leg.lane_at(v.rear()) < reach;
                    let lane = self.lane(leg.lane);
                    let turns = lane.kind == Kind::Loop && lane.next[0].0 == index;
                    !(here || turns && v.front() > leg.way[0] - 40.0 && v.rear() < leg.way[1] + 8.0)
                })
            };
            if !self.vehicles.iter().all(room) {
                self.next_number -= 1;
                continue;
            }
            let ahead = self.vehicles.iter().filter_map(|v| {
                let leg = &v.legs[v.leg];
                (leg.lane == index).then(|| (leg.lane_at(v.rear()), v.v))
            });
            let slowest = ahead
                .filter(|(at, _)| *at < 60.0)
                .map(|(_, v)| v)
                .fold(f64::INFINITY, f64::min);
            vehicle.v = vehicle.v.min(slowest + 3.0);
            let pause = self.gap(index) / vehicle.v.max(4.0);
            let (next, draws) = &mut self.arrivals[index];
            *next = t + 0.8 + draws.exponential(pause);
            self.vehicles.push(vehicle);
        }
    }
}
