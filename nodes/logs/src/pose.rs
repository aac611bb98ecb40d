//! `AgentState` as `geometry_msgs/msg/PoseWithCovarianceStamped`, and as a frame for viewers.

use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion};
use realo_schemas::geometry::tilt_degrees;
use realo_schemas::{AgentState, Nanos, PoseStatus};

use crate::cdr::{CdrError, CdrReader, CdrWriter};

/// Appends a pose as CDR. An unknown covariance is written as zeros.
pub fn encode(buffer: &mut Vec<u8>, stamp: Nanos, frame: &str, state: &AgentState) {
    let mut out = CdrWriter::new(buffer);
    out.header(stamp, frame);
    write_isometry(&mut out, &state.map_from_body);
    out.f64s(state.covariance.as_deref().unwrap_or(&[0.0; 36]));
}

/// No variance is larger, m² or rad²: unknown ones are written as 0.
const MAX_VARIANCE: f64 = 1e12;

/// Why a covariance cannot be right, in words.
fn covariance_fault(covariance: &[f64; 36]) -> Option<String> {
    let is_variance = |place: usize| place.is_multiple_of(7);
    let is_wrong = |(place, value): &(usize, &f64)| {
        !value.is_finite() || value.abs() > MAX_VARIANCE || (is_variance(*place) && **value < 0.0)
    };
    let (place, value) = covariance.iter().enumerate().find(is_wrong)?;
    let what = if is_variance(place) {
        "a variance"
    } else {
        "a covariance"
    };
    let value = if value.abs() < 1e6 {
        value.to_string()
    } else {
        format!("{value:e}")
    };
    Some(format!("{what} of {value}"))
}

/// Why the covariance of a pose that can be read cannot be right, in words.
pub(crate) fn wrong_covariance(payload: &[u8]) -> Option<String> {
    let mut input = CdrReader::new(payload).ok()?;
    input.header().ok()?;
    isometry(&input.f64s().ok()?).ok()?;
    covariance_fault(&input.f64s::<36>().ok()?)
}

/// Reads a pose. A covariance of zeros, or one that cannot be right, is unknown; so are velocities.
///
/// # Errors
/// Bytes that are no such message; numbers that are no pose.
pub fn decode(payload: &[u8], status: PoseStatus) -> Result<(Nanos, AgentState), CdrError> {
    let mut input = CdrReader::new(payload)?;
    let (stamp, _) = input.header()?;
    let map_from_body = isometry(&input.f64s()?)?;
    let covariance = Some(input.f64s::<36>()?)
        .filter(|c| c.iter().any(|v| *v != 0.0) && covariance_fault(c).is_none())
        .map(Box::new);
    Ok((
        stamp,
        AgentState {
            map_from_body,
            covariance,
            velocity: None,
            angular_rate: None,
            status,
        },
    ))
}

/// Max distance from the map's origin, m: Earth-centred positions are nearer.
const FARTHEST: f64 = 8e7;

/// Why no agent can have a pose, in words; `None` for one that can be.
pub(crate) fn fault(state: &AgentState) -> Option<String> {
    let pose = &state.map_from_body;
    // Without squares, which overflow.
    let far = pose
        .translation
        .vector
        .iter()
        .fold(0.0, |far: f64, along| far.hypot(*along));
    if far > FARTHEST {
        let km = far / 1000.0;
        return Some(format!(
            "expected a position within 80,000 km of the map's origin, found {km:e} km"
        ));
    }
    let tilt = tilt_degrees(&pose.rotation);
    (tilt > 90.0).then(|| {
        format!("expected a body with z up, found a tilt of {tilt:.0}°: is the quaternion in the order x, y, z, w?")
    })
}

/// Appends a `tf2_msgs/msg/TFMessage` that places one frame in another.
pub fn encode_transform(
    buffer: &mut Vec<u8>,
    stamp: Nanos,
    parent: &str,
    child: &str,
    parent_from_child: &Isometry3<f64>,
) {
    let mut out = CdrWriter::new(buffer);
    out.length(1);
    out.header(stamp, parent);
    out.string(child);
    write_isometry(&mut out, parent_from_child);
}

/// A transform of a `tf2_msgs/msg/TFMessage`.
pub(crate) struct Transform<'a> {
    pub stamp: Nanos,
    pub parent: &'a str,
    pub child: &'a str,
    pub parent_from_child: Isometry3<f64>,
}

/// Reads a `tf2_msgs/msg/TFMessage`.
pub(crate) fn decode_transforms(payload: &[u8]) -> Result<Vec<Transform<'_>>, CdrError> {
    let mut input = CdrReader::new(payload)?;
    let mut transforms = Vec::new();
    for _ in 0..input.length(70)? {
        let (stamp, parent) = input.header()?;
        let child = input.string()?;
        let parent_from_child = isometry(&input.f64s()?).map_err(|reason| format!("frame `{child}`: {reason}"))?;
        transforms.push(Transform {
            stamp,
            parent,
            child,
            parent_from_child,
        });
    }
    Ok(transforms)
}

/// x y z and the quaternion x y z w.
pub(crate) fn parts(pose: &Isometry3<f64>) -> [f64; 7] {
    let (t, q) = (&pose.translation, &pose.rotation);
    [t.x, t.y, t.z, q.i, q.j, q.k, q.w]
}

/// Quaternions whose length differs more from 1 are none: angles, or numbers that were lost.
const UNIT: f64 = 0.01;

/// The pose of seven numbers. A quaternion that has length 1 to rounding is kept as it is, so that poses survive a log.
///
/// # Errors
/// Numbers that are not finite; a quaternion of another length than 1.
pub fn isometry(numbers: &[f64; 7]) -> Result<Isometry3<f64>, CdrError> {
    let [x, y, z, i, j, k, w] = *numbers;
    let quaternion = Quaternion::new(w, i, j, k);
    let norm = quaternion.norm();
    if !numbers.iter().all(|v| v.is_finite()) || !norm.is_finite() || (norm - 1.0).abs() > UNIT {
        return Err(format!(
            "expected a finite position and a quaternion of length 1, found {numbers:?}"
        ));
    }
    let rotation = match (norm - 1.0).abs() < 1e-12 {
        true => UnitQuaternion::new_unchecked(quaternion),
        false => UnitQuaternion::from_quaternion(quaternion),
    };
    Ok(Isometry3::from_parts(Translation3::new(x, y, z), rotation))
}

fn write_isometry(out: &mut CdrWriter, pose: &Isometry3<f64>) {
    out.f64s(&parts(pose));
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use super::*;

    #[test]
    fn poses_survive_bit_for_bit() {
        let mut covariance = Box::new([0.0; 36]);
        covariance[7] = 0.01;
        let rotation = UnitQuaternion::from_euler_angles(0.01, -0.02, 2.5);
        let pose = Isometry3::from_parts(Translation3::new(1e5 + 0.1, -3.3, 0.7), rotation);
        for covariance in [None, Some(covariance)] {
            let state = AgentState {
                map_from_body: pose,
                covariance,
                velocity: None,
                angular_rate: None,
                status: PoseStatus::Recorded,
            };
            let mut payload = Vec::new();
            encode(&mut payload, 42, "map", &state);
            assert_eq!(decode(&payload, PoseStatus::Recorded).unwrap(), (42, state));
        }
    }

    #[test]
    fn a_covariance_that_cannot_be_right_is_unknown() {
        let with = |place: usize, value: f64| {
            let mut covariance = [0.01; 36];
            covariance[place] = value;
            covariance_fault(&covariance)
        };
        assert_eq!([with(0, 0.0), with(1, -0.5), with(35, 1e9)], [None, None, None]);
        for (place, value, words) in [
            (0, f64::NAN, "a variance of NaN"),
            (7, -1.0, "a variance of -1"),
            (35, f64::MAX, "a variance of 1.7976931348623157e308"),
            (1, f64::INFINITY, "a covariance of inf"),
        ] {
            assert_eq!(with(place, value).as_deref(), Some(words));
        }
    }

    #[test]
    fn refuses_what_is_no_pose_and_normalises_what_is_rounded() {
        assert!(isometry(&[f64::NAN, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]).is_err());
        assert!(isometry(&[0.0; 7]).unwrap_err().contains("quaternion"));
        // Angles in the place of a quaternion.
        assert!(isometry(&[0.0, 0.0, 0.0, 0.0, 0.0, 0.3, 0.0]).is_err());
        assert!(isometry(&[0.0, 0.0, 0.0, 0.0, 0.0, 2.0, 2.0]).is_err());
        let pose = isometry(&[0.0, 0.0, 0.0, 0.0, 0.0, 0.71, 0.71]).unwrap();
        assert!((pose.rotation * Vector3::x() - Vector3::y()).norm() < 1e-12);
    }
}
