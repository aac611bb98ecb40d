use nalgebra::{Matrix3, Vector3};

use crate::Geodetic;
use crate::earth::{axes, centred, place_at};

/// How far from its origin a local frame reaches, m. Farther away one of the two places is a mistake.
pub const FAR_M: f64 = 100_000.0;

/// Largest latitude of an origin, degrees: at a pole there is no east.
const ORIGIN_LATITUDE: f64 = 89.0;
/// Heights over the ellipsoid that something on Earth can have, m: below the Dead Sea's shore to above airliners.
const HEIGHT: std::ops::RangeInclusive<f64> = -1_000.0..=20_000.0;

/// Numbers that are no place on Earth, or no place of a local frame.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum GeodesyError {
    /// A number that is NaN or infinite.
    #[error("expected finite {field}, found {found}; a receiver without a fix may report NaN: leave such messages out")]
    NotFinite {
        /// Which one.
        field: &'static str,
        /// What it is.
        found: f64,
    },
    /// A number that nothing on Earth has.
    #[error(
        "expected {field} from {min} to {max} {unit}, found {found}; are latitude and longitude swapped, or in radians?"
    )]
    Range {
        /// Which one.
        field: &'static str,
        /// Its unit.
        unit: &'static str,
        /// Smallest allowed.
        min: f64,
        /// Largest allowed.
        max: f64,
        /// What it is.
        found: f64,
    },
    /// A place too far from the origin.
    #[error(
        "expected a place within {max} m of the local frame's origin, found one {found:.0} m away; compare the origin of the map \
         with what the receiver reports",
        max = FAR_M
    )]
    Far {
        /// Distance, m.
        found: f64,
    },
}

/// The tangent frame at a place: x east, y north, z up; metres.
#[derive(Clone, Debug, PartialEq)]
pub struct LocalFrame {
    origin: Geodetic,
    centred: Vector3<f64>,
    axes: Matrix3<f64>,
}

impl Geodetic {
    /// The place as it is, once its numbers are those of a place on Earth. Height 0 is one of them.
    ///
    /// # Errors
    /// [`GeodesyError`] for NaN, infinite numbers, latitudes beyond ±90°, longitudes beyond ±180° and heights that nothing on
    /// Earth has.
    pub fn checked(self) -> Result<Self, GeodesyError> {
        ranged("latitude", "degrees", self.latitude_deg, [-90.0, 90.0])?;
        ranged("longitude", "degrees", self.longitude_deg, [-180.0, 180.0])?;
        ranged("height", "m", self.height_m, [*HEIGHT.start(), *HEIGHT.end()])?;
        Ok(self)
    }
}

fn ranged(field: &'static str, unit: &'static str, found: f64, [min, max]: [f64; 2]) -> Result<(), GeodesyError> {
    if !found.is_finite() {
        return Err(GeodesyError::NotFinite { field, found });
    }
    if found < min || found > max {
        return Err(GeodesyError::Range {
            field,
            unit,
            min,
            max,
            found,
        });
    }
    Ok(())
}

impl LocalFrame {
    /// The frame at `origin`.
    ///
    /// # Errors
    /// [`GeodesyError`] if the origin is not a place on Earth, or within one degree of a pole.
    pub fn new(origin: Geodetic) -> Result<Self, GeodesyError> {
        let origin = origin.checked()?;
        let limits = [-ORIGIN_LATITUDE, ORIGIN_LATITUDE];
        ranged("latitude of an origin", "degrees", origin.latitude_deg, limits)?;
        Ok(LocalFrame {
            origin,
            centred: centred(&origin),
            axes: axes(&origin),
        })
    }

    /// Where the frame is.
    pub fn origin(&self) -> &Geodetic {
        &self.origin
    }

    /// A place in this frame: metres east, north and up.
    ///
    /// # Errors
    /// [`GeodesyError`] if it is not a place on Earth, or more than [`FAR_M`] away.
    pub fn local_of(&self, place: &Geodetic) -> Result<Vector3<f64>, GeodesyError> {
        let local = self.axes.transpose() * (centred(&place.checked()?) - self.centred);
        near(&local)?;
        Ok(local)
    }

    /// The place of a point of this frame.
    ///
    /// # Errors
    /// [`GeodesyError`] if the point is not finite, or more than [`FAR_M`] away.
    pub fn place_of(&self, local: &Vector3<f64>) -> Result<Geodetic, GeodesyError> {
        for (field, &found) in ["x", "y", "z"].into_iter().zip(local.iter()) {
            if !found.is_finite() {
                return Err(GeodesyError::NotFinite { field, found });
            }
        }
        near(local)?;
        Ok(place_at(&(self.centred + self.axes * local)))
    }
}

fn near(local: &Vector3<f64>) -> Result<(), GeodesyError> {
    let found = local.norm();
    if found > FAR_M {
        return Err(GeodesyError::Far { found });
    }
    Ok(())
}

#[cfg(test)]
mod tests {
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
    fn height_zero_is_a_height() {
        let frame = LocalFrame::new(place(48.0, 11.0, 0.0)).unwrap();
        let local = frame.local_of(&place(48.0, 11.0, 0.0)).unwrap();
        assert_eq!(local, Vector3::zeros());
        // 519 m above it, a receiver that reports height 0 is below.
        let frame = LocalFrame::new(place(48.0, 11.0, 519.0)).unwrap();
        let local = frame.local_of(&place(48.0, 11.0, 0.0)).unwrap();
        assert!((local - Vector3::new(0.0, 0.0, -519.0)).norm() < 1e-8, "{local}");
    }

    #[test]
    fn what_is_no_place_is_refused_by_name() {
        let cases = [
            (place(f64::NAN, 11.0, 0.0), "finite latitude"),
            (place(48.0, f64::INFINITY, 0.0), "finite longitude"),
            (place(48.0, 11.0, f64::NAN), "finite height"),
            (
                place(90.000_1, 11.0, 0.0),
                "latitude from -90 to 90 degrees, found 90.0001",
            ),
            (
                place(48.0, -180.1, 0.0),
                "longitude from -180 to 180 degrees, found -180.1",
            ),
            (place(48.0, 11.0, 20_001.0), "height from -1000 to 20000 m, found 20001"),
        ];
        let frame = LocalFrame::new(place(48.0, 11.0, 0.0)).unwrap();
        for (place, expected) in cases {
            let error = frame.local_of(&place).unwrap_err().to_string();
            assert!(error.contains(expected), "{place}: {error}");
            assert_eq!(LocalFrame::new(place).unwrap_err().to_string(), error);
        }
        let error = LocalFrame::new(place(89.5, 0.0, 0.0)).unwrap_err().to_string();
        assert!(error.contains("latitude of an origin from -89 to 89"), "{error}");
    }

    #[test]
    fn another_town_is_too_far() {
        let frame = LocalFrame::new(place(48.137, 11.575, 519.0)).unwrap();
        let error = frame.local_of(&place(52.520, 13.405, 34.0)).unwrap_err();
        assert!(
            matches!(error, GeodesyError::Far { found } if (found - 504_000.0).abs() < 1_000.0),
            "{error}"
        );
        for point in [[1e5, 1.0, 0.0], [f64::NAN, 0.0, 0.0], [0.0, f64::INFINITY, 0.0]] {
            assert!(frame.place_of(&point.into()).is_err(), "{point:?}");
        }
    }

    proptest! {
        #[test]
        fn a_point_within_a_hundred_kilometres_comes_back(
            latitude in -89.0..=89.0f64, longitude in -180.0..=180.0f64, height in -400.0..4_000.0f64,
            x in -7e4..7e4f64, y in -7e4..7e4f64, z in -500.0..500.0f64,
        ) {
            let frame = LocalFrame::new(place(latitude, longitude, height)).unwrap();
            let there = frame.place_of(&Vector3::new(x, y, z)).unwrap();
            let back = frame.local_of(&there).unwrap();
            prop_assert!((back - Vector3::new(x, y, z)).norm() < 1e-4, "{} m", (back - Vector3::new(x, y, z)).norm());
        }

        #[test]
        fn no_numbers_panic(bits in any::<[u64; 3]>(), point in any::<[u64; 3]>()) {
            let [latitude, longitude, height] = bits.map(f64::from_bits);
            let frame = LocalFrame::new(place(48.0, 11.0, 0.0)).unwrap();
            let _ = frame.local_of(&place(latitude, longitude, height));
            let _ = frame.place_of(&Vector3::from(point.map(f64::from_bits)));
            let _ = LocalFrame::new(place(latitude, longitude, height));
        }
    }
}
