//! Shapes of cars and vans.

use super::{Look, TYRE, mirrors, rounded};
use crate::random::Stream;
use crate::solid::{Part, Shape, Solid};

pub(super) fn car([length, width, height]: [f64; 3], look: &Look, draws: &mut Stream) -> Solid {
    let l = length / 2.0 - draws.between(0.06, 0.16);
    let (side, h) = (width / 2.0, height - draws.between(0.0, 0.04));
    let w = side - draws.between(0.08, 0.14);
    let cut = draws.between(0.3, 0.5);
    let belt = draws.between(0.56, 0.62) * h;
    let hull = [
        [-0.97 * l, 0.22],
        [0.93 * l, 0.22],
        [l, 0.38],
        [0.97 * l, 0.45 * h],
        [0.42 * l, belt],
        [-0.95 * l, belt],
        [-l, 0.42 * h],
    ];
    // Some end steeply, some have a boot.
    let rear = draws.between(-0.92, -0.72);
    let cabin = [
        [rear * l, belt - 0.02],
        [0.46 * l, belt - 0.02],
        [0.08 * l, 0.95 * h],
        [(rear + 0.2) * l, 0.95 * h],
    ];
    let roof = w - 0.16;
    let top = [
        [(rear + 0.19) * l, 0.93 * h],
        [0.09 * l, 0.93 * h],
        [-0.02 * l, h],
        [(rear + 0.3) * l, h],
    ];
    let seat = |x: f64| Part::block([x * l, -roof, 0.4 * h], [(x + 0.13) * l, roof, 0.84 * h], 0.2);
    let mut parts = vec![
        look.metal(rounded(&hull, w, w - 0.03, cut)),
        look.window(rounded(&cabin, w - 0.03, roof, 0.1)),
        look.metal(rounded(&top, roof + 0.01, roof - 0.08, 0.12)),
        seat(-0.5),
        seat(-0.05),
    ];
    parts.extend(mirrors(0.3 * l, [w - 0.05, side], [belt, belt + 0.16]));
    parts.extend(Part::wheels(&[-0.6 * l, 0.62 * l], 0.31, w - 0.01, 0.2, TYRE));
    Solid::new(parts)
}

pub(super) fn van([length, width, height]: [f64; 3], look: &Look, draws: &mut Stream) -> Solid {
    let l = length / 2.0 - draws.between(0.06, 0.14);
    let (side, h) = (width / 2.0, height - draws.between(0.0, 0.04));
    let w = side - draws.between(0.1, 0.17);
    let belt = 0.52 * h;
    let hull = [
        [-l, 0.25],
        [0.95 * l, 0.25],
        [l, 0.4],
        [0.98 * l, 0.38 * h],
        [0.66 * l, belt],
        [-l, belt],
    ];
    let cabin = [
        [0.12 * l, belt - 0.02],
        [0.7 * l, belt - 0.02],
        [0.42 * l, 0.95 * h],
        [0.12 * l, 0.95 * h],
    ];
    let load = [
        [-l, belt - 0.02],
        [0.14 * l, belt - 0.02],
        [0.14 * l, h],
        [-0.97 * l, h],
    ];
    let upper = w - 0.08;
    // Behind the driver: windows or sheet metal.
    let rear = rounded(&load, w - 0.01, upper, 0.12);
    let rear = if draws.chance(0.4) {
        look.window(rear)
    } else {
        look.metal(rear)
    };
    let mut parts = vec![
        look.metal(rounded(&hull, w, w - 0.02, 0.25)),
        rear,
        look.window(rounded(&cabin, w - 0.02, upper, 0.1)),
        look.metal(Shape::block([-0.95 * l, -upper, 0.95 * h], [0.4 * l, upper, h])),
        Part::block(
            [0.16 * l, -upper + 0.1, 0.4 * h],
            [0.28 * l, upper - 0.1, 0.82 * h],
            0.2,
        ),
    ];
    parts.extend(mirrors(0.55 * l, [w - 0.05, side], [belt, belt + 0.3]));
    parts.extend(Part::wheels(&[-0.58 * l, 0.6 * l], 0.34, w - 0.01, 0.22, TYRE));
    Solid::new(parts)
}
