//! Whether wheels roll as far as scans move. Scans that go along their own headings, and turn as the gyro says, are right; wheels that say another
//! way then are not: they are stuck, in another unit, or count backwards.

use nalgebra::{Point3, Vector2};
use realo_schemas::geometry::{normalize_yaw, yaw_of};
use realo_schemas::{Nanos, to_seconds};

use crate::models::LocalScan;
use crate::rules::Rules;

/// Scans follow each other within, s.
const SOON_S: f64 = 1.0;
/// Ways are compared over so long at least, s, and so far, m.
const SPAN: (f64, f64) = (1.0, 4.0);
/// A scan may be so far beside the way, m and by the share of it, and turn otherwise than the gyro, rad.
const BESIDE: (f64, f64) = (0.4, 0.05);
const TURNED: f64 = 0.05;
/// No vehicle is faster, m/s, or gets faster or slower by more, m/s².
const FASTEST: (f64, f64) = (60.0, 12.0);
/// Ways that differ by more are not the same: m, and by the share of the longer one.
const OFF: (f64, f64) = (0.5, 0.35);
/// So many spans one after the other are no slip.
const OFTEN: u32 = 2;

/// Wheels beside scans.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Rolling {
    /// When wheels spoke last, and their speed, m/s.
    wheel: Option<(Nanos, f64)>,
    /// Until when it is part of the way.
    until: Nanos,
    /// How far the wheels rolled, m: less where they rolled back.
    way: f64,
    run: Option<Run>,
    /// Spans in a row in which they differed, and in which they did not.
    against: u32,
    agreeing: u32,
}

/// Scans that follow each other.
#[derive(Clone, Debug, PartialEq)]
struct Run {
    last: Point,
    /// The speed from the scan before, m/s.
    speed: Option<f64>,
    /// Where the span began: its stamp, and how far the wheels had rolled, m.
    from: (Nanos, f64),
    /// How far scans went forwards since then, m.
    moved: f64,
    /// Scans so far.
    count: u32,
}

/// The wheels' axle by a scan, and the heading by the gyro.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Point {
    stamp: Nanos,
    place: Vector2<f64>,
    yaw: f64,
    heading: f64,
}

impl Rolling {
    /// Takes a speed of the wheels.
    pub fn wheel(&mut self, stamp: Nanos, speed: f64) {
        self.advance(stamp);
        self.wheel = Some((stamp, speed));
    }

    /// The last speed, unless wheels are silent since.
    pub fn speed(&self, stamp: Nanos) -> Option<f64> {
        let (_, speed) = self.wheel.filter(|(last, _)| to_seconds(stamp - last) <= SOON_S)?;
        Some(speed)
    }

    /// Moves on; what wheels said that are silent since is not known any more.
    fn advance(&mut self, to: Nanos) {
        if let Some((last, speed)) = self.wheel {
            self.way += speed * to_seconds(to - self.until);
            self.wheel = self.wheel.filter(|_| to_seconds(to - last) <= SOON_S);
        }
        self.until = to;
    }

    /// Takes a scan's pose; `heading`: by the gyro, rad from any axis. Says whether the wheels are wrong.
    pub fn scan(&mut self, stamp: Nanos, scan: &LocalScan, heading: f64, rules: &Rules) -> bool {
        self.advance(stamp);
        let axle = rules.body_from_imu * Point3::from(rules.axle_in_imu);
        let here = Point {
            stamp,
            place: (scan.map_from_body * axle).coords.xy(),
            yaw: yaw_of(&scan.map_from_body.rotation),
            heading,
        };
        let next = self.run.take().and_then(|run| run.with(&here));
        let mut run = next.unwrap_or_else(|| {
            (self.against, self.agreeing) = (0, 0);
            Run {
                last: here,
                speed: None,
                from: (stamp, self.way),
                moved: 0.0,
                count: 1,
            }
        });
        let rolled = self.way - run.from.1;
        let longer = rolled.abs().max(run.moved.abs());
        if self.wheel.is_none() {
            (self.against, self.agreeing) = (0, 0);
            (run.from, run.moved) = ((stamp, self.way), 0.0);
        } else if to_seconds(stamp - run.from.0) >= SPAN.0 && longer >= SPAN.1 {
            let is_off = (rolled - run.moved).abs() > OFF.0 + OFF.1 * longer;
            (self.against, self.agreeing) = (in_a_row(self.against, is_off), in_a_row(self.agreeing, !is_off));
            (run.from, run.moved) = ((stamp, self.way), 0.0);
        }
        self.run = Some(run);
        self.against >= OFTEN
    }

    /// Whether wheels roll as scans move.
    pub fn is_right(&self) -> bool {
        self.agreeing >= OFTEN
    }

    /// How many scans up to now go along their own headings, and turn as the gyro says.
    pub fn scans(&self) -> u32 {
        self.run.as_ref().map_or(0, |run| run.count)
    }
}

/// How often something was so in a row, with one more time at which it is or is not.
pub(crate) fn in_a_row(before: u32, is: bool) -> u32 {
    if is { before.saturating_add(1) } else { 0 }
}

impl Run {
    /// With one more scan; `None` for one that does not follow.
    fn with(self, here: &Point) -> Option<Self> {
        let seconds = to_seconds(here.stamp - self.last.stamp);
        let bend = normalize_yaw(here.yaw - self.last.yaw);
        let turned = normalize_yaw(bend - (here.heading - self.last.heading)).abs();
        let (sin, cos) = libm::sincos(self.last.yaw + 0.5 * bend);
        let step = here.place - self.last.place;
        let [along, beside] = [cos * step.x + sin * step.y, cos * step.y - sin * step.x];
        let speed = along / seconds.max(1e-3);
        let changed = self.speed.map_or(0.0, |last| (speed - last).abs());
        let follows = seconds <= SOON_S
            && turned < TURNED
            && beside.abs() < BESIDE.0 + BESIDE.1 * along.abs()
            && speed.abs() <= FASTEST.0
            && changed <= FASTEST.1 * seconds + 2.0 * BESIDE.0 / seconds.max(1e-3);
        follows.then_some(Run {
            last: *here,
            speed: Some(speed),
            moved: self.moved + along,
            count: self.count.saturating_add(1),
            ..self
        })
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{Isometry3, Matrix6, Vector3};
    use realo_geodesy::{Geodetic, LocalFrame};
    use realo_schemas::from_seconds;

    use super::*;
    use crate::{Settings, Unit};

    /// Drives 10 s at 8 m/s round a circle. `wheel`: what it says at a time, m/s; `shift`: where scans are found, m to the side. When wheels are
    /// said to be wrong.
    fn driven(wheel: impl Fn(f64) -> f64, shift: impl Fn(f64) -> f64) -> Option<f64> {
        let rules = Rules::new(Settings::new(
            Unit::Tactical,
            LocalFrame::new(Geodetic::default()).unwrap(),
        ));
        let mut rolling = Rolling::default();
        let mut found = None;
        for k in 1..=500 {
            let (at, stamp) = (0.02 * f64::from(k), from_seconds(0.02 * f64::from(k)));
            rolling.wheel(stamp, wheel(at));
            if k % 5 == 0 {
                let (sin, cos) = (0.1 * at).sin_cos();
                let place = Vector3::new(80.0 * sin, 80.0 * (1.0 - cos) + shift(at), 0.0);
                let scan = LocalScan {
                    map_from_body: Isometry3::new(place, Vector3::z() * (0.1 * at)),
                    covariance: Matrix6::identity(),
                };
                if rolling.scan(stamp, &scan, 0.1 * at, &rules) {
                    found = found.or(Some(at));
                }
            }
        }
        found
    }

    #[test]
    fn wheels_that_roll_otherwise_than_scans_move_are_wrong() {
        assert_eq!(driven(|_| 8.0, |_| 0.0), None);
        // A scale that is estimated, and slip for a second.
        assert_eq!(driven(|_| 8.6, |_| 0.0), None);
        assert_eq!(
            driven(|at| if (3.0..4.0).contains(&at) { 2.0 } else { 8.0 }, |_| 0.0),
            None
        );
        for wrong in [0.0, 28.8, -8.0, 2.2] {
            let found = driven(|_| wrong, |_| 0.0);
            assert!(found.is_some_and(|at| at < 3.0), "{wrong}: {found:?}");
        }
        let found = driven(|at| if at < 5.0 { 8.0 } else { 0.0 }, |_| 0.0);
        assert!(found.is_some_and(|at| (6.0..8.5).contains(&at)), "{found:?}");
    }

    #[test]
    fn scans_that_jump_say_nothing_of_wheels() {
        assert_eq!(
            driven(|_| 0.0, |at| if (10.0 * at) as u64 % 9 < 4 { 0.0 } else { 6.0 }),
            None
        );
    }
}
