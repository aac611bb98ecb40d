use nalgebra::{Isometry3, Point3};

/// The eight corners of a box: rear and front, right and left, below and above its centre, in the order of V2X-Real:
/// front-right, front-left, rear-left, rear-right of the bottom, then of the top.
pub type Corners = [[f64; 3]; 8];

/// Signs of (length, width, height) at each corner.
const SIGNS: [[f64; 3]; 8] = [
    [1.0, -1.0, -1.0],
    [1.0, 1.0, -1.0],
    [-1.0, 1.0, -1.0],
    [-1.0, -1.0, -1.0],
    [1.0, -1.0, 1.0],
    [1.0, 1.0, 1.0],
    [-1.0, 1.0, 1.0],
    [-1.0, -1.0, 1.0],
];

/// A box as centre, extents and heading, without anything else that is known of it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Cuboid {
    /// Centre, m.
    pub center: [f64; 3],
    /// Length, width, height, m.
    pub extent: [f64; 3],
    /// Heading, rad from +x towards +y.
    pub yaw: f64,
}

impl Cuboid {
    /// Its corners.
    pub fn corners(&self) -> Corners {
        let (sin, cos) = libm::sincos(self.yaw);
        SIGNS.map(|sign| {
            let [x, y, z] = [0, 1, 2].map(|axis| sign[axis] * self.extent[axis] / 2.0);
            [
                self.center[0] + x * cos - y * sin,
                self.center[1] + x * sin + y * cos,
                self.center[2] + z,
            ]
        })
    }

    /// The gravity-aligned box of eight corners, which may be tilted or rounded: centre of the corners, mean lengths of
    /// the edges, mean direction of the lengthwise edges on the ground plane.
    pub fn from_corners(corners: &Corners) -> Self {
        // Opposite corners only, as every edge meets one of them: the mean of all.
        let mean = |axis: usize| [0, 3, 5, 6].iter().map(|i| corners[*i][axis]).sum::<f64>() / 4.0;
        let edges = |pairs: [[usize; 2]; 4]| {
            pairs.map(|[from, to]| [0, 1, 2].map(|axis| corners[to][axis] - corners[from][axis]))
        };
        let lengthwise = edges([[3, 0], [2, 1], [7, 4], [6, 5]]);
        let across = edges([[0, 1], [3, 2], [4, 5], [7, 6]]);
        let upright = edges([[0, 4], [1, 5], [2, 6], [3, 7]]);
        let length = |edges: &[[f64; 3]; 4]| edges.iter().map(|e| Point3::from(*e).coords.norm()).sum::<f64>() / 4.0;
        let direction = [0, 1].map(|axis| lengthwise.iter().map(|edge| edge[axis]).sum::<f64>());
        Cuboid {
            center: [mean(0), mean(1), mean(2)],
            extent: [length(&lengthwise), length(&across), length(&upright)],
            yaw: libm::atan2(direction[1], direction[0]),
        }
    }
}

/// Corners brought to another frame.
pub fn transform_corners(to_from_from: &Isometry3<f64>, corners: &Corners) -> Corners {
    corners.map(|corner| (to_from_from * Point3::from(corner)).into())
}

/// Number of corners inside a volume, its faces included.
pub fn corners_inside(corners: &Corners, least: [f64; 3], greatest: [f64; 3]) -> usize {
    let inside = |corner: &&[f64; 3]| (0..3).all(|axis| (least[axis]..=greatest[axis]).contains(&corner[axis]));
    corners.iter().filter(inside).count()
}

/// Least and greatest of all corners, along x, y, z.
pub fn corner_hull(corners: &Corners) -> [[f64; 3]; 2] {
    let along = |axis: usize, fold: fn(f64, f64) -> f64, start: f64| corners.iter().map(|c| c[axis]).fold(start, fold);
    [
        [0, 1, 2].map(|axis| along(axis, f64::min, f64::INFINITY)),
        [0, 1, 2].map(|axis| along(axis, f64::max, f64::NEG_INFINITY)),
    ]
}

/// `map_from_frame` of a pose vector as CARLA and V2X-Real write it: x, y, z in metres, then roll, yaw, pitch in
/// degrees, where a positive pitch lifts the nose and a positive roll lowers the right side.
pub fn pose_from_carla([x, y, z, roll, yaw, pitch]: [f64; 6]) -> Isometry3<f64> {
    let rotation =
        nalgebra::UnitQuaternion::from_euler_angles(-roll.to_radians(), -pitch.to_radians(), yaw.to_radians());
    Isometry3::from_parts(nalgebra::Translation3::new(x, y, z), rotation)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn near(a: f64, b: f64) -> bool {
        (a - b).abs() < 1e-12
    }

    #[test]
    fn corners_lead_back_to_the_box() {
        for yaw in [0.0, 0.7, 3.1, -3.1, std::f64::consts::PI] {
            let cuboid = Cuboid {
                center: [3.0, -4.0, 1.0],
                extent: [4.5, 1.9, 1.5],
                yaw,
            };
            let back = Cuboid::from_corners(&cuboid.corners());
            assert!((0..3).all(|i| near(back.center[i], cuboid.center[i]) && near(back.extent[i], cuboid.extent[i])));
            assert!(near((back.yaw - yaw).cos(), 1.0), "{yaw} {}", back.yaw);
        }
    }

    #[test]
    fn corners_start_front_right_below() {
        let corners = Cuboid {
            center: [0.0; 3],
            extent: [4.0, 2.0, 1.0],
            yaw: 0.0,
        }
        .corners();
        assert_eq!(corners[0], [2.0, -1.0, -0.5]);
        assert_eq!(corners[6], [-2.0, 1.0, 0.5]);
        assert_eq!(corner_hull(&corners), [[-2.0, -1.0, -0.5], [2.0, 1.0, 0.5]]);
        assert_eq!(corners_inside(&corners, [0.0, -1.0, -1.0], [2.0, 0.0, 0.0]), 1);
    }

    #[test]
    fn carla_pitch_lifts_the_nose_and_roll_lowers_the_right() {
        let nose = pose_from_carla([0.0, 0.0, 0.0, 0.0, 90.0, 30.0]) * Point3::new(1.0, 0.0, 0.0);
        assert!(
            near(nose.x, 0.0) && near(nose.y, 0.75f64.sqrt()) && near(nose.z, 0.5),
            "{nose}"
        );
        let side = pose_from_carla([0.0, 0.0, 5.0, 30.0, 0.0, 0.0]) * Point3::new(0.0, 1.0, 0.0);
        assert!(near(side.y, 0.75f64.sqrt()) && near(side.z, 4.5), "{side}");
    }
}
