//! Logs of others: sweeps in the frame of their sensor, times and intensities as other drivers write them.

mod common;

use std::collections::BTreeMap;
use std::fs::File;
use std::path::{Path, PathBuf};

use common::{MS, START};
use nalgebra::{Isometry3, Translation3, UnitQuaternion};
use realo_logs::cdr::CdrWriter;
use realo_logs::{
    ChannelId, ChunkGroup, Entry, Log, LogError, LogWriter, McapWriter, RECORDING_RECORD, Schema, Stream, boxes,
    describe, describe_any, pose,
};
use realo_schemas::{Nanos, PointCloud, PoseStatus};

const UINT32: u8 = 6;
const FLOAT32: u8 = 7;

/// A field behind x, y and z: name, type, and the same value for every point of a sweep.
type More = (&'static str, u8, [u8; 4]);

fn sweep(out: &mut Vec<u8>, stamp: Nanos, frame: &str, points: &[[f32; 3]], more: &[More]) {
    let mut fields = vec![("x", FLOAT32), ("y", FLOAT32), ("z", FLOAT32)];
    fields.extend(more.iter().map(|(name, kind, _)| (*name, *kind)));
    let step = 4 * fields.len();
    let mut cdr = CdrWriter::new(out);
    cdr.header(stamp, frame);
    cdr.u32(1);
    cdr.length(points.len());
    cdr.length(fields.len());
    for (i, (name, kind)) in fields.iter().enumerate() {
        cdr.string(name);
        cdr.u32(4 * i as u32);
        cdr.u8(*kind);
        cdr.u32(1);
    }
    cdr.bool(false);
    cdr.length(step);
    cdr.length(step * points.len());
    let mut data = Vec::new();
    for point in points {
        data.extend(point.iter().flat_map(|v| v.to_le_bytes()));
        more.iter().for_each(|(_, _, bytes)| data.extend(bytes));
    }
    cdr.bytes_mut(data.len()).copy_from_slice(&data);
    cdr.bool(true);
}

struct Made {
    _dir: tempfile::TempDir,
    path: PathBuf,
}

/// A writer with one channel a topic.
struct Writer {
    mcap: McapWriter,
    channels: BTreeMap<String, ChannelId>,
}

/// A log of `agents`, which `fill` puts messages into.
fn made(agents: &str, fill: impl FnOnce(&mut Writer)) -> Made {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("foreign.mcap");
    let entries = [
        ("format", "1"),
        ("program", "x"),
        ("source", "x"),
        ("agents", agents),
        ("map_frame", "map"),
        ("protocol", "default"),
        ("key_frames", "all"),
    ];
    let metadata: BTreeMap<String, String> = entries.map(|(k, v)| (k.to_string(), v.to_string())).into();
    let mut writer = Writer {
        mcap: McapWriter::new(File::create(&path).unwrap(), "x", "realo", &metadata).unwrap(),
        channels: BTreeMap::new(),
    };
    fill(&mut writer);
    writer.mcap.finish().unwrap();
    Made { _dir: dir, path }
}

const TWO: &str = r#"[{"name":"alice","kind":"vehicle"},{"name":"bob","kind":"roadside"}]"#;

fn put(writer: &mut Writer, topic: &str, schema: Schema, time: Nanos, encode: impl FnOnce(&mut Vec<u8>)) {
    let Writer { mcap, channels } = writer;
    let new = || mcap.channel(topic, schema, ChunkGroup::of(&schema.name()));
    let channel = *channels.entry(topic.into()).or_insert_with(new);
    mcap.write(channel, time as u64, time as u64, encode).unwrap();
}

fn transform(writer: &mut Writer, topic: &str, stamp: Nanos, [parent, child]: [&str; 2], pose: &Isometry3<f64>) {
    put(writer, topic, Schema::TfMessage, stamp, |out| {
        pose::encode_transform(out, stamp, parent, child, pose);
    });
}

fn points(path: &Path, agent: &str) -> Result<Vec<PointCloud>, LogError> {
    let log = Log::open(path)?;
    let mut reader = log.read_all(&[(agent, Stream::Points)])?;
    let mut clouds = Vec::new();
    while let Some(entry) = reader.next()? {
        clouds.push(entry.cloud()?);
    }
    Ok(clouds)
}

fn one_sweep(writer: &mut Writer, agent: &str, stamp: Nanos, frame: &str, more: &[More]) {
    put(writer, &format!("/{agent}/points"), Schema::PointCloud2, stamp, |out| {
        sweep(out, stamp, frame, &[[1.0, 0.0, 0.0], [0.0, 2.0, -1.5]], more);
    });
}

fn shown(path: &Path) -> String {
    describe(path).unwrap().to_string()
}

#[test]
fn sweeps_of_the_sensor_are_brought_to_the_body_by_tf_static() {
    let quarter = UnitQuaternion::from_euler_angles(0.0, 0.0, std::f64::consts::FRAC_PI_2);
    let mounted = Isometry3::from_parts(Translation3::new(0.5, 0.0, 1.8), quarter);
    let made = made(TWO, |writer| {
        one_sweep(writer, "alice", START, "alice/lidar", &[]);
        one_sweep(writer, "bob", START, "/bob/body", &[]);
        // After the sweep: what is static holds for all times.
        transform(
            writer,
            "/tf_static",
            START + 900 * MS,
            ["alice/body", "alice/lidar"],
            &mounted,
        );
    });
    let clouds = points(&made.path, "alice").unwrap();
    for (found, expected) in [
        (&clouds[0].x, [0.5, -1.5]),
        (&clouds[0].y, [1.0, 0.0]),
        (&clouds[0].z, [1.8, 0.3]),
    ] {
        let close = found
            .iter()
            .zip(expected)
            .all(|(a, b): (&f32, f32)| (a - b).abs() < 1e-6);
        assert!(close && found.len() == 2, "{found:?} instead of {expected:?}");
    }
    assert_eq!(&points(&made.path, "bob").unwrap()[0].x[..], &[1.0f32, 0.0][..]);
    let shown = shown(&made.path);
    assert!(
        shown.contains("alice        frame alice/lidar, brought to the body frame by /tf_static; no times: all points"),
        "{shown}"
    );
    assert!(shown.contains("bob          frame /bob/body; no times"), "{shown}");
}

#[test]
fn moving_transforms_hold_at_the_sweeps_stamp() {
    let at = |x: f64| Isometry3::translation(x, 0.0, 0.0);
    let made = made(TWO, |writer| {
        for k in 0..20 {
            let stamp = START + k * 100 * MS;
            transform(writer, "/tf", stamp, ["map", "alice/body"], &at(0.7 * k as f64));
            transform(writer, "/tf", stamp, ["map", "alice/lidar"], &at(k as f64));
        }
        one_sweep(writer, "alice", START + 550 * MS, "alice/lidar", &[]);
    });
    let x = points(&made.path, "alice").unwrap()[0].x.to_vec();
    assert!((x[0] - 2.65).abs() < 1e-5 && (x[1] - 1.65).abs() < 1e-5, "{x:?}");
    assert!(shown(&made.path).contains("by /tf;"));
}

#[test]
fn sweeps_of_an_unknown_frame_are_refused_with_what_to_do() {
    for frame in ["alice/lidar", "", "bob/body", "alice/body2"] {
        let made = made(TWO, |writer| {
            one_sweep(writer, "alice", START, frame, &[]);
            transform(writer, "/tf", START, ["map", "alice/body"], &Isometry3::identity());
        });
        let error = points(&made.path, "alice").unwrap_err().to_string();
        let expected = format!(
            "/alice/points` at 1700000000.000 s: its frame is `{frame}`, expected `alice/body`, and no transform leads \
             there: /tf_static and /tf have only map → alice/body; put the transform from `alice/body` to `{frame}` on \
             /tf_static"
        );
        assert!(error.contains(&expected), "{error}");
        let shown = shown(&made.path);
        assert!(shown.contains("alice        CANNOT BE READ: its frame is"), "{shown}");
    }
}

#[test]
fn sweeps_that_cannot_be_read_are_one_problem_with_their_count() {
    let made = made(TWO, |writer| {
        transform(
            writer,
            "/tf_static",
            START,
            ["map", "alice/body"],
            &Isometry3::identity(),
        );
        for (k, frame) in ["alice/body", "lidar", "alice/body", "other"].into_iter().enumerate() {
            one_sweep(writer, "alice", START + k as Nanos * 100 * MS, frame, &[]);
        }
    });
    let shown = shown(&made.path);
    let line =
        "PROBLEM: 2 of 4 sweeps cannot be read, the first is /alice/points at 1700000000.100 s: its frame is `lidar`";
    assert_eq!(shown.matches(line).count(), 1, "{shown}");
    assert_eq!(shown.matches("its frame is").count(), 1, "{shown}");
}

#[test]
fn times_of_ouster_and_intensities_up_to_one_are_read_and_said() {
    let made = made(TWO, |writer| {
        for (k, v) in [0.0f32, 0.25, 1.0].into_iter().enumerate() {
            let stamp = START + k as Nanos * 100 * MS;
            let t = ("t", UINT32, 99_000_000u32.to_le_bytes());
            one_sweep(
                writer,
                "alice",
                stamp,
                "alice/body",
                &[("intensity", FLOAT32, v.to_le_bytes()), t],
            );
            let wide = ("intensity", FLOAT32, (v * 8.0).to_le_bytes());
            one_sweep(writer, "bob", stamp, "bob/body", &[wide]);
        }
    });
    let clouds = points(&made.path, "alice").unwrap();
    let found: Vec<(u8, i32)> = clouds.iter().map(|cloud| (cloud.intensity[0], cloud.time[1])).collect();
    assert_eq!(found, [(0, 99_000_000), (64, 99_000_000), (255, 99_000_000)]);
    let clouds = points(&made.path, "bob").unwrap();
    let found: Vec<u8> = clouds.iter().map(|cloud| cloud.intensity[1]).collect();
    assert_eq!(found, [0, 2, 8]);
    // The whole log decides, wherever reading begins.
    let log = Log::open(&made.path).unwrap();
    let mut reader = log
        .read(&[("bob", Stream::Points)], START + 50 * MS, START + 150 * MS)
        .unwrap();
    let entry: Entry = reader.next().unwrap().unwrap();
    assert_eq!(entry.cloud().unwrap().intensity[0], 2);
    let shown = shown(&made.path);
    assert!(
        shown.contains(
            "frame alice/body; times from t (uint32, ns from the stamp); intensities float32 in 0…1, scaled to 0…255\n"
        ),
        "{shown}"
    );
    assert!(
        shown
            .contains("frame bob/body; no times: all points are taken at the stamp; intensities float32 as they are\n"),
        "{shown}"
    );
}

#[test]
fn other_frames_of_poses_and_boxes_are_refused_and_the_header_has_the_stamp() {
    let made = made(TWO, |writer| {
        let state = common::state(0.0, PoseStatus::Recorded);
        put(writer, "/alice/pose", Schema::PoseWithCovarianceStamped, START, |out| {
            pose::encode(out, START, "odom", &state);
        });
        put(writer, "/alice/detections", Schema::Detection3DArray, START, |out| {
            boxes::encode(out, START, "alice/lidar", &common::objects(1));
        });
        put(writer, "/bob/points", Schema::PointCloud2, START, |out| {
            sweep(out, START + 1, "bob/body", &[], &[]);
        });
    });
    let log = Log::open(&made.path).unwrap();
    let mut reader = log
        .read_all(&[("alice", Stream::Pose), ("alice", Stream::Detections)])
        .unwrap();
    let error = reader.next().unwrap().unwrap().pose().unwrap_err().to_string();
    assert!(error.contains("its frame is `odom`, expected `map`"), "{error}");
    let error = reader.next().unwrap().unwrap().boxes().unwrap_err().to_string();
    assert!(
        error.contains("its frame is `alice/lidar`, expected `alice/body`"),
        "{error}"
    );
    let mut reader = log.read_all(&[("bob", Stream::Points)]).unwrap();
    let sweep = reader.next().unwrap().unwrap();
    assert_eq!(
        (sweep.stamp(), sweep.ready()),
        (START + 1, START),
        "the header's stamp counts"
    );
}

#[test]
fn agents_that_can_be_no_folder_are_refused_by_name() {
    for (name, shown) in [
        ("..", ".."),
        ("a/b", "a/b"),
        ("", ""),
        ("-o", "-o"),
        ("a\\u0000", "a\\0"),
    ] {
        let agents = format!(r#"[{{"name":"{name}","kind":"vehicle"}}]"#);
        let made = made(&agents, |_| {});
        let error = Log::open(&made.path).unwrap_err().to_string();
        assert!(
            error.contains("foreign.mcap`: metadata `agents`: `")
                && error.contains(&format!("{shown}` cannot name an agent")),
            "{error}"
        );
        let mut info = common::info();
        info.agents[0].name = serde_json::from_str(&format!("\"{name}\"")).unwrap();
        let path = made.path.with_file_name("new.mcap");
        let error = LogWriter::create(&path, &info).err().unwrap().to_string();
        assert!(error.contains("cannot name an agent") && !path.exists(), "{error}");
    }
}

#[test]
fn rates_are_those_between_the_first_and_the_last_message() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.mcap");
    common::make(&path);
    let description = describe(&path).unwrap();
    let rate = |topic: &str| description.topics[topic].rate_hz.unwrap();
    assert!((rate("/cav1/points") - 10.0).abs() < 1e-9, "{}", rate("/cav1/points"));
    assert!((rate("/rsu1/pose") - 100.0).abs() < 1e-9, "{}", rate("/rsu1/pose"));
    let shown = description.to_string();
    let line = shown.lines().find(|line| line.contains("/cav1/points")).unwrap();
    assert!(line.contains("10.0 Hz"), "{line}");
    let bytes = std::fs::read(&path).unwrap();
    std::fs::write(&path, &bytes[..bytes.len() / 2]).unwrap();
    let description = describe(&path).unwrap();
    let rate = description.topics["/cav1/points"].rate_hz.unwrap();
    assert!((rate - 10.0).abs() < 1e-9, "of a cut log {rate}");
    let once = made(TWO, |writer| one_sweep(writer, "alice", START, "alice/body", &[]));
    assert_eq!(describe(&once.path).unwrap().topics["/alice/points"].rate_hz, None);
}

#[test]
fn times_beyond_63_bits_are_the_last_there_are() {
    let made = made(TWO, |writer| {
        one_sweep(writer, "alice", START, "alice/body", &[]);
        let channel = writer.channels["/alice/points"];
        writer.mcap.write(channel, u64::MAX - 5, u64::MAX, |_| ()).unwrap();
    });
    let (first, last) = Log::open(&made.path).unwrap().span().unwrap();
    assert!(first == START && last >= Nanos::MAX - 1, "{first} {last}");
    let topic = &describe(&made.path).unwrap().topics["/alice/points"];
    assert_eq!(topic.channel.messages, 2);
    assert!(topic.rate_hz.unwrap() > 0.0);
    assert_eq!(points(&made.path, "alice").unwrap().len(), 1);
}

#[test]
fn recordings_are_described_as_such() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("recording.mcap");
    let metadata = BTreeMap::from([
        ("format".to_string(), "1".to_string()),
        ("program".into(), "realo 9".into()),
    ]);
    let mut mcap = McapWriter::new(File::create(&path).unwrap(), "x", RECORDING_RECORD, &metadata).unwrap();
    let boxes_topic = mcap.channel("/alice/boxes", Schema::Detection3DArray, ChunkGroup::Small);
    let reports = mcap.channel("/reports", Schema::String, ChunkGroup::Small);
    for k in 0..5 {
        let stamp = START + k * 50 * MS;
        let encode = |out: &mut Vec<u8>| boxes::encode(out, stamp, "alice/body", &[]);
        mcap.write(boxes_topic, stamp as u64, stamp as u64, encode).unwrap();
    }
    let text = |out: &mut Vec<u8>| CdrWriter::new(out).string("{}");
    mcap.write(reports, (START + 1000 * MS) as u64, START as u64, text)
        .unwrap();
    mcap.finish().unwrap();
    let described = describe_any(&path).unwrap();
    let shown = described.to_string();
    for line in [
        "recording of a run",
        "program   realo 9",
        "agents    alice\n",
        "time      1.000 s from 1700000000.000 s",
        "/alice/boxes                           5    20.0 Hz  vision_msgs/msg/Detection3DArray",
    ] {
        assert!(shown.contains(line), "no `{line}` in\n{shown}");
    }
    let json = serde_json::to_value(&described).unwrap();
    assert_eq!(json["topics"]["/alice/boxes"]["messages"], 5);
    assert_eq!(json["agents"], serde_json::json!(["alice"]));
    assert!(described.truncated().is_none());
    let bytes = std::fs::read(&path).unwrap();
    std::fs::write(&path, &bytes[..bytes.len() - 60]).unwrap();
    let cut = describe_any(&path).unwrap();
    assert!(cut.truncated().is_some() && cut.to_string().contains("TRUNCATED"));
    assert!(describe(&path).unwrap_err().to_string().contains("recording of a run"));
}

/// A log of one agent's poses on two channels of one topic, each with its stamps, in seconds.
fn two_channels(stamps: [&[i64]; 2]) -> Made {
    made(r#"[{"name":"alice","kind":"vehicle"}]"#, |writer| {
        for stamps in stamps {
            let mcap = &mut writer.mcap;
            let channel = mcap.channel("/alice/sweeps", Schema::Header, ChunkGroup::Small);
            for stamp in stamps.iter().map(|s| START + s * 1000 * MS) {
                let encode = |out: &mut Vec<u8>| CdrWriter::new(out).header(stamp, "alice/body");
                mcap.write(channel, stamp as u64, stamp as u64, encode).unwrap();
            }
        }
    })
}

#[test]
fn channels_of_a_topic_that_follow_each_other_are_one_stream() {
    let made = two_channels([&[0, 1, 2], &[3, 4]]);
    let log = Log::open(&made.path).unwrap();
    assert_eq!(log.count("alice", Stream::Sweeps), 5);
    assert_eq!(log.topics()["/alice/sweeps"].messages, 5);
    let mut reader = log.read_all(&[("alice", Stream::Sweeps)]).unwrap();
    let mut stamps = Vec::new();
    while let Some(entry) = reader.next().unwrap() {
        stamps.push((entry.stamp() - START) / (1000 * MS));
    }
    assert_eq!(stamps, [0, 1, 2, 3, 4]);
    let problems = describe(&made.path).unwrap().problems;
    assert!(
        problems[0].contains("has sweeps and no poses") && problems.len() == 1,
        "{problems:?}"
    );
}

#[test]
fn two_publishers_of_a_topic_are_named_with_what_to_do() {
    let made = two_channels([&[0, 2, 4], &[1, 3]]);
    let error = Log::open(&made.path).unwrap_err().to_string();
    for part in [
        "`/alice/sweeps`",
        "with 3 messages",
        "with 2 from",
        "two publishers",
        "leave one of them",
    ] {
        assert!(error.contains(part), "no `{part}` in {error}");
    }
}

#[test]
fn an_mcap_file_of_others_is_described_by_its_topics() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("bag.mcap");
    let mut mcap = McapWriter::new(File::create(&path).unwrap(), "x", "rosbag2", &BTreeMap::new()).unwrap();
    let imu = mcap.channel("/front/header", Schema::Header, ChunkGroup::Small);
    let encode = |out: &mut Vec<u8>| CdrWriter::new(out).header(START, "front");
    mcap.write(imu, START as u64, START as u64, encode).unwrap();
    mcap.finish().unwrap();
    for error in [Log::open(&path).unwrap_err(), describe_any(&path).unwrap_err()] {
        let error = error.to_string();
        for part in [
            "rosbag2",
            "/front/header (std_msgs/msg/Header)",
            "docs/reference/log-format.md",
            "python/realo_log.py",
        ] {
            assert!(error.contains(part), "no `{part}` in {error}");
        }
    }
}

#[test]
fn a_static_transform_of_two_values_is_refused_by_name() {
    let made = made(TWO, |writer| {
        one_sweep(writer, "alice", START, "alice/lidar", &[]);
        for (k, height) in [(0, 1.8), (1, 1.8), (2, 4.8)] {
            let mounted = Isometry3::from_parts(Translation3::new(0.5, 0.0, height), UnitQuaternion::identity());
            transform(
                writer,
                "/tf_static",
                START + k * MS,
                ["alice/body", "alice/lidar"],
                &mounted,
            );
        }
    });
    let error = points(&made.path, "alice").unwrap_err().to_string();
    for part in [
        "/alice/points",
        "`alice/body` → `alice/lidar` has two values",
        "3.000 m",
        "leave one of them",
    ] {
        assert!(error.contains(part), "no `{part}` in {error}");
    }
    assert!(shown(&made.path).contains("CANNOT BE READ"));
}
