use std::path::PathBuf;

use nalgebra::Isometry3;
use realo_schemas::{AgentState, Box3, PointCloud, PoseStatus};

use super::*;
use crate::{AgentInfo, AgentKind};

const MS: Nanos = 1_000_000;
const SECOND: Nanos = 1000 * MS;
const BEGIN: Nanos = 1_700_000_000 * SECOND;

struct Rig(tempfile::TempDir);

/// What a log says of another agent's clock.
fn clock(peer: &str, ahead: Nanos, uncertainty: Nanos) -> PeerClock {
    PeerClock {
        peer: peer.into(),
        at: BEGIN,
        offset: ahead,
        uncertainty,
        drift: 0.0,
    }
}

fn info(agents: &[&str]) -> LogInfo {
    let agent = |name: &&str| AgentInfo {
        name: name.to_string(),
        kind: AgentKind::Vehicle,
        footprint: None,
        sensor: String::new(),
        sensor_position: None,
    };
    LogInfo::new("a test", agents.iter().map(agent).collect())
}

fn object(x: f64) -> Box3 {
    Box3 {
        center: [x, 2.0, 0.5],
        length: 4.0,
        width: 2.0,
        height: 1.5,
        yaw: 0.3,
        velocity: Some([1.0, 0.5, 0.0]),
        class: "car".into(),
        score: 0.75,
        track: Some(7),
        covariance: None,
    }
}

impl Rig {
    fn new() -> Self {
        Rig(tempfile::tempdir().unwrap())
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    /// Ten sweeps of an agent whose clock is ahead.
    fn log(&self, agent: &str, ahead: Nanos, clocks: Vec<PeerClock>) -> Log {
        self.log_of(&info(&[agent]), ahead, clocks)
    }

    fn log_of(&self, info: &LogInfo, ahead: Nanos, clocks: Vec<PeerClock>) -> Log {
        let agent = &info.agents[0].name;
        let path = self.path(&format!("{agent}.mcap"));
        let mut log = LogWriter::create(&path, info).unwrap();
        for sweep in 0..10 {
            let stamp = BEGIN + sweep * 100 * MS + ahead;
            let state = AgentState {
                map_from_body: Isometry3::translation(sweep as f64, 0.0, 0.0),
                covariance: None,
                velocity: None,
                angular_rate: None,
                status: PoseStatus::Recorded,
            };
            log.pose(agent, stamp, stamp, &state).unwrap();
            let cloud = PointCloud::new(
                vec![1.0; 3],
                vec![2.0; 3],
                vec![0.0; 3],
                vec![9; 3],
                vec![-5, 0, 5],
                vec![0; 3],
            );
            log.cloud(agent, stamp, stamp + 50 * MS, &cloud.unwrap()).unwrap();
            let boxes = Boxes(vec![object(sweep as f64)]);
            log.detections(agent, stamp, stamp + 90 * MS, &boxes).unwrap();
            log.truth(agent, stamp, stamp + 90 * MS, &boxes.0, Some(&[12]), sweep % 2 == 0)
                .unwrap();
        }
        log.clocks(clocks);
        log.finish().unwrap();
        Log::open(path).unwrap()
    }
}

fn merged(rig: &Rig, logs: &[Log], given: &[(&str, Nanos)]) -> Result<Log, LogError> {
    let given = given.iter().map(|(agent, ahead)| (agent.to_string(), *ahead)).collect();
    let target = rig.path("merged.mcap");
    Merge::new(logs, &given)?.write(&target)?;
    Log::open(target)
}

fn refused(logs: &[Log], given: &[(&str, Nanos)]) -> String {
    let given = given.iter().map(|(agent, ahead)| (agent.to_string(), *ahead)).collect();
    Merge::new(logs, &given).expect_err("refused").to_string()
}

/// Stamp, ready and points of an agent's sweeps.
fn sweeps(log: &Log, agent: &str) -> Vec<(Nanos, Nanos, PointCloud)> {
    let mut reader = log.read_all(&[(agent, Stream::Points)]).unwrap();
    std::iter::from_fn(|| reader.next().unwrap())
        .map(|entry| (entry.stamp(), entry.ready(), entry.cloud().unwrap()))
        .collect()
}

#[test]
fn what_agents_recorded_stands_at_the_time_of_the_first_ones_clock() {
    let rig = Rig::new();
    let ahead = 200 * MS + 37;
    let alone = Rig::new();
    let expected = sweeps(&alone.log("rsu1", 0, vec![]), "rsu1");
    for reported_by in ["first", "second", "user"] {
        let saw = |by: &str, clock: PeerClock| if reported_by == by { vec![clock] } else { vec![] };
        let logs = [
            rig.log("cav1", 0, saw("first", clock("rsu1", ahead, 1000))),
            rig.log("rsu1", ahead, saw("second", clock("cav1", -ahead, 1000))),
        ];
        let given = if reported_by == "user" {
            vec![("rsu1", ahead)]
        } else {
            vec![]
        };
        let log = merged(&rig, &logs, &given).unwrap();
        assert_eq!(sweeps(&log, "rsu1"), expected, "{reported_by}");
        assert_eq!(sweeps(&log, "cav1"), sweeps(&logs[0], "cav1"));
        let keys = log.key_frames().unwrap();
        assert_eq!(keys["rsu1"], keys["cav1"]);
        assert_eq!(keys["rsu1"].len(), 5);
        let wanted = [("rsu1", Stream::Detections), ("rsu1", Stream::DetectionsInfo)];
        let mut reader = log.read_all(&wanted).unwrap();
        for sweep in 0..10 {
            let entry = reader.next().unwrap().unwrap();
            let mut boxes = entry.boxes().unwrap();
            let info = reader.next().unwrap().unwrap().info(&mut boxes).unwrap();
            assert_eq!((info.seq, boxes), (sweep, Boxes(vec![object(sweep as f64)])));
            assert_eq!(entry.stamp(), BEGIN + sweep as Nanos * 100 * MS);
        }
        for stream in [Stream::Pose, Stream::Sweeps, Stream::GroundTruth] {
            assert_eq!(log.count("rsu1", stream), 10, "{stream:?}");
        }
    }
}

#[test]
fn clocks_are_known_through_others_by_the_surest_way_and_drift() {
    let rig = Rig::new();
    let drifting = PeerClock {
        drift: 1e-3,
        at: BEGIN + 500 * MS,
        ..clock("rsu1", 300 * MS, 10)
    };
    let logs = [
        // What it says of cav3 itself is less sure than what cav2 says.
        rig.log(
            "cav1",
            0,
            vec![clock("cav2", 100 * MS, 10), clock("cav3", 500 * MS, 50 * MS), drifting],
        ),
        rig.log("cav2", 100 * MS, vec![clock("cav3", 50 * MS, 10)]),
        rig.log("cav3", 150 * MS, vec![]),
        rig.log("rsu1", 300 * MS, vec![]),
    ];
    let merge = Merge::new(&logs, &BTreeMap::new()).unwrap();
    let moved = merge.moved();
    assert_eq!(moved[0].by, [0, 0]);
    assert_eq!((moved[1].by, moved[2].by), ([-100 * MS; 2], [-150 * MS; 2]));
    assert_eq!(moved[2].uncertainty, 20);
    // A second of drift by a part in a thousand, about the middle.
    let [first, last] = moved[3].by;
    assert!(
        (first + 300 * MS - 500_000).abs() < 2000 && (last + 300 * MS + 490_000).abs() < 2000,
        "{:?}",
        moved[3]
    );
}

#[test]
fn logs_that_cannot_be_one_are_refused_with_the_reason() {
    let rig = Rig::new();
    let logs = [rig.log("cav1", 0, vec![]), rig.log("rsu1", 0, vec![])];
    let unknown = refused(&logs, &[]);
    assert!(
        unknown.contains("rsu1.mcap") && unknown.contains("--clock rsu1=0"),
        "{unknown}"
    );
    assert!(
        refused(&logs, &[("rsu2", 0)]).contains("a clock is given for `rsu2`, which no log has; they have: cav1, rsu1")
    );
    let far = refused(&logs, &[("rsu1", 3600 * SECOND)]);
    assert!(
        far.contains("no time in common") && far.contains("3598.") | far.contains("3599."),
        "{far}"
    );
    let twins = [logs[0].clone(), logs[0].clone()];
    assert!(refused(&twins, &[]).contains("both have agent `cav1`"));
    let elsewhere = LogInfo {
        map_frame: "utm".into(),
        ..info(&["cav2"])
    };
    let elsewhere = [logs[0].clone(), rig.log_of(&elsewhere, 0, vec![])];
    assert!(refused(&elsewhere, &[]).contains("`map_frame`: "));
    let mad = PeerClock {
        drift: f64::NAN,
        ..clock("rsu1", 5, 1)
    };
    let mad = [rig.log("cav1", 0, vec![mad]), logs[1].clone()];
    let error = refused(&mad, &[]);
    assert!(error.contains("metadata `clocks`"), "{error}");
    let merge = Merge::new(&logs, &[("rsu1".to_string(), 0)].into()).unwrap();
    let error = merge.write(logs[1].path()).unwrap_err().to_string();
    assert!(error.contains("one of the logs that are read"), "{error}");
    assert!(Merge::new(&[], &BTreeMap::new()).is_err());
}

#[test]
fn of_logs_that_begin_at_other_times_the_common_time_alone_is_taken() {
    let rig = Rig::new();
    let late = 400 * MS;
    let logs = [rig.log("cav1", 0, vec![]), rig.log("rsu1", 0, vec![])];
    let given = [("rsu1".to_string(), -late)].into();
    let merge = Merge::new(&logs, &given).unwrap();
    let [common, any] = merge.spans();
    assert_eq!(common, [BEGIN + late, BEGIN + 990 * MS]);
    assert_eq!(any, [BEGIN, BEGIN + late + 990 * MS]);
    let target = rig.path("common.mcap");
    merge.of_common_time().unwrap().write(&target).unwrap();
    let log = Log::open(&target).unwrap();
    for agent in ["cav1", "rsu1"] {
        let stamps: Vec<Nanos> = sweeps(&log, agent).iter().map(|(stamp, ..)| *stamp - BEGIN).collect();
        assert_eq!(stamps, [4, 5, 6, 7, 8, 9].map(|sweep| sweep * 100 * MS), "{agent}");
    }
    let mut poses = log.read_all(&[("cav1", Stream::Pose)]).unwrap();
    let first = poses.next().unwrap().unwrap();
    assert_eq!(first.stamp(), BEGIN + 100 * MS, "poses around the sweeps at the ends");
}
