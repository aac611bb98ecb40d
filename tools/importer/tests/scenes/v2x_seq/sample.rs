//! Pairs of DAIR-V2X-C that were recorded, listed as a sequence, and with their cooperative labels in the frame of the vehicle's
//! LiDAR: calibrations, clouds and labels are real.

use std::fs;
use std::path::Path;

use nalgebra::{Isometry3, Matrix3, Point3, Translation3, UnitQuaternion, Vector3};
use serde_json::{Value, json};

use super::{LISTS, read};
use crate::layouts::write;
use crate::reading::import;

/// Six consecutive sweeps.
const FRAMES: std::ops::RangeInclusive<u64> = 15_400..=15_405;

fn json_of(path: &Path) -> Value {
    serde_json::from_slice(&fs::read(path).unwrap_or_else(|error| panic!("{}: {error}", path.display()))).unwrap()
}

fn pose(value: &Value) -> Isometry3<f64> {
    let turn = Matrix3::from_fn(|row, column| value["rotation"][row][column].as_f64().unwrap());
    let place = Vector3::from_fn(|row, _| value["translation"][row][0].as_f64().unwrap());
    Isometry3::from_parts(Translation3::from(place), UnitQuaternion::from_matrix(&turn))
}

fn stem(value: &Value) -> String {
    let path = Path::new(value.as_str().unwrap());
    path.file_stem().unwrap().to_string_lossy().into_owned()
}

/// Where the labels of a file are in the world.
fn places(labels: &Value) -> Vec<Point3<f64>> {
    let place = |label: &Value| {
        let corners = label["world_8_points"].as_array().unwrap().iter();
        let sum: Vector3<f64> = corners
            .map(|corner| Vector3::from_fn(|axis, _| corner[axis].as_f64().unwrap()))
            .sum();
        Point3::from(sum / 8.0)
    };
    labels.as_array().unwrap().iter().map(place).collect()
}

/// Labels of the world in the frame of a LiDAR, each a track.
fn in_lidar(labels: &Value, lidar_from_world: &Isometry3<f64>) -> Value {
    let mut moved = labels.as_array().unwrap().clone();
    for ((index, label), place) in moved.iter_mut().enumerate().zip(places(labels)) {
        let corner = |corner: usize| {
            let numbers = &label["world_8_points"][corner];
            lidar_from_world * Point3::from([0, 1, 2].map(|axis| numbers[axis].as_f64().unwrap()))
        };
        let ahead = corner(0) - corner(3);
        let at = lidar_from_world * place;
        label["rotation"] = ahead.y.atan2(ahead.x).into();
        label["3d_location"] = json!({"x": at.x, "y": at.y, "z": at.z});
        label["track_id"] = format!("{:06}", index + 1).into();
        drop(label.as_object_mut().unwrap().remove("world_8_points"));
    }
    json!(moved)
}

/// Copies the files of a sweep, whose labels become tracks.
fn copy(from: &Path, to: &Path, entry: &Value) {
    for (key, file) in entry
        .as_object()
        .unwrap()
        .iter()
        .filter(|(key, _)| key.ends_with("_path"))
    {
        if !key.starts_with("image") && !key.starts_with("label_camera") {
            let file = file.as_str().unwrap();
            write(&to.join(file), &fs::read(from.join(file)).unwrap());
        }
    }
    let labels = to.join(entry["label_lidar_std_path"].as_str().unwrap());
    let mut list = json_of(&labels);
    for (index, label) in list.as_array_mut().unwrap().iter_mut().enumerate() {
        label["track_id"] = format!("{:06}", index + 1).into();
    }
    write(&labels, list.to_string().as_bytes());
}

/// Lists the pairs as a sequence below `data`; the places of their cooperative labels in the world, by frames.
fn make(sample: &Path, data: &Path) -> Vec<(String, Vec<Point3<f64>>)> {
    let [pairs, vehicles, roadsides] = LISTS.map(|list| json_of(&sample.join(list)));
    let (mut lists, mut expected) = ([vec![], vec![], vec![]], Vec::new());
    for pair in pairs.as_array().unwrap() {
        let names = ["vehicle_pointcloud_path", "infrastructure_pointcloud_path"].map(|key| stem(&pair[key]));
        if !FRAMES.contains(&names[0].parse().unwrap()) {
            continue;
        }
        for (side, (folder, entries)) in [("vehicle-side", &vehicles), ("infrastructure-side", &roadsides)]
            .into_iter()
            .enumerate()
        {
            let mut entries = entries.as_array().unwrap().iter();
            let mut entry = entries
                .find(|entry| stem(&entry["pointcloud_path"]) == names[side])
                .unwrap()
                .clone();
            copy(&sample.join(folder), &data.join(folder), &entry);
            entry["frame_id"] = names[side].clone().into();
            entry["sequence_id"] = "0000".into();
            lists[side + 1].push(entry);
        }
        let calibration =
            |folder: &str| json_of(&sample.join(format!("vehicle-side/calib/{folder}/{}.json", names[0])));
        let world_from_lidar =
            pose(&calibration("novatel_to_world")) * pose(&calibration("lidar_to_novatel")["transform"]);
        let labels = json_of(&sample.join(pair["cooperative_label_path"].as_str().unwrap()));
        let file = data.join(format!("cooperative/label/{}.json", names[0]));
        write(
            &file,
            in_lidar(&labels, &world_from_lidar.inverse()).to_string().as_bytes(),
        );
        expected.push((names[0].clone(), places(&labels)));
        lists[0].push(json!({
            "vehicle_frame": names[0], "infrastructure_frame": names[1], "vehicle_sequence": "0000",
            "infrastructure_sequence": "0000", "system_error_offset": pair["system_error_offset"],
        }));
    }
    for (name, list) in LISTS.iter().zip(&lists) {
        write(&data.join(name), json!(list).to_string().as_bytes());
    }
    expected.sort_by(|a, b| a.0.cmp(&b.0));
    expected
}

#[test]
fn recorded_clouds_poses_and_labels_are_where_they_are_in_the_world() {
    let Some(sample) = skipped::shared("data/dair") else {
        return;
    };
    let dir = tempfile::tempdir().unwrap();
    let (data, out) = (dir.path().join("data"), dir.path().join("out.mcap"));
    let expected = make(&sample, &data);
    let summary = import("v2x-seq", &data, &out, &[]).unwrap().remove(0);
    let labels: usize = expected.iter().map(|(_, places)| places.len()).sum();
    assert_eq!((summary.frames, summary.truth_boxes), (6, labels), "{summary}");
    // As they are known of the data set, by another way.
    for (agent, height) in summary.agents.iter().zip([2.0, 1.6]) {
        assert!((agent.height_m - height).abs() < 0.15, "{summary}");
    }
    let (_, found) = read(&out);
    let vehicle = found.iter().filter(|((agent, _), _)| agent == "vehicle");
    let mut compared = 0;
    for ((_, read), (_, places)) in vehicle.zip(&expected) {
        for (center, _, object) in read.boxes_in_map(&read.truth) {
            let place = places[object.track.unwrap() as usize - 1];
            let apart = (Point3::from(center) - place).norm();
            assert!(apart < 1e-3, "{apart} m");
            compared += 1;
        }
        assert_eq!(read.views, 2);
    }
    assert_eq!(compared, labels);
}
