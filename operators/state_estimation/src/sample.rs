//! What sensors and registration report to an estimator.

use nalgebra::{Isometry3, Matrix6, Vector3};
use realo_geodesy::Geodetic;
use realo_schemas::Nanos;

/// One sample of an IMU, in the IMU's own frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ImuSample {
    /// When it was measured.
    pub stamp: Nanos,
    /// Angular rate, rad/s.
    pub angular_rate: Vector3<f64>,
    /// Specific force, m/s²: at rest it points up, 9.8 long.
    pub specific_force: Vector3<f64>,
}

/// A position by GNSS. Messages without a fix are not passed on.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GnssFix {
    /// When it was measured.
    pub stamp: Nanos,
    /// Where the antenna is. A height of exactly 0 is taken for one that is not known.
    pub place: Geodetic,
    /// Variances east, north and up as the receiver reports them, m²; those of the unit without.
    pub variance: Option<[f64; 3]>,
}

/// A position by GNSS that somebody has taken to `map` already.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MapFix {
    /// When it was measured.
    pub stamp: Nanos,
    /// Where the antenna is in `map`, m.
    pub position: Vector3<f64>,
    /// Whether the height is known.
    pub has_height: bool,
    /// Variances east, north and up as the receiver reports them, m²; those of the unit without.
    pub variance: Option<[f64; 3]>,
}

/// Speed by the turning of the wheels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct WheelSpeed {
    /// When it was measured.
    pub stamp: Nanos,
    /// Forward at the axle, m/s. Exactly 0 is a standstill.
    pub speed: f64,
}

/// A pose by registration of a scan to a map.
#[derive(Clone, Debug, PartialEq)]
pub struct ScanPose {
    /// The scan's stamp, however late its pose comes.
    pub stamp: Nanos,
    /// The body's pose.
    pub map_from_body: Isometry3<f64>,
    /// Inverse covariance over x, y, z of the body's origin (m) and small turns about the axes of `map` through it (rad).
    /// Directions that the scan does not show have eigenvalues near 0.
    pub information: Matrix6<f64>,
}

/// Anything that an estimator takes.
#[derive(Clone, Debug, PartialEq)]
pub enum Sample {
    /// Of the IMU.
    Imu(ImuSample),
    /// Of the wheels.
    Wheel(WheelSpeed),
    /// Of the GNSS receiver.
    Gnss(GnssFix),
    /// The same, in `map`.
    Fix(MapFix),
    /// Of registration.
    Scan(Box<ScanPose>),
}

/// Takes an information matrix over twists at the origin of `map`, as Gauss-Newton on `exp(ξ) · map_from_body` gives it (ξ: translation,
/// then turn), to the one of [`ScanPose::information`].
///
/// `position`: of the body's origin in `map`.
pub fn information_at_body(at_map_origin: &Matrix6<f64>, position: &Vector3<f64>) -> Matrix6<f64> {
    // The twist that moves the body's origin by d and turns by φ has the translation d − φ × position = d + position × φ.
    let mut twist = Matrix6::identity();
    twist.fixed_view_mut::<3, 3>(0, 3).copy_from(&position.cross_matrix());
    twist.transpose() * at_map_origin * twist
}

#[cfg(test)]
mod tests {
    use nalgebra::{Point3, Vector6};

    use super::*;

    /// A residual along x of a point 2 m left of a body that is far from the map's origin: moving the body moves it, a turn about the
    /// body's vertical moves it by −2 m a radian.
    #[test]
    fn information_is_taken_to_where_the_body_is() {
        let position = Vector3::new(500.0, -300.0, 2.0);
        let point = Point3::from(position + Vector3::new(0.0, 2.0, 0.0));
        let normal = Vector3::x();
        let mut row = Vector6::zeros();
        row.fixed_rows_mut::<3>(0).copy_from(&normal);
        row.fixed_rows_mut::<3>(3).copy_from(&point.coords.cross(&normal));
        let found = information_at_body(&(row * row.transpose()), &position);
        let expected = Vector6::new(1.0, 0.0, 0.0, 0.0, 0.0, -2.0);
        assert!((found - expected * expected.transpose()).norm() < 1e-9, "{found}");
    }
}
