//! How an agent moves, as its sensors measured it: inertial unit, satellite receiver, wheels.
//!
//! All three are fixed to the *vehicle frame*: its origin is that of the body frame, x forward, y left, z through the roof.
//! It leans with the vehicle, where the body frame stays level. Metres, seconds, radians.

use crate::{Header, Nanos};

/// Measurements are at most this far from the stamp or the time of their message, ns.
pub const MOST_APART: Nanos = 3_600_000_000_000;
/// Measurements of one kind in a message at most.
pub const MOST_SAMPLES: usize = 100_000;

/// When something was measured, and when it arrived, in a [`Motion`].
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Taken {
    /// The sensor's stamp, from that of the message's header, by the agent's clock; ns.
    pub stamp: Nanos,
    /// When it was there, from the header's `ready`, by the clock of the run; ns, 0 or less.
    pub arrival: Nanos,
}

impl Taken {
    /// The sensor's stamp, ns, in a message with this header.
    pub fn stamp_in(&self, header: &Header) -> Nanos {
        header.stamp.saturating_add(self.stamp)
    }

    /// When it was there, ns, in a message with this header.
    pub fn arrival_in(&self, header: &Header) -> Nanos {
        header.ready.saturating_add(self.arrival)
    }
}

/// What an inertial unit gave; means over the time since the sample before.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ImuSample {
    /// When: the end of the time that it is of.
    pub taken: Taken,
    /// Angular rate about the axes of the vehicle frame, rad/s.
    pub angular_rate: [f64; 3],
    /// Acceleration less gravity along the axes of the vehicle frame, m/s²: at rest 9.8 upwards.
    pub specific_force: [f64; 3],
}

/// How a position was found.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub enum FixQuality {
    /// From satellites alone.
    #[default]
    Single,
    /// Corrected by satellites (SBAS).
    Corrected,
    /// Corrected by a reference station, as RTK is (GBAS).
    Differential,
}

impl FixQuality {
    /// The number of `sensor_msgs/NavSatStatus`.
    pub fn code(self) -> u8 {
        match self {
            FixQuality::Single => 0,
            FixQuality::Corrected => 1,
            FixQuality::Differential => 2,
        }
    }

    /// The quality of a number; `None` for one that says that there is no position, or is unknown.
    pub fn of_code(code: i64) -> Option<Self> {
        match code {
            0 => Some(FixQuality::Single),
            1 => Some(FixQuality::Corrected),
            2 => Some(FixQuality::Differential),
            _ => None,
        }
    }
}

/// A position of a satellite receiver's antenna.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GnssFix {
    /// When.
    pub taken: Taken,
    /// Where the antenna is in `map`, m.
    pub position: [f64; 3],
    /// Whether the height is known; a receiver that reports exactly 0 over the ellipsoid does not know it.
    pub has_height: bool,
    /// Row-major 3×3 covariance along the axes of `map`, m², where the receiver says it.
    pub covariance: Option<[f64; 9]>,
    /// How it was found.
    pub quality: FixQuality,
}

/// How fast the wheels roll.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct WheelSpeed {
    /// When.
    pub taken: Taken,
    /// Speed of [`Motion::axle`] ahead along the vehicle frame's x, m/s; below 0 backwards. Exactly 0 at rest.
    pub speed: f64,
    /// Its variance, (m/s)², where the source says it.
    pub variance: Option<f64>,
}

/// What an agent's sensors measured of its motion since the message before, each list in order of arrival.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Motion {
    /// Samples of the inertial unit.
    pub imu: Vec<ImuSample>,
    /// White noise of a sample, where the unit says it: variances of an angular rate, (rad/s)², and a specific force, (m/s²)².
    pub imu_variance: Option<[f64; 2]>,
    /// Positions of the receiver's antenna.
    pub fixes: Vec<GnssFix>,
    /// Speeds of the wheels.
    pub wheels: Vec<WheelSpeed>,
    /// Where the inertial unit sits in the vehicle frame, m.
    pub imu_position: [f64; 3],
    /// Where the antenna sits in the vehicle frame, m.
    pub antenna: [f64; 3],
    /// The point of the vehicle frame that the wheels carry along x and never aside, m: the middle of a fixed axle.
    pub axle: [f64; 3],
}

impl Motion {
    /// Whether nothing was measured.
    pub fn is_empty(&self) -> bool {
        self.imu.is_empty() && self.fixes.is_empty() && self.wheels.is_empty()
    }

    /// What it takes of memory, bytes.
    pub fn bytes(&self) -> u64 {
        let size = |count: usize, of: usize| (count * of) as u64;
        size(self.imu.len(), size_of::<ImuSample>())
            + size(self.fixes.len(), size_of::<GnssFix>())
            + size(self.wheels.len(), size_of::<WheelSpeed>())
    }

    /// Why no sensor can have given it, in words: numbers that are not finite or beyond what the units hold.
    pub fn fault(&self) -> Option<String> {
        let mounts = [
            ("imu_position", self.imu_position),
            ("antenna", self.antenna),
            ("axle", self.axle),
        ];
        let far = mounts.iter().find(|(_, at)| !within(at, MOST_ARM));
        let far = far.map(|(name, at)| format!("`{name}`: expected a place within {MOST_ARM} m, found {at:?}"));
        far.or_else(|| self.imu_variance.and_then(|of| of.into_iter().find_map(variance_fault)))
            .or_else(|| self.imu.iter().find_map(ImuSample::fault))
            .or_else(|| self.fixes.iter().find_map(GnssFix::fault))
            .or_else(|| self.wheels.iter().find_map(WheelSpeed::fault))
    }
}

/// No sensor sits farther from the origin of its vehicle, m.
const MOST_ARM: f64 = 30.0;
/// No gyroscope of a vehicle turns faster, rad/s: sensors end at 2,000°/s.
pub const MOST_RATE: f64 = 100.0;
/// No accelerometer of a vehicle reads more, m/s²: shock sensors end there.
pub const MOST_FORCE: f64 = 5_000.0;
/// Nothing on wheels is faster, m/s.
pub const MOST_SPEED: f64 = 150.0;
/// Steps of gyroscopes, rad/s, and of accelerometers, m/s², that are fine enough to change with each sample of a moving vehicle. Those of
/// coarser units say the same for the time of a straight road.
pub const FINE_STEPS: [f64; 2] = [2e-4, 3e-3];
/// What rounding changes of a reading, as where axes of the unit were turned into those of the vehicle.
pub const ROUNDING: f64 = 1e-9;
/// One axis of a fine sensor may repeat its reading so often while the vehicle moves. One that is measured has changed as often before.
pub const STUCK_AXIS: u32 = 100;
/// Positions are nearer to the map's origin, m: Earth-centred ones are.
pub const MOST_DISTANCE: f64 = 8e7;
/// No variance is larger.
const MOST_VARIANCE: f64 = 1e12;

/// Whether all numbers are numbers of at most a size.
fn within(numbers: &[f64], most: f64) -> bool {
    numbers.iter().all(|v| v.abs() <= most)
}

fn variance_fault(variance: f64) -> Option<String> {
    let fits = (0.0..=MOST_VARIANCE).contains(&variance);
    (!fits).then(|| format!("expected a variance of 0 to {MOST_VARIANCE:e}, found {variance}"))
}

impl ImuSample {
    /// Why no unit can have given it, in words.
    pub fn fault(&self) -> Option<String> {
        let (rate, force) = (self.angular_rate, self.specific_force);
        if !within(&rate, MOST_RATE) {
            return Some(format!(
                "expected angular rates within ±{MOST_RATE} rad/s, found {rate:?}"
            ));
        }
        let fits = within(&force, MOST_FORCE);
        (!fits).then(|| format!("expected specific forces within ±{MOST_FORCE} m/s², found {force:?}"))
    }
}

impl GnssFix {
    /// Why no receiver can have given it, in words.
    pub fn fault(&self) -> Option<String> {
        let at = self.position;
        if !within(&at, MOST_DISTANCE) {
            return Some(format!(
                "expected a position within {MOST_DISTANCE:e} m of the map's origin, found {at:?}"
            ));
        }
        let covariance = self.covariance?;
        let diagonal = [0, 4, 8]
            .into_iter()
            .find_map(|place| variance_fault(covariance[place]));
        diagonal.or_else(|| {
            let fits = within(&covariance, MOST_VARIANCE);
            (!fits).then(|| format!("expected covariances within ±{MOST_VARIANCE:e} m², found {covariance:?}"))
        })
    }
}

impl WheelSpeed {
    /// Why no wheels can have given it, in words.
    pub fn fault(&self) -> Option<String> {
        let speed = self.speed;
        if !within(&[speed], MOST_SPEED) {
            return Some(format!("expected a speed within ±{MOST_SPEED} m/s, found {speed}"));
        }
        self.variance.and_then(variance_fault)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Kind;

    #[test]
    fn times_are_relative_to_the_header() {
        let header = Header::origin(&"run".into(), &"cav1".into(), Kind::Motion, 0, 1_000, 2_000);
        let taken = Taken {
            stamp: -30,
            arrival: -7,
        };
        assert_eq!((taken.stamp_in(&header), taken.arrival_in(&header)), (970, 1_993));
    }

    #[test]
    fn qualities_have_the_numbers_of_ros() {
        for quality in [FixQuality::Single, FixQuality::Corrected, FixQuality::Differential] {
            assert_eq!(FixQuality::of_code(quality.code().into()), Some(quality));
        }
        assert_eq!([FixQuality::of_code(-1), FixQuality::of_code(3)], [None, None]);
    }

    #[test]
    fn what_no_sensor_gives_is_named() {
        let imu = |rate: f64, force: f64| ImuSample {
            taken: Taken::default(),
            angular_rate: [0.0, rate, 0.0],
            specific_force: [0.0, 0.0, force],
        };
        let fix = |x: f64, variance: f64| GnssFix {
            taken: Taken::default(),
            position: [x, 0.0, 0.0],
            has_height: true,
            covariance: Some([variance, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]),
            quality: FixQuality::Single,
        };
        let wheel = |speed: f64, variance: f64| WheelSpeed {
            taken: Taken::default(),
            speed,
            variance: Some(variance),
        };
        let sound = Motion {
            imu: vec![imu(1.0, 9.8)],
            imu_variance: Some([1e-6, 1e-4]),
            fixes: vec![fix(5.0, 1.0)],
            wheels: vec![wheel(-2.0, 0.01)],
            ..Motion::default()
        };
        assert_eq!(sound.fault(), None);
        let with = |change: &dyn Fn(&mut Motion)| {
            let mut motion = sound.clone();
            change(&mut motion);
            motion.fault().unwrap_or_default()
        };
        for (found, words) in [
            (with(&|m| m.imu[0] = imu(f64::NAN, 9.8)), "angular rates"),
            (with(&|m| m.imu[0] = imu(0.0, f64::INFINITY)), "specific forces"),
            (with(&|m| m.fixes[0] = fix(f64::NAN, 1.0)), "a position"),
            (with(&|m| m.fixes[0] = fix(0.0, -1.0)), "a variance"),
            (with(&|m| m.wheels[0] = wheel(1e9, 1.0)), "a speed"),
            (with(&|m| m.wheels[0] = wheel(1.0, f64::NAN)), "a variance"),
            (with(&|m| m.imu_variance = Some([-1.0, 0.0])), "a variance"),
            (with(&|m| m.antenna[2] = 300.0), "`antenna`"),
        ] {
            assert!(found.contains(words), "{words}: {found}");
        }
    }
}
