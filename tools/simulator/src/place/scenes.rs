//! The places with roads at any angle, each drawn anew for every number.

mod avenue;
mod block;
mod car_park;
mod crossings;
mod curve;
mod lines;
mod market;
mod motorway;
mod residential;
mod rural;
mod stand;

use std::f64::consts::{FRAC_PI_2, PI};

use super::network::{Bays, Builder, Control, Merge, Network, SIDES, TrafficMix};
use super::surface::Surface;
use super::verge::VergeKind;
use crate::Scenario;
use crate::path::Path;
use crate::random::Stream;
use avenue::avenue;
use block::block;
use car_park::car_park;
use crossings::{junction, roundabout, tee};
use curve::curve;
use market::market;
use motorway::motorway;
use residential::residential;
use rural::rural;
use stand::Stand;

/// How far roads reach from the place's middle, m.
const REACH: f64 = 195.0;

const KMH: f64 = 1.0 / 3.6;

/// A plan and what else the place needs to know.
pub(crate) struct Scene {
    pub network: Network,
    /// Slope of the whole place along x and y.
    pub grade: [f64; 2],
    /// Metres between the nodes of its terrain.
    pub cell: f64,
}

/// Draws the plan of a place.
pub(crate) fn scene(scenario: Scenario, number: u64) -> Scene {
    let mut draws = Stream::new(number, "network", scenario as u64);
    let draft = match scenario {
        Scenario::Tee => tee(&mut draws),
        Scenario::Roundabout => roundabout(&mut draws),
        Scenario::Curve => curve(&mut draws),
        Scenario::Residential => residential(&mut draws),
        Scenario::Motorway => motorway(&mut draws),
        Scenario::CarPark => car_park(&mut draws),
        Scenario::Avenue => avenue(&mut draws),
        Scenario::Rural => rural(&mut draws),
        Scenario::Market => market(&mut draws),
        Scenario::Loop => block(&mut draws),
        _ => junction(&mut draws),
    };
    let Draft {
        mut builder,
        mix,
        kerbs,
        roadside,
        grade,
        cell,
        merges,
        mut islands,
        hidden,
        ring,
    } = draft;
    if kerbs {
        park_along(&mut builder, &mut Stream::new(number, "kerbside", 0));
    }
    builder.settle();
    let roadside = roadside.map(|place| place.pose(&builder));
    for node in &builder.nodes {
        if let Control::Roundabout { radius, width } = node.control {
            let half = 0.5 * (radius - 0.5 * width);
            let mut line = Path::from(node.at[0] + half, node.at[1], FRAC_PI_2);
            line.arc(half, 2.0 * PI);
            islands.push((line, 0.8 * half));
        }
    }
    let Builder { roads, nodes } = builder;
    let surface = Surface::new(&roads, &nodes, kerbs);
    let (sin, cos) = libm::sincos(draws.between(0.0, std::f64::consts::TAU));
    // Level places are many.
    let slope = grade[0] + (grade[1] - grade[0]) * draws.unit() * draws.unit();
    Scene {
        network: Network {
            roads,
            nodes,
            merges,
            mix,
            kerbs,
            islands,
            roadside,
            surface,
            hidden,
            ring,
        },
        grade: [slope * cos, slope * sin],
        cell,
    }
}

/// Gives streets bays along the kerbs where they have none.
fn park_along(builder: &mut Builder, draws: &mut Stream) {
    for road in &mut builder.roads {
        let section = &mut road.section;
        for side in 0..SIDES.len() {
            let is_street = section.pavement[side] > 0.0 && section.lanes[1] > 0;
            if is_street && section.bays[side].is_none() && draws.chance(0.6) {
                section.bays[side] = Some(Bays::PARALLEL);
            }
        }
    }
}

struct Draft {
    builder: Builder,
    mix: TrafficMix,
    kerbs: bool,
    roadside: [Stand; 2],
    /// Min and max slope of the place.
    grade: [f64; 2],
    cell: f64,
    merges: Vec<Merge>,
    islands: Vec<(Path, f64)>,
    /// Stretches of roads over which too little of the sky is free for a satellite receiver.
    hidden: Vec<(usize, [f64; 2])>,
    /// Roads that lead round a block, each on to the next.
    ring: Vec<usize>,
}

impl Draft {
    fn new(builder: Builder, mix: TrafficMix) -> Self {
        let second = builder.nodes.len().saturating_sub(1).min(1);
        let roadside = [
            Stand::Corner { node: 0, arm: 0 },
            Stand::Corner { node: second, arm: 2 },
        ];
        Draft {
            builder,
            mix,
            kerbs: true,
            roadside,
            grade: [0.002, 0.022],
            cell: 2.0,
            merges: Vec::new(),
            islands: Vec::new(),
            hidden: Vec::new(),
            ring: Vec::new(),
        }
    }
}

/// Traffic of a town.
const USUAL_MIX: TrafficMix = TrafficMix {
    gap: [62.0, 28.0],
    walkers: [16, 46],
    groups: 0.15,
    standing: [2, 4],
    prams: 0.06,
    between: 0.08,
    parked: [0.35, 0.65],
    vans: [0.14, 0.10],
    long: 0.1,
    trailers: 0.3,
    tricycles: [0.02, 0.02],
    riders: 0.08,
    near: 65.0,
};

fn beside(draws: &mut Stream) -> [(VergeKind, f64); 2] {
    [(); 2].map(|()| match draws.unit() {
        u if u < 0.45 => (VergeKind::Park, draws.between(18.0, 36.0)),
        u if u < 0.8 => (VergeKind::Garden, draws.between(9.0, 18.0)),
        _ => (VergeKind::Street, draws.between(2.5, 6.0)),
    })
}
