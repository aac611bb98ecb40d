//! Bags that real recorders wrote: as many messages with the same bytes and times as the Python package `rosbags` 0.11 reads.

use std::collections::BTreeSet;
use std::path::Path;

use realo_bags::{Draft, open, survey};
use sha2::{Digest, Sha256};

/// How many messages, and the sum of the first 8 bytes of the hash of each, with its log time.
fn figures(path: &Path) -> (u64, u64) {
    let bag = open(path).unwrap_or_else(|error| panic!("{error}"));
    let wanted: BTreeSet<usize> = (0..bag.connections().len()).collect();
    let mut messages = bag.messages(&wanted).unwrap();
    let (mut count, mut sum, mut last) = (0, 0u64, i64::MIN);
    while let Some(message) = messages.next().unwrap() {
        assert!(message.log_time >= last, "messages come in the order of time");
        last = message.log_time;
        let hash = Sha256::new()
            .chain_update(message.data())
            .chain_update(message.log_time.to_le_bytes())
            .finalize();
        sum = sum.wrapping_add(u64::from_le_bytes(std::array::from_fn(|i| hash[i])));
        count += 1;
    }
    let listed: u64 = bag.connections().iter().map(|connection| connection.messages).sum();
    assert_eq!(listed, count, "{}: the index counts as the messages", path.display());
    (count, sum)
}

#[test]
fn real_bags_have_the_messages_that_rosbags_reads() {
    let Some(data) = skipped::shared("data") else { return };
    for (path, count, sum) in [
        ("rosbag1/example.bag", 8647, 0xdc9c_6723_fc94_744a_u64),
        ("rosbag1/example-bz2.bag", 8647, 0xdc9c_6723_fc94_744a),
        ("rosbag1/example-lz4.bag", 8647, 0xdc9c_6723_fc94_744a),
        ("rosbag1/example-unsorted-chunks.bag", 3, 0x17a1_84ec_f9bf_31ee),
        ("rosbag1/no-messages.bag", 0, 0),
        ("rosbag1/ouster_512x10_raw.bag", 43, 0x028a_d3ae_8f95_3e30),
        (
            "rosbag2/mcap/bag_with_topics_and_service_events",
            10,
            0x887b_eb59_30ee_8821,
        ),
        ("rosbag2/mcap/cdr_test", 7, 0x7910_f88c_a78a_6d84),
        ("rosbag2/sqlite3/cdr_test", 7, 0x7910_f88c_a78a_6d84),
        ("rosbag2/mcap/test_bag_for_seek", 5, 0x9f02_c3b2_034e_1f7d),
        ("rosbag2/sqlite3/test_bag_for_seek", 5, 0x9f02_c3b2_034e_1f7d),
        ("rosbag2/mcap/wbag", 6074, 0x26f5_74f3_9a50_117c),
        ("rosbag2/sqlite3/wbag", 6074, 0x26f5_74f3_9a50_117c),
        ("rosbag2/sqlite3/empty_bag", 0, 0),
        ("packets/robosense_helios16p", 5, 0x7508_863a_7342_d209),
    ] {
        assert_eq!(figures(&data.join(path)), (count, sum), "{path}");
    }
    // Both containers hold the same; rosbags leaves these out, as the metadata say another time.
    let talkers = ["mcap", "sqlite3"].map(|storage| figures(&data.join("rosbag2").join(storage).join("talker")));
    assert_eq!((talkers[0], talkers[0].0), (talkers[1], 20));
    for single in ["only_services", "only_topics", "topics_and_services"] {
        figures(&data.join(format!("rosbag2/mcap/single/{single}.mcap")));
    }
}

#[test]
fn every_real_file_is_described_or_refused_by_name() {
    let Some(data) = skipped::shared("data") else { return };
    let robosense = survey(open(&data.join("packets/robosense_helios16p")).unwrap().as_ref()).unwrap();
    let shown = robosense.to_string();
    assert!(shown.contains("/robosense_packets  5 messages"), "{shown}");
    let Err(reason) = Draft::of(&[robosense]) else {
        panic!("there are no clouds")
    };
    assert!(
        reason.contains("packets (robosense_msgs/RobosenseScan) are not read"),
        "{reason}"
    );
    let wrong = survey(open(&data.join("rosbag2/sqlite3/wrong_rmw_test")).unwrap().as_ref()).unwrap();
    assert!(wrong.to_string().contains("serialised as `"), "{wrong}");
    let turtles = survey(open(&data.join("rosbag1/example.bag")).unwrap().as_ref())
        .unwrap()
        .to_string();
    assert!(
        turtles.contains("tf2_msgs/TFMessage") && turtles.contains("world -> turtle1"),
        "{turtles}"
    );
}
