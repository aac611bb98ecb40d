//! A made-up world: flat ground with cars on it, and agents whose LiDARs see both. It is right-handed, z up; the cars stand a
//! little above the ground, and points on them are inside of their boxes.

use nalgebra::{Matrix4, Point3, Vector4};

/// A car: middle, heading in degrees, and length, width, height.
#[derive(Clone, Copy)]
pub struct Car {
    pub id: u64,
    pub center: [f64; 3],
    pub yaw: f64,
    pub size: [f64; 3],
}

/// An agent at its first frame: place of its LiDAR and roll, yaw, pitch in degrees, as a right-handed set composes them.
#[derive(Clone, Copy)]
pub struct Agent {
    pub folder: &'static str,
    pub six: [f64; 6],
    /// What it moves a frame, m.
    pub step: [f64; 2],
    /// Cars that its side labels.
    pub labels: &'static [u64],
}

/// Cars of all tests.
pub const CARS: [Car; 4] = [
    car(11, [12.0, 6.0], 30.0),
    car(12, [20.0, -5.0], -75.0),
    car(13, [5.0, -12.0], 170.0),
    car(14, [30.0, 9.0], 0.0),
];

const fn car(id: u64, [x, y]: [f64; 2], yaw: f64) -> Car {
    Car {
        id,
        center: [x, y, 1.0],
        yaw,
        size: [4.4, 1.8, 1.5],
    }
}

/// Points on each car, of each agent.
pub const ON_A_CAR: u32 = 320;

/// Rows and columns of the matrix that CARLA's six numbers make.
pub fn matrix([x, y, z, roll, yaw, pitch]: [f64; 6]) -> Matrix4<f64> {
    let [(sr, cr), (sy, cy), (sp, cp)] = [roll, yaw, pitch].map(|angle: f64| angle.to_radians().sin_cos());
    Matrix4::new(
        cp * cy,
        cy * sp * sr - sy * cr,
        -cy * sp * cr - sy * sr,
        x,
        sy * cp,
        sy * sp * sr + cy * cr,
        -sy * sp * cr + cy * sr,
        y,
        sp,
        -cp * sr,
        cp * cr,
        z,
        0.0,
        0.0,
        0.0,
        1.0,
    )
}

/// The matrix that mirrors y.
pub fn mirror() -> Matrix4<f64> {
    Matrix4::from_diagonal(&Vector4::new(1.0, -1.0, 1.0, 1.0))
}

impl Agent {
    pub fn at(&self, frame: u64) -> [f64; 6] {
        let [x, y, z, roll, yaw, pitch] = self.six;
        let [dx, dy] = self.step.map(|step| step * frame as f64);
        [x + dx, y + dy, z, roll, yaw, pitch]
    }

    /// Points in the map that it sees at a frame; no two agents see the same.
    pub fn sees(&self, frame: u64, number: usize) -> Vec<Point3<f64>> {
        let [x, y, ..] = self.at(frame);
        let aside = 0.01 * number as f64;
        let mut points = Vec::new();
        for i in -30..=30 {
            for k in -30..=30 {
                points.push(Point3::new(x + f64::from(i) + aside, y + f64::from(k) + aside, 0.0));
            }
        }
        let near = CARS
            .iter()
            .filter(|car| (car.center[0] - x).hypot(car.center[1] - y) < 1000.0);
        points.extend(near.flat_map(|car| car.points(aside)));
        points
    }
}

impl Car {
    /// Its pose, in a frame that is right-handed.
    pub fn pose(&self) -> Matrix4<f64> {
        let [x, y, z] = self.center;
        matrix([x, y, z, 0.0, self.yaw, 0.0])
    }

    /// Points 5 cm inside of its sides.
    pub fn points(&self, aside: f64) -> Vec<Point3<f64>> {
        let [length, width, height] = self.size.map(|metres| metres / 2.0 - 0.05);
        let mut points = Vec::new();
        for i in 0..16 {
            for k in 0..5 {
                let (along, up) = (
                    f64::from(i) / 16.0 * 2.0 - 1.0 + aside,
                    f64::from(k) / 5.0 * 2.0 - 1.0 + aside,
                );
                let sides = [
                    [along * length, width],
                    [along * length, -width],
                    [length, along * width],
                    [-length, along * width],
                ];
                points.extend(sides.map(|[u, v]| self.pose().transform_point(&Point3::new(u, v, up * height))));
            }
        }
        points
    }
}
