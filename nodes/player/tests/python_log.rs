//! A log that `python/realo_log.py` wrote from numpy arrays is read, described and played as one of ours.

use std::path::{Path, PathBuf};
use std::process::Command;

use realo_logs::{Log, Stream, describe};
use realo_operator::{Source, StageOutputs};
use realo_player::{Output, Player, Settings};
use realo_schemas::{Box3, FixQuality, Message, Payload};

/// A Python with numpy; one in a virtual environment under the build folder if the system's has none.
fn python() -> Option<PathBuf> {
    let venv = Path::new(env!("CARGO_TARGET_TMPDIR")).join("numpy-venv");
    let own = venv.join("bin/python");
    let run = |command: &mut Command| command.output().is_ok_and(|out| out.status.success());
    let has = |python: &Path| run(Command::new(python).args(["-c", "import numpy"]));
    if let Some(found) = [PathBuf::from("python3"), own.clone()]
        .into_iter()
        .find(|python| has(python))
    {
        return Some(found);
    }
    let made = run(Command::new("python3").args(["-m", "venv"]).arg(&venv))
        && run(Command::new(&own).args(["-m", "pip", "install", "--quiet", "numpy"]));
    (made && has(&own)).then_some(own)
}

const SCRIPT: &str = r#"
import sys
import numpy as np
from realo_log import LogWriter, agent, boxes, view

S, MS = 1_700_000_000_000_000_000, 1_000_000
agents = [agent("car", "vehicle", footprint=[-1, 3.5, -0.9, 0.9], sensor="64 beams"), agent("mast", "roadside")]
origin = [48.1, 11.6, 519.25]
with LogWriter(sys.argv[1], agents, source="a test", key_frames="even sweeps", map_origin=origin) as log:
    log.mount("car", "imu", [0.5, 0, 0.25])
    log.mount("car", "fix", [0, 0, 1.5])
    for tick in range(200):
        now = S + tick * 10 * MS
        log.imu("car", now, [0, 0, 0.125], [0, 0.5, 9.75], variances=(1e-6, 1e-4), ready=now + MS)
        if tick % 10 == 0:
            log.wheels("car", now, 10.0, speed_variance=0.01)
            log.fix("car", now, None if tick == 0 else origin, np.eye(3) * 4, quality="corrected", ready=now + 30 * MS)
        for name in "car", "mast":
            x = 0.1 * tick if name == "car" else 50.0
            log.pose(name, now, [x, 2.0, 0.25], [0, 0, 0, 1], ready=now + MS)
            log.pose(name, now, [x + 0.5, 2.0, 0.25], [0, 0, 0, 1], np.eye(6), ready=now + MS, truth=True)
            if tick % 10 == 5:
                k = tick // 10
                points = np.arange(3 * (20_000 + k), dtype=np.float32).reshape(-1, 3)
                end = now + 50 * MS
                log.sweep(name, now, points, intensity=k, time=np.arange(len(points)), ring=np.arange(len(points)) % 64,
                          ready=end)
                b = boxes([[10, k, 0.8], [20, 0, 0.8]], [[4.5, 1.9, 1.6]] * 2, [0.25, -3.0], ["car", "bus"],
                          score=[0.75, 0.5], velocity=[[1, 2, 0], [np.nan] * 3], track=[7, 8])
                log.detections(name, now, b, ready=end)
                camera = view([1, 0, 1.5], [-0.5, 0.5, -0.5, 0.5], [800, 810], [960.5, 540], [1920, 1080], margin=0.5)
                log.truth(name, now, b, points=[k, 3], key=k % 2 == 0, ready=end, views=[camera])
                log.own_labels(name, now, b, points=[4, 5], ready=end, views=[camera, camera])
try:
    log.pose("bus", S, [0, 0, 0], [0, 0, 0, 1])
    sys.exit("an agent that the log does not have was taken")
except ValueError as error:
    assert "`bus`" in str(error), error
for wrong in {"size": [1920, 0]}, {"focal": [float("nan"), 1]}, {"position": [1, 2]}, {"margin": -1}:
    given = {"position": [0, 0, 1], "quaternion": [0, 0, 0, 1], "focal": [1, 1], "center": [0, 0], "size": [2, 2]}
    try:
        view(**{**given, **wrong})
        sys.exit(f"{wrong} was taken")
    except ValueError as error:
        assert "view" in str(error), error
"#;

/// That Python, or the running test is left out.
fn needed_python() -> Option<PathBuf> {
    let found = python();
    if found.is_none() {
        skipped::skip("Python 3 with numpy, which pip could not install");
    }
    found
}

/// What the script wrote of the car's motion sensors.
fn assert_motion(log: &Log) {
    let streams = [Stream::Imu, Stream::Fix, Stream::Wheels];
    let mut reader = log.read_all(&streams.map(|stream| ("car", stream))).unwrap();
    let mut counts = [0; 3];
    let mut with_place = 0;
    while let Some(entry) = reader.next().unwrap() {
        let motion = entry.motion().unwrap();
        counts[streams.iter().position(|stream| *stream == entry.stream).unwrap()] += 1;
        for imu in &motion.imu {
            assert_eq!(imu.angular_rate, [0.0, 0.0, 0.125]);
            assert_eq!(imu.specific_force, [0.0, 0.5, 9.75]);
            assert_eq!(imu.taken.arrival - imu.taken.stamp, 1_000_000);
            assert_eq!(
                (motion.imu_position, motion.imu_variance),
                ([0.5, 0.0, 0.25], Some([1e-6, 1e-4]))
            );
        }
        for fix in &motion.fixes {
            assert!(fix.position.iter().all(|axis| axis.abs() < 1e-6), "{fix:?}");
            assert_eq!((fix.quality, motion.antenna), (FixQuality::Corrected, [0.0, 0.0, 1.5]));
            assert_eq!(fix.covariance.unwrap()[4], 4.0);
            with_place += 1;
        }
        for wheels in &motion.wheels {
            assert_eq!(
                (wheels.speed, wheels.variance, motion.axle),
                (10.0, Some(0.01), [0.0; 3])
            );
        }
    }
    assert_eq!(with_place, 19, "the first has none");
    assert_eq!(counts, [200, 20, 20]);
}

#[test]
fn values_that_do_not_fit_are_scaled_by_rule_or_refused_by_name() {
    let Some(python) = needed_python() else { return };
    let module = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../python");
    let out = Command::new(python)
        .current_dir(module.join("tests"))
        .env("PYTHONPATH", &module)
        .args(["-B", "-m", "unittest", "test_log"])
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&out.stderr);
    assert!(out.status.success() && said.contains("OK"), "{said}");
}

#[test]
fn a_log_from_numpy_arrays_is_read_and_played() {
    let Some(python) = needed_python() else { return };
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("python.mcap");
    let module = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../python");
    let out = Command::new(python)
        .env("PYTHONPATH", module)
        .args(["-B", "-c", SCRIPT])
        .arg(&path)
        .output()
        .unwrap();
    assert!(out.status.success(), "{}", String::from_utf8_lossy(&out.stderr));

    let log = Log::open(&path).unwrap();
    assert!(log.truncation().is_none());
    assert_eq!(log.info().agent("car").unwrap().footprint, Some([-1.0, 3.5, -0.9, 0.9]));
    assert_eq!(log.key_frames().unwrap()["mast"].len(), 10);
    let mut reader = log
        .read_all(&[("mast", Stream::Points), ("car", Stream::PoseTruth)])
        .unwrap();
    let (mut sweeps, mut poses) = (0, 0);
    while let Some(entry) = reader.next().unwrap() {
        if entry.stream == Stream::PoseTruth {
            let state = entry.pose().unwrap();
            assert_eq!(state.map_from_body.translation.x, 0.1 * f64::from(poses) + 0.5);
            assert_eq!(state.covariance.unwrap()[7], 1.0);
            poses += 1;
            continue;
        }
        let cloud = entry.cloud().unwrap();
        assert_eq!((entry.seq(), cloud.len()), (sweeps, 20_000 + sweeps as usize));
        assert_eq!((cloud.y[2], cloud.z[100]), (7.0, 302.0));
        assert_eq!(
            (cloud.intensity[9], cloud.time[70], cloud.ring[70]),
            (sweeps as u8, 70, 6)
        );
        sweeps += 1;
    }
    assert_eq!((sweeps, poses), (20, 200));
    assert_eq!(log.info().map_origin, Some([48.1, 11.6, 519.25]));
    assert_motion(&log);
    let description = describe(&path).unwrap();
    assert!((description.topics["/car/points"].rate_hz.unwrap() - 10.0).abs() < 1e-9);
    assert_eq!(description.topics["/car/ground_truth"].channel.messages, 20);
    assert_eq!(description.sweeps["car"].problem, None);

    let mut player = Player::new(Settings {
        log: path,
        ..Settings::default()
    })
    .unwrap();
    let mut played: Vec<(&str, Message)> = Vec::new();
    while let Some((_, output)) = player.next().unwrap() {
        let (port, message) = output.into_message();
        played.push((Output::PORTS[port.0].name, message));
    }
    // Both agents list the same boxes in frames of their own: two tracks at 39 pairs of times.
    let counts = player.counts();
    assert_eq!((counts.get("tracks_differ"), counts.counters.len()), (78, 1));
    let on = |port: &str| -> Vec<&Message> {
        let of_port = played.iter().filter(|(name, _)| *name == port);
        of_port.map(|(_, message)| message).collect()
    };
    for port in ["ego_clouds", "clouds", "ego_recorded", "recorded", "truth"] {
        assert_eq!(on(port).len(), 20, "{port}");
    }
    assert_eq!(on("ego_poses").len(), 200);
    let Payload::Boxes(boxes) = &on("recorded")[4].payload else {
        panic!("not boxes")
    };
    let [first, second] = &boxes.0[..] else {
        panic!("{boxes:?}")
    };
    assert_eq!((first.center, first.yaw, first.score), ([10.0, 4.0, 0.8], 0.25, 0.75));
    assert_eq!((first.length, first.width, first.height), (4.5, 1.9, 1.6));
    assert_eq!(
        (first.velocity, first.track, &*first.class),
        (Some([1.0, 2.0, 0.0]), Some(7), "car")
    );
    assert_eq!((second.velocity, second.yaw, &*second.class), (None, -3.0, "bus"));
    let Payload::GroundTruth(truth) = &on("truth")[4].payload else {
        panic!("not truth")
    };
    assert_eq!(truth.points, [4, 4, 3, 3]);
    assert!(truth.key && truth.ego_footprint == Some([-1.0, 3.5, -0.9, 0.9]));
    let own = truth.own.as_ref().expect("own labels were written");
    assert_eq!(
        (truth.views.len(), own.views.len(), &own.points[..]),
        (1, 2, &[4, 5][..])
    );
    let view = &truth.views[0];
    assert_eq!(
        (view.focal, view.center, view.size, view.margin),
        ([800.0, 810.0], [960.5, 540.0], [1920, 1080], 0.5)
    );
    // It looks along x: the first box lies ahead of it, and none behind.
    let behind = Box3 {
        center: [-10.0, 0.0, 0.8],
        ..truth.boxes[0].clone()
    };
    assert!(view.shows(&truth.boxes[0]) && !view.shows(&behind));
}
