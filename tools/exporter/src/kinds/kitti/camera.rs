//! The camera of KITTI's labels: it is at the LiDAR, with x to the right, y down and z ahead.

use nalgebra::{Isometry3, Matrix3, Point3, Rotation3, Translation3, UnitQuaternion};
use realo_schemas::Box3;
use realo_schemas::geometry::{normalize_yaw, transform_box};

use crate::places::number;

/// Focal length and principal point of KITTI's left colour camera, pixels.
const FOCAL: f64 = 721.5377;
const CENTER: [f64; 2] = [609.5593, 172.854];
/// Width and height of its image, pixels.
const IMAGE: [f64; 2] = [1242.0, 375.0];
/// Corners nearer than this are behind the camera, m.
const NEAREST: f64 = 0.1;

/// A file of `calib`, the same for all frames.
pub const CALIBRATION: &str = "P0: 721.5377 0 609.5593 0 0 721.5377 172.854 0 0 0 1 0
P1: 721.5377 0 609.5593 0 0 721.5377 172.854 0 0 0 1 0
P2: 721.5377 0 609.5593 0 0 721.5377 172.854 0 0 0 1 0
P3: 721.5377 0 609.5593 0 0 721.5377 172.854 0 0 0 1 0
R0_rect: 1 0 0 0 1 0 0 0 1
Tr_velo_to_cam: 0 -1 0 0 0 0 -1 0 1 0 0 0
Tr_imu_to_velo: 1 0 0 0 0 1 0 0 0 0 1 0
";

/// The camera's axes.
pub fn camera_from_lidar() -> Isometry3<f64> {
    let axes = Matrix3::new(
        0.0, -1.0, 0.0, //
        0.0, 0.0, -1.0, //
        1.0, 0.0, 0.0,
    );
    let axes = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(axes));
    Isometry3::from_parts(Translation3::identity(), axes)
}

/// The line of a box in the body frame, and whether the box is in the image.
pub fn label(object: &Box3, lidar_from_body: &Isometry3<f64>) -> (String, bool) {
    let in_lidar = transform_box(lidar_from_body, object);
    let ry = normalize_yaw(-object.yaw - std::f64::consts::FRAC_PI_2);
    let [ahead, left, up] = in_lidar.center;
    // The middle of the bottom.
    let place = [-left, object.height / 2.0 - up, ahead];
    let alpha = normalize_yaw(ry - libm::atan2(place[0], place[2]));
    let rectangle = rectangle(&in_lidar);
    let (truncated, sides) = rectangle.unwrap_or((1.0, [0.0; 4]));
    let class: String = object
        .class
        .chars()
        .map(|c| if c.is_whitespace() { '_' } else { c })
        .collect();
    let [left, top, right, bottom] = sides;
    // 3: nobody said how far it is occluded.
    let image = format!("{truncated:.2} 3 {alpha:.4} {left:.2} {top:.2} {right:.2} {bottom:.2}");
    let words: Vec<String> = [object.height, object.width, object.length]
        .into_iter()
        .chain(place)
        .chain([ry])
        .map(number)
        .collect();
    (format!("{class} {image} {}\n", words.join(" ")), rectangle.is_some())
}

/// How much of a box's rectangle is beside the image, and the part in it: left, top, right, bottom.
fn rectangle(in_lidar: &Box3) -> Option<(f64, [f64; 4])> {
    let (mut min, mut max) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
    for corner in corners(in_lidar) {
        let ahead = corner.x.max(NEAREST);
        for (axis, aside) in [-corner.y, -corner.z].into_iter().enumerate() {
            let at = CENTER[axis] + FOCAL * aside / ahead;
            min[axis] = min[axis].min(at);
            max[axis] = max[axis].max(at);
        }
    }
    let is_ahead = corners(in_lidar).any(|corner| corner.x > NEAREST);
    let inside: [[f64; 2]; 2] = std::array::from_fn(|axis| [min[axis].max(0.0), max[axis].min(IMAGE[axis] - 1.0)]);
    if !is_ahead || inside.iter().any(|[from, to]| from >= to) {
        return None;
    }
    let area = |[[x0, x1], [y0, y1]]: [[f64; 2]; 2]| (x1 - x0) * (y1 - y0);
    let whole = area([[min[0], max[0]], [min[1], max[1]]]);
    let beside = (1.0 - area(inside) / whole).clamp(0.0, 1.0);
    let [[left, right], [top, bottom]] = inside;
    Some((beside, [left, top, right, bottom]))
}

fn corners(object: &Box3) -> impl Iterator<Item = Point3<f64>> {
    let (sin, cos) = libm::sincos(object.yaw);
    let half = [object.length, object.width, object.height].map(|edge| edge / 2.0);
    let center = object.center;
    (0..8).map(move |corner| {
        let side = |bit: u32| {
            if corner >> bit & 1 == 0 {
                -half[bit as usize]
            } else {
                half[bit as usize]
            }
        };
        let (along, across) = (side(0), side(1));
        let x = center[0] + along * cos - across * sin;
        let y = center[1] + along * sin + across * cos;
        Point3::new(x, y, center[2] + side(2))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_box_ahead_is_in_the_image_and_one_behind_is_not() {
        let raised = Translation3::new(0.0, 0.0, -1.8).into();
        let (line, is_shown) = label(&Box3::new("Car", [20.0, 2.0, 0.75], [4.0, 2.0, 1.5], 0.0), &raised);
        assert!(is_shown);
        let words: Vec<&str> = line.split_whitespace().collect();
        assert_eq!(words.len(), 15);
        assert_eq!(words[8..14], ["1.5", "2.0", "4.0", "-2.0", "1.8", "20.0"]);
        let number = |index: usize| words[index].parse::<f64>().unwrap();
        assert!((number(14) + std::f64::consts::FRAC_PI_2).abs() < 1e-12, "{line}");
        // The near end is 18 m ahead, and 1 to 3 m to the left.
        assert!((number(4) - (609.5593 - 721.5377 * 3.0 / 18.0)).abs() < 0.01, "{line}");
        assert!((number(7) - (172.854 + 721.5377 * 1.8 / 18.0)).abs() < 0.01, "{line}");
        let (line, is_shown) = label(
            &Box3::new("police car", [-20.0, 2.0, 0.75], [4.0, 2.0, 1.5], 3.0),
            &raised,
        );
        assert!(!is_shown && line.starts_with("police_car 1.00 3 "), "{line}");
        assert!(line.contains(" 0.00 0.00 0.00 0.00 1.5 2.0 4.0 "), "{line}");
    }

    #[test]
    fn the_axes_are_those_of_the_calibration() {
        let words = CALIBRATION
            .lines()
            .find_map(|line| line.strip_prefix("Tr_velo_to_cam: "))
            .unwrap();
        let rows: Vec<f64> = words.split(' ').map(|word| word.parse().unwrap()).collect();
        let found = camera_from_lidar().to_homogeneous().transpose();
        let apart = found.as_slice().iter().zip(&rows).map(|(a, b)| (a - b).abs());
        assert!(apart.fold(0.0, f64::max) < 1e-15);
    }
}
