//! Changes of lane.

use super::vehicle::{Leg, Occupant};
use super::{Flow, project};
use crate::bodies::Class;
use crate::path::{Path, Pose2};

impl<'a> Flow<'a> {
    /// Changes of lane, one vehicle after the other; each is asked once a second.
    pub(super) fn change_lanes(&mut self, t: f64, tick: u64) {
        for i in 0..self.vehicles.len() {
            let own = &self.vehicles[i];
            let leg = own.legs[own.leg];
            let ends = self.ends(leg.lane);
            let asked = if ends { 2 } else { 10 };
            if !(tick + own.number).is_multiple_of(asked) || own.settled > t || own.v < 1.0 && !ends {
                continue;
            }
            if own.rear() < leg.way[0]
                || leg.leaving.is_some()
                || matches!(own.class, Class::Bicycle | Class::Scooter | Class::Tricycle)
            {
                continue;
            }
            let lane = self.lane(leg.lane);
            let now = self.acceleration(i);
            for side in 0..2 {
                let Some((target, [from, to])) = lane.beside[side] else {
                    continue;
                };
                let at = leg.lane_at(own.s);
                let length = (own.v * 3.4).max(16.0);
                // Nobody changes lanes shortly before a node.
                let margin = if ends { 2.0 } else { 45.0 };
                if at < from + 4.0 || at + length + margin > to || own.class.long() && side == 0 && !ends {
                    continue;
                }
                if self.worth_changing(i, leg, target, now, ends) {
                    self.change(i, leg, target, length, t);
                    break;
                }
            }
        }
    }

    /// Whether there is room on another lane, and more of it.
    fn worth_changing(&self, i: usize, leg: Leg, target: usize, now: f64, must: bool) -> bool {
        let own = &self.vehicles[i];
        let here = self.lane(leg.lane).path.at(leg.lane_at(own.s)).0;
        let at = project(&self.lane(target).path, here, leg.lane_at(own.s));
        let half = own.length() / 2.0;
        let mut ahead: Option<&Occupant> = None;
        let mut behind: Option<&Occupant> = None;
        for other in self.on[target].iter().filter(|other| other.vehicle != i) {
            if other.middle > at && ahead.is_none_or(|a| other.rear < a.rear) {
                ahead = Some(other);
            }
            if other.middle <= at && behind.is_none_or(|b| other.front > b.front) {
                behind = Some(other);
            }
        }
        let desired = self.desired(own);
        let mut then = own.driver().free(desired);
        if let Some(ahead) = ahead {
            let gap = ahead.rear - at - half;
            let room = if must { 0.12 } else { 0.35 };
            if gap < 3.0 + room * own.v {
                return false;
            }
            then = then.min(own.driver().follow(desired, gap, ahead.v, 2.0));
        }
        if let Some(behind) = behind {
            let follower = &self.vehicles[behind.vehicle];
            let gap = at - half - behind.front;
            let hard = if must { -3.5 } else { -1.5 };
            let room = if must { 0.1 } else { 0.25 };
            if gap < 3.0 + 0.5 * (behind.v - own.v).max(0.0) + room * behind.v
                || follower.driver().follow(self.desired(follower), gap, own.v, 2.0) < hard
            {
                return false;
            }
        }
        then > -1.8 && (must || then > now + 0.35)
    }

    /// Puts a vehicle's way over to another lane.
    fn change(&mut self, i: usize, leg: Leg, target: usize, length: f64, t: f64) {
        let new = self.lane(target);
        let own = &self.vehicles[i];
        let at = leg.lane_at(own.s);
        let mut path = own.path.part(0.0, own.s);
        let [begin, end] = cross_over(&mut path, [&self.lane(leg.lane).path, &new.path], at, length);
        let rest = new.path.length();
        let [from, over] = [own.s, path.length()];
        path.append(&new.path.part(end, rest));
        let mut legs = own.legs[..=own.leg].to_vec();
        let last = legs.len() - 1;
        legs[last] = Leg {
            way: [leg.way[0], from],
            on: [leg.on[0], at],
            ..leg
        };
        legs.push(Leg {
            lane: target,
            way: [from, over],
            on: [begin, end],
            leaving: Some((leg.lane, at - begin)),
        });
        legs.push(Leg {
            lane: target,
            way: [over, path.length()],
            on: [end, rest],
            leaving: None,
        });
        let vehicle = &mut self.vehicles[i];
        vehicle.leg = last + 1;
        vehicle.granted = legs.len();
        vehicle.legs = legs;
        vehicle.path = path;
        vehicle.settled = t + 8.0;
        let mut vehicle = self.vehicles.swap_remove(i);
        self.look_ahead(&mut vehicle);
        self.vehicles.push(vehicle);
        let last = self.vehicles.len() - 1;
        self.vehicles.swap(i, last);
        self.register();
    }
}

/// Leads a way from one lane over to another, smoothly, from `at` on the old one within a length of it; gives where on the
/// new lane it begins and ends.
fn cross_over(way: &mut Path, [old, new]: [&Path; 2], at: f64, length: f64) -> [f64; 2] {
    const STEPS: usize = 12;
    let aside = |s: f64, guess: f64| {
        let pose = old.at(s).0;
        (pose, project(new, pose, guess))
    };
    let (_, begin) = aside(at, at);
    let point = |u: f64| {
        let (pose, there) = aside(at + u * length, begin + u * length);
        let other = new.at(there).0;
        let w = u * u * u * (10.0 - 15.0 * u + 6.0 * u * u);
        (
            [pose.x + w * (other.x - pose.x), pose.y + w * (other.y - pose.y)],
            there,
        )
    };
    for k in 1..=STEPS {
        let u = k as f64 / STEPS as f64;
        let ([x, y], there) = point(u);
        let heading = if k == STEPS {
            new.at(there).0.heading
        } else {
            let ([x0, y0], _) = point(u - 0.01);
            let ([x1, y1], _) = point(u + 0.01);
            libm::atan2(y1 - y0, x1 - x0)
        };
        way.reach(Pose2 { x, y, heading });
    }
    [begin, point(1.0).1]
}
