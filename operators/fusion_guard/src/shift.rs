//! Motions on the ground plane.

use nalgebra::{Isometry3, Matrix3, Translation3, UnitQuaternion, Vector2, Vector3};

/// A motion on the ground plane of the ego's frame: a turn about a pivot, then a shift.
///
/// The pivot is where the collaborator says it is, so that its errors of place and heading are the two parts.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Shift {
    /// What stays where it is when only the heading is wrong, m.
    pub pivot: Vector2<f64>,
    /// Shift, m.
    pub by: Vector2<f64>,
    /// Turn from x to y, rad.
    pub turn: f64,
}

impl Shift {
    /// A motion that moves nothing.
    pub fn none(pivot: Vector2<f64>) -> Self {
        Shift {
            pivot,
            by: Vector2::zeros(),
            turn: 0.0,
        }
    }

    /// A place after the motion.
    pub fn place(&self, at: &Vector2<f64>) -> Vector2<f64> {
        self.mover()(at)
    }

    /// What places many as [`place`](Shift::place) does one.
    pub fn mover(&self) -> impl Fn(&Vector2<f64>) -> Vector2<f64> + use<> {
        let (sin, cos) = libm::sincos(self.turn);
        let (pivot, to) = (self.pivot, self.pivot + self.by);
        move |at| {
            let arm = at - pivot;
            to + Vector2::new(cos * arm.x - sin * arm.y, sin * arm.x + cos * arm.y)
        }
    }

    /// The motion as a transform of the ego's frame: points that were placed without it are where they should be with it.
    pub fn isometry(&self) -> Isometry3<f64> {
        let rotation = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), self.turn);
        let origin = self.place(&Vector2::zeros());
        Isometry3::from_parts(Translation3::new(origin.x, origin.y, 0.0), rotation)
    }

    /// Length of the shift, m.
    pub fn metres(&self) -> f64 {
        libm::hypot(self.by.x, self.by.y)
    }
}

/// A vector turned from x to y by an angle, rad.
pub fn turned(vector: &Vector2<f64>, angle: f64) -> Vector2<f64> {
    let (sin, cos) = libm::sincos(angle);
    Vector2::new(cos * vector.x - sin * vector.y, sin * vector.x + cos * vector.y)
}

/// Variance of the place of something at `at` whose agent's shift and turn have a covariance, m²: the mean of both axes.
pub fn variance_at(covariance: &Matrix3<f64>, pivot: &Vector2<f64>, at: &Vector2<f64>) -> f64 {
    let arm = at - pivot;
    let along = |x: f64, y: f64, turn: f64| {
        let of = Vector3::new(x, y, turn);
        (covariance * of).dot(&of)
    };
    0.5 * (along(1.0, 0.0, -arm.y) + along(0.0, 1.0, arm.x))
}

/// The difference of two headings up to half a turn, in (-π/2, π/2]: detectors mistake front and rear.
pub fn half_turn(difference: f64) -> f64 {
    use std::f64::consts::PI;
    difference - PI * (difference / PI).round()
}

#[cfg(test)]
mod tests {
    use nalgebra::Point3;
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn the_transform_places_as_the_motion_does(
            px in -50.0..50.0f64, py in -50.0..50.0f64, bx in -9.0..9.0f64, by in -9.0..9.0f64, turn in -0.5..0.5f64,
            x in -80.0..80.0f64, y in -80.0..80.0f64,
        ) {
            let shift = Shift { pivot: Vector2::new(px, py), by: Vector2::new(bx, by), turn };
            let placed = shift.place(&Vector2::new(x, y));
            let moved = shift.isometry() * Point3::new(x, y, 1.5);
            prop_assert!((moved - Point3::new(placed.x, placed.y, 1.5)).norm() < 1e-9);
            let still = shift.place(&shift.pivot);
            prop_assert!((still - shift.pivot - shift.by).norm() < 1e-9);
        }

        #[test]
        fn the_variance_of_a_place_is_that_of_its_error(x in -60.0..60.0f64, y in -60.0..60.0f64) {
            let covariance = Matrix3::from_diagonal(&Vector3::new(0.04, 0.09, 1e-4));
            let found = variance_at(&covariance, &Vector2::new(1.0, -2.0), &Vector2::new(x, y));
            let (ax, ay) = (x - 1.0, y + 2.0);
            let expected = 0.5 * (0.04 + ay * ay * 1e-4 + 0.09 + ax * ax * 1e-4);
            prop_assert!((found - expected).abs() < 1e-9);
        }
    }

    #[test]
    fn headings_count_up_to_half_a_turn() {
        use std::f64::consts::PI;
        for (difference, expected) in [(0.1, 0.1), (PI + 0.1, 0.1), (-PI + 0.2, 0.2), (0.6 * PI, -0.4 * PI)] {
            assert!((half_turn(difference) - expected).abs() < 1e-12, "{difference}");
        }
    }
}
