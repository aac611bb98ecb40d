//! Bodies as sensors meet them: rounded, and smaller than the boxes that people draw around them.
//!
//! Labels stand off the metal: recorded returns from the lower bodies of cars lie 0.17 to 0.30 m inside along the ray.
//! Mirrors reach the box's sides.

mod cars;
mod heavy;
mod light;

use crate::bodies::{Class, rider, walker};
use crate::random::Stream;
use crate::solid::{Part, Shape, Solid, prism};
use cars::{car, van};
use heavy::{bus, truck};
use light::{pram, tricycle};

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
