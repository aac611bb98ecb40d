//! Everything that drives: car following, lights, and the right of way in the junction.
//!
//! Nobody enters the junction without a *grant*: its light is green and its way meets neither that of another grant
//! nor a walker's crossing. A grant ends when the rear has left the junction.

use std::f64::consts::PI;

use super::lights::{Light, Lights};
use super::network::{Lane, Network, Turn, Way};
use super::zones::Zone;
use crate::bodies::Class;
use crate::path::{Motion, Path, TICK};
use crate::place::REACH;
use crate::random::Stream;
use crate::traffic::Driven;

/// Seconds simulated before the log begins.
pub(crate) const WARM_UP: f64 = 45.0;
/// What comfort allows in braking and in curves, m/s².
const BRAKE: f64 = 2.0;
const ASIDE: f64 = 2.6;
/// Hardest braking, m/s².
const EMERGENCY: f64 = 8.0;

/// Somebody crosses a part of the junction on foot.
#[derive(Clone, Debug)]
pub(crate) struct Crossing {
    pub zone: Zone,
    pub from: f64,
    pub until: f64,
}

/// What the traffic is made of.
pub(crate) struct TrafficPlan<'a> {
    pub network: &'a Network,
    pub lights: &'a Lights,
    pub crossings: &'a [Crossing],
    pub seed: u64,
    /// Mean distance from one car to the next, m.
    pub gap: f64,
    pub until: f64,
    /// Vehicles (by number) that turn round at the ends of the roads.
    pub stay: &'a [u64],
}

struct Vehicle {
    number: u64,
    class: Class,
    length: f64,
    size: [f64; 3],
    way: usize,
    /// Distance along `path` at which the present way began.
    leg: f64,
    path: Path,
    s: f64,
    v: f64,
    desired: f64,
    headway: f64,
    accelerate: f64,
    granted: bool,
    first_arm: usize,
    first: f64,
    ticks: Vec<(f64, f64)>,
    gone: bool,
    draws: Stream,
}

impl Vehicle {
    /// Distance along the present way.
    fn at(&self) -> f64 {
        self.s - self.leg
    }

    fn front(&self) -> f64 {
        self.at() + self.length / 2.0
    }

    fn rear(&self) -> f64 {
        self.at() - self.length / 2.0
    }
}

/// Simulates the traffic from `-WARM_UP` to `plan.until`.
pub(crate) fn drive(plan: &TrafficPlan) -> Vec<Driven> {
    let mut traffic = Traffic::new(plan);
    let steps = ((plan.until + WARM_UP) / TICK).round() as i64;
    for step in 0..=steps {
        let t = step as f64 * TICK - WARM_UP;
        traffic.step(t);
    }
    let mut driven: Vec<Driven> = traffic.left;
    driven.extend(traffic.vehicles.into_iter().map(finish));
    driven.sort_by_key(|vehicle| vehicle.number);
    driven
}

fn finish(vehicle: Vehicle) -> Driven {
    let motion = Motion {
        path: vehicle.path,
        first: vehicle.first,
        ticks: vehicle.ticks,
    };
    Driven {
        number: vehicle.number,
        class: vehicle.class,
        size: vehicle.size,
        motion,
        came_by: vehicle.first_arm,
    }
}

struct Traffic<'a> {
    plan: &'a TrafficPlan<'a>,
    vehicles: Vec<Vehicle>,
    left: Vec<Driven>,
    /// Next arrival on each lane, and the lane's draws.
    arrivals: Vec<(f64, Stream)>,
    next_number: u64,
}

impl<'a> Traffic<'a> {
    fn new(plan: &'a TrafficPlan) -> Self {
        let mut traffic = Traffic {
            plan,
            vehicles: Vec::new(),
            left: Vec::new(),
            arrivals: Vec::new(),
            next_number: 0,
        };
        for (index, lane) in plan.network.lanes.iter().enumerate() {
            let mut draws = Stream::new(plan.seed, "arrivals", index as u64);
            let gap = traffic.gap(lane);
            let behind = plan.network.ways[lane.ways[0]].clear + 8.0;
            traffic.fill(index, 12.0, lane.stop - 12.0, gap, &mut draws);
            traffic.fill(index, behind, 2.0 * REACH - 10.0, gap * 1.2, &mut draws);
            let first = -WARM_UP + draws.exponential(gap / 8.0);
            traffic.arrivals.push((first, draws));
        }
        traffic
    }

    /// Mean distance from one vehicle to the next, m.
    fn gap(&self, lane: &Lane) -> f64 {
        if lane.cycles {
            2.2 * self.plan.gap
        } else {
            self.plan.gap
        }
    }

    /// Puts vehicles on a stretch of a lane's straight way.
    fn fill(&mut self, lane: usize, from: f64, to: f64, gap: f64, draws: &mut Stream) {
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

    fn vehicle(&mut self, lane: usize, t: f64) -> Vehicle {
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

    fn step(&mut self, t: f64) {
        self.arrive(t);
        self.review_grants(t);
        self.give_grants(t);
        let accelerations: Vec<f64> = (0..self.vehicles.len()).map(|i| self.acceleration(i)).collect();
        for (vehicle, acceleration) in self.vehicles.iter_mut().zip(accelerations) {
            vehicle.ticks.push((vehicle.s, vehicle.v));
            advance(vehicle, acceleration);
        }
        self.leave();
    }

    fn way(&self, vehicle: &Vehicle) -> &'a Way {
        &self.plan.network.ways[vehicle.way]
    }

    fn lane(&self, vehicle: &Vehicle) -> &'a Lane {
        &self.plan.network.lanes[self.way(vehicle).lane]
    }

    fn stays(&self, vehicle: &Vehicle) -> bool {
        self.plan.stay.contains(&vehicle.number)
    }

    fn arrive(&mut self, t: f64) {
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

    /// Takes back grants that are over, and those of vehicles that can still stop for a light that is no longer green.
    fn review_grants(&mut self, t: f64) {
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

    fn give_grants(&mut self, t: f64) {
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
    fn open(&self, lane: &Lane, way: &Way, t: f64) -> bool {
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

    /// The Intelligent Driver Model, towards whatever is ahead.
    fn acceleration(&self, i: usize) -> f64 {
        let own = &self.vehicles[i];
        let (way, lane) = (self.way(own), self.lane(own));
        let mut desired = own.desired;
        for (start, radius) in own.path.arcs_from(own.s).take(3) {
            let ahead = (start - own.s - 1.0).max(0.0);
            desired = desired.min((ASIDE * radius + 2.0 * 1.5 * ahead).sqrt());
        }
        let free =
            own.accelerate * (1.0 - (own.v / desired) * (own.v / desired) * (own.v / desired) * (own.v / desired));
        let mut min = if own.v > desired { free.max(-BRAKE) } else { free };
        for (j, other) in self.vehicles.iter().enumerate() {
            if let Some(gap) = (j != i).then(|| self.gap_to(own, other)).flatten() {
                min = min.min(follow(own, gap, other.v, 2.0));
            }
        }
        let to_stop = lane.stop - own.front();
        if !own.granted && to_stop > -0.5 {
            min = min.min(follow(own, to_stop, 0.0, 0.8));
        }
        let to_loop = way.path.length() - 6.0 - own.front();
        if self.stays(own) && to_loop > -1.0 && self.loop_taken(i) {
            min = min.min(follow(own, to_loop, 0.0, 0.8));
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

    fn leave(&mut self) {
        for i in 0..self.vehicles.len() {
            let (vehicle, way) = (&self.vehicles[i], self.way(&self.vehicles[i]));
            let end = way.path.length();
            if !self.stays(vehicle) {
                self.vehicles[i].gone = vehicle.at() + vehicle.length / 2.0 >= end;
            } else if vehicle.s >= vehicle.path.length() {
                self.begin_leg(i);
            } else if vehicle.path.length() - vehicle.leg - end < 1e-6 && vehicle.at() > end - 60.0 {
                self.extend_by_loop(i);
            }
        }
        let (gone, here): (Vec<_>, Vec<_>) = std::mem::take(&mut self.vehicles).into_iter().partition(|v| v.gone);
        self.left.extend(gone.into_iter().map(finish));
        self.vehicles = here;
    }

    /// Adds the loop from the exit lane to the outermost driving lane of the same arm.
    fn extend_by_loop(&mut self, i: usize) {
        const RADIUS: f64 = 6.0;
        let way = self.way(&self.vehicles[i]);
        let back = self.lane_back(way.exit_arm);
        let aside = way.exit_offset + self.plan.network.lanes[back].offset;
        let angle = libm::acos(((aside / RADIUS + 2.0) / 4.0).min(1.0));
        let path = &mut self.vehicles[i].path;
        path.arc(RADIUS, -angle)
            .arc(RADIUS, PI + 2.0 * angle)
            .arc(RADIUS, -angle);
    }

    /// The outermost driving lane that comes in by an arm.
    fn lane_back(&self, arm: usize) -> usize {
        let lanes = &self.plan.network.lanes;
        (0..lanes.len())
            .rev()
            .find(|i| lanes[*i].arm == arm && !lanes[*i].cycles)
            .expect("an arm with an exit has lanes")
    }

    fn begin_leg(&mut self, i: usize) {
        let network = self.plan.network;
        let lane = self.lane_back(self.way(&self.vehicles[i]).exit_arm);
        let vehicle = &mut self.vehicles[i];
        vehicle.way = choose_way(network, lane, vehicle.class, &mut vehicle.draws);
        vehicle.leg = vehicle.path.length();
        vehicle.granted = false;
        vehicle.path.append(&network.ways[vehicle.way].path);
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

fn class_for(lane: &Lane, outer: bool, draws: &mut Stream) -> Class {
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

fn choose_way(network: &Network, lane: usize, class: Class, draws: &mut Stream) -> usize {
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

/// Deceleration (or less) that following somebody asks for.
fn follow(own: &Vehicle, gap: f64, leader_speed: f64, standstill: f64) -> f64 {
    let gap = gap.max(0.05);
    let closing = own.v * (own.v - leader_speed) / (2.0 * (own.accelerate * BRAKE).sqrt());
    let wanted = standstill + (own.v * own.headway * if standstill < 1.0 { 0.3 } else { 1.0 } + closing).max(0.0);
    let ratio = own.v / own.desired;
    own.accelerate * (1.0 - ratio * ratio * ratio * ratio - (wanted / gap) * (wanted / gap))
}

/// Moves on by a tick; nobody rolls backwards.
fn advance(vehicle: &mut Vehicle, acceleration: f64) {
    let v = vehicle.v + acceleration * TICK;
    if v >= 0.0 {
        vehicle.s += 0.5 * (vehicle.v + v) * TICK;
        vehicle.v = v;
    } else {
        vehicle.s += vehicle.v * vehicle.v / (-2.0 * acceleration);
        vehicle.v = 0.0;
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
