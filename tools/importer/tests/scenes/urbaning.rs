//! UrbanIng-V2X: arrays of several LiDARs, states of vehicles, a table of true times, and tracks in seconds.

use std::fs;
use std::path::PathBuf;

use nalgebra::{Matrix4, Point3, Vector3};
use realo_importer::look_at;
use realo_logs::AgentKind;
use serde_json::{Value, json};
use zip::CompressionMethod;

use crate::AGENTS;
use crate::layouts::write;
use crate::numpy::{doubles, npy, npz};
use crate::reading::{import, read};
use crate::round_trip::edit;
use crate::world::{Agent, CARS, ON_A_CAR, matrix};

const SEQUENCE: &str = "20241126_0008_crossing1_00";
const START_MS: i64 = 1_732_610_000_000;
const FRAMES: i64 = 3;
/// True times are so much later than those of the names, ms.
const LATE_MS: i64 = 20;
const MIDDLE: &str = "vehicle1_middle_lidar";
const LEFT: &str = "vehicle1_left_lidar";
const CROSSING: &str = "crossing1_11_lidar";

struct Made {
    dir: tempfile::TempDir,
    has_table: bool,
}

/// A vehicle that drives straight on: its body and its LiDAR at a time.
fn vehicle(ms: i64) -> Matrix4<f64> {
    let Agent { step, .. } = AGENTS[0];
    let [x, y] = step.map(|step| step * (ms - START_MS) as f64 / 100.0);
    matrix([x, y, 0.3, 0.0, 20.0, 0.0])
}

fn mount(sensor: &str) -> Matrix4<f64> {
    match sensor {
        LEFT => matrix([0.4, 0.9, 1.5, 1.0, 85.0, -3.0]),
        MIDDLE => matrix([1.1, 0.0, 1.6, 0.5, 2.0, -1.0]),
        _ => matrix(AGENTS[2].at(0)),
    }
}

fn rows(matrix: &Matrix4<f64>) -> Value {
    let rows: Vec<Vec<f64>> = (0..4).map(|row| matrix.row(row).iter().copied().collect()).collect();
    json!(rows)
}

/// Where a LiDAR is at a time.
fn lidar(sensor: &str, ms: i64) -> Matrix4<f64> {
    match sensor {
        CROSSING => mount(sensor),
        _ => vehicle(ms) * mount(sensor),
    }
}

/// What a LiDAR sees: each of a vehicle half of the points.
fn sees(sensor: &str) -> Vec<Point3<f64>> {
    let (agent, number) = if sensor == CROSSING {
        (AGENTS[2], 2)
    } else {
        (AGENTS[0], 0)
    };
    let all = agent.sees(0, number);
    match sensor {
        MIDDLE => all.into_iter().step_by(2).collect(),
        LEFT => all.into_iter().skip(1).step_by(2).collect(),
        _ => all,
    }
}

/// A cloud whose points are measured one a ms, again from the start after 100.
fn archive(points: &[Point3<f64>]) -> Vec<u8> {
    let count = format!("{},", points.len());
    let axis = |of: fn(&Point3<f64>) -> f64| {
        let bytes = points
            .iter()
            .flat_map(|point| (of(point) as f32).to_le_bytes())
            .collect::<Vec<u8>>();
        npy("<f4", &count, &bytes)
    };
    let bytes = vec![200_u8; points.len()];
    let offsets: Vec<f64> = (0..points.len()).map(|index| (index % 100) as f64).collect();
    let arrays = [
        ("x", axis(|point| point.x)),
        ("y", axis(|point| point.y)),
        ("z", axis(|point| point.z)),
        ("intensity", npy("|u1", &count, &bytes)),
        ("time_offset_ms", npy("<f8", &count, &doubles(&offsets))),
    ];
    npz(&arrays, CompressionMethod::Deflated)
}

impl Made {
    fn new(has_table: bool) -> Self {
        let made = Made {
            dir: tempfile::tempdir().unwrap(),
            has_table,
        };
        let mut table = format!("frame,{MIDDLE},{CROSSING}\n");
        for frame in 0..FRAMES {
            let ms = START_MS + 100 * frame;
            table += &format!("{ms},{},{}\n", ms + LATE_MS, ms + LATE_MS);
            for (sensor, aside) in [(MIDDLE, 0), (LEFT, 3), (CROSSING, 7)] {
                // Names of a frame differ from sensor to sensor; the table names the frame of the first.
                let ms = if has_table && sensor == CROSSING {
                    ms
                } else {
                    ms + if sensor == MIDDLE { 0 } else { aside }
                };
                write(
                    &made.sequence().join(format!("{sensor}/{ms}.npz")),
                    &made.cloud(sensor, made.time(sensor, ms)),
                );
            }
        }
        for ms in (START_MS - 100..START_MS + 500).step_by(50) {
            let state = json!({"pose": {"transformation": rows(&vehicle(ms))}, "velocity": [1.0, 2.0, 0.0]});
            write(
                &made.sequence().join(format!("vehicle1_state/{ms}.json")),
                state.to_string().as_bytes(),
            );
        }
        if has_table {
            write(&made.sequence().join("timesync_info.csv"), table.as_bytes());
        }
        let sensor = |name: &str| json!({"extrinsics": {"matrix": rows(&mount(name))}, "model": "made up"});
        let calibration = json!({"lidars": {MIDDLE: sensor(MIDDLE), LEFT: sensor(LEFT), CROSSING: sensor(CROSSING)}});
        write(
            &made.data().join("calibration.json"),
            calibration.to_string().as_bytes(),
        );
        write(
            &made.data().join(format!("labels/{SEQUENCE}.json")),
            tracks().to_string().as_bytes(),
        );
        made
    }

    fn data(&self) -> PathBuf {
        self.dir.path().join("data")
    }

    fn sequence(&self) -> PathBuf {
        self.data().join("dataset").join(SEQUENCE)
    }

    fn out(&self) -> PathBuf {
        self.dir.path().join("out.mcap")
    }

    /// The true time of a cloud of this name, ms.
    fn time(&self, sensor: &str, ms: i64) -> i64 {
        match sensor {
            // The second LiDAR of a vehicle is in the sweep of the first.
            LEFT => self.time(MIDDLE, ms - 3),
            _ if self.has_table => ms + LATE_MS,
            _ => ms,
        }
    }

    fn cloud(&self, sensor: &str, ms: i64) -> Vec<u8> {
        let lidar_from_map = lidar(sensor, ms).try_inverse().unwrap();
        let points: Vec<Point3<f64>> = sees(sensor)
            .iter()
            .map(|point| lidar_from_map.transform_point(point))
            .collect();
        archive(&points)
    }

    fn import(&self, set: &[(&str, &str)]) -> Result<realo_importer::SceneSummary, String> {
        Ok(import("urbaning", &self.data(), &self.out(), set)?.remove(0))
    }

    fn check(&self) {
        let (log, found) = read(&self.out());
        let kinds: Vec<AgentKind> = log.info().agents.iter().map(|agent| agent.kind).collect();
        assert_eq!(kinds, [AgentKind::Vehicle, AgentKind::Roadside]);
        assert_eq!(found.len(), 2 * FRAMES as usize);
        for (name, sensors) in [
            ("cav_vehicle1", &[LEFT, MIDDLE][..]),
            ("rsu_crossing1_11_lidar", &[CROSSING][..]),
        ] {
            for frame in 0..FRAMES {
                let ms = START_MS + 100 * frame + if self.has_table { LATE_MS } else { self.aside(name) };
                let read = &found[&(name.to_string(), ms * 1_000_000)];
                let expected: Vec<Point3<f64>> = sensors.iter().flat_map(|sensor| sees(sensor)).collect();
                let there = read.in_map();
                assert_eq!(there.len(), expected.len());
                let off = there
                    .iter()
                    .zip(&expected)
                    .map(|(a, b)| (a - b).norm())
                    .fold(0.0, f64::max);
                assert!(off < 2e-4, "{name}: points are {off} m apart");
                let cloud = read.cloud.as_ref().unwrap();
                assert_eq!(
                    (cloud.intensity[5], cloud.time[5], cloud.time[199]),
                    (200, 5_000_000, 99_000_000)
                );
                for (center, heading, object) in read.boxes_in_map(&read.truth) {
                    let car = CARS.iter().find(|car| Some(car.id) == object.track).unwrap();
                    let apart = (Point3::from(center) - Point3::from(car.center) - moved(ms)).norm();
                    let turned = (heading - car.yaw + 540.0).rem_euclid(360.0) - 180.0;
                    assert!(apart < 1e-3 && turned.abs() < 0.05, "{}: {apart} m, {turned}°", car.id);
                    assert_eq!(
                        ([object.length, object.width, object.height], &*object.class),
                        (car.size, "Car")
                    );
                }
                assert_eq!(read.truth.len(), CARS.len());
                assert!(
                    read.truth_points.iter().all(|points| *points >= ON_A_CAR / 2),
                    "{:?}",
                    read.truth_points
                );
            }
        }
    }

    /// Where no table says it, sensors have their names' times; the first LiDAR by name is the vehicle's left one.
    fn aside(&self, name: &str) -> i64 {
        if name.starts_with("cav") { 3 } else { 7 }
    }
}

/// How far objects are from where they were: all rise by 1 mm in 100 ms, so that it matters when they are looked at.
fn moved(ms: i64) -> Vector3<f64> {
    Vector3::new(0.0, 0.0, 1e-5 * (ms - START_MS) as f64)
}

/// Tracks with places each 200 ms.
fn tracks() -> Value {
    let track = |car: &crate::world::Car| {
        let times: Vec<i64> = (-2..4).map(|step| START_MS + 200 * step).collect();
        let seconds: Vec<f64> = times.iter().map(|ms| *ms as f64 / 1000.0).collect();
        let place = |ms: &i64| {
            let place = Point3::from(car.center) + moved(*ms);
            [place.x, place.y, place.z]
        };
        let places: Vec<[f64; 3]> = times.iter().map(place).collect();
        // Headings may jump by whole turns.
        let yaws: Vec<f64> = (0..times.len())
            .map(|i| car.yaw.to_radians() + if i % 2 == 0 { 0.0 } else { std::f64::consts::TAU })
            .collect();
        let id = if car.id == 11 { json!("11") } else { json!(car.id) };
        json!({"track_id": id, "object_type": "Car", "timestamps": seconds, "positions": places, "orientations": yaws, "dimensions": car.size})
    };
    json!({"tracks": CARS.iter().map(track).collect::<Vec<_>>()})
}

#[test]
fn points_of_several_lidars_true_times_and_tracks_come_back() {
    let made = Made::new(true);
    // The table has no times of the left LiDAR: it is in the sweep of the middle one, which is made the first by name here.
    fs::rename(made.sequence().join(LEFT), made.sequence().join("vehicle1_z_lidar")).unwrap();
    edit(&made.data().join("calibration.json"), |text| {
        text.replace(LEFT, "vehicle1_z_lidar")
    });
    let summary = made.import(&[]).unwrap();
    assert_eq!((summary.frames, summary.incomplete_frames), (3, 0), "{summary}");
    let (_, found) = read(&made.out());
    let at = (START_MS + LATE_MS) * 1_000_000;
    let first = &found[&("cav_vehicle1".to_string(), at)];
    assert_eq!(
        first.cloud.as_ref().unwrap().len(),
        sees(MIDDLE).len() + sees(LEFT).len()
    );
    let expected: Vec<Point3<f64>> = [MIDDLE, LEFT].iter().flat_map(|sensor| sees(sensor)).collect();
    let off = first
        .in_map()
        .iter()
        .zip(&expected)
        .map(|(a, b)| (a - b).norm())
        .fold(0.0, f64::max);
    assert!(off < 2e-4, "points are {off} m apart");
    for object in &first.truth {
        let car = CARS.iter().find(|car| Some(car.id) == object.track).unwrap();
        let there = realo_schemas::geometry::transform_box(&first.map_from_body, object).center;
        assert!(
            (there[2] - car.center[2] - moved(START_MS + LATE_MS).z).abs() < 1e-6,
            "{there:?}"
        );
    }
    let said = summary.to_string();
    for line in [
        "(--times)",
        "(--box-z)",
        "(--pose-direction)",
        "stamps: those of the data set; a stamp is the start of its sweep",
    ] {
        assert!(said.contains(line), "{line} is not in\n{said}");
    }
    let seen = look_at(&made.data());
    assert_eq!(
        seen.only(&made.data())
            .unwrap_or_else(|error| panic!("{error}"))
            .kind()
            .name,
        "urbaning",
        "{seen}"
    );
}

#[test]
fn without_a_table_the_names_are_the_times() {
    let made = Made::new(false);
    // Without a table the left LiDAR, which is the first by name, has the time of its own name.
    for frame in 0..FRAMES {
        let ms = START_MS + 100 * frame;
        for (sensor, name) in [(LEFT, ms + 3), (MIDDLE, ms)] {
            fs::write(
                made.sequence().join(format!("{sensor}/{name}.npz")),
                made.cloud(sensor, ms + 3),
            )
            .unwrap();
        }
    }
    made.import(&[]).unwrap();
    made.check();
}

#[test]
fn what_is_missing_or_damaged_is_named() {
    let made = Made::new(true);
    let (labels, calibration) = (
        made.data().join(format!("labels/{SEQUENCE}.json")),
        made.data().join("calibration.json"),
    );
    let table = made.sequence().join("timesync_info.csv");
    for (file, from, to, named) in [
        (
            &calibration,
            LEFT,
            "vehicle9",
            "expected an entry `vehicle1_left_lidar` as the folder is called",
        ),
        (
            &calibration,
            "\"matrix\"",
            "\"other\":[[1,2,3,4],[1,2,3,4],[1,2,3,4],[0,0,0,1]],\"matrix\"",
            "choose with --pose-key KEY",
        ),
        (&table, ",", ";x;", "timesync_info.csv`: line 2"),
        (
            &labels,
            "\"orientations\":[",
            "\"orientations\":[0.5,",
            "track `11`: expected a position, an orientation and dimensions for each of 6 timestamps",
        ),
    ] {
        let text = fs::read_to_string(file).unwrap();
        edit(file, |text| match from {
            "," => text.replacen(",", ";x;", 4),
            _ => text.replace(from, to),
        });
        let error = made.import(&[]).unwrap_err();
        assert!(error.contains(named), "{named} is not in\n{error}");
        fs::write(file, text).unwrap();
    }
    made.import(&[("times", "names")]).unwrap();
    let first = made.sequence().join(format!("{CROSSING}/{START_MS}.npz"));
    let bytes = fs::read(&first).unwrap();
    fs::write(&first, &bytes[..bytes.len() / 2]).unwrap();
    let error = made.import(&[]).unwrap_err();
    assert!(error.contains("expected arrays as numpy.savez writes them"), "{error}");
    fs::write(&first, bytes).unwrap();
    fs::remove_file(&labels).unwrap();
    let error = made.import(&[]).unwrap_err();
    assert!(error.contains("no such file") && error.contains(SEQUENCE), "{error}");
    fs::remove_dir_all(made.sequence().join("vehicle1_state")).unwrap();
    fs::create_dir(made.sequence().join("vehicle1_state")).unwrap();
    let error = made.import(&[]).unwrap_err();
    assert!(error.contains("expected states, MS.json, found none"), "{error}");
}

/// Writes the cloud of a LiDAR as it measures: each point where the LiDAR is at the point's own time, which is `ms` and its offset.
fn write_moving(made: &Made, sensor: &str, name: i64, ms: i64) {
    let point = |(index, point): (usize, &Point3<f64>)| {
        let lidar_from_map = lidar(sensor, ms + index as i64 % 100).try_inverse().unwrap();
        lidar_from_map.transform_point(point)
    };
    let points: Vec<Point3<f64>> = sees(sensor).iter().enumerate().map(point).collect();
    write(&made.sequence().join(format!("{sensor}/{name}.npz")), &archive(&points));
}

/// Checks the first sweep of the vehicle: where its points were at their own times, and how much later its second LiDAR measured.
fn check_moving(made: &Made, stamp_ms: i64, later_ms: i64) {
    let (_, found) = read(&made.out());
    let sweep = &found[&("cav_vehicle1".to_string(), stamp_ms * 1_000_000)];
    let times = sweep.cloud.as_ref().unwrap().time.clone();
    let (there, first) = (sweep.in_map(), sees(LEFT).len());
    for (index, expected) in [LEFT, MIDDLE].iter().flat_map(|sensor| sees(sensor)).enumerate() {
        let (own, later) = if index < first {
            (index, 0)
        } else {
            (index - first, later_ms)
        };
        let time = own as i64 % 100 + later;
        assert_eq!(i64::from(times[index]), time * 1_000_000, "point {index}");
        let moved = vehicle(stamp_ms + time) * vehicle(stamp_ms).try_inverse().unwrap();
        let off = (moved.transform_point(&there[index]) - expected).norm();
        assert!(off < 2e-4, "point {index} is {off} m off");
    }
}

#[test]
fn points_of_a_second_lidar_keep_their_own_times() {
    let names = Made::new(false);
    let table = Made::new(true);
    let mut lines = format!("frame,{MIDDLE},{LEFT},{CROSSING}\n");
    for frame in 0..FRAMES {
        let ms = START_MS + 100 * frame;
        write_moving(&names, MIDDLE, ms, ms);
        write_moving(&names, LEFT, ms + 3, ms + 3);
        // By the table the left LiDAR, which is the first by name, measures 11 ms before the middle one; by their names 3 ms after.
        write_moving(&table, MIDDLE, ms, ms + 31);
        write_moving(&table, LEFT, ms + 3, ms + 20);
        lines += &format!("{ms},{},,{ms}\n{},,{},\n", ms + 31, ms + 3, ms + 20);
    }
    fs::write(table.sequence().join("timesync_info.csv"), lines).unwrap();
    names.import(&[]).unwrap();
    check_moving(&names, START_MS + 3, -3);
    let summary = table.import(&[]).unwrap();
    assert!(!summary.to_string().contains("does not have them"), "{summary}");
    check_moving(&table, START_MS + 20, 11);
}

#[test]
fn clouds_of_lidars_a_second_apart_are_not_one_sweep() {
    let made = Made::new(true);
    let lines = format!(
        "frame,{MIDDLE},{LEFT}\n{START_MS},{},\n{},,{START_MS}\n",
        START_MS + 1000,
        START_MS + 3
    );
    fs::write(made.sequence().join("timesync_info.csv"), lines).unwrap();
    let error = made.import(&[]).unwrap_err();
    assert!(
        error.contains("expected a cloud within 1000 ms of the first LiDAR's, found one 1000 ms later")
            && error.contains("--times names"),
        "{error}"
    );
}

#[test]
fn labels_are_those_of_the_file_at_each_import() {
    let made = Made::new(false);
    let classes = || made.import(&[]).unwrap().classes.into_keys().collect::<Vec<String>>();
    assert_eq!(classes(), ["Car"]);
    edit(&made.data().join(format!("labels/{SEQUENCE}.json")), |text| {
        text.replace("\"Car\"", "\"Van\"")
    });
    assert_eq!(classes(), ["Van"]);
}

#[test]
fn clouds_that_find_no_place_in_a_sweep_are_named() {
    type Change = fn(&Made);
    let at = |made: &Made, sensor: &str, ms: i64| made.sequence().join(format!("{sensor}/{ms}.npz"));
    let cases: [(Change, String, (&str, i64)); 3] = [
        (
            |made| fs::remove_file(made.sequence().join(format!("{LEFT}/{}.npz", START_MS + 3))).unwrap(),
            format!("1 × cloud at a frame of which `{LEFT}`, the first LiDAR of `vehicle1`, has none: it is left out"),
            (MIDDLE, START_MS),
        ),
        (
            |made| fs::remove_file(made.sequence().join(format!("{MIDDLE}/{START_MS}.npz"))).unwrap(),
            format!("1 × cloud at a frame of which `{MIDDLE}`, a LiDAR of the same agent, has none"),
            (LEFT, START_MS + 3),
        ),
        (
            |made| {
                let folder = made.sequence().join(MIDDLE);
                let [from, to] = [START_MS, START_MS + 20].map(|ms| folder.join(format!("{ms}.npz")));
                fs::copy(from, to).map(drop).unwrap();
            },
            "1 × second cloud of a LiDAR within 50 ms: only the first is read".into(),
            (MIDDLE, START_MS + 20),
        ),
    ];
    for (change, cause, (sensor, ms)) in cases {
        let made = Made::new(false);
        change(&made);
        let error = made.import(&[]).unwrap_err();
        let named = at(&made, sensor, ms).display().to_string();
        assert!(error.contains(&cause) && error.contains(&named), "{error}");
        made.import(&[("skip-incomplete", "")]).unwrap();
    }
}

#[test]
fn a_table_says_which_times_it_does_not_have_and_is_refused_without_any() {
    let made = Made::new(true);
    let summary = made.import(&[]).unwrap().to_string();
    let line = format!(
        "assumed: the times of 3 of 3 clouds of `{LEFT}` are those of their names: `timesync_info.csv` does not have them"
    );
    assert!(
        summary.contains(&line) && !summary.contains(&format!("clouds of `{MIDDLE}`")),
        "{summary}"
    );
    edit(&made.sequence().join("timesync_info.csv"), |text| {
        text.replace(MIDDLE, "lidar_1").replace(CROSSING, "lidar_2")
    });
    let error = made.import(&[]).unwrap_err();
    for words in [
        "timesync_info.csv`: expected columns",
        MIDDLE,
        "found columns `lidar_1`, `lidar_2`",
        "--times names",
    ] {
        assert!(error.contains(words), "{words} is not in\n{error}");
    }
    made.import(&[("times", "names")]).unwrap();
}

#[test]
fn a_key_of_poses_chooses_where_there_are_several_only() {
    let made = Made::new(true);
    edit(&made.data().join("calibration.json"), |text| {
        text.replace(
            "\"matrix\"",
            "\"other\":[[1,2,3,4],[1,2,3,4],[1,2,3,4],[0,0,0,1]],\"matrix\"",
        )
    });
    made.import(&[("pose-key", "matrix")]).unwrap();
    let error = made.import(&[("pose-key", "third")]).unwrap_err();
    assert!(
        error.contains("expected a 4×4 matrix under `third` (--pose-key), found"),
        "{error}"
    );
}
