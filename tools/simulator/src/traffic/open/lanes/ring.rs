//! Lanes of a roundabout.

use std::f64::consts::{FRAC_PI_2, PI};

use super::bends::{Bend, turn_path};
use super::{Kind, Lanes, Mouth, lane};
use crate::path::{Path, Pose2};
use crate::place::Node;

/// Speed limit on the ring, m/s.
const LIMIT: f64 = 7.5;

/// The line on which one drives around.
struct Circle {
    middle: [f64; 2],
    radius: f64,
}

impl Circle {
    fn pose(&self, angle: f64) -> Pose2 {
        let (sin, cos) = libm::sincos(angle);
        Pose2 {
            x: self.middle[0] + self.radius * cos,
            y: self.middle[1] + self.radius * sin,
            heading: angle + FRAC_PI_2,
        }
    }

    fn arc(&self, from: f64, to: f64) -> Path {
        let mut path = Path::from_pose(self.pose(from));
        path.arc(self.radius, (to - from).rem_euclid(2.0 * PI));
        path
    }
}

/// How far before and behind an arm one leaves and joins the ring, rad.
fn beside(node: &Node) -> f64 {
    let count = node.arms.len();
    let gaps = (0..count).map(|k| {
        let next = node.arms[(k + 1) % count].heading;
        (next - node.arms[k].heading).rem_euclid(2.0 * PI)
    });
    (0.5 * gaps.fold(PI, f64::min) - 0.12).min(0.5)
}

fn bend(arm: usize, ring: bool) -> Bend {
    Bend {
        arm,
        to: arm,
        angle: 0.0,
        cycle: false,
        ring,
    }
}

impl Lanes {
    /// The ring of a roundabout, its entries and exits.
    pub(super) fn ring(
        &mut self,
        number: usize,
        node: &Node,
        mouths: &[[Vec<Mouth>; 2]],
        radius: f64,
        bends: &mut Vec<Bend>,
    ) {
        let circle = Circle {
            middle: node.at,
            radius,
        };
        let beside = beside(node);
        let between = self.between_arms(node, &circle, beside, bends);
        let count = node.arms.len();
        for (k, [entries, exits]) in mouths.iter().enumerate() {
            let heading = node.arms[k].heading;
            let (before, behind) = (between[(k + count - 1) % count], between[k]);
            let past = circle.arc(heading - beside, heading + beside);
            self.turn(number, k, past, LIMIT, before, behind, 0.55);
            bends.push(bend(k, true));
            for from in entries {
                let start = &self.lanes[from.lane].path;
                let start = start.at(start.length()).0;
                let path = turn_path(start, circle.pose(heading + beside), f64::INFINITY);
                self.turn(number, k, path, LIMIT, from.lane, behind, 1.0);
                bends.push(bend(k, false));
            }
            for to in exits {
                let end = self.lanes[to.lane].path.at(0.0).0;
                let path = turn_path(circle.pose(heading - beside), end, f64::INFINITY);
                self.turn(number, k, path, LIMIT, before, to.lane, 0.45);
                bends.push(bend(k, true));
            }
        }
    }

    /// The stretches of the ring between arms, by the arm before each: plain lanes. Those past an arm are turns, because
    /// entries join behind them.
    fn between_arms(&mut self, node: &Node, circle: &Circle, beside: f64, bends: &mut Vec<Bend>) -> Vec<usize> {
        let count = node.arms.len();
        let mut between = Vec::new();
        for k in 0..count {
            let from = node.arms[k].heading + beside;
            let to = node.arms[(k + 1) % count].heading - beside;
            let mut piece = lane(circle.arc(from, to), Kind::Drive, LIMIT);
            piece.outer = false;
            between.push(self.lanes.len());
            self.lanes.push(piece);
            bends.push(bend(k, true));
        }
        between
    }
}
