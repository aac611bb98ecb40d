//! What the player makes of a log of three agents.

mod common;

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use nalgebra::{Isometry3, Translation3, UnitQuaternion};
use realo_logs::{AgentInfo, AgentKind, Levelled, Log, LogInfo, LogWriter, Precomputed};
use realo_operator::{Error, Source};
use realo_player::{Coop, Detections, Player, PoseSource, Settings, TimeLine, next_pass, plan};
use realo_schemas::geometry::{View, tilt_degrees};
use realo_schemas::{
    AgentState, Box3, Boxes, GroundTruth, Kind, Message, Nanos, OwnLabels, Payload, PointCloud, PoseStatus,
};

use common::{Played, config, on, play};

const START: Nanos = 1_700_000_000_000_000_000;
const MS: Nanos = 1_000_000;
const SWEEPS: usize = 20;
/// When each agent's sweeps are, after the start.
const AGENTS: [(&str, AgentKind, Nanos); 3] = [
    ("cav1", AgentKind::Vehicle, 50),
    ("cav2", AgentKind::Vehicle, 70),
    ("rsu1", AgentKind::Roadside, 20),
];

fn state(seconds: f64, status: PoseStatus) -> AgentState {
    let pose = Isometry3::from_parts(Translation3::new(seconds, 0.0, 0.0), UnitQuaternion::identity());
    AgentState {
        map_from_body: pose,
        covariance: None,
        velocity: None,
        angular_rate: None,
        status,
    }
}

fn object(track: u64) -> Box3 {
    Box3 {
        center: [track as f64, 0.0, 0.8],
        length: 4.0,
        width: 2.0,
        height: 1.6,
        yaw: 0.3,
        velocity: Some([1.0, 0.0, 0.0]),
        class: "car".into(),
        score: 1.0,
        track: Some(track),
        covariance: None,
    }
}

fn cloud(n: usize) -> PointCloud {
    let column = vec![1.0f32; n];
    PointCloud::new(
        column.clone(),
        column.clone(),
        column,
        vec![0u8; n],
        vec![0i32; n],
        vec![0u16; n],
    )
    .unwrap()
}

fn info() -> LogInfo {
    let agents = AGENTS.map(|(name, kind, _)| AgentInfo {
        name: name.into(),
        kind,
        footprint: Some([-1.0, 3.0, -1.0, 1.0]),
        sensor: String::new(),
        sensor_position: None,
    });
    let mut info = LogInfo::new("test", agents.to_vec());
    info.end = Some(START + SWEEPS as Nanos * 100 * MS);
    info
}

/// Tracks 1, 2, 3 everywhere; an agent has `10 × rank + sweep` points on track 1, none on 2, and rsu1 does not list 3.
fn make(path: &Path) {
    let mut log = LogWriter::create(path, &info()).unwrap();
    for tick in 0..SWEEPS * 10 {
        let now = START + tick as Nanos * 10 * MS;
        for (rank, (agent, _, phase)) in AGENTS.into_iter().enumerate() {
            let seconds = tick as f64 * 0.01;
            log.pose(agent, now, now + MS, &state(seconds + 0.5, PoseStatus::Recorded))
                .unwrap();
            log.pose_truth(agent, now, now + MS, &state(seconds, PoseStatus::Truth))
                .unwrap();
            if tick % 10 != phase as usize / 10 {
                continue;
            }
            let (sweep, ready) = (tick / 10, now + 50 * MS);
            log.cloud(agent, now, ready, &cloud(100 + sweep)).unwrap();
            log.detections(agent, now, ready, &Boxes(vec![object(sweep as u64)]))
                .unwrap();
            let tracks: &[u64] = if agent == "rsu1" { &[2, 1] } else { &[1, 2, 3] };
            let objects: Vec<Box3> = tracks.iter().map(|track| object(*track)).collect();
            let of = |track: &u64| if *track == 1 { (10 * rank + sweep) as u32 } else { 0 };
            let points: Vec<u32> = tracks.iter().map(of).collect();
            log.truth(agent, now, ready, &objects, Some(&points), sweep % 2 == 0)
                .unwrap();
        }
    }
    log.finish().unwrap();
}

fn made() -> (tempfile::TempDir, PathBuf) {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.mcap");
    make(&path);
    (dir, path)
}

fn truths(played: &Played) -> Vec<GroundTruth> {
    let truth = |message: &&Message| match &message.payload {
        Payload::GroundTruth(truth) => truth.clone(),
        other => panic!("{other:?}"),
    };
    on(played, "truth").iter().map(truth).collect()
}

#[test]
fn plays_both_lanes_in_order_of_release() {
    let (_dir, path) = made();
    let (played, player) = play(config(&path));
    assert_eq!(player.cast().ego, "cav1");
    let counts = player.counts();
    assert!(counts.counters.is_empty(), "{counts:?}");
    let lost = counts.losses.values().flat_map(|loss| loss.agents.values());
    assert!(lost.into_iter().all(|share| share.count == 0), "{counts:?}");
    assert!(played.windows(2).all(|pair| pair[0].0 <= pair[1].0));
    let counts = [
        "ego_clouds",
        "ego_recorded",
        "truth",
        "clouds",
        "recorded",
        "ego_poses",
        "poses",
    ];
    assert_eq!(
        counts.map(|port| on(&played, port).len()),
        [20, 20, 20, 40, 40, 200, 400]
    );
    for (index, message) in on(&played, "ego_clouds").into_iter().enumerate() {
        let header = &message.header;
        assert_eq!(
            (&*header.agent, header.kind, header.seq),
            ("cav1", Kind::Points, index as u64)
        );
        assert_eq!(
            (header.stamp, header.ready),
            (START + (50 + 100 * index as Nanos) * MS, header.stamp + 50 * MS)
        );
        assert_eq!((&*header.frame, &*header.run), ("cav1/body", "run"));
        assert!(matches!(&message.payload, Payload::PointCloud(cloud) if cloud.len() == 100 + index));
    }
    for (sweep, boxes) in on(&played, "ego_clouds").into_iter().zip(on(&played, "ego_recorded")) {
        assert_eq!(
            (sweep.header.seq, sweep.header.stamp),
            (boxes.header.seq, boxes.header.stamp)
        );
        assert!(matches!(&boxes.payload, Payload::Boxes(Boxes(b)) if *b == [object(sweep.header.seq)]));
    }
    // At equal times poses go before what they are needed for.
    for pair in played.windows(2).filter(|pair| pair[0].0 == pair[1].0) {
        assert!(!pair[1].1.ends_with("poses") || pair[0].1.ends_with("poses"));
    }
    let Payload::AgentState(pose) = &on(&played, "ego_poses")[3].payload else {
        panic!()
    };
    assert_eq!(*pose, state(0.53, PoseStatus::Recorded));
}

#[test]
fn joins_the_points_of_the_nearest_sweeps() {
    let (_dir, path) = made();
    let (played, _) = play(config(&path));
    for (sweep, truth) in truths(&played).into_iter().enumerate() {
        let agents: Vec<&str> = truth.agents.iter().map(|agent| &**agent).collect();
        assert_eq!(agents, ["cav1", "cav2", "rsu1"]);
        assert_eq!(truth.key, sweep % 2 == 0);
        assert_eq!(truth.ego_footprint, Some([-1.0, 3.0, -1.0, 1.0]));
        assert_eq!(truth.other_footprints, [Some([-1.0, 3.0, -1.0, 1.0]); 2]);
        assert_eq!(truth.boxes, [object(1), object(2), object(3)]);
        // cav2's sweep is 20 ms later, rsu1's 30 ms earlier.
        let n = sweep as u32;
        assert_eq!(truth.points, [n, 10 + n, 20 + n, 0, 0, 0, 0, 0, 0]);
    }
}

#[test]
fn a_collaborators_nearest_sweep_may_come_later() {
    let (_dir, path) = made();
    let (played, _) = play(Settings {
        ego: "rsu1".into(),
        ..config(&path)
    });
    let truth = &truths(&played)[4];
    // From 420 ms: cav1 at 450 rather than 350, cav2 at 370 and 470 alike: the earlier.
    assert_eq!(
        truth.agents.iter().map(|agent| &**agent).collect::<Vec<_>>(),
        ["rsu1", "cav1", "cav2"]
    );
    assert_eq!(truth.points, [0, 0, 0, 24, 4, 13]);
}

#[test]
fn modes_choose_who_takes_part() {
    let (_dir, path) = made();
    let log = Log::open(&path).unwrap();
    let runs = |ego: &str, coop, agents: &[&str]| {
        let agents: Vec<String> = agents.iter().map(|agent| agent.to_string()).collect();
        let plan = plan(&log, ego, coop, &agents);
        plan.map(|plan| {
            plan.runs
                .into_iter()
                .map(|run| run.agents().collect::<Vec<_>>().join("+"))
                .collect::<Vec<_>>()
        })
    };
    assert_eq!(runs("", Coop::All, &[]).unwrap(), ["cav1+cav2+rsu1", "cav2+cav1+rsu1"]);
    assert_eq!(runs("", Coop::V2v, &[]).unwrap(), ["cav1+cav2", "cav2+cav1"]);
    assert_eq!(runs("", Coop::V2i, &[]).unwrap(), ["cav1+rsu1", "cav2+rsu1"]);
    assert_eq!(runs("", Coop::I2i, &[]).unwrap(), ["rsu1"]);
    assert_eq!(runs("cav2", Coop::All, &["rsu1"]).unwrap(), ["cav2+rsu1"]);
    assert_eq!(runs("rsu1", Coop::All, &[]).unwrap(), ["rsu1+cav1+cav2"]);
    assert_eq!(runs("", Coop::All, &["rsu1"]).unwrap(), ["rsu1"]);
    let error = runs("rsu1", Coop::V2i, &[]).unwrap_err().to_string();
    assert!(
        error.contains("`rsu1` is a roadside") && error.contains("cav1, cav2"),
        "{error}"
    );
    let error = runs("", Coop::I2i, &["cav1"]).unwrap_err().to_string();
    assert!(error.contains("rsu1 (roadside)"), "{error}");
    let error = runs("cav9", Coop::All, &[]).unwrap_err().to_string();
    assert!(error.contains("no agent `cav9`; it has: cav1, cav2, rsu1"), "{error}");

    let (played, player) = play(Settings {
        coop: Coop::I2i,
        ..config(&path)
    });
    assert_eq!(player.counts().get("runs_alone"), 1);
    assert!(on(&played, "clouds").is_empty() && on(&played, "ego_clouds").len() == SWEEPS);
}

#[test]
fn offline_everything_is_ready_at_its_stamp_with_true_poses() {
    let (_dir, path) = made();
    let (played, _) = play(Settings {
        offline: true,
        ..config(&path)
    });
    assert!(played.windows(2).all(|pair| pair[0].0 <= pair[1].0));
    assert!(
        played
            .iter()
            .all(|(time, _, message)| *time == message.header.stamp && *time == message.header.ready)
    );
    let counts = [
        "ego_clouds",
        "ego_recorded",
        "truth",
        "clouds",
        "recorded",
        "ego_poses",
        "poses",
    ];
    assert_eq!(
        counts.map(|port| on(&played, port).len()),
        [20, 20, 20, 40, 40, 200, 400]
    );
    let Payload::AgentState(pose) = &on(&played, "ego_poses")[3].payload else {
        panic!()
    };
    assert_eq!(*pose, state(0.03, PoseStatus::Truth));
    // The pose of a sweep's very stamp goes before the sweep.
    let sweep = played.iter().position(|(_, port, _)| *port == "ego_clouds").unwrap();
    let before = played[..sweep]
        .iter()
        .rev()
        .find(|(_, port, _)| *port == "ego_poses")
        .unwrap();
    assert_eq!(before.0, played[sweep].0);
}

#[test]
fn without_points_sweeps_keep_their_headers() {
    let (_dir, path) = made();
    let (with, _) = play(config(&path));
    let (without, _) = play(Settings {
        points: false,
        ..config(&path)
    });
    let headers = |played: &Played| {
        on(played, "clouds")
            .into_iter()
            .map(|m| m.header.clone())
            .collect::<Vec<_>>()
    };
    assert_eq!(headers(&with), headers(&without));
    assert!(
        on(&without, "clouds")
            .iter()
            .all(|m| matches!(&m.payload, Payload::PointCloud(cloud) if cloud.is_empty()))
    );
    assert_eq!(truths(&with), truths(&without));
    let (off, _) = play(Settings {
        detections: Detections::Off,
        pose: PoseSource::True,
        ..config(&path)
    });
    assert!(on(&off, "recorded").is_empty() && on(&off, "ego_recorded").is_empty());
    assert!(
        on(&off, "poses")
            .iter()
            .all(|m| matches!(&m.payload, Payload::AgentState(s) if s.status == PoseStatus::Truth))
    );
}

#[test]
fn a_part_of_a_log_keeps_its_numbers() {
    let (_dir, path) = made();
    let (played, _) = play(Settings {
        start: 1.0,
        duration: Some(0.5),
        ..config(&path)
    });
    let seqs: Vec<u64> = on(&played, "ego_clouds")
        .iter()
        .map(|message| message.header.seq)
        .collect();
    assert_eq!(seqs, [10, 11, 12, 13, 14]);
    assert!(truths(&played).iter().all(|truth| truth.boxes.len() == 3));
    assert!(played[0].1.ends_with("poses"));
    let error = Player::new(Settings {
        start: 60.0,
        ..config(&path)
    })
    .err()
    .unwrap()
    .to_string();
    assert!(error.contains("setting `start`: expected less than the"), "{error}");
}

#[test]
fn repeated_passes_go_on_in_time_and_numbers() {
    let (_dir, path) = made();
    for offline in [false, true] {
        let (played, _) = play(Settings {
            repeat: 3,
            offline,
            ..config(&path)
        });
        assert!(played.windows(2).all(|pair| pair[0].0 <= pair[1].0));
        for port in ["ego_clouds", "ego_recorded", "truth", "ego_poses"] {
            let messages = on(&played, port);
            let per_pass = messages.len() / 3;
            assert!(
                messages
                    .iter()
                    .enumerate()
                    .all(|(index, m)| m.header.seq == index as u64),
                "{port}"
            );
            let (first, second) = (&messages[0], &messages[per_pass]);
            assert_eq!(first.payload, second.payload);
            assert!(second.header.stamp - first.header.stamp > 2900 * MS);
        }
    }
}

#[test]
fn at_wall_time_passes_begin_when_it_is_said() {
    let (_folder, path) = made();
    let now = || {
        let since = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH);
        since.unwrap().as_nanos() as Nanos
    };
    let [begins, period] = next_pass(&path, now()).unwrap();
    assert!(begins >= now() && begins < now() + 4_000 * MS + period, "{begins}");
    assert_eq!(next_pass(&path, begins).unwrap()[0], begins + period);
    let first = |clock| play(Settings { clock, ..config(&path) }).0[0].0;
    let (log, wall) = (first(TimeLine::Log), first(TimeLine::Wall));
    // From half a second before the log; the player may have begun one pass later than was said.
    let begun = wall - log + Log::open(&path).unwrap().span().unwrap().0 - 500 * MS;
    assert!(begun >= begins && (begun - begins) % period == 0, "{begun} {begins}");
}

#[test]
fn a_cut_log_is_played_up_to_the_cut_and_counted() {
    let (dir, path) = made();
    let bytes = fs::read(&path).unwrap();
    let cut = dir.path().join("cut.mcap");
    fs::write(&cut, &bytes[..bytes.len() * 6 / 10]).unwrap();
    let (played, player) = play(config(&cut));
    assert_eq!(player.counts().get("log_truncated"), 1);
    let (whole, _) = play(config(&path));
    let (left, all) = (on(&played, "ego_clouds"), on(&whole, "ego_clouds"));
    assert!(
        left.len() < all.len() && left.len() >= 2,
        "{} of {}",
        left.len(),
        all.len()
    );
    assert!(left.iter().zip(&all).all(|(a, b)| a == b));
}

fn refused(config: Settings) -> String {
    Player::new(config).err().map(|error: Error| error.to_string()).unwrap()
}

#[test]
fn says_what_a_log_lacks() {
    let (dir, path) = made();
    let error = refused(config(&dir.path().join("none.mcap")));
    assert!(
        error.contains("none.mcap") && error.contains("realo-lab simulate"),
        "{error}"
    );
    assert!(
        refused(Settings {
            rate: 0.0,
            ..config(&path)
        })
        .contains("`rate`")
    );
    assert!(
        refused(Settings {
            repeat: 0,
            ..config(&path)
        })
        .contains("`repeat`")
    );
    assert!(
        refused(Settings {
            duration: Some(f64::NAN),
            ..config(&path)
        })
        .contains("`duration`")
    );
    assert!(
        refused(Settings {
            agents: vec!["rsu7".into()],
            ..config(&path)
        })
        .contains("`rsu7`")
    );

    let bare = dir.path().join("bare.mcap");
    let mut log = LogWriter::create(&bare, &info()).unwrap();
    for (agent, _, _) in AGENTS {
        log.pose(agent, START, START, &state(0.0, PoseStatus::Recorded))
            .unwrap();
        log.sweep(agent, START, START).unwrap();
    }
    log.finish().unwrap();
    let error = refused(config(&bare));
    assert!(
        error.contains("no topic `/cav1/points`") && error.contains("topics there: /cav1/pose, /cav1/sweeps"),
        "{error}"
    );
    let (played, _) = play(Settings {
        points: false,
        ..config(&bare)
    });
    assert_eq!((on(&played, "ego_clouds").len(), on(&played, "clouds").len()), (1, 2));
    assert_eq!(
        truths(&played),
        [GroundTruth {
            agents: ["cav1", "cav2", "rsu1"].map(Into::into).to_vec(),
            ego_footprint: Some([-1.0, 3.0, -1.0, 1.0]),
            other_footprints: vec![Some([-1.0, 3.0, -1.0, 1.0]); 2],
            ..GroundTruth::default()
        }]
    );
    let error = refused(Settings {
        points: false,
        detections: Detections::Required,
        ..config(&bare)
    });
    assert!(error.contains("/cav1/detections"), "{error}");
    let error = refused(Settings {
        points: false,
        pose: PoseSource::True,
        ..config(&bare)
    });
    assert!(error.contains("/cav1/pose_truth"), "{error}");
}

#[test]
fn poses_that_are_no_poses_are_counted() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.mcap");
    let mut log = LogWriter::create(&path, &info()).unwrap();
    for tick in 0..10 {
        let stamp = START + tick * 10 * MS;
        let x = if tick == 4 { f64::NAN } else { 1.0 };
        for (agent, _, _) in AGENTS {
            log.pose(agent, stamp, stamp, &state(x, PoseStatus::Recorded)).unwrap();
            log.cloud(agent, stamp, stamp, &cloud(0)).unwrap();
        }
    }
    log.finish().unwrap();
    let (played, player) = play(config(&path));
    assert_eq!(on(&played, "ego_poses").len(), 9);
    assert_eq!(player.counts().get("poses_unusable"), 3);
}

/// A log of bodies that pitch by so many degrees at odd ticks, cav1 alone, and by 0.2 at even ones, all three.
fn nodding(path: &Path, degrees: f64, more: impl FnOnce(&mut LogWriter), info: &LogInfo) {
    let mut log = LogWriter::create(path, info).unwrap();
    for tick in 0..10 {
        let stamp = START + tick * 10 * MS;
        for (agent, _, _) in AGENTS {
            let pitch = if tick % 2 == 1 && agent == "cav1" { degrees } else { 0.2 };
            let mut tilted = state(1.0, PoseStatus::Recorded);
            tilted.map_from_body.rotation *= UnitQuaternion::from_euler_angles(0.0, pitch.to_radians(), 0.0);
            log.pose(agent, stamp, stamp, &tilted).unwrap();
            log.cloud(agent, stamp, stamp, &cloud(3)).unwrap();
            log.detections(agent, stamp, stamp, &Boxes(vec![object(9)])).unwrap();
            log.truth(agent, stamp, stamp, &[object(9)], None, true).unwrap();
        }
    }
    more(&mut log);
    log.finish().unwrap();
}

/// The largest tilt of the poses on a port, degrees.
fn tilt_on(played: &Played, port: &str) -> f64 {
    let tilt = |message: &&Message| match &message.payload {
        Payload::AgentState(state) => tilt_degrees(&state.map_from_body.rotation),
        other => panic!("{other:?}"),
    };
    on(played, port).iter().map(tilt).fold(0.0, f64::max)
}

fn first_x_and_z(message: &Message) -> [f64; 2] {
    match &message.payload {
        Payload::PointCloud(cloud) => [cloud.x[0], cloud.z[0]].map(f64::from),
        Payload::Boxes(boxes) => [boxes.0[0].center[0], boxes.0[0].center[2]],
        Payload::GroundTruth(truth) => [truth.boxes[0].center[0], truth.boxes[0].center[2]],
        other => panic!("{other:?}"),
    }
}

#[test]
fn who_tilts_is_levelled_and_who_is_level_passes_bit_for_bit() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.mcap");
    nodding(&path, 3.0, |_| (), &info());
    for (offline, repeat) in [(false, 1), (true, 1), (false, 3)] {
        let (played, player) = play(Settings {
            offline,
            repeat,
            ..config(&path)
        });
        let counters = BTreeMap::from([("levelled".into(), 10 * u64::from(repeat))]);
        assert_eq!(player.counts().counters, counters);
        assert!(tilt_on(&played, "ego_poses") < 1e-9);
        assert!((tilt_on(&played, "poses") - 0.2).abs() < 1e-9);
        for (port, [x, z]) in [
            ("ego_clouds", [1.0, 1.0]),
            ("ego_recorded", [9.0, 0.8]),
            ("truth", [9.0, 0.8]),
        ] {
            for (tick, message) in on(&played, port).into_iter().enumerate() {
                let pitch = if tick % 2 == 1 { 3.0_f64 } else { 0.2 };
                let (sin, cos) = pitch.to_radians().sin_cos();
                let [found_x, found_z] = first_x_and_z(message);
                let off = (found_x - (cos * x + sin * z)).hypot(found_z - (cos * z - sin * x));
                assert!(off < 1e-6, "{off} m, {port}, tick {tick}, pass of {repeat}");
            }
        }
        let is_as_recorded = |message: &&Message| match &message.payload {
            Payload::PointCloud(found) => *found == cloud(3),
            Payload::Boxes(found) => *found == Boxes(vec![object(9)]),
            _ => false,
        };
        assert!(on(&played, "clouds").iter().all(is_as_recorded));
        assert!(on(&played, "recorded").iter().all(is_as_recorded));
    }
}

#[test]
fn a_log_whose_tilts_are_noise_is_played_as_it_is() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.mcap");
    nodding(&path, 0.24, |_| (), &info());
    let (played, player) = play(config(&path));
    assert_eq!(player.counts().counters, BTreeMap::new());
    assert!((tilt_on(&played, "ego_poses") - 0.24).abs() < 1e-9);
    assert!(on(&played, "ego_clouds").iter().all(|m| first_x_and_z(m) == [1.0, 1.0]));
}

#[test]
fn what_the_log_says_of_its_frames_holds() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.mcap");
    for (by, tilted) in [("ground", None), ("none", Some(5))] {
        let degrees = [0.0, 0.0];
        let levelled = BTreeMap::from([("cav1".to_string(), Levelled { by: by.into(), degrees })]);
        nodding(&path, 3.0, |log| log.levelled(levelled), &info());
        let (played, player) = play(config(&path));
        assert_eq!(player.counts().counters.get("tilted_poses").copied(), tilted, "{by}");
        assert!((tilt_on(&played, "ego_poses") - 3.0).abs() < 1e-9);
        assert!(on(&played, "truth").iter().all(|m| first_x_and_z(m) == [9.0, 0.8]));
    }
}

#[test]
fn beside_packets_all_is_played_as_it_is_and_counted() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.mcap");
    let mut info = info();
    info.precomputed = Some(Precomputed {
        graph: "late_fusion".into(),
        agents: vec!["cav2".into()],
        compute: "measured".into(),
        lane: Vec::new(),
    });
    nodding(&path, 3.0, |_| (), &info);
    let (played, player) = play(config(&path));
    assert_eq!(player.counts().counters, BTreeMap::from([("tilted_poses".into(), 5)]));
    assert!((tilt_on(&played, "ego_poses") - 3.0).abs() < 1e-9);
    assert!(on(&played, "ego_clouds").iter().all(|m| first_x_and_z(m) == [1.0, 1.0]));
}

#[test]
fn truth_has_its_views_and_what_the_own_side_labelled() {
    let view = |x: f64| View {
        frame_from_camera: nalgebra::Isometry3::translation(x, 0.0, 1.5),
        focal: [500.0, 500.0],
        center: [500.0, 300.0],
        size: [1000, 600],
        margin: 0.5,
    };
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("views.mcap");
    let mut log = LogWriter::create(&path, &info()).unwrap();
    for tick in 0..40 {
        let now = START + tick * 10 * MS;
        for (agent, _, _) in AGENTS {
            log.pose(agent, now, now, &state(1.0, PoseStatus::Recorded)).unwrap();
            if tick % 10 != 0 {
                continue;
            }
            let sweep = tick as u64 / 10;
            log.sweep(agent, now, now).unwrap();
            // The second sweep has neither views nor own labels.
            if sweep != 1 && agent != "cav2" {
                log.own_views(agent, now, now, &[view(sweep as f64)]).unwrap();
                log.own_labels(agent, now, now, &[object(sweep)], Some(&[7]), sweep.is_multiple_of(2))
                    .unwrap();
            }
            // The roadside unit has nothing but its own labels.
            if agent != "rsu1" {
                log.truth(agent, now, now, &[object(1), object(2)], None, true).unwrap();
                if sweep != 1 {
                    // Written behind the truth, as another program may.
                    log.truth_views(agent, now, now, &[view(1.0), view(-1.0)]).unwrap();
                }
            }
        }
    }
    log.finish().unwrap();
    let of = |ego: &str| {
        let (played, _) = play(Settings {
            ego: ego.into(),
            points: false,
            ..config(&path)
        });
        truths(&played)
    };
    for ego in ["cav1", "rsu1"] {
        let truths = of(ego);
        assert_eq!(truths.len(), 4);
        for (sweep, truth) in truths.iter().enumerate() {
            let labelled = sweep != 1;
            let cooperative = ego == "cav1";
            assert_eq!(
                (truth.boxes.len(), truth.key),
                (2 * usize::from(cooperative), cooperative)
            );
            let views = if labelled && cooperative {
                vec![view(1.0), view(-1.0)]
            } else {
                vec![]
            };
            assert_eq!(truth.views, views, "sweep {sweep} of {ego}");
            let own = labelled.then(|| {
                Box::new(OwnLabels {
                    boxes: vec![object(sweep as u64)],
                    points: vec![7],
                    key: sweep.is_multiple_of(2),
                    views: vec![view(sweep as f64)],
                })
            });
            assert_eq!(truth.own, own, "sweep {sweep} of {ego}");
        }
    }
    assert!(
        of("cav2")
            .iter()
            .all(|truth| truth.own.is_none() && truth.boxes.len() == 2)
    );

    // Numbers that are no view are refused where the log is made.
    let mut log = LogWriter::create(dir.path().join("bad.mcap"), &info()).unwrap();
    let flat = View {
        size: [1000, 0],
        ..view(0.0)
    };
    let error = log
        .truth_views("cav1", START, START, &[view(0.0), flat])
        .unwrap_err()
        .to_string();
    assert!(
        error.contains("/cav1/ground_truth_views") && error.contains("view 1: `size`"),
        "{error}"
    );
}
