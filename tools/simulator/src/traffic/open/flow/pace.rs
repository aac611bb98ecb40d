//! How fast a vehicle drives: limits, curves, lights and whoever is ahead.

use super::vehicle::Vehicle;
use super::{Flow, SIGHT, project};
use crate::traffic::following::{ASIDE, BRAKE, EMERGENCY};

impl<'a> Flow<'a> {
    /// What one would drive if nobody was there, m/s.
    pub(super) fn desired(&self, own: &Vehicle) -> f64 {
        let mut desired = f64::INFINITY;
        for leg in &own.legs[own.leg..] {
            let ahead = (leg.way[0] - own.s).max(0.0);
            if ahead > 100.0 {
                break;
            }
            let limit = (own.eager * self.lane(leg.lane).limit).min(own.top);
            desired = desired.min((limit * limit + 2.0 * 1.2 * ahead).sqrt());
        }
        for (start, radius) in own.path.arcs_from(own.s) {
            let ahead = (start - own.s - 1.0).max(0.0);
            if ahead > 100.0 {
                break;
            }
            desired = desired.min((ASIDE * radius + 2.0 * 1.5 * ahead).sqrt());
        }
        desired
    }

    /// The Intelligent Driver Model, towards whatever is ahead.
    pub(super) fn acceleration(&self, i: usize) -> f64 {
        let own = &self.vehicles[i];
        let desired = self.desired(own);
        let free = own.driver().free(desired);
        let mut min = if own.v > desired { free.max(-BRAKE) } else { free };
        if let Some((gap, v)) = self.leader(i) {
            min = min.min(own.driver().follow(desired, gap, v, 2.0));
        }
        if let Some(k) = self.gate(own) {
            let to_stop = own.legs[k].way[0] - own.front();
            if to_stop < SIGHT {
                min = min.min(own.driver().follow(desired, to_stop, 0.0, 0.8));
            }
        }
        // A lane that ends has to be left before.
        let last = own.legs[own.legs.len() - 1];
        if self.ends(last.lane) {
            // Room is left to change over from standing.
            let left = (last.way[1] - own.front() - 22.0).max(0.0);
            let most = (2.0 * BRAKE * left).sqrt();
            if own.v > most {
                min = min.min(-own.v * own.v / (2.0 * left.max(0.1)));
            }
        }
        min = min.min(self.let_in(i, desired));
        min.clamp(-EMERGENCY, own.accelerate)
    }

    /// What letting those in whose lane ends asks for; never more than comfort allows.
    fn let_in(&self, i: usize, desired: f64) -> f64 {
        let own = &self.vehicles[i];
        let lane = own.lane();
        let mut min = f64::INFINITY;
        for (from, other) in self.plan.lanes.lanes.iter().enumerate() {
            let Some((_, [begin, _])) = other.beside[0].filter(|(left, _)| *left == lane && other.next.is_empty())
            else {
                continue;
            };
            if other.exit.is_some() {
                continue;
            }
            let at = own.legs[own.leg].lane_at(own.s);
            for merging in self.on[from].iter().filter(|merging| merging.middle > begin - 20.0) {
                let pose = other.path.at(merging.middle).0;
                let there = project(&self.lane(lane).path, pose, at);
                let gap = there - at - own.length();
                if there > at && gap < 60.0 {
                    min = min.min(own.driver().follow(desired, gap.max(4.0), merging.v, 2.0).max(-1.4));
                }
            }
        }
        min
    }

    /// Bumper-to-bumper distance and speed of the nearest ahead.
    fn leader(&self, i: usize) -> Option<(f64, f64)> {
        let own = &self.vehicles[i];
        let mut nearest: Option<(f64, f64)> = None;
        let mut offer = |gap: f64, v: f64| {
            if nearest.is_none_or(|(min, _)| gap < min) {
                nearest = Some((gap, v));
            }
        };
        let front = own.front();
        for leg in own.legs[own.leg.saturating_sub(1)..].iter() {
            if leg.way[0] > front + SIGHT {
                break;
            }
            for other in self.on[leg.lane].iter().filter(|other| other.vehicle != i) {
                if leg.way_at(other.middle) > own.s {
                    offer(leg.way_at(other.rear) - front, other.v);
                }
            }
            if let Some((leaving, shift)) = leg.leaving.filter(|_| leg.way[1] > own.s) {
                // Until one has changed over, the old lane counts as well.
                let middle = leg.lane_at(own.s) + shift;
                for other in self.on[leaving].iter().filter(|other| other.vehicle != i) {
                    if other.middle > middle {
                        offer(other.rear - middle - own.length() / 2.0, other.v);
                    }
                }
            }
        }
        nearest
    }
}
