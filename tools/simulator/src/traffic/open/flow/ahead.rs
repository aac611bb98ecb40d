//! The way on: which lanes a vehicle takes next.

use super::vehicle::{Leg, Vehicle};
use super::{Flow, SIGHT, SLOW};
use crate::bodies::Class;
use crate::traffic::open::lanes::RoadLane;

impl<'a> Flow<'a> {
    /// Whether a lane and some way on from it are wide and straight enough for a class.
    pub(super) fn carries(&self, class: Class, lane: usize, passed: usize) -> bool {
        const FARTHEST: usize = 8;
        let tightest = match class {
            // Bodies are rigid: their ends swing out.
            Class::Articulated => 66.0,
            Class::Bus => 16.0,
            Class::Truck => 11.0,
            _ => return true,
        };
        let own = self.lane(lane);
        let on = |next: &(usize, f64)| self.carries(class, next.0, passed + 1);
        passed < FARTHEST
            && own.tightest > tightest
            && own.limit >= SLOW
            && (own.exit.is_some() || own.next.iter().any(on))
    }

    /// Chooses the way on until it reaches beyond sight.
    pub(super) fn look_ahead(&self, vehicle: &mut Vehicle) {
        while vehicle.path.length() < vehicle.s + SIGHT + 20.0 {
            let last = vehicle.legs[vehicle.legs.len() - 1];
            let lane = self.lane(last.lane);
            let stays = self.plan.stay.contains(&vehicle.number);
            let next = match lane.exit {
                Some(Some(back)) if stays => Some(back),
                Some(_) => None,
                None => self.choose(lane, vehicle),
            };
            let Some(next) = next else { return };
            let path = &self.lane(next).path;
            let from = vehicle.path.length();
            vehicle.path.append(path);
            vehicle.legs.push(Leg {
                lane: next,
                way: [from, from + path.length()],
                on: [0.0, path.length()],
                leaving: None,
            });
        }
    }

    /// Whether a lane is of the ring, or a turn on to it.
    fn leads_on(&self, lane: usize) -> bool {
        let of_ring = |lane: &RoadLane| lane.road.is_some_and(|road| self.plan.network.ring.contains(&road));
        let lane = self.lane(lane);
        of_ring(lane) || lane.road.is_none() && lane.next.iter().any(|next| of_ring(self.lane(next.0)))
    }

    fn choose(&self, lane: &RoadLane, vehicle: &mut Vehicle) -> Option<usize> {
        let fits = |next: &&(usize, f64)| self.carries(vehicle.class, next.0, 0);
        let mut all: Vec<(usize, f64)> = lane.next.iter().filter(fits).copied().collect();
        if self.plan.network.keeps_to_ring(self.plan.seed, vehicle.number) {
            let on: Vec<(usize, f64)> = all.iter().filter(|next| self.leads_on(next.0)).copied().collect();
            all = if on.is_empty() { all } else { on };
        }
        if all.is_empty() {
            let widest = lane
                .next
                .iter()
                .max_by(|a, b| self.lane(a.0).tightest.total_cmp(&self.lane(b.0).tightest));
            all.extend(widest.copied());
        }
        let sum: f64 = all.iter().map(|(_, weight)| weight).sum();
        let mut draw = vehicle.draws.unit() * sum;
        for (next, weight) in &all {
            draw -= weight;
            if draw < 0.0 {
                return Some(*next);
            }
        }
        all.last().map(|(next, _)| *next)
    }
}
