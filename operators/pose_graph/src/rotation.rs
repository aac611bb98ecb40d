//! Small turns.

use nalgebra::{Matrix3, UnitQuaternion, Vector3};
use realo_state_estimation::{quaternion_of, vector_of};

/// The rotation after a turn about the axes outside it.
pub(crate) fn turned(rotation: &UnitQuaternion<f64>, turn: &Vector3<f64>) -> UnitQuaternion<f64> {
    UnitQuaternion::new_normalize(quaternion_of(turn) * rotation.into_inner())
}

/// What is to be turned from `a` to have `b`, about the axes outside them.
pub(crate) fn between(a: &UnitQuaternion<f64>, b: &UnitQuaternion<f64>) -> Vector3<f64> {
    vector_of(&(b * a.inverse()))
}

/// How the vector of a rotation changes by a small turn from the left: the inverse of the left Jacobian of SO(3).
pub(crate) fn left_inverse(vector: &Vector3<f64>) -> Matrix3<f64> {
    let angle = vector.norm();
    let cross = vector.cross_matrix();
    // By its series: exact to rounding below the limit.
    let share = if angle < 1e-3 {
        1.0 / 12.0 + angle * angle / 720.0
    } else {
        let (sin, cos) = libm::sincos(angle);
        (1.0 - 0.5 * angle * sin / (1.0 - cos)) / (angle * angle)
    };
    Matrix3::identity() - 0.5 * cross + share * cross * cross
}
