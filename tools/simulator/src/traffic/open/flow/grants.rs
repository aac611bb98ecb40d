//! Grants: who may drive on to a turn, and until when.

use super::Flow;
use super::vehicle::Vehicle;
use crate::traffic::following::BRAKE;
use crate::traffic::open::lanes::Kind;

impl<'a> Flow<'a> {
    /// The next leg that needs a grant: its number.
    pub(super) fn gate(&self, vehicle: &Vehicle) -> Option<usize> {
        let first = vehicle.granted.max(vehicle.leg + 1);
        (first..vehicle.legs.len()).find(|k| {
            let kind = self.lane(vehicle.legs[*k].lane).kind;
            matches!(kind, Kind::Turn { .. } | Kind::Loop)
        })
    }

    /// Whether the lights let somebody on to a turn.
    pub(super) fn open(&self, lane: usize, t: f64) -> bool {
        let Kind::Turn { node, arm } = self.lane(lane).kind else {
            return true;
        };
        let phase = self.plan.network.nodes[node].arms[arm].phase;
        self.plan.signals[node]
            .as_ref()
            .is_none_or(|signals| signals.green(phase, t))
    }

    /// Takes back grants of those who can still stop and should.
    pub(super) fn review_grants(&mut self, t: f64) {
        for i in 0..self.vehicles.len() {
            let vehicle = &self.vehicles[i];
            let first = vehicle.leg + 1;
            for k in first..vehicle.granted.min(vehicle.legs.len()) {
                let leg = vehicle.legs[k];
                if !matches!(self.lane(leg.lane).kind, Kind::Turn { .. }) {
                    continue;
                }
                let to_stop = leg.way[0] - vehicle.front();
                let stops = to_stop > 0.5 && vehicle.v * vehicle.v / (2.0 * 2.6) < to_stop - 0.5;
                if stops && (!self.open(leg.lane, t) || self.walkers_on(i, k, t)) {
                    self.vehicles[i].granted = k;
                    break;
                }
            }
        }
        self.register();
    }

    pub(super) fn give_grants(&mut self, t: f64) {
        let mut order: Vec<(f64, usize, usize)> = Vec::new();
        for (i, vehicle) in self.vehicles.iter().enumerate() {
            if let Some(k) = self.gate(vehicle) {
                order.push((vehicle.legs[k].way[0] - vehicle.front(), i, k));
            }
        }
        order.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        for (to_gate, i, k) in order {
            if self.may_enter(i, k, to_gate, t) {
                let vehicle = &mut self.vehicles[i];
                vehicle.granted = k + 1;
                let rear = vehicle.rear() - vehicle.legs[k].way[0];
                let lane = vehicle.legs[k].lane;
                self.held[lane].push((i, rear));
            }
        }
    }

    fn may_enter(&self, i: usize, k: usize, to_gate: f64, t: f64) -> bool {
        let own = &self.vehicles[i];
        let leg = own.legs[k];
        let lane = self.lane(leg.lane);
        let horizon = own.v * own.v / (2.0 * BRAKE) + own.v * 1.2 + 8.0;
        if to_gate > horizon || !self.open(leg.lane, t) || self.leader_waits(i, k) {
            return false;
        }
        if lane.kind == Kind::Loop {
            let back = lane.next[0].0;
            let room = self.on[back].iter().all(|other| other.rear > own.length() + 14.0);
            return room && self.held[leg.lane].is_empty();
        }
        let taken = lane.conflicts.iter().any(|conflict| {
            let holds = |(other, rear): &(usize, f64)| *other != i && *rear < conflict.theirs[1] + 0.5;
            self.held[conflict.other].iter().any(holds)
        });
        !taken && self.exit_free(i, k) && !self.walkers_on(i, k, t) && !self.must_yield(i, k, t)
    }

    /// Whether somebody ahead on the lane before a gate has no grant for his own.
    fn leader_waits(&self, i: usize, k: usize) -> bool {
        let own = &self.vehicles[i];
        let before = own.legs[k - 1];
        let middle = before.lane_at(own.s);
        self.on[before.lane].iter().any(|other| {
            if other.vehicle == i || other.middle <= middle {
                return false;
            }
            let vehicle = &self.vehicles[other.vehicle];
            let on = vehicle.lane() == before.lane;
            on && self.gate(vehicle).is_some_and(|gate| gate == vehicle.leg + 1)
        })
    }

    /// Whether there is room behind a turn, so that nobody stands in the node.
    fn exit_free(&self, i: usize, k: usize) -> bool {
        let own = &self.vehicles[i];
        let end = own.legs[k].way[1];
        let mut nearest: Option<(f64, f64)> = None;
        for leg in own.legs[k..].iter().take(3) {
            for other in self.on[leg.lane].iter().filter(|other| other.vehicle != i) {
                let rear = leg.way_at(other.rear);
                if nearest.is_none_or(|(min, _)| rear < min) {
                    nearest = Some((rear, other.v));
                }
            }
        }
        nearest.is_none_or(|(rear, v)| rear > end + own.length() + 2.5 || v > 3.0)
    }
}
