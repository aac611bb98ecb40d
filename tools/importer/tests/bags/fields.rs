//! Fields of clouds as drivers have them: times of every sort, organised, padded, big endian, with directions without a return.

use super::wire::{Cloud, Field, Wire, cloud, pose_stamped};
use super::world::{MS, T0};
use super::writers::{mcap, ros1};
use super::{import, played};

const MAP: &str = "agents:\n  car:\n    clouds: /points\n    frame: lidar\n    height: 0\n    pose: /pose\n";
const COUNT: usize = 200;
const ROWS: usize = 4;
const UINT32: u8 = 6;
const FLOAT32: u8 = 7;
const FLOAT64: u8 = 8;

/// Bytes of a number as a field has them.
fn number(datatype: u8, value: f64, big_endian: bool) -> Vec<u8> {
    let mut bytes: Vec<u8> = match datatype {
        UINT32 => (value as u32).to_le_bytes().into(),
        FLOAT32 => (value as f32).to_le_bytes().into(),
        _ => value.to_le_bytes().into(),
    };
    if big_endian {
        bytes.reverse();
    }
    bytes
}

/// A sweep whose points' times are 0 to 80 ms after the stamp, in one field; the last point is no return.
fn one(stamp: i64, time: (&'static str, u8), write: fn(i64, f64) -> f64, big_endian: bool) -> Cloud {
    let (name, datatype) = time;
    let fields: Vec<Field> = vec![
        (name, 0, datatype),
        ("z", 8, FLOAT32),
        ("x", 14, FLOAT32),
        ("y", 20, FLOAT32),
    ];
    let point = |k: usize| {
        let after = 80e6 * k as f64 / COUNT as f64;
        let place = if k == COUNT - 1 {
            [f64::NAN; 3]
        } else {
            [k as f64, 1.0, 2.0]
        };
        let mut bytes = vec![0xaa; 26];
        let mut put = |at: usize, datatype, value| {
            let number = number(datatype, value, big_endian);
            bytes[at..at + number.len()].copy_from_slice(&number);
        };
        put(0, datatype, write(stamp, after));
        put(8, FLOAT32, place[2]);
        put(14, FLOAT32, place[0]);
        put(20, FLOAT32, place[1]);
        bytes
    };
    let row = |row: usize| (row * COUNT / ROWS..(row + 1) * COUNT / ROWS).flat_map(point).collect();
    Cloud {
        fields,
        step: 26,
        rows: (0..ROWS).map(row).collect(),
        row_step: (26 * COUNT / ROWS + 6) as u32,
        big_endian,
    }
}

#[test]
fn times_of_all_drivers_are_offsets_from_the_stamp() {
    type Write = fn(i64, f64) -> f64;
    let cases: [(&'static str, u8, Write); 8] = [
        ("timestamp", FLOAT64, |stamp, after| (stamp as f64 + after) / 1e9),
        ("time_stamp", FLOAT64, |_, after| after / 1e9),
        ("offset_time", UINT32, |_, after| after),
        ("t", UINT32, |_, after| after),
        ("time", FLOAT32, |_, after| after / 1e9),
        ("t", UINT32, |_, after| after / 1e3),
        ("timestamp", FLOAT64, |stamp, after| stamp as f64 + after),
        ("time", FLOAT32, |_, after| after / 1e6),
    ];
    let dir = tempfile::tempdir().unwrap();
    for (name, datatype, write) in cases {
        for (wire, big_endian) in [(Wire::Ros1, false), (Wire::Little, true), (Wire::Big, false)] {
            let mut messages = vec![pose_stamped("/pose", T0, T0, "map", [0.0; 4])];
            for k in 0..3 {
                let stamp = T0 + k * 100 * MS;
                messages.push(pose_stamped("/pose", stamp, stamp + MS, "map", [0.0; 4]));
                messages.push(cloud(
                    "/points",
                    stamp + 90 * MS,
                    stamp,
                    "lidar",
                    one(stamp, (name, datatype), write, big_endian),
                ));
            }
            let bag = dir
                .path()
                .join(if wire == Wire::Ros1 { "some.bag" } else { "some.mcap" });
            match wire {
                Wire::Ros1 => ros1(&bag, &messages, "lz4"),
                _ => mcap(&bag, &messages, wire),
            }
            let log = dir.path().join("log.mcap");
            import(&[bag], Some(MAP), &log).unwrap();
            let (stamp, _, cloud) = &played(&log, "car").clouds[1];
            assert_eq!((*stamp, cloud.len()), (T0 + 100 * MS, COUNT), "{name}");
            for k in 0..COUNT - 1 {
                let after = 80e6 * k as f64 / COUNT as f64;
                assert!(
                    (f64::from(cloud.time[k]) - after).abs() <= 1001.0,
                    "{name} {datatype}: {} for {after}",
                    cloud.time[k]
                );
                assert_eq!([cloud.x[k], cloud.y[k], cloud.z[k]], [k as f32, 1.0, 2.0]);
            }
            assert!(cloud.x[COUNT - 1].is_nan(), "a direction without a return stays one");
        }
    }
}

#[test]
fn log_times_count_where_the_map_file_says_so() {
    let dir = tempfile::tempdir().unwrap();
    let mut messages = Vec::new();
    for k in 0..3 {
        let time = T0 + k * 100 * MS;
        // Stamps since the start of the sensor.
        messages.push(pose_stamped("/pose", time, 5_000 * MS + k * 100 * MS, "map", [0.0; 4]));
        let points = one(0, ("time", FLOAT32), |_, after| after / 1e9, false);
        messages.push(cloud("/points", time + MS, 5_000 * MS + k * 100 * MS, "lidar", points));
    }
    let bag = dir.path().join("some.bag");
    ros1(&bag, &messages, "none");
    let log = dir.path().join("log.mcap");
    let map = format!("clock: log\n{MAP}");
    import(std::slice::from_ref(&bag), Some(&map), &log).unwrap();
    assert_eq!(played(&log, "car").clouds[2].0, T0 + 201 * MS);
    import(&[bag], Some(MAP), &log).unwrap();
    let clouds = played(&log, "car").clouds;
    assert_eq!(clouds[2].0, 5_200 * MS, "else the stamps count");
    assert!(
        clouds
            .iter()
            .all(|(stamp, ready, _)| *ready >= stamp + 79 * MS && *ready <= stamp + 90 * MS),
        "log times are brought to their clock"
    );
}
