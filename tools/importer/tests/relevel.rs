//! A log whose body frames pitch and roll becomes one whose body frames are level, and nothing else changes.

use std::fs::File;
use std::path::Path;

use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion, Vector3};
use realo_importer::{Level, relevel};
use realo_logs::{
    AgentInfo, AgentKind, ChunkGroup, Log, LogInfo, LogWriter, McapFile, McapWriter, Schema, Stream, describe,
};
use realo_operator::{Source, StageOutputs};
use realo_player::{Player, PoseSource, Settings};
use realo_schemas::geometry::{View, transform_box, yaw_of};
use realo_schemas::{AgentState, Box3, Boxes, Message, Nanos, Payload, PointCloud, PoseStatus};

const START: Nanos = 1_700_000_000_000_000_000;
const MS: Nanos = 1_000_000;

/// Where the level body lies.
fn level_pose(t: f64) -> Isometry3<f64> {
    let heading = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), 0.4 + 0.2 * t);
    Isometry3::from_parts(Translation3::new(100.0 + 8.0 * t, -50.0, 3.0), heading)
}

/// Level from body: it pitches by up to 2° and rolls by 1°.
fn tilt(t: f64) -> UnitQuaternion<f64> {
    UnitQuaternion::from_euler_angles(0.017, 0.035 * (3.0 * t).sin(), 0.0)
}

fn state(pose: Isometry3<f64>) -> AgentState {
    AgentState {
        map_from_body: pose,
        covariance: None,
        velocity: None,
        angular_rate: None,
        status: PoseStatus::Recorded,
    }
}

fn object() -> Box3 {
    Box3 {
        center: [20.0, 5.0, 0.8],
        length: 4.5,
        width: 1.9,
        height: 1.6,
        yaw: 0.3,
        velocity: Some([8.0, 0.5, 0.0]),
        class: "car".into(),
        score: 1.0,
        track: Some(3),
        covariance: None,
    }
}

fn view() -> View {
    View {
        frame_from_camera: Isometry3::new(Vector3::new(1.0, 0.0, 1.5), Vector3::new(-1.2, 1.2, -1.2)),
        focal: [800.0, 800.0],
        center: [960.0, 540.0],
        size: [1920, 1080],
        margin: 1.0,
    }
}

/// Level ground and a wall, each point at its own time.
fn points() -> Vec<([f64; 3], i32)> {
    let mut points = Vec::new();
    for i in -50..50_i32 {
        for k in -50..50_i32 {
            let (x, y) = (0.7 * f64::from(i) + 0.1, 0.7 * f64::from(k) + 0.2);
            let z = if k > 40 { 0.2 * f64::from(i.rem_euclid(12)) } else { 0.0 };
            points.push(([x, y, z], (i + 50) * 1_000_000));
        }
    }
    points
}

fn agents() -> Vec<AgentInfo> {
    let agent = AgentInfo {
        name: "car".into(),
        kind: AgentKind::Vehicle,
        footprint: Some([-1.0, 3.0, -1.0, 1.0]),
        sensor: "LiDAR".into(),
        sensor_position: None,
    };
    vec![agent]
}

/// With attitude the poses tell the tilt; without, the points alone, and the frame lies 1.2 m over the ground.
fn make(path: &Path, attitude: bool) {
    make_with(path, attitude, None);
}

/// With an error, rad, the recorded poses roll by so much too far, and there are true ones.
fn make_with(path: &Path, attitude: bool, error: Option<f64>) {
    let mut log = LogWriter::create(path, &LogInfo::new("a test", agents())).unwrap();
    let lift = if attitude { 0.0 } else { 1.2 };
    let body_from_level = |t: f64| tilt(t).inverse() * Translation3::new(0.0, 0.0, -lift);
    for tick in 0..60 {
        let (stamp, t) = (START + tick * 10 * MS, 0.01 * tick as f64);
        let recorded = match attitude {
            true => level_pose(t) * body_from_level(t).inverse(),
            false => level_pose(t) * Translation3::new(0.0, 0.0, lift),
        };
        match error {
            None => log.pose("car", stamp, stamp, &state(recorded)).unwrap(),
            Some(error) => {
                let believed = recorded * UnitQuaternion::from_euler_angles(error, 0.0, 0.0);
                log.pose("car", stamp, stamp, &state(believed)).unwrap();
                log.pose_truth("car", stamp, stamp, &state(recorded)).unwrap();
            }
        }
        if tick % 10 != 0 || tick == 50 {
            continue;
        }
        let ready = stamp + 100 * MS;
        let mut columns = [(); 3].map(|()| Vec::new());
        let mut time = Vec::new();
        for (point, offset) in points() {
            // Where attitude is not known, nobody can tell how it changed during the sweep.
            let at = if attitude { t + 1e-9 * f64::from(offset) } else { t };
            let point = body_from_level(at) * Point3::from(point);
            columns
                .iter_mut()
                .zip([point.x, point.y, point.z])
                .for_each(|(column, v)| column.push(v as f32));
            time.push(offset);
        }
        let [x, y, z] = columns;
        let n = x.len();
        let cloud = PointCloud::new(x, y, z, vec![9_u8; n], time, vec![1_u16; n]).unwrap();
        log.cloud("car", stamp, ready, &cloud).unwrap();
        let here: Isometry3<f64> = nalgebra::convert(body_from_level(t));
        let boxes = Boxes(vec![transform_box(&here, &object())]);
        log.detections("car", stamp, ready, &boxes).unwrap();
        log.own_views("car", stamp, ready, &[view().moved(&here)]).unwrap();
        log.own_labels("car", stamp, ready, &boxes.0, Some(&[8]), true).unwrap();
        log.truth_views("car", stamp, ready, &[view().moved(&here)]).unwrap();
        log.truth("car", stamp, ready, &boxes.0, Some(&[8]), tick == 0).unwrap();
    }
    log.finish().unwrap();
}

/// The largest distance of points, objects and poses from where they are in a level frame, m and rad.
fn worst(path: &Path) -> [f64; 3] {
    let log = Log::open(path).unwrap();
    let streams = Stream::ALL.into_iter().filter(|stream| log.has("car", *stream));
    let wanted: Vec<(&str, Stream)> = streams.map(|stream| ("car", stream)).collect();
    let mut reader = log.read_all(&wanted).unwrap();
    let (mut points_off, mut boxes_off, mut poses_off) = (0_f64, 0_f64, 0_f64);
    let mut counts = std::collections::BTreeMap::<Stream, usize>::new();
    while let Some(entry) = reader.next().unwrap() {
        *counts.entry(entry.stream).or_default() += 1;
        let t = 1e-9 * (entry.stamp() - START) as f64;
        match entry.stream {
            Stream::Points => {
                let cloud = entry.cloud().unwrap();
                assert_eq!(
                    (cloud.intensity[5], cloud.ring[5], entry.ready() - entry.stamp()),
                    (9, 1, 100 * MS)
                );
                for (i, (point, offset)) in points().into_iter().enumerate() {
                    assert_eq!(cloud.time[i], offset);
                    let found = Point3::new(cloud.x[i], cloud.y[i], cloud.z[i]).cast::<f64>();
                    points_off = points_off.max((found - Point3::from(point)).norm());
                }
            }
            Stream::Pose => {
                let found = entry.pose().unwrap().map_from_body;
                let up = found.rotation * Vector3::z();
                let turned = yaw_of(&found.rotation) - yaw_of(&level_pose(t).rotation);
                poses_off = poses_off.max((found.translation.vector - level_pose(t).translation.vector).norm());
                poses_off = poses_off.max(up.x.hypot(up.y)).max(turned.abs());
            }
            Stream::Detections | Stream::GroundTruth | Stream::OwnLabels => {
                let found = &entry.boxes().unwrap().0[0];
                let off = Vector3::from(found.center) - Vector3::from(object().center);
                boxes_off = boxes_off.max(off.norm()).max((found.yaw - object().yaw).abs());
                assert_eq!((found.length, found.track), (4.5, Some(3)));
            }
            Stream::GroundTruthInfo | Stream::OwnLabelsInfo => {
                let info = entry.info(&mut Boxes(vec![object()])).unwrap();
                assert_eq!(info.points, Some(vec![8]));
                assert_eq!(info.key, entry.stream == Stream::OwnLabelsInfo || t < 0.05);
            }
            Stream::GroundTruthViews | Stream::OwnLabelsViews => {
                let found = &entry.views().unwrap()[0];
                let off = found.frame_from_camera.to_homogeneous() - view().frame_from_camera.to_homogeneous();
                boxes_off = boxes_off.max(off.norm());
                assert_eq!((found.size, found.margin), ([1920, 1080], 1.0));
            }
            _ => {}
        }
    }
    for (stream, count) in &counts {
        assert_eq!(*count, if *stream == Stream::Pose { 60 } else { 5 }, "{stream:?}");
    }
    assert_eq!(
        counts.len(),
        Stream::ALL.len() - 5,
        "all but packets, true poses and motion"
    );
    [points_off, boxes_off, poses_off]
}

#[test]
fn the_recorded_pose_levels_each_point_at_its_own_time() {
    let dir = tempfile::tempdir().unwrap();
    let (raw, level) = (dir.path().join("raw.mcap"), dir.path().join("level.mcap"));
    make(&raw, true);
    assert!(worst(&raw)[0] > 1.0 && worst(&raw)[2] > 0.01);
    let levelled = relevel(&raw, &level, Level::Pose).unwrap();
    let [points, boxes, poses] = worst(&level);
    // Poses are interpolated over 10 ms, points have single precision, and boxes were upright in the tilted frame.
    assert!(
        points < 1e-3 && boxes < 1e-3 && poses < 1e-9,
        "{points} m, {boxes}, {poses}"
    );
    let [min, most] = levelled["car"].degrees;
    assert!((0.9..1.1).contains(&min) && (2.0..2.3).contains(&most), "{levelled:?}");
    let shown = describe(&level).unwrap().to_string();
    assert!(shown.contains("LiDAR; levelled by pose, by 0.97° to"), "{shown}");
    let shown = describe(&raw).unwrap().to_string();
    assert!(
        shown.contains("LiDAR; TILTS by up to 2.2") && shown.contains("levelled while played; `realo-lab import log`"),
        "{shown}"
    );
    // What is level stays as it is.
    let again = dir.path().join("again.mcap");
    assert_eq!(relevel(&level, &again, Level::Pose).unwrap(), levelled);
    let as_it_is = dir.path().join("as_it_is.mcap");
    assert_eq!(relevel(&level, &as_it_is, Level::None).unwrap(), levelled);
    let [points, boxes, poses] = worst(&again);
    assert!(
        points < 1e-3 && boxes < 1e-3 && poses < 1e-9,
        "{points} m, {boxes}, {poses}"
    );
}

type Played = Vec<(Nanos, usize, Message)>;

fn play(config: Settings) -> Played {
    let mut player = Player::new(config).unwrap();
    let mut played = Vec::new();
    while let Some((time, output)) = player.next().unwrap() {
        let (port, message) = output.into_message();
        played.push((time, port.0, message));
    }
    played
}

fn config(log: &Path) -> Settings {
    Settings {
        log: log.into(),
        ..Settings::default()
    }
}

/// A copy without the messages of a topic.
fn without(topic: &str, from: &Path, to: &Path) {
    rewritten(from, to, |known, time| (known != topic).then_some(time));
}

/// A copy whose messages have other log times, given by their topic and their own, or are left out.
fn rewritten(from: &Path, to: &Path, time: impl Fn(&str, u64) -> Option<u64>) {
    let file = McapFile::open(from).unwrap();
    let mut mcap = McapWriter::new(File::create(to).unwrap(), "x", "realo", &file.metadata()["realo"]).unwrap();
    let stays = file
        .channels()
        .iter()
        .filter(|(_, channel)| time(&channel.topic, 1).is_some());
    let channels: std::collections::BTreeMap<_, _> = stays
        .map(|(id, channel)| {
            let schema = Schema::named(&channel.schema).unwrap();
            (
                *id,
                mcap.channel(&channel.topic, schema, ChunkGroup::of(&channel.schema)),
            )
        })
        .collect();
    let mut messages = file.messages(channels.keys().copied().collect(), 0..u64::MAX).unwrap();
    while let Some(raw) = messages.next().unwrap() {
        let (to, topic) = (channels[&raw.channel], &file.channels()[&raw.channel].topic);
        if let Some(log_time) = time(topic, raw.log_time) {
            mcap.copy(to, raw.sequence, log_time, raw.publish_time, raw.data())
                .unwrap();
        }
    }
    mcap.finish().unwrap();
}

#[test]
fn a_log_that_tilts_is_played_as_its_level_copy() {
    let dir = tempfile::tempdir().unwrap();
    let [plain, erring, bare] = ["plain", "erring", "bare"].map(|name| dir.path().join(name).with_extension("mcap"));
    make(&plain, true);
    make_with(&erring, true, Some(0.01));
    without("/car/detections_info", &plain, &bare);
    for (raw, offline, repeat) in [
        (&plain, false, 1),
        (&plain, false, 3),
        (&plain, true, 2),
        (&erring, false, 1),
        (&bare, false, 1),
    ] {
        let level = dir.path().join("level.mcap");
        relevel(raw, &level, Level::Pose).unwrap();
        let [found, expected] = [raw, &level].map(|log| {
            play(Settings {
                offline,
                repeat,
                ..config(log)
            })
        });
        assert_eq!(found.len(), (60 + 3 * 5) * repeat as usize);
        for (found, expected) in found.iter().zip(&expected) {
            assert_eq!(
                (found.0, found.1, &found.2.header),
                (expected.0, expected.1, &expected.2.header)
            );
            // Numbers as written are numbers as read.
            assert!(found.2.payload == expected.2.payload, "{:?} of {raw:?}", found.2.header);
        }
    }
}

#[test]
fn the_pose_that_is_played_levels_what_is_played_with_it() {
    let dir = tempfile::tempdir().unwrap();
    let raw = dir.path().join("raw.mcap");
    make_with(&raw, true, Some(0.03));
    let exact = [(true, PoseSource::Recorded), (false, PoseSource::True)];
    for (offline, pose) in exact {
        let played = play(Settings {
            offline,
            pose,
            ..config(&raw)
        });
        for (_, _, message) in played {
            let t = 1e-9 * (message.header.stamp - START) as f64;
            match message.payload {
                Payload::PointCloud(cloud) => {
                    for (i, (point, _)) in points().into_iter().enumerate() {
                        let found = Point3::new(cloud.x[i], cloud.y[i], cloud.z[i]).cast::<f64>();
                        assert!((found - Point3::from(point)).norm() < 1e-3, "{found} for {point:?}");
                    }
                }
                Payload::AgentState(found) => {
                    assert!((found.map_from_body.inverse() * level_pose(t)).rotation.angle() < 1e-9);
                }
                Payload::Boxes(boxes) => assert!(is_object(&boxes.0[0])),
                Payload::GroundTruth(truth) => {
                    let own = truth.own.unwrap();
                    assert!(is_object(&truth.boxes[0]) && is_object(&own.boxes[0]));
                    for seen in [&truth.views[0], &own.views[0]] {
                        let off = seen.frame_from_camera.inverse() * view().frame_from_camera;
                        assert!(off.rotation.angle() < 1e-3 && off.translation.vector.norm() < 1e-3);
                    }
                }
                other => panic!("{other:?}"),
            }
        }
    }
}

/// Boxes were upright in the tilted frame.
fn is_object(found: &Box3) -> bool {
    let off = Vector3::from(found.center) - Vector3::from(object().center);
    off.norm() < 1e-3 && (found.yaw - object().yaw).abs() < 1e-3
}

#[test]
fn without_attitude_the_ground_levels() {
    let dir = tempfile::tempdir().unwrap();
    let (raw, level) = (dir.path().join("raw.mcap"), dir.path().join("level.mcap"));
    make(&raw, false);
    relevel(&raw, &level, Level::Ground).unwrap();
    let [points, boxes, poses] = worst(&level);
    assert!(
        points < 0.02 && boxes < 0.02 && poses < 0.02,
        "{points} m, {boxes}, {poses}"
    );
}

#[test]
fn says_what_it_cannot_level() {
    let dir = tempfile::tempdir().unwrap();
    let (raw, out) = (dir.path().join("raw.mcap"), dir.path().join("out.mcap"));
    let mut log = LogWriter::create(&raw, &LogInfo::new("a test", agents())).unwrap();
    log.cloud("car", START, START, &PointCloud::empty()).unwrap();
    log.finish().unwrap();
    let error = |level, out: &Path| relevel(&raw, out, level).unwrap_err().to_string();
    assert!(error(Level::Pose, &out).contains("/car/pose"));
    let ground = error(Level::Ground, &out);
    assert!(
        ground.contains("/car/points") && ground.contains("no ground"),
        "{ground}"
    );
    assert!(error(Level::None, &raw).contains("the log that is read"));
    assert!(!out.exists());
}

/// All boxes of a log, with their companions, by topic and stamp.
fn all_boxes(path: &Path) -> Vec<(Stream, Nanos, Vec<Box3>)> {
    let log = Log::open(path).unwrap();
    let mut found = Vec::new();
    for (array, info) in [
        (Stream::Detections, Stream::DetectionsInfo),
        (Stream::GroundTruth, Stream::GroundTruthInfo),
        (Stream::OwnLabels, Stream::OwnLabelsInfo),
    ] {
        let read = |stream| {
            let mut reader = log.read_all(&[("car", stream)]).unwrap();
            std::iter::from_fn(move || reader.next().unwrap())
        };
        for (entry, info) in read(array).zip(read(info)) {
            let mut boxes = entry.boxes().unwrap();
            info.info(&mut boxes).unwrap();
            found.push((array, entry.stamp(), boxes.0));
        }
    }
    found
}

#[test]
fn boxes_are_joined_by_their_stamps_and_none_is_lost() {
    let dir = tempfile::tempdir().unwrap();
    let [plain, before, early, lost, level] =
        ["plain", "before", "early", "lost", "level"].map(|name| dir.path().join(name).with_extension("mcap"));
    make(&plain, true);
    relevel(&plain, &level, Level::Pose).unwrap();
    let expected = all_boxes(&level);
    assert!(expected.len() >= 15, "{} messages", expected.len());
    // Companions that are in the log before their boxes, or an earlier sweep's boxes.
    for (path, earlier) in [(&before, MS), (&early, 150 * MS)] {
        rewritten(&plain, path, |topic, time| match topic.ends_with("_info") {
            true => Some(time.saturating_sub(earlier as u64)),
            false => Some(time),
        });
        relevel(path, &level, Level::Pose).unwrap();
        assert_eq!(all_boxes(&level), expected, "{earlier} ns");
    }
    let third = expected[2].1;
    let cut = third as u64 + 50 * MS as u64;
    rewritten(&plain, &lost, |topic, time| {
        (topic != "/car/ground_truth_info" || time <= 1 || time > cut).then_some(time)
    });
    std::fs::remove_file(&level).unwrap();
    let error = relevel(&lost, &level, Level::Pose).unwrap_err().to_string();
    assert!(
        error.contains("lost.mcap") && error.contains("without their companion") && error.contains("/car/ground_truth"),
        "{error}"
    );
    assert!(!level.exists());
}
