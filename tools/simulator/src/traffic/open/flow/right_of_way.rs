//! Who has to wait for whom, and for walkers.

use super::Flow;
use super::vehicle::Vehicle;
use crate::traffic::following::ASIDE;

impl<'a> Flow<'a> {
    /// Whether a walker is on the crossings of a turn, or will be before its end is reached.
    pub(super) fn walkers_on(&self, i: usize, k: usize, t: f64) -> bool {
        let own = &self.vehicles[i];
        let lane = self.lane(own.legs[k].lane);
        if lane.over.is_empty() {
            return false;
        }
        let seconds = self.time_to_clear(own, k);
        lane.over.iter().any(|over| {
            self.plan.walked.iter().any(|walked| {
                walked.crossing == over.crossing
                    && walked.until + 0.3 > t
                    && walked.from - 0.5 < t + seconds
                    && walked.share[0] < over.share[1]
                    && over.share[0] < walked.share[1]
            })
        })
    }

    /// Whether somebody who goes first would be held up.
    pub(super) fn must_yield(&self, i: usize, k: usize, t: f64) -> bool {
        let own = &self.vehicles[i];
        let lane = self.lane(own.legs[k].lane);
        if lane.conflicts.iter().all(|conflict| !conflict.yields) {
            return false;
        }
        let seconds = self.time_to_clear(own, k) + 0.6;
        self.vehicles.iter().enumerate().any(|(j, other)| {
            if j == i || other.v < 0.8 {
                return false;
            }
            let coming = other
                .legs
                .iter()
                .enumerate()
                .skip(other.leg)
                .take_while(|(_, leg)| leg.way[0] < other.front() + 90.0);
            coming.into_iter().any(|(_, leg)| {
                let Some(conflict) = lane.conflicts.iter().find(|c| c.other == leg.lane && c.yields) else {
                    return false;
                };
                let distance = leg.way[0] + conflict.theirs[0] - other.front();
                let passed = other.rear() > leg.way[0] + conflict.theirs[1];
                !passed && distance < seconds * other.v.max(2.0) && self.open(leg.lane, t)
            })
        })
    }

    /// A careful guess of the time until the rear has left a turn, s.
    fn time_to_clear(&self, own: &Vehicle, k: usize) -> f64 {
        let leg = own.legs[k];
        let lane = self.lane(leg.lane);
        let curve = (ASIDE * lane.tightest).sqrt();
        let top = (own.eager * lane.limit).min(own.top).min(0.85 * curve).max(1.5);
        let mut left = (leg.way[1] - own.rear()).max(0.0);
        let (mut v, mut t) = (own.v.min(top), 0.0);
        while left > 0.0 && t < 30.0 {
            v = (v + 0.4).min(top);
            left -= v * 0.5;
            t += 0.5;
        }
        t + 1.0
    }
}
