//! Shapes of tricycles and prams.

use super::{Look, TYRE, rounded_block};
use crate::bodies::figure;
use crate::random::Stream;
use crate::solid::{Part, Shape, Solid};

/// A cargo tricycle: one wheel and the rider in front, a bed with boards behind, loaded or not.
pub(super) fn tricycle([length, width, height]: [f64; 3], look: &Look, draws: &mut Stream) -> Solid {
    const WHEEL: f64 = 0.27;
    const FLOOR: f64 = 0.5;
    let (l, w, h) = (length / 2.0 - 0.04, width / 2.0 - 0.05, height);
    let boards = FLOOR + draws.between(0.2, 0.5);
    let cloth = 0.15 + 0.5 * draws.between(0.05, 0.8);
    let ball = |center: [f64; 3], radii: [f64; 3]| Part::solid(Shape::Ball { center, radii }, cloth);
    let mut parts = vec![
        look.metal(rounded_block([-l, -0.05 * l], w, [FLOOR - 0.06, boards], 0.03)),
        look.metal(Shape::block([-0.1 * l, -0.16, 0.3], [0.75 * l, 0.16, FLOOR])),
        // Seat, steering column with its shield, handlebar.
        Part::block([-0.02 * l, -0.24, FLOOR], [0.28 * l, 0.24, 0.45 * h], 0.1),
        look.metal(Shape::block([0.66 * l, -0.28, 0.35], [0.72 * l, 0.28, 0.58 * h])),
        Part::block([0.58 * l, -0.4, 0.6 * h], [0.62 * l, 0.4, 0.64 * h], 0.2),
        Part::solid(
            Shape::Wheel {
                x: l - WHEEL,
                z: WHEEL,
                radius: WHEEL,
                low: -0.06,
                high: 0.06,
            },
            TYRE,
        ),
        // The rider: thighs, trunk, arms, head.
        Part::block([0.12 * l, -0.2, 0.42 * h], [0.46 * l, 0.2, 0.52 * h], cloth),
        ball([0.14 * l, 0.0, 0.66 * h], [0.2, 0.23, 0.2 * h]),
        Part::block([0.14 * l, -0.3, 0.64 * h], [0.58 * l, 0.3, 0.7 * h], cloth),
        ball([0.18 * l, 0.0, h - 0.13], [0.11, 0.1, 0.13]),
    ];
    if draws.chance(0.6) {
        let top = (boards + draws.between(0.05, 0.6)).min(0.95 * h);
        let load = rounded_block([-0.92 * l, -0.12 * l], 0.9 * w, [boards - 0.1, top], 0.1);
        parts.push(Part::solid(load, draws.between(0.1, 0.6)));
    }
    parts.extend(Part::wheels(&[-0.55 * l], WHEEL, w, 0.12, TYRE));
    Solid::new(parts)
}

/// Somebody who pushes a pram: a basket with a hood on four wheels, and a handle that he holds.
pub(super) fn pram([length, width, height]: [f64; 3], look: &Look) -> Solid {
    const DEPTH: f64 = 0.62;
    const WHEEL: f64 = 0.14;
    let (front, w) = (length / 2.0, width / 2.0);
    let behind = -length / 2.0 + 0.5 * DEPTH;
    let middle = front - 0.42;
    let mut parts = figure([DEPTH, 0.9 * width, height], 0.15 + 0.5 * look.paint, behind);
    parts.extend([
        look.metal(Shape::block(
            [middle - 0.36, -0.8 * w, 0.5],
            [middle + 0.36, 0.8 * w, 0.78],
        )),
        look.metal(Shape::Ball {
            center: [middle - 0.14, 0.0, 0.78],
            radii: [0.26, 0.8 * w, 0.28],
        }),
        Part::block([middle - 0.3, -0.7 * w, 0.2], [middle + 0.3, 0.7 * w, 0.26], 0.2),
        Part::block([behind + 0.12, -0.7 * w, 0.95], [middle - 0.3, 0.7 * w, 0.99], 0.2),
    ]);
    parts.extend(Part::wheels(&[middle - 0.28, middle + 0.28], WHEEL, w, 0.05, TYRE));
    Solid::new(parts)
}
