//! Where a local map is on the Earth: between degrees on WGS 84 and metres east, north and up.

use nalgebra::{Matrix3, Vector3};

/// Where the origin of a local map is on the ellipsoid WGS 84.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MapOrigin {
    /// Latitude, degrees north; longitude, degrees east; height over the ellipsoid, m.
    geodetic: [f64; 3],
    /// The same, Earth-centred, m.
    center: Vector3<f64>,
    /// Axes of the map (east, north, up) as rows, Earth-centred.
    map_from_earth: Matrix3<f64>,
}

/// Half axis at the equator, m, and flattening of WGS 84.
const EQUATOR: f64 = 6_378_137.0;
const FLATTENING: f64 = 1.0 / 298.257_223_563;
/// Square of the first eccentricity.
const ECCENTRICITY: f64 = FLATTENING * (2.0 - FLATTENING);

/// Why numbers are no place on the Earth, in words.
pub(crate) fn geodetic_fault([latitude, longitude, height]: [f64; 3]) -> Option<String> {
    let fits = latitude.abs() <= 90.0 && longitude.abs() <= 360.0 && height.abs() <= 1e5;
    (!fits).then(|| {
        format!(
            "expected a latitude within ±90°, a longitude within ±360° and a height within ±100 km, found {latitude}, {longitude} \
             and {height}"
        )
    })
}

impl MapOrigin {
    /// A map whose origin is at a latitude (degrees north), longitude (degrees east) and height over the ellipsoid (m).
    ///
    /// # Errors
    /// Numbers that are no place on the Earth.
    pub fn new(geodetic: [f64; 3]) -> Result<Self, String> {
        if let Some(fault) = geodetic_fault(geodetic) {
            return Err(fault);
        }
        let (sin_lat, cos_lat) = libm::sincos(geodetic[0].to_radians());
        let (sin_lon, cos_lon) = libm::sincos(geodetic[1].to_radians());
        Ok(MapOrigin {
            geodetic,
            center: earth_centred(geodetic),
            map_from_earth: Matrix3::new(
                -sin_lon,
                cos_lon,
                0.0,
                -sin_lat * cos_lon,
                -sin_lat * sin_lon,
                cos_lat,
                cos_lat * cos_lon,
                cos_lat * sin_lon,
                sin_lat,
            ),
        })
    }

    /// Latitude, longitude (degrees) and height (m) of the origin.
    pub fn geodetic(&self) -> [f64; 3] {
        self.geodetic
    }

    /// East, north, up of a latitude, longitude (degrees) and height (m), m.
    pub fn to_map(&self, geodetic: [f64; 3]) -> [f64; 3] {
        (self.map_from_earth * (earth_centred(geodetic) - self.center)).into()
    }

    /// Latitude, longitude (degrees) and height (m) of a place in the map, m.
    pub fn from_map(&self, place: [f64; 3]) -> [f64; 3] {
        geodetic_of(self.center + self.map_from_earth.transpose() * Vector3::from(place))
    }
}

fn earth_centred([latitude, longitude, height]: [f64; 3]) -> Vector3<f64> {
    let (sin_lat, cos_lat) = libm::sincos(latitude.to_radians());
    let (sin_lon, cos_lon) = libm::sincos(longitude.to_radians());
    let normal = EQUATOR / (1.0 - ECCENTRICITY * sin_lat * sin_lat).sqrt();
    let across = (normal + height) * cos_lat;
    Vector3::new(
        across * cos_lon,
        across * sin_lon,
        (normal * (1.0 - ECCENTRICITY) + height) * sin_lat,
    )
}

/// Fixed-point steps on the latitude; each gains more than two digits.
const STEPS: usize = 8;

fn geodetic_of(place: Vector3<f64>) -> [f64; 3] {
    let across = libm::hypot(place.x, place.y);
    let mut latitude = libm::atan2(place.z, across * (1.0 - ECCENTRICITY));
    let mut height = 0.0;
    for _ in 0..STEPS {
        let (sin, cos) = libm::sincos(latitude);
        let normal = EQUATOR / (1.0 - ECCENTRICITY * sin * sin).sqrt();
        // Along the normal, which has no poles.
        height = across * cos + place.z * sin - normal * (1.0 - ECCENTRICITY * sin * sin);
        latitude = libm::atan2(place.z + ECCENTRICITY * normal * sin, across);
    }
    [
        latitude.to_degrees(),
        libm::atan2(place.y, place.x).to_degrees(),
        height,
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn places_come_back_to_a_tenth_of_a_millimetre() {
        for geodetic in [
            [48.1, 11.6, 519.0],
            [-33.9, 151.2, 0.0],
            [0.0, 0.0, 0.0],
            [78.2, -179.9, -20.0],
        ] {
            let origin = MapOrigin::new(geodetic).unwrap();
            assert!(origin.to_map(geodetic).iter().all(|v| v.abs() < 1e-8));
            for place in [[0.0, 0.0, 0.0], [150.0, -80.0, 3.0], [2e5, 1e5, -400.0]] {
                let back = origin.to_map(origin.from_map(place));
                let off = (0..3).map(|axis| (back[axis] - place[axis]).abs()).fold(0.0, f64::max);
                assert!(off < 1e-4, "{geodetic:?} {place:?}: {back:?}");
            }
        }
    }

    /// A minute of latitude is a nautical mile, and Earth-centred axes are known at the equator and the pole.
    #[test]
    fn distances_are_those_of_the_earth() {
        let origin = MapOrigin::new([45.0, 9.0, 0.0]).unwrap();
        let [east, north, up] = origin.to_map([45.0 + 1.0 / 60.0, 9.0, 0.0]);
        assert!(
            east.abs() < 1e-6 && (north - 1_852.2).abs() < 0.5 && up < 0.0,
            "{north}"
        );
        let [east, north, _] = origin.to_map([45.0, 9.001, 0.0]);
        assert!((east - 78.85).abs() < 0.05 && north.abs() < 0.01, "{east}");
        assert!((earth_centred([0.0, 0.0, 10.0]) - Vector3::new(6_378_147.0, 0.0, 0.0)).norm() < 1e-6);
        assert!((earth_centred([90.0, 0.0, 0.0]) - Vector3::new(0.0, 0.0, 6_356_752.314_245)).norm() < 1e-5);
    }

    #[test]
    fn what_is_no_place_is_refused() {
        for wrong in [[91.0, 0.0, 0.0], [0.0, 400.0, 0.0], [0.0, 0.0, f64::NAN]] {
            assert!(
                MapOrigin::new(wrong).unwrap_err().contains("a latitude within"),
                "{wrong:?}"
            );
        }
    }
}
