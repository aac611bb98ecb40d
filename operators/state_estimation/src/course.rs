//! Whether poses of scans follow each other as wheels roll: along their own headings, as far as the wheels say. No gyro is needed for that, so it
//! shows one that is wrong.

use nalgebra::{Point3, Vector2};
use realo_schemas::geometry::{normalize_yaw, yaw_of};
use realo_schemas::{Nanos, from_seconds};

use crate::models::LocalScan;
use crate::reckoning::Reckoning;
use crate::rules::Rules;

/// Scans follow each other within, s.
const SOON_S: f64 = 1.0;
/// A scan is compared with one that is no older, s.
const SPAN_S: f64 = 2.0;
/// How far they may be off, m and by the share of the way.
const OFF: (f64, f64) = (0.4, 0.05);
/// How far they may turn, rad, and by each metre: no vehicle turns round a tighter circle.
const BEND: (f64, f64) = (0.05, 0.35);
/// So many scans over so many metres prove a course.
const PROVEN: (u32, f64) = (10, 5.0);
/// A gyro that is so far off, rad, at so many scans in a row, is wrong.
const TURNED: f64 = 0.08;
const OFTEN: u32 = 3;
/// A gyro that is silent for longer cannot be compared, ns.
const SILENT: Nanos = 100_000_000;

/// Scans one after the other.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Course {
    run: Option<Run>,
    /// The last usable sample of the IMU.
    imu: Option<Nanos>,
}

/// Scans that follow each other.
#[derive(Clone, Debug, PartialEq)]
struct Run {
    count: u32,
    /// How far the vehicle came before `from`, m.
    way: f64,
    from: Point,
    last: Point,
    /// From `from` to `last` by the wheels, along the headings of scans.
    rolled: Vector2<f64>,
    /// Whether the gyro said all turns since `from`.
    has_gyro: bool,
    /// Scans in a row that contradict it.
    against: u32,
}

/// Where the wheels' axle is by a scan; what the gyro and the wheels say then.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Point {
    stamp: Nanos,
    place: Vector2<f64>,
    yaw: f64,
    heading: f64,
    way: f64,
}

impl Course {
    /// Notes a usable sample of the IMU.
    pub fn imu(&mut self, stamp: Nanos) {
        let gap = self.imu.is_none_or(|last| stamp - last > SILENT);
        self.imu = Some(stamp);
        if let Some(run) = self.run.as_mut().filter(|_| gap) {
            run.has_gyro = false;
        }
    }

    /// Takes a scan's pose; `odometer`: moved on to it.
    pub fn scan(&mut self, stamp: Nanos, scan: &LocalScan, odometer: &Reckoning, rules: &Rules) {
        if odometer.speed.is_none() {
            self.run = None;
            return;
        }
        let axle = rules.body_from_imu * Point3::from(rules.axle_in_imu);
        let here = Point {
            stamp,
            place: (scan.map_from_body * axle).coords.xy(),
            yaw: yaw_of(&scan.map_from_body.rotation),
            heading: odometer.heading,
            way: odometer.way,
        };
        let is_live = self.imu.is_some_and(|last| stamp - last <= SILENT);
        let next = self.run.take().and_then(|run| run.with(&here, is_live));
        self.run = Some(next.unwrap_or_else(|| Run::at(here, is_live)));
    }

    /// Whether scans up to now follow each other, over enough of the way to tell.
    pub fn is_proven(&self) -> bool {
        self.run.as_ref().is_some_and(Run::is_proven)
    }

    /// Whether the gyro turns otherwise than they do.
    pub fn is_gyro_wrong(&self) -> bool {
        self.run
            .as_ref()
            .is_some_and(|run| run.is_proven() && run.against >= OFTEN)
    }
}

impl Run {
    fn at(here: Point, has_gyro: bool) -> Self {
        Run {
            count: 1,
            way: 0.0,
            from: here,
            last: here,
            rolled: Vector2::zeros(),
            has_gyro,
            against: 0,
        }
    }

    /// With one more scan; `None` for one that does not follow.
    fn with(self, here: &Point, is_live: bool) -> Option<Self> {
        let bend = normalize_yaw(here.yaw - self.last.yaw);
        let step = here.way - self.last.way;
        let (sin, cos) = libm::sincos(self.last.yaw + 0.5 * bend);
        let rolled = self.rolled + Vector2::new(cos, sin) * step;
        let way = (here.way - self.from.way).abs();
        let off = (here.place - self.from.place - rolled).norm();
        let is_soon = here.stamp - self.last.stamp <= from_seconds(SOON_S);
        let follows = is_soon && bend.abs() <= BEND.0 + BEND.1 * step.abs() && off < OFF.0 + OFF.1 * way;
        if !follows {
            return None;
        }
        let has_gyro = self.has_gyro && is_live;
        let turned = normalize_yaw(here.yaw - self.from.yaw - (here.heading - self.from.heading)).abs();
        let against = if has_gyro && turned > TURNED {
            self.against.saturating_add(1)
        } else {
            0
        };
        let next = Run {
            count: self.count.saturating_add(1),
            last: *here,
            rolled,
            has_gyro,
            against,
            ..self
        };
        let is_over = here.stamp - next.from.stamp > from_seconds(SPAN_S);
        Some(match is_over {
            true => Run {
                way: next.way + way,
                from: *here,
                rolled: Vector2::zeros(),
                has_gyro: is_live,
                ..next
            },
            false => next,
        })
    }

    fn is_proven(&self) -> bool {
        let (count, way) = PROVEN;
        self.count >= count && self.way + (self.last.way - self.from.way).abs() >= way
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{Isometry3, Matrix6, Vector3};
    use realo_geodesy::{Geodetic, LocalFrame};

    use super::*;
    use crate::{ImuSample, Settings, Unit};

    /// Drives 6 s at 8 m/s round a circle. `gyro`: what it says at a time, rad/s; `shift`: where scans are found, m to the side. When the
    /// course is proven, and when the gyro is wrong.
    fn driven(gyro: impl Fn(f64) -> Option<f64>, shift: impl Fn(f64) -> f64) -> [Option<f64>; 2] {
        let rules = Rules::new(Settings::new(
            Unit::Tactical,
            LocalFrame::new(Geodetic::default()).unwrap(),
        ));
        let (mut course, mut odometer) = (Course::default(), Reckoning::default());
        let mut found = [None; 2];
        for k in 1..=600 {
            let (at, stamp) = (0.01 * f64::from(k), from_seconds(0.01 * f64::from(k)));
            odometer.wheel(stamp, 8.0);
            if let Some(rate) = gyro(at) {
                let sample = ImuSample {
                    stamp,
                    angular_rate: Vector3::z() * rate,
                    specific_force: Vector3::z() * 9.8,
                };
                odometer.imu(&sample, 0.01, &rules);
                course.imu(stamp);
            }
            if k % 10 == 0 {
                let (sin, cos) = (0.3 * at).sin_cos();
                let radius = 8.0 / 0.3;
                let place = Vector3::new(radius * sin, radius * (1.0 - cos) + shift(at), 0.0);
                let scan = LocalScan {
                    map_from_body: Isometry3::new(place, Vector3::z() * (0.3 * at)),
                    covariance: Matrix6::identity(),
                };
                odometer.advance(stamp);
                course.scan(stamp, &scan, &odometer, &rules);
                for (first, is) in found.iter_mut().zip([course.is_proven(), course.is_gyro_wrong()]) {
                    *first = first.or(is.then_some(at));
                }
            }
        }
        found
    }

    #[test]
    fn scans_that_go_where_wheels_roll_show_a_gyro_that_is_wrong() {
        let [proven, wrong] = driven(|_| Some(0.3), |_| 0.0);
        assert!(proven.is_some_and(|at| (0.9..1.2).contains(&at)) && wrong.is_none());
        // One that stands still from 3 s on at what it should not say.
        let [_, wrong] = driven(|at| Some(if at < 3.0 { 0.3 } else { 0.0 }), |_| 0.0);
        assert!(wrong.is_some_and(|at| (3.2..4.0).contains(&at)), "{wrong:?}");
        // One that is silent is not wrong, and not when it comes again.
        let [_, wrong] = driven(|at| (!(3.0..4.5).contains(&at)).then_some(0.3), |_| 0.0);
        assert_eq!(wrong, None);
    }

    #[test]
    fn scans_that_go_elsewhere_prove_nothing() {
        let [proven, wrong] = driven(|_| Some(0.0), |at| if (10.0 * at) as u64 % 9 < 4 { 0.0 } else { 1.5 });
        assert_eq!([proven, wrong], [None, None]);
    }
}
