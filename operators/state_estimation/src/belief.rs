//! What the filter believes: a state, and the covariance of its error.

use nalgebra::{Isometry3, Matrix3, Quaternion, SMatrix, SVector, UnitQuaternion, Vector3};

/// Errors that are estimated: 15 of the motion, 3 of GNSS, 1 of the wheels.
pub(crate) const STATES: usize = 19;
/// First row of the position's error, m in `map`.
pub(crate) const POSITION: usize = 0;
/// Of the velocity's, m/s in `map`.
pub(crate) const VELOCITY: usize = 3;
/// Of the attitude's, rad about the axes of the IMU.
pub(crate) const ATTITUDE: usize = 6;
/// Of the gyro bias's, rad/s.
pub(crate) const GYRO_BIAS: usize = 9;
/// Of the accelerometer bias's, m/s².
pub(crate) const ACCEL_BIAS: usize = 12;
/// Of the wandering error of GNSS, in standard deviations of it.
pub(crate) const WANDER: usize = 15;
/// Of the wheels' scale.
pub(crate) const SCALE: usize = 18;

pub(crate) type Covariance = SMatrix<f64, STATES, STATES>;
pub(crate) type Errors = SVector<f64, STATES>;

/// State and covariance. An error is what is to be added to the state (turned by, from the right) to have the truth.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Belief {
    pub position: Vector3<f64>,
    pub velocity: Vector3<f64>,
    pub map_from_imu: UnitQuaternion<f64>,
    pub gyro_bias: Vector3<f64>,
    pub accel_bias: Vector3<f64>,
    pub wander: Vector3<f64>,
    /// What the wheels report is (1 + scale) times the speed.
    pub scale: f64,
    pub covariance: Covariance,
    /// Without an IMU, what was known of the gyro's bias: its states hold the turn rate then, see [`Belief::coast`].
    pub coasting: Option<HeldBias>,
}

/// What is known of a gyro's bias while the gyro says nothing.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct HeldBias {
    pub bias: Vector3<f64>,
    pub covariance: Matrix3<f64>,
}

impl Belief {
    /// A belief with a pose and velocity of the IMU, and no covariance yet.
    pub fn at(map_from_imu: &Isometry3<f64>, velocity: Vector3<f64>) -> Self {
        Belief {
            position: map_from_imu.translation.vector,
            velocity,
            map_from_imu: map_from_imu.rotation,
            gyro_bias: Vector3::zeros(),
            accel_bias: Vector3::zeros(),
            wander: Vector3::zeros(),
            scale: 0.0,
            covariance: Covariance::zeros(),
            coasting: None,
        }
    }

    /// Puts another quantity into three states from `row` on, which has nothing in common with the others.
    pub fn replace(&mut self, row: usize, covariance: &Matrix3<f64>) -> Matrix3<f64> {
        let before = self.covariance.fixed_view::<3, 3>(row, row).into_owned();
        self.covariance.fixed_rows_mut::<3>(row).fill(0.0);
        self.covariance.fixed_columns_mut::<3>(row).fill(0.0);
        self.covariance.fixed_view_mut::<3, 3>(row, row).copy_from(covariance);
        before
    }

    /// Adds an independent source of error: `column` is what one standard deviation of it does to the state.
    pub fn widen(&mut self, column: &Errors) {
        self.covariance += column * column.transpose();
    }

    /// Widens what is known of the place, m along each axis of `map`, and of the turn about each of them, rad. A wrong heading turns the
    /// velocity with it.
    pub fn doubt(&mut self, place: &Vector3<f64>, turn: &Vector3<f64>) {
        let imu_from_map = self.map_from_imu.inverse();
        for axis in 0..3 {
            let mut off = Errors::zeros();
            off[POSITION + axis] = place[axis];
            self.widen(&off);
            let mut turned = Vector3::zeros();
            turned[axis] = turn[axis];
            let mut off = Errors::zeros();
            off.fixed_rows_mut::<3>(ATTITUDE).copy_from(&(imu_from_map * turned));
            off.fixed_rows_mut::<3>(VELOCITY)
                .copy_from(&turned.cross(&self.velocity));
            self.widen(&off);
        }
    }

    /// Takes an estimated error into the state, and the covariance to the new attitude.
    ///
    /// Nothing on board shows which way north is: a wrong heading turns position, velocity and attitude alike, so its error goes with a
    /// velocity across the one that is believed. When that changes, the covariance follows it (as errors of an invariant filter do,
    /// Barrau and Bonnabel 2017). If it did not, a heading that is corrected by some degrees would seem to show in the wheels' speed.
    pub fn inject(&mut self, errors: &Errors) {
        let part = |row: usize| errors.fixed_rows::<3>(row).into_owned();
        let (turn, moved, faster) = (part(ATTITUDE), part(POSITION), part(VELOCITY));
        let before = self.map_from_imu.to_rotation_matrix().into_inner();
        let turn_in_map = before * turn;
        self.position += moved;
        // The velocity turns with the attitude, and keeps its length.
        let turned_velocity = UnitQuaternion::new_normalize(quaternion_of(&turn_in_map)) * self.velocity;
        self.velocity = turned_velocity + (faster - turn_in_map.cross(&self.velocity));
        self.map_from_imu = turned(&self.map_from_imu, &turn);
        self.gyro_bias += part(GYRO_BIAS);
        self.accel_bias += part(ACCEL_BIAS);
        self.wander += part(WANDER);
        self.scale += errors[SCALE];
        let by_attitude = |change: Vector3<f64>| -change.cross_matrix() * before;
        // The error that is left counts from the new attitude (Solà 2017, eq. 287).
        for (row, factor) in [
            (POSITION, by_attitude(moved)),
            (VELOCITY, by_attitude(faster)),
            (ATTITUDE, (-0.5 * turn).cross_matrix()),
        ] {
            self.add_attitude(row, &factor);
        }
        self.symmetrize();
    }

    /// Adds to three errors from `row` on what the error of the attitude makes of them.
    fn add_attitude(&mut self, row: usize, factor: &Matrix3<f64>) {
        let of_attitude = factor * self.covariance.fixed_rows::<3>(ATTITUDE);
        let mut rows = self.covariance.fixed_rows_mut::<3>(row);
        rows += of_attitude;
        let of_attitude = self.covariance.fixed_columns::<3>(ATTITUDE) * factor.transpose();
        let mut columns = self.covariance.fixed_columns_mut::<3>(row);
        columns += of_attitude;
    }

    /// Removes what rounding adds to one half of the covariance and not to the other.
    pub fn symmetrize(&mut self) {
        for row in 0..STATES {
            for column in 0..row {
                let mean = 0.5 * (self.covariance[(row, column)] + self.covariance[(column, row)]);
                self.covariance[(row, column)] = mean;
                self.covariance[(column, row)] = mean;
            }
        }
    }

    /// Whether all numbers are finite and no variance is negative.
    pub fn is_sound(&self) -> bool {
        let vectors = [
            &self.position,
            &self.velocity,
            &self.gyro_bias,
            &self.accel_bias,
            &self.wander,
        ];
        vectors.iter().all(|vector| vector.iter().all(|part| part.is_finite()))
            && self.scale.is_finite()
            && self.map_from_imu.coords.iter().all(|part| part.is_finite())
            && self.covariance.iter().all(|part| part.is_finite())
            && self.covariance.diagonal().iter().all(|variance| *variance > 0.0)
    }
}

/// A rotation with a small one after it, in its own frame.
pub(crate) fn turned(map_from_imu: &UnitQuaternion<f64>, turn: &Vector3<f64>) -> UnitQuaternion<f64> {
    let product = map_from_imu.into_inner() * quaternion_of(turn);
    UnitQuaternion::new_normalize(product)
}

/// The rotation by a vector, rad.
pub fn quaternion_of(turn: &Vector3<f64>) -> Quaternion<f64> {
    let angle = turn.norm();
    let (sin, cos) = libm::sincos(0.5 * angle);
    // sin(a/2)/a, by its series where the division would lose digits.
    let share = if angle > 1e-4 {
        sin / angle
    } else {
        0.5 - angle * angle / 48.0
    };
    Quaternion::from_parts(cos, turn * share)
}

/// The vector of a rotation, rad; of the shorter way round.
pub fn vector_of(rotation: &UnitQuaternion<f64>) -> Vector3<f64> {
    let q = rotation.quaternion();
    let q = if q.scalar() < 0.0 { -q } else { *q };
    let vector = q.imag();
    let sin = vector.norm();
    let share = if sin > 1e-5 {
        2.0 * libm::atan2(sin, q.scalar()) / sin
    } else {
        2.0
    };
    vector * share
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn rotations_and_their_vectors_are_one_another(x in -1.8..1.8f64, y in -1.8..1.8f64, z in -1.8..1.8f64, exponent in -9..=0i32) {
            let vector = Vector3::new(x, y, z) * 10f64.powi(exponent);
            let rotation = UnitQuaternion::new_normalize(quaternion_of(&vector));
            prop_assert!((vector_of(&rotation) - vector).norm() <= 1e-9 * vector.norm());
            prop_assert!(rotation.angle_to(&UnitQuaternion::from_scaled_axis(vector)) < 1e-7);
        }
    }

    #[test]
    fn what_is_injected_moves_the_state_the_right_way() {
        let quarter = UnitQuaternion::from_scaled_axis(Vector3::z() * std::f64::consts::FRAC_PI_2);
        let pose = Isometry3::from_parts(Vector3::new(1.0, 2.0, 3.0).into(), quarter);
        let mut belief = Belief::at(&pose, Vector3::x());
        belief.covariance.fill_with_identity();
        let mut errors = Errors::zeros();
        errors[POSITION] = 0.5;
        errors[ATTITUDE] = 0.1;
        belief.inject(&errors);
        assert_eq!(belief.position, Vector3::new(1.5, 2.0, 3.0));
        // A turn about the IMU's x, which points north.
        let up = belief.map_from_imu * Vector3::z();
        assert!(
            (up - Vector3::new(0.1f64.sin(), 0.0, 0.1f64.cos())).norm() < 1e-12,
            "{up}"
        );
    }
}
