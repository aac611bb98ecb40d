//! Where ways come near each other.

use crate::path::{Path, Pose2};
use crate::place::{CROSSING_HALF, Node};

/// Step along lanes where they are compared, m.
const STEP: f64 = 0.5;

pub(super) fn sampled(path: &Path) -> Vec<Pose2> {
    let count = (path.length() / STEP).ceil() as usize;
    (0..=count)
        .map(|k| path.at((k as f64 * STEP).min(path.length())).0)
        .collect()
}

/// From where to where the second of two ways is within `reach` of the first.
pub(super) fn meeting(a: &[Pose2], b: &[Pose2], reach: f64) -> Option<[f64; 2]> {
    let near = |q: &Pose2| {
        a.iter().any(|p| {
            let (dx, dy) = (p.x - q.x, p.y - q.y);
            dx * dx + dy * dy < reach * reach
        })
    };
    let first = b.iter().position(near)?;
    let last = b.iter().rposition(near)?;
    Some([first as f64 * STEP, last as f64 * STEP])
}

/// The share of a crossing that a way takes up, from the arm's left to its right.
pub(super) fn passes(node: &Node, arm: usize, half: f64, way: &[Pose2], reach: f64) -> Option<[f64; 2]> {
    let middle = node.arms[arm].crossing?;
    let frame = node.place(arm, middle, 0.0);
    let (sin, cos) = libm::sincos(frame.heading);
    let mut share = [f64::INFINITY, f64::NEG_INFINITY];
    for pose in way {
        let (dx, dy) = (pose.x - frame.x, pose.y - frame.y);
        let (along, across) = (dx * cos + dy * sin, dy * cos - dx * sin);
        if along.abs() < CROSSING_HALF + 0.6 && across.abs() < half {
            let at = |v: f64| ((half - v) / (2.0 * half)).clamp(0.0, 1.0);
            share = [share[0].min(at(across + reach)), share[1].max(at(across - reach))];
        }
    }
    (share[0] < share[1]).then_some(share)
}
