//! TUMTraf-V2X: cuboids of OpenLABEL in the frame of a fused cloud, transforms between sensors, times in names.

use std::fs;
use std::path::{Path, PathBuf};

use nalgebra::{Isometry3, Matrix4, Point3, UnitQuaternion};
use realo_importer::look_at;
use realo_logs::{AgentKind, Log};
use serde_json::{Value, json};

use crate::AGENTS;
use crate::layouts::write;
use crate::reading::{import, read};
use crate::round_trip::edit;
use crate::world::{Agent, CARS, ON_A_CAR, matrix};

const VEHICLE: &str = "vehicle_lidar_robosense";
const SOUTH: &str = "s110_lidar_ouster_south";
const START: i64 = 1_688_625_741_000_000_000;
const PERIOD: i64 = 100_000_000;
const FRAMES: u64 = 3;
/// The vehicle's sweeps are so much later than the labels, ns.
const LATER: i64 = 31_000_000;

/// The vehicle and the roadside unit, each with its number in the world.
const LIDARS: [(&str, Agent, usize); 2] = [(VEHICLE, AGENTS[0], 0), (SOUTH, AGENTS[2], 2)];

/// How the files give the transforms between sensors.
#[derive(Clone, Copy, PartialEq)]
enum Said {
    Transforms,
    Systems { from_parent: bool },
}

struct Made {
    dir: tempfile::TempDir,
    said: Said,
    /// Whether cuboids are at the bottoms of their boxes.
    bottom: bool,
}

fn name(stamp: i64) -> String {
    format!("{}_{}", stamp / 1_000_000_000, stamp % 1_000_000_000)
}

fn labels_frame() -> Matrix4<f64> {
    matrix(AGENTS[2].at(0))
}

fn rows(matrix: &Matrix4<f64>) -> Value {
    let rows: Vec<Vec<f64>> = (0..4).map(|row| matrix.row(row).iter().copied().collect()).collect();
    json!(rows)
}

impl Made {
    fn new(said: Said, bottom: bool) -> Self {
        let made = Made {
            dir: tempfile::tempdir().unwrap(),
            said,
            bottom,
        };
        for frame in 0..FRAMES {
            let stamp = START + frame as i64 * PERIOD;
            for (sensor, agent, number) in LIDARS {
                let own = if sensor == VEHICLE { stamp + LATER } else { stamp };
                let file = format!("point_clouds/{sensor}/{}_{sensor}.pcd", name(own));
                write(&made.split().join(file), &cloud(sensor, &agent, number, frame, own));
            }
            let fused = format!("{SOUTH}_and_{VEHICLE}_registered");
            let file = format!("labels_point_clouds/{fused}/{}_{fused}.json", name(stamp));
            write(&made.split().join(file), made.labels(frame).to_string().as_bytes());
        }
        made
    }

    fn data(&self) -> PathBuf {
        self.dir.path().join("data")
    }

    fn split(&self) -> PathBuf {
        self.data().join("train")
    }

    fn out(&self) -> PathBuf {
        self.dir.path().join("out.mcap")
    }

    fn first_labels(&self) -> PathBuf {
        let fused = format!("{SOUTH}_and_{VEHICLE}_registered");
        self.split()
            .join(format!("labels_point_clouds/{fused}/{}_{fused}.json", name(START)))
    }

    fn import(&self, set: &[(&str, &str)]) -> Result<realo_importer::SceneSummary, String> {
        Ok(import("tumtraf", &self.data(), &self.out(), set)?.remove(0))
    }

    fn labels(&self, frame: u64) -> Value {
        let map_from_world = labels_frame().try_inverse().unwrap();
        let object = |car: &crate::world::Car| {
            let mut pose = map_from_world * car.pose();
            if self.bottom {
                pose *= Matrix4::new_translation(&nalgebra::Vector3::new(0.0, 0.0, -car.size[2] / 2.0));
            }
            let turn = UnitQuaternion::from_matrix(&pose.fixed_view::<3, 3>(0, 0).into_owned());
            let [l, w, h] = car.size;
            let val = [
                pose[(0, 3)],
                pose[(1, 3)],
                pose[(2, 3)],
                turn.i,
                turn.j,
                turn.k,
                turn.w,
                l,
                w,
                h,
            ];
            let data =
                json!({"name": format!("CAR_{}", car.id), "type": "CAR", "cuboid": {"name": "shape3D", "val": val}});
            (format!("track-{}", car.id), json!({"object_data": data}))
        };
        let mut objects: serde_json::Map<String, Value> = CARS.iter().map(object).collect();
        // What was seen in an image only.
        objects.insert("track-image".into(), json!({"object_data": {"type": "PEDESTRIAN"}}));
        let south_from_vehicle = map_from_world * matrix(AGENTS[0].at(frame));
        let pose = |from_parent: bool, pose: &Matrix4<f64>| match from_parent {
            true => rows(&pose.try_inverse().unwrap()),
            false => rows(pose),
        };
        let (transforms, systems) = match self.said {
            Said::Transforms => (
                json!({"v": {"src": VEHICLE, "dst": SOUTH, "transform_src_to_dst": {"matrix4x4": rows(&south_from_vehicle)}}}),
                json!({}),
            ),
            Said::Systems { from_parent } => {
                // The sensor's name is written in another way here.
                let south = Matrix4::new_translation(&nalgebra::Vector3::new(1.0, 2.0, 8.0));
                let vehicle = south * south_from_vehicle;
                let system = |at: &Matrix4<f64>| json!({"type": "sensor", "parent": "s110_base", "pose_wrt_parent": {"matrix4x4": pose(from_parent, at)}});
                let mut systems = json!({"s110_base": {"type": "scene_cs", "parent": ""}});
                systems["S0110_lidar_ouster_south"] = system(&south);
                systems[VEHICLE] = system(&vehicle);
                // Cameras have theirs the other way round, or none that is a pose.
                systems["s110_camera_basler_1"] =
                    json!({"parent": "s110_base", "pose_wrt_parent": {"matrix4x4": [1, 2, 3]}});
                (json!({}), systems)
            }
        };
        let frame = json!({"objects": objects, "frame_properties": {"transforms": transforms}});
        json!({"openlabel": {"frames": {"0": frame}, "coordinate_systems": systems}})
    }
}

/// A cloud as the driver of a sensor writes it: Ouster's `t` counts ns, RoboSense has absolute times.
fn cloud(sensor: &str, agent: &Agent, number: usize, frame: u64, stamp: i64) -> Vec<u8> {
    let lidar_from_world = matrix(agent.at(frame)).try_inverse().unwrap();
    let points = agent.sees(frame, number);
    let count = points.len();
    let is_ouster = sensor == SOUTH;
    let (time, size, kind) = if is_ouster {
        ("t", 4, "U")
    } else {
        ("timestamp", 8, "F")
    };
    let mut file = format!(
        "VERSION 0.7\nFIELDS x y z intensity {time}\nSIZE 4 4 4 4 {size}\nTYPE F F F F {kind}\nWIDTH {count}\nHEIGHT 1\nPOINTS {count}\n\
         DATA binary\n"
    )
    .into_bytes();
    for (index, point) in points.iter().enumerate() {
        let at = lidar_from_world.transform_point(point);
        // Of 256: half of it, and all of it.
        let intensity: f32 = if index + 1 == count { 256.0 } else { 128.0 };
        file.extend(
            [at.x as f32, at.y as f32, at.z as f32, intensity]
                .iter()
                .flat_map(|v| v.to_le_bytes()),
        );
        let offset = offset(index);
        match is_ouster {
            true => file.extend((offset as u32).to_le_bytes()),
            false => file.extend(((stamp + offset) as f64 / 1e9).to_le_bytes()),
        }
    }
    file
}

fn offset(index: usize) -> i64 {
    (index as i64 % 1000) * 99_000
}

/// Compares a log with the world, where the frame of the labels is the map.
fn compare(path: &Path) -> Log {
    let (log, found) = read(path);
    assert_eq!(found.len(), 2 * FRAMES as usize);
    let map_from_world = labels_frame().try_inverse().unwrap();
    for (name, agent, number) in [
        ("cav_vehicle_lidar_robosense", AGENTS[0], 0),
        ("rsu_s110_lidar_ouster_south", AGENTS[2], 2),
    ] {
        for frame in 0..FRAMES {
            let later = if name.starts_with("cav") { LATER } else { 0 };
            let read = &found[&(name.to_string(), START + frame as i64 * PERIOD + later)];
            let expected = agent.sees(frame, number);
            let there = read.in_map();
            assert_eq!(there.len(), expected.len());
            let off = there
                .iter()
                .zip(&expected)
                .map(|(a, b)| (a - map_from_world.transform_point(b)).norm());
            let off = off.fold(0.0, f64::max);
            assert!(off < 1e-4, "{name}: points are {off} m apart");
            let cloud = read.cloud.as_ref().unwrap();
            assert_eq!((cloud.intensity[0], cloud.intensity[cloud.len() - 1]), (128, 255));
            for index in [0, 1, 999, 2345] {
                let off = i64::from(cloud.time[index]) - self::offset(index);
                // A double holds a time since 1970 to 0.2 µs.
                assert!(off.abs() < 1000, "{name}: point {index} is {off} ns off");
            }
            assert_eq!(read.truth.len(), CARS.len());
            for (center, heading, object) in read.boxes_in_map(&read.truth) {
                let car = CARS
                    .iter()
                    .find(|car| object.track == realo_logs::track_of(&format!("track-{}", car.id)));
                let car = car.expect("each box is a car's");
                let apart = (Point3::from(center) - map_from_world.transform_point(&Point3::from(car.center))).norm();
                let map: Isometry3<f64> = nalgebra::try_convert(map_from_world).unwrap();
                let ahead = map * car_ahead(car.yaw);
                let turned = (heading - ahead.y.atan2(ahead.x).to_degrees() + 540.0).rem_euclid(360.0) - 180.0;
                assert!(apart < 1e-6 && turned.abs() < 0.05, "{}: {apart} m, {turned}°", car.id);
                assert_eq!(
                    ([object.length, object.width, object.height], &*object.class),
                    (car.size, "CAR")
                );
            }
            assert!(
                read.truth_points.iter().all(|points| *points == ON_A_CAR),
                "{:?}",
                read.truth_points
            );
        }
    }
    log
}

fn car_ahead(yaw: f64) -> nalgebra::Vector3<f64> {
    let (sin, cos) = yaw.to_radians().sin_cos();
    nalgebra::Vector3::new(cos, sin, 0.0)
}

#[test]
fn cuboids_points_and_times_come_back() {
    let made = Made::new(Said::Transforms, false);
    let summary = made.import(&[]).unwrap();
    assert_eq!(
        (summary.frames, summary.incomplete_frames, summary.dropped_labels),
        (3, 0, 6),
        "{summary}"
    );
    assert!(summary.residuals[0].metres.unwrap() < 0.1, "{summary}");
    let log = compare(&made.out());
    let kinds: Vec<AgentKind> = log.info().agents.iter().map(|agent| agent.kind).collect();
    assert_eq!(kinds, [AgentKind::Vehicle, AgentKind::Roadside]);
    let said = summary.to_string();
    for line in [
        "the place of a label is the middle of the box (--box-z)",
        "(--pose-direction)",
        "(--label-frame)",
        "(--intensity-range)",
    ] {
        assert!(said.contains(line), "{line} is not in\n{said}");
    }
    let seen = look_at(&made.data());
    assert_eq!(
        seen.only(&made.data())
            .unwrap_or_else(|error| panic!("{error}"))
            .kind()
            .name,
        "tumtraf"
    );
}

#[test]
fn boxes_on_their_bottoms_are_lifted_if_asked_for() {
    let made = Made::new(Said::Transforms, true);
    made.import(&[("box-z", "bottom")]).unwrap();
    compare(&made.out());
    made.import(&[]).unwrap();
    let (_, found) = read(&made.out());
    let first = found.values().next().unwrap();
    let lower = first.boxes_in_map(&first.truth)[0].0[2];
    let expected = labels_frame()
        .try_inverse()
        .unwrap()
        .transform_point(&Point3::from(CARS[0].center))
        .z;
    assert!((expected - lower - CARS[0].size[2] / 2.0).abs() < 0.01, "{lower}");
}

#[test]
fn poses_at_parents_go_either_way_and_sensors_have_names_with_zeros() {
    for from_parent in [false, true] {
        let made = Made::new(Said::Systems { from_parent }, false);
        let way = if from_parent { "from-parent" } else { "to-parent" };
        made.import(&[("pose-direction", way)]).unwrap();
        compare(&made.out());
        let other = if from_parent { "to-parent" } else { "from-parent" };
        let summary = made.import(&[("pose-direction", other)]).unwrap();
        assert!(
            summary.residuals[0].metres.is_none_or(|metres| metres > 0.3),
            "{summary}"
        );
    }
}

#[test]
fn times_of_ouster_end_at_the_stamp_if_that_is_the_end() {
    let made = Made::new(Said::Transforms, false);
    made.import(&[("stamp", "end"), ("agents", SOUTH)]).unwrap();
    let (_, found) = read(&made.out());
    let read = &found[&("rsu_s110_lidar_ouster_south".to_string(), START)];
    let cloud = read.cloud.as_ref().unwrap();
    assert_eq!((cloud.time[0], cloud.time[999], read.ready), (-98_901_000, 0, START));
}

#[test]
fn what_is_missing_or_damaged_is_named() {
    let made = Made::new(Said::Transforms, false);
    let file = made.first_labels();
    let text = fs::read_to_string(&file).unwrap();
    for (from, to, named) in [
        (
            VEHICLE,
            "another_lidar",
            "no transform leads from `vehicle_lidar_robosense` to `s110_lidar_ouster_south`",
        ),
        (
            "\"val\":[",
            "\"val\":[7.0,",
            "cuboid.val: expected x, y, z, qx, qy, qz, qw, length, width, height",
        ),
        (
            "\"0\":",
            "\"1\":{},\"0\":",
            "openlabel.frames: expected one frame, found 2",
        ),
        (
            "[0.0,0.0,0.0,1.0]",
            "[0.0,0.0,0.0,2.0]",
            "transforms.v: expected a rotation and a translation as a 4×4 matrix",
        ),
        ("{", "[", "damaged labels"),
    ] {
        edit(&file, |text| text.replace(from, to));
        let error = made.import(&[]).unwrap_err();
        assert!(error.contains(named), "{named} is not in\n{error}");
        fs::write(&file, &text).unwrap();
    }
    let cloud = made
        .split()
        .join(format!("point_clouds/{SOUTH}/{}_{SOUTH}.pcd", name(START)));
    fs::write(&cloud, "version https://git-lfs.github.com/spec/v1\n").unwrap();
    let error = made.import(&[]).unwrap_err();
    assert!(error.contains("found a pointer of Git LFS"), "{error}");
    let summary = made.import(&[("skip-incomplete", "")]).unwrap();
    assert_eq!((summary.frames, summary.incomplete_frames), (2, 1));
    fs::remove_dir_all(made.split().join("labels_point_clouds")).unwrap();
    let error = made.import(&[]).unwrap_err();
    assert!(error.contains("found no such folders; unpack the data set"), "{error}");
}

#[test]
fn labels_after_a_gap_are_another_scene() {
    let made = Made::new(Said::Transforms, false);
    let fused = format!("{SOUTH}_and_{VEHICLE}_registered");
    for (folder, sensor, end) in [
        ("point_clouds", SOUTH, "pcd"),
        ("labels_point_clouds", fused.as_str(), "json"),
    ] {
        let folder = made.split().join(folder).join(sensor);
        let later = START + 60_000_000_000;
        let [from, to] = [START, later].map(|stamp| folder.join(format!("{}_{sensor}.{end}", name(stamp))));
        fs::copy(from, to).unwrap();
    }
    let logs = made.dir.path().join("logs");
    let scenes = import("tumtraf", &made.data(), &logs, &[]).unwrap();
    let names: Vec<(&str, usize)> = scenes
        .iter()
        .map(|scene| (scene.scene.as_str(), scene.agents.len()))
        .collect();
    assert_eq!(names, [("train/1", 2), ("train/2", 1)]);
}

#[test]
fn matrices_off_the_way_are_not_read() {
    let made = Made::new(Said::Systems { from_parent: false }, false);
    let off_the_way = [
        (
            "S110_CAMERA_8",
            json!({"parent": "s110_base", "pose_wrt_parent": {"matrix4x4": [1, 2, 3]}}),
        ),
        (
            "s110_radar",
            json!({"parent": "s110_base", "pose_wrt_parent": {"matrix4x4": [[2, 0], [0, 2]]}}),
        ),
        (
            "s110_imu",
            json!({"parent": "s110_base", "pose_wrt_parent": {"quaternion": [0, 0, 0, 1]}}),
        ),
    ];
    let fused = made.first_labels().parent().unwrap().to_path_buf();
    for file in fs::read_dir(fused).unwrap() {
        let file = file.unwrap().path();
        let mut labels: Value = serde_json::from_slice(&fs::read(&file).unwrap()).unwrap();
        for (name, system) in &off_the_way {
            labels["openlabel"]["coordinate_systems"][name] = system.clone();
        }
        let frame = &mut labels["openlabel"]["frames"]["0"];
        frame["frame_properties"]["transforms"]["r"] =
            json!({"src": "s110_radar", "dst": "s110_imu", "transform_src_to_dst": {"matrix4x4": "none"}});
        fs::write(&file, labels.to_string()).unwrap();
    }
    made.import(&[]).unwrap();
    compare(&made.out());
    // On the way they are named.
    edit(&made.first_labels(), |text| {
        text.replace("\"matrix4x4\":", "\"other\":")
    });
    let error = made.import(&[]).unwrap_err();
    assert!(
        error.contains("pose_wrt_parent: expected a rotation and a translation as a 4×4 matrix"),
        "{error}"
    );
}

#[test]
fn times_of_ouster_before_their_sweep_are_refused() {
    let made = Made::new(Said::Transforms, false);
    let file = made
        .split()
        .join(format!("point_clouds/{SOUTH}/{}_{SOUTH}.pcd", name(START)));
    let mut bytes = fs::read(&file).unwrap();
    // The field is signed here, and the last point's time is below 0.
    let signed = String::from_utf8_lossy(&bytes).find("TYPE F F F F U").unwrap() + "TYPE F F F F ".len();
    bytes[signed] = b'I';
    let last = bytes.len() - 4;
    bytes[last..].copy_from_slice(&(-5_i32).to_le_bytes());
    fs::write(&file, bytes).unwrap();
    let error = made.import(&[]).unwrap_err();
    assert!(
        error.contains("field `t`: expected ns from the start of the sweep") && error.contains("found -5"),
        "{error}"
    );
}
