//! Poses as data sets write them.

use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion};

/// The same pose where y of both frames points the other way.
pub fn mirrored(pose: &Isometry3<f64>) -> Isometry3<f64> {
    let [x, y, z] = pose.translation.vector.into();
    let turn = pose.rotation;
    let turn = UnitQuaternion::new_unchecked(Quaternion::new(turn.w, -turn.i, turn.j, -turn.k));
    Isometry3::from_parts(Translation3::new(x, -y, z), turn)
}

/// x, y, z, m, and roll, yaw, pitch, degrees, as CARLA composes them: yaw, then pitch upwards, then roll.
pub fn six(pose: &Isometry3<f64>) -> [f64; 6] {
    let [x, y, z] = pose.translation.vector.into();
    let (roll, pitch, yaw) = pose.rotation.euler_angles();
    [x, y, z, (-roll).to_degrees(), yaw.to_degrees(), (-pitch).to_degrees()]
}

/// A number without an exponent, which some readers of YAML take for a text, and with all its digits.
pub fn number(value: f64) -> String {
    // A zero has no sign.
    let value = value + 0.0;
    match value.fract() == 0.0 {
        true => format!("{value:.1}"),
        false => value.to_string(),
    }
}

/// Numbers with commas between.
pub fn numbers(values: &[f64]) -> String {
    let words: Vec<String> = values.iter().map(|value| number(*value)).collect();
    words.join(", ")
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use super::*;

    #[test]
    fn six_numbers_are_the_pose() {
        let about = |axis, degrees: f64| UnitQuaternion::from_axis_angle(&axis, degrees.to_radians());
        for [roll, yaw, pitch] in [[1.0, 20.0, -0.8], [0.0, -170.0, 0.0], [-4.0, 95.0, 12.0]] {
            let turn =
                about(Vector3::z_axis(), yaw) * about(Vector3::y_axis(), -pitch) * about(Vector3::x_axis(), -roll);
            let found = six(&Isometry3::from_parts(Translation3::new(1.0, 2.0, 3.0), turn));
            let expected = [1.0, 2.0, 3.0, roll, yaw, pitch];
            let apart = found.iter().zip(expected).map(|(a, b)| (a - b).abs());
            assert!(apart.fold(0.0, f64::max) < 1e-9, "{found:?}");
        }
    }

    #[test]
    fn numbers_have_no_exponent_and_all_digits() {
        for (value, expected) in [
            (1.0, "1.0"),
            (-0.0, "0.0"),
            (-2.5, "-2.5"),
            (1e-7, "0.0000001"),
            (5_401_234.25, "5401234.25"),
        ] {
            assert_eq!(number(value), expected);
        }
        let long = 0.1 + 0.2;
        assert_eq!(number(long).parse(), Ok(long));
    }
}
