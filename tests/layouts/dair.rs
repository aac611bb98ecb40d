//! DAIR-V2X-C, and V2X-Seq-SPD with its sequences and tracks.

use std::path::Path;

use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion, Vector3};
use realo_schemas::Box3;
use realo_schemas::geometry::transform_box;
use serde_json::{Value, json};

use crate::files::{pcd, write, write_json};
use crate::scene::{HEIGHT, Scene, Sweep};

const SIDES: [&str; 2] = ["vehicle-side", "infrastructure-side"];
const LABELS: [&str; 2] = ["label/lidar", "label/virtuallidar"];
/// Stamp of the first sweeps, µs.
const START: i64 = 1_626_155_123_000_000;
/// Error of the roadside unit's recorded place, m.
const OFFSET: [f64; 2] = [-0.75, 0.25];

/// Heights of the LiDARs over the ground, m: fixed for DAIR-V2X-C, given by `--height` for V2X-Seq.
fn heights(is_sequence: bool) -> [f64; 2] {
    match is_sequence {
        true => [HEIGHT; 2],
        false => [2.0, 1.6],
    }
}

/// A pose as calibrations have it.
fn parts(pose: &Isometry3<f64>) -> Value {
    let rotation = pose.rotation.to_rotation_matrix();
    let row = |row: usize| [0, 1, 2].map(|column| rotation[(row, column)]);
    let [x, y, z] = pose.translation.vector.into();
    json!({"rotation": [row(0), row(1), row(2)], "translation": [[x], [y], [z]]})
}

/// Writes a vehicle and a roadside unit.
pub fn write_scene(scene: &Scene, data: &Path, is_sequence: bool) {
    let mut lists: [Vec<Value>; 3] = Default::default();
    for frame in 0..scene.agents[0].sweeps.len() {
        let names = [100, 200].map(|first| format!("{:06}", first + frame));
        for (side, name) in names.iter().enumerate() {
            let (folder, sweep) = (data.join(SIDES[side]), &scene.agents[side].sweeps[frame]);
            write_side(&folder, side, name, sweep, heights(is_sequence)[side]);
            lists[side + 1].push(entry(side, name, frame));
        }
        let [vehicle, roadside] = &names;
        let sweep = &scene.agents[0].sweeps[frame];
        let (folder, labels) = match is_sequence {
            true => ("label", in_lidar(&scene.seen(frame))),
            false => ("label_world", in_world(sweep, &scene.seen(frame))),
        };
        let together = format!("cooperative/{folder}/{vehicle}.json");
        write_json(&data.join(&together), &labels);
        lists[0].push(match is_sequence {
            true => json!({
                "vehicle_frame": vehicle, "infrastructure_frame": roadside, "vehicle_sequence": "0000",
                "infrastructure_sequence": "0000", "system_error_offset": offset(),
            }),
            false => json!({
                "vehicle_pointcloud_path": format!("vehicle-side/velodyne/{vehicle}.pcd"),
                "infrastructure_pointcloud_path": format!("infrastructure-side/velodyne/{roadside}.pcd"),
                "cooperative_label_path": together, "system_error_offset": offset(),
            }),
        });
    }
    for (folder, list) in ["cooperative", SIDES[0], SIDES[1]].iter().zip(lists) {
        write_json(&data.join(folder).join("data_info.json"), &list.into());
    }
}

fn offset() -> Value {
    json!({"delta_x": OFFSET[0], "delta_y": OFFSET[1]})
}

/// Cloud, calibrations and labels of a side's sweep.
fn write_side(folder: &Path, side: usize, name: &str, sweep: &Sweep, height: f64) {
    let cloud = pcd(&sweep.in_lidar(height), &sweep.intensities());
    write(&folder.join(format!("velodyne/{name}.pcd")), &cloud);
    let map_from_lidar = sweep.map_from_lidar(height);
    let calibration =
        |folder_of: &str, value: &Value| write_json(&folder.join(format!("calib/{folder_of}/{name}.json")), value);
    match side {
        0 => {
            let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), 1.5);
            let novatel_from_lidar = Isometry3::from_parts(Translation3::new(0.8, 0.1, 1.4), turn);
            calibration("lidar_to_novatel", &json!({"transform": parts(&novatel_from_lidar)}));
            calibration(
                "novatel_to_world",
                &parts(&(map_from_lidar * novatel_from_lidar.inverse())),
            );
        }
        _ => {
            let off = Translation3::new(-OFFSET[0], -OFFSET[1], 0.0);
            calibration("virtuallidar_to_world", &parts(&(off * map_from_lidar)));
        }
    }
    let labels: Vec<Value> = sweep.own.iter().map(|object| label(object, height)).collect();
    write_json(&folder.join(format!("{}/{name}.json", LABELS[side])), &labels.into());
}

fn entry(side: usize, name: &str, frame: usize) -> Value {
    let stamp = START + 100_000 * frame as i64;
    let mut entry = json!({
        "pointcloud_path": format!("velodyne/{name}.pcd"), "pointcloud_timestamp": stamp.to_string(), "frame_id": name,
        "sequence_id": "0000", "label_lidar_std_path": format!("{}/{name}.json", LABELS[side]),
    });
    let calibrations: &[&str] = match side {
        0 => &["lidar_to_novatel", "novatel_to_world"],
        _ => &["virtuallidar_to_world"],
    };
    for calibration in calibrations {
        entry[format!("calib_{calibration}_path")] = format!("calib/{calibration}/{name}.json").into();
    }
    entry
}

/// A label in the frame of a LiDAR.
fn label(object: &Box3, height: f64) -> Value {
    let [x, y, z] = object.center;
    json!({
        "type": &*object.class, "track_id": format!("{:06}", object.track.expect("a track")), "rotation": object.yaw,
        "3d_dimensions": {"h": object.height, "w": object.width, "l": object.length},
        "3d_location": {"x": x, "y": y, "z": z - height},
    })
}

fn in_lidar(objects: &[&Box3]) -> Value {
    objects.iter().map(|object| label(object, HEIGHT)).collect()
}

fn in_world(sweep: &Sweep, objects: &[&Box3]) -> Value {
    let label = |object: &Box3| {
        let there = transform_box(&sweep.map_from_body, object);
        let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), there.yaw);
        let corner = |above: f64| {
            [(0.5, 0.5), (0.5, -0.5), (-0.5, -0.5), (-0.5, 0.5)].map(|(along, aside)| {
                let offset = turn * Vector3::new(along * there.length, aside * there.width, above * there.height);
                <[f64; 3]>::from(Point3::from(there.center) + offset)
            })
        };
        let corners = [corner(-0.5), corner(0.5)].concat();
        json!({
            "type": &*there.class, "world_8_points": corners,
            "3d_dimensions": {"h": there.height, "w": there.width, "l": there.length},
        })
    };
    objects.iter().map(|object| label(object)).collect()
}
