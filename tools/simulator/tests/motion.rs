//! Logs of drives with motion sensors, and of agents whose clocks are wrong.

use std::path::Path;

use realo_logs::{ClockError, Log, Stream, describe};
use realo_schemas::Nanos;
use realo_simulator::{EPOCH, MAP_ORIGIN, MotionUnit, Options, Scenario, write_log};

const MS: Nanos = 1_000_000;

fn options() -> Options {
    Options {
        scenario: Scenario::Loop,
        seed: 5,
        seconds: 4.0,
        agents: ["cav1", "cav2", "rsu1"].map(String::from).to_vec(),
        clouds: false,
        column_stride: 50,
        inertial: Some(MotionUnit::Tactical),
        ..Options::default()
    }
}

fn written(options: &Options, path: &Path) -> Log {
    write_log(options, path, |_| {}).unwrap();
    Log::open(path).unwrap()
}

/// Every message of an agent but those for viewers: stream, stamp, when it was there, and its bytes behind the stamp.
fn messages(log: &Log, agent: &str) -> Vec<(Stream, Nanos, Nanos, Vec<u8>)> {
    let of_agent = |stream: &Stream| *stream != Stream::GroundTruthMarkers && log.has(agent, *stream);
    let wanted: Vec<(&str, Stream)> = Stream::ALL
        .into_iter()
        .filter(of_agent)
        .map(|stream| (agent, stream))
        .collect();
    let mut reader = log.read_all(&wanted).unwrap();
    std::iter::from_fn(|| reader.next().unwrap())
        .map(|entry| (entry.stream, entry.stamp(), entry.ready(), entry.data()[12..].to_vec()))
        .collect()
}

#[test]
fn a_drive_has_its_sensors_and_nothing_is_wrong_with_them() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.mcap");
    let log = written(&options(), &path);
    assert_eq!(describe(&path).unwrap().problems, Vec::<String>::new());
    assert_eq!(
        (log.info().map_origin, log.info().clock_errors.len()),
        (Some(MAP_ORIGIN), 0)
    );
    let counts = |agent: &str| [Stream::Imu, Stream::Fix, Stream::Wheels].map(|stream| log.count(agent, stream));
    assert_eq!([counts("cav1"), counts("rsu1")], [[420, 43, 211], [0, 43, 0]]);
    let mut reader = log.read_all(&[("rsu1", Stream::PoseTruth)]).unwrap();
    let truth = reader
        .next()
        .unwrap()
        .unwrap()
        .pose()
        .unwrap()
        .map_from_body
        .translation;
    let mut reader = log.read_all(&[("rsu1", Stream::Fix)]).unwrap();
    while let Some(entry) = reader.next().unwrap() {
        let motion = entry.motion().unwrap();
        let [x, y, z] = motion.fixes[0].position;
        let far = (x - truth.x).hypot(y - truth.y).hypot(z - motion.antenna[2] - truth.z);
        assert!(far < 40.0 && entry.ready() > entry.stamp(), "{far} m");
    }
}

#[test]
fn a_clock_that_is_wrong_moves_all_stamps_of_its_agent_and_nothing_else() {
    let folder = tempfile::tempdir().unwrap();
    let right = written(&options(), &folder.path().join("right.mcap"));
    let error = ClockError {
        offset: 30 * MS,
        drift: 2e-5,
        step: -12 * MS,
        step_at: 2_000 * MS,
    };
    let tai = ClockError {
        offset: 37_000 * MS,
        ..ClockError::default()
    };
    let mut wrong = options();
    wrong.clock_errors = [("cav1".to_string(), error), ("rsu1".to_string(), tai)].into();
    let path = folder.path().join("wrong.mcap");
    let log = written(&wrong, &path);
    assert_eq!(log.info().clock_errors, wrong.clock_errors);
    for (agent, of) in [("cav1", error), ("rsu1", tai), ("cav2", ClockError::default())] {
        let (before, after) = (messages(&right, agent), messages(&log, agent));
        assert_eq!(before.len(), after.len(), "{agent}");
        for (one, other) in before.iter().zip(&after) {
            assert_eq!((one.0, one.2), (other.0, other.2), "{agent}: log times are true");
            assert_eq!(other.1 - one.1, of.at(one.1 - EPOCH), "{agent} {:?}", one.0);
            // Boxes have a header each, with a stamp of their own.
            if one.0.is_motion() || matches!(one.0, Stream::Pose | Stream::PoseTruth | Stream::Sweeps) {
                assert_eq!(one.3, other.3, "{agent} {:?}", one.0);
            }
        }
    }
    let problems = describe(&path).unwrap().problems.join("\n");
    assert!(
        problems.contains("`rsu1`") && problems.contains("TAI against UTC"),
        "{problems}"
    );
    assert!(!problems.contains("`cav1`"), "50 ms are tolerated: {problems}");
}

#[test]
fn an_agent_starts_its_sweeps_when_it_is_told_to() {
    let folder = tempfile::tempdir().unwrap();
    let mut asked = options();
    asked.seconds = 0.5;
    asked.sweep_phase_ms = [("cav2".to_string(), 62.5)].into();
    let log = written(&asked, &folder.path().join("a.mcap"));
    let first = |agent: &str| {
        log.read_all(&[(agent, Stream::Sweeps)])
            .unwrap()
            .next()
            .unwrap()
            .unwrap()
            .ready()
    };
    assert_eq!(first("cav2"), EPOCH + 162_500_000);
    assert!((first("cav1") - EPOCH - 100 * MS).abs() < MS);
}
