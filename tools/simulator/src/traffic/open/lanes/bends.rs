//! Turns that meet at a node: their shape and who goes first.

use crate::path::{Path, Pose2, angle_within};
use crate::place::{Arm, Control, Node};

/// How a turn goes.
pub(super) struct Bend {
    pub arm: usize,
    pub to: usize,
    /// Left positive, 0 for straight on.
    pub angle: f64,
    pub cycle: bool,
    /// On the ring of a roundabout.
    pub ring: bool,
}

/// Number of the arm by which a road's begin or end lies at a node.
pub(super) fn arm_of(node: &Node, road: usize, at_start: bool) -> usize {
    let is = |arm: &Arm| arm.road == road && arm.at_start == at_start;
    node.arms
        .iter()
        .position(is)
        .expect("a road is an arm of the nodes at its ends")
}

/// Radius of the circle that comes as near to a corner as a kerb does that is rounded by [`crate::place::Network`]'s
/// surface: greater where roads meet at a wide angle.
pub(super) fn kerb_radius(corner: f64, bend: f64) -> f64 {
    let flat = 1.0 - libm::cos(0.5 * bend);
    (0.292 * corner / flat.max(1e-3)).min(25.0)
}

/// A way from one pose to another: straight as far as the bend allows, then a curve of equal tangents that is about as
/// wide as `radius`.
pub(super) fn turn_path(from: Pose2, to: Pose2, radius: f64) -> Path {
    let bend = angle_within(to.heading - from.heading);
    let (dx, dy) = (to.x - from.x, to.y - from.y);
    let (s0, c0) = libm::sincos(from.heading);
    let (s1, c1) = libm::sincos(to.heading);
    let sin = c0 * s1 - s0 * c1;
    if bend.abs() < 0.25 || bend.abs() > 2.8 || sin.abs() < 1e-3 {
        return Path::between(from, to);
    }
    // Where the two straight lines meet: so far ahead of the begin, so far before the end.
    let ahead = (dx * s1 - dy * c1) / sin;
    let before = (dy * c0 - dx * s0) / sin;
    let tangent = ahead.min(before).min(radius * libm::tan(0.5 * bend.abs()));
    if tangent < 2.0 {
        return Path::between(from, to);
    }
    let mut path = Path::from_pose(from);
    path.line(ahead - tangent);
    path.append(&Path::between(
        from.at(ahead - tangent, 0.0),
        to.at(tangent - before, 0.0),
    ));
    path.line(before - tangent);
    path
}

/// Whether one turn waits for another.
pub(super) fn yields(node: &Node, own: &Bend, other: &Bend) -> bool {
    if let Control::Roundabout { .. } = node.control {
        return !own.ring && other.ring;
    }
    if own.arm == other.arm {
        // Who turns right lets riders beside him go first.
        return other.cycle && !own.cycle && own.angle != 0.0;
    }
    let (a, b) = (&node.arms[own.arm], &node.arms[other.arm]);
    let between = angle_within(b.heading - a.heading);
    let opposite = between.abs() > 2.2;
    match node.control {
        Control::Priority if a.major != b.major => b.major,
        _ if opposite => own.angle > 0.3 && other.angle <= 0.3,
        Control::Signals => false,
        // Seen from an arm, the next one clockwise is to the left of who comes in by it: headings point outwards.
        Control::Uncontrolled => between > 0.0,
        _ => own.angle > 0.3 && other.angle <= 0.3 || (own.to == other.to && own.angle.abs() > other.angle.abs()),
    }
}
