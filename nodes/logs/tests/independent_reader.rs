//! The Python packages `mcap` and `mcap-ros2-support`, which share no code with us, decode a log of ours.

mod common;

use std::path::{Path, PathBuf};
use std::process::Command;

/// A Python with the packages, in a virtual environment under the build folder; `None` if there is none to be had.
fn python() -> Option<PathBuf> {
    let venv = Path::new(env!("CARGO_TARGET_TMPDIR")).join("mcap-venv");
    let python = venv.join("bin/python");
    let has = |python: &Path| {
        let check = Command::new(python)
            .args(["-c", "import mcap.reader, mcap_ros2.decoder"])
            .output();
        check.is_ok_and(|out| out.status.success())
    };
    if has(&python) {
        return Some(python);
    }
    let run = |command: &mut Command| command.output().is_ok_and(|out| out.status.success());
    let made = run(Command::new("python3").args(["-m", "venv"]).arg(&venv))
        && run(Command::new(&python).args(["-m", "pip", "install", "--quiet", "mcap", "mcap-ros2-support"]));
    (made && has(&python)).then_some(python)
}

const SCRIPT: &str = r#"
import json, struct, sys
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

counts, seen = {}, {}
with open(sys.argv[1], "rb") as file:
    reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
    header = reader.get_header()
    metadata = {m.name: m.metadata for m in reader.iter_metadata()}
    for schema, channel, message, decoded in reader.iter_decoded_messages():
        topic = channel.topic
        counts[topic] = counts.get(topic, 0) + 1
        stamp = message.publish_time
        if topic == "/cav1/points" and message.sequence == 3:
            d = decoded
            fields = {f.name: (f.offset, f.datatype) for f in d.fields}
            data = bytes(d.data)
            x = sum(struct.unpack_from("<f", data, i * d.point_step + fields["x"][0])[0] for i in range(d.width))
            t = sum(struct.unpack_from("<i", data, i * d.point_step + fields["time"][0])[0] for i in range(d.width))
            r = sum(struct.unpack_from("<H", data, i * d.point_step + fields["ring"][0])[0] for i in range(d.width))
            n = sum(data[i * d.point_step + fields["intensity"][0]] for i in range(d.width))
            seen["cloud"] = [d.width, x, t, r, n, d.header.frame_id, d.header.stamp.sec * 10**9 + d.header.stamp.nanosec - stamp]
        if topic == "/cav1/ground_truth" and message.sequence == 3:
            b = decoded.detections[2]
            seen["truth"] = [len(decoded.detections), b.id, b.results[0].hypothesis.class_id, b.bbox.center.position.x, b.bbox.size.x]
        if topic == "/cav1/ground_truth_info" and message.sequence == 3:
            seen["info"] = [decoded.seq, decoded.key, list(decoded.yaw), list(decoded.points), list(decoded.agents)]
        if topic == "/cav1/ground_truth_markers" and message.sequence == 3:
            seen["markers"] = [len(decoded.markers), decoded.markers[1].type, decoded.markers[1].scale.x, decoded.markers[3].text]
        if topic == "/cav1/pose_truth" and message.sequence == 7:
            seen["pose"] = [decoded.pose.pose.position.x, decoded.header.frame_id]
        if topic == "/tf" and message.sequence == 0:
            seen["tf"] = [decoded.transforms[0].header.frame_id, decoded.transforms[0].child_frame_id]
        if topic == "/cav1/sweeps" and message.sequence == 0:
            seen["sweep"] = decoded.frame_id
print(json.dumps({"profile": header.profile, "metadata": metadata, "counts": counts, "seen": seen}))
"#;

#[test]
fn python_decodes_every_topic() {
    let Some(python) = python() else {
        skipped::skip("Python 3 with `mcap` and `mcap-ros2-support`, which pip could not install");
        return;
    };
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.mcap");
    common::make(&path);
    let out = Command::new(python).args(["-c", SCRIPT]).arg(&path).output().unwrap();
    assert!(out.status.success(), "{}", String::from_utf8_lossy(&out.stderr));
    let found: serde_json::Value = serde_json::from_slice(&out.stdout).unwrap();

    assert_eq!(found["profile"], "ros2");
    assert!(found["metadata"]["realo"]["agents"].as_str().unwrap().contains("rsu1"));
    assert_eq!(found["metadata"]["realo"]["protocol"], "default");
    let log = realo_logs::Log::open(&path).unwrap();
    let counts: serde_json::Map<String, serde_json::Value> = log
        .topics()
        .into_iter()
        .map(|(topic, info)| (topic, info.messages.into()))
        .collect();
    assert_eq!(found["counts"], serde_json::Value::Object(counts));

    let seen = &found["seen"];
    let cloud = common::cloud(common::POINTS, 3);
    let x: f64 = cloud.x.iter().map(|v| f64::from(*v)).sum();
    let t: i64 = cloud.time.iter().map(|v| i64::from(*v)).sum();
    let r: i64 = cloud.ring.iter().map(|v| i64::from(*v)).sum();
    let n: i64 = cloud.intensity.iter().map(|v| i64::from(*v)).sum();
    assert!((seen["cloud"][1].as_f64().unwrap() - x).abs() < 1e-6);
    let rest = seen["cloud"].as_array().unwrap();
    let rest: Vec<_> = rest
        .iter()
        .enumerate()
        .filter(|(i, _)| *i != 1)
        .map(|(_, v)| v.clone())
        .collect();
    assert_eq!(
        serde_json::json!(rest),
        serde_json::json!([common::POINTS, t, r, n, "cav1/body", 0])
    );
    let objects = common::objects(3);
    let yaws: Vec<f64> = objects.iter().map(|object| object.yaw).collect();
    assert_eq!(
        seen["truth"],
        serde_json::json!([3, "102", "car", objects[2].center[0], 4.5])
    );
    assert_eq!(seen["info"], serde_json::json!([3, false, yaws, [0, 1, 2], ["cav1"]]));
    assert_eq!(seen["markers"], serde_json::json!([4, 1, 4.5, "car"]));
    assert_eq!(seen["pose"], serde_json::json!([1e5 + 10.0 * 0.07, "map"]));
    assert_eq!(seen["tf"], serde_json::json!(["map", "cav1/body"]));
    assert_eq!(seen["sweep"], "cav1/body");
}
