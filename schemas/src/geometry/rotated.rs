use crate::Box3;

/// A rectangle on the ground plane: a box seen from above, made ready for overlap tests.
///
/// Metres in any one frame. A rectangle without area overlaps nothing.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Footprint {
    /// Centre (x, y).
    pub center: [f64; 2],
    /// Half of the extents along and across the heading, not negative.
    pub half: [f64; 2],
    /// Unit vector of the heading: cosine and sine of the yaw.
    pub heading: [f64; 2],
    /// Half of the extents of the axis-aligned hull, along x and y.
    pub hull: [f64; 2],
    /// Area, m².
    pub area: f64,
}

impl Footprint {
    /// The footprint of a box.
    pub fn of(object: &Box3) -> Self {
        Footprint::new(
            [object.center[0], object.center[1]],
            object.length,
            object.width,
            object.yaw,
        )
    }

    /// The rectangle of a centre, extents along and across the heading (the sign does not matter) and a yaw in rad.
    pub fn new(center: [f64; 2], length: f64, width: f64, yaw: f64) -> Self {
        let (sin, cos) = libm::sincos(yaw);
        Footprint::from_heading(center, [length.abs() / 2.0, width.abs() / 2.0], [cos, sin])
    }

    fn from_heading(center: [f64; 2], half: [f64; 2], heading: [f64; 2]) -> Self {
        let [cos, sin] = heading.map(f64::abs);
        let hull = [half[0] * cos + half[1] * sin, half[0] * sin + half[1] * cos];
        Footprint {
            center,
            half,
            heading,
            hull,
            area: 4.0 * half[0] * half[1],
        }
    }

    /// (x, y) of the corners: front-left, front-right, rear-right, rear-left.
    pub fn corners(&self) -> [[f64; 2]; 4] {
        let ([cos, sin], [l, w]) = (self.heading, self.half);
        [(l, w), (l, -w), (-l, -w), (-l, w)]
            .map(|(x, y)| [self.center[0] + x * cos - y * sin, self.center[1] + x * sin + y * cos])
    }

    /// Heading, rad.
    #[cfg(test)]
    fn yaw(&self) -> f64 {
        libm::atan2(self.heading[1], self.heading[0])
    }

    /// Area that both axis-aligned hulls share.
    fn hull_overlap(&self, other: &Footprint) -> f64 {
        let side = |axis: usize| {
            let apart = (self.center[axis] - other.center[axis]).abs();
            // One hull may lie inside the other.
            let reach = self.hull[axis] + other.hull[axis] - apart;
            reach.min(2.0 * self.hull[axis]).min(2.0 * other.hull[axis]).max(0.0)
        };
        side(0) * side(1)
    }
}

/// Area that two footprints share, m²; at most the smaller one's.
pub fn intersection_area(a: &Footprint, b: &Footprint) -> f64 {
    let bound = a.area.min(b.area);
    // Also refuses NaN.
    if !(bound > 0.0 && a.hull_overlap(b) > 0.0) {
        return 0.0;
    }
    clipped_area(a, b).clamp(0.0, bound)
}

/// Intersection over union of two footprints, in [0, 1]; 0 where one has no area.
pub fn iou(a: &Footprint, b: &Footprint) -> f64 {
    let shared = intersection_area(a, b);
    if shared > 0.0 {
        shared / (a.area + b.area - shared)
    } else {
        0.0
    }
}

/// Whether the footprints' IoU is greater than `threshold` (not negative), mostly without computing it.
///
/// `iou(a, b)` and `iou(b, a)` may differ in their last bits: ask in a fixed order where results must not depend on it.
pub fn iou_exceeds(a: &Footprint, b: &Footprint, threshold: f64) -> bool {
    let exceeds = |shared: f64| shared > threshold * (a.area + b.area - shared);
    let bound = a.hull_overlap(b).min(a.area).min(b.area);
    // Rounding may bring an exact overlap above its hull's by some last digits.
    bound > 0.0 && exceeds(bound * (1.0 + 1e-9)) && exceeds(intersection_area(a, b))
}

/// Area of `b` inside `a`.
///
/// In the frame of `a`, whose sides are x = ±length and y = ±width there: the integral, around `b`, of y clamped to
/// ±width over x clamped to ±length. Each of the four edges adds its part; there is no polygon to grow or to degenerate.
fn clipped_area(a: &Footprint, b: &Footprint) -> f64 {
    let [cos_a, sin_a] = a.heading;
    let [cos_b, sin_b] = b.heading;
    let (dx, dy) = (b.center[0] - a.center[0], b.center[1] - a.center[1]);
    let (x, y) = (dx * cos_a + dy * sin_a, dy * cos_a - dx * sin_a);
    let (cos, sin) = (cos_b * cos_a + sin_b * sin_a, sin_b * cos_a - cos_b * sin_a);
    let (lx, ly) = (b.half[0] * cos, b.half[0] * sin);
    let (wx, wy) = (-b.half[1] * sin, b.half[1] * cos);
    let sides = a.half;
    // What cannot reach one of the sides of `a` shares nothing with it.
    if x.abs() - lx.abs() - wx.abs() >= sides[0] || y.abs() - ly.abs() - wy.abs() >= sides[1] {
        return 0.0;
    }
    let front_left = [x + lx + wx, y + ly + wy];
    let rear_left = [x - lx + wx, y - ly + wy];
    let rear_right = [x - lx - wx, y - ly - wy];
    let front_right = [x + lx - wx, y + ly - wy];
    let (lengthwise, across) = (ly / lx, wy / wx);
    // Against the sense of yaw, so that the upper edges add and the lower ones subtract.
    clamped_integral(rear_left, front_left, lengthwise, sides)
        + clamped_integral(front_left, front_right, across, sides)
        + clamped_integral(front_right, rear_right, lengthwise, sides)
        + clamped_integral(rear_right, rear_left, across, sides)
}

/// Integral of y over x along an edge of known slope, x clamped to ± the first and y to ± the second side.
#[inline(always)]
#[allow(clippy::manual_clamp)] // NaN must become a side, see below
fn clamped_integral(from: [f64; 2], to: [f64; 2], slope: f64, [length, width]: [f64; 2]) -> f64 {
    // `max` and `min` rather than `clamp`: they take NaN, the quotient of an edge along an axis, to a side.
    let within = |value: f64, side: f64| value.max(-side).min(side);
    let (start, end) = (within(from[0], length), within(to[0], length));
    if start == end {
        return 0.0;
    }
    let at = |x: f64| from[1] + (x - from[0]) * slope;
    let (low, high) = (at(start), at(end));
    // The shares of the way at which y meets -width and width.
    let rise = 1.0 / (high - low);
    let (one, other) = ((-width - low) * rise, (width - low) * rise);
    let share = |value: f64| value.max(0.0).min(1.0);
    let (enters, leaves) = (share(one.min(other)), share(one.max(other)));
    let y = |share: f64| within(low + share * (high - low), width);
    let mean = enters * within(low, width)
        + (leaves - enters) * 0.5 * (y(enters) + y(leaves))
        + (1.0 - leaves) * within(high, width);
    (end - start) * mean
}

#[cfg(test)]
mod tests {
    use std::f64::consts::{FRAC_PI_2, PI};

    use proptest::prelude::*;

    use super::*;

    /// Clips any convex polygon by any other, edge by edge, in coordinates around the first one's centre.
    fn naive_intersection(a: &Footprint, b: &Footprint) -> f64 {
        let around = |p: [f64; 2]| [p[0] - a.center[0], p[1] - a.center[1]];
        let mut clip: Vec<_> = a.corners().map(around).to_vec();
        clip.reverse();
        let mut polygon: Vec<_> = b.corners().map(around).to_vec();
        for (i, from) in clip.iter().enumerate() {
            let to = clip[(i + 1) % clip.len()];
            let side = |p: &[f64; 2]| (to[0] - from[0]) * (p[1] - from[1]) - (to[1] - from[1]) * (p[0] - from[0]);
            let mut kept = Vec::new();
            for (j, p) in polygon.iter().enumerate() {
                let q = &polygon[(j + 1) % polygon.len()];
                let (at_p, at_q) = (side(p), side(q));
                if at_p >= 0.0 {
                    kept.push(*p);
                }
                if at_p * at_q < 0.0 {
                    let share = at_p / (at_p - at_q);
                    kept.push([p[0] + share * (q[0] - p[0]), p[1] + share * (q[1] - p[1])]);
                }
            }
            polygon = kept;
        }
        let n = polygon.len();
        let twice: f64 = (0..n)
            .map(|i| (polygon[i], polygon[(i + 1) % n]))
            .map(|(p, q)| p[0] * q[1] - q[0] * p[1])
            .sum();
        twice.abs() / 2.0
    }

    fn footprint() -> impl Strategy<Value = Footprint> {
        (-6.0..6.0, -6.0..6.0, 0.3..9.0, 0.3..4.0, -7.0..7.0)
            .prop_map(|(x, y, length, width, yaw)| Footprint::new([x, y], length, width, yaw))
    }

    /// Pairs in which many edges nearly or exactly coincide.
    fn near_pair() -> impl Strategy<Value = (Footprint, Footprint)> {
        let shift = prop_oneof![Just(0.0), (-15i32..-1).prop_map(|e| 10f64.powi(e)), -1.0..1.0f64];
        let turn = (
            -8i32..8,
            prop_oneof![Just(0.0), (-15i32..-3).prop_map(|e| 10f64.powi(e))],
        );
        (footprint(), shift.clone(), shift, turn).prop_map(|(a, dx, dy, (eighths, rest))| {
            let yaw = a.yaw() + f64::from(eighths) * PI / 4.0 + rest;
            let b = Footprint::new(
                [a.center[0] + dx, a.center[1] + dy],
                2.0 * a.half[0],
                2.0 * a.half[1],
                yaw,
            );
            (a, b)
        })
    }

    fn moved(a: &Footprint, turn: f64, by: [f64; 2]) -> Footprint {
        let (sin, cos) = turn.sin_cos();
        let [x, y] = a.center;
        let center = [x * cos - y * sin + by[0], x * sin + y * cos + by[1]];
        Footprint::new(center, 2.0 * a.half[0], 2.0 * a.half[1], a.yaw() + turn)
    }

    fn check_pair(a: &Footprint, b: &Footprint) -> Result<(), TestCaseError> {
        let (ab, ba) = (iou(a, b), iou(b, a));
        prop_assert!((ab - ba).abs() <= 1e-12, "{ab} {ba}");
        prop_assert!((0.0..=1.0).contains(&ab));
        let shared = intersection_area(a, b);
        prop_assert!(
            (shared - naive_intersection(a, b)).abs() <= 1e-9,
            "{shared} {}",
            naive_intersection(a, b)
        );
        for threshold in [0.0, 0.15, 0.5, ab, ab * (1.0 - 1e-12), ab * (1.0 + 1e-12)] {
            let exact = shared > threshold * (a.area + b.area - shared);
            prop_assert_eq!(iou_exceeds(a, b, threshold), exact);
        }
        Ok(())
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(4000))]

        #[test]
        fn agrees_with_naive_clipping(a in footprint(), b in footprint()) {
            check_pair(&a, &b)?;
        }

        #[test]
        fn agrees_with_naive_clipping_where_edges_coincide((a, b) in near_pair()) {
            check_pair(&a, &b)?;
        }

        #[test]
        fn does_not_depend_on_the_frame(
            a in footprint(), b in footprint(), turn in -4.0..4.0f64, x in -1e6..1e6f64, y in -1e6..1e6f64,
        ) {
            let there = iou(&moved(&a, turn, [x, y]), &moved(&b, turn, [x, y]));
            prop_assert!((iou(&a, &b) - there).abs() < 1e-8, "{} {there}", iou(&a, &b));
        }

        #[test]
        fn is_one_for_identical_footprints(a in footprint(), turns in 0i32..4) {
            prop_assert!((iou(&a, &a) - 1.0).abs() < 1e-12);
            let centred = Footprint { center: [0.0; 2], ..a };
            let half_turned = moved(&centred, f64::from(turns) * PI, [0.0; 2]);
            prop_assert!((iou(&centred, &half_turned) - 1.0).abs() < 1e-12);
        }

        #[test]
        fn is_nothing_where_edges_touch(a in footprint(), along in 0.3..9.0f64, side in -1.0..1.0f64) {
            let reach = a.half[0] + along / 2.0;
            let [cos, sin] = a.heading;
            let slide = side * a.half[1];
            let center = [a.center[0] + reach * cos - slide * sin, a.center[1] + reach * sin + slide * cos];
            let b = Footprint::new(center, along, 2.0, a.yaw());
            prop_assert!(iou(&a, &b) < 1e-12);
        }
    }

    #[test]
    fn exact_cases() {
        let unit = Footprint::new([0.0, 0.0], 2.0, 2.0, 0.0);
        let cases = [
            ("edge", Footprint::new([2.0, 0.0], 2.0, 2.0, 0.0), 0.0),
            ("corner", Footprint::new([2.0, 2.0], 2.0, 2.0, 0.0), 0.0),
            ("half", Footprint::new([1.0, 0.0], 2.0, 2.0, 0.0), 1.0 / 3.0),
            ("inside", Footprint::new([0.2, 0.1], 1.0, 0.5, 1.0), 0.125),
            ("turned", Footprint::new([0.0, 0.0], 2.0, 2.0, FRAC_PI_2), 1.0),
            (
                "eighth",
                Footprint::new([0.0, 0.0], 2.0, 2.0, PI / 4.0),
                2f64.sqrt() / 2.0,
            ),
            ("negative extent", Footprint::new([1.0, 0.0], -2.0, 2.0, 0.0), 1.0 / 3.0),
        ];
        for (name, other, expected) in cases {
            assert!(
                (iou(&unit, &other) - expected).abs() < 1e-15,
                "{name}: {}",
                iou(&unit, &other)
            );
        }
    }

    #[test]
    fn what_has_no_area_or_is_not_a_number_overlaps_nothing() {
        let unit = Footprint::new([0.0, 0.0], 2.0, 2.0, 0.0);
        let line = Footprint::new([0.0, 0.0], 2.0, 0.0, 0.5);
        let point = Footprint::new([0.5, 0.5], 0.0, 0.0, 0.0);
        let broken = Footprint::new([f64::NAN, 0.0], 2.0, 2.0, 0.0);
        let endless = Footprint::new([0.0, 0.0], f64::INFINITY, 2.0, 0.0);
        for other in [line, point, broken] {
            for (a, b) in [(&unit, &other), (&other, &unit), (&other, &other)] {
                assert_eq!(iou(a, b), 0.0);
                assert!(!iou_exceeds(a, b, 0.0));
            }
        }
        assert!(iou(&unit, &endless).is_finite());
    }
}
