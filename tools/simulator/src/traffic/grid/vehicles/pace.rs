//! How fast a vehicle drives, by what is ahead.

use super::{Traffic, Vehicle};
use crate::traffic::following::{ASIDE, BRAKE, EMERGENCY};

impl<'a> Traffic<'a> {
    /// The Intelligent Driver Model, towards whatever is ahead.
    pub(super) fn acceleration(&self, i: usize) -> f64 {
        let own = &self.vehicles[i];
        let (way, lane) = (self.way(own), self.lane(own));
        let mut desired = own.desired;
        for (start, radius) in own.path.arcs_from(own.s).take(3) {
            let ahead = (start - own.s - 1.0).max(0.0);
            desired = desired.min((ASIDE * radius + 2.0 * 1.5 * ahead).sqrt());
        }
        let free = own.driver().free(desired);
        let mut min = if own.v > desired { free.max(-BRAKE) } else { free };
        for (j, other) in self.vehicles.iter().enumerate() {
            if let Some(gap) = (j != i).then(|| self.gap_to(own, other)).flatten() {
                min = min.min(own.driver().follow(own.desired, gap, other.v, 2.0));
            }
        }
        let to_stop = lane.stop - own.front();
        if !own.granted && to_stop > -0.5 {
            min = min.min(own.driver().follow(own.desired, to_stop, 0.0, 0.8));
        }
        let to_loop = way.path.length() - 6.0 - own.front();
        if self.stays(own) && to_loop > -1.0 && self.loop_taken(i) {
            min = min.min(own.driver().follow(own.desired, to_loop, 0.0, 0.8));
        }
        min.clamp(-EMERGENCY, own.accelerate)
    }

    /// Bumper-to-bumper distance to somebody who is ahead on the way, m.
    fn gap_to(&self, own: &Vehicle, other: &Vehicle) -> Option<f64> {
        let (way, theirs) = (self.way(own), self.way(other));
        let half = (own.length + other.length) / 2.0;
        let same_way = own.way == other.way;
        let behind_stop = other.rear() < self.lane(other).stop + 1.0;
        let mut nearest = None::<f64>;
        let mut offer = |distance: f64| {
            if distance > 0.0 && distance < 120.0 {
                nearest = Some(nearest.map_or(distance - half, |n| n.min(distance - half)));
            }
        };
        if same_way || way.lane == theirs.lane && behind_stop {
            offer(other.at() - own.at());
        }
        if way.exit == theirs.exit && !same_way && other.front() > theirs.clear - 6.0 {
            offer(other.at() - theirs.path.length() - (own.at() - way.path.length()));
        }
        // Who turns round comes in by a lane again.
        if self.stays(own) && way.exit_arm == self.plan.network.lanes[theirs.lane].arm {
            offer(other.at() + own.path.length() - own.s);
        }
        nearest
    }

    /// Whether the turning loop at the end of an arm, or the lane behind it, is taken.
    fn loop_taken(&self, i: usize) -> bool {
        let arm = self.way(&self.vehicles[i]).exit_arm;
        self.vehicles.iter().enumerate().any(|(j, other)| {
            let way = self.way(other);
            let in_loop = self.stays(other) && way.exit_arm == arm && other.at() > way.path.length() - 4.0;
            let behind_it = self.plan.network.lanes[way.lane].arm == arm && other.rear() < 8.0;
            j != i && (in_loop || behind_it)
        })
    }
}
