//! A vehicle, the legs of its way, and where it is on lanes.

use crate::bodies::Class;
use crate::path::{Motion, Path};
use crate::random::Stream;
use crate::traffic::Driven;
use crate::traffic::following::Driver;

/// A part of a vehicle's way that lies on a lane.
#[derive(Clone, Copy, Debug)]
pub(super) struct Leg {
    pub lane: usize,
    /// From where to where on the vehicle's way, m.
    pub way: [f64; 2],
    /// The same on the lane.
    pub on: [f64; 2],
    /// While one changes over: the lane that one comes from, and how much greater distances along it are.
    pub leaving: Option<(usize, f64)>,
}

impl Leg {
    /// Distance along the lane for one along the way.
    pub(super) fn lane_at(&self, s: f64) -> f64 {
        let [from, to] = self.way;
        let share = (s - from) / (to - from).max(1e-9);
        self.on[0] + share * (self.on[1] - self.on[0])
    }

    /// Distance along the way for one along the lane.
    pub(super) fn way_at(&self, at: f64) -> f64 {
        let [from, to] = self.on;
        let share = (at - from) / (to - from).max(1e-9);
        self.way[0] + share * (self.way[1] - self.way[0])
    }
}

pub(super) struct Vehicle {
    pub number: u64,
    pub class: Class,
    pub size: [f64; 3],
    /// The way up to where it has been chosen.
    pub path: Path,
    pub legs: Vec<Leg>,
    /// The leg that the middle is on.
    pub leg: usize,
    /// Legs up to this one (not included) may be driven on to.
    pub granted: usize,
    pub s: f64,
    pub v: f64,
    /// What it would drive at a limit of 1 m/s, and at most, m/s.
    pub eager: f64,
    pub top: f64,
    pub headway: f64,
    pub accelerate: f64,
    pub first_lane: usize,
    pub first: f64,
    pub ticks: Vec<(f64, f64)>,
    /// No change of lane before.
    pub settled: f64,
    pub gone: bool,
    pub draws: Stream,
}

impl Vehicle {
    pub(super) fn length(&self) -> f64 {
        self.size[0]
    }

    pub(super) fn front(&self) -> f64 {
        self.s + self.length() / 2.0
    }

    pub(super) fn rear(&self) -> f64 {
        self.s - self.length() / 2.0
    }

    pub(super) fn lane(&self) -> usize {
        self.legs[self.leg].lane
    }

    pub(super) fn driver(&self) -> Driver {
        Driver {
            v: self.v,
            headway: self.headway,
            accelerate: self.accelerate,
        }
    }
}

/// Somebody on a lane.
#[derive(Clone, Copy)]
pub(super) struct Occupant {
    pub vehicle: usize,
    /// Middle and rear along the lane, m.
    pub middle: f64,
    pub rear: f64,
    pub front: f64,
    pub v: f64,
}

pub(super) fn finish(vehicle: Vehicle) -> Driven {
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

/// Notes a vehicle on all lanes that it is on.
pub(super) fn note(on: &mut [Vec<Occupant>], index: usize, vehicle: &Vehicle) {
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
