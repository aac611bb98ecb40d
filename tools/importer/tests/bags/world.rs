//! What the made-up bags hold: vehicles that drive along x over flat ground, with a car that stands still and one that moves.

use realo_schemas::Nanos;

use super::wire::{Cloud, Field, Object, Recorded, cloud, detections, odometry, transform};

pub const T0: Nanos = 1_700_000_000_000_000_000;
pub const MS: Nanos = 1_000_000;
/// Sweeps of a recording.
pub const SWEEPS: i64 = 12;
/// Height of the LiDAR over `base_link`, and of that over the ground, m.
pub const MOUNTED: f64 = 1.6;
pub const BASE: f64 = 0.3;
/// Speed of the vehicle, m/s.
pub const SPEED: f64 = 5.0;

const FLOAT32: u8 = 7;
const FLOAT64: u8 = 8;
const UINT16: u8 = 4;

/// Where the vehicle is in the map.
pub fn place(start: f64, stamp: Nanos) -> [f64; 4] {
    [start + SPEED * (stamp - T0) as f64 / 1e9, 2.0, BASE, 0.0]
}

/// Points of the ground and of a wall, in the LiDAR's frame.
pub fn points() -> Vec<[f32; 3]> {
    let ground =
        (0..40).flat_map(|i| (0..40).map(move |k| [i as f32 - 20.0, k as f32 - 20.0, -(MOUNTED + BASE) as f32]));
    ground.chain((0..100).map(|i| [15.0, 0.1 * i as f32, 0.5])).collect()
}

/// Fields as Hesai's driver has them, with doubles of absolute time.
pub fn sweep(topic: &'static str, log_time: Nanos, stamp: Nanos, frame: &'static str) -> Recorded {
    sweep_with(topic, [log_time, stamp], frame, points())
}

/// The same of other points.
pub fn sweep_with(
    topic: &'static str,
    [log_time, stamp]: [Nanos; 2],
    frame: &'static str,
    points: Vec<[f32; 3]>,
) -> Recorded {
    let fields: Vec<Field> = vec![
        ("x", 0, FLOAT32),
        ("y", 4, FLOAT32),
        ("z", 8, FLOAT32),
        ("intensity", 12, FLOAT32),
        ("ring", 16, UINT16),
        ("timestamp", 18, FLOAT64),
    ];
    let count = points.len() as f64;
    let row = points.into_iter().enumerate().flat_map(|(k, point)| {
        let time = (stamp as f64 + 90e6 * k as f64 / count) / 1e9;
        let mut bytes: Vec<u8> = point.iter().flat_map(|v| v.to_le_bytes()).collect();
        bytes.extend(((k % 100) as f32).to_le_bytes());
        bytes.extend(((k % 32) as u16).to_le_bytes());
        bytes.extend(time.to_le_bytes());
        bytes
    });
    let rows = vec![row.collect::<Vec<u8>>()];
    let row_step = rows[0].len() as u32;
    cloud(
        topic,
        log_time,
        stamp,
        frame,
        Cloud {
            fields,
            step: 26,
            rows,
            row_step,
            big_endian: false,
        },
    )
}

/// Names of the topics and frames of a vehicle.
#[derive(Clone, Copy)]
pub struct Names {
    pub points: &'static str,
    pub odom: &'static str,
    pub truth: Option<&'static str>,
}

pub const PLAIN: Names = Names {
    points: "/velodyne_points",
    odom: "/odom",
    truth: Some("/ground_truth"),
};

/// Objects in the map at a time.
pub fn objects(stamp: Nanos) -> Vec<Object> {
    let x = 30.0 + 8.0 * (stamp - T0) as f64 / 1e9;
    vec![
        ("Car", "7", [15.0, 5.0, 1.0, 0.5], [4.5, 1.8, 1.5]),
        ("Car", "8", [x, -3.0, 1.0, 0.0], [4.2, 1.7, 1.6]),
    ]
}

/// A recording; `late`: how far its clock is behind, for stamps and log times.
pub fn recording(names: Names, start: f64, late: Nanos) -> Vec<Recorded> {
    let mut messages = vec![transform(
        "/tf_static",
        T0 - late,
        T0 - late,
        ["base_link", "velodyne"],
        [1.0, 0.0, MOUNTED, 0.0],
    )];
    for step in 0..(5 * SWEEPS) {
        let stamp = T0 + step * 20 * MS;
        messages.push(odometry(
            names.odom,
            stamp + MS - late,
            stamp - late,
            ["map", "base_link"],
            place(start, stamp),
        ));
        if step % 5 == 0 {
            messages.push(sweep(names.points, stamp + 95 * MS - late, stamp - late, "velodyne"));
        }
        if let (Some(truth), true) = (names.truth, step % 5 == 2) {
            // Truth is of other times than the sweeps, and each second one is missing.
            messages.push(detections(
                truth,
                stamp + 3 * MS - late,
                stamp - late,
                "map",
                objects(stamp),
            ));
        }
    }
    messages.sort_by_key(|message| message.log_time);
    messages
}
