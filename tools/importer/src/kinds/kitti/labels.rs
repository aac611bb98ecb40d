//! Labels of KITTI's object benchmark: in the rectified camera, the place on the ground.

use std::path::Path;

use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};

use crate::ImportError;
use crate::files::read_text;
use crate::scenes::Label;

/// Words of a line; a detection has its score behind them.
const WORDS: usize = 15;

/// Labels in the map, and how many lines are of no object or without a size.
///
/// # Errors
/// A line that is no label.
pub fn labels(path: &Path, map_from_camera: &Isometry3<f64>) -> Result<(Vec<Label>, usize), ImportError> {
    let text = match read_text(path) {
        // A frame without objects has a file without lines.
        Err(ImportError::Io { reason, .. }) if reason.kind() == std::io::ErrorKind::UnexpectedEof => String::new(),
        read => read?,
    };
    let (mut labels, mut dropped) = (Vec::new(), 0);
    for (index, line) in text.lines().enumerate().filter(|(_, line)| !line.trim().is_empty()) {
        let label = label(index, line, map_from_camera);
        match label.map_err(|reason| ImportError::content(path, format!("line {}: {reason}", index + 1)))? {
            Some(label) => labels.push(label),
            None => dropped += 1,
        }
    }
    Ok((labels, dropped))
}

fn label(index: usize, line: &str, map_from_camera: &Isometry3<f64>) -> Result<Option<Label>, String> {
    let words: Vec<&str> = line.split_whitespace().collect();
    let [class, _, _, _, _, _, _, _, numbers @ ..] = &words[..] else {
        return Err(format!("expected {WORDS} words, found {}", words.len()));
    };
    if *class == "DontCare" {
        return Ok(None);
    }
    let number = |word: &&str| {
        let number = word.parse().ok().filter(|number: &f64| number.is_finite());
        number.ok_or_else(|| format!("expected finite numbers, found `{}`", crate::shown(word)))
    };
    let numbers = numbers.iter().map(number).collect::<Result<Vec<f64>, _>>()?;
    let [height, width, length, x, y, z, yaw, ..] = numbers[..] else {
        return Err(format!("expected {WORDS} words, found {}", words.len()));
    };
    if [height, width, length].contains(&0.0) {
        return Ok(None);
    }
    let yaw = realo_documents::in_radians(yaw).map_err(|reason| format!("rotation_y: {reason}"))?;
    // In the camera y is down, and the heading is about it, 0 to the right; boxes here head along x with z up.
    let up = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), std::f64::consts::FRAC_PI_2);
    let turn = UnitQuaternion::from_axis_angle(&Vector3::y_axis(), yaw);
    let middle = Translation3::new(x, y - height / 2.0, z);
    let camera_from_object = Isometry3::from_parts(middle, turn * up);
    Ok(Some(Label {
        // The benchmark has no identities: a label is an object of its frame alone.
        id: format!("line {index}"),
        track: None,
        class: (*class).into(),
        map_from_object: map_from_camera * camera_from_object,
        size: [length, width, height],
        speed: None,
        points: None,
    }))
}

#[cfg(test)]
mod tests {
    use realo_schemas::geometry::yaw_of;

    use super::*;

    #[test]
    fn boxes_of_a_camera_head_where_they_should() {
        // Camera axes: x right, y down, z ahead; a LiDAR has x ahead, y left, z up.
        let lidar_from_camera = UnitQuaternion::from_matrix(&nalgebra::Matrix3::new(
            0.0, 0.0, 1.0, //
            -1.0, 0.0, 0.0, //
            0.0, -1.0, 0.0,
        ));
        let lidar_from_camera = Isometry3::from_parts(Translation3::identity(), lidar_from_camera);
        for (ry, yaw) in [(0.0, -90.0), (-90.0, 0.0), (30.0, -120.0), (90.0, -180.0)] {
            let line = format!("Car 0 0 0 0 0 0 0 1.5 1.6 3.9 2.0 1.7 20.0 {}", f64::to_radians(ry));
            let label = label(3, &line, &lidar_from_camera).unwrap().unwrap();
            let found = yaw_of(&label.map_from_object.rotation).to_degrees();
            let off = (found - yaw + 540.0).rem_euclid(360.0) - 180.0;
            assert!(off.abs() < 1e-9, "{ry}: {found}");
            let at = label.map_from_object.translation.vector;
            assert!((at - Vector3::new(20.0, -2.0, -0.95)).norm() < 1e-9, "{at}");
            let up = label.map_from_object.rotation * Vector3::z();
            assert!((up - Vector3::z()).norm() < 1e-9, "{up}");
            assert_eq!(label.size, [3.9, 1.6, 1.5]);
        }
        assert!(
            label(
                0,
                "DontCare -1 -1 -10 1 2 3 4 -1 -1 -1 -1000 -1000 -1000 -10",
                &lidar_from_camera
            )
            .unwrap()
            .is_none()
        );
        let degrees = "Car 0 0 0 0 0 0 0 1.5 1.6 3.9 2.0 1.7 20.0 -90";
        assert_eq!(
            label(0, degrees, &lidar_from_camera).unwrap_err(),
            "rotation_y: expected radians within ±4π, found -90, which looks like degrees: -90° are -1.5708 rad"
        );
        assert!(
            label(0, "Car 0 0", &lidar_from_camera)
                .unwrap_err()
                .contains("expected 15 words, found 3")
        );
    }
}
