use std::fmt;

use nalgebra::{Isometry3, Rotation3, UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};

use crate::earth::{axes, centred, place_at};

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
        let (here, there) = (axes(self), axes(other));
        let rotation = Rotation3::from_matrix_unchecked(there.transpose() * here);
        let translation = there.transpose() * (centred(self) - centred(other));
        Isometry3::from_parts(translation.into(), UnitQuaternion::from_rotation_matrix(&rotation))
    }

    /// The place at a point of the frame that stands here, m east, north and up.
    pub fn place_of(&self, point: &Vector3<f64>) -> Geodetic {
        place_at(&(centred(self) + axes(self) * point))
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::PI;

    use nalgebra::Point3;
    use proptest::prelude::*;

    use super::*;
    use crate::earth::{AXIS, ECCENTRICITY_2};

    fn place(latitude_deg: f64, longitude_deg: f64, height_m: f64) -> Geodetic {
        Geodetic {
            latitude_deg,
            longitude_deg,
            height_m,
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
