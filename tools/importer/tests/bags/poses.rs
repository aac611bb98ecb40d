//! Where poses come from: transforms, poses, positions with attitudes or a course, and the map file.

use realo_logs::MapOrigin;

use super::wire::{Recorded, fix, imu, pose_stamped, transform};
use super::world::{BASE, MOUNTED, MS, SWEEPS, T0, place, sweep};
use super::writers::ros1;
use super::{Played, import, played};

const ORIGIN: [f64; 3] = [48.1, 11.6, 500.0];

fn log_of(poses: Vec<Recorded>, map: &str) -> (Played, String) {
    let dir = tempfile::tempdir().unwrap();
    let mut messages = vec![transform(
        "/tf_static",
        T0,
        T0,
        ["base_link", "velodyne"],
        [1.0, 0.0, MOUNTED, 0.0],
    )];
    for k in 0..SWEEPS {
        let stamp = T0 + k * 100 * MS;
        messages.push(sweep("/velodyne_points", stamp + 95 * MS, stamp, "velodyne"));
    }
    messages.extend(poses);
    messages.sort_by_key(|message| message.log_time);
    let bag = dir.path().join("some.bag");
    ros1(&bag, &messages, "lz4");
    let log = dir.path().join("log.mcap");
    let map = format!("agents:\n  car:\n    clouds: /velodyne_points\n    frame: base_link\n    height: {BASE}\n{map}");
    let summary = import(&[bag], Some(&map), &log).unwrap();
    (played(&log, "car"), summary.to_string())
}

/// Stamps of poses, every 20 ms or less often.
fn stamps(step: i64) -> impl Iterator<Item = i64> {
    (-1..=SWEEPS * 100 / step).map(move |k| T0 + k * step * MS)
}

fn check(log: &Played, tolerance: f64) {
    assert_eq!(log.clouds.len() as i64, SWEEPS);
    let sweeps: Vec<i64> = log.clouds.iter().map(|(stamp, ..)| *stamp).collect();
    for (stamp, pose) in log.poses.iter().filter(|(stamp, _)| sweeps.contains(stamp)) {
        let [x, y, _, yaw] = place(0.0, *stamp);
        let found = pose.translation.vector;
        assert!(
            (found.x - x).abs() < tolerance && (found.y - y).abs() < tolerance,
            "{found} for {x} {y}"
        );
        assert!((pose.rotation.euler_angles().2 - yaw).abs() < tolerance);
    }
    assert!(log.poses.iter().filter(|(stamp, _)| sweeps.contains(stamp)).count() >= SWEEPS as usize);
}

#[test]
fn transforms_lead_from_the_world() {
    let mut poses = vec![transform("/tf_static", T0, T0, ["map", "odom"], [-3.0, 0.0, 0.0, 0.0])];
    poses.extend(stamps(20).map(|stamp| transform("/tf", stamp, stamp, ["odom", "base_link"], place(3.0, stamp))));
    let (log, said) = log_of(poses, "    pose: tf\n");
    check(&log, 1e-6);
    assert!(said.contains("transforms from `map` to `base_link`"), "{said}");
}

#[test]
fn poses_of_another_frame_are_brought_to_the_world() {
    let mut poses = vec![transform("/tf_static", T0, T0, ["map", "odom"], [-3.0, 0.0, 0.0, 0.0])];
    poses.extend(stamps(20).map(|stamp| pose_stamped("/pose", stamp, stamp, "odom", place(3.0, stamp))));
    check(&log_of(poses, "    pose: /pose\n").0, 1e-6);
}

#[test]
fn poses_that_are_far_apart_are_interpolated_at_the_sweeps() {
    let poses = stamps(1000).map(|stamp| pose_stamped("/pose", stamp, stamp, "map", place(0.0, stamp)));
    let poses =
        poses.chain([T0 + 2000 * MS].map(|stamp| pose_stamped("/pose", stamp, stamp, "map", place(0.0, stamp))));
    let (log, said) = log_of(poses.collect(), "    pose: /pose\n");
    check(&log, 1e-6);
    assert!(said.contains("1000 ms apart and interpolated"), "{said}");
}

/// Where the antenna is, 0.5 m behind `base_link`.
fn position(stamp: i64) -> [f64; 3] {
    let [x, y, z, _] = place(0.0, stamp);
    MapOrigin::new(ORIGIN).unwrap().from_map([x - 0.5, y, z])
}

#[test]
fn positions_have_the_attitude_of_an_inertial_unit_or_the_course() {
    let antenna = || transform("/tf_static", T0, T0, ["base_link", "gps"], [-0.5, 0.0, 0.0, 0.0]);
    let mut poses = vec![antenna()];
    poses.extend(stamps(100).map(|stamp| fix("/fix", stamp, stamp, "gps", position(stamp))));
    let map = format!("    pose: /fix\n    imu: /imu\nmap_origin: {ORIGIN:?}\n");
    let (log, said) = log_of(poses.clone(), &map.replace("    imu: /imu\n", ""));
    check(&log, 1e-3);
    assert!(said.contains("attitude by the course"), "{said}");
    poses.extend(stamps(20).map(|stamp| imu("/imu", stamp, stamp, "base_link", 0.0)));
    let (log, said) = log_of(poses, &map);
    check(&log, 1e-3);
    assert!(said.contains("attitude by the inertial unit"), "{said}");
}

#[test]
fn who_stands_still_has_its_pose_in_the_map_file() {
    let (log, _) = log_of(Vec::new(), "    pose: [10, 20, 0.3, 1.5]\n    kind: roadside\n");
    assert_eq!((log.clouds.len(), log.poses.len()), (SWEEPS as usize, SWEEPS as usize));
    let found = log.poses[3].1;
    assert!((found.translation.vector.y - 20.0).abs() < 1e-9 && found.translation.vector.z.abs() < 1e-9);
    assert!((found.rotation.euler_angles().2 - 1.5).abs() < 1e-9);
}
