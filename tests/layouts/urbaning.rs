//! UrbanIng-V2X: arrays of LiDARs, states of vehicles, and tracks over time.

use std::collections::BTreeMap;
use std::path::Path;

use nalgebra::Translation3;
use realo_logs::AgentKind;
use realo_schemas::Box3;
use serde_json::{Value, json};

use crate::arrays::{npy, npz};
use crate::files::{matrix, write, write_json};
use crate::scene::{HEIGHT, Scene, Sweep};

pub const NAMES: [&str; 3] = ["cav_vehicle1", "cav_vehicle2", "rsu_crossing1_11_lidar"];
const SENSORS: [&str; 3] = ["vehicle1_middle_lidar", "vehicle2_middle_lidar", "crossing1_11_lidar"];
const SEQUENCE: &str = "20241126_0008_crossing1_00";
const START_MS: i64 = 1_732_610_000_000;

fn at(frame: usize) -> i64 {
    START_MS + 100 * frame as i64
}

/// Writes two vehicles and a roadside unit.
pub fn write_scene(scene: &Scene, data: &Path) {
    let sequence = data.join("dataset").join(SEQUENCE);
    let (mut tracks, mut lidars) = (BTreeMap::<u64, Value>::new(), json!({}));
    for (agent, sensor) in scene.agents.iter().zip(SENSORS) {
        let is_vehicle = agent.kind == AgentKind::Vehicle;
        let mount = match is_vehicle {
            true => Translation3::new(0.0, 0.0, HEIGHT).into(),
            false => agent.sweeps[0].map_from_lidar(HEIGHT),
        };
        lidars[sensor] = json!({"extrinsics": {"matrix": matrix(&mount)}});
        for (frame, sweep) in agent.sweeps.iter().enumerate() {
            write(&sequence.join(format!("{sensor}/{}.npz", at(frame))), &archive(sweep));
            if is_vehicle {
                let (vehicle, _) = sensor.split_once('_').expect("a vehicle's sensor");
                let state = json!({"pose": {"transformation": matrix(&sweep.map_from_body)}});
                write_json(&sequence.join(format!("{vehicle}_state/{}.json", at(frame))), &state);
            }
            for object in sweep.labels() {
                add(&mut tracks, frame, &object);
            }
        }
    }
    let frames = 0..scene.agents[0].sweeps.len();
    let lines = frames.map(|frame| format!("{0},{0},{0},{0}\n", at(frame)));
    let table = format!("frame,{}\n{}", SENSORS.join(","), lines.collect::<String>());
    write(&sequence.join("timesync_info.csv"), table.as_bytes());
    write_json(&data.join("calibration.json"), &json!({"lidars": lidars}));
    let tracks: Vec<Value> = tracks.into_values().collect();
    write_json(
        &data.join(format!("labels/{SEQUENCE}.json")),
        &json!({"tracks": tracks}),
    );
}

/// Adds where an object is at a frame, unless another agent labelled it there.
fn add(tracks: &mut BTreeMap<u64, Value>, frame: usize, object: &Box3) {
    let id = object.track.expect("a track");
    let track = tracks.entry(id).or_insert_with(|| {
        json!({
            "track_id": id, "object_type": &*object.class, "timestamps": [], "positions": [], "orientations": [],
            "dimensions": [object.length, object.width, object.height],
        })
    });
    let seconds = json!(at(frame) as f64 / 1000.0);
    let times = track["timestamps"].as_array().expect("a list");
    if times.contains(&seconds) {
        return;
    }
    let columns = [
        ("timestamps", seconds),
        ("positions", json!(object.center)),
        ("orientations", json!(object.yaw)),
    ];
    for (key, value) in columns {
        track[key].as_array_mut().expect("a list").push(value);
    }
}

/// A cloud whose points are all at its stamp.
fn archive(sweep: &Sweep) -> Vec<u8> {
    let points = sweep.in_lidar(HEIGHT);
    let count = format!("{},", points.len());
    let axis = |axis: usize| npy("<f4", &count, points.iter().flat_map(|point| point[axis].to_le_bytes()));
    npz([
        ("x", axis(0)),
        ("y", axis(1)),
        ("z", axis(2)),
        ("intensity", npy("|u1", &count, sweep.cloud().intensity.iter().copied())),
        (
            "time_offset_ms",
            npy("<f8", &count, points.iter().flat_map(|_| 0_f64.to_le_bytes())),
        ),
    ])
}
