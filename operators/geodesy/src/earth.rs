//! The ellipsoid of WGS-84: places on it, its gravity and its turning (NIMA TR8350.2, third edition).

use std::f64::consts::PI;

use nalgebra::{Matrix3, Vector3};

use crate::Geodetic;

/// Semi-major axis, m.
pub(crate) const AXIS: f64 = 6_378_137.0;
/// Flattening.
const FLATTENING: f64 = 1.0 / 298.257_223_563;
/// Square of the first eccentricity.
pub(crate) const ECCENTRICITY_2: f64 = FLATTENING * (2.0 - FLATTENING);
/// Angular rate, rad/s.
const RATE: f64 = 7.292_115e-5;
/// Gravity on the equator, m/s², and Somigliana's constant.
const GRAVITY: [f64; 2] = [9.780_325_335_9, 1.931_852_652_41e-3];
/// Centrifugal over gravitational acceleration on the equator.
const CENTRIFUGAL: f64 = 3.449_786_506_84e-3;

/// Normal gravity at a place, m/s², downwards: Somigliana's formula with the second-order change by height.
///
/// Within 0.002 m/s² of what is measured near the ground.
pub fn normal_gravity(place: &Geodetic) -> f64 {
    let sin = libm::sin(place.latitude_deg * PI / 180.0);
    let sin2 = sin * sin;
    let ground = GRAVITY[0] * (1.0 + GRAVITY[1] * sin2) / libm::sqrt(1.0 - ECCENTRICITY_2 * sin2);
    let share = place.height_m / AXIS;
    let linear = 1.0 + FLATTENING + CENTRIFUGAL - 2.0 * FLATTENING * sin2;
    ground * (1.0 - 2.0 * linear * share + 3.0 * share * share)
}

/// How the Earth turns against the stars, in the local frame of a place: rad/s about east, north and up.
pub fn earth_rate(place: &Geodetic) -> Vector3<f64> {
    let (sin, cos) = libm::sincos(place.latitude_deg * PI / 180.0);
    Vector3::new(0.0, RATE * cos, RATE * sin)
}

/// Metres from the centre of the Earth, z to the north pole, x to the prime meridian.
pub(crate) fn centred(place: &Geodetic) -> Vector3<f64> {
    let (sin, cos) = libm::sincos(place.latitude_deg * PI / 180.0);
    let (sin_east, cos_east) = libm::sincos(place.longitude_deg * PI / 180.0);
    let normal = AXIS / libm::sqrt(1.0 - ECCENTRICITY_2 * sin * sin);
    let across = (normal + place.height_m) * cos;
    let along = (normal * (1.0 - ECCENTRICITY_2) + place.height_m) * sin;
    Vector3::new(across * cos_east, across * sin_east, along)
}

/// The axes east, north and up at a place, in the frame of [`centred`].
pub(crate) fn axes(place: &Geodetic) -> Matrix3<f64> {
    let (sin, cos) = libm::sincos(place.latitude_deg * PI / 180.0);
    let (sin_east, cos_east) = libm::sincos(place.longitude_deg * PI / 180.0);
    let east = Vector3::new(-sin_east, cos_east, 0.0);
    let north = Vector3::new(-sin * cos_east, -sin * sin_east, cos);
    let up = Vector3::new(cos * cos_east, cos * sin_east, sin);
    Matrix3::from_columns(&[east, north, up])
}

/// The place of a point that is no nearer to the Earth's centre than a mine.
pub(crate) fn place_at(point: &Vector3<f64>) -> Geodetic {
    let across = libm::hypot(point.x, point.y);
    let mut latitude = libm::atan2(point.z, across * (1.0 - ECCENTRICITY_2));
    // Each round takes two to three digits; near the ground six leave no error.
    for _ in 0..6 {
        let sin = libm::sin(latitude);
        let normal = AXIS / libm::sqrt(1.0 - ECCENTRICITY_2 * sin * sin);
        latitude = libm::atan2(point.z + ECCENTRICITY_2 * normal * sin, across);
    }
    let (sin, cos) = libm::sincos(latitude);
    let normal = AXIS / libm::sqrt(1.0 - ECCENTRICITY_2 * sin * sin);
    // The way along the normal, which is sound at the equator and at the poles.
    let height_m = across * cos + point.z * sin - AXIS * AXIS / normal;
    Geodetic {
        latitude_deg: latitude * 180.0 / PI,
        longitude_deg: libm::atan2(point.y, point.x) * 180.0 / PI,
        height_m,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn place(latitude_deg: f64, longitude_deg: f64, height_m: f64) -> Geodetic {
        Geodetic {
            latitude_deg,
            longitude_deg,
            height_m,
        }
    }

    #[test]
    fn known_points_of_the_earth_lie_where_they_should() {
        // The axes of the ellipsoid, and the worked example of EPSG guidance note 7-2, section 4.1.1 (North Sea).
        let cases = [
            (place(0.0, 0.0, 0.0), [AXIS, 0.0, 0.0], 1e-9),
            (place(0.0, 90.0, 10.0), [0.0, AXIS + 10.0, 0.0], 1e-9),
            (place(90.0, 0.0, 0.0), [0.0, 0.0, 6_356_752.314_245], 1e-6),
            (
                place(
                    53.0 + 48.0 / 60.0 + 33.82 / 3600.0,
                    2.0 + 7.0 / 60.0 + 46.38 / 3600.0,
                    73.0,
                ),
                [3_771_793.968, 140_253.342, 5_124_304.349],
                1e-3,
            ),
        ];
        for (place, expected, bound) in cases {
            let found = centred(&place);
            assert!((found - Vector3::from(expected)).norm() < bound, "{place}: {found}");
        }
    }

    #[test]
    fn gravity_is_that_of_the_tables() {
        // Equator and pole: TR8350.2, table 3.4. At 45° and 1,000 m: the free-air gradient of 0.3086 mGal/m, to its second order.
        let cases = [
            (place(0.0, 0.0, 0.0), 9.780_325_336, 1e-9),
            (place(90.0, 0.0, 0.0), 9.832_184_938, 1e-9),
            (place(45.0, 0.0, 0.0), 9.806_197_769, 1e-8),
            (place(45.0, 0.0, 1_000.0), 9.806_197_769 - 3.0848e-3, 2e-6),
        ];
        for (place, expected, bound) in cases {
            let found = normal_gravity(&place);
            assert!(
                (found - expected).abs() < bound,
                "{place}: {found}, expected {expected}"
            );
        }
    }

    #[test]
    fn the_earth_turns_once_a_sidereal_day_about_its_axis() {
        let here = place(48.0, 11.0, 500.0);
        let rate = earth_rate(&here);
        let day = 2.0 * PI / rate.norm();
        assert!((day - 86_164.1).abs() < 0.1, "{day} s");
        let axis = axes(&here) * rate;
        assert!((axis - Vector3::new(0.0, 0.0, rate.norm())).norm() < 1e-18, "{axis}");
    }
}
