//! What motion sensors measured, as it comes: how much of each, and whether stamps rise.

use std::collections::BTreeMap;

use realo_operator::{Counter, Outputs, StageOutputs};
use realo_schemas::motion::Taken;
use realo_schemas::{Header, Motion, Name, Nanos};

pub(crate) const IMU_SAMPLES: Counter = Counter::plain("imu_samples", "samples of inertial units that came");
pub(crate) const GNSS_FIXES: Counter = Counter::plain("gnss_fixes", "positions of satellite receivers that came");
pub(crate) const WHEEL_SPEEDS: Counter = Counter::plain("wheel_speeds", "speeds of wheels that came");
pub(crate) const MOTION_BACKWARDS: Counter = Counter::loss(
    "motion_backwards",
    "measurements of motion sensors whose stamp is not later than that of the one before",
    "measurements of motion sensors have stamps that do not rise",
    "`realo info` says how many of which topic: the sensor's clock stands still, runs backwards or was set",
);

/// The newest stamps of each agent: of its inertial unit, its receiver, its wheels.
#[derive(Debug, Default)]
pub(crate) struct Order(BTreeMap<Name, [Option<Nanos>; 3]>);

impl Order {
    /// Counts what a message has.
    pub fn count<O: StageOutputs>(&mut self, header: &Header, motion: &Motion, out: &mut Outputs<O>) {
        let newest = self.0.entry(header.agent.clone()).or_default();
        let imu: Vec<Taken> = motion.imu.iter().map(|sample| sample.taken).collect();
        let fixes: Vec<Taken> = motion.fixes.iter().map(|fix| fix.taken).collect();
        let wheels: Vec<Taken> = motion.wheels.iter().map(|wheel| wheel.taken).collect();
        let of_each = [(&IMU_SAMPLES, imu), (&GNSS_FIXES, fixes), (&WHEEL_SPEEDS, wheels)];
        for ((counter, taken), newest) in of_each.into_iter().zip(newest) {
            let mut backwards = 0;
            for stamp in taken.iter().map(|taken| taken.stamp_in(header)) {
                backwards += u64::from(newest.is_some_and(|newest| stamp <= newest));
                *newest = Some(newest.map_or(stamp, |newest| newest.max(stamp)));
            }
            let count = taken.len() as u64;
            out.count_of(counter, &header.agent, count, count);
            out.count_of(&MOTION_BACKWARDS, &header.agent, backwards, count);
        }
    }
}

#[cfg(test)]
mod tests {
    use realo_operator::Operator;
    use realo_schemas::{ImuSample, Kind, Message, WheelSpeed};

    use super::*;
    use crate::operator::{Input, Localization, Settings};

    fn message(stamp: Nanos, offsets: &[Nanos]) -> Message {
        let taken = |offset: &Nanos| Taken {
            stamp: *offset,
            arrival: *offset,
        };
        let imu = offsets.iter().map(|offset| ImuSample {
            taken: taken(offset),
            angular_rate: [0.0; 3],
            specific_force: [0.0, 0.0, 9.8],
        });
        let wheels = vec![WheelSpeed {
            taken: Taken::default(),
            speed: 3.0,
            variance: None,
        }];
        let motion = Motion {
            imu: imu.collect(),
            wheels,
            ..Motion::default()
        };
        let header = Header::origin(&"run".into(), &"cav1".into(), Kind::Motion, 0, stamp, stamp + 50);
        Message::new(header, motion)
    }

    #[test]
    fn what_came_is_counted_and_nothing_is_sent() {
        let mut localization = Localization::new(Settings::default()).unwrap();
        let mut out = Outputs::at(150);
        for (stamp, offsets) in [(100, &[-30, -20, -10][..]), (200, &[-120, -90]), (300, &[])] {
            localization
                .on_message(Input::MOTION, message(stamp, offsets), &mut out)
                .unwrap();
        }
        assert_eq!(out.take_sent(), []);
        let counted = ["imu_samples", "wheel_speeds", "gnss_fixes", "motion_backwards"].map(|name| out.counted(name));
        // A stamp of 80 came behind one of 90.
        assert_eq!(counted, [5, 3, 0, 1]);
    }
}
