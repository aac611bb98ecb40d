//! Everything that drives on a network: car following, changes of lane, lights and right of way.
//!
//! Nobody drives on to a turn without a *grant*. A grant is given where the lights allow it, no other grant is on a
//! conflicting turn, nobody who goes first would be held up, no walker is about to cross, and there is room behind the
//! node. It ends, conflict by conflict, when the rear has passed.

use super::lanes::{Kind, Lane, Lanes};
use super::signals::Signals;
use crate::bodies::Class;
use crate::path::{Motion, Path, Pose2, TICK};
use crate::place::{Control, Network, TrafficMix};
use crate::random::Stream;
use crate::traffic::Driven;

/// Seconds simulated before the log begins.
pub(super) const WARM_UP: f64 = 45.0;
/// What comfort allows in braking and in curves, m/s².
const BRAKE: f64 = 2.0;
const ASIDE: f64 = 2.6;
/// Hardest braking, m/s².
const EMERGENCY: f64 = 8.0;
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

/// A part of a vehicle's way that lies on a lane.
#[derive(Clone, Copy, Debug)]
struct Leg {
    lane: usize,
    /// From where to where on the vehicle's way, m.
    way: [f64; 2],
    /// The same on the lane.
    on: [f64; 2],
    /// While one changes over: the lane that one comes from, and how much greater distances along it are.
    leaving: Option<(usize, f64)>,
}

impl Leg {
    /// Distance along the lane for one along the way.
    fn lane_at(&self, s: f64) -> f64 {
        let [from, to] = self.way;
        let share = (s - from) / (to - from).max(1e-9);
        self.on[0] + share * (self.on[1] - self.on[0])
    }

    /// Distance along the way for one along the lane.
    fn way_at(&self, at: f64) -> f64 {
        let [from, to] = self.on;
        let share = (at - from) / (to - from).max(1e-9);
        self.way[0] + share * (self.way[1] - self.way[0])
    }
}

struct Vehicle {
    number: u64,
    class: Class,
    size: [f64; 3],
    /// The way up to where it has been chosen.
    path: Path,
    legs: Vec<Leg>,
    /// The leg that the middle is on.
    leg: usize,
    /// Legs up to this one (not included) may be driven on to.
    granted: usize,
    s: f64,
    v: f64,
    /// What it would drive at a limit of 1 m/s, and at most, m/s.
    eager: f64,
    top: f64,
    headway: f64,
    accelerate: f64,
    first_lane: usize,
    first: f64,
    ticks: Vec<(f64, f64)>,
    /// No change of lane before.
    settled: f64,
    gone: bool,
    draws: Stream,
}

impl Vehicle {
    fn length(&self) -> f64 {
        self.size[0]
    }

    fn front(&self) -> f64 {
        self.s + self.length() / 2.0
    }

    fn rear(&self) -> f64 {
        self.s - self.length() / 2.0
    }

    fn lane(&self) -> usize {
        self.legs[self.leg].lane
    }
}

/// Somebody on a lane.
#[derive(Clone, Copy)]
struct Occupant {
    vehicle: usize,
    /// Middle and rear along the lane, m.
    middle: f64,
    rear: f64,
    front: f64,
    v: f64,
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

fn finish(vehicle: Vehicle) -> Driven {
    Driven {
        number: vehicle.number,
        class: vehicle.class,
        size: vehicle.size,
        came_by: vehicle.first_lane,
        motion: Motion {
            path: vehicle.path,
            first: vehicle.first,
            ticks: vehicle.ticks,
        },
    }
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

    fn lane(&self, index: usize) -> &'a Lane {
        &self.plan.lanes.lanes[index]
    }

    /// Mean distance from one vehicle to the next, m.
    fn gap(&self, lane: usize) -> f64 {
        let gap = self.plan.mix.gap[usize::from(self.plan.dense)];
        match self.lane(lane).kind {
            Kind::Cycle => 2.4 * gap,
            // Entries are less busy than what they lead to.
            Kind::Drive if self.ends(lane) => 3.0 * gap,
            _ => gap,
        }
    }

    /// Whether one has to change over from a lane because nothing goes on from it.
    fn ends(&self, lane: usize) -> bool {
        let lane = self.lane(lane);
        lane.exit.is_none() && lane.next.is_empty()
    }

    /// Puts vehicles on a lane.
    fn fill(&mut self, lane: usize, draws: &mut Stream) {
        let length = self.lane(lane).path.length();
        let gap = self.gap(lane);
        let mut at = length - 6.0 - draws.between(0.0, gap);
        while at > 8.0 {
            let mut vehicle = self.vehicle(lane, at, -WARM_UP);
            vehicle.v *= 0.6;
            at -= vehicle.length() + 8.0 + draws.exponential((gap - 14.0).max(2.0));
            self.vehicles.push(vehicle);
        }
    }

    fn vehicle(&mut self, lane: usize, at: f64, t: f64) -> Vehicle {
        let number = self.next_number;
        self.next_number += 1;
        let mut draws = Stream::new(self.plan.seed, "vehicle", number);
        let class = self.class_for(lane, &mut draws);
        let size = class.labelled_size(&mut draws);
        let top = match class {
            Class::Bicycle => draws.between(3.8, 5.8),
            Class::Scooter => draws.between(5.5, 7.5),
            Class::Tricycle => draws.between(5.0, 9.0),
            Class::Truck | Class::Articulated | Class::Bus => draws.between(21.0, 24.5),
            _ => draws.between(26.0, 37.0),
        };
        let eager = draws.between(0.8, 1.08);
        let length = self.lane(lane).path.length();
        let leg = Leg {
            lane,
            way: [0.0, length],
            on: [0.0, length],
            leaving: None,
        };
        let mut vehicle = Vehicle {
            number,
            class,
            size,
            path: self.lane(lane).path.clone(),
            legs: vec![leg],
            leg: 0,
            granted: 1,
            s: at,
            v: (eager * self.lane(lane).limit).min(top) * 0.85,
            eager,
            top,
            headway: draws.between(1.0, 1.6),
            accelerate: if class.long() { 0.9 } else { draws.between(1.2, 1.8) },
            first_lane: lane,
            first: t,
            ticks: Vec::new(),
            settled: t,
            gone: false,
            draws,
        };
        self.look_ahead(&mut vehicle);
        vehicle
    }

    fn class_for(&self, number: usize, draws: &mut Stream) -> Class {
        let draw = draws.unit();
        let lane = self.lane(number);
        if lane.kind == Kind::Cycle {
            return if draw < 0.6 { Class::Bicycle } else { Class::Scooter };
        }
        let mix = self.plan.mix;
        let mixed = lane
            .road
            .is_some_and(|road| self.plan.network.roads[road].section.cycle == 0.0);
        let share = |class: Class, share: f64| match lane.outer && self.carries(class, number, 0) {
            true => share,
            false => 0.0,
        };
        let trailers = share(Class::Articulated, mix.trailers);
        let riders = if mixed && lane.outer { mix.riders } else { 0.0 };
        let shares = [
            (Class::Van, mix.vans[1]),
            (Class::Articulated, mix.long * 0.6 * trailers),
            (Class::Truck, share(Class::Truck, mix.long * 0.6 * (1.0 - trailers))),
            (Class::Bus, share(Class::Bus, mix.long * 0.4)),
            (Class::Motorcycle, 0.03),
            (Class::Tricycle, if lane.outer { mix.tricycles[1] } else { 0.0 }),
            (Class::Bicycle, riders * 0.7),
            (Class::Scooter, riders * 0.3),
        ];
        let mut sum = 0.0;
        for (class, share) in shares {
            sum += share;
            // Riders keep off fast roads.
            let slow = matches!(class, Class::Bicycle | Class::Scooter | Class::Tricycle) && lane.limit > 20.0;
            if draw < sum && !slow {
                return class;
            }
        }
        Class::Car
    }

    /// Whether a lane and some way on from it are wide and straight enough for a class.
    fn carries(&self, class: Class, lane: usize, passed: usize) -> bool {
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
    fn look_ahead(&self, vehicle: &mut Vehicle) {
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

    fn choose(&self, lane: &Lane, vehicle: &mut Vehicle) -> Option<usize> {
        let fits = |next: &&(usize, f64)| self.carries(vehicle.class, next.0, 0);
        let mut all: Vec<(usize, f64)> = lane.next.iter().filter(fits).copied().collect();
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

    fn step(&mut self, t: f64, tick: u64) {
        self.arrive(t);
        self.register();
        self.review_grants(t);
        self.give_grants(t);
        self.change_lanes(t, tick);
        let accelerations: Vec<f64> = (0..self.vehicles.len()).map(|i| self.acceleration(i)).collect();
        for (vehicle, acceleration) in self.vehicles.iter_mut().zip(accelerations) {
            vehicle.ticks.push((vehicle.s, vehicle.v));
            advance(vehicle, acceleration);
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

    fn arrive(&mut self, t: f64) {
        for index in 0..self.arrivals.len() {
            let lane = self.lane(index);
            if !lane.source || self.arrivals[index].0 > t {
                continue;
            }
            let mut vehicle = self.vehicle(index, 3.0, t);
            vehicle.s = vehicle.length() / 2.0 + 0.5;
            let reach = vehicle.length() + 6.0 + 1.3 * vehicle.v;
            // Nobody comes in where others have just come in, or are about to turn round.
            let room = |v: &Vehicle| {
                v.legs[v.leg.saturating_sub(1)..].iter().all(|leg| {
                    let beside = leg.way[0] < v.front() && leg.way[1] > v.rear();
                    let here = leg.lane == index && beside && leg.lane_at(v.rear()) < reach;
                    let lane = self.lane(leg.lane);
                    let turns = lane.kind == Kind::Loop && lane.next[0].0 == index;
                    !(here || turns && v.front() > leg.way[0] - 40.0 && v.rear() < leg.way[1] + 8.0)
                })
            };
            if !self.vehicles.iter().all(room) {
                self.next_number -= 1;
                continue;
            }
            let ahead = self.vehicles.iter().filter_map(|v| {
                let leg = &v.legs[v.leg];
                (leg.lane == index).then(|| (leg.lane_at(v.rear()), v.v))
            });
            let slowest = ahead
                .filter(|(at, _)| *at < 60.0)
                .map(|(_, v)| v)
                .fold(f64::INFINITY, f64::min);
            vehicle.v = vehicle.v.min(slowest + 3.0);
            let pause = self.gap(index) / vehicle.v.max(4.0);
            let (next, draws) = &mut self.arrivals[index];
            *next = t + 0.8 + draws.exponential(pause);
            self.vehicles.push(vehicle);
        }
    }

    /// The next leg that needs a grant: its number.
    fn gate(&self, vehicle: &Vehicle) -> Option<usize> {
        let first = vehicle.granted.max(vehicle.leg + 1);
        (first..vehicle.legs.len()).find(|k| {
            let kind = self.lane(vehicle.legs[*k].lane).kind;
            matches!(kind, Kind::Turn { .. } | Kind::Loop)
        })
    }

    /// Whether the lights let somebody on to a turn.
    fn open(&self, lane: usize, t: f64) -> bool {
        let Kind::Turn { node, arm } = self.lane(lane).kind else {
            return true;
        };
        let phase = self.plan.network.nodes[node].arms[arm].phase;
        self.plan.signals[node]
            .as_ref()
            .is_none_or(|signals| signals.green(phase, t))
    }

    /// Takes back grants of those who can still stop and should.
    fn review_grants(&mut self, t: f64) {
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

    fn give_grants(&mut self, t: f64) {
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

    /// Whether a walker is on the crossings of a turn, or will be before its end is reached.
    fn walkers_on(&self, i: usize, k: usize, t: f64) -> bool {
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
    fn must_yield(&self, i: usize, k: usize, t: f64) -> bool {
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

    /// What one would drive if nobody was there, m/s.
    fn desired(&self, own: &Vehicle) -> f64 {
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
    fn acceleration(&self, i: usize) -> f64 {
        let own = &self.vehicles[i];
        let desired = self.desired(own);
        let ratio = own.v / desired;
        let free = own.accelerate * (1.0 - ratio * ratio * ratio * ratio);
        let mut min = if own.v > desired { free.max(-BRAKE) } else { free };
        if let Some((gap, v)) = self.leader(i) {
            min = min.min(follow(own, desired, gap, v, 2.0));
        }
        if let Some(k) = self.gate(own) {
            let to_stop = own.legs[k].way[0] - own.front();
            if to_stop < SIGHT {
                min = min.min(follow(own, desired, to_stop, 0.0, 0.8));
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
                    min = min.min(follow(own, desired, gap.max(4.0), merging.v, 2.0).max(-1.4));
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

    /// Changes of lane, one vehicle after the other; each is asked once a second.
    fn change_lanes(&mut self, t: f64, tick: u64) {
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
        let ratio = own.v / desired;
        let mut then = own.accelerate * (1.0 - ratio * ratio * ratio * ratio);
        if let Some(ahead) = ahead {
            let gap = ahead.rear - at - half;
            let room = if must { 0.12 } else { 0.35 };
            if gap < 3.0 + room * own.v {
                return false;
            }
            then = then.min(follow(own, desired, gap, ahead.v, 2.0));
        }
        if let Some(behind) = behind {
            let follower = &self.vehicles[behind.vehicle];
            let gap = at - half - behind.front;
            let hard = if must { -3.5 } else { -1.5 };
            let room = if must { 0.1 } else { 0.25 };
            if gap < 3.0 + 0.5 * (behind.v - own.v).max(0.0) + room * behind.v
                || follow(follower, self.desired(follower), gap, own.v, 2.0) < hard
            {
                return false;
            }
        }
        then > -1.8 && (must || then > now + 0.35)
    }

    /// Puts a vehicle's way over to another lane.
    fn change(&mut self, i: usize, leg: Leg, target: usize, length: f64, t: f64) {
        const STEPS: usize = 12;
        let (old, new) = (self.lane(leg.lane), self.lane(target));
        let own = &self.vehicles[i];
        let at = leg.lane_at(own.s);
        let aside = |s: f64, guess: f64| {
            let pose = old.path.at(s).0;
            let there = project(&new.path, pose, guess);
            (pose, there)
        };
        let (_, begin) = aside(at, at);
        let point = |u: f64| {
            let (pose, there) = aside(at + u * length, begin + u * length);
            let other = new.path.at(there).0;
            let w = u * u * u * (10.0 - 15.0 * u + 6.0 * u * u);
            (
                [pose.x + w * (other.x - pose.x), pose.y + w * (other.y - pose.y)],
                there,
            )
        };
        let mut path = own.path.part(0.0, own.s);
        for k in 1..=STEPS {
            let u = k as f64 / STEPS as f64;
            let ([x, y], there) = point(u);
            let heading = if k == STEPS {
                new.path.at(there).0.heading
            } else {
                let ([x0, y0], _) = point(u - 0.01);
                let ([x1, y1], _) = point(u + 0.01);
                libm::atan2(y1 - y0, x1 - x0)
            };
            path.reach(Pose2 { x, y, heading });
        }
        let (_, end) = point(1.0);
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

/// Notes a vehicle on all lanes that it is on.
fn note(on: &mut [Vec<Occupant>], index: usize, vehicle: &Vehicle) {
    let (rear, front) = (vehicle.rear(), vehicle.front());
    for leg in &vehicle.legs[vehicle.leg.saturating_sub(2)..] {
        if leg.way[0] > front {
            break;
        }
        if leg.way[1] < rear {
            continue;
        }
        let occupant = Occupant {
            vehicle: index,
            middle: leg.lane_at(vehicle.s),
            rear: leg.lane_at(rear),
            front: leg.lane_at(front),
            v: vehicle.v,
        };
        on[leg.lane].push(occupant);
        if let Some((leaving, shift)) = leg.leaving {
            on[leaving].push(Occupant {
                vehicle: index,
                middle: occupant.middle + shift,
                rear: occupant.rear + shift,
                front: occupant.front + shift,
                v: vehicle.v,
            });
        }
    }
}

/// Distance along a path of the point beside a pose.
fn project(path: &Path, pose: Pose2, guess: f64) -> f64 {
    path.project(pose.x, pose.y, guess.clamp(0.0, path.length())).0
}

/// Deceleration (or less) that following somebody asks for.
fn follow(own: &Vehicle, desired: f64, gap: f64, leader_speed: f64, standstill: f64) -> f64 {
    let gap = gap.max(0.05);
    let closing = own.v * (own.v - leader_speed) / (2.0 * (own.accelerate * BRAKE).sqrt());
    let wanted = standstill + (own.v * own.headway * if standstill < 1.0 { 0.3 } else { 1.0 } + closing).max(0.0);
    let ratio = own.v / desired;
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

/// Lights of all nodes that have some.
pub(super) fn signals(network: &Network, seed: u64) -> Vec<Option<Signals>> {
    network
        .nodes
        .iter()
        .enumerate()
        .map(|(n, node)| (node.control == Control::Signals).then(|| Signals::new(seed, n)))
        .collect()
}
