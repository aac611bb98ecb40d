//! KITTI: one vehicle, boxes in the camera, poses and times in files of their own.

use std::fs;
use std::path::Path;

use nalgebra::{Matrix4, Point3};
use realo_schemas::geometry::yaw_of;

use crate::layouts::{rows, write};
use crate::reading::{import, read};
use crate::world::{CARS, ON_A_CAR, matrix};

/// Camera axes from those of the LiDAR, and how far aside the camera is.
fn camera_from_lidar() -> Matrix4<f64> {
    let axes = [[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]];
    let aside = [0.05, -0.08, -0.27];
    Matrix4::from_fn(|row, column| match (row, column) {
        (3, 3) => 1.0,
        (3, _) => 0.0,
        (row, 3) => aside[row],
        (row, column) => axes[row][column],
    })
}

/// Where the LiDAR is: it drives along a curve.
fn lidar(frame: u64) -> Matrix4<f64> {
    let t = frame as f64;
    matrix([0.8 * t, 0.05 * t * t, 1.73, 0.0, 3.0 * t, 0.0])
}

fn twelve(matrix: &Matrix4<f64>) -> String {
    let words: Vec<String> = matrix.transpose().as_slice()[..12].iter().map(f64::to_string).collect();
    words.join(" ")
}

fn make(dir: &Path, frames: u64) {
    let camera = camera_from_lidar();
    let (mut poses, mut times) = (String::new(), String::new());
    for frame in 0..frames {
        let name = format!("{frame:06}");
        let lidar_from_world = lidar(frame).try_inverse().unwrap();
        let mut points = Vec::new();
        for i in -30..=30 {
            points.extend((-30..=30).map(|k| Point3::new(f64::from(i), f64::from(k), 0.0)));
        }
        points.extend(CARS[0].points(0.0));
        let to_lidar = |point: &Point3<f64>| {
            let point = lidar_from_world.transform_point(point);
            [point.x as f32, point.y as f32, point.z as f32]
        };
        write(
            &dir.join("velodyne").join(format!("{name}.bin")),
            &rows(&points.iter().map(to_lidar).collect::<Vec<_>>()),
        );
        let calibration = format!(
            "P0: 1 0 0 0 0 1 0 0 0 0 1 0\nP2: 721 0 609 44.8 0 721 172 0.2 0 0 1 0.003\nR0_rect: 1 0 0 0 1 0 0 0 1\n\
             Tr_velo_to_cam: {}\n\n",
            twelve(&camera)
        );
        write(&dir.join("calib").join(format!("{name}.txt")), calibration.as_bytes());
        let car = camera * lidar_from_world * CARS[0].pose();
        let [length, width, height] = CARS[0].size;
        let ahead = car.transform_vector(&nalgebra::Vector3::x());
        let ry = (-ahead.z).atan2(ahead.x);
        let middle = car.transform_point(&Point3::origin());
        let label = format!(
            "Car 0.00 0 1.5 1 2 3 4 {height} {width} {length} {} {} {} {ry}\nDontCare -1 -1 -10 1 2 3 4 -1 -1 -1 -1000 -1000 -1000 -10\n",
            middle.x,
            middle.y + height / 2.0,
            middle.z
        );
        write(&dir.join("label_2").join(format!("{name}.txt")), label.as_bytes());
        let first = camera * lidar(0).try_inverse().unwrap();
        poses += &format!("{}\n", twelve(&(first * lidar(frame) * camera.try_inverse().unwrap())));
        times += &format!("{:.6e}\n", 0.1038 * frame as f64);
    }
    write(&dir.join("poses.txt"), poses.as_bytes());
    write(&dir.join("times.txt"), times.as_bytes());
}

#[test]
fn poses_points_boxes_and_times_come_back() {
    let dir = tempfile::tempdir().unwrap();
    let (data, out) = (dir.path().join("drive 5"), dir.path().join("out.mcap"));
    make(&data, 4);
    let summary = &import("kitti", &data, &out, &[]).unwrap()[0];
    assert_eq!((summary.frames, summary.dropped_labels), (4, 4), "{summary}");
    let said = summary.to_string();
    assert!(
        said.contains("assumed: stamps: times of the data set count from 1 January 2020")
            && said.contains("poses.txt has poses of the left camera"),
        "{said}"
    );
    assert!(
        !said.contains("numbers rise") && !said.contains("without poses.txt"),
        "{said}"
    );
    let (log, found) = read(&out);
    assert_eq!(log.info().agents[0].name, "cav_1");
    for (frame, ((_, stamp), read)) in found.iter().enumerate() {
        let start = *found.keys().next().map(|(_, stamp)| stamp).unwrap();
        assert!((stamp - start - 103_800_000 * frame as i64).abs() < 1000);
        // The map is the LiDAR's frame of the first pose.
        let expected = lidar(0).try_inverse().unwrap() * lidar(frame as u64);
        let at = read.map_from_body.translation.vector;
        assert!(
            (at.x - expected[(0, 3)]).abs() < 1e-6 && (at.y - expected[(1, 3)]).abs() < 1e-6,
            "{at}"
        );
        let yaw = yaw_of(&read.map_from_body.rotation).to_degrees();
        assert!((yaw - 3.0 * frame as f64).abs() < 1e-6, "{yaw}");
        let [(center, heading, object)] = read.boxes_in_map(&read.truth)[..] else {
            panic!()
        };
        let car = Point3::from(CARS[0].center);
        let off = Point3::from(center) - lidar(0).try_inverse().unwrap().transform_point(&car);
        assert!(
            off.norm() < 1e-6 && (heading - CARS[0].yaw).abs() < 1e-6,
            "{off} {heading}"
        );
        assert_eq!(
            (object.track, &*object.class, object.length),
            (None, "Car", CARS[0].size[0])
        );
        assert_eq!((read.truth_points[..].to_vec(), read.views), (vec![ON_A_CAR], 1));
    }
}

#[test]
fn frames_without_poses_are_each_at_the_origin_and_what_is_damaged_is_named() {
    let dir = tempfile::tempdir().unwrap();
    let (data, out) = (dir.path().join("object"), dir.path().join("out.mcap"));
    make(&data, 3);
    fs::write(data.join("poses.txt"), "1 0 0 0 0 1 0 0 0 0 1 0\n1 2\n").unwrap();
    let error = import("kitti", &data, &out, &[]).unwrap_err();
    assert!(
        error.contains("poses.txt`: line 2: expected 12 numbers, found 2"),
        "{error}"
    );
    fs::write(data.join("poses.txt"), "1 0 0 0 0 1 0 0 0 0 1 0\n".repeat(2)).unwrap();
    let error = import("kitti", &data, &out, &[("skip-incomplete", "")]).unwrap_err();
    assert!(
        error.contains("poses.txt`: expected a line for each of the frames 0 to 2, found 2 lines") && !out.exists(),
        "{error}"
    );
    for name in ["poses.txt", "times.txt"] {
        fs::remove_file(data.join(name)).unwrap();
    }
    let said = import("kitti", &data, &out, &[]).unwrap()[0].to_string();
    assert!(
        said.contains("numbers rise by 1 each 0.1000 s")
            && said.contains("without poses.txt each frame is at the origin"),
        "{said}"
    );
    assert!(!said.contains("first pose"), "{said}");
    let (_, found) = read(&out);
    assert!(
        found
            .values()
            .all(|read| read.map_from_body.translation.vector.xy().norm() < 1e-9)
    );
    fs::write(data.join("label_2/000000.txt"), "Car 0.00 0\n").unwrap();
    fs::write(data.join("calib/000001.txt"), "P2: 1 2 3\n").unwrap();
    fs::remove_file(data.join("velodyne/000002.bin")).unwrap();
    fs::write(data.join("label_2/000002.txt"), "").unwrap();
    let error = import("kitti", &data, &out, &[]).unwrap_err();
    for line in [
        "3 of 3 frames are incomplete",
        "label_2/000000.txt: line 1: expected 15 words, found 3",
        "calib/000001.txt: expected a line `Tr_velo_to_cam:` or `Tr_velo_cam:` or `Tr: …`, found none",
        "1 × no such file\n    velodyne/000002.bin",
    ] {
        assert!(error.contains(line), "{line} is not in\n{error}");
    }
}
