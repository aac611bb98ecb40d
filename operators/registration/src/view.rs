//! What an agent saw past: directions in which a sweep's points are farther away than a place.

use nalgebra::Vector3;

/// Bins of 1° of azimuth and of elevation.
const AZIMUTHS: usize = 360;
const ELEVATIONS: usize = 90;
/// Elevation at which the first bin begins, degrees.
const LOWEST: f64 = -60.0;
/// No point came from there.
const UNKNOWN: u16 = u16::MAX;
/// Bins of 3×3 that must have points, or nothing is said.
const MIN_KNOWN: usize = 5;

/// The nearest point of a sweep in each direction.
pub(crate) struct View {
    /// Where the sensor was, in the map's frame less its origin, m.
    pub sensor: Vector3<f64>,
    /// Smallest range in each bin, cm.
    ranges: Vec<u16>,
}

impl View {
    /// A view of no points.
    pub fn new(sensor: Vector3<f64>) -> Self {
        View {
            sensor,
            ranges: vec![UNKNOWN; AZIMUTHS * ELEVATIONS],
        }
    }

    /// Adds a point, m from the map's origin.
    pub fn add(&mut self, point: &Vector3<f64>) {
        let away = point - self.sensor;
        if let Some([azimuth, elevation]) = bin(&away) {
            let range = &mut self.ranges[elevation * AZIMUTHS + azimuth];
            *range = (*range).min((away.norm() * 100.0).min(65_534.0) as u16);
        }
    }

    /// Whether all points that are seen around the direction of a place are farther than it by `margin` m or more.
    ///
    /// The nearest point of 3×3 bins decides: so the ground in front of a place, the leaves beside a gap, and a thin pole beside a
    /// view keep it from being called empty.
    pub fn is_past(&self, place: &Vector3<f64>, margin: f64) -> bool {
        let away = place - self.sensor;
        let Some([azimuth, elevation]) = bin(&away) else {
            return false;
        };
        if elevation == 0 || elevation + 1 == ELEVATIONS {
            return false;
        }
        let (mut known, mut nearest) = (0, UNKNOWN);
        for row in elevation - 1..=elevation + 1 {
            for turn in [AZIMUTHS - 1, 0, 1] {
                let range = self.ranges[row * AZIMUTHS + (azimuth + turn) % AZIMUTHS];
                known += usize::from(range != UNKNOWN);
                nearest = nearest.min(range);
            }
        }
        known >= MIN_KNOWN && f64::from(nearest) * 0.01 > away.norm() + margin
    }
}

/// The bin of a direction; `None` above and below all.
fn bin(away: &Vector3<f64>) -> Option<[usize; 2]> {
    let azimuth = libm::atan2(away.y, away.x).to_degrees();
    let flat = (away.x * away.x + away.y * away.y).sqrt();
    let elevation = libm::atan2(away.z, flat).to_degrees() - LOWEST;
    let inside = elevation >= 0.0 && elevation < ELEVATIONS as f64;
    inside.then_some([(azimuth + 180.0) as usize % AZIMUTHS, elevation as usize])
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A wall across x at `range`, 40 m wide, over flat ground 2 m below the sensor.
    fn wall(range: f64) -> View {
        let mut view = View::new(Vector3::zeros());
        for elevation in -100..=100 {
            for azimuth in -400..400 {
                let (azimuth, elevation) = (f64::from(azimuth) * 0.2, f64::from(elevation) * 0.25);
                let direction = Vector3::new(1.0, libm::tan(azimuth.to_radians()), libm::tan(elevation.to_radians()));
                let on_wall = direction * range;
                let point = match on_wall.z < -2.0 {
                    true => direction * (-2.0 / direction.z),
                    false => on_wall,
                };
                view.add(&point);
            }
        }
        view
    }

    #[test]
    fn what_stands_before_a_wall_is_seen_past_and_what_stands_behind_is_not() {
        let view = wall(20.0);
        let past = |x, y, z| view.is_past(&Vector3::new(x, y, z), 1.0);
        assert!(past(10.0, 0.0, -0.5) && past(15.0, 5.0, -0.5));
        assert!(!past(20.0, 0.0, -0.5) && !past(19.5, 0.0, -0.5) && !past(30.0, 0.0, -0.5));
    }

    #[test]
    fn the_ground_is_never_seen_past() {
        let view = wall(60.0);
        for x in 4..60 {
            for below in [2.0, 1.9] {
                let place = Vector3::new(f64::from(x), 1.0, -below);
                assert!(!view.is_past(&place, 1.0), "{x} m away, {below} m below");
            }
        }
    }

    #[test]
    fn nothing_is_said_of_where_nothing_came_from() {
        let view = wall(20.0);
        for place in [[-10.0, 0.0, 0.0], [0.0, 0.0, 10.0], [0.0, 0.0, -10.0], [5.0, 0.0, 8.0]] {
            assert!(!view.is_past(&Vector3::from(place), 1.0), "{place:?}");
        }
        assert!(!View::new(Vector3::zeros()).is_past(&Vector3::new(9.0, 0.0, 0.0), 1.0));
    }
}
