//! Clocks of other epochs, sweeps of other times, and messages that bags of both versions of ROS recorded.

use std::path::{Path, PathBuf};

use realo_schemas::Nanos;

use super::wire::{Recorded, Wire, fix, imu, odometry, pose_stamped, recorded, transform};
use super::world::{BASE, MOUNTED, MS, Names, PLAIN, SWEEPS, T0, place, recording, sweep, sweep_with};
use super::writers::{mcap, ros1};
use super::{import, played};

const SECOND: Nanos = 1000 * MS;
/// What brings T0 to a clock that counts from the start of a computer, ns.
const UPTIME: Nanos = 120 * SECOND - T0;
/// Poses are recorded so long after their stamps, and sweeps after theirs, ns.
const POSES_LATE: Nanos = 5 * MS;
const SWEEPS_LATE: Nanos = 160 * MS;

/// A vehicle whose stamps are ahead of the recorder's clock.
#[derive(Clone, Copy)]
struct Car {
    ahead: Nanos,
    poses_late: Nanos,
    sweeps_late: Nanos,
    sweeps: Nanos,
    is_fixed: bool,
    /// Where it starts, m.
    start: f64,
}

const CAR: Car = Car {
    ahead: 0,
    poses_late: POSES_LATE,
    sweeps_late: SWEEPS_LATE,
    sweeps: SWEEPS,
    is_fixed: false,
    start: 0.0,
};

impl Car {
    fn messages(self) -> Vec<Recorded> {
        let mut messages = vec![transform(
            "/tf_static",
            T0,
            T0 + self.ahead,
            ["base_link", "velodyne"],
            [1.0, 0.0, MOUNTED, 0.0],
        )];
        let points = [[10.0, 0.0, -1.0], [0.0, 10.0, -1.0], [0.0, -10.0, -1.0]];
        for k in 0..self.sweeps {
            let at = T0 + k * 100 * MS;
            let times = [at + self.sweeps_late, at + self.ahead];
            messages.push(sweep_with("/velodyne_points", times, "velodyne", points.to_vec()));
        }
        for k in (0..5 * self.sweeps).filter(|_| !self.is_fixed) {
            let at = T0 + k * 20 * MS;
            let names = ["map", "base_link"];
            messages.push(odometry(
                "/odom",
                at + self.poses_late,
                at + self.ahead,
                names,
                place(self.start, at),
            ));
        }
        messages.sort_by_key(|message| message.log_time);
        messages
    }

    fn map(self, name: &str) -> String {
        let pose = if self.is_fixed { "[0, 0, 0, 0]" } else { "/odom" };
        agent(name, pose)
    }
}

fn agent(name: &str, pose: &str) -> String {
    format!(
        "  {name}:\n    bag: {name}.bag\n    clouds: /velodyne_points\n    frame: base_link\n    height: {BASE}\n    pose: {pose}\n"
    )
}

/// First stamp and delay of the first sweep of two cars, and what the import said.
fn joined(cars: [Car; 2]) -> ([[Nanos; 2]; 2], String) {
    let dir = tempfile::tempdir().unwrap();
    let paths = ["a.bag", "b.bag"].map(|name| dir.path().join(name));
    for (path, car) in paths.iter().zip(cars) {
        ros1(path, &car.messages(), "none");
    }
    let map = format!("agents:\n{}{}", cars[0].map("a"), cars[1].map("b"));
    let log = dir.path().join("log.mcap");
    let summary = import(&paths, Some(&map), &log).unwrap();
    let first = |agent: &str| {
        let (stamp, ready, _) = played(&log, agent).clouds[0];
        [stamp, ready - stamp]
    };
    (["a", "b"].map(first), summary.to_string())
}

#[test]
fn clocks_of_a_known_kind_are_moved_by_whole_seconds() {
    for (ahead, kind) in [
        (
            18 * SECOND,
            "-18.000 s, because its clock looks like GPS time against UTC",
        ),
        (37 * SECOND, "-37.000 s, because its clock looks like TAI against UTC"),
    ] {
        // The second car's messages take 7 ms longer, and that of its sweeps is no reason to move them.
        let other = Car {
            ahead,
            poses_late: POSES_LATE + 7 * MS,
            sweeps_late: SWEEPS_LATE + 7 * MS,
            ..CAR
        };
        let ([a, b], said) = joined([CAR, other]);
        assert_eq!((a, b), ([T0, SWEEPS_LATE], [T0, SWEEPS_LATE + 7 * MS]), "{said}");
        assert!(
            said.contains(kind) && said.contains("± 5 ms by log times of the poses"),
            "{said}"
        );
    }
}

#[test]
fn a_clock_of_gps_time_is_moved_where_sweeps_overlap_too() {
    let long = Car { sweeps: 200, ..CAR };
    let other = Car {
        ahead: 18 * SECOND,
        ..long
    };
    let ([a, b], said) = joined([long, other]);
    assert_eq!((a, b), ([T0, SWEEPS_LATE], [T0, SWEEPS_LATE]), "{said}");
    // Where the stamps of both are GPS time, they are of one clock already.
    let ([a, b], said) = joined([other, Car { start: 30.0, ..other }]);
    assert_eq!((a[0], b[0]), (T0 + 18 * SECOND, T0 + 18 * SECOND), "{said}");
    assert!(said.contains("taken as one by header time"), "{said}");
}

#[test]
fn log_times_are_compared_by_messages_of_one_kind() {
    let uptime = Car { ahead: UPTIME, ..CAR };
    let ([a, b], said) = joined([CAR, uptime]);
    assert_eq!((a, b), ([T0, SWEEPS_LATE], [T0, SWEEPS_LATE]), "{said}");
    assert!(
        said.contains("s ± 5 ms by log times of the poses, which take as long as those of `a`"),
        "{said}"
    );
    // A mast has no poses, so the ends of its sweeps count.
    let mast = Car {
        is_fixed: true,
        sweeps_late: SWEEPS_LATE + 30 * MS,
        ..uptime
    };
    for (cars, mast_at) in [([CAR, mast], 1), ([mast, CAR], 0)] {
        let (found, said) = joined(cars);
        assert_eq!(found[mast_at], [T0 + 30 * MS, SWEEPS_LATE], "{said}");
        assert_eq!(found[1 - mast_at], [T0, SWEEPS_LATE], "{said}");
        // The last of three points is 60 ms after the stamp.
        assert!(said.contains("s ± 100 ms by log times of the ends of sweeps"), "{said}");
    }
}

#[test]
fn bags_without_a_clock_in_step_are_treated_alike() {
    let one = Car { ahead: UPTIME, ..CAR };
    let other = Car {
        ahead: UPTIME + 5000 * SECOND,
        ..CAR
    };
    let ([a, b], said) = joined([one, other]);
    assert_eq!((a, b), ([T0 + POSES_LATE, SWEEPS_LATE - POSES_LATE], a), "{said}");
    assert!(
        said.contains("taken as recorded at once") && said.contains("± 100 ms"),
        "{said}"
    );
}

#[test]
fn sweeps_without_a_time_in_common_are_refused_however_long_the_bags_are() {
    let dir = tempfile::tempdir().unwrap();
    let paths = ["a.bag", "b.bag"].map(|name| dir.path().join(name));
    let names = Names { truth: None, ..PLAIN };
    let mut first = recording(names, 0.0, 0);
    first.extend((5 * SWEEPS..500).map(|k| {
        let at = T0 + k * 20 * MS;
        odometry("/odom", at + MS, at, ["map", "base_link"], place(0.0, at))
    }));
    ros1(&paths[0], &first, "none");
    ros1(&paths[1], &recording(names, 20.0, -5 * SECOND), "none");
    let map = format!("agents:\n{}{}", agent("a", "/odom"), agent("b", "/odom"));
    let log = dir.path().join("log.mcap");
    let error = import(&paths, Some(&map), &log).unwrap_err().to_string();
    for part in [
        "expected agents with a time in common",
        "`a` has sweeps from 1700000000.000 to 1700000001.100 s",
        "`b` has sweeps from 1700000005.000 to 1700000006.100 s",
        "give `offset` (s)",
        "`clock: log`",
        "`--agents NAME`",
    ] {
        assert!(error.contains(part), "{part} is not in {error}");
    }
    assert!(!log.exists(), "nothing is written");
}

/// A bag of ROS 1 and one of ROS 2 that recorded more messages; the clock of the second is 37 ms behind.
fn mixed(dir: &Path, heard: impl Fn(Nanos, Nanos) -> Recorded) -> (Nanos, String) {
    let paths: [PathBuf; 2] = ["a.bag", "b.mcap"].map(|name| dir.join(name));
    let names = Names { truth: None, ..PLAIN };
    for (path, late) in paths.iter().zip([0, 37 * MS]) {
        let mut messages = recording(names, 0.0, late);
        messages.extend((0..8).map(|k| heard(k, T0 + k * 300 * MS + k % 3 * MS - late)));
        messages.sort_by_key(|message| message.log_time);
        match late {
            0 => ros1(path, &messages, "none"),
            _ => mcap(path, &messages, Wire::Little),
        }
    }
    let map = format!(
        "agents:\n{}{}",
        agent("a", "/odom"),
        agent("b", "/odom").replace("b.bag", "b.mcap")
    );
    let log = dir.join("log.mcap");
    let summary = import(&paths, Some(&map), &log).unwrap();
    (played(&log, "b").clouds[0].0, summary.to_string())
}

#[test]
fn what_bags_of_both_versions_of_ros_recorded_compares_their_clocks() {
    let heard: [fn(i64, Nanos, Nanos) -> Recorded; 4] = [
        |k, log_time, stamp| pose_stamped("/v2x/beacon", log_time, stamp, "map", [k as f64, 1.0, 0.0, 0.1]),
        |k, log_time, stamp| odometry("/v2x/odom", log_time, stamp, ["map", "van"], [k as f64, 1.0, 0.0, 0.1]),
        |k, log_time, stamp| {
            fix(
                "/v2x/fix",
                log_time,
                stamp,
                "gps",
                [48.0, 11.0 + 1e-5 * k as f64, 500.0],
            )
        },
        |k, log_time, stamp| imu("/v2x/imu", log_time, stamp, "unit", 0.1 * k as f64),
    ];
    for heard in heard {
        let dir = tempfile::tempdir().unwrap();
        let (first, said) = mixed(dir.path(), |k, log_time| heard(k, log_time, T0 + k * 300 * MS));
        assert_eq!(first, T0, "{said}");
        assert!(
            said.contains("+37.000 ms") && said.contains("by 8 messages that it and"),
            "{said}"
        );
    }
}

#[test]
fn messages_of_both_versions_of_ros_that_cannot_be_compared_are_named() {
    let dir = tempfile::tempdir().unwrap();
    let (first, said) = mixed(dir.path(), |k, log_time| {
        recorded("/v2x/cam", "etsi_msgs/CAM", log_time, move |out| {
            out.u32(1000 + k as u32)
        })
    });
    assert_eq!(first, T0 - 37 * MS, "{said}");
    for part in [
        "The bags are of ROS 1 and ROS 2, so messages of `/v2x/cam` (etsi_msgs/CAM) cannot be compared",
        "give `offset` (s)",
    ] {
        assert!(said.contains(part), "{part} is not in {said}");
    }
}

/// Why a car is refused whose clouds have other stamps than its poses.
fn refused(stamp_of: impl Fn(Nanos) -> Nanos) -> String {
    let dir = tempfile::tempdir().unwrap();
    let bag = dir.path().join("a.bag");
    let mut messages = recording(Names { truth: None, ..PLAIN }, 0.0, 0);
    messages.retain(|message| message.topic != "/velodyne_points");
    messages.extend((0..SWEEPS).map(|k| {
        let at = T0 + k * 100 * MS;
        sweep("/velodyne_points", at + 95 * MS, stamp_of(at), "velodyne")
    }));
    messages.sort_by_key(|message| message.log_time);
    ros1(&bag, &messages, "none");
    let map = format!("agents:\n{}", agent("a", "/odom"));
    let log = dir.path().join("log.mcap");
    let error = import(std::slice::from_ref(&bag), Some(&map), &log)
        .unwrap_err()
        .to_string();
    assert!(!log.exists(), "nothing is written");
    let by_log = import(&[bag], Some(&format!("clock: log\n{map}")), &log).unwrap();
    assert!(by_log.agents[0].sweeps > 0, "what the error names helps: {by_log}");
    error
}

#[test]
fn clouds_of_another_clock_than_the_poses_are_said_with_the_kind_of_clock() {
    let tai = [
        "12 × /velodyne_points: no pose is near its stamp",
        "the nearest pose is 35.820 s earlier than the first such sweep",
        "the stamps of clouds are 36.906 s later than those of poses",
        "looks like TAI against UTC",
        "`clock: log`",
    ];
    let gps = ["17.906 s later than", "looks like GPS time against UTC", "`clock: log`"];
    let uptime = [
        "looks like time since the sensor or its computer started",
        "`clock: log`",
    ];
    let other = ["the kind of that clock is not known", "`clock: log`"];
    let error = refused(|at| at + 37 * SECOND);
    assert!(tai.iter().all(|part| error.contains(part)), "{error}");
    let error = refused(|at| at + 18 * SECOND);
    assert!(gps.iter().all(|part| error.contains(part)), "{error}");
    let error = refused(|at| at + UPTIME);
    assert!(uptime.iter().all(|part| error.contains(part)), "{error}");
    let error = refused(|at| at - 77 * SECOND);
    assert!(other.iter().all(|part| error.contains(part)), "{error}");
}

#[test]
fn poses_that_are_missing_are_no_other_clock() {
    let dir = tempfile::tempdir().unwrap();
    let bag = dir.path().join("a.bag");
    let mut messages = recording(Names { truth: None, ..PLAIN }, 0.0, 0);
    messages.retain(|message| message.topic != "/odom");
    let before = T0 - 40 * SECOND;
    messages.extend((0..50).map(|k| {
        let at = before + k * 20 * MS;
        odometry("/odom", at + MS, at, ["map", "base_link"], place(0.0, at))
    }));
    messages.sort_by_key(|message| message.log_time);
    ros1(&bag, &messages, "none");
    let map = format!("agents:\n{}", agent("a", "/odom"));
    let error = import(&[bag], Some(&map), &dir.path().join("log.mcap"))
        .unwrap_err()
        .to_string();
    for part in [
        "the nearest pose is 39.020 s earlier",
        "poses of that time are missing in the bag",
    ] {
        assert!(error.contains(part), "{part} is not in {error}");
    }
}
