//! Motion sensors and covariances of poses go on to the log.

use std::path::{Path, PathBuf};

use realo_logs::motion::{decode_fix, decode_imu, decode_wheels};
use realo_logs::{Entry, Log, MapOrigin, Stream, describe_any};

use super::import;
use super::wire::{Recorded, odometry, recorded, transform};
use super::world::{BASE, MOUNTED, MS, SPEED, SWEEPS, T0, place, sweep};
use super::writers::ros1;

const ORIGIN: [f64; 3] = [48.1, 11.6, 500.0];
/// Messages of the recorder come so much later than what they measured, ns.
const LATE: i64 = 2 * MS;

fn imu(stamp: i64, gravity: f64) -> Recorded {
    recorded("/imu", "sensor_msgs/Imu", stamp + LATE, move |out| {
        out.header(stamp, "imu_link");
        out.f64s(&[0.0, 0.0, 0.0, 1.0]);
        out.f64s(&[0.0; 9]);
        // No two samples of a unit are equal, in either of its sensors.
        let drift = 1e-12 * (stamp - T0) as f64;
        out.f64s(&[0.01, -0.02, 0.03 + drift]);
        out.f64s(&[1e-6, 0.0, 0.0, 0.0, 2e-6, 0.0, 0.0, 0.0, 1e-6]);
        out.f64s(&[0.1, 0.2 + drift, gravity]);
        out.f64s(&[1e-4, 0.0, 0.0, 0.0, 1e-4, 0.0, 0.0, 0.0, 3e-4]);
    })
}

fn fix(stamp: i64) -> Recorded {
    let [x, y, z, _] = place(0.0, stamp);
    let geodetic = MapOrigin::new(ORIGIN).unwrap().from_map([x, y, z + 1.5]);
    recorded("/gps/fix", "sensor_msgs/NavSatFix", stamp + LATE, move |out| {
        out.header(stamp, "gps");
        out.u8(2);
        out.u16(1);
        out.f64s(&geodetic);
        out.f64s(&[0.01, 0.0, 0.0, 0.0, 0.01, 0.0, 0.0, 0.0, 0.04]);
        out.u8(2);
    })
}

fn wheels(stamp: i64) -> Recorded {
    recorded(
        "/vehicle/wheel_speed",
        "geometry_msgs/TwistStamped",
        stamp + LATE,
        move |out| {
            out.header(stamp, "rear_axle");
            out.f64s(&[SPEED, 0.0, 0.0, 0.0, 0.0, 0.0]);
        },
    )
}

fn posed(stamp: i64) -> Recorded {
    let mut covariance = [0.0; 36];
    for (axis, variance) in [0.04, 0.01, 0.09, 1e-4, 2e-4, 4e-4].into_iter().enumerate() {
        covariance[7 * axis] = variance;
    }
    recorded(
        "/pose",
        "geometry_msgs/PoseWithCovarianceStamped",
        stamp + LATE,
        move |out| {
            out.header(stamp, "map");
            out.f64s(&super::wire::seven(place(0.0, stamp)));
            out.f64s(&covariance);
        },
    )
}

struct Made {
    dir: tempfile::TempDir,
}

impl Made {
    fn new(gravity: f64) -> Self {
        let dir = tempfile::tempdir().unwrap();
        let fixed = |child: &'static str, at: [f64; 4]| transform("/tf_static", T0, T0, ["base_link", child], at);
        let mut messages = vec![
            fixed("velodyne", [1.0, 0.0, MOUNTED, 0.0]),
            fixed("imu_link", [0.2, -0.1, 0.5, 0.0]),
            fixed("gps", [0.0, 0.0, 1.5, 0.0]),
        ];
        for k in 0..SWEEPS {
            let stamp = T0 + k * 100 * MS;
            messages.push(sweep("/velodyne_points", stamp + 95 * MS, stamp, "velodyne"));
        }
        for k in 0..SWEEPS * 10 {
            let stamp = T0 + k * 10 * MS;
            messages.extend([imu(stamp, gravity), posed(stamp)]);
            if k % 10 == 0 {
                messages.extend([fix(stamp), wheels(stamp)]);
            }
        }
        messages.push(odometry("/odom", T0, T0, ["map", "base_link"], place(0.0, T0)));
        messages.sort_by_key(|message| message.log_time);
        ros1(&dir.path().join("some.bag"), &messages, "lz4");
        Made { dir }
    }

    fn import(&self, more: &str) -> Result<(PathBuf, String), String> {
        let log = self.dir.path().join("log.mcap");
        let map = format!(
            "agents:\n  car:\n    clouds: /velodyne_points\n    frame: base_link\n    height: {BASE}\n    pose: /pose\n    imu: /imu\n{more}"
        );
        let summary =
            import(&[self.dir.path().join("some.bag")], Some(&map), &log).map_err(|error| error.to_string())?;
        Ok((log, summary.to_string()))
    }
}

/// Messages of a stream, with what is asked of each.
fn each<T>(log: &Path, stream: Stream, of: impl Fn(&Entry) -> T) -> Vec<T> {
    let log = Log::open(log).unwrap();
    let mut reader = log.read_all(&[("car", stream)]).unwrap();
    let mut found = Vec::new();
    while let Some(entry) = reader.next().unwrap() {
        found.push(of(&entry));
    }
    found
}

#[test]
fn sensors_go_on_with_their_places_times_and_noise() {
    let made = Made::new(9.81);
    let (log, said) = made.import(&format!(
        "    fix: /gps/fix\n    wheels: /vehicle/wheel_speed\n    mounts: {{rear_axle: [-0.4, 0, 0, 0, 0, 0]}}\nmap_origin: {ORIGIN:?}\n"
    ))
    .unwrap();
    let sensors = format!(
        "motion sensors: {} samples of the inertial unit, {SWEEPS} positions, {SWEEPS} speeds of the wheels",
        SWEEPS * 10
    );
    assert!(said.contains(&sensors), "{said}");
    let samples = each(&log, Stream::Imu, |entry| {
        (
            entry.stamp(),
            entry.ready(),
            decode_imu(entry.data()).unwrap().1,
            entry.mount().unwrap(),
        )
    });
    let (stamp, ready, reading, mount) = &samples[7];
    assert_eq!((*stamp, *ready), (T0 + 70 * MS, T0 + 70 * MS + LATE));
    let [roll, pitch, yaw] = reading.angular_rate;
    let [forward, left, up] = reading.specific_force;
    assert_eq!((roll, pitch, forward, up), (0.01, -0.02, 0.1, 9.81));
    assert!(
        (yaw - 0.03 - 7e-5).abs() < 1e-15 && (left - 0.2 - 7e-5).abs() < 1e-15,
        "{yaw}, {left}"
    );
    assert_eq!(reading.variance, Some([2e-6, 3e-4]));
    let at = mount.translation.vector;
    assert!(
        (at.x - 0.2).abs() < 1e-12 && (at.y + 0.1).abs() < 1e-12 && (at.z - 0.5 - BASE).abs() < 1e-12,
        "{at}"
    );
    let fixes = each(&log, Stream::Fix, |entry| {
        (
            decode_fix(entry.data()).unwrap().1,
            entry.mount().unwrap().translation.z,
        )
    });
    let (reading, height) = &fixes[3];
    let map = MapOrigin::new(ORIGIN).unwrap().to_map(reading.geodetic);
    let [x, y, ..] = place(0.0, T0 + 300 * MS);
    assert!((map[0] - x).abs() < 1e-6 && (map[1] - y).abs() < 1e-6 && (height - 1.5 - BASE).abs() < 1e-12);
    assert_eq!(reading.covariance.unwrap()[8], 0.04);
    let speeds = each(&log, Stream::Wheels, |entry| {
        (
            decode_wheels(entry.data()).unwrap().1,
            entry.mount().unwrap().translation.x,
        )
    });
    assert_eq!(
        (speeds[0].0.velocity[0], speeds[0].0.variance, speeds[0].1),
        (SPEED, None, -0.4)
    );
    assert_eq!(Log::open(&log).unwrap().info().map_origin, Some(ORIGIN));
    let described = describe_any(&log).unwrap();
    assert!(!described.has_problems(), "{:?}", described.problems());
}

#[test]
fn poses_keep_their_covariances() {
    let made = Made::new(9.81);
    let (log, said) = made.import("").unwrap();
    assert!(said.contains("with a covariance"), "{said}");
    let poses = each(&log, Stream::Pose, |entry| entry.pose().unwrap());
    for pose in &poses {
        let covariance = pose.covariance.as_ref().unwrap();
        for (axis, variance) in [0.04, 0.01, 0.09, 1e-4, 2e-4, 4e-4].into_iter().enumerate() {
            assert!((covariance[7 * axis] - variance).abs() < 1e-12, "{axis}");
        }
    }
    assert!(poses.len() >= 100);
}

#[test]
fn a_unit_without_gravity_gives_its_attitude_alone() {
    let made = Made::new(9.81);
    let (log, said) = made.import("").unwrap();
    assert!(Log::open(&log).unwrap().has("car", Stream::Imu), "{said}");
    let still = Made {
        dir: tempfile::tempdir().unwrap(),
    };
    // Many drivers leave what a unit does not measure at 0.
    let zeros = |stamp: i64| {
        recorded("/imu", "sensor_msgs/Imu", stamp, move |out| {
            out.header(stamp, "imu_link");
            out.f64s(&[0.0, 0.0, 0.0, 1.0]);
            out.f64s(&[0.0; 9 + 3 + 9 + 3 + 9]);
        })
    };
    let mut messages: Vec<Recorded> = (0..SWEEPS * 10)
        .flat_map(|k| [zeros(T0 + k * 10 * MS), posed(T0 + k * 10 * MS)])
        .collect();
    messages.push(transform(
        "/tf_static",
        T0,
        T0,
        ["base_link", "velodyne"],
        [1.0, 0.0, MOUNTED, 0.0],
    ));
    messages.extend((0..SWEEPS).map(|k| {
        sweep(
            "/velodyne_points",
            T0 + k * 100 * MS + 95 * MS,
            T0 + k * 100 * MS,
            "velodyne",
        )
    }));
    messages.sort_by_key(|message| message.log_time);
    ros1(&still.dir.path().join("some.bag"), &messages, "lz4");
    let (log, said) = still.import("").unwrap();
    assert!(
        !Log::open(&log).unwrap().has("car", Stream::Imu) && !said.contains("left out"),
        "{said}"
    );
}

#[test]
fn positions_need_the_origin_of_the_world_and_sensors_a_place() {
    let made = Made::new(9.81);
    let error = made.import("    fix: /gps/fix\n").unwrap_err();
    assert!(
        error.contains("agents.car.fix: expected `map_origin: [latitude, longitude, height]`"),
        "{error}"
    );
    let (log, said) = made.import("    wheels: /vehicle/wheel_speed\n").unwrap();
    assert!(
        said.contains("left out: 1 × /vehicle/wheel_speed: its sensor is nowhere: its frame is `rear_axle`"),
        "{said}"
    );
    assert!(!Log::open(&log).unwrap().has("car", Stream::Wheels));
}
