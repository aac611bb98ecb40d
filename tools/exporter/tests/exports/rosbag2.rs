//! A bag of ROS 2: points, poses and boxes come back by its own map file.

use std::fs;
use std::path::Path;

use realo_logs::cdr::CdrReader;
use realo_logs::{Log, McapFile, Schema};

use crate::reading::{assert_same_boxes, assert_same_clouds, assert_same_poses, import, sweeps, try_export};
use crate::world::{AGENTS, MadeUp, SWEEPS, simulated};

#[test]
fn a_simulated_log_comes_back_with_its_names_and_stamps() {
    let dir = tempfile::tempdir().unwrap();
    let path = simulated(dir.path());
    let (out, back) = (dir.path().join("bag"), dir.path().join("back.mcap"));
    let exported = try_export("rosbag2", &path, &out, &[], false).unwrap();
    assert!(
        !exported.lost.iter().any(|line| line.contains("UNKNOWN")),
        "{:?}",
        exported.lost
    );
    import(&exported, &back);
    let (log, back) = (Log::open(&path).unwrap(), Log::open(&back).unwrap());
    for name in AGENTS {
        let (before, after) = (log.info().agent(name).unwrap(), back.info().agent(name).unwrap());
        assert_eq!((before.kind, before.footprint), (after.kind, after.footprint));
        let (before, after) = (sweeps(&log, name), sweeps(&back, name));
        assert_eq!((before.len(), after.len()), (SWEEPS, SWEEPS));
        for (before, after) in before.iter().zip(&after) {
            assert_eq!(before.stamp, after.stamp);
            assert_same_poses(&before.map_from_body, &after.map_from_body);
            assert_same_clouds(&before.cloud, &after.cloud, 0.0);
            assert_eq!(
                (&before.cloud.time, &before.cloud.ring),
                (&after.cloud.time, &after.cloud.ring)
            );
            assert_same_boxes(&before.truth, &after.truth);
            let tracks = |boxes: &[realo_schemas::Box3]| boxes.iter().map(|object| object.track).collect::<Vec<_>>();
            assert_eq!(tracks(&before.truth), tracks(&after.truth));
        }
    }
    let metadata = fs::read_to_string(out.join("metadata.yaml")).unwrap();
    for line in [
        "storage_identifier: mcap",
        "name: /cav1/objects",
        "type: visualization_msgs/msg/MarkerArray",
        "name: /cav1/detected_objects",
        "type: autoware_perception_msgs/msg/DetectedObjects",
    ] {
        assert!(metadata.contains(line), "{line} is not in\n{metadata}");
    }
    objects_of_autoware_are_those_of_detections(&out.join("bag_0.mcap"));
}

/// Each list of `DetectedObjects` has the header and the number of objects of its `Detection3DArray`, and its schema names what is
/// nested in it.
fn objects_of_autoware_are_those_of_detections(bag: &Path) {
    let file = McapFile::open(bag).unwrap();
    let of = |topic: &str| {
        let channel = file.channels().iter().find(|(_, channel)| channel.topic == topic);
        let mut messages = file.messages([*channel.unwrap().0].into(), 0..u64::MAX).unwrap();
        let mut found = Vec::new();
        while let Some(raw) = messages.next().unwrap() {
            let mut input = CdrReader::new(raw.data()).unwrap();
            let (stamp, frame) = input.header().unwrap();
            found.push((stamp, frame.to_string(), input.u32().unwrap()));
        }
        found
    };
    let (detections, objects) = (of("/cav1/objects"), of("/cav1/detected_objects"));
    assert_eq!((detections.len(), detections[0].2 > 0), (SWEEPS, true));
    assert_eq!(detections, objects);
    let text = Schema::DetectedObjects.text();
    for nested in [
        "autoware_perception_msgs/Shape",
        "geometry_msgs/Point32",
        "geometry_msgs/Twist",
    ] {
        assert_eq!(text.matches(&format!("MSG: {nested}\n")).count(), 1, "{nested}\n{text}");
    }
}

#[test]
fn a_log_without_truth_is_a_bag_without_objects() {
    let dir = tempfile::tempdir().unwrap();
    let log = MadeUp {
        truth: false,
        ..MadeUp::default()
    };
    let out = dir.path().join("bag");
    let exported = try_export("rosbag2", &log.write(dir.path()), &out, &[], false).unwrap();
    assert_eq!((exported.agents[0].sweeps, exported.agents[0].boxes), (2, 0));
    assert!(!fs::read_to_string(out.join("map.yml")).unwrap().contains("truth"));
    let none = MadeUp {
        clouds: false,
        ..MadeUp::default()
    };
    let error = try_export("rosbag2", &none.write(dir.path()), &dir.path().join("none"), &[], false).unwrap_err();
    assert!(error.contains("topic `/AGENT/points`: expected clouds"), "{error}");
}
