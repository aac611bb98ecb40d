//! Roads, kerbs, bays and crossings. The place's plane: the main road along x, the centre at the origin.
//!
//! An *arm* k leaves the centre towards (cos, sin)(k · 90°); arms 0 and 2 are the main road (axis 0). Traffic keeps
//! to the right.

use crate::random::{Stream, mix, unit_of};
use crate::solid::fraction;

/// Width of a driving lane and of a cycle lane, m.
pub(crate) const LANE: f64 = 3.25;
pub(crate) const CYCLE_LANE: f64 = 1.5;
/// How far the roads reach from the centre, m.
pub(crate) const REACH: f64 = 180.0;
/// From kerb to building line, m.
pub(crate) const PAVEMENT: f64 = 6.5;
/// Depth of the parking bays that are cut into the pavement, m.
pub(crate) const BAY: f64 = 2.2;
/// Where along an arm the bays lie, m from the centre.
pub(crate) const BAYS: [f64; 2] = [32.0, 150.0];
/// Height of the kerbs, m.
pub(crate) const KERB: f64 = 0.12;
/// Radius of the kerb at corners, m.
const CORNER: f64 = 2.5;

/// Which of the two places on a grid.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Grid {
    /// Two roads that cross under traffic lights.
    Intersection,
    /// A straight road with a signalised crossing for pedestrians.
    Corridor,
}

/// The plan of the roads.
#[derive(Clone, Debug)]
pub(crate) struct Roads {
    pub grid: Grid,
    /// Driving lanes in each direction, by axis.
    pub lanes: [usize; 2],
    /// Half the width between the kerbs, by axis, m; 0 where the axis has no road.
    pub half: [f64; 2],
    /// Whether the axis' arms have parking bays.
    pub bays: [bool; 2],
}

impl Roads {
    pub fn new(grid: Grid, place: u64) -> Self {
        let mut draws = Stream::new(place, "roads", 0);
        let side = if draws.chance(0.5) { 2 } else { 1 };
        let side_bays = draws.chance(0.5);
        let lanes = match grid {
            Grid::Intersection => [2, side],
            Grid::Corridor => [2, 0],
        };
        let half = lanes.map(|n| if n == 0 { 0.0 } else { n as f64 * LANE + CYCLE_LANE });
        Roads {
            grid,
            lanes,
            half,
            bays: [true, side_bays && lanes[1] > 0],
        }
    }

    /// The arms that have a road.
    pub fn arms(&self) -> &'static [usize] {
        match self.grid {
            Grid::Intersection => &[0, 1, 2, 3],
            Grid::Corridor => &[0, 2],
        }
    }

    /// Distance of an axis' stop lines from the centre, m.
    pub fn stop(&self, axis: usize) -> f64 {
        match self.grid {
            Grid::Intersection => self.half[1 - axis] + 6.7,
            Grid::Corridor => 3.4,
        }
    }

    /// Distance from the centre behind which a leaving vehicle is clear of junction and crossing, m.
    pub fn clear(&self, axis: usize) -> f64 {
        match self.grid {
            Grid::Intersection => self.half[1 - axis] + 6.2,
            Grid::Corridor => 2.5,
        }
    }

    /// The middle of the crossing over an arm, m from the centre, and half its width.
    pub fn crossing(&self, axis: usize) -> (f64, f64) {
        match self.grid {
            Grid::Intersection => (self.half[1 - axis] + CORNER + 1.5, 1.5),
            Grid::Corridor => (0.0, 1.75),
        }
    }

    /// Half the road's width at a distance from the centre, bays included.
    fn half_at(&self, axis: usize, distance: f64) -> f64 {
        let bay = self.bays[axis] && (BAYS[0]..=BAYS[1]).contains(&distance);
        self.half[axis] + if bay { BAY } else { 0.0 }
    }

    /// Whether a point lies on raised ground, behind a kerb.
    #[inline]
    pub fn raised(&self, x: f64, y: f64) -> bool {
        self.inside_kerb(x, y) > 0.0
    }

    /// Distance from the kerb, positive on the raised side, m; exact near the kerb.
    pub fn inside_kerb(&self, x: f64, y: f64) -> f64 {
        let (x, y) = (x.abs(), y.abs());
        // The ground beyond the ends of the roads is a level square.
        if (x > REACH && y < self.half[0] + PAVEMENT + 4.0) || (y > REACH && x < self.half[1] + PAVEMENT + 4.0) {
            return -1.0;
        }
        let dy = y - self.half_at(0, x);
        if self.half[1] == 0.0 {
            return dy;
        }
        let dx = x - self.half_at(1, y);
        let (cx, cy) = (x - self.half[1] - CORNER, y - self.half[0] - CORNER);
        if dx > 0.0 && dy > 0.0 && cx < 0.0 && cy < 0.0 {
            return CORNER - (cx * cx + cy * cy).sqrt();
        }
        dx.min(dy)
    }

    /// How high raised ground stands under a walker, m: kerbs are lowered over half a metre.
    pub fn step_up(&self, x: f64, y: f64) -> f64 {
        super::step_up(self.inside_kerb(x, y))
    }

    /// Whether a point lies on a crossing.
    #[cfg(test)]
    pub fn on_crossing(&self, x: f64, y: f64, margin: f64) -> bool {
        self.arms().iter().any(|arm| {
            let (along, across) = if arm % 2 == 0 { (x, y) } else { (y, x) };
            let along = if *arm < 2 { along } else { -along };
            let (middle, half) = self.crossing(arm % 2);
            (along - middle).abs() <= half + margin && across.abs() <= self.half[arm % 2] + margin
        })
    }

    /// Reflectivity of the ground at a point: asphalt, paint or paving, with a speckle of 0.2 m.
    #[inline]
    pub fn reflectivity(&self, x: f64, y: f64, raised: bool) -> f64 {
        let cell = |v: f64| (v * 5.0 + 4096.0) as i32 as u64;
        let speckle = 0.8 + 0.4 * unit_of(mix(cell(x).wrapping_mul(0x9e37_79b9).wrapping_add(cell(y) << 32)));
        let base = match () {
            () if raised => 0.28,
            () if self.painted(x, y) => 0.75,
            () => 0.14,
        };
        base * speckle
    }

    /// Whether there is paint: lane lines, stop lines, the bars of a crossing.
    fn painted(&self, x: f64, y: f64) -> bool {
        let (ax, ay) = (x.abs(), y.abs());
        (ay < self.half[0] && self.painted_on(0, x, y, ax, ay))
            || (ax < self.half[1] && self.painted_on(1, y, x, ay, ax))
    }

    fn painted_on(&self, axis: usize, along: f64, across: f64, distance: f64, side: f64) -> bool {
        const LINE: f64 = 0.07;
        let (middle, half) = self.crossing(axis);
        if (distance - middle).abs() < half {
            return fraction(side) < 0.5;
        }
        let stop = self.stop(axis);
        if distance < stop {
            return false;
        }
        // A stop line lies across the lanes that come in: their left is the road's middle.
        let coming = (along > 0.0) == (across > 0.0) && axis == 0 || (along > 0.0) == (across < 0.0) && axis == 1;
        let coming = coming && side > LINE;
        if distance < stop + 0.3 {
            return coming;
        }
        let edge = self.half[axis] - CYCLE_LANE;
        let lanes = self.lanes[axis];
        let dashed = (1..lanes).any(|k| (side - k as f64 * LANE).abs() < LINE);
        side < LINE || (side - edge).abs() < LINE || dashed && fraction(along / 9.0) < 1.0 / 3.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn kerbs_lie_where_the_plan_says() {
        let roads = Roads::new(Grid::Corridor, 0);
        let half = 2.0 * LANE + CYCLE_LANE;
        assert!(!roads.raised(10.0, half - 0.01) && roads.raised(10.0, half + 0.01));
        assert!(!roads.raised(-60.0, -half - BAY + 0.01) && roads.raised(-60.0, -half - BAY - 0.01));
        let crossing = Roads::new(Grid::Intersection, 0);
        let [main, side] = crossing.half;
        assert!(!crossing.raised(side - 0.1, main + 50.0) && !crossing.raised(side + 0.2, main + 0.2));
        assert!(crossing.raised(side + 2.0, main + 2.0) && crossing.raised(-side - 2.0, -main - 2.0));
        assert!(crossing.on_crossing(crossing.crossing(0).0, 0.0, 0.0) && !crossing.on_crossing(0.0, 0.0, 0.0));
    }
}
