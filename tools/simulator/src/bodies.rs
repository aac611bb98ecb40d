//! The road users: classes, sizes and bodies.

mod people;
mod vehicles;

use crate::random::Stream;
use crate::solid::Solid;
pub(crate) use people::{figure, rider, walker};
use vehicles::{bus, car, truck, van};

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
