//! The place: ground, roads, and what stands beside them. Fixed by its own number, whatever the traffic.

mod clutter;
mod fixtures;
mod foliage;
mod houses;
mod network;
mod roads;
mod scenes;
mod surface;
mod terrain;
mod things;
mod verge;

pub(crate) use network::{Arm, CROSSING_HALF, Control, Network, Node, SIDES, Strip, TrafficMix};
pub(crate) use roads::{BAY, BAYS, CYCLE_LANE, Grid, KERB, LANE, PAVEMENT, REACH, Roads};

use crate::Scenario;
use crate::inertial::Sky;
use crate::path::Pose2;
use crate::random::Stream;
use crate::solid::{Hit, Solid};
pub(crate) use foliage::Foliage;
use terrain::Terrain;
pub(crate) use verge::{Verge, VergeKind};

/// The plan of a place's roads.
pub(crate) enum Plan {
    /// One of the two places whose roads are straight and cross squarely.
    Grid(Roads),
    /// Roads at any angle.
    Network(Box<Network>),
}

/// Everything that does not move.
pub(crate) struct Scenery {
    pub scenario: Scenario,
    /// The place's number.
    pub number: u64,
    pub plan: Plan,
    pub terrain: Terrain,
    pub fixtures: Vec<Fixture>,
    pub foliage: Vec<Foliage>,
    /// The edges of free ground beside the roads.
    pub verges: Vec<Verge>,
    /// Direction of the main road in `map`, rad.
    pub heading: f64,
}

/// Something that stands in the place.
pub(crate) struct Fixture {
    pub pose: Pose2,
    /// Height of its foot, m.
    pub z: f64,
    pub solid: Solid,
}

impl Fixture {
    /// Middle and extent of what road users could touch, length, width and 0, m.
    pub fn footprint(&self) -> (Pose2, [f64; 3]) {
        const TALLEST: f64 = 1.8;
        let low = self.solid.footprint_below(TALLEST);
        let pose = self.pose.at(0.5 * (low[0] + low[1]), 0.5 * (low[2] + low[3]));
        (pose, [low[1] - low[0], low[3] - low[2], 0.0])
    }
}

impl Scenery {
    pub fn new(scenario: Scenario, number: u64) -> Self {
        match scenario.resolve(number) {
            Scenario::Intersection => Self::on_grid(Grid::Intersection, number),
            Scenario::Corridor => Self::on_grid(Grid::Corridor, number),
            other => Self::of_network(other, number),
        }
    }

    /// One of the two places on a grid.
    pub fn on_grid(grid: Grid, number: u64) -> Self {
        let roads = Roads::new(grid, number);
        let terrain = Terrain::new(number);
        let fixtures = fixtures::build(&roads, &terrain, number);
        let scenario = match grid {
            Grid::Intersection => Scenario::Intersection,
            Grid::Corridor => Scenario::Corridor,
        };
        Scenery {
            scenario,
            number,
            verges: Verge::of_grid(&roads),
            plan: Plan::Grid(roads),
            terrain,
            fixtures,
            foliage: Vec::new(),
            heading: Self::heading(number),
        }
    }

    /// A place with roads at any angle.
    fn of_network(scenario: Scenario, number: u64) -> Self {
        let scenes::Scene { network, grade, cell } = scenes::scene(scenario, number);
        let mut draws = Stream::new(number, "relief", 0);
        let waves = [(); 2].map(|()| {
            let (sin, cos) = libm::sincos(draws.between(0.0, std::f64::consts::TAU));
            let k = std::f64::consts::TAU / draws.between(180.0, 420.0);
            let slope = draws.between(0.002, 0.006);
            [k * cos, k * sin, draws.between(0.0, std::f64::consts::TAU), slope / k]
        });
        let crowns = surface::Crowns::new(&network.roads, cell);
        let terrain = Terrain::shaped(number, cell, grade, |x, y| {
            let long = waves
                .iter()
                .map(|[kx, ky, phase, amplitude]| amplitude * libm::sin(kx * x + ky * y + phase));
            long.sum::<f64>() + crowns.height(x, y)
        });
        let verges = Verge::of_network(&network);
        let (mut fixtures, houses) = houses::build(&network, &verges, &terrain, number);
        let nodes: Vec<[f64; 2]> = network.nodes.iter().map(|node| node.at).collect();
        let ground = clutter::Ground {
            open: &|x, y| open_ground(&network, &houses, x, y),
            off_road: &|x, y| network.surface.off_road(x, y),
            height: &|x, y| terrain.height(x, y) + step_up(network.surface.inside_kerb(x, y)),
            watched: &|x, y| network.watched(x, y),
            nodes: &nodes,
        };
        let clutter = clutter::clutter(&verges, &ground, number);
        fixtures.extend(clutter.fixtures);
        Scenery {
            scenario,
            number,
            verges,
            plan: Plan::Network(Box::new(network)),
            terrain,
            fixtures,
            foliage: clutter.foliage,
            heading: Self::heading(number),
        }
    }

    /// The same place on another day: what grows has lost or gained some, or is gone; all else is as it was.
    pub fn on_day(mut self, day: u64) -> Self {
        if day > 0 {
            let number = self.number;
            self.foliage = self
                .foliage
                .iter()
                .filter_map(|foliage| foliage.on_day(number, day))
                .collect();
        }
        self
    }

    /// The sky over a point: between the houses of a grid it is narrow.
    pub fn sky(&self, x: f64, y: f64) -> Sky {
        match &self.plan {
            Plan::Grid(_) => Sky::Narrow,
            Plan::Network(network) => network.sky(x, y),
        }
    }

    /// Whether the roads lie at any angle; there is clutter along them, and bodies are rounded.
    pub fn is_network(&self) -> bool {
        matches!(self.plan, Plan::Network(_))
    }

    fn heading(number: u64) -> f64 {
        Stream::new(number, "heading", 0).between(-std::f64::consts::PI, std::f64::consts::PI)
    }

    /// The roads of a place on a grid.
    #[cfg(test)]
    pub fn grid(&self) -> &Roads {
        match &self.plan {
            Plan::Grid(roads) => roads,
            Plan::Network(_) => panic!("{} is not on a grid", self.scenario.name()),
        }
    }

    /// The roads of a place that is not on a grid.
    #[cfg(test)]
    pub fn network(&self) -> &Network {
        match &self.plan {
            Plan::Network(network) => network,
            Plan::Grid(_) => panic!("{} is on a grid", self.scenario.name()),
        }
    }

    /// Height of the roads' surface, m.
    pub fn road_height(&self, x: f64, y: f64) -> f64 {
        self.terrain.height(x, y)
    }

    /// Height of the ground under a walker, m.
    pub fn walk_height(&self, x: f64, y: f64) -> f64 {
        let step = match &self.plan {
            Plan::Grid(roads) => roads.step_up(x, y),
            Plan::Network(network) => step_up(network.surface.inside_kerb(x, y)),
        };
        self.terrain.height(x, y) + step
    }

    /// Whether a point lies on raised ground, behind a kerb.
    #[inline]
    pub fn raised(&self, x: f64, y: f64) -> bool {
        match &self.plan {
            Plan::Grid(roads) => roads.raised(x, y),
            Plan::Network(network) => network.surface.raised(x, y),
        }
    }

    #[inline]
    fn reflectivity(&self, x: f64, y: f64, raised: bool) -> f64 {
        match &self.plan {
            Plan::Grid(roads) => roads.reflectivity(x, y, raised),
            Plan::Network(network) => network.surface.reflectivity(x, y),
        }
    }

    /// Where poles for roadside units stand: (pose of the body frame, height of the ground).
    pub fn roadside(&self, second: bool) -> (Pose2, f64) {
        let roads = match &self.plan {
            Plan::Grid(roads) => roads,
            Plan::Network(network) => {
                let pose = network.roadside[usize::from(second)];
                return (pose, self.walk_height(pose.x, pose.y));
            }
        };
        let side = if second { -1.0 } else { 1.0 };
        let [main, cross] = roads.half;
        let (x, y) = match roads.grid {
            Grid::Intersection => (side * (cross + 1.5), side * (main + 1.5)),
            Grid::Corridor => (side * 28.0, side * (main + 1.5)),
        };
        let pose = Pose2 {
            x,
            y,
            heading: if second { std::f64::consts::PI } else { 0.0 },
        };
        (pose, self.terrain.height(x, y) + KERB)
    }

    /// Where rays meet the ground before their limits: origins, rays and limits by axis.
    #[inline]
    pub fn cast_ground<const N: usize>(
        &self,
        origins: &[[f64; N]; 3],
        rays: [&[f64; N]; 3],
        limits: &[f64; N],
    ) -> [Option<Hit>; N] {
        let point = |k: usize, t: f64| (origins[0][k] + rays[0][k] * t, origins[1][k] + rays[1][k] * t);
        let met = |k: usize, t: f64, rho: f64| Hit {
            t,
            cos: -rays[2][k],
            rho,
        };
        let mut hits = [None; N];
        if let Plan::Network(network) = &self.plan
            && !network.surface.has_kerbs()
        {
            let ground = self.terrain.cast(origins, rays, 0.0, [&[0.0; N], limits]);
            for k in 0..N {
                if !ground[k].is_nan() {
                    let (x, y) = point(k, ground[k]);
                    hits[k] = Some(met(k, ground[k], network.surface.reflectivity(x, y)));
                }
            }
            return hits;
        }
        let upper = self.terrain.cast(origins, rays, KERB, [&[0.0; N], limits]);
        // Those that go on to the lower ground.
        let mut beneath = [f64::NEG_INFINITY; N];
        for k in 0..N {
            if upper[k].is_nan() {
                continue;
            }
            let (x, y) = point(k, upper[k]);
            match self.raised(x, y) {
                true => hits[k] = Some(met(k, upper[k], self.reflectivity(x, y, true))),
                false => beneath[k] = limits[k],
            }
        }
        if beneath.iter().all(|limit| *limit < 0.0) {
            return hits;
        }
        let lower = self.terrain.cast(origins, rays, 0.0, [&upper, &beneath]);
        for k in 0..N {
            if beneath[k] < 0.0 {
                continue;
            }
            let t = if lower[k].is_nan() { limits[k] } else { lower[k] };
            let (x, y) = point(k, t);
            hits[k] = if self.raised(x, y) {
                let t = self.kerb([upper[k], t], |t| point(k, t));
                Some(Hit { t, cos: 0.7, rho: 0.3 })
            } else if lower[k].is_nan() {
                None
            } else {
                Some(met(k, t, self.reflectivity(x, y, false)))
            };
        }
        hits
    }

    /// Where a ray went through a kerb's face between the two surfaces.
    fn kerb(&self, [mut before, mut behind]: [f64; 2], point: impl Fn(f64) -> (f64, f64)) -> f64 {
        for _ in 0..12 {
            let middle = 0.5 * (before + behind);
            let (x, y) = point(middle);
            if self.raised(x, y) {
                behind = middle
            } else {
                before = middle
            }
        }
        behind
    }
}

/// Distance of a point from everything that is paved and from houses, by their extents along and across, negative upon them,
/// m; good to a metre, and never more than 30 m. Where it is great, shrubs and trees may grow.
fn open_ground(network: &Network, houses: &[(Pose2, [f64; 2])], x: f64, y: f64) -> f64 {
    let off = houses.iter().map(|(pose, size)| {
        let (sin, cos) = libm::sincos(pose.heading);
        let (dx, dy) = (x - pose.x, y - pose.y);
        let along = (dx * cos + dy * sin).abs() - 0.5 * size[0];
        let across = (dy * cos - dx * sin).abs() - 0.5 * size[1];
        along.max(across)
    });
    off.fold(network.surface.open_ground(x, y), f64::min)
}

/// How high the ground stands under a walker, m: kerbs are lowered over half a metre.
fn step_up(inside_kerb: f64) -> f64 {
    KERB * (inside_kerb * 2.0 + 0.5).clamp(0.0, 1.0)
}
