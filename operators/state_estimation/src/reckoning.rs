//! Dead reckoning on the plane before there is a pose: how the vehicle moved since it was switched on.

use nalgebra::{Vector2, Vector3};
use realo_schemas::Nanos;

use crate::ImuSample;
use crate::rules::Rules;

/// The mean of a time with changes of speed says the tilt to so many radians.
const TILT_MOVING: f64 = 0.012;
/// At a standstill.
const TILT_STANDING: f64 = 0.004;
/// Roads lean so far.
const TILT_OF_ROADS: f64 = 0.05;

/// The plane motion since the start, in a frame of its own.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Reckoning {
    pub time: Option<Nanos>,
    /// Of the IMU, m; without wheels as if the speed were 1 m/s.
    pub place: Vector2<f64>,
    /// From the axis at the start, rad.
    pub heading: f64,
    /// The last yaw rate, rad/s.
    pub rate: f64,
    /// The last speed of the wheels, m/s.
    pub speed: Option<f64>,
    /// How far the wheels rolled, m: less where they rolled back.
    pub way: f64,
    sums: ForceSums,
}

/// Sums over a time from which the tilt follows.
#[derive(Clone, Debug, Default, PartialEq)]
struct ForceSums {
    seconds: f64,
    force: Vector3<f64>,
    lateral: f64,
    first_speed: Option<f64>,
    moved: bool,
}

/// Roll and pitch with their standard deviation, rad.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Tilt {
    pub roll: f64,
    pub pitch: f64,
    pub sigma: f64,
}

impl Reckoning {
    /// Moves on to a stamp by the last speed and rate; over gaps as well, which the alignment then sees as noise.
    pub fn advance(&mut self, to: Nanos) {
        let seconds = self.time.map_or(0.0, |time| (to - time) as f64 * 1e-9);
        self.time = Some(to);
        let middle = self.heading + 0.5 * self.rate * seconds;
        let (sin, cos) = libm::sincos(middle);
        self.place += Vector2::new(cos, sin) * (self.speed.unwrap_or(1.0) * seconds);
        self.way += self.speed.unwrap_or(0.0) * seconds;
        self.heading += self.rate * seconds;
    }

    /// Takes a usable sample of the IMU; `period`: since the one before, s.
    pub fn imu(&mut self, sample: &ImuSample, period: f64, rules: &Rules) {
        self.advance(sample.stamp);
        self.rate = (rules.body_from_imu.rotation * sample.angular_rate).z;
        let sums = &mut self.sums;
        sums.seconds += period;
        sums.force += rules.body_from_imu.rotation * sample.specific_force * period;
        sums.lateral += self.rate * self.speed.unwrap_or(0.0) * period;
    }

    /// Takes a speed of the wheels.
    pub fn wheel(&mut self, stamp: Nanos, speed: f64) {
        self.advance(stamp);
        self.speed = Some(speed);
        self.sums.moved |= speed != 0.0;
        self.sums.first_speed.get_or_insert(speed);
    }

    /// Forgets the forces of the past.
    pub fn restart(&mut self) {
        self.sums = ForceSums {
            first_speed: self.speed,
            moved: self.speed.is_some_and(|speed| speed != 0.0),
            ..ForceSums::default()
        };
    }

    /// The tilt of the body: the mean specific force without what the wheels and the gyro say of accelerations.
    pub fn tilt(&self, rules: &Rules) -> Tilt {
        let level = Tilt {
            roll: 0.0,
            pitch: 0.0,
            sigma: TILT_OF_ROADS,
        };
        let sums = &self.sums;
        let (Some(first), Some(last)) = (sums.first_speed, self.speed) else {
            return level;
        };
        if sums.seconds < 0.2 {
            return level;
        }
        let motion = Vector3::new((last - first) / sums.seconds, sums.lateral / sums.seconds, 0.0);
        let up = sums.force / sums.seconds - motion;
        let noise = if sums.moved { TILT_MOVING } else { TILT_STANDING };
        Tilt {
            roll: libm::atan2(up.y, up.z),
            pitch: libm::atan2(-up.x, libm::hypot(up.y, up.z)),
            sigma: libm::hypot(noise, rules.noise.accel_bias_start / rules.earth.gravity),
        }
    }
}
