//! Whether an IMU can be believed, by its samples one after the other.

use nalgebra::Vector3;

use crate::ImuSample;
use crate::fault::Fault;
use crate::predict::Increment;
use crate::rules::Rules;

/// A sample may be the same as so many before it.
const REPEATS: u32 = 2;
/// Time over which the specific force is averaged, s.
const AVERAGE_S: f64 = 1.0;
/// The averaged force may lean so far from up (cosine), as it does at the hardest braking.
const LEAN: f64 = 0.7;
/// And be so many times as long as gravity.
const LENGTH: [f64; 2] = [0.7, 1.3];
/// One sample's force points up by at least so much, in gravities, unless a wheel falls into a hole.
const UP: f64 = 0.2;

/// What is known of an IMU.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct ImuMonitor {
    last: Option<ImuSample>,
    repeats: u32,
    average: Vector3<f64>,
}

impl ImuMonitor {
    /// Looks at the next sample.
    ///
    /// # Errors
    /// Why it cannot be used.
    pub fn look(&mut self, sample: &ImuSample, rules: &Rules) -> Result<(), Fault> {
        let force = rules.body_from_imu.rotation * sample.specific_force;
        let share = match &self.last {
            None => 1.0,
            Some(last) => {
                let seconds = ((sample.stamp - last.stamp) as f64 * 1e-9).clamp(0.0, 0.1);
                seconds / (AVERAGE_S + seconds)
            }
        };
        self.average += (force - self.average) * share;
        let same =
            |last: ImuSample| (last.angular_rate, last.specific_force) == (sample.angular_rate, sample.specific_force);
        self.repeats = if self.last.is_some_and(same) {
            self.repeats + 1
        } else {
            0
        };
        self.last = Some(*sample);
        if self.repeats > REPEATS {
            return Err(Fault::ImuStuck);
        }
        let gravity = rules.earth.gravity;
        let length = self.average.norm();
        let leans = self.average.z < LEAN * length || force.z < UP * gravity;
        if leans || !(LENGTH[0] * gravity..LENGTH[1] * gravity).contains(&length) {
            return Err(Fault::ImuGravity);
        }
        Ok(())
    }
}

/// What the IMU integrates from one sample to the next by the rule of trapezoids, without the part that was taken from the
/// earlier one alone. A change between the samples may have come at any moment, evenly spread.
///
/// `taken`: the time after the earlier sample that was, s. `period`: between the two, s.
pub(crate) fn between(earlier: &ImuSample, later: &ImuSample, period: f64, taken: f64) -> Increment {
    let half = 0.5 * period;
    let sum = |a: &Vector3<f64>, b: &Vector3<f64>| (a + b) * half - a * taken;
    let spread = |a: &Vector3<f64>, b: &Vector3<f64>| (b - a).map(|change| change * change * period * period / 12.0);
    Increment {
        turn: sum(&earlier.angular_rate, &later.angular_rate),
        push: sum(&earlier.specific_force, &later.specific_force),
        spread: [
            spread(&earlier.angular_rate, &later.angular_rate),
            spread(&earlier.specific_force, &later.specific_force),
        ],
    }
}

/// What it integrates over a time from one sample alone.
pub(crate) fn held(sample: &ImuSample, seconds: f64) -> Increment {
    Increment {
        turn: sample.angular_rate * seconds,
        push: sample.specific_force * seconds,
        spread: [Vector3::zeros(); 2],
    }
}
