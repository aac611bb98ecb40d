//! What odometry makes of a drive.

use nalgebra::Isometry3;
use realo_schemas::Nanos;
use realo_state_estimation::Faults;

use crate::anchors::{Fix, FixFaults};
use crate::keyframe::Keyframe;
use crate::odometry::Counts;

/// A part of a drive without a break.
#[derive(Clone, Debug, Default)]
pub struct Piece {
    /// Its keyframes, by time.
    pub keyframes: Vec<Keyframe>,
    /// Where the level body frame was in the piece's `odom`, by time.
    pub track: Vec<(Nanos, Isometry3<f64>)>,
}

/// A drive of one vehicle.
#[derive(Clone, Debug)]
pub struct Drive {
    /// Its pieces, by time.
    pub pieces: Vec<Piece>,
    /// Positions of GNSS that can be used, by time.
    pub fixes: Vec<Fix>,
    /// What was wrong with others.
    pub fix_faults: FixFaults,
    /// What was wrong with samples of IMU and wheels, and with poses of sweeps.
    pub faults: Faults,
    /// What became of sweeps.
    pub counts: Counts,
}
