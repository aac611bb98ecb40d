//! Grants: who may enter the junction.

use super::{Crossing, Traffic, Vehicle};
use crate::traffic::following::BRAKE;
use crate::traffic::grid::lights::Light;
use crate::traffic::grid::network::{RoadLane, Turn, Way};

impl<'a> Traffic<'a> {
    /// Takes back grants that are over, and those of vehicles that can still stop for a light that is no longer green.
    pub(super) fn review_grants(&mut self, t: f64) {
        for i in 0..self.vehicles.len() {
            let vehicle = &self.vehicles[i];
            if !vehicle.granted {
                continue;
            }
            let (way, lane) = (self.way(vehicle), self.lane(vehicle));
            let to_stop = lane.stop - vehicle.front();
            let stops = to_stop > 0.3 && vehicle.v * vehicle.v / (2.0 * 2.8) < to_stop - 0.3;
            if vehicle.rear() > way.clear || stops && !self.open(lane, way, t) {
                self.vehicles[i].granted = false;
            }
        }
    }

    pub(super) fn give_grants(&mut self, t: f64) {
        let waiting = |v: &Vehicle| !v.granted && v.front() <= self.lane(v).stop + 0.01;
        let mut order: Vec<usize> = (0..self.vehicles.len())
            .filter(|i| waiting(&self.vehicles[*i]))
            .collect();
        // The nearest of each lane asks first; at equal distance the older one.
        order.sort_by(|a, b| {
            let left = |i: usize| self.lane(&self.vehicles[i]).stop - self.vehicles[i].front();
            left(*a).total_cmp(&left(*b)).then(a.cmp(b))
        });
        let mut asked = vec![false; self.plan.network.lanes.len()];
        for i in order {
            let lane = self.way(&self.vehicles[i]).lane;
            // Nobody overtakes the first of his lane.
            let first = !std::mem::replace(&mut asked[lane], true) || self.granted_ahead(i);
            if first && self.may_enter(i, t) {
                self.vehicles[i].granted = true;
                asked[lane] = false;
            }
        }
    }

    /// Whether all that are ahead in the lane have their grants.
    fn granted_ahead(&self, i: usize) -> bool {
        let own = &self.vehicles[i];
        let lane = self.way(own).lane;
        self.vehicles.iter().all(|v| {
            self.way(v).lane != lane || v.at() <= own.at() || v.granted || v.front() > self.lane(v).stop + 0.01
        })
    }

    /// Whether the lights let somebody set out.
    fn open(&self, lane: &RoadLane, way: &Way, t: f64) -> bool {
        let axis = lane.arm % 2;
        self.plan.lights.show(axis, t) == Light::Green || way.turn == Turn::Left && self.plan.lights.arrow(axis, t)
    }

    fn may_enter(&self, i: usize, t: f64) -> bool {
        let own = &self.vehicles[i];
        let (way, lane) = (self.way(own), self.lane(own));
        let to_stop = lane.stop - own.front();
        let horizon = own.v * own.v / (2.0 * BRAKE) + own.v * 1.2 + 8.0;
        if to_stop > horizon || !self.open(lane, way, t) {
            return false;
        }
        let taken = self.vehicles.iter().enumerate().any(|(j, other)| {
            let theirs = self.way(other);
            j != i && other.granted && other.way != own.way && theirs.zone.meets(&way.zone)
        });
        !taken && self.exit_free(i) && !self.walkers_in(way, t, time_to_clear(own, way)) && !self.must_yield(i, t)
    }

    /// Whether the exit has room, so that nobody stands in the junction.
    fn exit_free(&self, i: usize) -> bool {
        let own = &self.vehicles[i];
        let way = self.way(own);
        self.vehicles.iter().enumerate().all(|(j, other)| {
            let theirs = self.way(other);
            let beyond = other.rear() - theirs.clear;
            let merges = theirs.exit == way.exit && (other.way != own.way || other.at() > own.at());
            j == i
                || !merges
                || !(-30.0..own.length + 4.0).contains(&beyond)
                || other.v > 3.0
                || other.at() < self.lane(other).stop
        })
    }

    fn walkers_in(&self, way: &Way, t: f64, seconds: f64) -> bool {
        let meets = |c: &&Crossing| c.until + 0.3 > t && c.from - 0.5 < t + seconds;
        self.plan
            .crossings
            .iter()
            .filter(meets)
            .any(|crossing| crossing.zone.meets(&way.zone))
    }

    /// Whether a left turn would cut off oncoming traffic that has green.
    fn must_yield(&self, i: usize, t: f64) -> bool {
        let own = &self.vehicles[i];
        let (way, lane) = (self.way(own), self.lane(own));
        way.turn == Turn::Left
            && self.vehicles.iter().any(|other| {
                let (theirs, from) = (self.way(other), self.lane(other));
                let left = from.stop - other.front();
                from.arm == (lane.arm + 2) % 4
                    && theirs.turn != Turn::Left
                    && theirs.zone.meets(&way.zone)
                    && (0.0..40.0).contains(&left)
                    && left < 4.5 * other.v
                    && self.plan.lights.show(from.arm % 2, t) == Light::Green
            })
    }
}

/// A careful guess of the time until the rear has left the junction, s.
fn time_to_clear(own: &Vehicle, way: &Way) -> f64 {
    let top = own.desired.min(if way.turn == Turn::Straight { 8.0 } else { 4.0 });
    let mut left = (way.clear - own.rear()).max(0.0);
    let (mut v, mut t) = (own.v.min(top), 0.0);
    while left > 0.0 {
        v = (v + 0.4).min(top);
        left -= v * 0.5;
        t += 0.5;
    }
    t + 1.5
}
