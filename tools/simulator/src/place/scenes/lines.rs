//! Lines that roads follow.

use crate::path::{Path, Pose2};
use crate::random::Stream;

/// Straight at a node, m.
pub(super) const LEAD: f64 = 22.0;

/// Adds a curve that tightens and widens in steps.
pub(super) fn bend(path: &mut Path, radius: f64, angle: f64) {
    for (share, times) in [(0.1, 3.0), (0.15, 1.6), (0.5, 1.0), (0.15, 1.6), (0.1, 3.0)] {
        path.arc(radius * times, angle * share);
    }
}

pub(super) fn sign(draws: &mut Stream) -> f64 {
    if draws.chance(0.5) { 1.0 } else { -1.0 }
}

/// A line from a point outwards, straight at first, then bent one way and most of that back, up to a length.
pub(super) fn outwards(at: [f64; 2], heading: f64, radius: f64, angle: f64, length: f64) -> Path {
    let mut path = Path::from(at[0], at[1], heading);
    path.line(LEAD);
    bend(&mut path, radius, angle);
    path.line(14.0);
    bend(&mut path, 1.3 * radius, -0.8 * angle);
    let left = length - path.length();
    path.line(left);
    path
}

/// A line from one node to another.
pub(super) fn link(from: Pose2, to: Pose2, lead: f64) -> Path {
    let mut path = Path::from_pose(from);
    path.line(lead);
    path.append(&Path::between(from.at(lead, 0.0), to.at(-lead, 0.0)));
    path.line(lead);
    path
}

pub(super) fn degrees(draws: &mut Stream, low: f64, high: f64) -> f64 {
    draws.between(low, high).to_radians()
}
