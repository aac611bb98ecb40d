//! Where roadside units stand.

use std::f64::consts::PI;

use crate::path::{Pose2, angle_within};
use crate::place::network::{Builder, Node, OPPOSITE};

/// Where a roadside unit stands.
pub(super) enum Stand {
    /// Behind the kerb between an arm of a node and the next one.
    Corner { node: usize, arm: usize },
    /// Beside a road: distance along it, and from its line.
    Beside { road: usize, along: f64, across: f64 },
}

impl Stand {
    pub(super) fn pose(&self, builder: &Builder) -> Pose2 {
        match *self {
            Stand::Corner { node, arm } => {
                let node = &builder.nodes[node];
                let arm = arm % node.arms.len();
                let pose = corner(builder, node, arm, 1.3);
                let ahead = across(node, pose);
                Pose2 {
                    heading: libm::atan2(ahead[1] - pose.y, ahead[0] - pose.x),
                    ..pose
                }
            }
            Stand::Beside { road, along, across } => {
                const INWARDS: f64 = 0.4;
                let pose = builder.roads[road].line.at(along).0.aside(across);
                Pose2 {
                    heading: pose.heading - INWARDS.copysign(across),
                    ..pose
                }
            }
        }
    }
}

/// Where a unit at a corner of a node looks: over the node and out along the arm most nearly ahead.
pub(super) fn across(node: &Node, from: Pose2) -> [f64; 2] {
    const OUT: f64 = 35.0;
    let over = libm::atan2(node.at[1] - from.y, node.at[0] - from.x);
    let off = |arm: &&crate::place::network::Arm| angle_within(arm.heading - over).abs();
    let nearest = node.arms.iter().min_by(|a, b| off(a).total_cmp(&off(b)));
    nearest.map_or(node.at, |arm| {
        let end = arm.out.at(OUT).0;
        [end.x, end.y]
    })
}

/// The point `behind` the kerbs between an arm and the next one counter-clockwise, heading along the arm.
fn corner(builder: &Builder, node: &Node, arm: usize, behind: f64) -> Pose2 {
    let half = |k: usize| builder.roads[node.arms[k].road].section.half() + behind;
    let next = (arm + 1) % node.arms.len();
    let (own, other) = (node.arms[arm].heading, node.arms[next].heading);
    let between = (other - own).rem_euclid(2.0 * PI);
    if let Some(ring) = node.ring_edge() {
        let (sin, cos) = libm::sincos(own + 0.5 * between);
        let out = ring + behind + 1.0;
        return Pose2 {
            x: node.at[0] + out * cos,
            y: node.at[1] + out * sin,
            heading: own,
        };
    }
    if between > OPPOSITE {
        return node.place(arm, 2.0, half(arm));
    }
    let (sin, cos) = libm::sincos(between);
    // A little farther out than the corner itself, because kerbs are rounded there.
    let along = (half(next) + half(arm) * cos) / sin;
    let slide = 0.3 * node.corner;
    let pose = node.place(arm, along, half(arm));
    let (s, c) = libm::sincos(own + 0.5 * between);
    Pose2 {
        x: pose.x + slide * c,
        y: pose.y + slide * s,
        ..pose
    }
}
