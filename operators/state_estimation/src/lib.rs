//! Where an agent is and how it moves, from what its sensors say, and how well that is known.
//!
//! - [`Estimator`]: for vehicles. An error-state Kalman filter with 15 states of motion (position, velocity, attitude, biases of gyro
//!   and accelerometer), 3 for the wandering error of GNSS and 1 for the wheels' scale. It predicts by the IMU, and is corrected by
//!   GNSS, wheel speed and poses of scans, each behind a χ² gate of 99.9 %.
//! - [`HoldEstimator`]: for roadside units. It localises once, holds the pose, and notices when the unit was moved.
//! - [`Unit`]: errors of named sensors. [`Fault`]: what can be wrong with samples; each is counted in [`Faults`].
//!
//! # Which sample does what
//! | sample | rate | what it corrects |
//! |---|---|---|
//! | [`ImuSample`] | 100 Hz | nothing: it moves the estimate on, by trapezoids between samples |
//! | [`WheelSpeed`] | any | speed along, and no velocity across or up; exactly 0 is a standstill, where the gyro shows its bias |
//! | [`GnssFix`] | 10 Hz | position, as truth + what wanders + white noise |
//! | [`ScanPose`] | 10 Hz | position and heading, by its information: directions that the scan does not show stay as they are |
//!
//! Fixes that agree with each other and leave an estimate behind end it at once ([`Fault::GnssTrack`]); IMU or wheels that contradict their track
//! are named.
//!
//! Poses of scans that agree with wheels and gyro over some metres overrule a receiver without corrections that is off by as much as such
//! receivers are ([`Fault::GnssOffset`]).
//!
//! An estimate begins with GNSS as soon as dead reckoning and fixes align to 0.1 rad, or with a scan's pose that agrees with
//! GNSS, or with five scans that follow each other ([`Settings::scans_to_begin`]). It is given up when scans and GNSS agree against it, or when one of them contradicts
//! it for as long as [`Limits`] say.
//!
//! No number from outside causes a panic. Results are the same bits on every machine.

mod agreement;
mod align;
mod belief;
mod correct;
mod course;
mod deskew;
mod estimate;
mod estimator;
mod fault;
mod filter;
mod hold;
mod imu;
mod measured;
mod models;
mod predict;
mod reckoning;
mod rolling;
mod rules;
mod sample;
mod settings;
mod source;
mod start;
mod track;
mod unit;
mod witness;

pub use belief::{quaternion_of, vector_of};
pub use deskew::{deskewed, level, level_pose};
pub use estimate::{Estimate, Status};
pub use estimator::{Estimator, Verdict};
pub use fault::{Fault, Faults};
pub use hold::{HoldEstimator, HoldSettings};
pub use imu::Stuck;
pub use measured::{Measured, unit_of};
pub use sample::{GnssFix, ImuSample, MapFix, Sample, ScanPose, WheelSpeed, information_at_body};
pub use settings::{Earth, Limits, Mounting, ScanNoise, Settings, SettingsError};
pub use unit::{Inertial, Receiver, STANDARD_GRAVITY, Unit, UnitNoise, Wheels};
