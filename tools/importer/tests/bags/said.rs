//! What bags hold that is half, twice, or of no use is counted and said, and never scored as if nothing were there.

use realo_importer::BagSummary;
use realo_logs::{Log, Stream};
use realo_schemas::Nanos;

use super::wire::{Cloud, Marker, Recorded, cloud, detections, markers, odometry, transform};
use super::world::{BASE, MOUNTED, MS, Names, PLAIN, SWEEPS, T0, place, points, recording, sweep, sweep_with};
use super::writers::ros1;
use super::{Played, import, played};

const FLOAT32: u8 = 7;
const SILENT: Names = Names { truth: None, ..PLAIN };

/// Imports a recording with more messages, by a map file.
fn made(more: impl IntoIterator<Item = Recorded>, lines: &str) -> (BagSummary, Played, usize) {
    let mut messages = recording(SILENT, 0.0, 0);
    messages.extend(more);
    imported(messages, lines)
}

fn imported(mut messages: Vec<Recorded>, lines: &str) -> (BagSummary, Played, usize) {
    let dir = tempfile::tempdir().unwrap();
    let (bag, log) = (dir.path().join("some.bag"), dir.path().join("log.mcap"));
    messages.sort_by_key(|message| message.log_time);
    ros1(&bag, &messages, "none");
    let map = format!(
        "agents:\n  car:\n    clouds: /velodyne_points\n    frame: base_link\n    height: {BASE}\n    pose: /odom\n{lines}"
    );
    let summary = import(&[bag], Some(&map), &log).unwrap();
    let scored = scored(&log);
    (summary, played(&log, "car"), scored)
}

/// Sweeps of the log with truth that is scored.
fn scored(log: &std::path::Path) -> usize {
    let log = Log::open(log).unwrap();
    if !log.has("car", Stream::GroundTruthInfo) {
        return 0;
    }
    let mut reader = log.read_all(&[("car", Stream::GroundTruthInfo)]).unwrap();
    let mut count = 0;
    while reader.next().unwrap().is_some() {
        count += 1;
    }
    count
}

fn stamps() -> impl Iterator<Item = Nanos> {
    (0..SWEEPS).map(|k| T0 + k * 100 * MS)
}

#[test]
fn clouds_in_a_base_on_the_ground_become_a_log_by_the_draft() {
    let dir = tempfile::tempdir().unwrap();
    let (bag, log) = (dir.path().join("some.bag"), dir.path().join("log.mcap"));
    let up = (MOUNTED + BASE) as f32;
    let on_ground: Vec<[f32; 3]> = points().iter().map(|[x, y, z]| [*x, *y, z + up]).collect();
    let mut messages: Vec<Recorded> = stamps()
        .map(|at| sweep_with("/concatenated", [at + 95 * MS, at], "base_link", on_ground.clone()))
        .collect();
    messages.extend((0..5 * SWEEPS).map(|k| {
        let at = T0 + k * 20 * MS;
        odometry("/odom", at + MS, at, ["map", "base_link"], place(0.0, at))
    }));
    messages.sort_by_key(|message| message.log_time);
    ros1(&bag, &messages, "none");
    let summary = import(&[bag], None, &log).unwrap();
    assert_eq!(
        (summary.agents[0].height_m, summary.agents[0].sweeps),
        (0.0, SWEEPS as usize)
    );
    let draft = summary.draft.unwrap();
    assert!(
        draft.contains("height: ground  # ") && draft.contains("or at z = 0 of clouds that have nothing below"),
        "{draft}"
    );
    let ground = played(&log, "ego").clouds[0].2.z[0];
    assert!(ground.abs() < 0.01, "{ground}");
}

const TRUTH: &str = "    truth: /objects\n";

#[test]
fn messages_of_one_stamp_are_one_truth() {
    let cube = |namespace: &'static str, id, x| -> Marker { (namespace, id, 1, [x, 3.0, 1.0, 0.0]) };
    let one = stamps().map(|at| {
        let both = vec![cube("Car", 1, 20.0), cube("Pedestrian", 2, 30.0)];
        markers("/objects", at + MS, at, "map", both)
    });
    let two = stamps().flat_map(|at| {
        let of = |late, marker| markers("/objects", at + late, at, "map", vec![marker]);
        // The last message says again what the first did.
        [
            of(MS, cube("Car", 1, 20.0)),
            of(2 * MS, cube("Pedestrian", 2, 30.0)),
            of(3 * MS, cube("Car", 1, 20.0)),
        ]
    });
    let (of_one, one, _) = made(one, TRUTH);
    let (of_two, two, _) = made(two, TRUTH);
    let all = SWEEPS as usize;
    assert_eq!(
        (of_one.classes["Car"], of_one.classes["Pedestrian"]),
        (all, all),
        "{of_one}"
    );
    assert_eq!(one.truth, two.truth, "{of_two}");
    let said = of_two.to_string();
    assert!(
        said.contains(&format!(
            "left out: {all} × /objects: objects that an earlier message of the same stamp has"
        )),
        "{said}"
    );
}

#[test]
fn ids_that_clash_at_one_stamp_are_said() {
    let object = |class, track, x| (class, track, [x, 3.0, 1.0, 0.0], [4.0, 2.0, 1.5]);
    for (second, said) in [
        (
            "Truck",
            "have the id of an object of another class at the same stamp: ids count for each class alone",
        ),
        (
            "Car",
            "have the id of another object of their class at the same stamp: both stay",
        ),
    ] {
        let clashing = stamps().flat_map(|at| {
            let of = |late, object| detections("/objects", at + late, at, "map", vec![object]);
            [of(MS, object("Car", "1", 20.0)), of(2 * MS, object(second, "1", 30.0))]
        });
        let (summary, log, _) = made(clashing, TRUTH);
        assert!(summary.to_string().contains(said), "{summary}");
        for (_, boxes) in &log.truth {
            assert_eq!(boxes.len(), 2);
            assert_eq!(boxes[0].track == boxes[1].track, second == "Car");
        }
    }
}

#[test]
fn truth_that_cannot_be_used_is_not_nothing() {
    let at = |frame, kind| {
        stamps().map(move |at| {
            markers(
                "/objects",
                at + MS,
                at,
                frame,
                vec![("Car", 1, kind, [20.0, 3.0, 1.0, 0.0])],
            )
        })
    };
    let (summary, log, found) = made(at("map", 1), TRUTH);
    assert_eq!((log.truth.len() as i64, found as i64), (SWEEPS, SWEEPS), "{summary}");
    for (frame, kind, named) in [
        ("map", 5, "/objects: markers of the type LINE_LIST, which are no boxes"),
        ("lost", 1, "/objects: objects are in `lost`, and nothing leads to `map`"),
    ] {
        let (summary, log, found) = made(at(frame, kind), TRUTH);
        assert_eq!((log.truth.len(), found), (0, 0), "{summary}");
        assert_eq!(summary.agents[0].unplaced_truths as i64, SWEEPS);
        let said = summary.to_string();
        assert!(said.contains(named) && said.contains("LEFT UNSCORED"), "{said}");
    }
    // An array without markers says that nothing is there.
    let none = stamps().map(|at| markers("/objects", at + MS, at, "map", Vec::new()));
    let (summary, log, _) = made(none, TRUTH);
    assert_eq!(summary.agents[0].unplaced_truths, 0, "{summary}");
    assert!(!log.truth.is_empty() && log.truth.iter().all(|(_, boxes)| boxes.is_empty()));
}

#[test]
fn poses_of_one_stamp_that_differ_are_counted() {
    let other = stamps().map(|at| {
        let [x, y, z, yaw] = place(0.0, at);
        odometry("/odom", at + 2 * MS, at, ["map", "base_link"], [x + 7.0, y, z, yaw])
    });
    let (summary, log, _) = made(other, "");
    let said = summary.to_string();
    let expected =
        format!("warning: poses of `car`: {SWEEPS} differ from an earlier one of the same stamp, by 7.00 m at most");
    assert!(said.contains(&expected), "{said}");
    assert!(
        log.poses
            .iter()
            .all(|(at, pose)| (pose.translation.vector.x - place(0.0, *at)[0]).abs() < 1e-6)
    );
    assert!(!made([], "").0.to_string().contains("warning"));
}

#[test]
fn vehicles_in_an_odom_of_their_own_are_in_no_common_world() {
    let in_frame = |world: &'static str, start: f64| {
        let mut messages = recording(SILENT, 0.0, 0);
        messages.retain(|message| message.topic != "/odom");
        messages.extend((0..5 * SWEEPS).map(|step| {
            let stamp = T0 + step * 20 * MS;
            let [x, _, z, yaw] = place(start, stamp);
            odometry("/odom", stamp + MS, stamp, [world, "base_link"], [x, 0.0, z, yaw])
        }));
        messages.sort_by_key(|message| message.log_time);
        messages
    };
    let dir = tempfile::tempdir().unwrap();
    let both = |world: &'static str, starts: [f64; 2]| {
        let paths = ["one.bag", "two.bag"].map(|name| dir.path().join(name));
        for (path, start) in paths.iter().zip(starts) {
            ros1(path, &in_frame(world, start), "none");
        }
        let log = dir.path().join("log.mcap");
        let _ = std::fs::remove_file(&log);
        import(&paths, None, &log).unwrap().to_string()
    };
    let said = both("odom", [0.0, 3.0]);
    for part in [
        "warning: poses of `one` and `two` are in `odom`",
        "ARE ALL AGENTS IN IT?",
        "record a transform",
    ] {
        assert!(said.contains(part), "{part} is not in\n{said}");
    }
    assert!(!said.contains("--handed"), "{said}");
    let said = both("map", [20.0, 3.0]);
    assert!(!said.contains("warning") && !said.contains("ARE ALL AGENTS"), "{said}");
}

#[test]
fn stamps_of_zero_are_said() {
    let mut messages = recording(SILENT, 0.0, 0);
    messages.retain(|message| message.topic != "/velodyne_points");
    messages.extend(stamps().map(|at| sweep_of(at, 0, "intensity")));
    let (summary, log, _) = imported(messages, "");
    assert_eq!(log.clouds.len() as i64, SWEEPS);
    let said = summary.to_string();
    let expected = format!("warning: stamps of {SWEEPS} messages of `/velodyne_points` are 0");
    assert!(said.contains(&expected) && said.contains("`clock: log`"), "{said}");
}

/// A sweep without times, whose intensities are in a field of this name.
fn sweep_of(log_time: Nanos, stamp: Nanos, intensity: &'static str) -> Recorded {
    let row = points().into_iter().enumerate().flat_map(|(k, point)| {
        let numbers = point.into_iter().chain([(k % 200) as f32]);
        numbers.flat_map(f32::to_le_bytes).collect::<Vec<u8>>()
    });
    let rows = vec![row.collect::<Vec<u8>>()];
    let content = Cloud {
        fields: vec![
            ("x", 0, FLOAT32),
            ("y", 4, FLOAT32),
            ("z", 8, FLOAT32),
            (intensity, 12, FLOAT32),
        ],
        step: 16,
        row_step: rows[0].len() as u32,
        rows,
        big_endian: false,
    };
    cloud("/velodyne_points", log_time, stamp, "velodyne", content)
}

#[test]
fn intensities_of_other_names_are_taken_and_missing_ones_are_said() {
    for (name, said, brightest) in [
        ("intensity", "intensities: float32, times 1", 199),
        ("Intensity", "intensities: of the field `Intensity`: float32", 199),
        ("reflectivity", "intensities: of the field `reflectivity`: float32", 199),
        ("i", "intensities: of the field `i`: float32", 199),
        ("echo", "intensities: NONE, all are 0: the clouds have x, y, z, echo", 0),
    ] {
        let mut messages = recording(SILENT, 0.0, 0);
        messages.retain(|message| message.topic != "/velodyne_points");
        messages.extend(stamps().map(|at| sweep_of(at + 50 * MS, at, name)));
        let (summary, log, _) = imported(messages, "");
        assert!(summary.to_string().contains(said), "{said} is not in\n{summary}");
        assert_eq!(
            log.clouds[0].2.intensity.iter().copied().max(),
            Some(brightest),
            "{name}"
        );
    }
}

#[test]
fn a_second_lidar_that_ends_early_is_said() {
    let mut messages = recording(SILENT, 0.0, 0);
    messages.push(transform(
        "/tf_static",
        T0,
        T0,
        ["base_link", "rear"],
        [-2.0, 0.0, MOUNTED, 0.0],
    ));
    messages.extend(
        stamps()
            .take(3)
            .map(|at| sweep("/rear_points", at + 95 * MS, at, "rear")),
    );
    messages.sort_by_key(|message| message.log_time);
    let dir = tempfile::tempdir().unwrap();
    let (bag, log) = (dir.path().join("some.bag"), dir.path().join("log.mcap"));
    ros1(&bag, &messages, "none");
    let map = format!(
        "agents:\n  car:\n    clouds: [/velodyne_points, /rear_points]\n    frame: base_link\n    height: {BASE}\n    pose: /odom\n"
    );
    let said = import(&[bag], Some(&map), &log).unwrap().to_string();
    let expected = format!(
        "warning: {} of {SWEEPS} sweeps of `car` have no cloud of `/rear_points`",
        SWEEPS - 3
    );
    assert!(said.contains(&expected), "{said}");
}
