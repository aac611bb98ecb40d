//! What an agent's messages say of its motion, as estimators take it.

use realo_schemas::motion::Taken;
use realo_schemas::{GnssFix, ImuSample, Motion, Nanos};
use realo_time_offset::Middles;

use crate::{MapFix, Sample, Unit, UnitNoise, WheelSpeed};

/// Makes samples of an agent's messages, in the order of their stamps.
#[derive(Clone, Debug, Default)]
pub struct Measured {
    imu: Middles,
}

impl Measured {
    /// The samples of a message whose header has this stamp; those of the IMU are in the middle of the time that they are the mean of.
    pub fn samples(&mut self, header: Nanos, motion: &Motion) -> Vec<Sample> {
        let at = |taken: &Taken| header.saturating_add(taken.stamp);
        let mut samples: Vec<Sample> = Vec::new();
        for sample in &motion.imu {
            let middle = self.imu.of(at(&sample.taken));
            samples.push(Sample::Imu(imu(sample, middle)));
        }
        samples.extend(motion.fixes.iter().map(|fix| Sample::Fix(map_fix(fix, at(&fix.taken)))));
        samples.extend(motion.wheels.iter().map(|wheel| {
            Sample::Wheel(WheelSpeed {
                stamp: at(&wheel.taken),
                speed: wheel.speed,
            })
        }));
        samples.sort_by_key(Sample::stamp);
        samples
    }
}

fn imu(sample: &ImuSample, stamp: Nanos) -> crate::ImuSample {
    crate::ImuSample {
        stamp,
        angular_rate: sample.angular_rate.into(),
        specific_force: sample.specific_force.into(),
    }
}

fn map_fix(fix: &GnssFix, stamp: Nanos) -> MapFix {
    MapFix {
        stamp,
        position: fix.position.into(),
        has_height: fix.has_height,
        variance: fix.covariance.map(|of| [of[0], of[4], of[8]]),
    }
}

/// The unit whose gyroscopes are as noisy as an IMU says of its own; the noisiest of one that says nothing.
pub fn unit_of(imu_variance: Option<[f64; 2]>) -> Unit {
    // Of samples at 100 Hz.
    let density = |variance: f64| (variance * 0.01).sqrt();
    let ratio = |noise: &UnitNoise, variance: f64| (libm::log(density(variance)) - libm::log(noise.gyro_noise)).abs();
    match imu_variance {
        Some([rate, _]) if rate > 0.0 => {
            let units = [Unit::Consumer, Unit::Tactical];
            let nearest = units
                .into_iter()
                .min_by(|a, b| ratio(&a.noise(), rate).total_cmp(&ratio(&b.noise(), rate)));
            nearest.unwrap_or(Unit::Consumer)
        }
        _ => Unit::Consumer,
    }
}
