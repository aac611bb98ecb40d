//! Traffic on roads at any angle.

mod cavs;
mod flow;
mod lanes;
mod signals;
mod standing;
mod strollers;

use flow::{FlowPlan, drive};
use lanes::Lanes;
use strollers::Ways;

use super::{Arrival, Demand};
use crate::options::Error;
use crate::path::{Course, Pose2};
use crate::place::Network;
use cavs::choose;
use standing::{between, parked, stand};

/// Middle and extent of what stands in the place.
type Footprint = (Pose2, [f64; 3]);

/// How far beyond a log its traffic goes, s.
const MARGIN: f64 = 0.5;

/// Everybody who is about until `until`.
pub(super) fn crowd(demand: &Demand, network: &Network, until: f64) -> Result<Vec<Arrival>, Error> {
    let Demand {
        place,
        seed,
        dense,
        seconds,
        ..
    } = *demand;
    let mix = &network.mix;
    let lanes = Lanes::new(network);
    let signals = flow::signals(network, seed);
    let things: Vec<Footprint> = place.fixtures.iter().map(|fixture| fixture.footprint()).collect();
    let (walkers, walked) = strollers::walk(&Ways {
        network,
        things: &things,
        crossings: &lanes.crossings,
        signals: &signals,
        seed,
        dense,
        until,
    });
    let plan = |seed: u64, until: f64, stay| FlowPlan {
        network,
        lanes: &lanes,
        signals: &signals,
        walked: &walked,
        mix,
        dense,
        seed,
        until,
        stay,
    };
    let parked = parked(network, &things, seed, dense);
    let between = between(network, &parked, seed);
    let chosen = choose(place, network, &parked, seed, seconds, |s, until| {
        drive(&plan(s, until, &[]))
    });
    let (traffic_seed, cavs) = chosen.ok_or(Error::NoRoom {
        scenario: place.scenario.name(),
        place: place.number,
        seed,
    })?;
    let mut crowd = Vec::new();
    for vehicle in drive(&plan(traffic_seed, until, &cavs)) {
        let cav = cavs.iter().position(|number| *number == vehicle.number);
        crowd.push((cav, vehicle.class, vehicle.size, Course::Moving(vehicle.motion)));
    }
    crowd.extend(walkers.into_iter().map(|w| (None, w.class, w.size, w.course)));
    crowd.extend(stand(parked));
    crowd.extend(stand(between));
    Ok(crowd)
}

#[cfg(test)]
mod tests;
