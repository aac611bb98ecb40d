//! V2X-Seq-SPD: DAIR's folders with sequences, tracks of each side, and cooperative labels in the frame of the vehicle's LiDAR.

mod bad_input;
mod sample;

use std::fs;
use std::path::{Path, PathBuf};

use nalgebra::{Matrix4, Vector3};
use realo_importer::{SceneSummary, look_at};
use realo_logs::{AgentKind, Log, Stream};
use serde_json::{Value, json};

use crate::AGENTS;
use crate::layouts::{pcd, write};
use crate::reading::{import, read};
use crate::round_trip::compare;
use crate::world::{Agent, CARS, Car, ON_A_CAR, matrix};

/// Stamp of the vehicle's first sweep of a pair, µs.
const START: i64 = 1_626_155_123_881_356;
/// The roadside unit's is so much later, and its sweeps are faster, µs.
const LATER: i64 = 22_874;
const PERIODS: [i64; 2] = [100_000, 96_000];
const FRAMES: u64 = 3;
/// What was recorded of the roadside unit's place is off by so much, m.
const OFFSET: [f64; 2] = [-0.7, 0.14];
/// Numbers of the first frames of pairs.
const FIRST: [u64; 2] = [9, 0];
/// The vehicle and the roadside unit, each with its number in the world.
const LIDARS: [(Agent, usize); 2] = [(AGENTS[0], 0), (AGENTS[2], 2)];
const SIDES: [&str; 2] = ["vehicle-side", "infrastructure-side"];
const LISTS: [&str; 3] = [
    "cooperative/data_info.json",
    "vehicle-side/data_info.json",
    "infrastructure-side/data_info.json",
];

struct Made {
    dir: tempfile::TempDir,
}

fn frame(number: u64) -> String {
    format!("{number:06}")
}

/// Stamp of a side's sweep, µs.
fn stamp(side: usize, sequence: u64, frame: u64) -> i64 {
    START + 60_000_000 * sequence as i64 + LATER * side as i64 + PERIODS[side] * frame as i64
}

/// A matrix as calibrations have it.
fn parts(matrix: &Matrix4<f64>) -> Value {
    let row = |row: usize| [0, 1, 2].map(|column| matrix[(row, column)]);
    json!({"rotation": [row(0), row(1), row(2)], "translation": [[matrix[(0, 3)]], [matrix[(1, 3)]], [matrix[(2, 3)]]]})
}

/// A camera that looks where the LiDAR does.
fn camera_from_lidar() -> Matrix4<f64> {
    Matrix4::new(
        0.0, -1.0, 0.0, 0.0, 0.0, 0.0, -1.0, -0.2, 1.0, 0.0, 0.0, 0.1, 0.0, 0.0, 0.0, 1.0,
    )
}

/// A car's label in the frame of a LiDAR.
fn label(lidar_from_world: &Matrix4<f64>, car: &Car, track: &str) -> Value {
    let pose = lidar_from_world * car.pose();
    let [l, w, h] = car.size;
    json!({
        "token": "46870de4-7673-3fee-acbc-ab4b35f70834", "type": "Car", "track_id": track,
        "truncated_state": 0, "occluded_state": 2, "alpha": -1.36,
        "2d_box": {"xmin": 865.5, "ymin": 567.8, "xmax": 928.4, "ymax": 615.9},
        "3d_dimensions": {"l": l, "w": w, "h": h},
        "3d_location": {"x": pose[(0, 3)], "y": pose[(1, 3)], "z": pose[(2, 3)]},
        "rotation": pose[(1, 0)].atan2(pose[(0, 0)]),
    })
}

fn car(id: u64) -> &'static Car {
    CARS.iter().find(|car| car.id == id).unwrap()
}

/// What a side calls an object.
fn track(side: usize, id: u64) -> String {
    format!("{:06}", [9500, 500][side] + id)
}

impl Made {
    /// Sequences of three pairs each.
    fn new(sequences: u64) -> Self {
        let made = Made {
            dir: tempfile::tempdir().unwrap(),
        };
        let mut lists: [Vec<Value>; 3] = Default::default();
        for sequence in 0..sequences {
            // The vehicle's first sweep is in no pair, and has no files.
            lists[1].push(entry(
                0,
                sequence,
                frame(100 * sequence + FIRST[0] - 1),
                START - 100_000,
            ));
            for k in 0..FRAMES {
                let numbers = FIRST.map(|first| frame(100 * sequence + first + k));
                for (side, number) in numbers.iter().enumerate() {
                    lists[side + 1].push(entry(side, sequence, number.clone(), stamp(side, sequence, k)));
                    made.side(side, sequence, k, number);
                }
                let file = made.data().join(format!("cooperative/label/{}.json", numbers[0]));
                write(&file, cooperative(sequence, k, &numbers).to_string().as_bytes());
                lists[0].push(json!({
                    "vehicle_frame": numbers[0], "infrastructure_frame": numbers[1],
                    "vehicle_sequence": format!("{sequence:04}"), "infrastructure_sequence": format!("{sequence:04}"),
                    "system_error_offset": {"delta_x": OFFSET[0], "delta_y": OFFSET[1]},
                }));
            }
        }
        // Lists need not be in order.
        lists[0].reverse();
        for (name, list) in LISTS.iter().zip(&lists) {
            write(&made.data().join(name), json!(list).to_string().as_bytes());
        }
        made
    }

    fn data(&self) -> PathBuf {
        self.dir.path().join("data")
    }

    fn out(&self) -> PathBuf {
        self.dir.path().join("out.mcap")
    }

    fn import(&self, set: &[(&str, &str)]) -> Result<SceneSummary, String> {
        Ok(import("v2x-seq", &self.data(), &self.out(), set)?.remove(0))
    }

    /// Changes a list, or a file of labels.
    fn edit(&self, name: &str, change: impl FnOnce(&mut Vec<Value>)) {
        let path = self.data().join(name);
        let mut list: Vec<Value> = serde_json::from_slice(&fs::read(&path).unwrap()).unwrap();
        let before = list.clone();
        change(&mut list);
        assert_ne!(list, before, "nothing was changed");
        write(&path, json!(list).to_string().as_bytes());
    }

    /// Writes the files of a sweep.
    fn side(&self, side: usize, sequence: u64, k: u64, number: &str) {
        let folder = self.data().join(SIDES[side]);
        let (agent, place) = LIDARS[side];
        let world_from_lidar = matrix(agent.at(k));
        let lidar_from_world = world_from_lidar.try_inverse().unwrap();
        let points: Vec<[f32; 3]> = agent
            .sees(k, place)
            .iter()
            .map(|point| lidar_from_world.transform_point(point))
            .map(|at| [at.x as f32, at.y as f32, at.z as f32])
            .collect();
        let cloud = match side {
            0 => timed(&points, stamp(side, sequence, k)),
            _ => pcd(&points),
        };
        write(&folder.join(format!("velodyne/{number}.pcd")), &cloud);
        let calibration = |name: &str, value: &Value| {
            write(
                &folder.join(format!("calib/{name}/{number}.json")),
                value.to_string().as_bytes(),
            );
        };
        match side {
            0 => {
                let novatel_from_lidar = matrix([0.8, 0.1, 1.4, 0.4, 91.0, -0.7]);
                calibration("lidar_to_novatel", &json!({"transform": parts(&novatel_from_lidar)}));
                let world_from_novatel = world_from_lidar * novatel_from_lidar.try_inverse().unwrap();
                calibration("novatel_to_world", &parts(&world_from_novatel));
                calibration("lidar_to_camera", &parts(&camera_from_lidar()));
                calibration(
                    "camera_intrinsic",
                    &json!({"cam_K": [1000, 0, 960, 0, 1000, 540, 0, 0, 1]}),
                );
            }
            _ => {
                let off = Matrix4::new_translation(&Vector3::new(-OFFSET[0], -OFFSET[1], 0.0));
                calibration("virtuallidar_to_world", &parts(&(off * world_from_lidar)));
                calibration("virtuallidar_to_camera", &parts(&camera_from_lidar()));
                calibration(
                    "camera_intrinsic",
                    &json!({"cam_K": [1000, 0, 960, 0, 1000, 540, 0, 0, 1], "width": 1920, "height": 1080}),
                );
            }
        }
        let labels = agent.labels.iter();
        let mut labels: Vec<Value> = labels
            .map(|id| label(&lidar_from_world, car(*id), &track(side, *id)))
            .collect();
        // What was seen in an image only.
        let mut placeholder = label(&lidar_from_world, car(11), "000099");
        placeholder["3d_dimensions"] = json!({"l": 0, "w": 0, "h": 0});
        labels.push(placeholder);
        let name = ["label/lidar", "label/virtuallidar"][side];
        write(
            &folder.join(format!("{name}/{number}.json")),
            json!(labels).to_string().as_bytes(),
        );
    }
}

/// A sweep in the list of its side.
fn entry(side: usize, sequence: u64, number: String, stamp: i64) -> Value {
    let file = |folder: &str, end: &str| format!("{folder}/{number}.{end}");
    let mut entry = json!({
        "image_path": file("image", "jpg"), "pointcloud_path": file("velodyne", "pcd"),
        "calib_camera_intrinsic_path": file("calib/camera_intrinsic", "json"),
        "label_camera_std_path": file("label/camera", "json"), "intersection_loc": "yizhuang08",
        "image_timestamp": (stamp + 9000).to_string(), "pointcloud_timestamp": stamp.to_string(),
        "frame_id": number, "start_frame_id": "000000", "end_frame_id": "000209", "num_frames": 210,
        "sequence_id": format!("{sequence:04}"),
    });
    let files: &[(&str, &str)] = match side {
        0 => &[
            ("calib_lidar_to_camera_path", "calib/lidar_to_camera"),
            ("calib_lidar_to_novatel_path", "calib/lidar_to_novatel"),
            ("calib_novatel_to_world_path", "calib/novatel_to_world"),
            ("label_lidar_std_path", "label/lidar"),
        ],
        _ => &[
            ("calib_virtuallidar_to_camera_path", "calib/virtuallidar_to_camera"),
            ("calib_virtuallidar_to_world_path", "calib/virtuallidar_to_world"),
            ("label_lidar_std_path", "label/virtuallidar"),
        ],
    };
    for (key, folder) in files {
        entry[key] = file(folder, "json").into();
    }
    entry
}

/// All cars in the frame of the vehicle's LiDAR, with the tracks of both sides.
fn cooperative(sequence: u64, k: u64, numbers: &[String; 2]) -> Value {
    let lidar_from_world = matrix(LIDARS[0].0.at(k)).try_inverse().unwrap();
    let one = |car: &Car| {
        let of_side = |side: usize| match LIDARS[side].0.labels.contains(&car.id) {
            true => track(side, car.id),
            false => "-1".into(),
        };
        let [vehicle, roadside] = [0, 1].map(of_side);
        let mut label = label(&lidar_from_world, car, &frame(car.id));
        label["from_side"] = match (vehicle.as_str(), roadside.as_str()) {
            (_, "-1") => "veh",
            ("-1", _) => "inf",
            _ => "coop",
        }
        .into();
        label["veh_pointcloud_timestamp"] = stamp(0, sequence, k).to_string().into();
        label["inf_pointcloud_timestamp"] = stamp(1, sequence, k).to_string().into();
        label["veh_frame_id"] = numbers[0].clone().into();
        label["inf_frame_id"] = numbers[1].clone().into();
        label["veh_track_id"] = vehicle.into();
        label["inf_track_id"] = roadside.into();
        label
    };
    CARS.iter().map(one).collect()
}

/// A cloud as vehicles have it: intensities as bytes, and times as seconds since 1970.
fn timed(points: &[[f32; 3]], stamp: i64) -> Vec<u8> {
    let n = points.len();
    let mut file = format!(
        "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z intensity timestamp\nSIZE 4 4 4 1 8\nTYPE F F F U F\nCOUNT 1 1 1 1 1\nWIDTH {n}\nHEIGHT 1\n\
         VIEWPOINT 0 0 0 1 0 0 0\nPOINTS {n}\nDATA binary\n"
    )
    .into_bytes();
    for (index, [x, y, z]) in points.iter().enumerate() {
        file.extend([x, y, z].iter().flat_map(|metres| metres.to_le_bytes()));
        file.push((index % 200) as u8);
        let seconds = stamp as f64 / 1e6 + 0.09 * index as f64 / n as f64;
        file.extend(seconds.to_le_bytes());
    }
    file
}

/// Compares a log of the sequence with the world.
fn compare_all(out: &Path, sequence: u64) -> Log {
    let (log, found) = read(out);
    assert_eq!(found.len(), 2 * FRAMES as usize);
    for (side, (name, (agent, place))) in ["vehicle", "roadside"].into_iter().zip(LIDARS).enumerate() {
        for k in 0..FRAMES {
            let at = stamp(side, sequence, k) * 1000;
            let read = &found[&(name.to_string(), at)];
            compare(read, &agent, place, k);
            assert_eq!(read.ready - at, [100_000_000, 96_000_000][side]);
            let own: Vec<u64> = read.own.iter().filter_map(|object| object.track).collect();
            assert_eq!(own, agent.labels, "own labels have the tracks of cooperative ones");
            assert!(read.own_points.iter().all(|points| *points == ON_A_CAR));
            let truth: Vec<u64> = read.truth.iter().filter_map(|object| object.track).collect();
            let all: Vec<u64> = CARS.iter().map(|car| car.id).collect();
            match side {
                0 => assert_eq!((truth, read.views), (all, 2)),
                _ => assert_eq!((truth, read.views), (Vec::new(), 0)),
            }
            let cloud = read.cloud.as_ref().unwrap();
            let times = (cloud.time[0], cloud.time[cloud.len() - 1]);
            match side {
                0 => assert!(
                    times.0.abs() < 1000 && (89_000_000..90_000_000).contains(&times.1),
                    "{times:?}"
                ),
                _ => assert_eq!(times, (0, 0)),
            }
        }
    }
    log
}

#[test]
fn a_sequence_comes_back_with_boxes_poses_points_and_tracks() {
    let made = Made::new(1);
    let summary = made.import(&[]).unwrap();
    let log = compare_all(&made.out(), 0);
    let agents = &log.info().agents;
    assert_eq!(
        (agents[0].kind, agents[1].kind, agents[0].footprint),
        (AgentKind::Vehicle, AgentKind::Roadside, Some([-2.3, 2.3, -0.95, 0.95]))
    );
    assert_eq!(log.info().protocol, "dair");
    assert_eq!(
        (summary.frames, summary.truth_boxes, summary.dropped_labels),
        (3, 12, 6)
    );
    assert!(summary.residuals[0].metres.unwrap() < 0.1, "{summary}");
    let said = summary.to_string();
    for line in [
        "scene `0000`: 3 frames",
        "truth: 12 boxes, the cooperative labels",
        "(--roadside-stamp)",
        "(--box-z)",
        "frames levelled by: pose (--level)",
    ] {
        assert!(said.contains(line), "{line} is not in\n{said}");
    }
    assert!(!said.contains("lacks") && !said.contains("taken as it is"), "{said}");
    // A side's labels are what a detector would have found: no tracks.
    let mut reader = log.read_all(&[("roadside", Stream::Detections)]).unwrap();
    let boxes = reader.next().unwrap().expect("detections").boxes().unwrap();
    assert_eq!(boxes.0.len(), 2);
    assert!(boxes.0.iter().all(|found| found.track.is_none() && found.score == 1.0));
}

#[test]
fn the_folder_is_known_by_the_keys_of_its_list() {
    let made = Made::new(1);
    let seen = look_at(&made.data());
    assert_eq!(seen.only(&made.data()).unwrap().kind().name, "v2x-seq", "{seen}");
    let said = seen.to_string();
    for line in [
        "it is `v2x-seq`: `cooperative/data_info.json` has `vehicle_frame` in entry 0",
        "it is not `dair`: `cooperative/data_info.json` has `vehicle_frame` in entry 0, as V2X-Seq-SPD",
    ] {
        assert!(said.contains(line), "{line} is not in\n{said}");
    }
    let error = import("dair", &made.data(), &made.out(), &[]).unwrap_err();
    let command = format!("try `realo-lab import v2x-seq {} -o LOG`", made.data().display());
    assert!(error.contains(&command), "{error}");
}

#[test]
fn each_sequence_is_a_log_and_parts_can_be_chosen() {
    let made = Made::new(2);
    let logs = made.dir.path().join("logs");
    let scenes = import("v2x-seq", &made.data(), &logs, &[]).unwrap();
    assert_eq!(scenes.len(), 2);
    for sequence in 0..2 {
        compare_all(&logs.join(format!("{sequence:04}.mcap")), sequence);
    }
    let set = [("scenes", "0001"), ("frames", "110.."), ("agents", "vehicle")];
    let summary = made.import(&set).unwrap();
    assert_eq!((summary.frames, summary.truth_boxes, summary.agents.len()), (2, 8, 1));
    let error = made.import(&[("scenes", "0007")]).unwrap_err();
    assert!(
        error.contains("there is no scene `0007`; there are `0000`, `0001`"),
        "{error}"
    );
    let summary = made.import(&[("scenes", "0000"), ("agents", "roadside")]).unwrap();
    assert_eq!((summary.truth_boxes, summary.agents[0].labels), (0, 6));
}

#[test]
fn ends_of_sweeps_bottoms_of_boxes_and_heights_can_be_told() {
    let made = Made::new(1);
    made.import(&[("roadside-stamp", "end"), ("box-z", "bottom"), ("height", "1.9")])
        .unwrap();
    let (log, found) = read(&made.out());
    let at = stamp(1, 0, 0) * 1000;
    assert_eq!(found[&("roadside".to_string(), at)].ready, at);
    assert_eq!(log.info().agents[1].sensor_position, Some([0.0, 0.0, 1.9]));
    let first = &found[&("vehicle".to_string(), stamp(0, 0, 0) * 1000)];
    let (center, _, object) = first.boxes_in_map(&first.truth)[0];
    let lifted = center[2] - car(object.track.unwrap()).center[2];
    assert!((lifted - object.height / 2.0).abs() < 0.001, "{lifted}");
}

#[test]
fn numbers_may_be_texts_and_texts_numbers() {
    let made = Made::new(1);
    for list in &LISTS[1..] {
        made.edit(list, |entries| {
            for entry in entries {
                for key in ["frame_id", "pointcloud_timestamp"] {
                    entry[key] = entry[key].as_str().unwrap().parse::<u64>().unwrap().into();
                }
            }
        });
    }
    made.edit(LISTS[0], |entries| {
        for entry in entries {
            entry["infrastructure_frame"] = entry["infrastructure_frame"]
                .as_str()
                .unwrap()
                .parse::<u64>()
                .unwrap()
                .into();
            entry["system_error_offset"]["delta_x"] = OFFSET[0].to_string().into();
        }
    });
    for file in ["cooperative/label/000010.json", "vehicle-side/label/lidar/000010.json"] {
        made.edit(file, |labels| {
            for label in labels {
                label["track_id"] = label["track_id"].as_str().unwrap().parse::<u64>().unwrap().into();
                label["rotation"] = label["rotation"].to_string().into();
                for (group, keys) in [("3d_dimensions", ["l", "w", "h"]), ("3d_location", ["x", "y", "z"])] {
                    for key in keys {
                        label[group][key] = label[group][key].to_string().into();
                    }
                }
            }
        });
    }
    made.import(&[]).unwrap();
    compare_all(&made.out(), 0);
}

#[test]
fn lists_without_cameras_give_truth_without_views_and_no_offset_is_an_empty_text() {
    let made = Made::new(1);
    made.edit(LISTS[2], |entries| {
        for entry in entries {
            drop(
                entry
                    .as_object_mut()
                    .unwrap()
                    .remove("calib_virtuallidar_to_camera_path"),
            );
        }
    });
    made.edit(LISTS[0], |entries| {
        entries
            .iter_mut()
            .for_each(|entry| entry["system_error_offset"] = "".into());
    });
    let summary = made.import(&[]).unwrap();
    assert_eq!(summary.frames, 3);
    let (log, found) = read(&made.out());
    let at = |name: &str, side| &found[&(name.to_string(), stamp(side, 0, 0) * 1000)];
    assert_eq!(at("vehicle", 0).views, 0);
    assert!(log.has("vehicle", Stream::OwnLabelsViews) && !log.has("roadside", Stream::OwnLabelsViews));
    let off = at("roadside", 1).map_from_body.translation.vector.x - LIDARS[1].0.at(0)[0];
    assert!((off + OFFSET[0]).abs() < 0.05, "the offset is not added: {off}");
}
