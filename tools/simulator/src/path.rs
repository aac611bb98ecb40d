//! Ways through the place: lines and arcs, and how somebody moves along one.

mod motion;

pub(crate) use motion::{Course, Motion, State};
use std::f64::consts::TAU;

/// Seconds between the recorded steps of a motion.
pub(crate) const TICK: f64 = 0.1;

/// A point of a path or a pose in the ground plane; metres, radians.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Pose2 {
    pub x: f64,
    pub y: f64,
    pub heading: f64,
}

impl Pose2 {
    /// The pose that lies `offset` to the left.
    pub fn aside(self, offset: f64) -> Self {
        self.at(0.0, offset)
    }

    /// The pose `ahead` of this one and `aside` to its left, with its heading.
    pub fn at(self, ahead: f64, aside: f64) -> Self {
        let (sin, cos) = libm::sincos(self.heading);
        Pose2 {
            x: self.x + ahead * cos - aside * sin,
            y: self.y + ahead * sin + aside * cos,
            heading: self.heading,
        }
    }
}

/// An angle brought into ±π.
pub(crate) fn angle_within(angle: f64) -> f64 {
    angle - TAU * (angle / TAU).round()
}

/// Lines and arcs that join smoothly.
#[derive(Clone, Debug)]
pub(crate) struct Path {
    stretches: Vec<Stretch>,
    length: f64,
}

#[derive(Clone, Copy, Debug)]
struct Stretch {
    start: f64,
    pose: Pose2,
    curvature: f64,
}

impl Stretch {
    fn at(&self, s: f64) -> Pose2 {
        let Pose2 { x, y, heading } = self.pose;
        let d = s - self.start;
        let (sin, cos) = libm::sincos(heading);
        if self.curvature == 0.0 {
            return Pose2 {
                x: x + d * cos,
                y: y + d * sin,
                heading,
            };
        }
        let turned = heading + self.curvature * d;
        let (sin1, cos1) = libm::sincos(turned);
        Pose2 {
            x: x + (sin1 - sin) / self.curvature,
            y: y - (cos1 - cos) / self.curvature,
            heading: turned,
        }
    }
}

impl Path {
    pub fn from(x: f64, y: f64, heading: f64) -> Self {
        let start = Stretch {
            start: 0.0,
            pose: Pose2 { x, y, heading },
            curvature: 0.0,
        };
        Path {
            stretches: vec![start],
            length: 0.0,
        }
    }

    /// A path of no length at a pose.
    pub fn from_pose(pose: Pose2) -> Self {
        Path::from(pose.x, pose.y, pose.heading)
    }

    pub fn length(&self) -> f64 {
        self.length
    }

    pub fn line(&mut self, length: f64) -> &mut Self {
        self.stretch(length, 0.0)
    }

    /// Turns by `angle` (left positive) on a circle of `radius`.
    pub fn arc(&mut self, radius: f64, angle: f64) -> &mut Self {
        self.stretch(
            radius * angle.abs(),
            if angle < 0.0 { -1.0 / radius } else { 1.0 / radius },
        )
    }

    fn stretch(&mut self, length: f64, curvature: f64) -> &mut Self {
        if length <= 0.0 {
            return self;
        }
        let mut pose = self.at(self.length).0;
        pose.heading -= TAU * (pose.heading / TAU).round();
        self.stretches.push(Stretch {
            start: self.length,
            pose,
            curvature,
        });
        self.length += length;
        self
    }

    /// Goes on with a path that begins where this one ends.
    pub fn append(&mut self, other: &Path) {
        let start = self.length;
        self.stretches.extend(other.stretches.iter().map(|s| Stretch {
            start: s.start + start,
            ..*s
        }));
        self.length += other.length;
    }

    /// A path through poses: two arcs from each to the next, so that headings join.
    pub fn through(poses: &[Pose2]) -> Self {
        let Pose2 { x, y, heading } = poses[0];
        let mut path = Path::from(x, y, heading);
        for to in &poses[1..] {
            path.reach(*to);
        }
        path
    }

    /// Goes on to a pose by two arcs whose tangents are equally long.
    pub fn reach(&mut self, to: Pose2) -> &mut Self {
        let from = self.at(self.length).0;
        let (wx, wy) = (to.x - from.x, to.y - from.y);
        let square = wx * wx + wy * wy;
        if square < 1e-12 {
            return self;
        }
        let (s0, c0) = libm::sincos(from.heading);
        let (s1, c1) = libm::sincos(to.heading);
        let along = wx * (c0 + c1) + wy * (s0 + s1);
        let bend = 2.0 * (1.0 - c0 * c1 - s0 * s1);
        let tangent = if bend < 1e-9 {
            square / (2.0 * along)
        } else {
            ((along * along + bend * square).sqrt() - along) / bend
        };
        let joint = [
            0.5 * (from.x + to.x + tangent * (c0 - c1)),
            0.5 * (from.y + to.y + tangent * (s0 - s1)),
        ];
        self.arc_to(joint).arc_to([to.x, to.y])
    }

    /// Goes on to a point by one arc.
    pub fn arc_to(&mut self, [x, y]: [f64; 2]) -> &mut Self {
        let from = self.at(self.length).0;
        let (wx, wy) = (x - from.x, y - from.y);
        let (sin, cos) = libm::sincos(from.heading);
        let (ahead, aside) = (wx * cos + wy * sin, wy * cos - wx * sin);
        let square = wx * wx + wy * wy;
        let curvature = 2.0 * aside / square;
        if square < 1e-16 || curvature.abs() < 1e-7 {
            return self.stretch(square.sqrt(), 0.0);
        }
        let angle = 2.0 * libm::atan2(aside, ahead);
        self.stretch(angle / curvature, curvature)
    }

    /// A curve that leaves one pose and comes to another as a cubic does whose handles fit an arc.
    pub fn between(from: Pose2, to: Pose2) -> Self {
        const STEPS: usize = 24;
        let (dx, dy) = (to.x - from.x, to.y - from.y);
        let distance = (dx * dx + dy * dy).sqrt();
        let (s0, c0) = libm::sincos(from.heading);
        let (s1, c1) = libm::sincos(to.heading);
        let bend = libm::cos(0.25 * angle_within(to.heading - from.heading));
        let handle = distance / (3.0 * bend * bend);
        let corners = [
            [from.x, from.y],
            [from.x + handle * c0, from.y + handle * s0],
            [to.x - handle * c1, to.y - handle * s1],
            [to.x, to.y],
        ];
        let mut path = Path::from(from.x, from.y, from.heading);
        for k in 1..STEPS {
            let u = k as f64 / STEPS as f64;
            let v = 1.0 - u;
            let at = |i: usize| {
                let [a, b, c, d] = corners.map(|corner| corner[i]);
                let point = v * v * v * a + 3.0 * v * v * u * b + 3.0 * v * u * u * c + u * u * u * d;
                let step = v * v * (b - a) + 2.0 * v * u * (c - b) + u * u * (d - c);
                (point, step)
            };
            let ((x, vx), (y, vy)) = (at(0), at(1));
            let heading = libm::atan2(vy, vx);
            path.reach(Pose2 { x, y, heading });
        }
        path.reach(to);
        path
    }

    /// The path that runs `offset` to the left of this one; every curve's radius must exceed the offset.
    pub fn parallel(&self, offset: f64) -> Self {
        let start = self.at(0.0).0.aside(offset);
        let mut path = Path::from(start.x, start.y, start.heading);
        for (from, to, curvature) in self.pieces() {
            let scale = 1.0 - curvature * offset;
            path.stretch((to - from) * scale, curvature / scale);
        }
        path
    }

    /// The part between two distances, of which the second is the greater.
    pub fn part(&self, from: f64, to: f64) -> Self {
        let start = self.at(from).0;
        let mut path = Path::from(start.x, start.y, start.heading);
        for (begin, end, curvature) in self.pieces() {
            path.stretch(end.min(to) - begin.max(from), curvature);
        }
        path
    }

    /// The same way in the other direction.
    pub fn reversed(&self) -> Self {
        let end = self.at(self.length).0;
        let mut path = Path::from(end.x, end.y, end.heading + std::f64::consts::PI);
        let pieces: Vec<_> = self.pieces().collect();
        for (from, to, curvature) in pieces.into_iter().rev() {
            path.stretch(to - from, -curvature);
        }
        path
    }

    /// Begin, end and curvature of each stretch.
    pub fn pieces(&self) -> impl Iterator<Item = (f64, f64, f64)> + '_ {
        self.stretches.iter().enumerate().map(|(k, stretch)| {
            let end = self.stretches.get(k + 1).map_or(self.length, |next| next.start);
            (stretch.start, end, stretch.curvature)
        })
    }

    /// Distance along the path of the point nearest to a point, and how far that lies to the left of it; looked for
    /// around `guess`.
    pub fn project(&self, x: f64, y: f64, guess: f64) -> (f64, f64) {
        let (mut s, mut aside) = (guess, 0.0);
        for _ in 0..8 {
            let (pose, curvature) = self.at(s);
            let (sin, cos) = libm::sincos(pose.heading);
            let (dx, dy) = (x - pose.x, y - pose.y);
            let ahead = dx * cos + dy * sin;
            aside = dy * cos - dx * sin;
            let step = ahead / (1.0 - curvature * aside).max(0.2);
            s = (s + step).clamp(0.0, self.length);
            if step.abs() < 1e-9 {
                break;
            }
        }
        (s, aside)
    }

    /// Pose and curvature after `s` metres; the ends go on as they are.
    pub fn at(&self, s: f64) -> (Pose2, f64) {
        let next = self.stretches.partition_point(|stretch| stretch.start <= s);
        let stretch = &self.stretches[next.max(1) - 1];
        (stretch.at(s), stretch.curvature)
    }

    /// The arcs from `s` on: (start, radius).
    pub fn arcs_from(&self, s: f64) -> impl Iterator<Item = (f64, f64)> + '_ {
        let first = self.stretches.partition_point(|stretch| stretch.start <= s).max(1) - 1;
        let arcs = self.stretches[first..]
            .iter()
            .filter(|stretch| stretch.curvature != 0.0);
        arcs.map(|stretch| (stretch.start, 1.0 / stretch.curvature.abs()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::{FRAC_PI_2, PI};

    #[test]
    fn right_turn_ends_where_geometry_says() {
        let mut path = Path::from(-10.0, 0.0, 0.0);
        path.line(10.0).arc(5.0, -FRAC_PI_2).line(2.0);
        let (end, curvature) = path.at(path.length());
        assert!(
            (end.x - 5.0).abs() < 1e-12 && (end.y + 7.0).abs() < 1e-12 && curvature == 0.0,
            "{end:?}"
        );
        assert_eq!(path.arcs_from(0.0).collect::<Vec<_>>(), [(10.0, 5.0)]);
    }

    fn near(a: Pose2, b: Pose2) -> bool {
        (a.x - b.x).abs() + (a.y - b.y).abs() < 1e-6 && libm::cos(a.heading - b.heading) > 1.0 - 1e-9
    }

    #[test]
    fn curves_begin_and_end_in_their_poses() {
        let mut draws = crate::random::Stream::new(1, "curves", 0);
        for _ in 0..200 {
            let mut pose = |x: f64| Pose2 {
                x: x + draws.between(-1.0, 1.0),
                y: draws.between(-4.0, 4.0),
                heading: draws.between(-0.8, 0.8),
            };
            let (from, to) = (pose(0.0), pose(14.0));
            let path = Path::between(from, to);
            assert!(near(path.at(0.0).0, from) && near(path.at(path.length()).0, to));
            let (part, back) = (path.part(2.0, 7.5), path.reversed());
            assert!((part.length() - 5.5).abs() < 1e-9);
            assert!(near(part.at(3.0).0, path.at(5.0).0));
            let mut turned = back.at(4.0).0;
            turned.heading -= PI;
            assert!(near(turned, path.at(path.length() - 4.0).0));
            let side = path.parallel(0.7).at(6.0).0;
            let (s, aside) = path.project(side.x, side.y, 6.0);
            assert!((aside - 0.7).abs() < 1e-6 && libm::cos(path.at(s).0.heading - side.heading) > 1.0 - 1e-9);
        }
    }

    #[test]
    fn quarter_of_a_circle_is_one() {
        let corner = |x, y, heading| Pose2 { x, y, heading };
        let path = Path::between(corner(0.0, 0.0, 0.0), corner(8.0, 8.0, FRAC_PI_2));
        assert!((path.length() - 8.0 * FRAC_PI_2).abs() < 0.02);
        for k in 1..30 {
            let radius = 1.0 / path.at(path.length() * f64::from(k) / 30.0).1;
            assert!((radius - 8.0).abs() < 0.5, "{radius}");
        }
    }

    #[test]
    fn speed_is_the_derivative_of_distance() {
        let mut path = Path::from(0.0, 0.0, 1.0);
        path.line(3.0).arc(4.0, PI).line(50.0);
        let ticks: Vec<_> = (0..40).map(|k| f64::from(k) * TICK).map(|t| (t * t, 2.0 * t)).collect();
        let course = Course::Moving(Motion {
            path,
            first: 1.0,
            ticks,
        });
        assert_eq!(course.at(0.9), None);
        for t in [1.05, 2.33, 3.71, 4.2] {
            let [before, now, after] = [t - 1e-5, t, t + 1e-5].map(|t| course.at(t).unwrap());
            let moved = (
                (after.pose.x - before.pose.x) / 2e-5,
                (after.pose.y - before.pose.y) / 2e-5,
            );
            assert!((moved.0 - now.speed * libm::cos(now.pose.heading)).abs() < 1e-6);
            assert!((moved.1 - now.speed * libm::sin(now.pose.heading)).abs() < 1e-6);
            let turned = (after.pose.heading - before.pose.heading) / 2e-5;
            assert!((turned - now.turn_rate).abs() < 1e-6);
            assert!((now.speed - 2.0 * (t - 1.0)).abs() < 1e-9);
        }
    }
}
