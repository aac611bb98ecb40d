//! Sweeps that stand for the drive around them.

use nalgebra::{Isometry3, Matrix6, Vector6};
use realo_registration::{Alignment, Sample};
use realo_schemas::{Nanos, PointCloud, to_seconds};
use realo_state_estimation::Estimate;

/// Registration of one sweep to the last ones is not better than this, m.
const REGISTRATION_M: f64 = 0.015;
/// What dead reckoning loses beside what the filter says: of a place at once, m, and by the way, m/m; of a heading at once, rad, and by
/// the time, rad/s.
const PLACE: [f64; 2] = [0.02, 0.01];
const HEADING: [f64; 2] = [1e-3, 5e-4];
/// Of roll and pitch of a level frame, rad.
const TILT: f64 = 3e-3;

/// A sweep that is kept for the map, and where it was by odometry.
#[derive(Clone, Debug)]
pub struct Keyframe {
    /// The sweep's stamp, ns.
    pub stamp: Nanos,
    /// The level body frame by odometry.
    pub odom_from_body: Isometry3<f64>,
    /// Its points, sampled, in that frame.
    pub cloud: PointCloud,
    /// Information of the pose as seen from the keyframe before, as [`realo_pose_graph::Edge`] has it; nothing in the first of a piece.
    pub information: Matrix6<f64>,
    /// Covariance of the filter.
    pub covariance: Matrix6<f64>,
    /// Way from the beginning of the piece, m.
    pub travelled: f64,
}

impl Keyframe {
    /// The first of a piece, or one that follows `before`. `found`: how the sweep was registered.
    pub(crate) fn new(
        before: Option<&Keyframe>,
        estimate: &Estimate,
        odom_from_body: &Isometry3<f64>,
        sample: &Sample,
        found: Option<&Alignment>,
    ) -> Self {
        let mut keyframe = Keyframe {
            stamp: estimate.stamp,
            odom_from_body: *odom_from_body,
            cloud: cloud_of(sample),
            information: Matrix6::zeros(),
            covariance: estimate.covariance,
            travelled: 0.0,
        };
        if let Some(before) = before {
            let way = (odom_from_body.translation.vector - before.odom_from_body.translation.vector).norm();
            keyframe.travelled = before.travelled + way;
            let registered = found.map_or_else(Matrix6::zeros, |found| found.weighed(REGISTRATION_M));
            let seconds = to_seconds(keyframe.stamp.saturating_sub(before.stamp));
            let told = registered + reckoned(before, &keyframe, way, seconds);
            keyframe.information = seen_from(&before.odom_from_body, &told);
        }
        keyframe
    }
}

/// Information of a keyframe by dead reckoning from the one before.
fn reckoned(before: &Keyframe, after: &Keyframe, way: f64, seconds: f64) -> Matrix6<f64> {
    let grown = |axis: usize| (after.covariance[(axis, axis)] - before.covariance[(axis, axis)]).max(0.0);
    let place = PLACE[0] + PLACE[1] * way;
    let heading = HEADING[0] + HEADING[1] * seconds;
    let variances = [
        place * place + grown(0).max(grown(1)),
        place * place + grown(0).max(grown(1)),
        place * place + grown(2),
        TILT * TILT,
        TILT * TILT,
        heading * heading + grown(5),
    ];
    Matrix6::from_diagonal(&Vector6::from(variances.map(|variance| 1.0 / variance)))
}

/// Information over axes of `odom`, over those of a frame in it.
fn seen_from(odom_from_frame: &Isometry3<f64>, information: &Matrix6<f64>) -> Matrix6<f64> {
    let rotation = odom_from_frame.rotation.to_rotation_matrix().into_inner();
    let mut both = Matrix6::zeros();
    both.fixed_view_mut::<3, 3>(0, 0).copy_from(&rotation);
    both.fixed_view_mut::<3, 3>(3, 3).copy_from(&rotation);
    let turned = both.transpose() * information * both;
    0.5 * (turned + turned.transpose())
}

/// Points alone.
fn cloud_of(sample: &Sample) -> PointCloud {
    let n = sample.len();
    PointCloud {
        x: sample.x.clone().into(),
        y: sample.y.clone().into(),
        z: sample.z.clone().into(),
        intensity: vec![0; n].into(),
        time: vec![0; n].into(),
        ring: vec![0; n].into(),
    }
}
