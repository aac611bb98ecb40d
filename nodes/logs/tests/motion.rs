//! Motion sensors through a log: written, read in the vehicle frame, merged, and named where they are damaged.

use std::f64::consts::FRAC_PI_2;
use std::path::Path;

use nalgebra::{Isometry3, UnitQuaternion, Vector3};
use realo_logs::{
    AgentInfo, AgentKind, FixReading, ImuReading, Log, LogInfo, LogWriter, MapOrigin, Merge, Stream, WheelReading,
    describe, sensor_frame,
};
use realo_schemas::motion::Taken;
use realo_schemas::{AgentState, FixQuality, Motion, Nanos, PoseStatus};

const START: Nanos = 1_700_000_000_000_000_000;
const MS: Nanos = 1_000_000;
const ORIGIN: [f64; 3] = [48.1, 11.6, 519.0];

fn info(agent: &str, origin: Option<[f64; 3]>) -> LogInfo {
    let agent = AgentInfo {
        name: agent.into(),
        kind: AgentKind::Vehicle,
        footprint: None,
        sensor: String::new(),
        sensor_position: None,
    };
    LogInfo {
        map_origin: origin,
        ..LogInfo::new("a test", vec![agent])
    }
}

/// Up to ten seconds of a car that drives straight on at 10 m/s.
fn write(path: &Path, agent: &str, info: &LogInfo, damage: impl Fn(usize, &mut ImuReading, &mut FixReading)) {
    let mut log = LogWriter::create(path, info).unwrap();
    let turned = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), FRAC_PI_2);
    let mounts = [
        ("imu", Isometry3::from_parts(Vector3::new(0.5, 0.0, 0.4).into(), turned)),
        ("antenna", Isometry3::translation(-0.5, 0.2, 1.5)),
        ("axle", Isometry3::translation(0.5, 0.0, 0.0)),
    ];
    for (sensor, at) in &mounts {
        log.mount(agent, START, &sensor_frame(agent, sensor), at).unwrap();
    }
    let origin = MapOrigin::new(ORIGIN).unwrap();
    for k in 0..1_000_usize {
        let stamp = START + k as Nanos * 10 * MS;
        let (x, shake) = (0.1 * k as f64, 0.01 * (k % 7) as f64);
        let mut imu = ImuReading {
            angular_rate: [0.1 + shake, 0.0, 0.3],
            specific_force: [0.0, -1.0, 9.8 + shake],
            variance: Some([1e-6, 1e-4]),
        };
        let mut fix = FixReading {
            quality: Some(FixQuality::Single),
            geodetic: origin.from_map([x - 0.5, 0.2, 1.5]),
            covariance: Some([1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 4.0]),
        };
        damage(k, &mut imu, &mut fix);
        log.imu(agent, stamp, stamp + 2 * MS, &imu).unwrap();
        if k % 10 == 0 {
            log.fix(agent, stamp, stamp + 50 * MS, &fix).unwrap();
        }
        let wheels = WheelReading {
            velocity: [10.0 + shake, 0.0, 0.0],
            variance: None,
        };
        log.wheels(agent, stamp, stamp + MS, &wheels).unwrap();
        let state = AgentState {
            map_from_body: Isometry3::translation(x, 0.0, 0.0),
            covariance: None,
            velocity: None,
            angular_rate: None,
            status: PoseStatus::Recorded,
        };
        log.pose(agent, stamp, stamp, &state).unwrap();
        if k % 10 == 5 {
            log.sweep(agent, stamp, stamp + 50 * MS).unwrap();
        }
    }
    log.finish().unwrap();
}

fn read(path: &Path, agent: &str, stream: Stream) -> Vec<Motion> {
    let log = Log::open(path).unwrap();
    let mut reader = log.read_all(&[(agent, stream)]).unwrap();
    std::iter::from_fn(|| reader.next().unwrap())
        .map(|entry| entry.motion().unwrap())
        .collect()
}

#[test]
fn sensors_are_read_in_the_vehicle_frame_and_the_map() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.mcap");
    write(&path, "cav1", &info("cav1", Some(ORIGIN)), |_, _, _| {});
    let taken = |arrival: Nanos| Taken {
        stamp: START + 100 * MS,
        arrival: START + arrival * MS,
    };
    let imu = &read(&path, "cav1", Stream::Imu)[10];
    let sample = imu.imu[0];
    assert_eq!(
        (sample.taken, imu.imu_position, imu.imu_variance),
        (taken(102), [0.5, 0.0, 0.4], Some([1e-6, 1e-4]))
    );
    // The unit's x looks to the left.
    let expected = [[0.0, 0.13, 0.3], [1.0, 0.0, 9.83]];
    for (found, expected) in [sample.angular_rate, sample.specific_force].iter().zip(expected) {
        assert!(
            (0..3).all(|axis| (found[axis] - expected[axis]).abs() < 1e-12),
            "{found:?} {expected:?}"
        );
    }
    let motion = &read(&path, "cav1", Stream::Fix)[1];
    let fix = motion.fixes[0];
    assert_eq!(
        (fix.taken, motion.antenna, fix.quality),
        (taken(150), [-0.5, 0.2, 1.5], FixQuality::Single)
    );
    assert!(
        (0..3).all(|axis| (fix.position[axis] - [0.5, 0.2, 1.5][axis]).abs() < 1e-6),
        "{fix:?}"
    );
    let motion = &read(&path, "cav1", Stream::Wheels)[10];
    assert_eq!(
        (motion.wheels[0].speed, motion.wheels[0].variance, motion.axle),
        (10.03, None, [0.5, 0.0, 0.0])
    );
    assert_eq!(describe(&path).unwrap().problems, Vec::<String>::new());
}

#[test]
fn a_merged_log_has_the_sensors_of_all_and_how_they_are_mounted() {
    let folder = tempfile::tempdir().unwrap();
    let logs: Vec<Log> = ["cav1", "cav2"]
        .into_iter()
        .map(|agent| {
            let path = folder.path().join(agent);
            write(&path, agent, &info(agent, Some(ORIGIN)), |_, _, _| {});
            Log::open(path).unwrap()
        })
        .collect();
    let path = folder.path().join("both.mcap");
    let one_clock = [("cav2".to_string(), 0)].into();
    Merge::new(&logs, &one_clock).unwrap().write(&path).unwrap();
    for agent in ["cav1", "cav2"] {
        for stream in [Stream::Imu, Stream::Fix, Stream::Wheels] {
            assert_eq!(
                read(&path, agent, stream),
                read(&folder.path().join(agent), agent, stream),
                "{agent} {stream:?}"
            );
        }
    }
}

#[test]
fn damaged_sensors_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.mcap");
    let problems = |origin: Option<[f64; 3]>, damage: &dyn Fn(usize, &mut ImuReading, &mut FixReading)| {
        write(&path, "cav1", &info("cav1", origin), damage);
        describe(&path).unwrap().problems.join("\n")
    };
    let found = problems(Some(ORIGIN), &|k, imu, _| {
        if k == 77 {
            imu.specific_force[1] = f64::NAN;
        }
    });
    assert!(
        found.contains("/cav1/imu: 1 of 1000 measurements") && found.contains("specific forces within"),
        "{found}"
    );
    let found = problems(Some(ORIGIN), &|_, imu, _| {
        imu.specific_force = imu.specific_force.map(|v| v / 9.80665)
    });
    assert!(
        found.contains("/cav1/imu: the mean specific force") && found.contains("multiples of g"),
        "{found}"
    );
    let found = problems(None, &|_, _, _| {});
    assert!(
        found.contains("/cav1/fix: 100 of 100 measurements") && found.contains("`map_origin`"),
        "{found}"
    );
    let found = problems(Some(ORIGIN), &|k, _, fix| {
        if k >= 500 {
            fix.geodetic[0] += 2e-4
        }
    });
    assert!(found.contains("/cav1/fix: 1 of 100 positions jump"), "{found}");
    let found = problems(Some([48.1, 17.6, 519.0]), &|_, _, _| {});
    assert!(found.contains("off the agent's poses"), "{found}");
    // A receiver that says that it has no position for a time is sound.
    let found = problems(Some(ORIGIN), &|k, _, fix| {
        if k < 500 {
            (fix.quality, fix.geodetic) = (None, [f64::NAN; 3]);
        }
    });
    assert_eq!(found, "");
    let found = problems(Some(ORIGIN), &|_, _, fix| {
        (fix.quality, fix.geodetic) = (None, [f64::NAN; 3])
    });
    assert!(
        found.contains("/cav1/fix: none of 100 messages has a position") && found.contains("antenna"),
        "{found}"
    );
}

#[test]
fn a_frame_that_nothing_places_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.mcap");
    let mut log = LogWriter::create(&path, &info("cav1", Some(ORIGIN))).unwrap();
    let wheels = WheelReading {
        velocity: [1.0, 0.0, 0.0],
        variance: None,
    };
    log.wheels("cav1", START, START, &wheels).unwrap();
    log.finish().unwrap();
    let log = Log::open(&path).unwrap();
    let entry = log
        .read_all(&[("cav1", Stream::Wheels)])
        .unwrap()
        .next()
        .unwrap()
        .unwrap();
    let error = entry.motion().unwrap_err().to_string();
    assert!(
        error.contains("/cav1/wheels") && error.contains("`cav1/axle`, expected `cav1/body`"),
        "{error}"
    );
}
