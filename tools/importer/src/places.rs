//! What poses of data sets may be, and how some of them write them.

use nalgebra::{Isometry3, Matrix3, Translation3, UnitQuaternion};
use realo_schemas::{AgentState, PoseStatus};

/// How far from the identity the product of a rotation and its transpose may be.
pub const ORTHONORMAL: f64 = 0.01;
/// No place lies farther from the origin of the world, m: twice around the Earth.
pub const WORLD: f64 = 8e7;
/// No LiDAR is mounted at a greater tilt, degrees.
pub const MOST_TILT: f64 = 45.0;

/// Whether a matrix is a rotation but for so much, as [`ORTHONORMAL`] says.
pub fn is_rotation(rotation: &Matrix3<f64>, skew: f64) -> bool {
    let off = (rotation * rotation.transpose() - Matrix3::identity()).abs().max();
    // A NaN is not near either.
    off <= skew && rotation.determinant() > 0.0
}

/// A pose of three rows of a rotation with a translation in the fourth column; `None` if it has no rotation.
///
/// # Panics
/// If there are fewer than 12 numbers.
pub fn of_rows(rows: &[f64]) -> Option<Isometry3<f64>> {
    let rotation = Matrix3::from_fn(|row, column| rows[4 * row + column]);
    let translation = Translation3::new(rows[3], rows[7], rows[11]);
    is_rotation(&rotation, ORTHONORMAL)
        .then(|| Isometry3::from_parts(translation, UnitQuaternion::from_matrix(&rotation)))
}

/// A pose as a log has it.
pub fn recorded(map_from_body: Isometry3<f64>) -> AgentState {
    AgentState {
        map_from_body,
        covariance: None,
        velocity: None,
        angular_rate: None,
        status: PoseStatus::Recorded,
    }
}
