//! Bodies of vehicles.

use crate::solid::{Part, Shape, Solid, prism};

pub(super) const TYRE: f64 = 0.06;

const GLASS: f64 = 0.1;

/// Share of the rays that pass a car's windows; the rest meets tint, frames and dirt.
const SEEN_THROUGH: f64 = 0.65;

fn glass(shape: Shape) -> Part {
    Part {
        shape,
        rho: GLASS,
        pass: SEEN_THROUGH,
    }
}

pub(super) fn car([length, width, height]: [f64; 3], paint: f64) -> Solid {
    let (l, h, w) = (length / 2.0, height, width / 2.0);
    let belt = 0.59 * h;
    let hull = [
        [-l, 0.18],
        [0.96 * l, 0.18],
        [l, 0.30],
        [l, 0.42 * h],
        [0.42 * l, belt],
        [-l, belt],
    ];
    let cabin = [
        [-0.9 * l, belt],
        [0.46 * l, belt],
        [0.06 * l, 0.96 * h],
        [-0.64 * l, 0.96 * h],
    ];
    let roof = w - 0.17;
    let mut parts = vec![
        Part::solid(prism(&hull, w, w), paint),
        glass(prism(&cabin, w - 0.03, roof)),
        Part::block([-0.64 * l, -roof, 0.95 * h], [0.06 * l, roof, h], paint),
        Part::block([-0.52 * l, -roof, 0.4 * h], [-0.36 * l, roof, 0.8 * h], 0.2),
        Part::block([0.0, -roof, 0.4 * h], [0.12 * l, roof, 0.8 * h], 0.2),
    ];
    parts.extend(Part::wheels(&[-0.6 * l, 0.62 * l], 0.32, w, 0.2, TYRE));
    Solid::new(parts)
}

pub(super) fn van([length, width, height]: [f64; 3], paint: f64) -> Solid {
    let (l, h, w) = (length / 2.0, height, width / 2.0);
    let belt = 0.52 * h;
    let hull = [[-l, 0.2], [l, 0.2], [l, 0.4 * h], [0.6 * l, belt], [-l, belt]];
    let cabin = [
        [0.12 * l, belt],
        [0.66 * l, belt],
        [0.36 * l, 0.96 * h],
        [0.12 * l, 0.96 * h],
    ];
    let mut parts = vec![
        Part::solid(prism(&hull, w, w), paint),
        Part::solid(
            prism(&[[-l, belt], [0.1 * l, belt], [0.1 * l, h], [-l, h]], w, w - 0.06),
            paint,
        ),
        glass(prism(&cabin, w - 0.02, w - 0.12)),
        Part::block([0.1 * l, -w + 0.12, 0.95 * h], [0.36 * l, w - 0.12, h], paint),
        Part::block([0.14 * l, -w + 0.2, 0.4 * h], [0.26 * l, w - 0.2, 0.8 * h], 0.2),
    ];
    parts.extend(Part::wheels(&[-0.58 * l, 0.6 * l], 0.34, w, 0.22, TYRE));
    Solid::new(parts)
}

pub(super) fn truck([length, width, height]: [f64; 3], paint: f64) -> Solid {
    let (l, h, w) = (length / 2.0, height, width / 2.0);
    let cab = l - 2.0;
    let cab_top = (0.88 * h).min(2.8);
    let mut parts = vec![
        Part::block([cab, -w, 0.45], [l, w, 1.35], paint),
        glass(Shape::block(
            [cab + 0.25, -w + 0.02, 1.35],
            [l - 0.05, w - 0.02, 0.8 * cab_top],
        )),
        Part::block([cab, -w + 0.02, 1.35], [cab + 0.25, w - 0.02, cab_top], paint),
        Part::block([cab, -w + 0.02, 0.8 * cab_top], [l - 0.1, w - 0.02, cab_top], paint),
        Part::block([-l, -w, 1.05], [cab - 0.35, w, h], 0.6),
        Part::block([-l + 0.2, -0.45, 0.6], [cab, 0.45, 1.05], 0.15),
    ];
    parts.extend(Part::wheels(&[-0.62 * l, l - 1.15], 0.48, w, 0.3, TYRE));
    Solid::new(parts)
}

pub(super) fn bus([length, width, height]: [f64; 3], paint: f64) -> Solid {
    let (l, h, w) = (length / 2.0, height, width / 2.0);
    let (sill, lintel) = (0.38 * h, 0.76 * h);
    let mut parts = vec![
        Part::block([-l, -w, 0.3], [l, w, sill], paint),
        glass(Shape::block([-l + 0.02, -w + 0.02, sill], [l - 0.02, w - 0.02, lintel])),
        Part::block([-l, -w, lintel], [l, w, h], paint),
    ];
    for pillar in [-0.995, -0.6, -0.2, 0.2, 0.6, 0.97] {
        parts.push(Part::block(
            [pillar * l, -w, sill],
            [pillar * l + 0.12, w, lintel],
            paint,
        ));
    }
    for seat in [-0.75, -0.4, 0.05, 0.4] {
        parts.push(Part::block(
            [seat * l, -w + 0.15, sill],
            [seat * l + 0.15, -0.3, sill + 0.55],
            0.25,
        ));
        parts.push(Part::block(
            [seat * l, 0.3, sill],
            [seat * l + 0.15, w - 0.15, sill + 0.55],
            0.25,
        ));
    }
    parts.extend(Part::wheels(&[-0.5 * l, 0.55 * l], 0.48, w, 0.3, TYRE));
    Solid::new(parts)
}
