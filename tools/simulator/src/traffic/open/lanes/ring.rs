//! Lanes of a roundabout.

use std::f64::consts::{FRAC_PI_2, PI};

use super::bends::{Bend, turn_path};
use super::{Kind, Lanes, Mouth, lane};
use crate::path::{Path, Pose2};
use crate::place::Node;

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
        const LIMIT: f64 = 7.5;
        let on_ring = |angle: f64| {
            let (sin, cos) = libm::sincos(angle);
            Pose2 {
                x: node.at[0] + radius * cos,
                y: node.at[1] + radius * sin,
                heading: angle + FRAC_PI_2,
            }
        };
        let count = node.arms.len();
        let arc = |from: f64, to: f64| {
            let mut path = Path::from_pose(on_ring(from));
            path.arc(radius, (to - from).rem_euclid(2.0 * PI));
            path
        };
        // How far before and behind an arm one leaves and joins the ring, rad.
        let gaps = (0..count).map(|k| {
            let next = node.arms[(k + 1) % count].heading;
            (next - node.arms[k].heading).rem_euclid(2.0 * PI)
        });
        let beside = (0.5 * gaps.fold(PI, f64::min) - 0.12).min(0.5);
        // Stretches between arms are plain lanes; those past an arm are turns, because entries join behind them.
        let between: Vec<usize> = (0..count)
            .map(|k| {
                let from = node.arms[k].heading + beside;
                let to = node.arms[(k + 1) % count].heading - beside;
                let mut piece = lane(arc(from, to), Kind::Drive, LIMIT);
                piece.outer = false;
                self.lanes.push(piece);
                bends.push(Bend {
                    arm: k,
                    to: k,
                    angle: 0.0,
                    cycle: false,
                    ring: true,
                });
                self.lanes.len() - 1
            })
            .collect();
        for k in 0..count {
            let heading = node.arms[k].heading;
            let before = between[(k + count - 1) % count];
            let past = arc(heading - beside, heading + beside);
            self.turn(number, k, past, LIMIT, before, between[k], 0.55);
            let ring = |ring: bool| Bend {
                arm: k,
                to: k,
                angle: 0.0,
                cycle: false,
                ring,
            };
            bends.push(ring(true));
            for from in &mouths[k][0] {
                let start = &self.lanes[from.lane].path;
                let path = turn_path(start.at(start.length()).0, on_ring(heading + beside), f64::INFINITY);
                self.turn(number, k, path, LIMIT, from.lane, between[k], 1.0);
                bends.push(ring(false));
            }
            for to in &mouths[k][1] {
                let path = turn_path(
                    on_ring(heading - beside),
                    self.lanes[to.lane].path.at(0.0).0,
                    f64::INFINITY,
                );
                self.turn(number, k, path, LIMIT, before, to.lane, 0.45);
                bends.push(ring(true));
            }
        }
    }
}
