//! What motion sensors measured, as the player sends it.

mod common;

use std::path::Path;

use nalgebra::Isometry3;
use realo_logs::{AgentInfo, AgentKind, FixReading, ImuReading, LogInfo, LogWriter, WheelReading};
use realo_operator::Source;
use realo_player::{MotionSensors, Player, Settings};
use realo_schemas::{AgentState, FixQuality, Message, Nanos, Payload, PointCloud, PoseStatus};

use common::{config, on, play};

const START: Nanos = 1_700_000_000_000_000_000;
const MS: Nanos = 1_000_000;
/// When each agent's sweeps are, after the start.
const AGENTS: [(&str, Nanos); 2] = [("cav1", 50), ("cav2", 70)];

fn info() -> LogInfo {
    let agents = AGENTS.map(|(name, _)| AgentInfo {
        name: name.into(),
        kind: AgentKind::Vehicle,
        footprint: None,
        sensor: String::new(),
        sensor_position: None,
    });
    LogInfo::new("test", agents.to_vec())
}

fn state(x: f64) -> AgentState {
    AgentState {
        map_from_body: Isometry3::translation(x, 0.0, 0.0),
        covariance: None,
        velocity: None,
        angular_rate: None,
        status: PoseStatus::Recorded,
    }
}

/// A car with an inertial unit, a receiver and wheels; its sweeps are missing for a while.
fn make_moving(path: &Path, sound: bool) {
    let info = LogInfo {
        map_origin: sound.then_some([48.0, 11.0, 500.0]),
        ..info()
    };
    let mut log = LogWriter::create(path, &info).unwrap();
    for sensor in ["imu", "antenna", "axle"] {
        let at = Isometry3::translation(0.5, 0.0, 0.25);
        log.mount("cav1", START, &format!("cav1/{sensor}"), &at).unwrap();
    }
    for tick in 0..200 {
        let now = START + tick * 10 * MS;
        for (agent, ..) in AGENTS {
            log.pose(agent, now, now + MS, &state(0.01 * tick as f64)).unwrap();
        }
        let imu = ImuReading {
            angular_rate: [0.0, 0.0, 0.1],
            specific_force: [0.0, 0.0, 9.8],
            variance: None,
        };
        log.imu("cav1", now, now + 2 * MS, &imu).unwrap();
        if tick % 10 == 0 {
            let fix = FixReading {
                quality: Some(FixQuality::Single),
                geodetic: [48.0, 11.0, 500.0],
                covariance: None,
            };
            log.fix("cav1", now, now + 70 * MS, &fix).unwrap();
            let wheels = WheelReading {
                velocity: [1.0, 0.0, 0.0],
                variance: None,
            };
            log.wheels("cav1", now, now + 8 * MS, &wheels).unwrap();
        }
        for (agent, phase) in AGENTS {
            let is_there = agent != "cav1" || !(80..140).contains(&tick);
            if tick % 10 == phase / 10 && is_there {
                log.cloud(agent, now, now + 50 * MS, &PointCloud::empty()).unwrap();
            }
        }
    }
    log.finish().unwrap();
}

/// The motion of a message with its times on the log's line: stamp and arrival.
fn times_of(message: &Message) -> Vec<[Nanos; 2]> {
    let Payload::Motion(motion) = &message.payload else {
        panic!("{message:?}")
    };
    let header = &message.header;
    let imu = motion.imu.iter().map(|sample| sample.taken);
    imu.map(|taken| [taken.stamp_in(header), taken.arrival_in(header)])
        .collect()
}

#[test]
fn motion_goes_with_the_next_sweep_or_a_little_later_without_one() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.mcap");
    make_moving(&path, true);
    let only_known = |offline: bool, repeat: u32| Settings {
        offline,
        repeat,
        ..config(&path)
    };
    let (played, player) = play(only_known(false, 1));
    assert_eq!(player.counts().get("motion_unusable"), 0);
    let motion = on(&played, "ego_motion");
    let all: Vec<[Nanos; 2]> = motion.iter().flat_map(|message| times_of(message)).collect();
    let expected: Vec<[Nanos; 2]> = (0..200).map(|k| START + k * 10 * MS).map(|t| [t, t + 2 * MS]).collect();
    assert_eq!(all, expected, "each once, in order, with its own times");
    let seqs: Vec<u64> = motion.iter().map(|message| message.header.seq).collect();
    assert_eq!(seqs, (0..motion.len() as u64).collect::<Vec<_>>());
    for message in &motion {
        assert!(
            times_of(message)
                .iter()
                .all(|[_, arrival]| *arrival <= message.header.ready)
        );
    }
    // While there are sweeps, each follows what was measured until it was there; in the gap it comes all the same.
    let sweep = played
        .iter()
        .position(|(time, port, _)| *port == "ego_clouds" && *time == START + 200 * MS)
        .unwrap();
    let before = played[..sweep]
        .iter()
        .rev()
        .find(|(_, port, _)| *port == "ego_motion")
        .unwrap();
    assert_eq!((before.0, before.2.header.stamp), (START + 200 * MS, START + 150 * MS));
    let gaps: Vec<Nanos> = motion
        .windows(2)
        .map(|pair| pair[1].header.ready - pair[0].header.ready)
        .collect();
    assert!(gaps.iter().all(|gap| *gap <= 220 * MS), "{gaps:?}");
    let Payload::Motion(first) = &motion[3].payload else {
        panic!()
    };
    assert_eq!(
        (first.imu_position, first.antenna, first.axle),
        ([0.5, 0.0, 0.25], [0.5, 0.0, 0.25], [0.5, 0.0, 0.25])
    );
    assert!(on(&played, "motion").is_empty());

    // Offline, nothing comes after its stamp; a second pass has it again, with numbers that go on.
    let (played, _) = play(only_known(true, 2));
    let motion = on(&played, "ego_motion");
    let all: Vec<[Nanos; 2]> = motion.iter().flat_map(|message| times_of(message)).collect();
    assert_eq!(all.len(), 400);
    assert!(all.iter().all(|[stamp, arrival]| stamp == arrival));
    let seqs: Vec<u64> = motion.iter().map(|message| message.header.seq).collect();
    assert!(seqs.windows(2).all(|pair| pair[0] < pair[1]), "{seqs:?}");
}

#[test]
fn motion_that_cannot_be_used_is_counted_and_may_be_asked_for_or_left_out() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.mcap");
    make_moving(&path, false);
    let (played, player) = play(config(&path));
    assert_eq!(player.counts().get("motion_unusable"), 20);
    let found = &player.counts().losses["motion_unusable"].found["cav1"];
    assert!(found.contains("map_origin"), "{found}");
    assert!(!on(&played, "ego_motion").is_empty());
    let off = Settings {
        motion: MotionSensors::Off,
        ..config(&path)
    };
    let (played, player) = play(off);
    assert_eq!(
        (on(&played, "ego_motion").len(), player.counts().get("motion_unusable")),
        (0, 0)
    );
    let without = dir.path().join("b.mcap");
    let mut log = LogWriter::create(&without, &info()).unwrap();
    for (agent, _) in AGENTS {
        log.pose(agent, START, START, &state(0.0)).unwrap();
        log.cloud(agent, START, START + 50 * MS, &PointCloud::empty()).unwrap();
    }
    log.finish().unwrap();
    let required = |log: &Path| Settings {
        motion: MotionSensors::Required,
        ..config(log)
    };
    let error = Player::new(required(&without)).err().unwrap().to_string();
    assert!(error.contains("/cav1/fix"), "{error}");
}
