//! What the ego's own sweep shows of the ground around it: where nothing stands, where something does, and where it cannot see.

use nalgebra::Vector2;
use realo_schemas::PointCloud;

use crate::objects::Object;

/// Cells around the ego, and along a direction.
const DIRECTIONS: usize = 1024;
const RINGS: usize = 160;
/// Length of a cell along its direction, m.
const RING_M: f64 = 0.5;
/// Points that are looked at; of a denser sweep every second, third, …
const POINTS: usize = 120_000;
/// A beam that passes lower than this over the ground passes over nothing that stands there, m.
const LOW_M: f64 = 0.7;
/// Points between these heights are of something that stands on the ground, m.
const STANDS_M: [f64; 2] = [0.3, 2.5];
/// What is free ends this far before a beam's end, m.
const MARGIN_M: f64 = 0.5;
/// Beams that have to pass through a cell for it to be free.
const BEAMS: i32 = 2;
/// Places of an object's footprint that are looked at, along and across.
const LOOKS: [usize; 2] = [6, 3];

/// Cells of a sweep, in the ego's body frame: beams that pass each low over the ground, and points of what stands in it.
pub struct View {
    passing: Vec<i32>,
    standing: Vec<u32>,
}

/// What is where somebody says that an object is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Seen {
    /// Nothing stands there.
    Free,
    /// Something does.
    Something,
    /// The ego does not see it.
    Nothing,
}

impl View {
    /// The view of a sweep in the ego's body frame, whose z = 0 is the ground below the sensor.
    pub fn of(cloud: &PointCloud) -> Self {
        let mut view = View {
            passing: vec![0; DIRECTIONS * (RINGS + 1)],
            standing: vec![0; DIRECTIONS * (RINGS + 1)],
        };
        let height = sensor_height(cloud);
        for at in (0..cloud.len()).step_by(cloud.len() / POINTS + 1) {
            view.add([cloud.x[at], cloud.y[at], cloud.z[at]].map(f64::from), height);
        }
        // From where beams begin and end to how many pass.
        for direction in view.passing.chunks_exact_mut(RINGS + 1) {
            let mut beams = 0;
            for cell in direction {
                beams += *cell;
                *cell = beams;
            }
        }
        view
    }

    fn add(&mut self, [x, y, z]: [f64; 3], height: Option<f64>) {
        let Some((direction, range)) = polar(&Vector2::new(x, y)).filter(|_| z.is_finite()) else {
            return;
        };
        let first = direction * (RINGS + 1);
        if (STANDS_M[0]..=STANDS_M[1]).contains(&z) && range < RINGS as f64 * RING_M {
            self.standing[first + (range / RING_M) as usize] += 1;
        }
        // Where the beam comes down to the height at which it would hit what stands there. Without the sensor's height only the ground
        // that is seen is known to be free.
        let low = match height {
            Some(height) if z < LOW_M && height > LOW_M => range * (height - LOW_M) / (height - z),
            Some(height) if z < LOW_M && height <= LOW_M => 0.0,
            None if z < STANDS_M[0] => range - RING_M,
            _ => return,
        };
        let end = range - if z < STANDS_M[0] { 0.0 } else { MARGIN_M };
        let [low, end] = [low, end].map(|metres| (metres / RING_M).clamp(0.0, RINGS as f64) as usize);
        if end > low {
            self.passing[first + low] += 1;
            self.passing[first + end] -= 1;
        }
    }

    /// What the ego sees at a place.
    pub fn at(&self, place: &Vector2<f64>) -> Seen {
        let Some((direction, range)) = polar(place).filter(|(_, range)| *range < RINGS as f64 * RING_M) else {
            return Seen::Nothing;
        };
        let cell = direction * (RINGS + 1) + (range / RING_M) as usize;
        match (self.standing[cell], self.passing[cell]) {
            (1.., _) => Seen::Something,
            (0, BEAMS..) => Seen::Free,
            _ => Seen::Nothing,
        }
    }

    /// What the ego sees where an object would stand.
    ///
    /// An object that is there has points, or hides what is behind its near side. Most of its ground seen free means that it is not there.
    pub fn of_object(&self, center: &Vector2<f64>, yaw: f64, size: &[f64; 2]) -> Seen {
        // The outer tenth on each side is left out: boxes err by as much.
        let [free, something] = self.looks(center, yaw, size, 0.8);
        let all = LOOKS[0] * LOOKS[1];
        if 10 * free >= 6 * all && 10 * something <= all {
            return Seen::Free;
        }
        // Beams end on the sides.
        let [_, something] = self.looks(center, yaw, size, 1.3);
        if 10 * something >= all {
            Seen::Something
        } else {
            Seen::Nothing
        }
    }

    /// At how many places of an object's ground, of which `share` is looked at, nothing stands, and something does.
    fn looks(&self, center: &Vector2<f64>, yaw: f64, size: &[f64; 2], share: f64) -> [usize; 2] {
        let (sin, cos) = libm::sincos(yaw);
        let (mut free, mut something) = (0, 0);
        let [along, across] = LOOKS;
        for look in 0..along * across {
            let share = |place: usize, all: usize| share * ((place as f64 + 0.5) / all as f64 - 0.5);
            let (x, y) = (
                size[0] * share(look % along, along),
                size[1] * share(look / along, across),
            );
            match self.at(&(center + Vector2::new(x * cos - y * sin, x * sin + y * cos))) {
                Seen::Free => free += 1,
                Seen::Something => something += 1,
                Seen::Nothing => {}
            }
        }
        [free, something]
    }

    /// The same of an object at another place.
    pub fn of_moved(&self, object: &Object, center: &Vector2<f64>, turn: f64) -> Seen {
        self.of_object(center, object.yaw + turn, &object.size)
    }
}

/// Number of a place's direction and its distance, m; `None` for the origin and what is not finite.
///
/// Directions are cells of x / (|x| + |y|): they need no arc tangent, and are at most twice as wide as others.
fn polar(place: &Vector2<f64>) -> Option<(usize, f64)> {
    let (x, y) = (place.x, place.y);
    let sum = x.abs() + y.abs();
    if !(sum > 1e-3 && sum.is_finite()) {
        return None;
    }
    let along = x / sum;
    // 0 to 4 around the circle, from +x towards +y.
    let around = if y >= 0.0 { 1.0 - along } else { 3.0 + along };
    let direction = (around * (DIRECTIONS / 4) as f64) as usize % DIRECTIONS;
    Some((direction, (x * x + y * y).sqrt()))
}

/// Height of the sensor over the ground, m, from the beams: points of one beam lie on a cone, whose tip is the sensor.
///
/// `None` for sweeps whose beams are not known or see too little.
fn sensor_height(cloud: &PointCloud) -> Option<f64> {
    // By beam: number of points, sums of r, z, r², r z.
    let mut beams: Vec<[f64; 5]> = Vec::new();
    for at in (0..cloud.len()).step_by(cloud.len() / POINTS + 1) {
        let [x, y, z] = [cloud.x[at], cloud.y[at], cloud.z[at]].map(f64::from);
        let range = (x * x + y * y).sqrt();
        if !(range.is_finite() && z.is_finite() && range < 150.0) {
            continue;
        }
        let beam = usize::from(cloud.ring[at]);
        if beam >= beams.len() {
            beams.resize(beam + 1, [0.0; 5]);
        }
        for (sum, term) in beams[beam].iter_mut().zip([1.0, range, z, range * range, range * z]) {
            *sum += term;
        }
    }
    let tip = |[n, r, z, rr, rz]: &[f64; 5]| {
        let spread = n * rr - r * r;
        // Points at one distance say nothing of the tip.
        (*n >= 50.0 && spread > 4.0 * n * n).then(|| (z * rr - r * rz) / spread)
    };
    let mut tips: Vec<f64> = beams
        .iter()
        .filter_map(tip)
        .filter(|tip| (0.2..20.0).contains(tip))
        .collect();
    tips.sort_by(f64::total_cmp);
    // One cone that all points are said to lie on is none.
    (tips.len() >= 4).then(|| tips[tips.len() / 2])
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// A sweep of 64 beams from a height over flat ground with blocks: centre, half extents, height.
    pub(crate) fn sweep(height: f64, blocks: &[([f64; 2], [f64; 2], f64)], with_rings: bool) -> PointCloud {
        let (mut x, mut y, mut z, mut ring) = (vec![], vec![], vec![], vec![]);
        for beam in 0..64u16 {
            let down = (-24.0 + 0.42 * f64::from(beam)).to_radians();
            for column in 0..1800 {
                let azimuth = f64::from(column) * 0.2f64.to_radians();
                let direction = [down.cos() * azimuth.cos(), down.cos() * azimuth.sin(), down.sin()];
                let ground = if direction[2] < 0.0 {
                    -height / direction[2]
                } else {
                    f64::INFINITY
                };
                let hits = blocks.iter().filter_map(|block| enter(height, &direction, block));
                let range = hits.fold(ground, f64::min);
                if range < 100.0 {
                    x.push((range * direction[0]) as f32);
                    y.push((range * direction[1]) as f32);
                    z.push((height + range * direction[2]) as f32);
                    ring.push(if with_rings { beam } else { 0 });
                }
            }
        }
        let n = x.len();
        PointCloud::new(x, y, z, vec![9u8; n], vec![0; n], ring).expect("columns of one length")
    }

    /// Where a beam enters a block that stands on the ground.
    fn enter(height: f64, direction: &[f64; 3], (center, half, tall): &([f64; 2], [f64; 2], f64)) -> Option<f64> {
        let (mut near, mut far) = (0.0f64, f64::INFINITY);
        let sides = [
            (0.0, center[0] - half[0], center[0] + half[0], direction[0]),
            (0.0, center[1] - half[1], center[1] + half[1], direction[1]),
            (height, 0.0, *tall, direction[2]),
        ];
        for (from, low, high, along) in sides {
            let [a, b] = [(low - from) / along, (high - from) / along];
            near = near.max(a.min(b));
            far = far.min(a.max(b));
        }
        (near < far && near > 0.1).then_some(near)
    }

    const CAR: [f64; 2] = [4.5, 1.9];

    fn car_at(view: &View, x: f64, y: f64) -> Seen {
        view.of_object(&Vector2::new(x, y), 0.0, &CAR)
    }

    #[test]
    fn the_sensors_height_is_where_the_cones_of_its_beams_meet() {
        for height in [1.6, 1.9, 5.5] {
            let wall = ([0.0, -12.0], [8.0, 0.5], 4.0);
            let found = sensor_height(&sweep(height, &[wall], true)).expect("beams are known");
            assert!((found - height).abs() < 0.1, "{found} for {height}");
        }
        assert_eq!(sensor_height(&sweep(1.9, &[], false)), None);
        assert_eq!(sensor_height(&PointCloud::empty()), None);
    }

    #[test]
    fn ground_is_free_cars_are_something_and_behind_a_wall_nothing_is_seen() {
        let blocks = [([15.0, 3.0], [2.25, 0.95], 1.5), ([0.0, -12.0], [8.0, 0.5], 4.0)];
        for (height, with_rings) in [(1.9, true), (1.9, false), (5.5, true)] {
            let view = View::of(&sweep(height, &blocks, with_rings));
            assert_ne!(car_at(&view, 15.0, 3.0), Seen::Free, "{height} {with_rings}");
            assert_eq!(view.at(&Vector2::new(12.9, 3.0)), Seen::Something, "its front");
            assert_eq!(car_at(&view, 0.0, -16.0), Seen::Nothing, "{height} {with_rings}");
            for (x, y) in [(15.0, -3.0), (8.0, 0.0), (-12.0, 5.0), (3.0, 12.0)] {
                let seen = car_at(&view, x, y);
                assert!(
                    seen == Seen::Free || (!with_rings || height > 4.0) && seen == Seen::Nothing,
                    "{x} {y} {height} {seen:?}"
                );
            }
            assert_eq!(car_at(&view, 200.0, 0.0), Seen::Nothing);
        }
    }

    #[test]
    fn an_object_that_is_where_it_is_said_to_be_is_never_free() {
        for place in 0..10 {
            let (sin, cos) = libm::sincos(0.6 * f64::from(place));
            let range = 5.0 + 4.0 * f64::from(place);
            let at = [range * cos, range * sin];
            let view = View::of(&sweep(1.9, &[(at, [2.25, 0.95], 1.5)], true));
            // Detections err.
            for (dx, dy) in [(0.0, 0.0), (0.4, 0.0), (0.0, 0.3), (-0.4, -0.2)] {
                let seen = view.of_object(&Vector2::new(at[0] + dx, at[1] + dy), 0.05, &CAR);
                assert_ne!(seen, Seen::Free, "{at:?}");
            }
        }
    }

    #[test]
    fn numbers_that_are_no_places_are_not_looked_at() {
        let cloud = PointCloud::new(
            vec![f32::NAN, f32::INFINITY, 0.0, 1e30, 5.0],
            vec![0.0, 1.0, 0.0, 1e30, 0.0],
            vec![0.0, 0.0, 0.0, 0.0, f32::NAN],
            vec![0u8; 5],
            vec![0; 5],
            vec![u16::MAX; 5],
        );
        let view = View::of(&cloud.expect("columns of one length"));
        assert_eq!(view.at(&Vector2::new(5.0, 0.0)), Seen::Nothing);
        assert_eq!(view.at(&Vector2::new(f64::NAN, 0.0)), Seen::Nothing);
        assert_eq!(car_at(&view, f64::NAN, 0.0), Seen::Nothing);
    }
}
