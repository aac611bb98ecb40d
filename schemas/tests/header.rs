//! What a header says of itself.

use nalgebra::{Isometry3, UnitQuaternion, Vector3};
use realo_schemas::*;

#[test]
fn a_clock_leads_from_the_wall_to_the_log_and_back() {
    let clock = Clock {
        wall_origin: 1_000,
        log_origin: 50,
        rate: 0.5,
    };
    assert_eq!(clock.log_at(1_000), 50);
    assert_eq!(clock.log_at(1_200), 150);
    assert_eq!(clock.wall_at(150), 1_200);
    assert_eq!(clock.wall_at(40), 980);
}

#[test]
fn kinds_have_names_and_payloads() {
    for kind in Kind::ALL {
        assert_eq!(kind.as_str().parse(), Ok(kind));
        assert_eq!(kind.to_string(), kind.as_str());
    }
    assert_eq!("cars".parse::<Kind>(), Err("unknown message kind `cars`".into()));
    let carried = [
        (PayloadType::PointCloud, Some(Kind::Points)),
        (PayloadType::FeatureMap, Some(Kind::Features)),
        (PayloadType::Boxes, Some(Kind::Boxes)),
        (PayloadType::AgentState, Some(Kind::AgentState)),
        (PayloadType::GroundTruth, None),
        (PayloadType::Packet, None),
        (PayloadType::Motion, None),
    ];
    for (payload, kind) in carried {
        assert_eq!(Kind::of(payload), kind);
    }
}

#[test]
fn a_pose_is_finite_and_keeps_the_bits_of_a_unit_quaternion() {
    let rotation = UnitQuaternion::from_euler_angles(0.1, 0.2, 0.3);
    let pose = Pose::exact(Isometry3::from_parts(Vector3::new(1.0, 2.0, 3.0).into(), rotation));
    let (translation, quaternion) = pose.to_parts();
    assert_eq!(Pose::from_parts(translation, quaternion).as_ref(), Some(&pose));
    // Another length is made one.
    let doubled = Pose::from_parts(translation, quaternion.map(|v| 2.0 * v)).unwrap();
    assert!(doubled.map_from_frame.rotation.angle_to(&rotation) < 1e-12);
    assert!((doubled.map_from_frame.rotation.norm() - 1.0).abs() < 1e-15);
    let slightly = Pose::from_parts(translation, quaternion.map(|v| 1.00001 * v)).unwrap();
    assert!((slightly.map_from_frame.rotation.norm() - 1.0).abs() < 1e-15);
    for bad in [
        [0.0; 4],
        [f64::NAN, 0.0, 0.0, 1.0],
        [f64::INFINITY; 4],
        [0.0, 0.0, 0.0, 1e-9],
    ] {
        assert_eq!(Pose::from_parts(translation, bad), None, "{bad:?}");
    }
    assert!(Pose::from_parts(translation, [0.0, 0.0, 0.0, 1.1e-9]).is_some());
    assert_eq!(Pose::from_parts([0.0, f64::NAN, 0.0], quaternion), None);
}

#[test]
fn a_header_says_who_measured_what_and_when() {
    let header = Header::origin(&"run".into(), &"cav1".into(), Kind::Boxes, 7, 1_000, 2_000);
    assert_eq!(header.to_string(), "boxes of cav1, seq 7, stamp 1000 ns");
    assert_eq!((header.age(1_300), &*header.frame), (300, "cav1/body"));
}
