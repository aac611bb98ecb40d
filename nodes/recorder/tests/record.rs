//! What is recorded can be read again, also from a run that was killed or a disk that was full.

use std::path::Path;

use nalgebra::{Isometry3, Translation3, UnitQuaternion};
use realo_logs::{Log, LogError, McapFile};
use realo_operator::{Books, NodeBooks, PortId, Sink, StageInputs};
use realo_recorder::{FATES, Input, Recorder, Settings, footprints_of, read_boxes, read_reports, read_truth};
use realo_schemas::report::{Crossing, Fate, Fated, Use};
use realo_schemas::{
    AgentState, Box3, Boxes, GroundTruth, Header, Kind, Message, Name, Nanos, Packet, Payload, PointCloud, Pose,
    PoseStatus, Report,
};

const START: Nanos = 1_700_000_000_000_000_000;
const MS: Nanos = 1_000_000;

fn port(name: &str) -> PortId {
    PortId(Input::PORTS.iter().position(|port| port.name == name).unwrap())
}

fn header(agent: &str, kind: Kind, seq: u64) -> Header {
    let stamp = START + seq as Nanos * 100 * MS;
    Header::origin(&"recording".into(), &agent.into(), kind, seq, stamp, stamp + 53 * MS)
}

fn boxes(seq: u64) -> Message {
    let object = |i: u64| Box3 {
        center: [i as f64 / 3.0, -1.0 / 7.0, f64::from_bits(0x3ff5_5555_5555_5555)],
        length: 4.7,
        width: 1.0 + 1.0 / (i + 1) as f64,
        height: 1.5,
        yaw: -3.1 + i as f64 / 11.0,
        velocity: i.is_multiple_of(2).then_some([0.1, -0.2, f64::from(i as u32) / 3.0]),
        class: ["car", "pedestrian"][i as usize % 2].into(),
        score: 1.0 / (i + 3) as f32,
        track: (i == 1).then_some(77),
        covariance: (i == 2).then_some([0.1; 9]),
    };
    let mut header = header("cav1", Kind::Boxes, seq);
    let rotation = UnitQuaternion::from_euler_angles(0.0, 0.01, 0.2 * seq as f64);
    header.pose = Some(Pose::exact(Isometry3::from_parts(
        Translation3::new(1e5, 0.1, 0.2),
        rotation,
    )));
    Message::new(header, Boxes((0..seq % 5).map(object).collect()))
}

fn truth(seq: u64) -> Message {
    let (Payload::Boxes(objects), agents) = (boxes(seq).payload, ["cav1", "rsu1"]) else {
        panic!()
    };
    // A source that does not say how many points there are leaves them empty.
    let points = (0..if seq.is_multiple_of(2) {
        2 * objects.0.len() as u32
    } else {
        0
    })
        .collect();
    let agents = agents.map(Name::from).to_vec();
    let truth = GroundTruth {
        boxes: objects.0,
        agents,
        points,
        ego_footprint: None,
        key: seq.is_multiple_of(3),
        ..GroundTruth::default()
    };
    Message::new(header("cav1", Kind::Truth, seq), truth)
}

fn record(recorder: &mut Recorder, seq: u64) -> Result<(), realo_operator::Error> {
    let mut send = |name: &str, message: Message| recorder.on_message(port(name), message);
    let state = AgentState {
        map_from_body: Isometry3::identity(),
        covariance: None,
        velocity: None,
        angular_rate: None,
        status: PoseStatus::Recorded,
    };
    send("ego_state", Message::new(header("cav1", Kind::AgentState, seq), state))?;
    let mut packet = header("rsu1", Kind::Boxes, seq);
    packet.to = Some("cav1".into());
    send(
        "packets",
        Message::new(
            packet,
            Packet {
                codec: vec!["boxes".into()],
                bytes: vec![0u8; 900].into(),
            },
        ),
    )?;
    send("truth", truth(seq))?;
    let mut detections = boxes(seq);
    detections.header.agent = Name::from("rsu1");
    send("other_boxes", detections)?;
    send("boxes", boxes(seq))?;
    let report = Report {
        topic: "evaluation".into(),
        json: format!("{{\"query\":{seq}}}"),
    };
    send("evaluation", Message::new(header("cav1", Kind::Report, seq), report))?;
    let n = 5_000;
    let x: Vec<f32> = (0..n)
        .map(|i| ((i * 7919 + seq as usize * 104_729) % 10_007) as f32 * 0.0137)
        .collect();
    let cloud = PointCloud::new(x.clone(), x.clone(), x, vec![0u8; n], vec![0i32; n], vec![0u16; n]).unwrap();
    send("ego_clouds", Message::new(header("cav1", Kind::Points, seq), cloud))
}

fn config(path: &Path, clouds: bool) -> Settings {
    Settings {
        path: path.into(),
        clouds,
    }
}

fn fated() -> Fated {
    Fated {
        message: Crossing {
            from: "rsu1".into(),
            to: "cav1".into(),
            kind: Kind::Boxes,
            seq: 3,
        },
        fate: Fate::Used,
        r#use: Some(Use {
            query: 4,
            age_ns: 93_000_000,
        }),
        entry: None,
    }
}

fn books() -> Books {
    let node = NodeBooks {
        name: "nms".into(),
        ..NodeBooks::default()
    };
    Books {
        nodes: [("nms".to_string(), node)].into(),
    }
}

fn topics(path: &Path) -> Vec<String> {
    let file = McapFile::open(path).unwrap();
    let mut topics: Vec<String> = file.channels().values().map(|channel| channel.topic.clone()).collect();
    topics.sort();
    topics
}

#[test]
fn boxes_come_back_bit_for_bit_with_reports_and_the_rest() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("made/for/it/recording.mcap");
    let mut recorder = Recorder::new(config(&path, false)).unwrap();
    for seq in 0..30 {
        record(&mut recorder, seq).unwrap();
    }
    recorder.fates(&[]).unwrap();
    recorder.fates(std::slice::from_ref(&fated())).unwrap();
    recorder.finish(&books()).unwrap();
    let expected: Vec<Message> = (0..30).map(boxes).collect();
    assert_eq!(read_boxes(&path).unwrap(), expected);
    for (message, expected) in read_boxes(&path).unwrap().iter().zip(&expected) {
        let (Payload::Boxes(found), Payload::Boxes(wanted)) = (&message.payload, &expected.payload) else {
            panic!()
        };
        let bits = |object: &Box3| {
            (
                object.yaw.to_bits(),
                object.score.to_bits(),
                object.center.map(f64::to_bits),
            )
        };
        assert!(found.0.iter().map(bits).eq(wanted.0.iter().map(bits)));
    }
    assert_eq!(read_truth(&path).unwrap(), (0..30).map(truth).collect::<Vec<_>>());
    let reports = read_reports(&path).unwrap();
    assert_eq!(reports.len(), 32);
    assert_eq!(
        reports[4],
        serde_json::json!({"topic": "evaluation", "agent": "cav1", "report": {"query": 4}})
    );
    assert_eq!(reports[30]["topic"], FATES);
    let fates: Vec<Fated> = serde_json::from_value(reports[30]["report"].clone()).unwrap();
    assert_eq!(fates, [fated()]);
    assert_eq!(reports[31]["report"]["nodes"]["nms"]["name"], "nms");
    let expected = [
        "/cav1/boxes",
        "/cav1/boxes_info",
        "/cav1/boxes_markers",
        "/cav1/ground_truth",
        "/cav1/ground_truth_info",
        "/cav1/ground_truth_markers",
        "/cav1/pose",
        "/packets",
        "/reports",
        "/rsu1/detections",
        "/rsu1/detections_info",
        "/rsu1/detections_markers",
        "/tf",
    ];
    assert_eq!(topics(&path), expected);
}

#[test]
fn the_outlines_of_agents_come_back() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("r.mcap");
    let mut recorder = Recorder::new(config(&path, false)).unwrap();
    for seq in 0..30 {
        let Message { header, payload } = truth(seq);
        let Payload::GroundTruth(mut truth) = payload else {
            panic!()
        };
        truth.agents.push("cav2".into());
        truth.points.clear();
        truth.ego_footprint = Some([-1.25, 3.5, -0.875, 0.875]);
        truth.other_footprints = vec![None, Some([-1.0, 4.0, -1.0, 1.0])];
        recorder.on_message(port("truth"), Message::new(header, truth)).unwrap();
    }
    recorder.finish(&books()).unwrap();
    let found: Vec<(Name, [f64; 4])> = footprints_of(&path).unwrap().into_iter().collect();
    assert_eq!(
        found,
        [
            ("cav1".into(), [-1.25, 3.5, -0.875, 0.875]),
            ("cav2".into(), [-1.0, 4.0, -1.0, 1.0])
        ]
    );
    let topics = topics(&path);
    let outlines: Vec<&String> = topics.iter().filter(|topic| topic.ends_with("/footprint")).collect();
    assert_eq!(outlines, ["/cav1/footprint", "/cav2/footprint"]);
}

#[test]
fn clouds_are_recorded_when_asked_for() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("r.mcap");
    let mut recorder = Recorder::new(config(&path, true)).unwrap();
    record(&mut recorder, 0).unwrap();
    recorder.finish(&books()).unwrap();
    assert!(topics(&path).contains(&"/cav1/points".to_string()));
}

#[test]
fn a_killed_run_leaves_what_was_recorded() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("r.mcap");
    let mut recorder = Recorder::new(config(&path, true)).unwrap();
    for seq in 0..30 {
        record(&mut recorder, seq).unwrap();
    }
    // As if the process were gone: nothing is closed.
    std::mem::forget(recorder);
    for _ in 0..100 {
        if read_boxes(&path).is_ok_and(|left| left.len() >= 20) {
            break;
        }
        std::thread::sleep(std::time::Duration::from_millis(100));
    }
    let left = read_boxes(&path).unwrap();
    assert!(left.len() >= 20, "{}", left.len());
    assert!(
        left.iter()
            .enumerate()
            .all(|(seq, message)| *message == boxes(seq as u64))
    );
    assert!(McapFile::open(&path).unwrap().truncation().is_some());
}

#[test]
fn a_full_disk_is_a_clear_error() {
    let mut recorder = Recorder::new(config(Path::new("/dev/full"), true)).unwrap();
    let error = (0..100)
        .find_map(|seq| record(&mut recorder, seq).err())
        .or_else(|| recorder.finish(&books()).err());
    let error = error.unwrap().to_string();
    assert!(
        error.contains("/dev/full") && error.contains("No space left on device"),
        "{error}"
    );
    assert!(error.contains("what was written stays readable"), "{error}");
}

#[test]
fn logs_and_recordings_are_told_apart() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("r.mcap");
    Recorder::new(config(&path, false)).unwrap().finish(&books()).unwrap();
    assert!(read_boxes(&path).unwrap().is_empty());
    let error = Log::open(&path).unwrap_err().to_string();
    assert!(error.contains("recording of a run"), "{error}");
    let log = dir.path().join("log.mcap");
    realo_logs::LogWriter::create(&log, &realo_logs::LogInfo::new("x", vec![]))
        .unwrap()
        .finish()
        .unwrap();
    assert!(matches!(read_boxes(&log), Err(LogError::NotRealo { .. })));
    let error = Recorder::new(config(Path::new("/proc/nowhere/r.mcap"), false))
        .err()
        .unwrap()
        .to_string();
    assert!(
        error.contains("cannot make the folder of `/proc/nowhere/r.mcap`"),
        "{error}"
    );
}
