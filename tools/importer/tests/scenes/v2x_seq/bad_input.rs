//! What is missing, damaged, doubled or mixed is refused or counted by name.

use std::fs;

use realo_importer::{importer, look_at};
use serde_json::json;

use super::{LISTS, Made, read};
use crate::reading::import;

/// Refused, with these lines.
fn refused(made: &Made, lines: &[&str]) {
    let error = made.import(&[]).unwrap_err();
    for line in lines {
        assert!(error.contains(line), "{line} is not in\n{error}");
    }
    assert!(!made.out().exists());
}

/// Everything that an import says, of the data set too.
fn said(made: &Made) -> String {
    let kind = importer("v2x-seq").unwrap();
    let job = kind.job(&made.data(), &made.out(), &kind.kind().defaults()).unwrap();
    job.run(&mut |_, _, _| {})
        .unwrap_or_else(|error| panic!("{error}"))
        .to_string()
}

#[test]
fn lists_of_two_data_sets_are_refused_by_name() {
    let made = Made::new(1);
    made.edit(LISTS[0], |entries| {
        entries.push(json!({"vehicle_pointcloud_path": "vehicle-side/velodyne/000100.pcd"}));
    });
    let line = "`cooperative/data_info.json` has entries of two data sets: `vehicle_pointcloud_path` in entry 3, as DAIR-V2X-C has it, \
                and `vehicle_frame` in entry 0, as V2X-Seq-SPD; unpack each into a folder of its own";
    for kind in ["v2x-seq", "dair"] {
        let error = import(kind, &made.data(), &made.out(), &[]).unwrap_err();
        assert!(error.contains(line), "{error}");
    }
    let error = look_at(&made.data()).only(&made.data()).err().unwrap().to_string();
    assert!(error.contains(&format!("it is not `dair`: {line}")), "{error}");
    // One whose pairs name files is of the other kind.
    made.edit(LISTS[0], |entries| drop(entries.drain(..3)));
    let error = import("v2x-seq", &made.data(), &made.out(), &[]).unwrap_err();
    assert!(error.contains("try `realo-lab import dair "), "{error}");
}

#[test]
fn all_that_is_missing_or_damaged_is_listed_at_once_and_can_be_left_out() {
    let made = Made::new(2);
    let data = made.data();
    fs::remove_file(data.join("cooperative/label/000009.json")).unwrap();
    fs::remove_file(data.join("vehicle-side/velodyne/000010.pcd")).unwrap();
    fs::remove_file(data.join("infrastructure-side/calib/virtuallidar_to_camera/000001.json")).unwrap();
    fs::write(data.join("infrastructure-side/velodyne/000102.pcd"), "").unwrap();
    fs::write(data.join("vehicle-side/label/lidar/000110.json"), "[{").unwrap();
    let logs = made.dir.path().join("logs");
    let error = import("v2x-seq", &data, &logs, &[]).unwrap_err();
    for line in [
        "4 of 6 frames are incomplete; missing or damaged:",
        "3 × no such file\n",
        "    cooperative/label/000009.json\n",
        "    vehicle-side/velodyne/000010.pcd\n",
        "    infrastructure-side/calib/virtuallidar_to_camera/000001.json\n",
        "1 × an empty file\n    infrastructure-side/velodyne/000102.pcd",
        "1 × damaged labels\n    vehicle-side/label/lidar/000110.json: EOF",
        "--skip-incomplete",
    ] {
        assert!(error.contains(line), "{line} is not in\n{error}");
    }
    let scenes = import("v2x-seq", &data, &logs, &[("skip-incomplete", "")]).unwrap();
    let frames: Vec<_> = scenes
        .iter()
        .map(|scene| (scene.frames, scene.incomplete_frames))
        .collect();
    assert_eq!(frames, [(1, 2), (1, 2)]);
    for list in &LISTS[..2] {
        fs::remove_file(data.join(list)).unwrap();
    }
    fs::write(data.join(LISTS[0]), "[{\"vehicle_frame\": \"000009\"}]").unwrap();
    fs::write(data.join(LISTS[2]), "[").unwrap();
    let error = import("v2x-seq", &data, &logs, &[]).unwrap_err();
    for line in [
        "vehicle-side/data_info.json`: ",
        "infrastructure-side/data_info.json`: EOF",
        "whether DIR is `V2X-Seq-SPD`",
    ] {
        assert!(error.contains(line), "{line} is not in\n{error}");
    }
}

#[test]
fn a_frame_that_is_in_no_list_is_named_and_counted() {
    let made = Made::new(1);
    made.edit(LISTS[1], |entries| {
        entries.retain(|entry| entry["frame_id"] != "000010")
    });
    made.edit(LISTS[2], |entries| {
        drop(entries[2].as_object_mut().unwrap().remove("label_lidar_std_path"))
    });
    refused(
        &made,
        &[
            "2 of 3 frames are incomplete",
            "1 × in no entry of vehicle-side/data_info.json\n    frame 000010",
            "1 × entry of infrastructure-side/data_info.json that is not usable\n    entry 2 (infrastructure-side/velodyne/000002.pcd): \
             missing field `label_lidar_std_path`",
        ],
    );
    let summary = made.import(&[("skip-incomplete", "")]).unwrap();
    assert_eq!(summary.frames, 1);
    let made = Made::new(1);
    made.edit(LISTS[1], Vec::clear);
    refused(
        &made,
        &[
            "3 of 3 frames are incomplete",
            "no frame is complete",
            "    frame 000011",
        ],
    );
    made.edit(LISTS[0], Vec::clear);
    // Without entries nothing tells the data sets apart.
    let error = import("v2x-seq", &made.data(), &made.out(), &[]).unwrap_err();
    assert!(error.contains("no entry of it has `vehicle_frame`"), "{error}");
}

#[test]
fn frames_that_are_listed_twice_are_counted_or_refused() {
    let made = Made::new(1);
    made.edit(LISTS[0], |entries| entries.push(entries[1].clone()));
    made.edit(LISTS[1], |entries| {
        entries.push(entries[1].clone());
        let mut other = entries[2].clone();
        other["pointcloud_timestamp"] = "1626155129881356".into();
        entries.push(other);
    });
    let text = said(&made);
    for line in [
        "note: in the data set, and in no log:",
        "1 × entry of cooperative/data_info.json that says again what another does\n    entry 3 (vehicle_frame 000010): as entry 1",
        "1 × entry of vehicle-side/data_info.json that says again what another does\n    entry 4: frame 000009",
        "entry 5 (vehicle-side/velodyne/000010.pcd): expected one entry of frame 000010, found two that differ; the first was taken",
        "1 × sequence with sweeps in no pair, which were left out\n    `0000`: 1 of vehicle-side, 0 of infrastructure-side",
    ] {
        assert!(text.contains(line), "{line} is not in\n{text}");
    }
    let made = Made::new(1);
    made.edit(LISTS[0], |entries| {
        let mut other = entries[1].clone();
        other["infrastructure_frame"] = "000002".into();
        entries.push(other);
    });
    let line = "entry 3 (vehicle_frame 000010): expected a frame in one pair, found it in entry 1 too; remove one";
    refused(&made, &["1 of 4 frames are incomplete", line]);
    assert_eq!(made.import(&[("skip-incomplete", "")]).unwrap().frames, 3);
}

#[test]
fn a_roadside_sweep_of_two_pairs_is_taken_once() {
    let made = Made::new(1);
    made.edit(LISTS[0], |entries| entries[0]["infrastructure_frame"] = "000001".into());
    made.edit("cooperative/label/000011.json", |labels| {
        labels
            .iter_mut()
            .for_each(|label| label["inf_frame_id"] = "000001".into());
    });
    let text = said(&made);
    let line = "1 × sequence with roadside sweeps in several pairs, which were taken once\n    `0000`: 1 times";
    assert!(text.contains(line), "{text}");
    let (_, found) = read(&made.out());
    let count = |name: &str| found.keys().filter(|(agent, _)| agent == name).count();
    assert_eq!((count("vehicle"), count("roadside")), (3, 2));
}

#[test]
fn a_sequence_without_pairs_or_without_cooperative_labels_is_named() {
    let made = Made::new(2);
    made.edit(LISTS[0], |entries| {
        entries.retain(|entry| entry["vehicle_sequence"] == "0000")
    });
    let text = said(&made);
    let line =
        "1 × sequence without a pair, which becomes no log\n    `0001`: 4 of vehicle-side, 3 of infrastructure-side";
    assert!(text.contains(line), "{text}");
    let made = Made::new(2);
    let data = made.data();
    for number in 109..112 {
        fs::remove_file(data.join(format!("cooperative/label/{number:06}.json"))).unwrap();
    }
    let logs = made.dir.path().join("logs");
    let error = import("v2x-seq", &data, &logs, &[]).unwrap_err();
    assert!(
        error.contains("3 of 6 frames are incomplete") && error.contains("    cooperative/label/000111.json"),
        "{error}"
    );
    // The other sequence is written all the same.
    assert!(
        error.contains("; written: ") && logs.join("0000.mcap").is_file(),
        "{error}"
    );
}

#[test]
fn sequences_that_contradict_each_other_are_refused() {
    let made = Made::new(1);
    made.edit(LISTS[0], |entries| {
        entries[0]["infrastructure_sequence"] = "0003".into()
    });
    made.edit(LISTS[1], |entries| entries[2]["sequence_id"] = "0008".into());
    refused(
        &made,
        &[
            "2 of 3 frames are incomplete",
            "entry 0: vehicle_sequence and infrastructure_sequence: expected one name, as `0000`, found `0000` and `0003`",
            "entry 1 (vehicle_frame 000010): expected frames of the sequence `0000`, found frame 000010 of vehicle-side/data_info.json in \
             sequence `0008`",
        ],
    );
}

#[test]
fn stamps_that_go_back_or_are_of_another_unit_are_refused() {
    let made = Made::new(1);
    made.edit(LISTS[2], |entries| {
        entries[1]["pointcloud_timestamp"] = "1626155103000000".into()
    });
    refused(
        &made,
        &[
            "1 of 3 frames are incomplete",
            "1 × frame whose stamp goes back\n    frame 000001: pointcloud_timestamp: expected one later than that of frame 000000, \
             1626155123904230 µs, found 1626155103000000 µs",
        ],
    );
    made.edit(LISTS[2], |entries| {
        entries[1]["pointcloud_timestamp"] = "1626155103".into()
    });
    refused(
        &made,
        &["entry 1 (infrastructure-side/velodyne/000001.pcd): pointcloud_timestamp: expected microseconds since 1970"],
    );
    made.edit(LISTS[0], |entries| {
        entries[0]["vehicle_frame"] = "last".into();
        entries[2]["system_error_offset"]["delta_x"] = "nan".into();
    });
    refused(
        &made,
        &[
            "entry 0: vehicle_frame: expected the digits of a frame, as `000009`, found `last`",
            "entry 2: system_error_offset: expected metres within ±1000",
        ],
    );
}

#[test]
fn tracks_that_are_twice_in_a_frame_are_refused() {
    for (file, field) in [
        ("cooperative/label/000009.json", "track_id"),
        ("cooperative/label/000009.json", "veh_track_id"),
        ("infrastructure-side/label/virtuallidar/000000.json", "track_id"),
    ] {
        let made = Made::new(1);
        let mut text = String::new();
        made.edit(file, |labels| {
            // With other zeros before it, it is the same.
            text = labels[0][field].as_str().unwrap().trim_start_matches('0').into();
            labels[1][field] = format!("0{text}").into();
        });
        let line =
            format!("{file}: label 1 (`Car`): {field}: expected each once in a frame, found `{text}` in label 0 too");
        refused(&made, &["1 of 3 frames are incomplete", &line]);
    }
}

#[test]
fn tracks_that_are_no_whole_numbers_are_texts_and_noted() {
    let made = Made::new(1);
    made.edit("cooperative/label/000009.json", |labels| {
        labels[0]["track_id"] = "car a".into();
        labels[1]["track_id"] = "-1".into();
        labels[2]["track_id"] = json!(null);
        labels[3]["type"] = "TrafficCone".into();
    });
    let summary = made.import(&[]).unwrap();
    let text = summary.to_string();
    let line = "note: taken as it is:\n  1 × track_id that is not a whole number: its text is the identity\n    \
                cooperative/label/000009.json: label 0: `car a`";
    assert!(text.contains(line), "{text}");
    let (_, found) = read(&made.out());
    let tracks: Vec<Option<u64>> = found
        .values()
        .find(|read| read.truth.len() == 4)
        .unwrap()
        .truth
        .iter()
        .map(|object| object.track)
        .collect();
    assert!(tracks[0].unwrap() > 1 << 63 && tracks[1..] == [None; 3], "{tracks:?}");
    made.edit("cooperative/label/000010.json", |labels| {
        labels[0]["track_id"] = json!([7])
    });
    fs::remove_file(made.out()).unwrap();
    refused(
        &made,
        &["label 0 (`Car`): track_id: expected a text or a whole number, -1 for none, found [7]"],
    );
}

#[test]
fn labels_of_another_frame_are_refused_and_those_far_from_the_vehicles_own_are_noted() {
    let made = Made::new(1);
    made.edit("cooperative/label/000009.json", |labels| {
        let x = labels[0]["3d_location"]["x"].as_f64().unwrap();
        labels[0]["3d_location"]["x"] = (x + 5.0).into();
    });
    let text = made.import(&[]).unwrap().to_string();
    let line = "1 × cooperative label more than 2 m from the vehicle's own label of its veh_track_id";
    assert!(
        text.contains(line) && text.contains("veh_track_id `9511`: 5.0 m"),
        "{text}"
    );
    fs::remove_file(made.out()).unwrap();
    made.edit("cooperative/label/000009.json", |labels| {
        labels[0]["3d_location"]["x"] = 3400.0.into()
    });
    made.edit("cooperative/label/000010.json", |labels| {
        labels[2]["inf_frame_id"] = "000077".into()
    });
    made.edit("cooperative/label/000011.json", |labels| {
        labels[2]["rotation"] = 170.0.into()
    });
    refused(
        &made,
        &[
            "3 of 3 frames are incomplete",
            "cooperative/label/000009.json: label 0 (`Car`): expected a box within 1000 m of its agent",
            "cooperative/label/000010.json: label 2 (`Car`): inf_frame_id: expected 000001, as the pair of the file has it, found 000077",
            "cooperative/label/000011.json: label 2 (`Car`): expected a box within 1000 m of its agent, at most 100 m long, with a heading in \
             radians within ±4π",
        ],
    );
}
