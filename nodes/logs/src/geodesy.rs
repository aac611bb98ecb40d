//! Where a local map is on the Earth: between degrees on WGS 84 and metres east, north and up.

use nalgebra::Vector3;
use realo_geodesy::Geodetic;

/// Where the origin of a local map is on the ellipsoid WGS 84.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MapOrigin(Geodetic);

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
        Ok(MapOrigin(place(geodetic)))
    }

    /// East, north, up of a latitude, longitude (degrees) and height (m), m.
    pub fn to_map(&self, geodetic: [f64; 3]) -> [f64; 3] {
        place(geodetic).other_from_here(&self.0).translation.vector.into()
    }

    /// Latitude, longitude (degrees) and height (m) of a place in the map, m.
    pub fn from_map(&self, place: [f64; 3]) -> [f64; 3] {
        let found = self.0.place_of(&Vector3::from(place));
        [found.latitude_deg, found.longitude_deg, found.height_m]
    }
}

fn place([latitude_deg, longitude_deg, height_m]: [f64; 3]) -> Geodetic {
    Geodetic {
        latitude_deg,
        longitude_deg,
        height_m,
    }
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

    /// A minute of latitude is a nautical mile.
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
