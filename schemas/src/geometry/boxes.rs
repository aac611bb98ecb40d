use std::f64::consts::{PI, TAU};

use nalgebra::{Isometry3, Point3, UnitQuaternion, Vector3};

use crate::Box3;

/// `to_from_from`: brings points of frame `from` to frame `to`, both given in `map`.
pub fn relative(map_from_to: &Isometry3<f64>, map_from_from: &Isometry3<f64>) -> Isometry3<f64> {
    map_from_to.inv_mul(map_from_from)
}

/// Heading of a rotation: the direction of its x axis on the ground plane, rad.
pub fn yaw_of(rotation: &UnitQuaternion<f64>) -> f64 {
    let x = rotation * Vector3::x();
    libm::atan2(x.y, x.x)
}

/// How far a rotation turns the z axis away from itself, degrees.
pub fn tilt_degrees(rotation: &UnitQuaternion<f64>) -> f64 {
    let up = rotation * Vector3::z();
    libm::atan2(libm::hypot(up.x, up.y), up.z).to_degrees()
}

/// Level from body, where the body's rotation in a map with z up is known: z turned up, x in its heading.
pub fn level_from_body(map_from_body: &UnitQuaternion<f64>) -> UnitQuaternion<f64> {
    let heading = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), yaw_of(map_from_body));
    heading.inverse() * map_from_body
}

/// The same heading in (-π, π].
pub fn normalize_yaw(yaw: f64) -> f64 {
    let wrapped = yaw - TAU * (yaw / TAU).round();
    if wrapped <= -PI { wrapped + TAU } else { wrapped }
}

/// Brings boxes to another frame, each as [`transform_box`] does.
pub fn transform_boxes(to_from_from: &Isometry3<f64>, boxes: &mut [Box3]) {
    for object in boxes {
        *object = transform_box(to_from_from, object);
    }
}

/// A box brought to another frame. Boxes stay gravity-aligned: tilt moves the centre and turns the heading only.
pub fn transform_box(to_from_from: &Isometry3<f64>, object: &Box3) -> Box3 {
    let center = to_from_from * Point3::from(object.center);
    let (sin, cos) = libm::sincos(object.yaw);
    let heading = to_from_from.rotation * Vector3::new(cos, sin, 0.0);
    Box3 {
        center: center.into(),
        yaw: libm::atan2(heading.y, heading.x),
        velocity: object
            .velocity
            .map(|v| (to_from_from.rotation * Vector3::from(v)).into()),
        covariance: object
            .covariance
            .map(|c| rotate_covariance(&c, yaw_of(&to_from_from.rotation))),
        ..object.clone()
    }
}

fn rotate_covariance(covariance: &[f64; 9], yaw: f64) -> [f64; 9] {
    let rotation = nalgebra::Rotation3::from_axis_angle(&Vector3::z_axis(), yaw);
    let c = nalgebra::Matrix3::from_row_slice(covariance);
    let turned = rotation.matrix() * c * rotation.matrix().transpose();
    std::array::from_fn(|i| turned[(i / 3, i % 3)])
}

/// (x, y) of the four bottom corners: front-left, front-right, rear-right, rear-left.
pub fn bottom_corners(object: &Box3) -> [[f64; 2]; 4] {
    let (sin, cos) = libm::sincos(object.yaw);
    let (l, w) = (object.length / 2.0, object.width / 2.0);
    [(l, w), (l, -w), (-l, -w), (-l, w)].map(|(x, y)| {
        [
            object.center[0] + x * cos - y * sin,
            object.center[1] + x * sin + y * cos,
        ]
    })
}

/// Whether (x, y) lies on the box's footprint, edges included.
pub fn footprint_contains(object: &Box3, [x, y]: [f64; 2]) -> bool {
    let (sin, cos) = libm::sincos(object.yaw);
    let (dx, dy) = (x - object.center[0], y - object.center[1]);
    (dx * cos + dy * sin).abs() <= object.length / 2.0 && (dy * cos - dx * sin).abs() <= object.width / 2.0
}

/// Whether every number is finite, every extent positive and the score in [0, 1].
pub fn is_valid(object: &Box3) -> bool {
    let extents = [object.length, object.width, object.height];
    object
        .center
        .iter()
        .chain(&extents)
        .chain([&object.yaw])
        .all(|v| v.is_finite())
        && extents.iter().all(|v| *v > 0.0)
        && (0.0..=1.0).contains(&object.score)
}
