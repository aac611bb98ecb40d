//! Bags that are cut, missing, or something else: what is whole is read, or an error says what helps.

use std::fs;
use std::path::Path;

use realo_importer::look_at;

use super::import;
use super::wire::{Wire, detections, recorded};
use super::world::{MS, PLAIN, SWEEPS, T0, recording, sweep};
use super::writers::{db3, mcap, metadata, ros1};

const MAP: &str =
    "agents:\n  car:\n    clouds: /velodyne_points\n    frame: base_link\n    height: 0.3\n    pose: /odom\n";

fn refused(bag: &Path, map: Option<&str>) -> String {
    let log = bag.with_file_name("log.mcap");
    let error = import(&[bag.into()], map, &log)
        .expect_err("this is refused")
        .to_string();
    assert!(!log.exists(), "nothing is left of it");
    error
}

#[test]
fn a_cut_bag_gives_its_whole_chunks_and_says_what_is_lost() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("cut.bag");
    for packing in ["none", "lz4", "bz2"] {
        ros1(&path, &recording(PLAIN, 0.0, 0), packing);
        let bytes = fs::read(&path).unwrap();
        fs::write(&path, &bytes[..bytes.len() * 2 / 3]).unwrap();
        let summary = import(std::slice::from_ref(&path), Some(MAP), &dir.path().join("log.mcap")).unwrap();
        let note = &summary.notes[0];
        assert!(
            note.contains("cut at byte") && note.contains("chunks are lost"),
            "{note}"
        );
        assert!(summary.is_partial(), "{summary}");
        let sweeps = summary.agents[0].sweeps as i64;
        assert!((SWEEPS / 2..SWEEPS).contains(&sweeps), "{packing}: {sweeps}");
    }
}

#[test]
fn a_bag_that_was_not_closed_is_read() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("active.bag");
    ros1(&path, &recording(PLAIN, 0.0, 0), "none");
    let mut bytes = fs::read(&path).unwrap();
    // As the recorder leaves it: no position of the index, no connections at the end.
    let at = bytes.windows(10).position(|part| part == b"index_pos=").unwrap() + 10;
    let end = u64::from_le_bytes(bytes[at..at + 8].try_into().unwrap()) as usize;
    bytes.truncate(end);
    bytes[at..at + 8].fill(0);
    fs::write(&path, bytes).unwrap();
    let summary = import(std::slice::from_ref(&path), Some(MAP), &dir.path().join("log.mcap")).unwrap();
    assert_eq!(summary.agents[0].sweeps as i64, SWEEPS);
    assert!(
        summary.notes[0].contains("not closed") && summary.notes[0].contains("rosbag reindex"),
        "{summary}"
    );
}

#[test]
fn cut_files_of_ros_2_give_what_is_whole() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("cut.mcap");
    mcap(&path, &recording(PLAIN, 0.0, 0), Wire::Little);
    let bytes = fs::read(&path).unwrap();
    fs::write(&path, &bytes[..bytes.len() * 2 / 3]).unwrap();
    let summary = import(std::slice::from_ref(&path), Some(MAP), &dir.path().join("log.mcap")).unwrap();
    assert!(
        summary.notes[0].contains("cut at byte") && summary.is_partial(),
        "{summary}"
    );
    assert!((summary.agents[0].sweeps as i64) < SWEEPS);
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("cut.db3");
    db3(&path, &recording(PLAIN, 0.0, 0), Wire::Little, false);
    let bytes = fs::read(&path).unwrap();
    fs::write(&path, &bytes[..bytes.len() * 2 / 3]).unwrap();
    let error = refused(&path, Some(MAP));
    assert!(
        error.contains("cut.db3") && error.contains("damaged database"),
        "{error}"
    );
}

#[test]
fn a_missing_part_is_named() {
    let dir = tempfile::tempdir().unwrap();
    let bag = dir.path().join("bag");
    fs::create_dir(&bag).unwrap();
    let messages = recording(PLAIN, 0.0, 0);
    db3(&bag.join("bag_0.db3"), &messages, Wire::Little, false);
    metadata(
        &bag,
        &["bag_0.db3", "bag_1.db3", "bag/bag_2.db3"],
        ["", ""],
        messages.len(),
    );
    let error = refused(&bag, Some(MAP));
    for part in [
        "metadata.yaml",
        "2 of 3 parts are missing: `bag_1.db3`, `bag/bag_2.db3`",
        "fetch them",
    ] {
        assert!(error.contains(part), "{error}");
    }
    // Without metadata nobody knows, and what is there is read.
    fs::remove_file(bag.join("metadata.yaml")).unwrap();
    let summary = import(&[bag], Some(MAP), &dir.path().join("log.mcap")).unwrap();
    assert!(
        summary.notes[0].contains("no metadata.yaml") && !summary.is_partial(),
        "{summary}"
    );
}

#[test]
fn whole_bags_are_not_partial_whatever_is_noted() {
    let dir = tempfile::tempdir().unwrap();
    let [path, log, again] = ["some.bag", "log.mcap", "again.mcap"].map(|name| dir.path().join(name));
    ros1(&path, &recording(PLAIN, 0.0, 0), "none");
    let summary = import(&[path], Some(MAP), &log).unwrap();
    assert!(summary.notes.is_empty() && !summary.is_partial(), "{summary}");
    let map = "agents:\n  car:\n    clouds: /car/points\n    frame: car/body\n    height: 0\n    pose: /car/pose\n";
    let summary = import(&[log], Some(map), &again).unwrap();
    assert!(
        summary.notes[0].contains("a log of realo") && !summary.is_partial(),
        "{summary}"
    );
}

#[test]
fn what_is_no_bag_is_named() {
    let dir = tempfile::tempdir().unwrap();
    let file = |name: &str, content: &[u8]| {
        let path = dir.path().join(name);
        fs::write(&path, content).unwrap();
        path
    };
    for (name, content, expected) in [
        (
            "lfs.bag",
            &b"version https://git-lfs.github.com/spec/v1\n"[..],
            "git lfs pull",
        ),
        ("empty.db3", b"", "an empty file"),
        ("text.mcap", b"hello", "found a file that begins with [68, 65"),
        ("old.bag", b"#ROSBAG V1.2\n", "rosbag fix"),
        (
            "some.pkl",
            b"\x80\x04\x95\x08",
            "a pickle of Python, which is never loaded",
        ),
        ("some.ply", b"ply\nformat ascii 1.0\n", "a cloud of PLY"),
        ("some.bag.gz", b"\x1f\x8b\x08\x00", "gunzip -k"),
        ("short.db3", b"SQLite format 3\0", "less than its head"),
    ] {
        let error = refused(&file(name, content), None);
        assert!(error.contains(name) && error.contains(expected), "{error}");
    }
    let empty = dir.path().join("folder");
    fs::create_dir(&empty).unwrap();
    let error = refused(&empty, None);
    assert!(error.contains("found no part"), "{error}");
    assert!(refused(&dir.path().join("nothing.bag"), None).contains("nothing.bag"));
    fs::write(empty.join("metadata.yaml"), "rosbag2_bagfile_information: [1]\n").unwrap();
    let error = refused(&empty, None);
    assert!(error.contains("expected the metadata of a bag"), "{error}");
}

#[test]
fn sizes_that_would_take_gigabytes_are_not_believed() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("big.bag");
    ros1(&path, &recording(PLAIN, 0.0, 0), "lz4");
    let mut bytes = fs::read(&path).unwrap();
    let at = bytes.windows(5).position(|part| part == b"size=").unwrap() + 5;
    bytes[at..at + 4].fill(0xff);
    fs::write(&path, bytes).unwrap();
    let error = refused(&path, Some(MAP));
    assert!(
        error.contains("are said to unpack to 4294967295") && error.contains("big.bag"),
        "{error}"
    );
}

#[test]
fn what_is_missing_for_a_log_is_named() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("some.bag");
    let without = |topic: &str| {
        let mut messages = recording(PLAIN, 0.0, 0);
        messages.retain(|message| message.topic != topic);
        ros1(&path, &messages, "none");
    };
    without("/tf_static");
    let error = refused(&path, Some(MAP));
    for part in [
        "expected sweeps, none is left",
        "`velodyne`",
        "`base_link`",
        "mounts: {velodyne: [x, y, z",
    ] {
        assert!(error.contains(part), "{error}");
    }
    let mounted = format!("{MAP}    mounts: {{velodyne: [1, 0, 1.6, 0, 0, 0]}}\n");
    let log = dir.path().join("log.mcap");
    assert_eq!(
        import(std::slice::from_ref(&path), Some(&mounted), &log)
            .unwrap()
            .agents[0]
            .sweeps as i64,
        SWEEPS
    );
    fs::remove_file(&log).unwrap();
    without("/odom");
    let error = refused(&path, None);
    assert!(
        error.contains("no transform") || error.contains("expected transforms"),
        "{error}"
    );
    let error = refused(&path, Some(MAP));
    assert!(error.contains("has no topic `/odom`"), "{error}");
    without("/velodyne_points");
    let error = refused(&path, None);
    assert!(error.contains("expected a topic of sensor_msgs/PointCloud2"), "{error}");
    without("");
    for (from, to, expected) in [
        (
            "/odom",
            "/ground_truth",
            "agents.car.pose: expected `tf`, or a topic of Odometry",
        ),
        ("/velodyne_points", "/points", "it has `/velodyne_points`"),
        ("height: 0.3", "height: 0.3\n    colour: red", "unknown field `colour`"),
        ("agents:", "world: odom\nagents:", "write `world: map`"),
        (
            "pose: /odom",
            "pose: !!python/object/apply:os.system ['touch /tmp/never']",
            "pose",
        ),
        (
            "    pose: /odom\n",
            "    pose: /odom\n  mast:\n    clouds: /velodyne_points\n    frame: base_link\n    pose: /odom\n",
            "is the topic of `car` already",
        ),
    ] {
        let error = refused(&path, Some(&MAP.replace(from, to)));
        assert!(error.contains(expected), "{error}");
    }
    assert!(!Path::new("/tmp/never").exists());
}

#[test]
fn unknown_serialisations_are_refused_by_name() {
    let dir = tempfile::tempdir().unwrap();
    let bag = dir.path().join("bag.db3");
    db3(&bag, &recording(PLAIN, 0.0, 0), Wire::Little, false);
    let bytes = fs::read(&bag).unwrap();
    let text: Vec<u8> = bytes
        .windows(3)
        .enumerate()
        .fold(bytes.clone(), |mut changed, (at, part)| {
            if part == b"cdr" {
                changed[at..at + 3].copy_from_slice(b"xdr");
            }
            changed
        });
    fs::write(&bag, text).unwrap();
    let error = refused(&bag, Some(MAP));
    assert!(error.contains("serialised as `xdr`, expected cdr"), "{error}");
}

#[test]
fn messages_that_cannot_be_read_are_left_out_and_counted() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("some.bag");
    let mut messages = recording(PLAIN, 0.0, 0);
    let wrong = T0 + 950 * MS;
    messages.push(recorded("/odom", "nav_msgs/Odometry", wrong, |out| out.u32(1)));
    messages.push(detections(
        "/ground_truth",
        wrong + MS,
        wrong + MS,
        "nowhere",
        vec![("Car", "1", [0.0; 4], [1.0; 3])],
    ));
    messages.push(sweep("/velodyne_points", wrong + 2 * MS, T0, "velodyne"));
    ros1(&path, &messages, "none");
    let map = format!("{MAP}    truth: /ground_truth\n");
    let summary = import(&[path], Some(&map), &dir.path().join("log.mcap")).unwrap();
    let left_out = summary.to_string();
    for part in [
        "left out: 1 × /odom: ",
        "/ground_truth: objects are in `nowhere`",
        "/velodyne_points: its stamp does not lie",
    ] {
        assert!(left_out.contains(part), "{left_out}");
    }
}

#[test]
fn auto_recognises_bags_by_their_bytes() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("some.dat");
    ros1(&path, &recording(PLAIN, 0.0, 0), "none");
    assert_eq!(look_at(&path).only(&path).unwrap().kind().name, "bag");
    let log = dir.path().join("log.mcap");
    import(&[path], Some(MAP), &log).unwrap();
    let seen = look_at(&log);
    assert!(
        seen.fits.is_empty() && seen.to_string().contains("recording of realo already"),
        "{seen}"
    );
}

#[test]
fn a_topic_that_is_there_many_times_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    let bag = dir.path().join("bag.db3");
    db3(&bag, &recording(PLAIN, 0.0, 0), Wire::Little, false);
    let mut bytes = fs::read(&bag).unwrap();
    // The second pointer of the page of topics leads to the row of the first.
    let name: &[u8] = b"nav_msgs/msg/Odometry";
    let page = bytes
        .chunks_mut(1024)
        .find(|page| page[0] == 0x0d && page.windows(name.len()).any(|part| part == name))
        .unwrap();
    page.copy_within(8..10, 10);
    fs::write(&bag, &bytes).unwrap();
    let error = refused(&bag, Some(MAP));
    assert!(error.contains("twice in `topics`"), "{error}");
}
