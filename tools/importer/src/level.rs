//! Level frames: which way is up, and where the ground lies below a sensor.

use std::fmt;

use nalgebra::{Isometry3, Matrix3, Translation3, UnitQuaternion, Vector3};
use realo_logs::Levelled;
use realo_schemas::geometry::{level_from_body, yaw_of};

use crate::pcd::Points;

/// By what a body frame is levelled.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Level {
    /// By the recorded pose: z is that of the map; the height over ground is known from elsewhere.
    #[default]
    Pose,
    /// By a plane through the ground around the sensor, which gives the height too.
    Ground,
    /// Not at all: the axes are the sensor's.
    None,
}

impl Level {
    /// All, with their names and what they mean.
    pub const ALL: &[(Level, &str, &str)] = &[
        (Level::Pose, "pose", ""),
        (Level::Ground, "ground", ""),
        (Level::None, "none", ""),
    ];

    /// `pose`, `ground` or `none`.
    pub fn as_str(self) -> &'static str {
        match self {
            Level::Pose => Levelled::BY_POSE,
            Level::Ground => Levelled::BY_GROUND,
            Level::None => Levelled::BY_NOTHING,
        }
    }
}

impl fmt::Display for Level {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(self.as_str())
    }
}

/// Body from sensor, where the sensor's rotation in a map with z up is known: the body's z is up, its x has the sensor's
/// heading, and its origin lies `height` below the sensor.
pub(crate) fn by_pose(map_from_sensor: &UnitQuaternion<f64>, height: f64) -> Isometry3<f64> {
    Isometry3::from_parts(Translation3::new(0.0, 0.0, height), level_from_body(map_from_sensor))
}

/// Body from sensor by the ground: z = 0 is the plane, z points away from it, and x has the sensor's heading.
pub(crate) fn by_ground(ground: &Plane) -> Isometry3<f64> {
    let up = ground.normal();
    // The smallest rotation leaves the heading on the plane as it is to second order; what it turns is turned back.
    let level = UnitQuaternion::rotation_between(&up, &Vector3::z()).unwrap_or_default();
    let heading = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), yaw_of(&level));
    let height = -ground.offset * up.z;
    Isometry3::from_parts(Translation3::new(0.0, 0.0, height), heading.inverse() * level)
}

/// Body from sensor of a sweep; `height`: of the sensor over the ground, m, where the ground does not say it.
pub(crate) fn body_from_sensor(
    level: Level,
    map_from_sensor: &UnitQuaternion<f64>,
    height: f64,
    cloud: &Points,
) -> Result<Isometry3<f64>, String> {
    Ok(match level {
        Level::Pose => by_pose(map_from_sensor, height),
        Level::Ground => {
            let points = cloud.x.iter().zip(&cloud.y).zip(&cloud.z);
            let points = points.map(|((x, y), z)| [*x, *y, *z]);
            by_ground(&Plane::of_ground(points, BELOW_A_SENSOR)?)
        }
        Level::None => Translation3::new(0.0, 0.0, height).into(),
    })
}

/// A plane z = `slope` · (x, y) + `offset`, m.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Plane {
    /// Rise along x and y.
    pub slope: [f64; 2],
    /// Height at the origin.
    pub offset: f64,
}

/// Points further away say little of the ground at the sensor, m.
const REACH: f64 = 40.0;
/// The ground lies no lower, m.
const LOWEST: f64 = -12.0;
/// In the frame of a sensor the ground at the sensor lies no higher, m.
pub const BELOW_A_SENSOR: f64 = -0.3;
/// In a frame that is on the ground already, the ground is at most so far from z = 0, m.
const AT_ZERO: f64 = 0.3;
/// Where the ground is at z = 0, at most one of so many points is below it: a hole, or a reflection.
const FEW_BELOW: usize = 50;
/// Width of the layers in which the commonest height is looked for, m.
const LAYER: f64 = 0.2;
/// A fit needs so many points near the plane.
const LEAST_POINTS: usize = 200;
/// Scale of the residuals at the first and the last of the rounds, m.
const FIRST_SCALE: f64 = 0.5;
const LAST_SCALE: f64 = 0.05;
const ROUNDS: usize = 40;

impl Plane {
    /// Unit normal, upwards.
    pub fn normal(&self) -> Vector3<f64> {
        Vector3::new(-self.slope[0], -self.slope[1], 1.0).normalize()
    }

    /// The plane of the ground within 40 m of the origin and below `highest`: from the commonest height, iteratively
    /// reweighted least squares, whose scale shrinks from 0.5 to 0.05 m. The same points give the same plane.
    ///
    /// # Errors
    /// Too few points near any plane.
    pub fn of_ground(points: impl Iterator<Item = [f64; 3]>, highest: f64) -> Result<Self, String> {
        let near = |[x, y, z]: &[f64; 3]| libm::hypot(*x, *y) < REACH && (LOWEST..highest).contains(z);
        let layer = |z: f64| ((z - LOWEST) / LAYER) as usize;
        // Cells rather than points: near the sensor points lie a hundred times as dense.
        let mut cells = std::collections::BTreeMap::<[i64; 3], ([f64; 3], u32)>::new();
        for point in points.filter(near) {
            let cell = point.map(|v| (v / LAYER).floor() as i64);
            let (sum, count) = cells.entry(cell).or_default();
            (0..3).for_each(|axis| sum[axis] += point[axis]);
            *count += 1;
        }
        let cells: Vec<[f64; 3]> = cells
            .into_values()
            .map(|(sum, count)| sum.map(|v| v / f64::from(count)))
            .collect();
        let mut layers = vec![0_u32; layer(highest) + 1];
        cells.iter().for_each(|[.., z]| layers[layer(*z)] += 1);
        let commonest = (0..layers.len()).rev().max_by_key(|index| layers[*index]).unwrap_or(0);
        let mut plane = Plane {
            slope: [0.0; 2],
            offset: LOWEST + (commonest as f64 + 0.5) * LAYER,
        };
        for round in 0..ROUNDS {
            let share = round as f64 / (ROUNDS - 1) as f64;
            let scale = FIRST_SCALE * libm::pow(LAST_SCALE / FIRST_SCALE, share);
            plane = plane.refitted(&cells, scale)?;
        }
        let close = cells
            .iter()
            .filter(|point| plane.above(point).abs() < 2.0 * LAST_SCALE)
            .count();
        match close >= LEAST_POINTS {
            true => Ok(plane),
            false => Err(too_few(close)),
        }
    }

    /// The ground of a cloud as its publisher gives it: below the sensor, else at z = 0 where next to nothing is below that, as in
    /// clouds that a driver has brought to a `base_link` on the ground. In the frame of a LiDAR its lower beams see what is below.
    ///
    /// # Errors
    /// Too few points near any plane.
    pub fn of_ground_or_zero(points: &[[f64; 3]]) -> Result<Self, String> {
        let below = Plane::of_ground(points.iter().copied(), BELOW_A_SENSOR);
        let near = points.iter().filter(|[x, y, _]| libm::hypot(*x, *y) < REACH);
        let lower = near.clone().filter(|[.., z]| *z < BELOW_A_SENSOR).count();
        if below.is_ok() || lower > near.count() / FEW_BELOW {
            return below;
        }
        let at_zero = Plane::of_ground(points.iter().copied(), AT_ZERO);
        at_zero
            .ok()
            .filter(|plane| plane.offset.abs() < AT_ZERO)
            .map_or(below, Ok)
    }

    fn above(&self, [x, y, z]: &[f64; 3]) -> f64 {
        z - self.slope[0] * x - self.slope[1] * y - self.offset
    }

    /// One round: weights of Geman and McClure.
    fn refitted(&self, points: &[[f64; 3]], scale: f64) -> Result<Self, String> {
        let (mut normal, mut right) = (Matrix3::zeros(), Vector3::zeros());
        for point in points {
            let ratio = self.above(point) / scale;
            let weight = 1.0 / ((1.0 + ratio * ratio) * (1.0 + ratio * ratio));
            let row = Vector3::new(point[0], point[1], 1.0);
            normal += row * row.transpose() * weight;
            right += row * (point[2] * weight);
        }
        let found = normal.cholesky().map(|normal| normal.solve(&right));
        let found = found.filter(|found| found.iter().all(|v| v.is_finite()));
        let found = found.ok_or_else(|| too_few(points.len()))?;
        Ok(Plane {
            slope: [found[0], found[1]],
            offset: found[2],
        })
    }
}

fn too_few(found: usize) -> String {
    format!(
        "no ground was found: expected at least {LEAST_POINTS} cells of {LAYER} m on a plane within {REACH} m of the sensor, \
         found {found}; take --level pose or none"
    )
}

#[cfg(test)]
mod tests {
    use realo_schemas::geometry::tilt_degrees;

    use super::*;

    /// Ground with walls, a car roof and a hole, seen by a sensor at `height` in a frame that is tilted.
    fn scene(body_from_sensor: &Isometry3<f64>) -> Vec<[f64; 3]> {
        let sensor_from_body = body_from_sensor.inverse();
        let mut points = Vec::new();
        for i in -60..=60_i32 {
            for k in -60..=60_i32 {
                let (x, y) = (0.55 * f64::from(i), 0.55 * f64::from(k));
                let z = match (x, y) {
                    (3.0..=7.0, -9.0..=-4.0) => continue,
                    (8.0..=14.0, 2.0..=6.0) => 1.5,
                    (_, 20.0..) => 0.15 * f64::from((i * 7).rem_euclid(20)),
                    _ => 0.02 * f64::from((i * 13 + k * 7).rem_euclid(3) - 1),
                };
                let point = sensor_from_body * nalgebra::Point3::new(x, y, z);
                points.push([point.x, point.y, point.z]);
            }
        }
        points
    }

    #[test]
    fn finds_the_ground_between_what_stands_on_it() {
        for (roll, pitch, height) in [(0.0, 0.0, 2.0), (0.02, -0.03, 1.8), (-0.05, 0.01, 5.5)] {
            let tilt = UnitQuaternion::from_euler_angles(roll, pitch, 0.0);
            let body_from_sensor = Isometry3::from_parts(Translation3::new(0.0, 0.0, height), tilt);
            let points = scene(&body_from_sensor);
            let plane = Plane::of_ground(points.iter().copied(), BELOW_A_SENSOR).unwrap();
            let found = by_ground(&plane);
            let off = tilt_degrees(&(found.rotation * tilt.inverse()));
            assert!(off < 0.05, "{off}° at {roll} {pitch}");
            assert!((found.translation.z - height).abs() < 0.02, "{} m", found.translation.z);
            assert_eq!(plane, Plane::of_ground(points.iter().copied(), BELOW_A_SENSOR).unwrap());
        }
    }

    #[test]
    fn says_where_there_is_no_ground() {
        let wall = (0..10_000).map(|i| [5.0, 0.01 * f64::from(i % 100), 0.01 * f64::from(i / 100)]);
        let error = Plane::of_ground(wall, BELOW_A_SENSOR).unwrap_err();
        assert!(error.contains("no ground") && error.contains("--level pose"), "{error}");
        assert!(Plane::of_ground(std::iter::empty(), BELOW_A_SENSOR).is_err());
    }

    #[test]
    fn a_cloud_on_the_ground_already_has_its_ground_at_zero() {
        let on_ground = scene(&Isometry3::identity());
        assert!(Plane::of_ground(on_ground.iter().copied(), BELOW_A_SENSOR).is_err());
        let plane = Plane::of_ground_or_zero(&on_ground).unwrap();
        assert!(plane.offset.abs() < 0.02 && plane.slope[0].abs() < 1e-3, "{plane:?}");
        // Below a sensor nothing changes.
        let below = scene(&Translation3::new(0.0, 0.0, 1.8).into());
        let plane = Plane::of_ground(below.iter().copied(), BELOW_A_SENSOR);
        assert_eq!(Plane::of_ground_or_zero(&below), plane);
        // The level beams of a LiDAR on walls around it are no ground: other beams see what is below.
        let on_walls = |i: i32, z: f64| {
            let angle = f64::from(i) * 0.01;
            let reach = 15.0 + 10.0 * libm::sin(7.0 * angle);
            [reach * libm::cos(angle), reach * libm::sin(angle), z]
        };
        let level = (0..628).map(|i| on_walls(i, 0.0));
        let lower = (0..150).map(|i| on_walls(4 * i, -0.35 - 0.01 * f64::from(i)));
        let seen: Vec<[f64; 3]> = level.chain(lower).collect();
        let up_to = |highest| Plane::of_ground(seen.iter().copied(), highest);
        assert!(up_to(BELOW_A_SENSOR).is_err() && up_to(AT_ZERO).is_ok());
        assert!(Plane::of_ground_or_zero(&seen).unwrap_err().contains("no ground"));
    }

    #[test]
    fn a_levelled_body_points_up_and_keeps_its_heading() {
        for (roll, pitch, yaw) in [(0.01, -0.02, 0.3), (-0.03, 0.005, -2.9), (0.0, 0.0, 1.0)] {
            let map_from_sensor = UnitQuaternion::from_euler_angles(roll, pitch, yaw);
            let body_from_sensor = by_pose(&map_from_sensor, 2.0);
            let map_from_body = map_from_sensor * body_from_sensor.rotation.inverse();
            assert!(tilt_degrees(&map_from_body) < 1e-9);
            assert!((yaw_of(&map_from_body) - yaw_of(&map_from_sensor)).abs() < 1e-12);
            let origin = body_from_sensor * nalgebra::Point3::origin();
            assert_eq!([origin.x, origin.y, origin.z], [0.0, 0.0, 2.0]);
        }
    }
}
