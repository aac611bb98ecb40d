//! Things that stand along a street.

use super::{METAL, SHEET, sieve};
use crate::random::Stream;
use crate::solid::Part;

/// A square plate, whose lower edge is at `low`, on a post that is `high`, m.
fn plate(half: f64, low: f64, high: f64) -> Vec<Part> {
    vec![
        Part::post([0.0, 0.0], 0.04, [0.0, high], METAL),
        Part::block([-0.02, -half, low], [0.02, half, low + 2.0 * half], SHEET),
    ]
}

/// A plate on a post that faces those who come.
pub(crate) fn street_sign(draws: &mut Stream) -> Vec<Part> {
    plate(draws.between(0.25, 0.4), 2.2, 2.3)
}

pub(crate) fn bollard(draws: &mut Stream) -> Vec<Part> {
    vec![Part::post(
        [0.0, 0.0],
        draws.between(0.05, 0.15),
        [0.0, draws.between(0.6, 1.1)],
        0.4,
    )]
}

pub(crate) fn lamp(draws: &mut Stream) -> Vec<Part> {
    let height = draws.between(6.0, 10.0);
    vec![
        Part::post([0.0, 0.0], draws.between(0.06, 0.11), [0.0, height], METAL),
        Part::block([-0.1, -1.8, height - 0.15], [0.1, 0.0, height], METAL),
    ]
}

/// A plate on a post, square to the road.
pub(crate) fn sign(draws: &mut Stream) -> Vec<Part> {
    let half = draws.between(0.25, 0.5);
    let low = draws.between(1.6, 2.4);
    plate(half, low, low + half)
}

pub(crate) fn bin(draws: &mut Stream) -> Vec<Part> {
    let (l, w, h) = (
        draws.between(0.25, 0.7),
        draws.between(0.25, 0.4),
        draws.between(0.8, 1.3),
    );
    vec![Part::block([-l, -w, 0.08], [l, w, h], draws.between(0.1, 0.5))]
}

/// A box of a utility: electricity, signals, post.
pub(crate) fn cabinet(draws: &mut Stream) -> Vec<Part> {
    let (l, w, h) = (
        draws.between(0.3, 1.0),
        draws.between(0.2, 0.45),
        draws.between(0.9, 1.7),
    );
    vec![Part::block([-l, -w, 0.0], [l, w, h], 0.4)]
}

/// Bicycles side by side, square to the road.
pub(crate) fn bicycles(count: usize, draws: &mut Stream) -> Vec<Part> {
    let mut parts = Vec::new();
    for k in 0..count.min(6) {
        let x = (k as f64 - 0.5 * (count as f64 - 1.0)) * 0.6 + draws.between(-0.1, 0.1);
        let frame = |low: [f64; 3], high: [f64; 3], pass| sieve(low, high, 0.15, pass);
        parts.push(frame([x - 0.03, -0.85, 0.02], [x + 0.03, -0.2, 0.68], 0.75));
        parts.push(frame([x - 0.03, 0.2, 0.02], [x + 0.03, 0.85, 0.68], 0.75));
        parts.push(frame([x - 0.04, -0.4, 0.35], [x + 0.04, 0.45, 0.85], 0.55));
        parts.push(Part::block([x - 0.25, 0.4, 0.95], [x + 0.25, 0.48, 1.02], 0.2));
    }
    parts
}

/// A bus shelter: glass at the back and the ends, a roof, a bench.
pub(crate) fn shelter(draws: &mut Stream) -> Vec<Part> {
    let (l, h) = (draws.between(1.6, 2.4), draws.between(2.3, 2.6));
    let glass = |low, high| sieve(low, high, 0.15, 0.6);
    vec![
        glass([-l, 0.7, 0.3], [l, 0.74, h]),
        glass([-l, -0.5, 0.3], [-l + 0.04, 0.7, 2.0]),
        Part::block([l - 0.15, -0.4, 0.2], [l, 0.7, 2.1], 0.4),
        Part::block([-l - 0.1, -0.8, h], [l + 0.1, 0.8, h + 0.12], 0.3),
        Part::block([-0.7 * l, 0.25, 0.4], [0.4 * l, 0.6, 0.46], 0.3),
        Part::post([-l, 0.7], 0.05, [0.0, h], METAL),
        Part::post([l, 0.7], 0.05, [0.0, h], METAL),
        Part::post([0.0, 0.7], 0.05, [0.0, h], METAL),
    ]
}

/// A construction cone: rings that narrow upwards, of which one reflects.
pub(crate) fn cone() -> Vec<Part> {
    vec![
        Part::block([-0.2, -0.2, 0.0], [0.2, 0.2, 0.04], 0.1),
        Part::post([0.0, 0.0], 0.13, [0.04, 0.3], 0.35),
        Part::post([0.0, 0.0], 0.09, [0.3, 0.5], SHEET),
        Part::post([0.0, 0.0], 0.05, [0.5, 0.75], 0.35),
    ]
}

/// A barrier of a building site: filled with water, or boards on feet.
pub(crate) fn barrier(draws: &mut Stream) -> Vec<Part> {
    if draws.chance(0.5) {
        return vec![
            Part::block([-0.95, -0.25, 0.0], [0.95, 0.25, 0.35], 0.5),
            Part::block([-0.95, -0.12, 0.35], [0.95, 0.12, 0.85], 0.5),
        ];
    }
    vec![
        Part::block([-1.0, -0.02, 0.8], [1.0, 0.02, 1.0], SHEET),
        Part::block([-1.0, -0.02, 0.35], [1.0, 0.02, 0.5], 0.5),
        Part::block([-0.95, -0.3, 0.0], [-0.85, 0.3, 0.1], 0.1),
        Part::block([0.85, -0.3, 0.0], [0.95, 0.3, 0.1], 0.1),
    ]
}
