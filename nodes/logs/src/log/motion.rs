//! What an agent's motion sensors measured, in its vehicle frame.

use nalgebra::Isometry3;
use realo_schemas::motion::Taken;
use realo_schemas::{GnssFix, ImuSample, Motion, WheelSpeed};

use super::Entry;
use crate::cdr::CdrReader;
use crate::motion::{self, turned};
use crate::sweeps::NoCloud;
use crate::{LogError, Stream};

impl Entry {
    /// The frame of the message, as its header has it.
    pub(crate) fn frame(&self) -> Result<String, LogError> {
        let read = || {
            CdrReader::new(self.data())?
                .header()
                .map(|(_, frame)| frame.to_string())
        };
        read().map_err(|reason| self.bad(reason))
    }

    /// Where the sensor of the message sits in the vehicle frame, m, and how its axes are turned there.
    ///
    /// # Errors
    /// Bytes that have no header; a frame from which no transform leads to the body.
    pub fn mount(&self) -> Result<Isometry3<f64>, LogError> {
        let way = self.context.way(&self.agent, &self.frame()?, self.stamp());
        match way {
            Ok(way) => Ok(way.map_or_else(Isometry3::identity, |way| way.to_from_from)),
            Err(NoCloud::Unreadable(reason) | NoCloud::Unplaced(reason)) => Err(self.bad(reason)),
        }
    }

    /// The one measurement of [`Stream::Imu`], [`Stream::Fix`] or [`Stream::Wheels`], none where a receiver has no position. Its
    /// [`Taken`] has times of the log, not of a message.
    ///
    /// # Errors
    /// Bytes that are no such message; a frame from which no transform leads to the body; positions in a log that does not say
    /// where its map is; numbers that no sensor gives.
    pub fn motion(&self) -> Result<Motion, LogError> {
        let taken = Taken {
            stamp: self.stamp(),
            arrival: self.ready(),
        };
        let mount = self.mount()?;
        let at = mount.translation.vector.into();
        let bad = |reason| self.bad(reason);
        let mut motion = Motion::default();
        match self.stream {
            Stream::Imu => {
                let (_, reading) = motion::decode_imu(self.data()).map_err(bad)?;
                motion.imu.push(ImuSample {
                    taken,
                    angular_rate: turned(reading.angular_rate, &mount.rotation),
                    specific_force: turned(reading.specific_force, &mount.rotation),
                });
                motion.imu_variance = reading.variance;
                motion.imu_position = at;
            }
            Stream::Fix => {
                let (_, reading) = motion::decode_fix(self.data()).map_err(bad)?;
                let Some(quality) = reading.quality else {
                    return Ok(motion);
                };
                let origin = self.context.origin.as_ref().ok_or_else(|| bad(NO_ORIGIN.into()))?;
                motion.fixes.push(GnssFix {
                    taken,
                    position: origin.to_map(reading.geodetic),
                    has_height: reading.geodetic[2] != 0.0,
                    covariance: reading.covariance,
                    quality,
                });
                motion.antenna = at;
            }
            Stream::Wheels => {
                let (_, reading) = motion::decode_wheels(self.data()).map_err(bad)?;
                let [speed, ..] = turned(reading.velocity, &mount.rotation);
                motion.wheels.push(WheelSpeed {
                    taken,
                    speed,
                    variance: reading.variance,
                });
                motion.axle = at;
            }
            other => return Err(bad(format!("`{}` is no topic of a motion sensor", other.as_str()))),
        }
        motion.fault().map_or(Ok(motion), |fault| Err(bad(fault)))
    }
}

/// Why positions on the Earth are in no map.
const NO_ORIGIN: &str = "the log does not say where its map is: write `map_origin` into its record `realo`, [latitude, longitude, \
                         height] of the map's origin on WGS 84";
