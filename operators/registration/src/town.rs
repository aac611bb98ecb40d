//! A street of boxes for tests, and a LiDAR that drives through it.

use damage::Draw;
use nalgebra::{Isometry3, Point3, UnitQuaternion, Vector3};
use realo_schemas::PointCloud;

/// Where the LiDAR is in the body frame, m.
pub const SENSOR: [f64; 3] = [0.0, 0.0, 1.9];
const MAX_RANGE: f64 = 100.0;

/// A box that stands on the ground.
#[derive(Clone, Copy)]
pub struct Block {
    place: [f64; 2],
    half: [f64; 2],
    height: f64,
    cos_sin: [f64; 2],
}

impl Block {
    pub fn new(place: [f64; 2], [length, width]: [f64; 2], height: f64, yaw: f64) -> Self {
        Block {
            place,
            half: [0.5 * length, 0.5 * width],
            height,
            cos_sin: [libm::cos(yaw), libm::sin(yaw)],
        }
    }

    pub fn car(place: [f64; 2]) -> Self {
        Block::new(place, [4.5, 1.9], 1.5, 0.0)
    }

    /// Where a ray comes in, as a multiple of its direction.
    fn enters(&self, from: &Point3<f64>, direction: &Vector3<f64>) -> Option<f64> {
        let [cos, sin] = self.cos_sin;
        let turn = |x: f64, y: f64| [cos * x + sin * y, cos * y - sin * x];
        let [x, y] = turn(from.x - self.place[0], from.y - self.place[1]);
        let [dx, dy] = turn(direction.x, direction.y);
        let slabs = [
            (x, dx, [-self.half[0], self.half[0]]),
            (y, dy, [-self.half[1], self.half[1]]),
            (from.z, direction.z, [0.0, self.height]),
        ];
        let (mut enter, mut leave) = (0.0f64, f64::INFINITY);
        for (at, along, [low, high]) in slabs {
            let [a, b] = [(low - at) / along, (high - at) / along];
            (enter, leave) = (enter.max(a.min(b)), leave.min(a.max(b)));
        }
        (enter < leave && enter > 0.0).then_some(enter)
    }
}

/// What stands around.
#[derive(Clone)]
pub struct Town(pub Vec<Block>);

impl Town {
    /// A street along x from `from` to `to`: houses of all kinds with gaps on both sides, poles, parked cars.
    pub fn street(seed: u64, from: f64, to: f64) -> Self {
        let mut draw = Draw::new(seed);
        let mut number = |low: f64, high: f64| low + (high - low) * draw.below(1_000_000) as f64 * 1e-6;
        let mut blocks = Vec::new();
        for side in [-1.0, 1.0] {
            let mut x = from;
            while x < to {
                let (length, depth, height) = (number(6.0, 20.0), number(6.0, 10.0), number(4.0, 12.0));
                let y = side * (number(11.0, 14.0) + 0.5 * depth);
                blocks.push(Block::new(
                    [x + 0.5 * length, y],
                    [length, depth],
                    height,
                    number(-0.06, 0.06),
                ));
                blocks.push(Block::new(
                    [x + number(0.0, length), side * number(8.0, 9.5)],
                    [0.3, 0.3],
                    6.0,
                    0.4,
                ));
                if number(0.0, 1.0) < 0.4 {
                    blocks.push(Block::car([x + number(0.0, length), side * number(6.0, 6.5)]));
                }
                x += length + number(0.5, 8.0);
            }
        }
        Town(blocks)
    }

    /// Two walls without end along x, and nothing else.
    pub fn walls() -> Self {
        Town(
            [-12.0, 12.0]
                .map(|y| Block::new([0.0, y], [1000.0, 2.0], 8.0, 0.0))
                .into(),
        )
    }

    pub fn with(&self, block: Block) -> Self {
        let mut town = self.clone();
        town.0.push(block);
        town
    }

    /// A sweep from a pose, with 2 cm of noise along the rays.
    pub fn sweep(&self, map_from_body: &Isometry3<f64>, beams: usize, columns: usize, seed: u64) -> PointCloud {
        let mut draw = Draw::new(seed);
        let sensor = map_from_body * Point3::from(SENSOR);
        let near = |block: &&Block| {
            let [x, y] = block.place;
            (x - sensor.x).abs() < MAX_RANGE + block.half[0] && (y - sensor.y).abs() < MAX_RANGE + block.half[1]
        };
        let blocks: Vec<&Block> = self.0.iter().filter(near).collect();
        let mut axes = [const { Vec::<f32>::new() }; 3];
        for column in 0..columns {
            let azimuth = std::f64::consts::TAU * column as f64 / columns as f64;
            for beam in 0..beams {
                let elevation = (-25.0 + 40.0 * beam as f64 / beams as f64).to_radians();
                let flat = libm::cos(elevation);
                let direction = Vector3::new(
                    flat * libm::cos(azimuth),
                    flat * libm::sin(azimuth),
                    libm::sin(elevation),
                );
                let in_map = map_from_body.rotation * direction;
                let hits = blocks.iter().filter_map(|block| block.enters(&sensor, &in_map));
                let ground = if in_map.z < 0.0 {
                    -sensor.z / in_map.z
                } else {
                    f64::INFINITY
                };
                let range = hits.fold(ground, f64::min);
                if range > MAX_RANGE {
                    continue;
                }
                let noise = (0..4).map(|_| draw.below(1000) as f64 * 1e-3 - 0.5).sum::<f64>() * 0.035;
                let point = Point3::from(SENSOR) + direction * (range + noise);
                axes.iter_mut()
                    .zip(point.iter())
                    .for_each(|(axis, value)| axis.push(*value as f32));
            }
        }
        let [x, y, z] = axes;
        let n = x.len();
        PointCloud::new(x, y, z, vec![0; n], vec![0; n], vec![0; n]).unwrap()
    }
}

/// A pose on the street, level.
pub fn pose(x: f64, y: f64, yaw: f64) -> Isometry3<f64> {
    Isometry3::from_parts(
        Vector3::new(x, y, 0.0).into(),
        UnitQuaternion::from_euler_angles(0.0, 0.0, yaw),
    )
}
