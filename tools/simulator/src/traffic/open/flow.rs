//! Everything that drives on a network: car following, changes of lane, lights and right of way.
//!
//! Nobody drives on to a turn without a *grant*. A grant is given where the lights allow it, no other grant is on a
//! conflicting turn, nobody who goes first would be held up, no walker is about to cross, and there is room behind the
//! node. It ends, conflict by conflict, when the rear has passed.

mod ahead;
mod arrivals;
mod grants;
mod overtaking;
mod pace;
mod right_of_way;
mod vehicle;

use super::lanes::{Kind, Lanes, RoadLane};
use super::signals::Signals;
use crate::path::{Path, Pose2, TICK};
use crate::place::{Control, Network, TrafficMix};
use crate::random::Stream;
use crate::traffic::Driven;
use crate::traffic::following::{WARM_UP, advance};
use vehicle::{Occupant, Vehicle, finish, note};

/// Trucks and buses keep to roads with at least this limit, m/s.
const SLOW: f64 = 6.5;
/// How far ahead one looks, m.
const SIGHT: f64 = 140.0;

/// Somebody is on a part of a pedestrian crossing for some time.
#[derive(Clone, Copy, Debug)]
pub(super) struct Walked {
    pub crossing: usize,
    /// Share of the crossing, from the arm's left to its right.
    pub share: [f64; 2],
    pub from: f64,
    pub until: f64,
}

/// What the traffic is made of.
pub(super) struct FlowPlan<'a> {
    pub network: &'a Network,
    pub lanes: &'a Lanes,
    /// Lights by node.
    pub signals: &'a [Option<Signals>],
    pub walked: &'a [Walked],
    pub mix: &'a TrafficMix,
    pub dense: bool,
    pub seed: u64,
    pub until: f64,
    /// Vehicles (by number) that turn round at the ends of the roads.
    pub stay: &'a [u64],
}

/// Simulates the traffic from `-WARM_UP` to `plan.until`.
pub(super) fn drive(plan: &FlowPlan) -> Vec<Driven> {
    let mut flow = Flow::new(plan);
    let steps = ((plan.until + WARM_UP) / TICK).round() as i64;
    for step in 0..=steps {
        flow.step(step as f64 * TICK - WARM_UP, step as u64);
    }
    let mut driven: Vec<Driven> = flow.left;
    driven.extend(flow.vehicles.into_iter().map(finish));
    driven.sort_by_key(|vehicle| vehicle.number);
    driven
}

struct Flow<'a> {
    plan: &'a FlowPlan<'a>,
    vehicles: Vec<Vehicle>,
    left: Vec<Driven>,
    /// By lane: next arrival and its draws.
    arrivals: Vec<(f64, Stream)>,
    /// Who is on a lane.
    on: Vec<Vec<Occupant>>,
    /// Who holds a grant for a turn, and where along it his rear is.
    held: Vec<Vec<(usize, f64)>>,
    next_number: u64,
}

impl<'a> Flow<'a> {
    fn new(plan: &'a FlowPlan) -> Self {
        let count = plan.lanes.lanes.len();
        let mut flow = Flow {
            plan,
            vehicles: Vec::new(),
            left: Vec::new(),
            arrivals: Vec::new(),
            on: vec![Vec::new(); count],
            held: vec![Vec::new(); count],
            next_number: 0,
        };
        for index in 0..count {
            let mut draws = Stream::new(plan.seed, "arrivals", index as u64);
            let lane = flow.lane(index);
            if matches!(lane.kind, Kind::Drive | Kind::Cycle) && lane.road.is_some() {
                flow.fill(index, &mut draws);
            }
            let pause = flow.gap(index) / (0.7 * flow.lane(index).limit).min(9.0);
            flow.arrivals.push((-WARM_UP + draws.exponential(pause), draws));
        }
        flow
    }

    fn lane(&self, index: usize) -> &'a RoadLane {
        &self.plan.lanes.lanes[index]
    }

    /// Whether one has to change over from a lane because nothing goes on from it.
    fn ends(&self, lane: usize) -> bool {
        let lane = self.lane(lane);
        lane.exit.is_none() && lane.next.is_empty()
    }

    fn step(&mut self, t: f64, tick: u64) {
        self.arrive(t);
        self.register();
        self.review_grants(t);
        self.give_grants(t);
        self.change_lanes(t, tick);
        let accelerations: Vec<f64> = (0..self.vehicles.len()).map(|i| self.acceleration(i)).collect();
        for (vehicle, acceleration) in self.vehicles.iter_mut().zip(accelerations) {
            vehicle.ticks.push((vehicle.s, vehicle.v));
            advance(&mut vehicle.s, &mut vehicle.v, acceleration);
        }
        self.move_on();
    }

    /// Notes who is where.
    fn register(&mut self) {
        for list in &mut self.on {
            list.clear();
        }
        for list in &mut self.held {
            list.clear();
        }
        for (index, vehicle) in self.vehicles.iter().enumerate() {
            note(&mut self.on, index, vehicle);
            for (number, leg) in vehicle.legs.iter().enumerate() {
                let turn = matches!(self.plan.lanes.lanes[leg.lane].kind, Kind::Turn { .. } | Kind::Loop);
                if turn && number < vehicle.granted && vehicle.rear() < leg.way[1] {
                    self.held[leg.lane].push((index, vehicle.rear() - leg.way[0]));
                }
            }
        }
    }

    /// Who has come to a new leg, and who has left.
    fn move_on(&mut self) {
        let mut vehicles = std::mem::take(&mut self.vehicles);
        for vehicle in &mut vehicles {
            while vehicle.leg + 1 < vehicle.legs.len() && vehicle.s >= vehicle.legs[vehicle.leg].way[1] {
                vehicle.leg += 1;
            }
            vehicle.granted = vehicle.granted.max(vehicle.leg + 1);
            self.look_ahead(vehicle);
            let last = vehicle.legs[vehicle.legs.len() - 1];
            let leaves = self.lane(last.lane).exit.is_some();
            vehicle.gone = leaves && vehicle.front() >= last.way[1];
        }
        let (gone, here): (Vec<_>, Vec<_>) = vehicles.into_iter().partition(|vehicle| vehicle.gone);
        self.left.extend(gone.into_iter().map(finish));
        self.vehicles = here;
    }
}

/// Distance along a path of the point beside a pose.
fn project(path: &Path, pose: Pose2, guess: f64) -> f64 {
    path.project(pose.x, pose.y, guess.clamp(0.0, path.length())).0
}

/// Lights of all nodes that have some.
pub(super) fn signals(network: &Network, seed: u64) -> Vec<Option<Signals>> {
    network
        .nodes
        .iter()
        .enumerate()
        .map(|(n, node)| (node.control == Control::Signals).then(|| Signals::new(seed, n)))
        .collect()
}
