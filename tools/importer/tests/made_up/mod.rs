//! A data set in the layout of DAIR-V2X-C, made up: as many pairs as asked for, of 300 points and two objects each.

use std::fs;
use std::path::{Path, PathBuf};

use serde_json::{Value, json};

/// Stamp of the first pair, µs.
pub const T0: u64 = 1_700_000_000_000_000;
/// Points of a cloud.
pub const POINTS: usize = 300;

/// Writes the data set below a folder.
pub fn make(root: &Path, pairs: u64) {
    let eye = json!([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]);
    let (mut vehicles, mut roadsides, mut together) = (Vec::new(), Vec::new(), Vec::new());
    for k in 0..pairs {
        let (v, r) = (format!("{:06}", 100 + k), format!("{:06}", 200 + k));
        let sides = [
            ("vehicle-side", &v, "label/lidar"),
            ("infrastructure-side", &r, "label/virtuallidar"),
        ];
        for (side, name, labels) in sides {
            let side = root.join(side);
            write(
                &side.join(format!("velodyne/{name}.pcd")),
                &cloud(|i| i as f32 / POINTS as f32),
            );
            write_json(
                &side.join(format!("{labels}/{name}.json")),
                &json!([label(10.0, 4.0), label(20.0, -5.0)]),
            );
        }
        let x = 100.0 + k as f64;
        let vehicle = root.join("vehicle-side/calib");
        let mounting = json!({"transform": {"rotation": eye, "translation": [[0.0], [0.0], [1.8]]}});
        write_json(&vehicle.join(format!("lidar_to_novatel/{v}.json")), &mounting);
        let place = json!({"rotation": eye, "translation": [[x], [50.0], [0.0]]});
        write_json(&vehicle.join(format!("novatel_to_world/{v}.json")), &place);
        let place = json!({"rotation": eye, "translation": [[130.0], [50.0], [1.8]]});
        let roadside = root.join("infrastructure-side/calib/virtuallidar_to_world");
        write_json(&roadside.join(format!("{r}.json")), &place);
        let truth = root.join("cooperative/label_world");
        write_json(
            &truth.join(format!("{v}.json")),
            &json!([in_world(x + 10.0, 54.0), in_world(150.0, 45.0)]),
        );
        let stamp = T0 + k * 100_000;
        vehicles.push(json!({
            "pointcloud_path": format!("velodyne/{v}.pcd"), "pointcloud_timestamp": stamp.to_string(),
            "calib_lidar_to_novatel_path": format!("calib/lidar_to_novatel/{v}.json"),
            "calib_novatel_to_world_path": format!("calib/novatel_to_world/{v}.json"),
            "label_lidar_std_path": format!("label/lidar/{v}.json"),
        }));
        roadsides.push(json!({
            "pointcloud_path": format!("velodyne/{r}.pcd"), "pointcloud_timestamp": (stamp + 30_000).to_string(),
            "calib_virtuallidar_to_world_path": format!("calib/virtuallidar_to_world/{r}.json"),
            "label_lidar_std_path": format!("label/virtuallidar/{r}.json"),
        }));
        together.push(json!({
            "infrastructure_pointcloud_path": format!("infrastructure-side/velodyne/{r}.pcd"),
            "vehicle_pointcloud_path": format!("vehicle-side/velodyne/{v}.pcd"),
            "cooperative_label_path": format!("cooperative/label_world/{v}.json"),
            "system_error_offset": {"delta_x": 0.0, "delta_y": 0.0},
        }));
    }
    write_json(&root.join("vehicle-side/data_info.json"), &json!(vehicles));
    write_json(&root.join("infrastructure-side/data_info.json"), &json!(roadsides));
    write_json(&root.join("cooperative/data_info.json"), &json!(together));
}

/// A cloud of floats whose intensities are given by the number of the point.
pub fn cloud(intensity: impl Fn(usize) -> f32) -> Vec<u8> {
    let mut file = head("x y z intensity", "4 4 4 4", "F F F F", "1 1 1 1");
    for i in 0..POINTS {
        let [x, y, z] = place(i);
        file.extend([x, y, z, intensity(i)].iter().flat_map(|v| v.to_le_bytes()));
    }
    file
}

/// Where a point lies.
pub fn place(i: usize) -> [f32; 3] {
    [(i % 20) as f32 * 3.0 - 30.0, (i / 20) as f32 * 4.0 - 30.0, -1.8]
}

/// The head of a binary cloud.
pub fn head(fields: &str, sizes: &str, types: &str, counts: &str) -> Vec<u8> {
    format!(
        "# .PCD v0.7\nVERSION 0.7\nFIELDS {fields}\nSIZE {sizes}\nTYPE {types}\nCOUNT {counts}\nWIDTH {POINTS}\nHEIGHT 1\n\
         VIEWPOINT 0 0 0 1 0 0 0\nPOINTS {POINTS}\nDATA binary\n"
    )
    .into_bytes()
}

/// Changes a list of the data set.
pub fn edit(path: &Path, change: impl FnOnce(&mut Vec<Value>)) {
    let mut list: Vec<Value> = serde_json::from_slice(&fs::read(path).unwrap()).unwrap();
    change(&mut list);
    write_json(path, &Value::Array(list));
}

/// The lists.
pub fn lists(root: &Path) -> [PathBuf; 3] {
    ["cooperative", "vehicle-side", "infrastructure-side"].map(|folder| root.join(folder).join("data_info.json"))
}

pub fn write(path: &Path, bytes: &[u8]) {
    fs::create_dir_all(path.parent().unwrap()).unwrap();
    fs::write(path, bytes).unwrap();
}

fn write_json(path: &Path, value: &Value) {
    write(path, value.to_string().as_bytes());
}

fn label(x: f64, y: f64) -> Value {
    json!({
        "type": "Car", "rotation": 0.0, "3d_dimensions": {"h": 1.5, "w": 1.8, "l": 4.4},
        "3d_location": {"x": x, "y": y, "z": -1.1},
    })
}

fn in_world(x: f64, y: f64) -> Value {
    let corners = [(2.2, 0.9), (2.2, -0.9), (-2.2, -0.9), (-2.2, 0.9)];
    let at = |z: f64| corners.map(|(a, b)| [x + a, y + b, z]);
    let corners = [at(0.0), at(1.5)].concat();
    json!({"type": "Car", "3d_dimensions": {"h": 1.5, "w": 1.8, "l": 4.4}, "world_8_points": corners})
}
