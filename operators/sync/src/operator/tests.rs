use nalgebra::{Isometry3, Point3, Vector3};
use realo_operator::Outputs;
use realo_schemas::{AgentState, Header, Kind, Message, Nanos, PointCloud, PoseStatus};

use super::*;

const MS: Nanos = 1_000_000;

fn header(agent: &str, kind: Kind, seq: u64, stamp: Nanos, ready: Nanos) -> Header {
    Header::origin(&"run".into(), &agent.into(), kind, seq, stamp * MS, ready * MS)
}

/// An agent that drives at 20 m/s along y of the map.
fn pose_at(time: Nanos) -> Isometry3<f64> {
    Isometry3::new(
        Vector3::new(1e5, 0.02 * time as f64, 1.0),
        Vector3::z() * std::f64::consts::FRAC_PI_2,
    )
}

fn state(time: Nanos) -> AgentState {
    let mut covariance = Box::new([0.0; 36]);
    covariance[0] = time as f64;
    AgentState {
        map_from_body: pose_at(time),
        covariance: Some(covariance),
        velocity: None,
        angular_rate: None,
        status: PoseStatus::Recorded,
    }
}

fn pose(agent: &str, time: Nanos) -> Message {
    Message::new(header(agent, Kind::AgentState, time as u64, time, time), state(time))
}

/// A sweep of 100 ms around its stamp of a thing that stands at (1e5 - 3, 40, 2) in the map.
fn sweep(agent: &str, seq: u64, stamp: Nanos) -> Message {
    let times: Vec<i32> = (-50..=50).map(|ms| ms * 1_000_000).collect();
    let seen = times.iter().map(|time| {
        let at = pose_at(0).translation.vector.y + 0.02e-6 * (stamp * MS + Nanos::from(*time)) as f64;
        Point3::new(40.0 - at, 3.0, 1.0)
    });
    let seen: Vec<Point3<f64>> = seen.collect();
    let column = |i: usize| seen.iter().map(|p| p[i] as f32).collect::<Vec<f32>>();
    let n = times.len();
    let cloud = PointCloud::new(column(0), column(1), column(2), vec![9u8; n], times, vec![1u16; n]).unwrap();
    Message::new(header(agent, Kind::Points, seq, stamp, stamp + 50), cloud)
}

fn sync(config: Settings) -> Sync {
    Sync::new(config).unwrap()
}

fn run(sync: &mut Sync, inputs: impl IntoIterator<Item = Message>) -> (Vec<Message>, Outputs<Output>) {
    let mut all = Vec::new();
    let mut last = Outputs::at(0);
    for message in inputs {
        let port = if matches!(message.payload, realo_schemas::Payload::AgentState(_)) {
            Input::POSES
        } else {
            Input::CLOUDS
        };
        last = Outputs::at(message.header.ready);
        sync.on_message(port, message, &mut last).unwrap();
        all.extend(last.take_sent().into_iter().map(|(_, message)| message));
    }
    (all, last)
}

fn parts(sent: &[Message]) -> (Header, AgentState, Header, PointCloud) {
    let [state, cloud] = sent else {
        panic!("expected a state and a cloud, found {}", sent.len())
    };
    let (state_header, state) = state.clone().into_parts().unwrap();
    let (cloud_header, cloud) = cloud.clone().into_parts().unwrap();
    (state_header, state, cloud_header, cloud)
}

#[test]
fn removes_the_motion_and_says_where_the_agent_is() {
    let mut sync = sync(Settings::default());
    let poses = (0..=25).map(|i| pose("cav1", 10 * i));
    let (sent, out) = run(&mut sync, poses.chain([sweep("cav1", 7, 204)]));
    let (state_header, state, cloud_header, cloud) = parts(&sent);
    assert_eq!(
        (state_header.kind, state_header.seq, state_header.stamp),
        (Kind::AgentState, 7, 204 * MS)
    );
    assert_eq!((state_header.ready, cloud_header.ready), (254 * MS, 254 * MS));
    assert_eq!(cloud_header.kind, Kind::Points);
    let pose = cloud_header.pose.unwrap();
    assert_eq!(state_header.pose.as_ref(), Some(&pose));
    assert!((pose.map_from_frame.translation.vector - pose_at(204).translation.vector).norm() < 1e-9);
    assert_eq!(pose.covariance.unwrap()[0], 200.0, "of the nearest pose");
    assert!((state.velocity.unwrap() - Vector3::new(0.0, 20.0, 0.0)).norm() < 1e-6);
    assert!(state.angular_rate.unwrap().norm() < 1e-9);
    assert_eq!(state.status, PoseStatus::Recorded);
    // The sweep spreads the thing over 2 m along x; it stands at 40 m - 4.08 m.
    assert!(cloud.x.iter().all(|x| (x - 35.92).abs() < 1e-4), "{:?}", cloud.x);
    assert!(cloud.y.iter().all(|y| (y - 3.0).abs() < 1e-5));
    assert_eq!(out.counted("not_deskewed"), 0);
}

#[test]
fn a_sweep_goes_on_at_once_over_a_gap_and_waits_beyond_it() {
    let mut early = sync(Settings::default());
    let (sent, mut out) = run(
        &mut early,
        (0..=10).map(|i| pose("cav1", 10 * i)).chain([sweep("cav1", 0, 200)]),
    );
    let (.., state, _, cloud) = (parts(&sent).0, parts(&sent).1, parts(&sent).2, parts(&sent).3);
    assert_eq!(state.status, PoseStatus::Extrapolated);
    assert!(cloud.x.iter().all(|x| (x - 36.0).abs() < 1e-4));
    assert!(out.take_wakes().is_empty());

    let mut late = sync(Settings::default());
    let (sent, mut out) = run(
        &mut late,
        (0..=9).map(|i| pose("cav1", 10 * i)).chain([sweep("cav1", 0, 200)]),
    );
    assert_eq!(sent, []);
    assert_eq!(out.take_wakes(), [252 * MS, 350 * MS].into());
    let mut out = Outputs::at(260 * MS);
    late.on_message(Input::POSES, pose("cav1", 100), &mut out).unwrap();
    let sent: Vec<Message> = out.take_sent().into_iter().map(|(_, message)| message).collect();
    assert_eq!(parts(&sent).2.ready, 260 * MS, "as soon as the pose is known");
}

#[test]
fn a_sweep_without_a_pose_is_dropped_when_patience_ends() {
    let mut sync = sync(Settings::default());
    let (sent, mut out) = run(&mut sync, [sweep("cav1", 0, 200)]);
    assert_eq!((sent.len(), out.take_wakes()), (0, [252 * MS, 350 * MS].into()));
    let mut out = Outputs::at(349 * MS);
    sync.on_wake(349 * MS, &mut out).unwrap();
    assert_eq!(out.counted("no_pose"), 0);
    let mut out = Outputs::at(350 * MS);
    sync.on_wake(350 * MS, &mut out).unwrap();
    assert_eq!((out.take_sent().len(), out.counted("no_pose")), (0, 0));
    run(&mut sync, [sweep("cav1", 1, 400)]);
    let mut out = Outputs::at(460 * MS);
    sync.on_end(&mut out).unwrap();
    assert_eq!((out.counted("no_pose"), out.counted("late_pose")), (2, 0));
}

#[test]
fn a_pose_that_comes_too_late_is_no_fault_of_the_log() {
    let mut sync = sync(Settings::default());
    run(&mut sync, [sweep("cav1", 0, 200), sweep("cav1", 1, 1_000)]);
    sync.on_wake(2_000 * MS, &mut Outputs::at(2_000 * MS)).unwrap();
    let counted = |sync: &mut Sync, pose: Message| {
        let mut out = Outputs::at(2_100 * MS);
        sync.on_message(Input::POSES, pose, &mut out).unwrap();
        (out.counted("no_pose"), out.counted("late_pose"))
    };
    // The first sweep's pose was late; the second one has none once there are poses on both sides, too far apart.
    assert_eq!(counted(&mut sync, pose("cav1", 200)), (0, 1));
    assert_eq!(counted(&mut sync, pose("cav1", 1_100)), (0, 0));
    assert_eq!(counted(&mut sync, pose("cav1", 1_200)), (1, 0));
    let mut out = Outputs::at(2_200 * MS);
    sync.on_end(&mut out).unwrap();
    assert_eq!((out.counted("no_pose"), out.counted("late_pose")), (0, 0));
}

#[test]
fn one_pose_at_the_stamp_is_enough_to_pass_as_it_is() {
    let mut sync = sync(Settings::default());
    let (sent, mut out) = run(&mut sync, [pose("cav1", 200), sweep("cav1", 0, 200)]);
    let (_, state, header, cloud) = parts(&sent);
    assert_eq!((state.velocity, state.angular_rate), (None, None));
    assert_eq!(header.pose.unwrap().map_from_frame, pose_at(200));
    assert!((cloud.x[0] - 37.0).abs() < 1e-4 && (cloud.x[100] - 35.0).abs() < 1e-4);
    assert_eq!((out.counted("not_deskewed"), out.take_wakes().len()), (1, 0));
    let (sent, out) = run(&mut sync, [pose("cav1", 9000), sweep("cav1", 1, 9000)]);
    assert_eq!(
        (sent.len(), out.counted("not_deskewed")),
        (2, 1),
        "nor does a pose long ago say how it moved"
    );
}

#[test]
fn sweeps_are_passed_as_they_are_if_asked_for() {
    let mut sync = sync(Settings {
        deskew: false,
        ..Settings::default()
    });
    let (sent, out) = run(
        &mut sync,
        (0..=25).map(|i| pose("cav1", 10 * i)).chain([sweep("cav1", 0, 200)]),
    );
    let (_, state, _, cloud) = parts(&sent);
    assert!((cloud.x[0] - 37.0).abs() < 1e-4 && state.velocity.is_some());
    assert_eq!(out.counted("not_deskewed"), 0);
}

#[test]
fn repeated_and_older_sweeps_are_dropped_and_agents_are_kept_apart() {
    let mut sync = sync(Settings::default());
    let poses = (0..=60).flat_map(|i| [pose("cav1", 10 * i), pose("cav2", 10 * i)]);
    run(&mut sync, poses);
    assert_eq!(run(&mut sync, [sweep("cav1", 3, 300)]).0.len(), 2);
    let (sent, out) = run(&mut sync, [sweep("cav1", 3, 300)]);
    assert_eq!((sent.len(), out.counted("duplicate")), (0, 1));
    let (sent, out) = run(&mut sync, [sweep("cav1", 2, 200)]);
    assert_eq!((sent.len(), out.counted("out_of_order")), (0, 1));
    assert_eq!(run(&mut sync, [sweep("cav2", 2, 200)]).0.len(), 2);
    assert_eq!(
        run(&mut sync, [sweep("cav1", 0, 400)]).0.len(),
        2,
        "a restarted sensor is welcome"
    );
}

#[test]
fn an_empty_cloud_and_one_without_sound_points_pass() {
    let mut sync = sync(Settings::default());
    run(&mut sync, (0..=60).map(|i| pose("cav1", 10 * i)));
    let empty = Message::new(header("cav1", Kind::Points, 0, 200, 250), PointCloud::empty());
    assert!(parts(&run(&mut sync, [empty]).0).3.is_empty());
    let nan = vec![f32::NAN, 0.0];
    let cloud = PointCloud::new(nan.clone(), nan.clone(), nan, vec![0u8; 2], vec![0; 2], vec![0u16; 2]).unwrap();
    let (sent, out) = run(
        &mut sync,
        [Message::new(header("cav1", Kind::Points, 1, 300, 350), cloud)],
    );
    assert!(parts(&sent).3.is_empty());
    assert_eq!((out.counted("nan_points"), out.counted("own_body_points")), (1, 1));
}

#[test]
fn refuses_stamps_from_the_future_and_poses_that_are_none() {
    let mut sync = sync(Settings::default());
    let mut refuse = |port, message| {
        sync.on_message(port, message, &mut Outputs::at(0))
            .unwrap_err()
            .to_string()
    };
    assert!(refuse(Input::CLOUDS, sweep("cav1", 0, 1001)).contains("1.001 s"));
    assert!(refuse(Input::POSES, pose("cav1", 1001)).contains("1.001 s"));
    let mut bad = state(0);
    bad.map_from_body.translation.x = f64::NAN;
    assert!(
        refuse(
            Input::POSES,
            Message::new(header("cav1", Kind::AgentState, 0, 0, 0), bad)
        )
        .contains("finite")
    );
    assert!(refuse(Input::POSES, sweep("cav1", 0, 0)).contains("AgentState"));
    let refuse = |own_body: &[f32]| {
        let config = Settings {
            own_body: own_body.to_vec(),
            ..Settings::default()
        };
        Sync::new(config).err().expect("refused").to_string()
    };
    assert!(refuse(&[1.0]).contains("`own_body`"));
    assert!(refuse(&[1.0, -1.0, 0.0, 1.0]).contains("`own_body`"));
    assert!(
        Sync::new(Settings {
            own_body: vec![],
            ..Settings::default()
        })
        .is_ok()
    );
}

#[test]
fn waiting_sweeps_are_bounded() {
    let mut sync = sync(Settings {
        patience_ms: 10_000,
        ..Settings::default()
    });
    (0..30).for_each(|i| drop(run(&mut sync, [sweep("cav1", i, 100 * i as Nanos)])));
    let track = &sync.tracks["cav1"];
    assert_eq!(track.waiting.len(), 8);
    assert_eq!(sync.tracks.get_mut("cav1").unwrap().unposed().len(), 22);
}

#[test]
fn a_pose_that_is_due_and_comes_just_behind_the_sweep_counts() {
    let poses = |to: Nanos| (0..=to / 10).map(|k| pose("cav1", 10 * k));
    // Points until 150, poses each 10: the pose of 150 and the sweep overtake each other.
    let in_order = run(
        &mut sync(Settings::default()),
        poses(150).chain([sweep("cav1", 1, 100)]),
    )
    .0;
    let mut late = sync(Settings::default());
    let (sent, mut out) = run(&mut late, poses(140).chain([sweep("cav1", 1, 100)]));
    assert_eq!((sent.len(), out.take_wakes()), (0, [152 * MS, 250 * MS].into()));
    let (_, expected, _, _) = parts(&in_order);
    let (sent, _) = run(&mut late, [pose("cav1", 150)]);
    assert_eq!(parts(&sent).1, expected);

    // If it does not come, the sweep goes on without.
    let mut without = sync(Settings::default());
    run(&mut without, poses(140).chain([sweep("cav1", 1, 100)]));
    let mut out = Outputs::at(152 * MS);
    without.on_wake(152 * MS, &mut out).unwrap();
    assert_eq!(out.take_sent().len(), 2);

    // Poses that are always late are not awaited.
    let (sent, _) = run(
        &mut sync(Settings::default()),
        poses(120).chain([sweep("cav1", 1, 100)]),
    );
    assert_eq!(sent.len(), 2);
}

#[test]
fn a_pose_for_each_sweep_counts_also_where_float_seconds_have_rounded_its_stamp() {
    let moved = |by: Nanos| {
        let mut pose = pose("cav1", 600);
        pose.header.stamp += by;
        let mut sync = sync(Settings::default());
        let (sent, out) = run(&mut sync, [pose, sweep("cav1", 0, 600)]);
        let mut late = Outputs::at(900 * MS);
        sync.on_wake(900 * MS, &mut late).unwrap();
        sync.on_end(&mut late).unwrap();
        (sent.len(), out.counted("no_pose") + late.counted("no_pose"))
    };
    assert_eq!([-128, 128, 1_000].map(moved), [(2, 0); 3]);
    assert_eq!(moved(2_000), (0, 1));
}

#[test]
fn an_outline_is_read_from_a_list() {
    let args = ["own_body=-2,3,-1,1".to_string()];
    let settings: Settings = realo_operator::config::parse(&args).unwrap();
    assert_eq!(settings.own_body, [-2.0, 3.0, -1.0, 1.0]);
}
