//! Buildings, trees, poles and signs along the roads.

use super::things::{street_sign, street_tree};
use super::{Fixture, Grid, PAVEMENT, REACH, Roads, Terrain};
use crate::path::Pose2;
use crate::random::Stream;
use crate::solid::{Part, Shape, Solid};

/// From the kerb line of a road without bays to the row of trees and lamps, m.
const ROW: f64 = 2.9;

pub(super) fn build(roads: &Roads, terrain: &Terrain, number: u64) -> Vec<Fixture> {
    let mut site = Site {
        roads,
        terrain,
        fixtures: Vec::new(),
    };
    for (index, arm) in roads.arms().iter().enumerate() {
        for side in [-1.0, 1.0] {
            let stream = 2 * index as u64 + u64::from(side > 0.0);
            let verge = Verge { arm: *arm, side };
            site.buildings(verge, &mut Stream::new(number, "buildings", stream));
            site.row(verge, &mut Stream::new(number, "row", stream));
        }
        site.signals(*arm);
        site.terminal(*arm, &mut Stream::new(number, "terminal", index as u64));
    }
    site.fixtures
}

/// One side of an arm.
#[derive(Clone, Copy)]
struct Verge {
    arm: usize,
    /// +1: to the left when one leaves the centre.
    side: f64,
}

struct Site<'a> {
    roads: &'a Roads,
    terrain: &'a Terrain,
    fixtures: Vec<Fixture>,
}

impl Site<'_> {
    /// Place coordinates of a point `along` an arm and `across` to its left.
    fn point(arm: usize, along: f64, across: f64) -> (f64, f64) {
        match arm {
            0 => (along, across),
            1 => (-across, along),
            2 => (-along, -across),
            _ => (across, -along),
        }
    }

    fn add(&mut self, arm: usize, along: f64, across: f64, turn: f64, parts: Vec<Part>) {
        let (x, y) = Self::point(arm, along, across);
        let heading = arm as f64 * std::f64::consts::FRAC_PI_2 + turn;
        // Feet go a little into the ground, so that no ray slips under them.
        let z = self.terrain.height(x, y) - 0.1;
        self.fixtures.push(Fixture {
            pose: Pose2 { x, y, heading },
            z,
            solid: Solid::new(parts),
        });
    }

    fn buildings(&mut self, verge: Verge, draws: &mut Stream) {
        let axis = verge.arm % 2;
        let line = self.roads.half[axis] + PAVEMENT + 0.6;
        let beside = self.roads.half[1 - axis] + PAVEMENT + 0.6;
        // The main road's rows own the corners.
        let mut along = match (self.roads.grid, axis) {
            (Grid::Corridor, _) => 0.5,
            (Grid::Intersection, 0) => beside,
            (Grid::Intersection, _) => beside + 21.0,
        };
        while along < REACH + 15.0 {
            let front = draws.between(9.0, 26.0);
            let depth = draws.between(9.0, 17.0);
            let height = draws.between(6.0, 24.0);
            let setback = if draws.chance(0.3) {
                draws.between(0.8, 3.0)
            } else {
                0.0
            };
            let turn = if setback > 0.9 { draws.between(-0.02, 0.02) } else { 0.0 };
            let rho = draws.between(0.15, 0.6);
            let kind = draws.unit();
            let gap = if draws.chance(0.35) {
                draws.between(1.5, 7.0)
            } else {
                0.0
            };
            let middle = along + front / 2.0;
            let garden = kind < 0.12 && along > 40.0;
            let high = if garden { draws.between(1.0, 1.9) } else { height };
            let thick = if garden { 0.5 } else { depth };
            let low = [-front / 2.0, -thick / 2.0, 0.0];
            let high = [front / 2.0, thick / 2.0, high];
            let shape = if garden {
                Shape::Block { low, high }
            } else {
                Shape::Facade { low, high }
            };
            let across = verge.side * (line + setback + thick / 2.0);
            self.add(verge.arm, middle, across, turn, vec![Part::solid(shape, rho)]);
            if garden {
                for share in [0.2, 0.5, 0.8] {
                    let deep = verge.side * (line + draws.between(3.0, 10.0));
                    self.tree(verge.arm, along + front * share, deep, draws);
                }
            }
            along += front + gap;
        }
    }

    /// Lamps and trees by turns, with a sign here and there.
    fn row(&mut self, verge: Verge, draws: &mut Stream) {
        let axis = verge.arm % 2;
        let across = verge.side * (self.roads.half[axis] + ROW);
        let mut along = self.roads.stop(axis) + draws.between(7.0, 12.0);
        while along < REACH - 5.0 {
            match draws.unit() {
                u if u < 0.45 => self.tree(verge.arm, along, across, draws),
                u if u < 0.8 => {
                    let lamp = Part::post([0.0, 0.0], 0.09, [0.0, draws.between(6.5, 8.5)], 0.4);
                    self.add(verge.arm, along, across, 0.0, vec![lamp]);
                }
                _ => self.add(verge.arm, along, across, 0.0, street_sign(draws)),
            }
            along += draws.between(8.0, 15.0);
        }
    }

    fn tree(&mut self, arm: usize, along: f64, across: f64, draws: &mut Stream) {
        let tree = street_tree([1.3, 2.3], [3.7, 4.3], [1.2, 2.2], draws);
        self.add(arm, along, across, 0.0, tree);
    }

    /// The signal post beside an arm's stop line, and the one over the crossing's other end.
    fn signals(&mut self, arm: usize) {
        let axis = arm % 2;
        for side in [-1.0, 1.0] {
            let parts = vec![
                Part::post([0.0, 0.0], 0.07, [0.0, 3.4], 0.4),
                Part::block([-0.15, -0.18, 2.4], [0.15, 0.18, 3.3], 0.1),
            ];
            let along = self.roads.stop(axis) + 0.4;
            self.add(arm, along, side * (self.roads.half[axis] + 0.6), 0.0, parts);
        }
    }

    /// What closes the view at an arm's end.
    fn terminal(&mut self, arm: usize, draws: &mut Stream) {
        let (half, height) = (draws.between(25.0, 40.0), draws.between(8.0, 20.0));
        let facade = Shape::Facade {
            low: [-6.0, -half, 0.0],
            high: [6.0, half, height],
        };
        let along = REACH + draws.between(32.0, 45.0);
        self.add(arm, along, 0.0, 0.0, vec![Part::solid(facade, draws.between(0.2, 0.5))]);
    }
}
