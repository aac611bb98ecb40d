//! Whether poses of scans agree with how the vehicle moved by wheels and gyro: then they are of one place on the map, and not found
//! anew each time.

use nalgebra::Vector2;
use realo_schemas::geometry::{normalize_yaw, yaw_of};
use realo_schemas::{Nanos, from_seconds};

use crate::ImuSample;
use crate::course::Course;
use crate::models::LocalScan;
use crate::reckoning::Reckoning;
use crate::rules::Rules;

/// A scan is compared with one that is no older, s: then the gyro's bias has not turned the way.
const SPAN_S: f64 = 2.0;
/// Scans follow each other within, s.
const SOON_S: f64 = 1.0;
/// How far they may be off, m and by the share of the way, and turned, rad.
const OFF: (f64, f64) = (0.4, 0.05);
const TURNED: f64 = 0.05;
/// So many scans over so many metres prove it.
const PROVEN: (u32, f64) = (10, 5.0);

/// Scans one after the other, and the way by wheels and gyro.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Agreement {
    pub odometer: Reckoning,
    pub course: Course,
    run: Option<Run>,
}

/// Scans that agree.
#[derive(Clone, Debug, PartialEq)]
struct Run {
    count: u32,
    /// How far the vehicle came, m.
    way: f64,
    last: Nanos,
    from: Anchor,
}

/// A scan, and where the vehicle was then by the odometer.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Anchor {
    stamp: Nanos,
    place: Vector2<f64>,
    yaw: f64,
    reckoned: Vector2<f64>,
    heading: f64,
}

impl Agreement {
    /// Takes a usable IMU sample; `period`: since the one before, s.
    pub fn imu(&mut self, sample: &ImuSample, period: f64, rules: &Rules) {
        self.odometer.imu(sample, period, rules);
        self.course.imu(sample.stamp);
    }

    /// Takes a speed of the wheels.
    pub fn wheel(&mut self, stamp: Nanos, speed: f64) {
        self.odometer.wheel(stamp, speed);
    }

    /// Takes a scan's pose.
    pub fn scan(&mut self, stamp: Nanos, scan: &LocalScan, rules: &Rules) {
        self.odometer.advance(stamp);
        self.course.scan(stamp, scan, &self.odometer, rules);
        let here = Anchor {
            stamp,
            place: scan.map_from_body.translation.vector.xy(),
            yaw: yaw_of(&scan.map_from_body.rotation),
            reckoned: self.odometer.place,
            heading: self.odometer.heading,
        };
        let run = match self.run.take() {
            Some(run) if run.is_continued(&here) => run.with(&here),
            _ => Run {
                count: 1,
                way: 0.0,
                last: stamp,
                from: here,
            },
        };
        if run.from.stamp == stamp {
            // What leans the vehicle changes with the road.
            self.odometer.restart();
        }
        self.run = Some(run);
    }

    /// Whether scans up to now agree with the motion, over enough of it to tell: by wheels and gyro, or by wheels alone.
    pub fn is_proven(&self) -> bool {
        self.is_proven_by_both() || self.course.is_proven()
    }

    fn is_proven_by_both(&self) -> bool {
        let (count, way) = PROVEN;
        let is_known = self.odometer.speed.is_some();
        is_known
            && self
                .run
                .as_ref()
                .is_some_and(|run| run.count >= count && run.way >= way)
    }
}

impl Run {
    fn is_continued(&self, here: &Anchor) -> bool {
        let from = &self.from;
        let turned = normalize_yaw(here.yaw - from.yaw - (here.heading - from.heading)).abs();
        let (sin, cos) = libm::sincos(from.yaw - from.heading);
        let way = here.reckoned - from.reckoned;
        let expected = from.place + Vector2::new(cos * way.x - sin * way.y, sin * way.x + cos * way.y);
        let slack = OFF.0 + OFF.1 * way.norm();
        here.stamp - self.last <= from_seconds(SOON_S) && turned < TURNED && (here.place - expected).norm() < slack
    }

    fn with(self, here: &Anchor) -> Self {
        let is_over = here.stamp - self.from.stamp > from_seconds(SPAN_S);
        let way = (here.reckoned - self.from.reckoned).norm();
        Run {
            count: self.count.saturating_add(1),
            way: if is_over { self.way + way } else { self.way.max(way) },
            last: here.stamp,
            from: if is_over { *here } else { self.from },
        }
    }
}
