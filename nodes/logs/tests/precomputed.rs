//! A copy of a log is the log with packets beside it.

mod common;

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

use common::{MS, START};
use realo_logs::{LaneStage, Levelled, Log, LogCopy, LogError, LogWriter, McapFile, Precomputed, SentPacket, Stream};
use realo_schemas::{Kind, Nanos, PoseStatus};

fn precomputed(agents: &[&str]) -> Precomputed {
    let arguments = BTreeMap::from([("model".to_string(), "lite-1".to_string())]);
    Precomputed {
        graph: "attfuse".into(),
        agents: agents.iter().map(|agent| agent.to_string()).collect(),
        compute: "measured".into(),
        lane: vec![LaneStage {
            stage: "others.encoder".into(),
            runs: "operator pillar-encoder".into(),
            arguments,
        }],
    }
}

fn packet(seq: u64) -> SentPacket {
    SentPacket {
        seq,
        kind: Kind::Features,
        frame: "rsu1/body".into(),
        codec: vec!["plain".into()],
        bytes: vec![seq as u8; 3000],
    }
}

/// Every message of a file: topic, number, times, payload.
type Messages = Vec<(String, u32, u64, u64, Vec<u8>)>;

fn messages(path: &Path) -> Messages {
    let file = McapFile::open(path).unwrap();
    let mut all = file
        .messages(file.channels().keys().copied().collect(), 0..u64::MAX)
        .unwrap();
    let mut found = Vec::new();
    while let Some(raw) = all.next().unwrap() {
        let topic = file.channels()[&raw.channel].topic.clone();
        found.push((topic, raw.sequence, raw.log_time, raw.publish_time, raw.data().to_vec()));
    }
    found.sort();
    found
}

fn stamp(seq: u64) -> Nanos {
    START + 50 * MS + seq as Nanos * 100 * MS
}

fn add(from: &Path, to: &Path, agents: &[&str], anew: &str, shift: u64) {
    let log = Log::open(from).unwrap();
    let mut copy = LogCopy::begin(&log, to, &precomputed(agents), &[anew.to_string()]).unwrap();
    for seq in 0..4 {
        copy.add(anew, stamp(seq), stamp(seq) + 90 * MS, &packet(seq + shift))
            .unwrap();
    }
    copy.finish().unwrap();
}

fn packets(path: &Path, agent: &str) -> Vec<SentPacket> {
    let log = Log::open(path).unwrap();
    let mut reader = log.read_all(&[(agent, Stream::Packets)]).unwrap();
    let mut found = Vec::new();
    while let Some(entry) = reader.next().unwrap() {
        assert_eq!(entry.ready(), entry.stamp() + 90 * MS);
        found.push(entry.packet().unwrap());
    }
    found
}

#[test]
fn all_of_the_log_stays_and_new_packets_take_the_place_of_old_ones() {
    let dir = tempfile::tempdir().unwrap();
    let [first, second, third, fourth] = ["a", "b", "c", "d"].map(|name| dir.path().join(name).with_extension("mcap"));
    common::make(&first);
    let before = messages(&first);
    add(&first, &second, &["rsu1"], "rsu1", 0);
    let with: Messages = messages(&second);
    let (new, old): (Messages, Messages) = with.into_iter().partition(|(topic, ..)| topic == "/rsu1/packets");
    assert!(old == before, "every message with its number, times and bytes");
    assert_eq!(new.len(), 4);
    let log = Log::open(&second).unwrap();
    assert_eq!(log.info().precomputed, Some(precomputed(&["rsu1"])));
    assert_eq!(log.key_frames(), Log::open(&first).unwrap().key_frames());
    assert!(log.truncation().is_none());

    add(&second, &third, &["cav1", "rsu1"], "cav1", 10);
    assert_eq!(packets(&third, "rsu1"), (0..4).map(packet).collect::<Vec<_>>());
    assert_eq!(packets(&third, "cav1"), (10..14).map(packet).collect::<Vec<_>>());
    // What is not named any more goes; what is new replaces.
    add(&third, &fourth, &["rsu1"], "rsu1", 20);
    assert_eq!(packets(&fourth, "rsu1"), (20..24).map(packet).collect::<Vec<_>>());
    assert!(!Log::open(&fourth).unwrap().has("cav1", Stream::Packets));
}

#[test]
fn a_copy_that_is_not_finished_leaves_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.mcap");
    common::make(&path);
    let log = Log::open(&path).unwrap();
    let same = LogCopy::begin(&log, &path, &precomputed(&[]), &[]);
    assert!(matches!(same, Err(LogError::Input { .. })));
    drop(LogCopy::begin(&log, &dir.path().join("b.mcap"), &precomputed(&[]), &[]).unwrap());
    assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 1);
}

#[test]
fn packets_are_added_to_level_frames_alone() {
    let dir = tempfile::tempdir().unwrap();
    let (raw, out) = (dir.path().join("raw.mcap"), dir.path().join("out.mcap"));
    let begun = |levelled: Option<&str>| {
        let mut log = LogWriter::create(&raw, &common::info()).unwrap();
        let mut state = common::state(0.0, PoseStatus::Recorded);
        state.map_from_body.rotation *= nalgebra::UnitQuaternion::from_euler_angles(0.0, 0.02, 0.0);
        log.pose("rsu1", START, START, &state).unwrap();
        let reported = |by: &str| Levelled {
            by: by.into(),
            degrees: [0.0, 0.0],
        };
        log.levelled(
            levelled
                .map(|by| ("rsu1".to_string(), reported(by)))
                .into_iter()
                .collect(),
        );
        log.finish().unwrap();
        let log = Log::open(&raw).unwrap();
        LogCopy::begin(&log, &out, &precomputed(&[]), &[]).map(|_| ())
    };
    let error = begun(None).unwrap_err().to_string();
    for part in ["raw.mcap", "poses of `rsu1`", "0.25°", "found 1.0", "realo import log"] {
        assert!(error.contains(part), "no `{part}` in: {error}");
    }
    begun(Some("none")).unwrap();
    let error = begun(Some("moon")).unwrap_err().to_string();
    assert!(
        error.contains("expected one of pose, ground, none, found `moon`"),
        "{error}"
    );
}

#[test]
fn lanes_that_would_make_other_messages_are_told_apart() {
    let one = precomputed(&["rsu1"]);
    assert_eq!(one.difference(&one.lane), None);
    let differs = |change: fn(&mut Vec<LaneStage>)| {
        let mut lane = one.lane.clone();
        change(&mut lane);
        one.difference(&lane).unwrap()
    };
    let model = differs(|lane| _ = lane[0].arguments.insert("model".into(), "lite-2".into()));
    assert_eq!(model, "with `others.encoder.model` = lite-1, here it is lite-2");
    let threads = differs(|lane| _ = lane[0].arguments.insert("threads".into(), "1".into()));
    assert_eq!(threads, "with `others.encoder.threads` = nothing, here it is 1");
    let runs = differs(|lane| lane[0].runs = "program mine.py 00".into());
    assert_eq!(
        runs,
        "by `operator pillar-encoder` in `others.encoder`, here it is `program mine.py 00`"
    );
    assert!(differs(Vec::clear).contains("with the stage `others.encoder`, which has no part in it here"));
    let more = differs(|lane| {
        let more = LaneStage {
            stage: "others.more".into(),
            ..lane[0].clone()
        };
        lane.push(more);
    });
    assert!(more.contains("without the stage `others.more`"), "{more}");
}
