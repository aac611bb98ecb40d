//! The road users: classes, sizes and bodies.

use crate::random::Stream;
use crate::solid::{Part, Shape, Solid, prism};

/// What a road user is, named as V2X-Real's raw classes name it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Class {
    Car,
    Van,
    Truck,
    Bus,
    Motorcycle,
    Bicycle,
    Scooter,
    /// Three wheels and a bed for loads, motorised.
    Tricycle,
    /// A lorry with a trailer: one body.
    Articulated,
    Pedestrian,
    Child,
    /// Somebody and the pram that he pushes: one body.
    Pram,
}

impl Class {
    /// The raw class name; V2X-Real spells the motorcycle's so.
    pub fn name(self) -> &'static str {
        match self {
            Class::Car => "Car",
            Class::Van => "Van",
            Class::Truck | Class::Articulated => "Truck",
            Class::Bus => "Bus",
            Class::Motorcycle | Class::Tricycle => "MotorcyleRider",
            Class::Bicycle => "BicycleRider",
            Class::Scooter => "ScooterRider",
            Class::Pedestrian | Class::Pram => "Pedestrian",
            Class::Child => "Child",
        }
    }

    pub fn walks(self) -> bool {
        matches!(self, Class::Pedestrian | Class::Child | Class::Pram)
    }

    /// Whether it keeps to straight lanes because it is too long to turn in one.
    pub fn long(self) -> bool {
        matches!(self, Class::Truck | Class::Articulated | Class::Bus)
    }

    /// Length, width and height, m.
    pub fn size(self, draws: &mut Stream) -> [f64; 3] {
        let mut draw = |mean, deviation, low, high| draws.normal_in(mean, deviation, low, high);
        match self {
            Class::Car => [
                draw(4.38, 0.25, 3.7, 4.7),
                draw(1.85, 0.05, 1.72, 1.95),
                draw(1.53, 0.08, 1.4, 1.72),
            ],
            Class::Van => [
                draw(4.9, 0.25, 4.5, 5.5),
                draw(2.0, 0.06, 1.88, 2.1),
                draw(2.05, 0.13, 1.85, 2.4),
            ],
            Class::Truck => [
                draw(8.6, 0.8, 6.8, 10.2),
                draw(2.45, 0.05, 2.3, 2.55),
                draw(3.2, 0.25, 2.8, 3.7),
            ],
            Class::Bus => [draw(11.6, 0.4, 10.6, 12.2), 2.55, draw(3.2, 0.12, 3.0, 3.5)],
            Class::Motorcycle => [
                draw(2.1, 0.08, 1.95, 2.25),
                draw(0.8, 0.04, 0.72, 0.9),
                draw(1.5, 0.06, 1.4, 1.65),
            ],
            Class::Bicycle => [
                draw(1.76, 0.06, 1.62, 1.9),
                draw(0.6, 0.04, 0.52, 0.7),
                draw(1.72, 0.08, 1.5, 1.9),
            ],
            Class::Scooter => [
                draw(1.8, 0.06, 1.66, 1.95),
                draw(0.75, 0.04, 0.66, 0.84),
                draw(1.5, 0.07, 1.35, 1.65),
            ],
            Class::Tricycle => [
                draw(2.9, 0.12, 2.6, 3.1),
                draw(1.2, 0.08, 1.05, 1.4),
                draw(1.55, 0.1, 1.4, 1.8),
            ],
            Class::Articulated => [
                draw(15.6, 0.9, 13.5, 16.5),
                draw(2.55, 0.04, 2.45, 2.65),
                draw(3.8, 0.15, 3.4, 4.0),
            ],
            Class::Pram => [
                draw(1.62, 0.07, 1.48, 1.78),
                draw(0.6, 0.03, 0.54, 0.66),
                draw(1.69, 0.08, 1.5, 1.9),
            ],
            Class::Pedestrian => [
                draw(0.66, 0.05, 0.54, 0.78),
                draw(0.56, 0.04, 0.48, 0.66),
                draw(1.71, 0.09, 1.5, 1.95),
            ],
            Class::Child => [
                draw(0.5, 0.04, 0.42, 0.58),
                draw(0.42, 0.03, 0.36, 0.48),
                draw(1.2, 0.12, 0.95, 1.45),
            ],
        }
    }

    /// A body that fills a box of this size: x forward from the box's centre, z = 0 on the ground.
    pub fn body(self, size: [f64; 3], draws: &mut Stream) -> Solid {
        let paint = 0.06 + 0.74 * draws.unit();
        match self {
            Class::Car => car(size, paint),
            Class::Van => van(size, paint),
            Class::Truck => truck(size, paint),
            Class::Bus => bus(size, paint),
            Class::Bicycle => rider(size, paint, 0.02),
            Class::Motorcycle | Class::Scooter => rider(size, paint, 0.12),
            Class::Pedestrian | Class::Child => walker(size, 0.15 + 0.5 * paint),
            Class::Tricycle | Class::Articulated | Class::Pram => self.shape(size, draws),
        }
    }
}

const TYRE: f64 = 0.06;
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

fn car([length, width, height]: [f64; 3], paint: f64) -> Solid {
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

fn van([length, width, height]: [f64; 3], paint: f64) -> Solid {
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

fn truck([length, width, height]: [f64; 3], paint: f64) -> Solid {
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

fn bus([length, width, height]: [f64; 3], paint: f64) -> Solid {
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

/// Somebody on two wheels; `frame` is half the machine's own width.
pub(crate) fn rider([length, width, height]: [f64; 3], paint: f64, frame: f64) -> Solid {
    let (l, h, w) = (length / 2.0, height, width / 2.0);
    let radius: f64 = if frame > 0.05 { 0.26 } else { 0.34 };
    let tread = frame.max(0.03);
    let wheel = |x: f64| {
        Part::solid(
            Shape::Wheel {
                x,
                z: radius,
                radius,
                low: -tread,
                high: tread,
            },
            TYRE,
        )
    };
    let (hip, shoulder) = (0.5 * h, 0.84 * h);
    let leg = |y: f64| {
        Part::solid(
            Shape::Post {
                x: 0.0,
                y,
                radius: 0.075,
                low: 0.2,
                high: hip + 0.05,
                swing: 0.08,
            },
            0.25,
        )
    };
    let bar = 0.58 * h;
    Solid::new(vec![
        wheel(-l + radius),
        wheel(l - radius),
        Part::block(
            [-l + radius, -frame, 0.3],
            [l - radius, frame, 0.46 * h],
            0.3 * paint + 0.05,
        ),
        Part::block([0.42 * l, -w, bar], [0.42 * l + 0.06, w, bar + 0.06], 0.2),
        leg(-0.13),
        leg(0.13),
        Part::solid(
            Shape::Ball {
                center: [-0.02, 0.0, (hip + shoulder) / 2.0],
                radii: [0.2, 0.22, 0.24 * h],
            },
            0.15 + 0.5 * paint,
        ),
        Part::block(
            [0.0, -w + 0.08, 0.7 * h],
            [0.44 * l, w - 0.08, 0.7 * h + 0.1],
            0.15 + 0.5 * paint,
        ),
        Part::solid(
            Shape::Ball {
                center: [0.08, 0.0, h - 0.13],
                radii: [0.11, 0.1, 0.13],
            },
            0.3,
        ),
    ])
}

pub(crate) fn walker(size: [f64; 3], cloth: f64) -> Solid {
    Solid::new(figure(size, cloth, 0.0))
}

/// The parts of somebody on foot whose middle is `x` ahead of the body's.
pub(crate) fn figure([length, width, height]: [f64; 3], cloth: f64, x: f64) -> Vec<Part> {
    let (l, h, w) = (length / 2.0, height, width / 2.0);
    let (hip, shoulder) = (0.5 * h, 0.84 * h);
    let leg = 0.045 * h;
    let arm = 0.03 * h;
    let limb = |y: f64, radius: f64, low: f64, high: f64, swing: f64| {
        Part::solid(
            Shape::Post {
                x,
                y,
                radius,
                low,
                high,
                swing,
            },
            cloth,
        )
    };
    let head = 0.07 * h;
    vec![
        limb(-0.3 * w, leg, 0.0, hip, l - leg),
        limb(0.3 * w, leg, 0.0, hip, -(l - leg)),
        limb(-w + arm, arm, 0.45 * h, shoulder, -(l - arm) * 0.7),
        limb(w - arm, arm, 0.45 * h, shoulder, (l - arm) * 0.7),
        Part::solid(
            Shape::Ball {
                center: [x, 0.0, 0.66 * h],
                radii: [0.075 * h, w - 1.6 * arm, 0.21 * h],
            },
            cloth,
        ),
        Part::solid(
            Shape::Ball {
                center: [x + 0.02, 0.0, h - 0.085 * h],
                radii: [head, 0.9 * head, 0.085 * h],
            },
            0.4,
        ),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn box_encloses_the_body_tightly() {
        use Class::*;
        for class in [Car, Van, Truck, Bus, Motorcycle, Bicycle, Scooter, Pedestrian, Child] {
            for index in 0..50 {
                let mut draws = Stream::new(7, "body", index);
                let size = class.size(&mut draws);
                let body = class.body(size, &mut draws);
                let low = [-size[0] / 2.0, -size[1] / 2.0, 0.0];
                let high = [size[0] / 2.0, size[1] / 2.0, size[2]];
                for k in 0..3 {
                    assert!(
                        (body.low[k] - low[k]).abs() < 1e-6,
                        "{class:?} axis {k}: {} for {}",
                        body.low[k],
                        low[k]
                    );
                    assert!(
                        (body.high[k] - high[k]).abs() < 1e-6,
                        "{class:?} axis {k}: {} for {}",
                        body.high[k],
                        high[k]
                    );
                }
            }
        }
    }
}
