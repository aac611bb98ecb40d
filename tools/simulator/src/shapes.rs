//! Bodies as sensors meet them: rounded, and smaller than the boxes that people draw around them.
//!
//! Labels stand off the metal: recorded returns from the lower bodies of cars lie 0.17 to 0.30 m inside along the ray.
//! Mirrors reach the box's sides.

use crate::bodies::{Class, figure, rider, walker};
use crate::random::Stream;
use crate::solid::{Part, Shape, Solid, prism};

const TYRE: f64 = 0.05;
const GLASS: f64 = 0.1;

/// Paint and glass of a vehicle.
struct Look {
    paint: f64,
    /// Share of the rays that pass a window; the others meet the glass, what is on it or just behind.
    pass: f64,
}

impl Look {
    fn draw(draws: &mut Stream) -> Self {
        // Black paint mirrors: hardly anything comes back from afar.
        let paint = match draws.chance(0.12) {
            true => draws.between(0.003, 0.012),
            false => draws.between(0.05, 0.8),
        };
        Look {
            paint,
            pass: draws.between(0.15, 0.55),
        }
    }

    fn metal(&self, shape: Shape) -> Part {
        Part::solid(shape, self.paint)
    }

    fn window(&self, shape: Shape) -> Part {
        Part {
            shape,
            rho: GLASS,
            pass: self.pass,
        }
    }
}

/// A prism whose upright edges are cut: corners of the plan lose `cut` m along both sides.
fn rounded(outline: &[[f64; 2]], half_width: f64, top: f64, cut: f64) -> Shape {
    let Shape::Hull(mut planes) = prism(outline, half_width, top) else {
        unreachable!("a prism is a hull");
    };
    let ends = outline.iter().map(|p| p[0]);
    let [rear, front] = ends.fold([f64::MAX, f64::MIN], |[a, b], x| [a.min(x), b.max(x)]);
    for (side, x) in [(-1.0, rear), (1.0, front)] {
        for left in [-1.0, 1.0] {
            let n = std::f64::consts::FRAC_1_SQRT_2;
            planes.push([side * n, left * n, 0.0, n * (side * x + half_width - cut)]);
        }
    }
    Shape::Hull(planes)
}

/// A block with cut upright edges.
fn rounded_block([x0, x1]: [f64; 2], half_width: f64, [z0, z1]: [f64; 2], cut: f64) -> Shape {
    rounded(&[[x0, z0], [x1, z0], [x1, z1], [x0, z1]], half_width, half_width, cut)
}

/// Mirrors that reach from the body to the sides of the box.
fn mirrors(x: f64, [from, to]: [f64; 2], [z0, z1]: [f64; 2]) -> [Part; 2] {
    [-1.0, 1.0].map(|side: f64| {
        let (a, b) = (side * from, side * to);
        Part::block([x - 0.08, a.min(b), z0], [x + 0.08, a.max(b), z1], 0.2)
    })
}

impl Class {
    /// Length, width and height as people label them in recorded clouds, m (DAIR-V2X: 266 cars, 22 vans, 11 buses, 10
    /// motorcyclists, 6 tricycles).
    pub fn labelled_size(self, draws: &mut Stream) -> [f64; 3] {
        let mut draw = |mean, deviation, low, high| draws.normal_in(mean, deviation, low, high);
        match self {
            Class::Car => [
                draw(4.32, 0.3, 3.6, 5.0),
                draw(1.93, 0.12, 1.7, 2.15),
                draw(1.55, 0.14, 1.38, 1.85),
            ],
            Class::Van => [
                draw(4.6, 0.2, 4.2, 5.1),
                draw(2.1, 0.14, 1.85, 2.4),
                draw(2.05, 0.13, 1.85, 2.4),
            ],
            Class::Bus => [
                draw(11.49, 0.71, 10.0, 12.2),
                draw(2.82, 0.12, 2.6, 3.0),
                draw(3.5, 0.2, 3.1, 3.9),
            ],
            Class::Motorcycle => [
                draw(1.76, 0.12, 1.6, 2.1),
                draw(0.81, 0.04, 0.72, 0.9),
                draw(1.5, 0.12, 1.3, 1.75),
            ],
            _ => self.size(draws),
        }
    }

    /// A rounded body within a box of this size: x forward from the box's centre, z = 0 on the ground.
    pub fn shape(self, size: [f64; 3], draws: &mut Stream) -> Solid {
        let look = Look::draw(draws);
        match self {
            Class::Car => car(size, &look, draws),
            Class::Van => van(size, &look, draws),
            Class::Truck | Class::Articulated => truck(size, &look, draws),
            Class::Bus => bus(size, &look, draws),
            Class::Bicycle => rider(size.map(|s| 0.97 * s), look.paint, 0.02),
            Class::Motorcycle | Class::Scooter => rider(size.map(|s| 0.97 * s), look.paint, 0.12),
            Class::Tricycle => tricycle(size, &look, draws),
            Class::Pedestrian | Class::Child => walker(size, 0.15 + 0.5 * look.paint),
            Class::Pram => pram(size, &look),
        }
    }
}

fn car([length, width, height]: [f64; 3], look: &Look, draws: &mut Stream) -> Solid {
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

fn van([length, width, height]: [f64; 3], look: &Look, draws: &mut Stream) -> Solid {
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

/// A lorry; from 11 m on, a tractor with a trailer behind a gap.
fn truck([length, width, height]: [f64; 3], look: &Look, draws: &mut Stream) -> Solid {
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

fn bus([length, width, height]: [f64; 3], look: &Look, draws: &mut Stream) -> Solid {
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

/// A cargo tricycle: one wheel and the rider in front, a bed with boards behind, loaded or not.
fn tricycle([length, width, height]: [f64; 3], look: &Look, draws: &mut Stream) -> Solid {
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
fn pram([length, width, height]: [f64; 3], look: &Look) -> Solid {
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

#[cfg(test)]
mod tests {
    use super::*;

    const ALL: [Class; 12] = [
        Class::Car,
        Class::Van,
        Class::Truck,
        Class::Bus,
        Class::Motorcycle,
        Class::Bicycle,
        Class::Scooter,
        Class::Tricycle,
        Class::Articulated,
        Class::Pedestrian,
        Class::Child,
        Class::Pram,
    ];

    #[test]
    fn bodies_lie_within_their_boxes_and_nearly_fill_them() {
        for class in ALL {
            for index in 0..100 {
                let mut draws = Stream::new(7, "shape", index);
                let size = class.labelled_size(&mut draws);
                let body = class.shape(size, &mut draws);
                let low = [-size[0] / 2.0, -size[1] / 2.0, 0.0];
                let high = [size[0] / 2.0, size[1] / 2.0, size[2]];
                for k in 0..3 {
                    let (a, b) = (body.low[k] - low[k], high[k] - body.high[k]);
                    assert!(a > -1e-6 && b > -1e-6, "{class:?} axis {k}: {a} and {b} inside");
                    assert!(a < 0.25 && b < 0.25, "{class:?} axis {k}: {a} and {b} inside");
                }
            }
        }
    }

    /// Sizes against the boxes that people drew in recorded clouds: mean within 4 %, all within what was measured.
    #[test]
    fn sizes_are_those_that_people_label() {
        type Case = (Class, [f64; 3], [[f64; 2]; 3]);
        let cases: [Case; 5] = [
            (Class::Car, [4.32, 1.93, 1.55], [[3.6, 5.4], [1.6, 2.3], [1.3, 1.95]]),
            (Class::Van, [4.6, 2.1, 2.05], [[4.1, 5.2], [1.75, 2.5], [1.5, 2.4]]),
            (Class::Bus, [11.4, 2.83, 3.5], [[10.0, 12.7], [2.55, 3.1], [2.7, 3.9]]),
            (
                Class::Motorcycle,
                [1.78, 0.8, 1.5],
                [[1.5, 2.15], [0.4, 1.0], [1.1, 1.8]],
            ),
            (Class::Tricycle, [2.9, 1.2, 1.55], [[2.5, 3.15], [1.0, 1.5], [1.4, 1.8]]),
        ];
        for (class, mean, limits) in cases {
            let sizes: Vec<[f64; 3]> = (0..500)
                .map(|index| class.labelled_size(&mut Stream::new(3, "size", index)))
                .collect();
            for k in 0..3 {
                let [low, high] = limits[k];
                assert!(
                    sizes.iter().all(|size| (low..=high).contains(&size[k])),
                    "{class:?} axis {k}"
                );
                let found = sizes.iter().map(|size| size[k]).sum::<f64>() / 500.0;
                assert!((found / mean[k] - 1.0).abs() < 0.04, "{class:?} axis {k}: {found}");
            }
        }
    }

    #[test]
    fn first_returns_from_lower_bodies_lie_inside_the_label() {
        let (mut depths, mut count) = (0.0, 0);
        for index in 0..400u64 {
            let mut draws = Stream::new(9, "shape", index);
            let size = Class::Car.labelled_size(&mut draws);
            let body = Class::Car.shape(size, &mut draws);
            let angle = draws.between(0.0, std::f64::consts::TAU);
            let (sin, cos) = libm::sincos(angle);
            let aside = draws.between(-0.6, 0.6);
            let origin = [-20.0 * cos - aside * sin, -20.0 * sin + aside * cos, 0.6];
            let ray = [cos, sin, 0.0];
            let Some(hit) = body.cast(origin, ray, 50.0, index, 0.0) else {
                continue;
            };
            let enters = (0..2)
                .map(|k| (-0.5 * size[k] * ray[k].signum() - origin[k]) / ray[k])
                .fold(f64::MIN, f64::max);
            depths += hit.t - enters;
            count += 1;
        }
        let mean = depths / f64::from(count);
        assert!(
            count > 380 && (0.1..0.35).contains(&mean),
            "{mean} m inside, {count} rays"
        );
    }
}
