//! A made-up data set in forms that people have: files that are missing, marks and slashes of other systems, clouds as other
//! programs write them.

mod made_up;

use std::fs;
use std::path::Path;

use made_up::{POINTS, cloud, edit, head, lists, make, place, write};
use realo_importer::{DairOptions, Summary, VEHICLE, dair};
use realo_logs::{Log, Stream};
use realo_schemas::PointCloud;
use serde_json::{Value, json};

const FIRST: &str = "vehicle-side/velodyne/000100.pcd";

struct Made {
    folder: tempfile::TempDir,
}

impl Made {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        make(&folder.path().join("data"), 4);
        Made { folder }
    }

    fn data(&self) -> std::path::PathBuf {
        self.folder.path().join("data")
    }

    fn import(&self, skip_incomplete: bool) -> Result<Summary, String> {
        let options = DairOptions {
            skip_incomplete,
            ..DairOptions::default()
        };
        let out = self.folder.path().join("out.mcap");
        let done = dair(&self.data(), &out, options).map_err(|error| error.to_string());
        assert_eq!(done.is_ok(), out.exists());
        done
    }

    /// The vehicle's first cloud.
    fn cloud(&self) -> PointCloud {
        let log = Log::open(self.folder.path().join("out.mcap")).unwrap();
        let mut reader = log.read_all(&[(VEHICLE, Stream::Points)]).unwrap();
        reader.next().unwrap().expect("a sweep").cloud().unwrap()
    }
}

#[test]
fn all_that_is_missing_is_listed_at_once_or_left_out() {
    let made = Made::new();
    let data = made.data();
    assert_eq!(made.import(false).unwrap().pairs, 4);
    fs::remove_file(made.folder.path().join("out.mcap")).unwrap();
    fs::remove_file(data.join("infrastructure-side/velodyne/000202.pcd")).unwrap();
    fs::remove_file(data.join("cooperative/label_world/000102.json")).unwrap();
    fs::write(data.join("vehicle-side/calib/novatel_to_world/000101.json"), "").unwrap();
    fs::remove_file(data.join("vehicle-side/label/lidar/000103.json")).unwrap();
    let [together, _, roadside] = lists(&data);
    edit(&roadside, |list| drop(list.remove(3)));
    let without = |entry: &mut Value| drop(entry.as_object_mut().unwrap().remove("cooperative_label_path"));
    edit(&together, |list| {
        list.push(list[0].clone());
        without(list.last_mut().unwrap());
    });
    let error = made.import(false).unwrap_err();
    for line in [
        "4 of 5 pairs are incomplete",
        "1 × entry of cooperative/data_info.json that is not usable\n    entry 4: missing field `cooperative_label_path`",
        "3 × no such file\n",
        "infrastructure-side/velodyne/000202.pcd\n",
        "cooperative/label_world/000102.json\n",
        "1 × an empty file\n    vehicle-side/calib/novatel_to_world/000101.json",
        "vehicle-side/label/lidar/000103.json\n",
        "1 × in no entry of infrastructure-side/data_info.json\n    infrastructure-side/velodyne/000203.pcd",
        "--skip-incomplete",
    ] {
        assert!(error.contains(line), "{line} is not in\n{error}");
    }
    let summary = made.import(true).unwrap();
    assert_eq!(
        (
            summary.pairs,
            summary.incomplete_pairs,
            summary.missing.values().flatten().count()
        ),
        (1, 4, 6)
    );
    let said = summary.to_string();
    assert!(
        said.contains("left out: 4 pairs; missing or damaged:") && said.contains("000202.pcd"),
        "{said}"
    );
    fs::remove_file(made.folder.path().join("out.mcap")).unwrap();
    fs::remove_dir_all(data.join("vehicle-side/velodyne")).unwrap();
    let error = made.import(true).unwrap_err();
    assert!(error.contains("no pair is complete"), "{error}");
}

/// Damages one file in each of three of five pairs, and two of the fourth.
fn damage(data: &Path) {
    let cloud = data.join("vehicle-side/velodyne/000100.pcd");
    let bytes = fs::read(&cloud).unwrap();
    fs::write(&cloud, &bytes[..bytes.len() / 2]).unwrap();
    fs::write(data.join("infrastructure-side/label/virtuallidar/000201.json"), "[{").unwrap();
    let place = data.join("vehicle-side/calib/novatel_to_world/000102.json");
    fs::write(&place, r#"{"rotation": "none", "translation": [[0], [0], [0]]}"#).unwrap();
    fs::remove_file(data.join("infrastructure-side/velodyne/000203.pcd")).unwrap();
    let truth = data.join("cooperative/label_world/000103.json");
    fs::write(&truth, r#"{"type": "Car"}"#).unwrap();
}

#[test]
fn all_that_is_damaged_is_listed_with_all_that_is_missing_or_left_out() {
    let made = Made::new();
    let data = made.data();
    make(&data, 5);
    let [together, ..] = lists(&data);
    damage(&data);
    let error = made.import(false).unwrap_err();
    for line in [
        "4 of 5 pairs are incomplete; missing or damaged:",
        "1 × damaged calibration\n    vehicle-side/calib/novatel_to_world/000102.json: invalid type: string \"none\"",
        "1 × damaged cloud\n    vehicle-side/velodyne/000100.pcd: expected 4800 bytes for 300 points, found 2",
        "2 × damaged labels\n",
        "infrastructure-side/label/virtuallidar/000201.json: EOF",
        "cooperative/label_world/000103.json: invalid type: map",
        "1 × no such file\n    infrastructure-side/velodyne/000203.pcd\n",
        "--skip-incomplete",
    ] {
        assert!(error.contains(line), "{line} is not in\n{error}");
    }
    let summary = made.import(true).unwrap();
    assert_eq!((summary.pairs, summary.incomplete_pairs), (1, 4));
    assert_eq!(summary.missing.values().flatten().count(), 5);
    let said = summary.to_string();
    assert!(
        said.contains("left out: 4 pairs; missing or damaged:") && said.contains("2 × damaged labels"),
        "{said}"
    );
    let log = Log::open(made.folder.path().join("out.mcap")).unwrap();
    assert_eq!(log.span(), log.info().start.zip(log.info().end));
    // Entries that can be read and say nothing usable.
    edit(&together, |list| {
        list[4]["system_error_offset"]["delta_x"] = "nan".into();
    });
    fs::remove_file(made.folder.path().join("out.mcap")).unwrap();
    let error = made.import(true).unwrap_err();
    assert!(
        error.contains("5 of 5 pairs") && error.contains("system_error_offset: expected metres within ±1000"),
        "{error}"
    );
}

#[test]
fn lists_that_cannot_be_read_are_named_together() {
    let made = Made::new();
    let [together, vehicle, roadside] = lists(&made.data());
    fs::write(&together, "[").unwrap();
    fs::remove_file(&roadside).unwrap();
    let error = made.import(true).unwrap_err();
    for name in [&together, &roadside] {
        assert!(error.contains(&name.display().to_string()), "{error}");
    }
    assert!(!error.contains(&vehicle.display().to_string()), "{error}");
}

#[test]
fn entries_that_no_pair_needs_are_noted_and_needed_ones_are_listed_once_by_their_place() {
    let made = Made::new();
    let [together, vehicle, roadside] = lists(&made.data());
    edit(&vehicle, |list| {
        let mut double = list[0].clone();
        double["pointcloud_timestamp"] = "1600000000000000".into();
        list.insert(0, json!({}));
        list.push(double);
    });
    let summary = made.import(false).unwrap();
    assert_eq!(
        (summary.pairs, summary.incomplete_pairs, summary.missing.len()),
        (4, 0, 0)
    );
    let said = summary.to_string();
    for line in [
        "note: entries that were skipped, and that no pair needs:\n  2 × entry of vehicle-side/data_info.json that is not usable",
        "    entry 0: missing field `pointcloud_path`",
        "    entry 5 (vehicle-side/velodyne/000100.pcd): expected one entry of this cloud, found two that differ",
    ] {
        assert!(said.contains(line), "{line} is not in\n{said}");
    }
    fs::remove_file(made.folder.path().join("out.mcap")).unwrap();
    edit(&roadside, |list| {
        drop(list[2].as_object_mut().unwrap().remove("label_lidar_std_path"));
    });
    edit(&together, |list| {
        list.insert(0, json!({}));
        list[2]["system_error_offset"]["delta_x"] = "nan".into();
    });
    let error = made.import(false).unwrap_err();
    for line in [
        "3 of 5 pairs are incomplete",
        "2 × entry of cooperative/data_info.json that is not usable\n    entry 0: missing field",
        "    entry 2 (vehicle-side/velodyne/000101.pcd): system_error_offset: expected metres",
        "1 × entry of infrastructure-side/data_info.json that is not usable\n    entry 2 (infrastructure-side/velodyne/000202.pcd): \
         missing field `label_lidar_std_path`",
    ] {
        assert!(error.contains(line), "{line} is not in\n{error}");
    }
    for absent in ["in no entry of", "vehicle-side/data_info.json"] {
        assert!(!error.contains(absent), "{absent} is in\n{error}");
    }
    let summary = made.import(true).unwrap();
    assert_eq!((summary.pairs, summary.incomplete_pairs), (2, 3));
    // An entry that does not say its cloud may be the one that a pair needs.
    edit(&vehicle, |list| drop(list.remove(4)));
    fs::remove_file(made.folder.path().join("out.mcap")).unwrap();
    let error = made.import(false).unwrap_err();
    for line in [
        "1 × in no entry of vehicle-side/data_info.json\n    vehicle-side/velodyne/000103.pcd",
        "1 × entry of vehicle-side/data_info.json that is not usable\n    entry 0: missing field `pointcloud_path`",
    ] {
        assert!(error.contains(line), "{line} is not in\n{error}");
    }
}

#[test]
fn clouds_at_one_time_and_sizes_below_zero_are_no_sweeps_and_no_placeholders() {
    let made = Made::new();
    let data = made.data();
    let [_, vehicle, _] = lists(&data);
    edit(&vehicle, |list| {
        list[1]["pointcloud_timestamp"] = list[0]["pointcloud_timestamp"].clone();
    });
    edit(&data.join("vehicle-side/label/lidar/000102.json"), |list| {
        list[0]["3d_dimensions"]["l"] = (-4.4).into();
        list[1]["3d_dimensions"]["l"] = 0.into();
    });
    let error = made.import(false).unwrap_err();
    assert!(
        error.contains("2 of 4 pairs")
            && error.contains("entry 1 (vehicle-side/velodyne/000101.pcd): pointcloud_timestamp: expected one cloud")
            && !error.contains("in no entry of")
            && error.contains("000102.json: label 0 (`Car`)"),
        "{error}"
    );
    let summary = made.import(true).unwrap();
    assert_eq!((summary.pairs, summary.placeholders_dropped), (2, 0));
}

#[test]
fn marks_and_slashes_of_other_systems_are_read() {
    let made = Made::new();
    for list in lists(&made.data()) {
        edit(&list, |entries| {
            for value in entries
                .iter_mut()
                .flat_map(|entry| entry.as_object_mut().unwrap().values_mut())
            {
                if let Value::String(text) = value {
                    *text = text.replace('/', "\\");
                }
            }
        });
        let marked = [b"\xef\xbb\xbf", &fs::read(&list).unwrap()[..]].concat();
        fs::write(&list, marked).unwrap();
    }
    assert_eq!(made.import(false).unwrap().pairs, 4);
    let [together, ..] = lists(&made.data());
    fs::write(&together, b"\xff\xfe[\0]\0").unwrap();
    fs::remove_file(made.folder.path().join("out.mcap")).unwrap();
    let error = made.import(false).unwrap_err();
    assert!(
        error.contains("UTF-16") && error.contains("save it as UTF-8"),
        "{error}"
    );
}

/// Replaces all clouds of the vehicle and gives the first as it was imported.
fn imported(made: &Made, file: &[u8]) -> PointCloud {
    for k in 0..4 {
        write(
            &made.data().join(format!("vehicle-side/velodyne/{:06}.pcd", 100 + k)),
            file,
        );
    }
    made.import(false).unwrap();
    made.cloud()
}

#[test]
fn intensities_are_scaled_by_the_brightest_of_the_first_clouds() {
    let made = Made::new();
    for most in [1.0, 100.0, 255.0, 4000.0f32] {
        let found = imported(&made, &cloud(|i| i as f32 / (POINTS - 1) as f32 * most));
        let (brightest, distinct): (u8, std::collections::BTreeSet<u8>) = (
            *found.intensity.iter().max().unwrap(),
            found.intensity.iter().copied().collect(),
        );
        let expected = match most {
            1.0 | 255.0 => 255,
            100.0 => 100,
            _ => 249,
        };
        assert_eq!(brightest, expected, "up to {most}");
        assert!(distinct.len() > 90, "up to {most}: {} values", distinct.len());
    }
    // A dark cloud of a bright sensor stays dark, and what is below 0 is counted.
    let dark = cloud(|i| if i == 0 { -300.0 } else { 0.5 });
    write(&made.data().join(FIRST), &dark);
    let summary = made.import(false).unwrap();
    assert_eq!(summary.limited_intensities, 1);
    assert!(summary.to_string().contains("limited: 1 intensities"));
    assert!(made.cloud().intensity.iter().all(|intensity| *intensity == 0));
}

#[test]
fn padding_doubles_integers_and_text_are_read_alike() {
    let made = Made::new();
    let (mut padded, mut doubles, mut shorts) = (
        head("x y z _ intensity _", "4 4 4 1 4 1", "F F F U F U", "1 1 1 4 1 12"),
        head("x y z intensity", "8 8 8 8", "F F F F", "1 1 1 1"),
        head("x y z intensity", "4 4 4 2", "F F F U", "1 1 1 1"),
    );
    let mut text = String::from_utf8(head("x y z intensity", "4 4 4 4", "F F F F", "1 1 1 1")).unwrap();
    text = text.replace("DATA binary", "DATA ascii");
    for i in 0..POINTS {
        let ([x, y, z], share) = (place(i), i as f32 / POINTS as f32);
        for value in [x, y, z] {
            padded.extend(value.to_le_bytes());
            doubles.extend(f64::from(value).to_le_bytes());
            shorts.extend(value.to_le_bytes());
        }
        padded.extend([7; 4]);
        padded.extend(share.to_le_bytes());
        padded.extend([7; 12]);
        doubles.extend(f64::from(share).to_le_bytes());
        shorts.extend(((share * 255.0).round() as u16).to_le_bytes());
        text.push_str(&format!("{x} {y} {z} {share}\r\n"));
    }
    let expected = imported(&made, &cloud(|i| i as f32 / POINTS as f32));
    for (name, file) in [
        ("padding", padded),
        ("doubles", doubles),
        ("16 bits", shorts),
        ("text", text.into_bytes()),
    ] {
        assert!(imported(&made, &file) == expected, "{name}");
    }
}

#[test]
fn fields_are_taken_by_their_names_and_directions_without_a_return_stay_nan() {
    let made = Made::new();
    let expected = imported(&made, &cloud(|i| i as f32 / POINTS as f32));
    let names = "ring intensity z y x";
    let mut reordered = head(names, "2 4 4 4 4", "U F F F F", "1 1 1 1 1");
    // An organised cloud: each third row is a direction without a return.
    let without = POINTS / 2;
    let text = String::from_utf8(head(names, "2 4 4 4 4", "U F F F F", "1 1 1 1 1")).unwrap();
    let mut organised = text
        .replace(&format!(" {POINTS}\n"), &format!(" {}\n", POINTS + without))
        .into_bytes();
    for i in 0..POINTS {
        let ([x, y, z], share) = (place(i), i as f32 / POINTS as f32);
        let row = [
            &(i as u16 % 32).to_le_bytes()[..],
            &[share, z, y, x].map(f32::to_le_bytes).concat(),
        ]
        .concat();
        reordered.extend(&row);
        organised.extend(&row);
        if i % 2 == 1 {
            organised.extend([0, 0]);
            organised.extend([0.0, f32::NAN, f32::NAN, f32::NAN].map(f32::to_le_bytes).concat());
        }
    }
    assert!(imported(&made, &reordered) == expected, "order");
    // As in logs of ours, a row of NaN is a direction without a return.
    let found = imported(&made, &organised);
    assert_eq!(found.len(), POINTS + without);
    let rows = |cloud: &PointCloud| -> Vec<([f32; 3], u8)> {
        let rows = (0..cloud.len()).map(|i| ([cloud.x[i], cloud.y[i], cloud.z[i]], cloud.intensity[i]));
        rows.filter(|(place, _)| !place[0].is_nan()).collect()
    };
    assert_eq!(rows(&found), rows(&expected));
}

#[test]
fn clouds_far_from_their_sensor_are_refused_and_none_is_cut() {
    let made = Made::new();
    let mut far = head("x y z intensity", "8 8 8 4", "F F F F", "1 1 1 1");
    for i in 0..POINTS {
        let [x, y, z] = place(i).map(f64::from);
        far.extend([x + 691_234.0, y + 5_334_567.0, z].iter().flat_map(|v| v.to_le_bytes()));
        far.extend(0.5f32.to_le_bytes());
    }
    fs::write(made.data().join(FIRST), far).unwrap();
    let error = made.import(false).unwrap_err();
    assert!(
        error.contains(FIRST) && error.contains("in its frame") && error.contains("691204"),
        "{error}"
    );
    assert!(Path::new(&made.data()).exists());
}

#[test]
fn stamps_turns_and_corners_of_another_convention_are_refused() {
    let made = Made::new();
    let data = made.data();
    let [_, vehicle, _] = lists(&data);
    edit(&vehicle, |list| {
        for (entry, stamp) in list.iter_mut().zip(["1626240241604", "1626240241"]) {
            entry["pointcloud_timestamp"] = stamp.into();
        }
    });
    edit(&data.join("vehicle-side/label/lidar/000102.json"), |list| {
        list[0]["rotation"] = 90.into()
    });
    edit(&data.join("cooperative/label_world/000103.json"), |list| {
        list[0]["world_8_points"].as_array_mut().unwrap()[..4].rotate_left(1);
        list[0]["world_8_points"].as_array_mut().unwrap()[4..].rotate_left(1);
    });
    let error = made.import(false).unwrap_err();
    for line in [
        "expected microseconds since 1970, found 1626240241604, which looks like milliseconds",
        "found 1626240241, which looks like seconds",
        "000102.json: label 0 (`Car`): expected a box within 1000 m of its agent, at most 100 m long, with a heading in radians within ±4π",
        "000103.json: label 0 (`Car`): world_8_points: expected front-left",
    ] {
        assert!(error.contains(line), "{line} is not in\n{error}");
    }
}
