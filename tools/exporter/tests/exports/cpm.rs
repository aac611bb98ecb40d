//! Collective Perception Messages: they decode to the boxes of the log, and what does not fit is refused by name.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

use realo_logs::{
    AgentInfo, AgentKind, ChunkGroup, Log, LogInfo, LogWriter, MAX_GAP, McapWriter, Schema, Stream, boxes as log_boxes,
    pose, pose_track,
};
use realo_operator::Steps;
use realo_schemas::geometry::transform_box;
use realo_schemas::{Box3, Boxes, Name, Payload};
use realo_transmission::Decoder;
use realo_transmission::cpm::{Geodetic, received, station_of};

use crate::reading::try_export;
use crate::world::{AGENTS, MadeUp, SWEEPS, recorded, simulated};

const ORIGIN: &str = "48.1374,11.5755,519";

fn origin() -> Geodetic {
    ORIGIN.to_string().try_into().unwrap()
}

/// The messages of an export: agent, stamp and boxes in the map, by the lines of its index.
fn messages(out: &Path) -> Vec<(String, i64, Vec<Box3>)> {
    let index = fs::read_to_string(out.join("index.csv")).unwrap();
    let mut lines = index.lines();
    assert_eq!(
        lines.next(),
        Some("file,agent,station_id,stamp_ns,reference_time_ms,objects,bytes")
    );
    let message = |line: &str| {
        let [file, agent, station, stamp, _, objects, size] = line.split(',').collect::<Vec<_>>().try_into().unwrap();
        let bytes = fs::read(out.join(file)).unwrap();
        assert_eq!(size, bytes.len().to_string());
        let message = received(&bytes, &Name::from("test"), 0, 0).unwrap();
        assert_eq!(*message.header.agent, format!("station-{station}"));
        assert_eq!(station, station_of(agent).to_string());
        let stamp: i64 = stamp.parse().unwrap();
        assert!((message.header.stamp - stamp).abs() <= 500_000);
        let Payload::Packet(packet) = &message.payload else {
            panic!("not a packet")
        };
        let mut decoder = Decoder::new(1 << 20).unwrap().with_origin(origin());
        let (decoded, _) = decoder
            .message(message.header.clone(), packet, &mut Steps::default())
            .unwrap();
        let Payload::Boxes(boxes) = &decoded.payload else {
            panic!("not boxes")
        };
        assert_eq!(objects, boxes.0.len().to_string());
        (agent.to_string(), stamp, boxes.0.clone())
    };
    lines.map(message).collect()
}

#[test]
fn each_list_of_a_log_is_a_message_that_decodes_to_its_boxes() {
    let dir = tempfile::tempdir().unwrap();
    let path = simulated(dir.path());
    let log = Log::open(&path).unwrap();
    for (boxes, stream) in [("truth", Stream::GroundTruth), ("detections", Stream::Detections)] {
        let out = dir.path().join(boxes);
        let exported = try_export("cpm", &path, &out, &[("origin", ORIGIN), ("boxes", boxes)], false).unwrap();
        let said = exported.to_string();
        assert!(
            said.contains("roadside units: rsu1") && said.contains("3 messages"),
            "{said}"
        );
        let found = messages(&out);
        assert_eq!(found.len(), AGENTS.len() * SWEEPS);
        let mut compared = 0;
        for name in AGENTS {
            let track = pose_track(&log, name, Stream::PoseTruth, MAX_GAP).unwrap();
            let mut reader = log.read_all(&[(name, stream)]).unwrap();
            while let Some(entry) = reader.next().unwrap() {
                let stamp = entry.stamp();
                let (.., after) = found
                    .iter()
                    .find(|(agent, of, _)| agent == name && *of == stamp)
                    .unwrap();
                let before = entry.boxes().unwrap().0;
                assert_eq!(before.len(), after.len());
                let map_from_body = track.at(stamp).unwrap();
                for (before, after) in before.iter().zip(after) {
                    let before = transform_box(&map_from_body, before);
                    for axis in 0..3 {
                        let apart = (before.center[axis] - after.center[axis]).abs();
                        assert!(apart < 0.011, "{apart} m");
                    }
                    assert!((before.length - after.length).abs() < 0.0501);
                    compared += 1;
                }
            }
        }
        assert!(compared > 10, "{compared}");
    }
}

/// The log of one vehicle that found these boxes once.
fn log_of(path: &Path, stamp: i64, boxes: &[Box3], origin: Option<[f64; 3]>) {
    let agent = AgentInfo {
        name: "car".into(),
        kind: AgentKind::Vehicle,
        footprint: None,
        sensor: String::new(),
        sensor_position: None,
    };
    let mut info = LogInfo::new("a test", vec![agent]);
    info.map_origin = origin;
    let mut log = LogWriter::create(path, &info).unwrap();
    for step in 0..3 {
        let at = stamp + step * 50_000_000;
        log.pose("car", at, at, &recorded(nalgebra::Isometry3::identity()))
            .unwrap();
    }
    log.sweep("car", stamp, stamp + 100_000_000).unwrap();
    log.detections("car", stamp, stamp + 100_000_000, &Boxes(boxes.to_vec()))
        .unwrap();
    log.finish().unwrap();
}

/// A log that no message holds: its name, stamp, boxes and origin, and what its refusal says.
struct Unfit {
    name: &'static str,
    stamp: i64,
    boxes: Vec<Box3>,
    origin: Option<[f64; 3]>,
    expected: &'static str,
}

fn unfit_logs() -> [Unfit; 5] {
    const STAMP: i64 = 1_767_225_600_000_000_000;
    let car = |x: f64| Box3::new("Car", [x, 3.0, 0.8], [4.2, 1.8, 1.6], 0.4);
    let train = Box3::new("Tram", [10.0, 3.0, 1.5], [31.2, 2.5, 3.5], 0.0);
    let many: Vec<Box3> = (0..300).map(|index| car(f64::from(index))).collect();
    let of = |name, boxes, expected| Unfit {
        name,
        stamp: STAMP,
        boxes,
        origin: Some([48.1374, 11.5755, 519.0]),
        expected,
    };
    [
        Unfit {
            origin: None,
            ..of("origin", vec![car(5.0)], "expected `map_origin` in the log or --origin")
        },
        of("many", many, "expected at most 255 objects in a message, found 300"),
        of("long", vec![car(5.0), train], "object 1 (`Tram`): expected"),
        of("far", vec![car(1400.0)], "object 0 (`Car`): expected"),
        Unfit {
            stamp: 5_000_000_000,
            ..of("time", vec![car(5.0)], "expected a stamp from 2004 to 2143")
        },
    ]
}

#[test]
fn what_a_message_cannot_hold_is_refused_by_name_or_left_out_and_counted() {
    let dir = tempfile::tempdir().unwrap();
    let mut said = BTreeMap::new();
    for unfit in unfit_logs() {
        let (name, expected) = (unfit.name, unfit.expected);
        let log = dir.path().join(format!("{name}.mcap"));
        log_of(&log, unfit.stamp, &unfit.boxes, unfit.origin);
        let out = dir.path().join(name);
        let error = try_export("cpm", &log, &out, &[], false).unwrap_err();
        assert!(error.contains(expected) && error.contains(name), "{error}");
        assert!(!out.exists(), "nothing of it is left");
        if let Ok(exported) = try_export("cpm", &log, &out, &[("unfit", "drop")], false) {
            assert_eq!(messages(&out).len(), 1);
            said.insert(name, (exported.agents[0].boxes, exported.left_out.join("; ")));
        }
    }
    let expected = [
        (
            "far",
            (
                0,
                "1 objects farther than 1,310.7 m from their agent, or longer than 25.4 m".to_string(),
            ),
        ),
        (
            "long",
            (
                1,
                "1 objects farther than 1,310.7 m from their agent, or longer than 25.4 m".to_string(),
            ),
        ),
        (
            "many",
            (
                255,
                "45 objects of the lowest scores, beyond 255 in a message".to_string(),
            ),
        ),
    ];
    assert_eq!(said, BTreeMap::from(expected));
    let none = MadeUp::default().write(dir.path());
    let error = try_export("cpm", &none, &dir.path().join("none"), &[("origin", ORIGIN)], false).unwrap_err();
    assert!(error.contains("topic `/AGENT/detections`: expected boxes"), "{error}");
    let fused = [("origin", ORIGIN), ("boxes", "fused")];
    let error = try_export("cpm", &none, &dir.path().join("none"), &fused, false).unwrap_err();
    assert!(
        error.contains("--boxes fused: expected the recording of a run"),
        "{error}"
    );
}

/// A log of others whose boxes are in this frame, and have these tracks.
fn foreign(path: &Path, frame: &str, tracks: [u64; 2]) {
    const STAMP: i64 = 1_767_225_600_000_000_000;
    let entries = [
        ("format", "1"),
        ("program", "x"),
        ("source", "x"),
        ("agents", r#"[{"name":"car","kind":"vehicle"}]"#),
        ("map_frame", "map"),
        ("protocol", "default"),
        ("key_frames", "all"),
        ("map_origin", "[48.1374,11.5755,519.0]"),
    ];
    let metadata: BTreeMap<String, String> = entries.map(|(key, value)| (key.to_string(), value.to_string())).into();
    let mut mcap = McapWriter::new(fs::File::create(path).unwrap(), "x", "realo", &metadata).unwrap();
    let mut channel = |topic: &str, schema: Schema| mcap.channel(topic, schema, ChunkGroup::of(&schema.name()));
    let poses = channel("/car/pose", Schema::PoseWithCovarianceStamped);
    let detections = channel("/car/detections", Schema::Detection3DArray);
    for step in 0..3 {
        let at = STAMP + step * 50_000_000;
        mcap.write(poses, at as u64, at as u64, |out| {
            pose::encode(out, at, "map", &recorded(nalgebra::Isometry3::identity()));
        })
        .unwrap();
    }
    let objects = tracks.map(|track| {
        let mut object = Box3::new("Car", [10.0 + track as f64, 3.0, 0.8], [4.2, 1.8, 1.6], 0.4);
        object.track = Some(track);
        object
    });
    mcap.write(detections, STAMP as u64, STAMP as u64, |out| {
        log_boxes::encode(out, STAMP, frame, &objects);
    })
    .unwrap();
    mcap.finish().unwrap();
}

#[test]
fn boxes_of_a_log_pass_the_checks_of_its_other_readers() {
    let dir = tempfile::tempdir().unwrap();
    let (log, out) = (dir.path().join("foreign.mcap"), dir.path().join("out"));
    foreign(&log, "car/lidar", [1, 2]);
    let error = try_export("cpm", &log, &out, &[], false).unwrap_err();
    assert!(
        error.contains("its frame is `car/lidar`, expected `car/body`"),
        "{error}"
    );
    assert!(!out.exists());
    foreign(&log, "car/body", [1, 2]);
    let exported = try_export("cpm", &log, &out, &[], false).unwrap();
    assert_eq!((exported.agents[0].sweeps, exported.agents[0].boxes), (1, 2));
}

#[test]
fn an_agent_that_is_not_there_is_refused_with_those_that_are() {
    let dir = tempfile::tempdir().unwrap();
    let (log, out) = (simulated(dir.path()), dir.path().join("out"));
    for (option, names) in [("roadside", "rsu1,rsu"), ("agents", "cav1,rsu")] {
        let set = [("origin", ORIGIN), ("boxes", "truth"), (option, names)];
        let error = try_export("cpm", &log, &out, &set, false).unwrap_err();
        assert!(
            error.contains("has no agent `rsu`; it has: cav1, cav2, rsu1"),
            "{error}"
        );
        assert!(!out.exists());
    }
}

#[test]
fn boxes_of_an_agent_itself_are_left_out_and_counted() {
    let dir = tempfile::tempdir().unwrap();
    let itself = MadeUp {
        object: Box3::new("Car", [1.0, 0.1, 0.8], [4.2, 1.8, 1.6], 0.0),
        ..MadeUp::default()
    };
    let log = itself.write(dir.path());
    for (kind, set, expected) in [
        (
            "cpm",
            &[("origin", ORIGIN), ("boxes", "truth")][..],
            "2 objects centred in the outline of their agent, which are the agent itself",
        ),
        (
            "opv2v",
            &[],
            "2 boxes centred in the outline of their agent, which are the agent itself",
        ),
        (
            "kitti",
            &[],
            "2 boxes centred in the outline of their agent, which are the agent itself",
        ),
    ] {
        let exported = try_export(kind, &log, &dir.path().join(kind), set, false).unwrap();
        assert_eq!(exported.left_out, [expected], "{kind}");
        assert_eq!(exported.agents[0].boxes, 0);
    }
}
