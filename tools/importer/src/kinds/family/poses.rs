//! Poses of the family: six numbers in CARLA's angles, or a matrix.

use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion, Vector3};

use crate::places::{self, WORLD};

/// No angle is larger, degrees.
const MOST_TURN: f64 = 720.0;

/// World from frame by x, y, z, m, and roll, yaw, pitch, degrees, as CARLA composes them: yaw, then pitch upwards, then roll.
pub fn world_from_six([x, y, z, roll, yaw, pitch]: [f64; 6]) -> Isometry3<f64> {
    let about = |axis, degrees: f64| UnitQuaternion::from_axis_angle(&axis, degrees.to_radians());
    let rotation = about(Vector3::z_axis(), yaw) * about(Vector3::y_axis(), -pitch) * about(Vector3::x_axis(), -roll);
    Isometry3::from_parts(Translation3::new(x, y, z), rotation)
}

/// The same pose where y of both frames points the other way.
pub fn mirrored(pose: &Isometry3<f64>) -> Isometry3<f64> {
    let [x, y, z] = pose.translation.vector.into();
    let turn = pose.rotation;
    let turn = UnitQuaternion::new_unchecked(Quaternion::new(turn.w, -turn.i, turn.j, -turn.k));
    Isometry3::from_parts(Translation3::new(x, -y, z), turn)
}

/// World from frame of six numbers, or of the 16 of a matrix, row by row.
///
/// # Errors
/// What was expected and found.
pub fn world_from_numbers(numbers: &[f64]) -> Result<Isometry3<f64>, String> {
    let pose = match numbers {
        [x, y, z, roll, yaw, pitch] => {
            if ![roll, yaw, pitch].iter().all(|angle| angle.abs() <= MOST_TURN) {
                return Err(format!(
                    "expected roll, yaw and pitch in degrees within ±{MOST_TURN}, found {numbers:?}"
                ));
            }
            world_from_six([*x, *y, *z, *roll, *yaw, *pitch])
        }
        numbers if numbers.len() == 16 => of_matrix(numbers)?,
        other => {
            return Err(format!(
                "expected x, y, z, roll, yaw, pitch (m, degrees) or a 4×4 matrix, found {} numbers",
                other.len()
            ));
        }
    };
    match pose.translation.vector.iter().all(|metres| metres.abs() <= WORLD) {
        true => Ok(pose),
        false => Err(format!(
            "expected a place within {WORLD:e} m, found {:?}",
            pose.translation.vector.as_slice()
        )),
    }
}

fn of_matrix(numbers: &[f64]) -> Result<Isometry3<f64>, String> {
    let pose = places::of_rows(numbers).filter(|_| numbers[12..] == [0.0, 0.0, 0.0, 1.0]);
    pose.ok_or_else(|| {
        format!("expected a rotation and a translation with 0, 0, 0, 1 as the last row, found {numbers:?}")
    })
}

#[cfg(test)]
mod tests {
    use nalgebra::Matrix3;

    use super::*;

    #[test]
    fn six_numbers_compose_as_carla_says() {
        let (roll, yaw, pitch) = (10.0_f64, 70.0_f64, -20.0_f64);
        let [(sr, cr), (sy, cy), (sp, cp)] = [roll, yaw, pitch].map(|angle| angle.to_radians().sin_cos());
        let expected = Matrix3::new(
            cp * cy,
            cy * sp * sr - sy * cr,
            -cy * sp * cr - sy * sr,
            sy * cp,
            sy * sp * sr + cy * cr,
            -sy * sp * cr + cy * sr,
            sp,
            -cp * sr,
            cp * cr,
        );
        let found = world_from_six([1.0, 2.0, 3.0, roll, yaw, pitch]);
        assert!((found.rotation.to_rotation_matrix().matrix() - expected).abs().max() < 1e-12);
        assert_eq!(found.translation.vector, Vector3::new(1.0, 2.0, 3.0));
    }

    #[test]
    fn a_mirrored_pose_moves_mirrored_points() {
        let pose = world_from_six([5.0, -7.0, 1.0, 4.0, 130.0, -6.0]);
        let point = nalgebra::Point3::new(3.0, 2.0, -1.0);
        let mirror = |p: nalgebra::Point3<f64>| nalgebra::Point3::new(p.x, -p.y, p.z);
        let (there, back) = (mirror(pose * point), mirrored(&pose) * mirror(point));
        assert!((there - back).norm() < 1e-12);
    }

    #[test]
    fn a_matrix_is_the_same_pose_and_others_are_refused() {
        let pose = world_from_six([500_123.25, 5_401_234.5, 300.0, 1.0, 30.0, 2.0]);
        let rows = pose.to_homogeneous().transpose();
        let found = world_from_numbers(rows.as_slice()).unwrap();
        assert!((found.to_homogeneous() - pose.to_homogeneous()).abs().max() < 1e-9);
        for (numbers, reason) in [
            (vec![1.0; 7], "found 7 numbers"),
            (vec![1.0; 16], "expected a rotation"),
            (vec![0.0, 0.0, 0.0, 0.0, 1e4, 0.0], "in degrees"),
            (vec![f64::NAN, 0.0, 0.0, 0.0, 0.0, 0.0], "expected a place"),
        ] {
            let error = world_from_numbers(&numbers).unwrap_err();
            assert!(error.contains(reason), "{error}");
        }
    }
}
