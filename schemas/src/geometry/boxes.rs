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

/// Beyond this distance from the agent whose frame it is in, a box is a mistake of its producer, m.
pub const FARTHEST_M: f64 = 10_000.0;
/// Above this length, width or height a box is a mistake of its producer, m.
pub const LARGEST_M: f64 = 100.0;

/// What a plausible box is, in words for messages.
pub const PLAUSIBLE_BOX: &str = crate::plausible_box!();

/// What a plausible box is, and what to do, as a literal: the text of a counter has to be one.
#[macro_export]
macro_rules! plausible_box {
    () => {
        "expected are finite numbers in the frame of the agent, sizes of 0 to 100 m, distances up to 10 km and scores of 0 to 1"
    };
    ($fix:literal) => {
        concat!($crate::plausible_box!(), ": ", $fix)
    };
}

/// As [`plausible_box`](crate::plausible_box), of a detection, whose velocity and covariance count as well.
#[macro_export]
macro_rules! plausible_detection {
    ($fix:literal) => {
        concat!(
            $crate::plausible_box!(),
            "; velocities and covariances are finite too, and speeds up to 1,000 m/s: ",
            $fix
        )
    };
}

/// Whether every number is finite, every extent above 0 and at most [`LARGEST_M`], and the score in [0, 1].
pub fn is_valid(object: &Box3) -> bool {
    let extents = [object.length, object.width, object.height];
    object.center.iter().chain([&object.yaw]).all(|v| v.is_finite())
        && extents.iter().all(|v| *v > 0.0 && *v <= LARGEST_M)
        && (0.0..=1.0).contains(&object.score)
}

/// Whether a box in an agent's frame can be an object that somebody saw: it [`is_valid`], at most [`FARTHEST_M`] away.
pub fn is_plausible(object: &Box3) -> bool {
    is_valid(object) && Vector3::from(object.center).norm() <= FARTHEST_M
}

/// Max speed of an object, m/s.
const MAX_SPEED_MPS: f64 = 1000.0;

/// Why a box in an agent's frame cannot be one that somebody detected, in words; `None` where it [`is_plausible`] and moves by
/// finite numbers, no faster than 1,000 m/s.
pub fn detection_fault(object: &Box3) -> Option<String> {
    let velocity = object.velocity.iter().flatten();
    let mut motion = velocity.chain(object.covariance.iter().flatten());
    let is_finite = motion.all(|number| number.is_finite());
    // Without squares, which overflow.
    let velocity = object.velocity.iter().flatten();
    let speed = velocity.fold(0.0, |speed: f64, along| speed.hypot(*along));
    box_fault(object)
        .or_else(|| (!is_finite).then(|| "a velocity or covariance that is not finite".into()))
        .or_else(|| (speed > MAX_SPEED_MPS).then(|| format!("a velocity of {speed:e} m/s")))
}

/// Why a box in an agent's frame is not plausible, in words; `None` where it [`is_plausible`].
pub fn box_fault(object: &Box3) -> Option<String> {
    if is_plausible(object) {
        return None;
    }
    let extents = [object.length, object.width, object.height];
    let all = object.center.iter().chain(&extents).chain([&object.yaw]);
    let [l, w, h] = extents;
    Some(if !all.copied().all(f64::is_finite) {
        "a number that is not finite".into()
    } else if extents.iter().any(|v| *v <= 0.0) {
        format!("a size of {l:.3} × {w:.3} × {h:.3} m")
    } else if extents.iter().any(|v| *v > LARGEST_M) {
        format!("a size of {l:.3e} × {w:.3e} × {h:.3e} m")
    } else if (0.0..=1.0).contains(&object.score) {
        format!("a distance of {:.3e} m", Vector3::from(object.center).norm())
    } else {
        format!("a score of {}", object.score)
    })
}
