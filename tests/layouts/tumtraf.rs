//! TUMTraf-V2X: cuboids of OpenLABEL in the frame of the roadside LiDAR, which is the map.

use std::path::Path;

use nalgebra::{UnitQuaternion, Vector3};
use realo_schemas::Box3;
use realo_schemas::geometry::transform_box;
use serde_json::{Map, Value, json};

use crate::files::{matrix, pcd, write, write_json};
use crate::scene::{HEIGHT, Scene};

pub const NAMES: [&str; 2] = ["cav_vehicle_lidar_robosense", "rsu_s110_lidar_ouster_south"];
const SENSORS: [&str; 2] = ["vehicle_lidar_robosense", "s110_lidar_ouster_south"];
const START: i64 = 1_688_625_741;

/// Writes a vehicle and a roadside unit.
pub fn write_scene(scene: &Scene, data: &Path) {
    for frame in 0..scene.agents[0].sweeps.len() {
        let time = format!("{START}_{:09}", frame * 100_000_000);
        let sweeps = [0, 1].map(|side| &scene.agents[side].sweeps[frame]);
        for (sensor, sweep) in SENSORS.iter().zip(sweeps) {
            // Parts of 256, as these sensors report them.
            let intensities: Vec<f32> = sweep
                .cloud()
                .intensity
                .iter()
                .map(|intensity| f32::from(*intensity) * 256.0 / 255.0)
                .collect();
            let cloud = pcd(&sweep.in_lidar(HEIGHT), &intensities);
            write(
                &data.join(format!("train/point_clouds/{sensor}/{time}_{sensor}.pcd")),
                &cloud,
            );
        }
        let [map_from_vehicle, map_from_south] = sweeps.map(|sweep| sweep.map_from_lidar(HEIGHT));
        let both = [sweeps[0].labels(), sweeps[1].labels()].concat();
        let objects: Map<String, Value> = both
            .iter()
            .map(|object| cuboid(&transform_box(&map_from_south.inverse(), object)))
            .collect();
        let south_from_vehicle = matrix(&map_from_south.inv_mul(&map_from_vehicle));
        let transform =
            json!({"src": SENSORS[0], "dst": SENSORS[1], "transform_src_to_dst": {"matrix4x4": south_from_vehicle}});
        let frame = json!({"objects": objects, "frame_properties": {"transforms": {"v": transform}}});
        let labels = json!({"openlabel": {"frames": {"0": frame}, "coordinate_systems": {}}});
        let fused = format!("{}_and_{}_registered", SENSORS[1], SENSORS[0]);
        let file = data.join(format!("train/labels_point_clouds/{fused}/{time}_{fused}.json"));
        write_json(&file, &labels);
    }
}

/// A box of the labels' frame, by its track.
fn cuboid(object: &Box3) -> (String, Value) {
    let ([x, y, z], id) = (object.center, object.track.expect("a track"));
    let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), object.yaw);
    let size = [object.length, object.width, object.height];
    let val = [&[x, y, z, turn.i, turn.j, turn.k, turn.w][..], &size].concat();
    let class = object.class.to_uppercase();
    let data = json!({"name": format!("{class}_{id}"), "type": class, "cuboid": {"name": "shape3D", "val": val}});
    (format!("track-{id}"), json!({"object_data": data}))
}
