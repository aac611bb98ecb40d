//! Boxes as `autoware_perception_msgs/msg/DetectedObjects`.

use nalgebra::UnitQuaternion;
use realo_schemas::{Box3, Nanos};

use crate::cdr::CdrWriter;

/// The label of `ObjectClassification` for what has no other one.
pub const UNKNOWN: u8 = 0;
/// Its other labels, with names of classes in lower case.
const LABELS: &[(u8, &[&str])] = &[
    (1, &["vehicle", "car", "van", "policecar", "longvehicle"]),
    (2, &["truck", "concretetruck", "trashcan"]),
    (3, &["bus"]),
    (4, &["trailer"]),
    // The spelling is that of V2X-Real.
    (5, &["motorcycle", "motorcyclist", "motorcylerider"]),
    (6, &["bicycle", "cyclist", "bicyclerider", "scooter", "scooterrider"]),
    (7, &["pedestrian", "person", "child", "roadworker"]),
];
/// `DetectedObjectKinematics::AVAILABLE`: the whole orientation is known.
const ORIENTED: u8 = 2;
/// `Shape::BOUNDING_BOX`.
const BOUNDING_BOX: u8 = 0;

/// The label of a class; unknown ones have a label too.
pub fn label(class: &str) -> u8 {
    let class = class.to_ascii_lowercase();
    let known = LABELS.iter().find(|(_, names)| names.contains(&&*class));
    known.map_or(UNKNOWN, |(label, _)| *label)
}

/// Appends boxes as CDR.
pub fn encode(buffer: &mut Vec<u8>, stamp: Nanos, frame: &str, boxes: &[Box3]) {
    let mut out = CdrWriter::new(buffer);
    out.header(stamp, frame);
    out.length(boxes.len());
    for object in boxes {
        write(&mut out, object);
    }
}

fn write(out: &mut CdrWriter, object: &Box3) {
    out.f32(object.score);
    out.length(1);
    out.u8(label(&object.class));
    out.f32(1.0);
    let turn = UnitQuaternion::from_euler_angles(0.0, 0.0, object.yaw);
    out.f64s(&object.center);
    out.f64s(&[turn.i, turn.j, turn.k, turn.w]);
    out.f64s(&pose_covariance(object.covariance.as_ref()));
    out.bool(object.covariance.is_some());
    out.u8(ORIENTED);
    // Twists are relative to the object.
    let velocity = object
        .velocity
        .map(|velocity| turn.inverse() * nalgebra::Vector3::from(velocity));
    out.f64s(velocity.unwrap_or_default().as_slice());
    out.f64s(&[0.0; 3]);
    out.f64s(&[0.0; 36]);
    out.bool(object.velocity.is_some());
    out.bool(false);
    out.u8(BOUNDING_BOX);
    out.length(0);
    out.f64s(&[object.length, object.width, object.height]);
}

/// Over x, y, z and rotations about them, from x, y and yaw.
fn pose_covariance(covariance: Option<&[f64; 9]>) -> [f64; 36] {
    const PLACES: [usize; 3] = [0, 1, 5];
    let mut all = [0.0; 36];
    for (at, value) in covariance.into_iter().flatten().enumerate() {
        all[6 * PLACES[at / 3] + PLACES[at % 3]] = *value;
    }
    all
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cdr::CdrReader;

    #[test]
    fn an_object_has_its_pose_speed_and_size() {
        let mut object = Box3::new("Truck", [10.0, -2.0, 1.5], [8.0, 2.5, 3.0], std::f64::consts::FRAC_PI_2);
        object.score = 0.75;
        object.velocity = Some([0.0, 5.0, 0.0]);
        object.covariance = Some([1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0]);
        let mut payload = Vec::new();
        encode(&mut payload, 7_000_000_001, "map", &[object]);
        let mut input = CdrReader::new(&payload).unwrap();
        assert_eq!(input.header().unwrap(), (7_000_000_001, "map"));
        assert_eq!((input.u32().unwrap(), input.f32().unwrap()), (1, 0.75));
        assert_eq!(
            (input.u32().unwrap(), input.u8().unwrap(), input.f32().unwrap()),
            (1, 2, 1.0)
        );
        assert_eq!(input.f64s().unwrap(), [10.0, -2.0, 1.5]);
        let [i, j, k, w] = input.f64s().unwrap();
        assert!(i == 0.0 && j == 0.0 && (k - w).abs() < 1e-12);
        let covariance: [f64; 36] = input.f64s().unwrap();
        assert_eq!(
            [0, 1, 5, 6, 7, 11, 30, 31, 35].map(|at: usize| covariance[at]),
            [1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0]
        );
        assert_eq!((input.bool().unwrap(), input.u8().unwrap()), (true, ORIENTED));
        let speed: [f64; 3] = input.f64s().unwrap();
        assert!((speed[0] - 5.0).abs() < 1e-12 && speed[1].abs() < 1e-12);
        input.f64s::<39>().unwrap();
        assert_eq!((input.bool().unwrap(), input.bool().unwrap()), (true, false));
        assert_eq!((input.u8().unwrap(), input.u32().unwrap()), (BOUNDING_BOX, 0));
        assert_eq!((input.f64s().unwrap(), input.rest()), ([8.0, 2.5, 3.0], 0));
    }

    #[test]
    fn classes_have_the_labels_of_autoware() {
        let labels = ["vehicle", "Car", "TRUCK", "bus", "pedestrian", "unicorn"].map(label);
        assert_eq!(labels, [1, 1, 2, 3, 7, UNKNOWN]);
        let riders = ["BicycleRider", "ScooterRider", "MotorcyleRider", "Child"].map(label);
        assert_eq!(riders, [6, 6, 5, 7]);
    }
}
