//! Shapes of trucks and buses.

use super::{Look, TYRE, mirrors, rounded_block};
use crate::random::Stream;
use crate::solid::{Part, Shape, Solid};

/// A lorry; from 11 m on, a tractor with a trailer behind a gap.
pub(super) fn truck([length, width, height]: [f64; 3], look: &Look, draws: &mut Stream) -> Solid {
    let l = length / 2.0 - draws.between(0.05, 0.12);
    let (side, h) = (width / 2.0, height);
    let w = side - draws.between(0.08, 0.14);
    let cab = l - draws.between(1.9, 2.3);
    let cab_top = (0.9 * h).min(draws.between(2.7, 3.4));
    let long = length > 11.0;
    let gap = if long {
        draws.between(0.7, 1.1)
    } else {
        draws.between(0.2, 0.5)
    };
    let floor = draws.between(1.0, 1.25);
    let load = [-l, cab - gap];
    let body = match draws.below(4) {
        // An open bed with boards, loaded or not.
        0 if !long => rounded_block(load, w, [floor, floor + draws.between(0.5, 1.2).min(h - floor)], 0.03),
        _ => rounded_block(load, w, [floor, h], 0.05),
    };
    let mut parts = vec![
        look.metal(rounded_block([cab, l], w - 0.03, [0.45, 1.4], 0.2)),
        look.window(rounded_block(
            [cab + 0.25, l - 0.06],
            w - 0.05,
            [1.4, 0.8 * cab_top],
            0.2,
        )),
        look.metal(rounded_block([cab, cab + 0.3], w - 0.05, [1.4, cab_top], 0.05)),
        look.metal(rounded_block([cab, l - 0.15], w - 0.05, [0.8 * cab_top, cab_top], 0.25)),
        Part::solid(body, draws.between(0.1, 0.7)),
        // The tallest point, whatever the load: a spoiler or the load's bow.
        Part::block([cab - gap - 0.1, -0.3 * w, floor], [cab - gap, 0.3 * w, h], 0.3),
        Part::block([-l + 0.2, -0.45, 0.6], [cab, 0.45, floor], 0.15),
    ];
    parts.extend(mirrors(l - 0.35, [w - 0.1, side], [1.6, 2.2]));
    let axles: &[f64] = if long {
        &[-0.75, -0.6, -0.45, 0.55, 0.88]
    } else {
        &[-0.62, 0.75]
    };
    let axles: Vec<f64> = axles.iter().map(|share| share * l).collect();
    parts.extend(Part::wheels(&axles, 0.48, w - 0.02, 0.3, TYRE));
    Solid::new(parts)
}

pub(super) fn bus([length, width, height]: [f64; 3], look: &Look, draws: &mut Stream) -> Solid {
    let l = length / 2.0 - draws.between(0.05, 0.15);
    let (side, h) = (width / 2.0, height - draws.between(0.0, 0.05));
    let w = side - draws.between(0.1, 0.18);
    let (sill, lintel) = (0.36 * h, 0.76 * h);
    let mut parts = vec![
        look.metal(rounded_block([-l, l], w, [0.3, sill], 0.25)),
        look.window(rounded_block([-l + 0.02, l - 0.02], w - 0.02, [sill, lintel], 0.25)),
        look.metal(rounded_block([-l, l], w, [lintel, 0.94 * h], 0.25)),
        look.metal(rounded_block([-l + 0.3, l - 0.3], w - 0.2, [0.94 * h, h], 0.25)),
        // Seats and whoever sits on them.
        Part::block([-0.9 * l, -w + 0.3, sill], [0.8 * l, -w + 0.75, sill + 0.5], 0.25),
        Part::block([-0.9 * l, w - 0.75, sill], [0.7 * l, w - 0.3, sill + 0.5], 0.25),
    ];
    for pillar in [-0.95, -0.6, -0.2, 0.2, 0.6, 0.9] {
        parts.push(look.metal(Shape::block([pillar * l, -w, sill], [pillar * l + 0.12, w, lintel])));
    }
    parts.extend(mirrors(l - 0.2, [w - 0.1, side], [0.55 * h, 0.7 * h]));
    parts.extend(Part::wheels(&[-0.5 * l, 0.55 * l], 0.48, w - 0.02, 0.3, TYRE));
    Solid::new(parts)
}
