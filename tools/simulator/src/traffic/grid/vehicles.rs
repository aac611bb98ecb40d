//! Everything that drives: car following, lights, and the right of way in the junction.
//!
//! Nobody enters the junction without a *grant*: its light is green and its way meets neither that of another grant
//! nor a walker's crossing. A grant ends when the rear has left the junction.

mod arrivals;
mod grants;
mod pace;

use std::f64::consts::PI;

use super::lights::Lights;
use super::network::{Network, RoadLane, Way};
use super::zones::Zone;
use crate::bodies::Class;
use crate::path::{Motion, Path, TICK};
use crate::place::REACH;
use crate::random::Stream;
use crate::traffic::Driven;
use crate::traffic::following::{Driver, WARM_UP, advance};
use arrivals::choose_way;

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

    fn driver(&self) -> Driver {
        Driver {
            v: self.v,
            headway: self.headway,
            accelerate: self.accelerate,
        }
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

    fn step(&mut self, t: f64) {
        self.arrive(t);
        self.review_grants(t);
        self.give_grants(t);
        let accelerations: Vec<f64> = (0..self.vehicles.len()).map(|i| self.acceleration(i)).collect();
        for (vehicle, acceleration) in self.vehicles.iter_mut().zip(accelerations) {
            vehicle.ticks.push((vehicle.s, vehicle.v));
            advance(&mut vehicle.s, &mut vehicle.v, acceleration);
        }
        self.leave();
    }

    fn way(&self, vehicle: &Vehicle) -> &'a Way {
        &self.plan.network.ways[vehicle.way]
    }

    fn lane(&self, vehicle: &Vehicle) -> &'a RoadLane {
        &self.plan.network.lanes[self.way(vehicle).lane]
    }

    fn stays(&self, vehicle: &Vehicle) -> bool {
        self.plan.stay.contains(&vehicle.number)
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
