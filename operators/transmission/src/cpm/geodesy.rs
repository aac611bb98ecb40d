//! Places on Earth and the local frames at them, on the ellipsoid of WGS84.

use std::f64::consts::PI;
use std::fmt;

use nalgebra::{Isometry3, Matrix3, Rotation3, UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};

/// Semi-major axis of WGS84, m.
const AXIS: f64 = 6_378_137.0;
/// Flattening of WGS84.
const FLATTENING: f64 = 1.0 / 298.257_223_563;
/// Square of the first eccentricity.
const ECCENTRICITY_2: f64 = FLATTENING * (2.0 - FLATTENING);

/// Largest latitude of a map's origin, degrees: at a pole there is no east.
const LATITUDE: f64 = 89.0;
/// Heights that a CPM reports, m.
const HEIGHT: std::ops::Range<f64> = -1_000.0..8_000.0;

/// A place on Earth: WGS84, height over the ellipsoid.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct Geodetic {
    /// Degrees, north above 0.
    pub latitude_deg: f64,
    /// Degrees, east above 0.
    pub longitude_deg: f64,
    /// Height over the ellipsoid, m.
    pub height_m: f64,
}

/// A text that is no origin of a map.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error(
    "expected LAT,LON or LAT,LON,HEIGHT (degrees within ±89 and ±180, metres over the ellipsoid from -1000 to 8000), \
     such as 48.1374,11.5755,519, found `{0}`"
)]
pub struct NoOrigin(String);

impl TryFrom<String> for Geodetic {
    type Error = NoOrigin;

    fn try_from(text: String) -> Result<Self, NoOrigin> {
        let numbers: Option<Vec<f64>> = text.split(',').map(|number| number.trim().parse().ok()).collect();
        let place = match numbers.as_deref() {
            Some([latitude_deg, longitude_deg]) => Some([*latitude_deg, *longitude_deg, 0.0]),
            Some([latitude_deg, longitude_deg, height_m]) => Some([*latitude_deg, *longitude_deg, *height_m]),
            _ => None,
        };
        place
            .filter(|[latitude, longitude, height]| {
                latitude.abs() <= LATITUDE && longitude.abs() <= 180.0 && HEIGHT.contains(height)
            })
            .map(|[latitude_deg, longitude_deg, height_m]| Geodetic {
                latitude_deg,
                longitude_deg,
                height_m,
            })
            .ok_or(NoOrigin(text))
    }
}

impl fmt::Display for Geodetic {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        write!(f, "{},{},{}", self.latitude_deg, self.longitude_deg, self.height_m)
    }
}

impl From<Geodetic> for String {
    fn from(place: Geodetic) -> Self {
        place.to_string()
    }
}

impl Geodetic {
    /// The frame that stands at the place, x east, y north, z up, in that of another place; metres.
    pub fn other_from_here(&self, other: &Geodetic) -> Isometry3<f64> {
        let (here, there) = (self.earth_from_local(), other.earth_from_local());
        let rotation = Rotation3::from_matrix_unchecked(there.transpose() * here);
        let translation = there.transpose() * (self.earth_centred() - other.earth_centred());
        Isometry3::from_parts(translation.into(), UnitQuaternion::from_rotation_matrix(&rotation))
    }

    /// The place at a point of the frame that stands here, m east, north and up.
    pub fn place_of(&self, point: &Vector3<f64>) -> Geodetic {
        geodetic(&(self.earth_centred() + self.earth_from_local() * point))
    }

    /// Metres from the centre of the Earth, z to the north pole, x to the prime meridian.
    fn earth_centred(&self) -> Vector3<f64> {
        let (sin, cos) = libm::sincos(self.latitude_deg * PI / 180.0);
        let (sin_east, cos_east) = libm::sincos(self.longitude_deg * PI / 180.0);
        let normal = AXIS / libm::sqrt(1.0 - ECCENTRICITY_2 * sin * sin);
        let across = (normal + self.height_m) * cos;
        let along = (normal * (1.0 - ECCENTRICITY_2) + self.height_m) * sin;
        Vector3::new(across * cos_east, across * sin_east, along)
    }

    fn earth_from_local(&self) -> Matrix3<f64> {
        let (sin, cos) = libm::sincos(self.latitude_deg * PI / 180.0);
        let (sin_east, cos_east) = libm::sincos(self.longitude_deg * PI / 180.0);
        let east = Vector3::new(-sin_east, cos_east, 0.0);
        let north = Vector3::new(-sin * cos_east, -sin * sin_east, cos);
        let up = Vector3::new(cos * cos_east, cos * sin_east, sin);
        Matrix3::from_columns(&[east, north, up])
    }
}

/// The place of a point that is no nearer to the Earth's centre than a mine.
fn geodetic(point: &Vector3<f64>) -> Geodetic {
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
    use nalgebra::Point3;
    use proptest::prelude::*;

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
            let found = place.earth_centred();
            assert!((found - Vector3::from(expected)).norm() < bound, "{place}: {found}");
        }
    }

    #[test]
    fn east_north_and_up_are_where_they_should_be() {
        let here = place(48.0, 11.0, 500.0);
        // A millionth of a degree: by the radii of curvature there, 0.111193 m north and 0.074628 m east.
        let sin = libm::sin(48.0 * PI / 180.0);
        let w = libm::sqrt(1.0 - ECCENTRICITY_2 * sin * sin);
        let (meridian, normal) = (AXIS * (1.0 - ECCENTRICITY_2) / (w * w * w), AXIS / w);
        let step = 1e-6 * PI / 180.0;
        let north = place(48.0 + 1e-6, 11.0, 500.0)
            .other_from_here(&here)
            .translation
            .vector;
        let east = place(48.0, 11.0 + 1e-6, 500.0)
            .other_from_here(&here)
            .translation
            .vector;
        let up = place(48.0, 11.0, 510.0).other_from_here(&here).translation.vector;
        assert!((north - Vector3::new(0.0, (meridian + 500.0) * step, 0.0)).norm() < 1e-7);
        let across = (normal + 500.0) * libm::cos(48.0 * PI / 180.0) * step;
        assert!((east - Vector3::new(across, 0.0, 0.0)).norm() < 1e-7);
        assert!((up - Vector3::new(0.0, 0.0, 10.0)).norm() < 1e-7);
    }

    #[test]
    fn the_antimeridian_is_a_meridian() {
        let (west, east) = (place(-17.0, -179.9999, 0.0), place(-17.0, 179.9999, 0.0));
        let way = west.other_from_here(&east);
        assert!((way.translation.vector.x - 21.29).abs() < 0.01, "{way}");
        let found = east.place_of(&way.translation.vector);
        assert!((found.longitude_deg - -179.9999).abs() < 1e-9, "{found}");
    }

    #[test]
    fn origins_are_read_as_they_are_written_and_others_refused() {
        let read = |text: &str| Geodetic::try_from(text.to_string());
        assert_eq!(read("48.1, 11.5"), Ok(place(48.1, 11.5, 0.0)));
        assert_eq!(read("-33.9,-70.5,520.25"), Ok(place(-33.9, -70.5, 520.25)));
        assert_eq!(read(&place(1.5, -2.25, 3.0).to_string()), Ok(place(1.5, -2.25, 3.0)));
        for text in [
            "",
            "48.1",
            "a,b",
            "90,0",
            "-89.1,0",
            "0,180.1",
            "0,0,8000",
            "0,0,-1001",
            "nan,0",
            "0,inf",
            "1,2,3,4",
        ] {
            let error = read(text).unwrap_err().to_string();
            assert!(error.contains("LAT,LON") && error.contains(text), "{text}: {error}");
        }
    }

    proptest! {
        #[test]
        fn a_point_within_ten_kilometres_comes_back(
            latitude in -89.0..=89.0f64, longitude in -180.0..=180.0f64, height in -400.0..4_000.0f64,
            x in -1e4..1e4f64, y in -1e4..1e4f64, z in -500.0..500.0f64,
        ) {
            let origin = place(latitude, longitude, height);
            let there = origin.place_of(&Vector3::new(x, y, z));
            let back = there.other_from_here(&origin) * Point3::origin();
            prop_assert!((back - Point3::new(x, y, z)).norm() < 1e-6, "{} m", (back - Point3::new(x, y, z)).norm());
        }
    }
}
