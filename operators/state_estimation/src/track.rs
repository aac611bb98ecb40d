//! Whether IMU and wheels agree with the track of GNSS and with each other: when they do not, one of them is mounted or wired wrongly.

use nalgebra::{Vector2, Vector3};
use realo_schemas::geometry::normalize_yaw;
use realo_schemas::{Nanos, from_seconds, to_seconds};

use crate::ImuSample;
use crate::fault::Fault;
use crate::models::LocalFix;
use crate::reckoning::Reckoning;
use crate::rules::Rules;

/// From one place of the track to the next, s; after a longer time the track begins anew.
const APART_S: (f64, f64) = (2.0, 4.0);
/// Fixes with more than so many times the unit's variance are between buildings, and tell nothing.
const CLEAR: f64 = 1.5;
/// A way of three places is long enough to compare lengths, m; by wheels it may be so many times as long as by GNSS.
const LONG: f64 = 20.0;
const LENGTHS: [f64; 2] = [0.5, 2.0];
/// Two ways are long enough to compare turns, m; it is a turn from so much on, and the IMU's may be so different, rad.
const LEG: f64 = 8.0;
const TURN: f64 = 0.4;
const TURNS: f64 = 0.7;
/// Lengths and turns that contradict so often, one after the other, are no chance.
const OFTEN: [u32; 2] = [3, 2];
/// Sums of forces lose 63 % of themselves in so long, s.
const FORCES_S: f64 = 30.0;
/// A change of speed is taken over so long, s.
const BLOCK_S: f64 = 0.5;
/// Squares of accelerations that tell, m²/s³: two seconds of a brisk curve.
const TELLS: f64 = 6.0;
/// The measured part of an expected acceleration is 1; less than this is none, and less than that is the other way.
const NONE: f64 = 0.2;
const OPPOSITE: f64 = -0.3;
/// A contradiction is remembered for so long, ns.
const MEMORY: Nanos = 10_000_000_000;

/// The track and the motion beside it.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Track {
    places: [Option<Place>; 3],
    /// Contradictions one after the other: of lengths, of turns.
    against: [u32; 2],
    /// Whether the IMU turned as GNSS did in the last turn.
    is_turning_right: bool,
    /// How far the wheels went, m.
    way: f64,
    wheels: Option<(Nanos, f64)>,
    lateral: Slope,
    forward: Slope,
    block: Block,
    /// When something was contradicted last.
    named: Option<Nanos>,
}

/// A place of the track.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Place {
    stamp: Nanos,
    fixed: Vector2<f64>,
    reckoned: Vector2<f64>,
    way: f64,
}

/// Measured against expected accelerations.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct Slope {
    product: f64,
    square: f64,
}

/// Forward forces since a speed of the wheels.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct Block {
    push: f64,
    seconds: f64,
    from: Option<f64>,
}

impl Slope {
    fn add(&mut self, measured: f64, expected: f64, seconds: f64) {
        let keep = libm::exp(-seconds / FORCES_S);
        self.product = keep * self.product + measured * expected * seconds;
        self.square = keep * self.square + expected * expected * seconds;
    }

    /// The measured part; `None` while little was expected.
    fn share(&self) -> Option<f64> {
        (self.square >= TELLS).then(|| self.product / self.square)
    }
}

impl Track {
    /// Takes a usable IMU sample; `period`: since the one before, s.
    pub fn imu(&mut self, sample: &ImuSample, period: f64, rules: &Rules) {
        let Some((_, speed)) = self.wheels else { return };
        let turn = |vector: Vector3<f64>| rules.body_from_imu.rotation * vector;
        let (rate, force) = (turn(sample.angular_rate), turn(sample.specific_force));
        self.lateral.add(force.y, speed * rate.z, period);
        self.block.push += force.x * period;
        self.block.seconds += period;
    }

    /// Takes a speed of the wheels.
    pub fn wheel(&mut self, stamp: Nanos, speed: f64) {
        if let Some((before, speed)) = self.wheels.replace((stamp, speed)) {
            self.way += speed.abs() * to_seconds(stamp - before).min(1.0);
        }
        let Block { push, seconds, from } = self.block;
        let Some(from) = from.filter(|_| seconds < 2.0 * BLOCK_S) else {
            self.block = Block {
                from: Some(speed),
                ..Block::default()
            };
            return;
        };
        if seconds >= BLOCK_S {
            self.forward.add(push / seconds, (speed - from) / seconds, seconds);
            self.block = Block {
                from: Some(speed),
                ..Block::default()
            };
        }
    }

    /// Takes a fix, and the way by wheels and gyro; says which sensor contradicts.
    pub fn fix(&mut self, stamp: Nanos, fix: &LocalFix, odometer: &Reckoning, rules: &Rules) -> Option<Fault> {
        let unit = rules.noise.gnss[0] * rules.noise.gnss[0];
        if fix.variance.x.max(fix.variance.y) > CLEAR * unit {
            self.places = [None; 3];
            return None;
        }
        let since = self.places[2].map(|last| to_seconds(stamp - last.stamp));
        if since.is_some_and(|since| since < APART_S.0) {
            return None;
        }
        let here = Place {
            stamp,
            fixed: fix.position.xy(),
            reckoned: odometer.place,
            way: self.way,
        };
        self.places = match since {
            Some(since) if since <= APART_S.1 => [self.places[1], self.places[2], Some(here)],
            _ => [None, None, Some(here)],
        };
        let found = self.by_track().or_else(|| self.by_forces());
        if found.is_some() {
            self.named = Some(stamp);
        }
        found
    }

    /// Whether a sensor was named not long ago.
    pub fn is_contradicted(&self, now: Nanos) -> bool {
        self.named.is_some_and(|named| now - named <= MEMORY)
    }

    /// Whether the vehicle was pushed as its wheels got faster and slower.
    pub fn agrees_with_wheels(&self) -> bool {
        self.forward.share().is_some_and(|share| share > NONE)
    }

    fn by_track(&mut self) -> Option<Fault> {
        self.wheels?;
        let [Some(first), Some(middle), Some(last)] = self.places else {
            return None;
        };
        let fixed = [middle.fixed - first.fixed, last.fixed - middle.fixed];
        let reckoned = [middle.reckoned - first.reckoned, last.reckoned - middle.reckoned];
        let [by_gnss, by_wheels] = [fixed[0].norm() + fixed[1].norm(), last.way - first.way];
        if by_gnss.max(by_wheels) >= LONG {
            let is_off = by_wheels < LENGTHS[0] * by_gnss || by_wheels > LENGTHS[1] * by_gnss;
            self.against[0] = if is_off { self.against[0] + 1 } else { 0 };
        }
        if fixed.iter().chain(&reckoned).all(|leg| leg.norm() >= LEG) {
            let [by_gnss, by_imu] = [fixed, reckoned].map(|[a, b]| libm::atan2(a.perp(&b), a.dot(&b)));
            let is_off = normalize_yaw(by_gnss - by_imu).abs() > TURNS;
            if by_gnss.abs().max(by_imu.abs()) >= TURN {
                self.against[1] = if is_off { self.against[1] + 1 } else { 0 };
                self.is_turning_right = !is_off;
            }
        }
        if self.against[0] >= OFTEN[0] {
            return Some(Fault::WheelTrack);
        }
        (self.against[1] >= OFTEN[1]).then_some(Fault::ImuTrack)
    }

    /// Wheels that turn the wrong way contradict forces along and across; an IMU that is turned or has a wrong sign, one of them, or both
    /// in part.
    fn by_forces(&self) -> Option<Fault> {
        let [lateral, forward] = [self.lateral.share(), self.forward.share()];
        match (lateral, forward) {
            (Some(lateral), Some(forward)) if lateral.max(forward) < OPPOSITE => Some(Fault::WheelTrack),
            (Some(lateral), Some(forward)) if lateral.min(forward) < NONE => Some(Fault::ImuTrack),
            // Speed has not changed enough yet: a gyro that is right leaves the wheels.
            (Some(lateral), None) if lateral < OPPOSITE && self.is_turning_right => Some(Fault::WheelTrack),
            (Some(lateral), None) if (OPPOSITE..NONE).contains(&lateral) => Some(Fault::ImuTrack),
            _ => None,
        }
    }
}

/// Fixes that were refused one after the other, agree with each other, and leave the estimate behind.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Leaving {
    since: Nanos,
    last: Nanos,
    count: u32,
    /// How far off those of the beginning were, m: their sum and number.
    first: (Vector2<f64>, f64),
    /// How far off they are now, m: a mean that forgets.
    recent: Vector2<f64>,
    position: Vector2<f64>,
}

/// Fixes of so long a beginning are averaged, ns, and later ones over so many seconds: noise alone leaves nothing behind.
const BEGINNING: Nanos = 500_000_000;
const RECENT_S: f64 = 0.3;
/// Fixes are no farther apart than by so many standard deviations, and what a vehicle drives, m/s.
const FOLLOWS: (f64, f64) = (5.0, 50.0);
/// They left for so long, so many of them.
const LEFT: (Nanos, u32) = (1_000_000_000, 5);
/// So fast, m/s: GNSS that drifts is slower.
const LEFT_SPEED: f64 = 2.0;
/// And so far, m and in standard deviations of both.
const LEFT_FAR: (f64, f64) = (10.0, 6.0);

impl Leaving {
    /// With a fix that was refused; it begins anew with one that does not follow from the one before.
    pub fn with(before: Option<Self>, stamp: Nanos, fix: &LocalFix, residual: Vector2<f64>) -> Self {
        let position = fix.position.xy();
        let sigma = (2.0 * (fix.variance.x + fix.variance.y)).sqrt();
        let follows = |last: &Leaving| {
            let reach = FOLLOWS.0 * sigma + FOLLOWS.1 * to_seconds(stamp - last.last);
            stamp - last.last <= from_seconds(1.0) && (position - last.position).norm() <= reach
        };
        match before.filter(follows) {
            Some(before) => {
                let (sum, count) = before.first;
                let is_beginning = stamp - before.since <= BEGINNING;
                let share = 1.0 - libm::exp(-to_seconds(stamp - before.last) / RECENT_S);
                Leaving {
                    last: stamp,
                    count: before.count.saturating_add(1),
                    first: if is_beginning {
                        (sum + residual, count + 1.0)
                    } else {
                        (sum, count)
                    },
                    recent: before.recent + (residual - before.recent) * share,
                    position,
                    ..before
                }
            }
            None => Leaving {
                since: stamp,
                last: stamp,
                count: 1,
                first: (residual, 1.0),
                recent: residual,
                position,
            },
        }
    }

    /// Whether they left the estimate; `sigma`: of the estimate and a fix along each axis, m.
    pub fn is_gone(&self, stamp: Nanos, residual: Vector2<f64>, sigma: f64) -> bool {
        let seconds = to_seconds(stamp - self.since);
        let is_long = stamp - self.since >= LEFT.0 && self.count >= LEFT.1;
        let is_far = residual.norm() > LEFT_FAR.0.max(LEFT_FAR.1 * sigma);
        let first = self.first.0 / self.first.1;
        is_long && is_far && (self.recent - first).norm() > LEFT_SPEED * seconds
    }
}

#[cfg(test)]
mod tests {
    use realo_geodesy::{Geodetic, LocalFrame};

    use super::*;
    use crate::{Settings, Unit};

    #[test]
    fn accelerations_say_whether_wheels_count_the_way_that_the_vehicle_goes() {
        let frame = LocalFrame::new(Geodetic::default()).unwrap();
        let rules = Rules::new(Settings::new(Unit::Tactical, frame));
        // Ten seconds that begin at rest: pushes ahead, m/s², and what the wheels make of them.
        let agrees = |push: f64, sign: f64| {
            let mut track = Track::default();
            for k in 0..1000 {
                let stamp = from_seconds(0.01 * f64::from(k));
                let sample = ImuSample {
                    stamp,
                    angular_rate: Vector3::zeros(),
                    specific_force: Vector3::new(push, 0.0, 9.8),
                };
                track.imu(&sample, 0.01, &rules);
                if k % 10 == 0 {
                    track.wheel(stamp, sign * push * 0.01 * f64::from(k));
                }
            }
            track.agrees_with_wheels()
        };
        // Ahead, and truly backwards.
        assert!(agrees(1.0, 1.0) && agrees(-1.0, 1.0));
        assert!(!agrees(1.0, -1.0) && !agrees(0.0, 1.0));
    }
}
