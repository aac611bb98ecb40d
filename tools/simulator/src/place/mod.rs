//! The place: ground, roads, and what stands beside them. Fixed by its own number, whatever the traffic.

mod clutter;
mod fixtures;
mod foliage;
mod roads;
mod terrain;
mod things;
#[allow(dead_code)] // kinds of ground that not every place has
mod verge;

pub(crate) use roads::{BAY, BAYS, CYCLE_LANE, KERB, LANE, PAVEMENT, REACH, Roads};

use crate::Scenario;
use crate::path::Pose2;
use crate::random::Stream;
use crate::solid::{Hit, Solid};
pub(crate) use foliage::Foliage;
use terrain::Terrain;
pub(crate) use verge::{Verge, VergeKind};

/// Everything that does not move.
pub(crate) struct Scenery {
    pub roads: Roads,
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

impl Scenery {
    pub fn new(scenario: Scenario, number: u64) -> Self {
        let roads = Roads::new(scenario, number);
        let terrain = Terrain::new(number);
        let heading = Stream::new(number, "heading", 0).between(-std::f64::consts::PI, std::f64::consts::PI);
        let fixtures = fixtures::build(&roads, &terrain, number);
        let verges = Verge::of_grid(&roads);
        Scenery {
            roads,
            terrain,
            fixtures,
            foliage: Vec::new(),
            verges,
            heading,
        }
    }

    /// The place with open verges that are lined and overgrown, instead of streets of walls.
    pub fn overgrown(mut self, number: u64) -> Self {
        const DEPTH: f64 = 35.0;
        let kinds = [VergeKind::Park, VergeKind::Garden, VergeKind::Field, VergeKind::Park];
        self.verges = Verge::of_grid(&self.roads);
        let mut draws = Stream::new(number, "kinds", 0);
        for verge in &mut self.verges {
            *verge = verge.clone().widened(kinds[draws.below(kinds.len())], DEPTH);
        }
        self.fixtures
            .retain(|fixture| fixture.solid.high[2] - fixture.solid.low[2] < 4.0);
        let ground = clutter::Ground {
            open: &|x, y| self.open_ground(x, y),
            height: &|x, y| self.walk_height(x, y),
        };
        let clutter = clutter::clutter(&self.verges, &ground, number);
        self.fixtures.extend(clutter.fixtures);
        self.foliage = clutter.foliage;
        self
    }

    /// Distance of a point from everything that is paved, negative upon it, m; good to a metre, and never more than
    /// 30 m. Where it is great, shrubs and trees may grow.
    pub fn open_ground(&self, x: f64, y: f64) -> f64 {
        self.roads.open_ground(x, y)
    }

    /// Height of the roads' surface, m.
    pub fn road_height(&self, x: f64, y: f64) -> f64 {
        self.terrain.height(x, y)
    }

    /// Height of the ground under a walker, m.
    pub fn walk_height(&self, x: f64, y: f64) -> f64 {
        self.terrain.height(x, y) + self.roads.step_up(x, y)
    }

    /// Where poles for roadside units stand: (pose of the body frame, height of the ground).
    pub fn roadside(&self, second: bool) -> (Pose2, f64) {
        let side = if second { -1.0 } else { 1.0 };
        let [main, cross] = self.roads.half;
        let (x, y) = match self.roads.scenario {
            Scenario::Intersection => (side * (cross + 1.5), side * (main + 1.5)),
            Scenario::Corridor => (side * 28.0, side * (main + 1.5)),
        };
        let pose = Pose2 {
            x,
            y,
            heading: if second { std::f64::consts::PI } else { 0.0 },
        };
        (pose, self.terrain.height(x, y) + KERB)
    }

    /// Where a ray meets the ground before `limit`.
    #[inline]
    pub fn cast_ground(&self, origin: [f64; 3], ray: [f64; 3], limit: f64) -> Option<Hit> {
        let point = |t: f64| (origin[0] + ray[0] * t, origin[1] + ray[1] * t);
        let upper = self.terrain.cast(origin, ray, KERB, [0.0, limit])?;
        let (x, y) = point(upper);
        if self.roads.raised(x, y) {
            return Some(Hit {
                t: upper,
                cos: -ray[2],
                rho: self.roads.reflectivity(x, y, true),
            });
        }
        let lower = self.terrain.cast(origin, ray, 0.0, [upper, limit]);
        let (x, y) = point(lower.unwrap_or(limit));
        if !self.roads.raised(x, y) {
            return lower.map(|t| Hit {
                t,
                cos: -ray[2],
                rho: self.roads.reflectivity(x, y, false),
            });
        }
        // Between the two surfaces the ray went through a kerb's face.
        let (mut before, mut behind) = (upper, lower.unwrap_or(limit));
        for _ in 0..12 {
            let middle = 0.5 * (before + behind);
            let (x, y) = point(middle);
            if self.roads.raised(x, y) {
                behind = middle
            } else {
                before = middle
            }
        }
        Some(Hit {
            t: behind,
            cos: 0.7,
            rho: 0.3,
        })
    }
}
