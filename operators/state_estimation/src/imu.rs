//! Whether an IMU can be believed, by its samples one after the other.

use nalgebra::Vector3;
use realo_schemas::motion;

use crate::ImuSample;
use crate::fault::Fault;
use crate::predict::Increment;
use crate::rules::Rules;

/// A sample may be the same as so many before it.
const REPEATS: u32 = 2;
/// Gyroscopes or accelerometers alone may repeat their values so often: in a vehicle that rolls by its wheels, and where no wheels say whether it
/// does. Readings of a vehicle that stands may be less than a step of the unit apart for as long as it stands.
const ALONE: [u32; 2] = [20, 50];
/// So many times as often where their steps are coarse, for the time of a straight road.
const COARSE: u32 = 10;
/// Time over which the specific force is averaged, s.
const AVERAGE_S: f64 = 1.0;
/// The averaged force may lean so far from up (cosine), as it does at the hardest braking.
const LEAN: f64 = 0.7;
/// And be so many times as long as gravity.
const LENGTH: [f64; 2] = [0.7, 1.3];
/// One sample's force points up by at least so much, in gravities, unless a wheel falls into a hole.
const UP: f64 = 0.2;

/// What of an IMU is stuck.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stuck {
    /// All of it.
    Whole,
    /// The gyroscopes alone, or one of them.
    Gyroscopes,
    /// The accelerometers alone, or one of them.
    Accelerometers,
}

/// What one axis of a sensor did so far.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct Axis {
    /// Samples in a row that repeat the one before, while the vehicle rolls.
    run: u32,
    /// How often its value changed: units with one gyroscope report 0 about the other axes.
    changes: u32,
    /// The smallest of its steps.
    step: Option<f64>,
}

impl Axis {
    fn look(&mut self, step: f64, rolls: bool) {
        if step <= motion::ROUNDING {
            self.run = self.run.saturating_add(u32::from(rolls));
            return;
        }
        self.run = 0;
        self.changes = self.changes.saturating_add(1);
        self.step = Some(self.step.map_or(step, |known| known.min(step)));
    }
}

/// What is known of an IMU.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct ImuMonitor {
    /// What was stuck last.
    pub stuck: Option<Stuck>,
    last: Option<ImuSample>,
    /// Samples in a row that repeat the one before.
    repeats: u32,
    /// The same of angular rates and specific forces by themselves, while the vehicle does not stand.
    alone: [u32; 2],
    /// The axes of both, in the frame of the IMU.
    axes: [[Axis; 3]; 2],
    average: Vector3<f64>,
}

impl ImuMonitor {
    /// Looks at the next sample; `speed`: the last one of the wheels, m/s; `rolls`: whether wheels turn, also if they are not believed.
    ///
    /// # Errors
    /// Why it cannot be used.
    pub fn look(&mut self, sample: &ImuSample, speed: Option<f64>, rolls: bool, rules: &Rules) -> Result<(), Fault> {
        let force = rules.body_from_imu.rotation * sample.specific_force;
        let share = match &self.last {
            None => 1.0,
            Some(last) => {
                let seconds = ((sample.stamp - last.stamp) as f64 * 1e-9).clamp(0.0, 0.1);
                seconds / (AVERAGE_S + seconds)
            }
        };
        self.average += (force - self.average) * share;
        if let Some(stuck) = self.repeated(sample, speed, rolls, rules) {
            self.stuck = Some(stuck);
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

    /// What has repeated its values too often with the next sample.
    fn repeated(&mut self, sample: &ImuSample, speed: Option<f64>, rolls: bool, rules: &Rules) -> Option<Stuck> {
        let last = self.last.replace(*sample)?;
        let pairs = [
            (last.angular_rate, sample.angular_rate),
            (last.specific_force, sample.specific_force),
        ];
        let steps = pairs.map(|(a, b)| [0, 1, 2].map(|axis| (a[axis] - b[axis]).abs()));
        let axes = self.axes.iter_mut().flatten().zip(steps.into_iter().flatten());
        axes.for_each(|(axis, step)| axis.look(step, rolls));
        let same = pairs.map(|(a, b)| a == b);
        let stands = speed == Some(0.0);
        for (run, same) in self.alone.iter_mut().zip(same) {
            *run = match same {
                true => run.saturating_add(u32::from(!stands)),
                false => 0,
            };
        }
        self.repeats = match same {
            [true, true] => self.repeats.saturating_add(1),
            _ => 0,
        };
        let most = ALONE[usize::from(speed.is_none())];
        let is_stuck = [0, 1].map(|part| self.alone[part] > if self.is_coarse(part) { COARSE * most } else { most });
        match is_stuck {
            _ if self.repeats > REPEATS => Some(Stuck::Whole),
            [true, _] => Some(Stuck::Gyroscopes),
            [_, true] => Some(Stuck::Accelerometers),
            [false, false] => self.one_axis(rules),
        }
    }

    /// Whether all steps of a sensor so far were coarser than its noise.
    fn is_coarse(&self, part: usize) -> bool {
        let steps = self.axes[part].iter().filter_map(|axis| axis.step);
        steps
            .reduce(f64::min)
            .is_some_and(|step| step > motion::FINE_STEPS[part])
    }

    /// Which sensor has an axis that is stuck. Only one with steps so fine that no two samples of it are equal by chance can tell. The
    /// gyroscope nearest to the vertical must change; other axes must once they did.
    fn one_axis(&self, rules: &Rules) -> Option<Stuck> {
        let up = rules.body_from_imu.rotation.inverse() * Vector3::z();
        let is_stuck = |part: usize| {
            let axes = &self.axes[part];
            let is_fine = !self.is_coarse(part) && axes.iter().any(|axis| axis.changes >= motion::STUCK_AXIS);
            let is_measured = |at: usize| axes[at].changes >= motion::STUCK_AXIS || (part == 0 && at == up.iamax());
            is_fine && (0..3).any(|at| axes[at].run > motion::STUCK_AXIS && is_measured(at))
        };
        match is_stuck(0) {
            true => Some(Stuck::Gyroscopes),
            false => is_stuck(1).then_some(Stuck::Accelerometers),
        }
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

#[cfg(test)]
mod tests {
    use std::f64::consts::FRAC_PI_2;

    use nalgebra::Isometry3;
    use realo_geodesy::{Geodetic, LocalFrame};
    use realo_schemas::from_seconds;

    use super::*;
    use crate::{Settings, Unit};

    /// Shows 400 samples at 100 Hz; the first that is stuck, and what of it.
    fn stuck(
        speed: impl Fn(usize) -> Option<f64>,
        reading: impl Fn(usize) -> [f64; 2],
    ) -> Option<(usize, Option<Stuck>)> {
        let frame = LocalFrame::new(Geodetic::default()).unwrap();
        let rules = Rules::new(Settings::new(Unit::Tactical, frame));
        let mut monitor = ImuMonitor::default();
        let first = (0..400).find(|k| {
            let [turn, push] = reading(*k);
            let sample = ImuSample {
                stamp: from_seconds(0.01 * *k as f64),
                // A unit that says nothing about the other axes.
                angular_rate: Vector3::new(0.0, 0.01, turn),
                specific_force: Vector3::new(push, 0.0, 9.8),
            };
            let rolls = speed(*k).is_some_and(|speed| speed != 0.0);
            monitor.look(&sample, speed(*k), rolls, &rules) == Err(Fault::ImuStuck)
        });
        first.map(|at| (at, monitor.stuck))
    }

    #[test]
    fn each_sensor_that_stands_still_is_found_by_itself() {
        let noise = |k: usize| (k * 37 % 101) as f64 * 1e-6;
        let from = |start: usize, k: usize| noise(k.min(start));
        let moving = |_: usize| Some(8.0);
        assert_eq!(stuck(moving, |k| [noise(k), noise(k + 1)]), None);
        assert_eq!(
            stuck(moving, |k| [from(200, k), from(200, k)]),
            Some((203, Some(Stuck::Whole)))
        );
        assert_eq!(
            stuck(moving, |k| [from(200, k), noise(k)]),
            Some((221, Some(Stuck::Gyroscopes)))
        );
        assert_eq!(
            stuck(moving, |k| [noise(k), from(200, k)]),
            Some((221, Some(Stuck::Accelerometers)))
        );
        assert_eq!(
            stuck(|_| None, |k| [from(200, k), noise(k)]),
            Some((251, Some(Stuck::Gyroscopes)))
        );
    }

    /// Axes: 0 to 2 of the gyroscopes, 3 to 5 of the accelerometers. Shows 800 samples of an IMU with these steps, one axis of which holds
    /// what it says at a sample; the first that is stuck, and what of it.
    fn held(
        settings: &Settings,
        axis: Option<usize>,
        from: usize,
        step: f64,
        rolls: bool,
    ) -> Option<(usize, Option<Stuck>)> {
        let noise = |k: usize| (k * 37 % 101) as f64 / 37.0 * step;
        let rules = Rules::new(settings.clone());
        let up = rules.body_from_imu.rotation.inverse() * Vector3::z() * 9.8;
        let mut monitor = ImuMonitor::default();
        let first = (0..800).find(|k| {
            let value = |at: usize| noise(if axis == Some(at) { (*k).min(from) } else { *k } + 7 * at);
            let sample = ImuSample {
                stamp: from_seconds(0.01 * *k as f64),
                angular_rate: Vector3::new(value(0), value(1), value(2)),
                specific_force: up + Vector3::new(value(3), value(4), value(5)),
            };
            let speed = if rolls { 8.0 } else { 0.0 };
            monitor.look(&sample, Some(speed), rolls, &rules) == Err(Fault::ImuStuck)
        });
        first.map(|at| (at, monitor.stuck))
    }

    fn settings(body_from_imu: Isometry3<f64>) -> Settings {
        let frame = LocalFrame::new(Geodetic::default()).unwrap();
        let mut settings = Settings::new(Unit::Tactical, frame);
        settings.mounting.body_from_imu = body_from_imu;
        settings
    }

    #[test]
    fn one_axis_that_stands_still_is_found_while_the_vehicle_rolls() {
        let level = settings(Isometry3::identity());
        assert_eq!(held(&level, None, 0, 1e-4, true), None);
        for axis in 0..6 {
            let sensor = if axis < 3 {
                Stuck::Gyroscopes
            } else {
                Stuck::Accelerometers
            };
            assert_eq!(
                held(&level, Some(axis), 150, 1e-4, true),
                Some((251, Some(sensor))),
                "axis {axis}"
            );
            assert_eq!(held(&level, Some(axis), 150, 1e-4, false), None);
            // What hardly ever changed is not measured, but for the turns of the vehicle.
            let expected = (axis == 2).then_some((101, Some(Stuck::Gyroscopes)));
            assert_eq!(held(&level, Some(axis), 0, 1e-4, true), expected, "axis {axis}");
        }
        // An IMU whose x points up, as the body's z does.
        let upright = settings(Isometry3::rotation(-Vector3::y() * FRAC_PI_2));
        let never = [0, 2].map(|axis| held(&upright, Some(axis), 0, 1e-4, true));
        assert_eq!(never, [Some((101, Some(Stuck::Gyroscopes))), None]);
    }

    #[test]
    fn one_gyroscope_with_coarse_steps_may_say_the_same_on_a_straight_road() {
        let rules = Rules::new(settings(Isometry3::identity()));
        let mut monitor = ImuMonitor::default();
        // It turns for a second, and drives straight on for 1.5 s.
        let noise = |k: usize| (k * 37 % 101) as f64 * 1e-4;
        for k in 0..250 {
            let sample = ImuSample {
                stamp: from_seconds(0.01 * k as f64),
                angular_rate: Vector3::new(0.0, 0.0, 0.0017 * k.min(100) as f64),
                specific_force: Vector3::new(noise(k), noise(k + 7), 9.8),
            };
            assert_eq!(monitor.look(&sample, Some(8.0), true, &rules), Ok(()), "{k}");
        }
    }

    #[test]
    fn units_with_coarse_steps_repeat_themselves_on_straight_roads() {
        let level = settings(Isometry3::identity());
        for axis in 0..6 {
            assert_eq!(held(&level, Some(axis), 150, 0.005, true), None, "axis {axis}");
        }
    }

    /// Steps of 0.06 °/s, as of a chip with 16 bits for 2,000 °/s, are more than a vehicle that stands shows.
    #[test]
    fn steps_of_the_unit_are_no_fault_while_the_vehicle_stands() {
        let noise = |k: usize| (k * 37 % 101) as f64 * 1e-3;
        assert_eq!(stuck(|_| Some(0.0), |k| [0.001, noise(k)]), None);
        // It is one once the vehicle drives off.
        let drives = |k: usize| Some(if k < 300 { 0.0 } else { 3.0 });
        assert_eq!(
            stuck(drives, |k| [0.001, noise(k)]),
            Some((320, Some(Stuck::Gyroscopes)))
        );
    }
}
