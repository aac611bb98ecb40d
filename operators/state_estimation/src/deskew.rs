//! The motion within a sweep, by what is estimated.

use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use realo_schemas::geometry::{Motion, PoseTrack, yaw_of};
use realo_schemas::{Nanos, PointCloud};

use crate::Estimate;

/// Poses during a sweep are this far apart, ns.
const STEP: Nanos = 10_000_000;
/// Sweeps do not take longer, ns.
const LONGEST: Nanos = 1_000_000_000;
/// A heading that is less sure is none, rad.
const UNSURE: f64 = 1.0;

/// A sweep in the level body frame at its stamp; `None` while the motion during it is not known.
pub fn deskewed(
    cloud: &PointCloud,
    stamp: Nanos,
    estimate_at: impl Fn(Nanos) -> Option<Estimate>,
) -> Option<PointCloud> {
    let (first, last) = (*cloud.time.iter().min()?, *cloud.time.iter().max()?);
    let (first, last) = (Nanos::from(first).min(0), Nanos::from(last).max(0));
    if last - first > LONGEST {
        return None;
    }
    let mut track = PoseTrack::new(2 * LONGEST, 2 * STEP);
    let steps = (last - first) / STEP;
    for offset in (0..=steps).map(|step| first + step * STEP).chain([0, last]) {
        let at = stamp.checked_add(offset)?;
        let estimate = estimate_at(at).filter(|estimate| estimate.heading_sigma() < UNSURE)?;
        track.insert(at, level_pose(&estimate));
    }
    let motion = Motion::new(&track, stamp, first, last)?;
    let [x, y, z] = motion.at_stamp([&cloud.x, &cloud.y, &cloud.z], &cloud.time);
    Some(PointCloud {
        x: x.into(),
        y: y.into(),
        z: z.into(),
        ..cloud.clone()
    })
}

/// The pose of the level body frame.
pub fn level_pose(estimate: &Estimate) -> Isometry3<f64> {
    let pose = &estimate.map_from_body;
    level(&pose.translation.vector, yaw_of(&pose.rotation))
}

/// A level pose.
pub fn level(position: &Vector3<f64>, yaw: f64) -> Isometry3<f64> {
    let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), yaw);
    Isometry3::from_parts(Translation3::from(*position), turn)
}

#[cfg(test)]
mod tests {
    use nalgebra::Matrix6;

    use super::*;
    use crate::Status;

    const MS: Nanos = 1_000_000;

    /// 10 m/s along x.
    fn moving(sigma: f64) -> impl Fn(Nanos) -> Option<Estimate> {
        move |stamp| {
            Some(Estimate {
                stamp,
                map_from_body: Isometry3::translation(1e-8 * stamp as f64, 0.0, 0.0),
                covariance: Matrix6::identity() * (sigma * sigma),
                velocity: Vector3::x() * 10.0,
                angular_rate: None,
                status: Status::Tracking,
            })
        }
    }

    #[test]
    fn points_go_where_they_are_at_the_stamp() {
        let time = [-50, 0, 25, 50].map(|t| (t * MS) as i32);
        let cloud = PointCloud::new(
            vec![5.0f32; 4],
            vec![1.0; 4],
            vec![0.0; 4],
            vec![0; 4],
            time.to_vec(),
            vec![0u16; 4],
        )
        .unwrap();
        let moved = deskewed(&cloud, 1_000 * MS, moving(0.1)).unwrap();
        for (x, expected) in moved.x.iter().zip([4.5, 5.0, 5.25, 5.5]) {
            assert!((x - expected).abs() < 1e-4, "{x} {expected}");
        }
        assert_eq!(deskewed(&cloud, 1_000 * MS, moving(2.0)), None, "no heading");
        assert_eq!(deskewed(&PointCloud::empty(), 0, moving(0.1)), None);
    }
}
