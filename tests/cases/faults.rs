//! Values of a log that contradict each other or that nothing can have: `realo info` and a run name them.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use realo_logs::{BoxesInfo, boxes, cloud, pose};
use realo_schemas::{Box3, Boxes, Nanos, Pose};

use crate::common;
use crate::scene::{Ran, Raw, Scene, rewrite, rewrite_with, run};

/// What `realo info` says of a log on one line, and its exit code.
fn info(log: &Path) -> (String, Option<i32>) {
    let output = common::realo(["info", &log.to_string_lossy()]);
    let said = common::text(&output.stdout) + &common::text(&output.stderr);
    // Messages are wrapped to the terminal's width.
    let said = said.split_whitespace().collect::<Vec<_>>().join(" ");
    (said, output.status.code())
}

/// The scene with each message changed.
fn changed(name: &str, mut change: impl FnMut(&mut Raw)) -> PathBuf {
    picked(name, |message| {
        change(message);
        true
    })
}

/// The scene with each message changed, and without some.
fn picked(name: &str, mut change: impl FnMut(&mut Raw) -> bool) -> PathBuf {
    let base = Scene::default().write(&format!("{name}-base"));
    rewrite(&base, name, |mut message| match change(&mut message) {
        true => vec![message],
        false => vec![],
    })
}

fn offline(log: &Path, name: &str) -> Ran {
    run("late_fusion", log, name, &["--offline"])
}

/// A run and `realo info` name a fault and end with 3.
fn reported(log: &Path, name: &str, note: &str, problem: &str) -> Ran {
    let ran = offline(log, name);
    assert!(ran.code == 3 && ran.notes().contains(note), "{name}: {ran:?}");
    let (said, code) = info(log);
    assert!(said.contains("PROBLEM: ") && said.contains(problem), "{name}: {said}");
    assert_eq!(code, Some(3), "{name}");
    ran
}

/// The scene with boxes and companions changed: `change` takes the boxes of an array or, with `true`, of a companion.
fn with_boxes(name: &str, stream: &str, change: impl Fn(&mut Box3, bool)) -> PathBuf {
    let mut arrays: BTreeMap<(String, Nanos), Boxes> = BTreeMap::new();
    changed(name, |message| {
        let (agent, topic) = (message.parts().0.to_string(), message.parts().1.to_string());
        let (stamp, frame) = (message.header_stamp(), format!("{agent}/body"));
        if topic == stream {
            let (_, mut found) = boxes::decode(&message.data).expect("boxes");
            arrays.insert((agent, stamp), found.clone());
            found.0.iter_mut().for_each(|object| change(object, false));
            message.data.clear();
            boxes::encode(&mut message.data, stamp, &frame, &found.0);
        } else if topic.strip_suffix("_info") == Some(stream) {
            let mut found = arrays[&(agent, stamp)].clone();
            let (_, info): (_, BoxesInfo) = boxes::decode_info(&message.data, &mut found).expect("a companion");
            found.0.iter_mut().for_each(|object| change(object, true));
            message.data.clear();
            boxes::encode_info(&mut message.data, stamp, &frame, &found.0, &info);
        }
    })
}

/// The scene with the poses of a topic changed: `change` takes x, y, z, the quaternion, and the number of the message.
fn with_poses(name: &str, topic: &str, change: impl Fn(&mut [f64], u32)) -> PathBuf {
    const POSE: usize = 8 * (3 + 4);
    const COVARIANCE: usize = 8 * 36;
    changed(name, |message| {
        if message.topic == topic {
            let at = message.data.len() - COVARIANCE - POSE;
            let words = message.data[at..at + POSE].chunks_exact(8);
            let mut pose: Vec<f64> = words
                .map(|word| f64::from_le_bytes(word.try_into().expect("eight bytes")))
                .collect();
            change(&mut pose, message.sequence);
            let bytes: Vec<u8> = pose.iter().flat_map(|word| word.to_le_bytes()).collect();
            message.data[at..at + POSE].copy_from_slice(&bytes);
        }
    })
}

#[test]
fn headings_of_two_values_are_named() {
    let degrees = with_boxes("yaw-degrees", "detections", |object, of_companion| {
        if of_companion {
            object.yaw = object.yaw.to_degrees();
        }
    });
    let words = "a `yaw` of -162.000 rad and a quaternion of -2.827 rad: looks like degrees";
    let ran = reported(&degrees, "yaw-degrees", words, words);
    assert!(
        ran.notes().contains("mast: 80 of 80 recorded detections"),
        "{}",
        ran.notes()
    );
    let turned = with_boxes("truth-turned", "ground_truth", |object, of_companion| {
        object.yaw += if of_companion { 1.0 } else { 0.0 };
    });
    let problem = "/car/ground_truth_info: 160 of 160 boxes have another heading";
    reported(
        &turned,
        "truth-turned",
        "objects of the ground truth have another heading",
        problem,
    );
    let beyond = with_boxes("yaw-beyond", "detections", |object, of_companion| {
        object.yaw += if of_companion {
            1_000.0 * std::f64::consts::TAU
        } else {
            0.0
        };
    });
    reported(
        &beyond,
        "yaw-beyond",
        "a `yaw` beyond ±4π",
        "/car/detections_info: 80 of 80 boxes",
    );
}

#[test]
fn boxes_are_judged_with_their_companions_before_a_run_too() {
    // Without a quaternion the companion's heading counts.
    let none = with_boxes("no-quaternion", "detections", |object, of_companion| {
        if !of_companion {
            object.yaw = f64::NAN;
        }
    });
    let ran = offline(&none, "no-quaternion");
    assert_eq!(
        (ran.code, ran.ap("0.5"), info(&none).1),
        (0, 1.0, Some(0)),
        "{}",
        ran.notes()
    );
    let nan = with_boxes("no-yaw", "detections", |object, of_companion| {
        if of_companion {
            object.yaw = f64::NAN;
        }
    });
    let fast = with_boxes("no-velocity", "detections", |object, _| {
        object.velocity = Some([f64::INFINITY; 3])
    });
    for (name, log, fault) in [
        ("no-yaw", nan, "a number that is not finite"),
        ("no-velocity", fast, "a velocity or covariance that is not finite"),
    ] {
        reported(&log, name, fault, "/mast/detections: 80 of 80 boxes are left out");
    }
}

#[test]
fn footprints_that_no_vehicle_has_are_reported() {
    let with = |name: &str, footprint: &str| {
        let base = Scene::default().write(&format!("{name}-base"));
        let record = |record: &mut BTreeMap<String, String>| {
            let agents = record["agents"].replace("[-1.5,3.3,-0.9,0.9]", footprint);
            record.insert("agents".into(), agents);
        };
        rewrite_with(&base, name, &[], record, |message| vec![message])
    };
    let log = with("footprint-cm", "[-150.0,330.0,-90.0,90.0]");
    let ran = offline(&log, "footprint-cm");
    let (said, code) = info(&log);
    assert_eq!((ran.code, code), (1, Some(1)), "{ran:?} {said}");
    for said in [ran.err.split_whitespace().collect::<Vec<_>>().join(" "), said] {
        let expected = "`footprint` of `car`: expected [x min, x max, y min, y max] in metres, within ±30 m";
        assert!(said.contains(expected) && said.contains("330.0"), "{said}");
    }
    let log = with("footprint-wide", "[-30.0,30.0,-30.0,30.0]");
    let ran = run("no_fusion", &log, "footprint-wide", &["--offline"]);
    let expected = "of 80 detections were not scored, because they are on the ego's own body";
    assert!(ran.notes().contains(expected), "{}", ran.notes());
}

#[test]
fn covariances_that_cannot_be_right_do_not_end_cooperation() {
    for (name, value, words) in [
        ("covariance-nan", f64::NAN, "a variance of NaN"),
        ("covariance-huge", 1e300, "a variance of 1e300"),
        ("covariance-negative", -1.0, "a variance of -1"),
    ] {
        let log = changed(name, |message| {
            if message.topic == "/mast/pose" {
                let end = message.data.len();
                message.data[end - 36 * 8..].copy_from_slice(&value.to_le_bytes().repeat(36));
            }
        });
        let problem = "/mast/pose: 52 of 52 poses have a covariance that cannot be right";
        let ran = reported(&log, name, words, problem);
        assert_eq!(ran.ap("0.5"), 1.0, "{name}");
    }
}

#[test]
fn true_poses_that_do_not_reach_the_sweeps_are_named() {
    for (name, keeps, problem) in [
        (
            "truth-half",
            (|n| n < 20) as fn(u32) -> bool,
            "10 of 20 sweeps have no pose on /car/pose_truth",
        ),
        (
            "truth-sparse",
            |n| n % 10 == 0,
            "sweeps have no pose on /car/pose_truth",
        ),
    ] {
        let base = Scene::default().write(&format!("{name}-base"));
        let log = rewrite_with(
            &base,
            name,
            &[["/car/pose_truth", "/car/pose"]],
            |_| {},
            |message| {
                let mut out = vec![message.clone()];
                if message.topic == "/car/pose" && keeps(message.sequence) {
                    out.push(Raw {
                        topic: "/car/pose_truth".into(),
                        ..message
                    });
                }
                out
            },
        );
        reported(&log, name, "these are the poses of `pose_truth`", problem);
    }
}

#[test]
fn companions_and_topics_that_are_missing_or_broken_are_named_before_a_run() {
    let cut = |message: &mut Raw, topic: &str, keep: fn(usize) -> usize| {
        if message.topic == topic && message.sequence == 7 {
            message.data.truncate(keep(message.data.len()));
        }
        true
    };
    let without = picked("no-companion", |message| !message.topic.ends_with("ground_truth_info"));
    let short = picked("short-companion", |message| {
        cut(message, "/mast/ground_truth_info", |n| n - 1)
    });
    let half = picked("half-a-cloud", |message| cut(message, "/mast/points", |n| n / 2));
    let turned = changed("another-frame", |message| {
        if message.topic == "/car/points" && message.sequence >= 10 {
            let (stamp, points) = cloud::decode(&message.data).expect("a cloud");
            message.data.clear();
            cloud::encode(&mut message.data, stamp, "velodyne", &points);
        }
    });
    let record = |key: &'static str, from: &'static str, to: &'static str| {
        move |record: &mut BTreeMap<String, String>| {
            let text = record[key].replace(from, to);
            record.insert(key.into(), text);
        }
    };
    let base = Scene::default().write("records-base");
    let more = record("agents", "[{", "[{\"name\":\"ghost\",\"kind\":\"vehicle\"},{");
    let ghost = rewrite_with(&base, "ghost", &[], more, |message| vec![message]);
    let protocol = rewrite_with(
        &base,
        "protocol",
        &[],
        record("protocol", "default", "nope"),
        |message| vec![message],
    );
    for (name, log, parts) in [
        (
            "no-companion",
            without,
            ["/car/ground_truth_info is missing", "/car/ground_truth_info"],
        ),
        (
            "short-companion",
            short,
            ["/mast/ground_truth_info at 1700000000.810 s", "/mast/ground_truth_info"],
        ),
        (
            "half-a-cloud",
            half,
            ["/mast/points at 1700000000.810 s", "/mast/points"],
        ),
        (
            "another-frame",
            turned,
            ["/car/points at 1700000001.090 s", "its frame is `velodyne`"],
        ),
        ("ghost", ghost, ["`ghost` has no sweeps", "no topic `/ghost/pose`"]),
        ("protocol", protocol, ["protocol `nope`", "protocol `nope`"]),
    ] {
        let (said, code) = info(&log);
        assert!(said.contains("PROBLEM: ") && said.contains(parts[0]), "{name}: {said}");
        assert_eq!(code, Some(3), "{name}");
        let ran = offline(&log, name);
        assert!(
            ran.code == 1
                && ran
                    .err
                    .split_whitespace()
                    .collect::<Vec<_>>()
                    .join(" ")
                    .contains(parts[1]),
            "{ran:?}"
        );
    }
}

#[test]
fn a_damaged_chunk_is_found_before_a_run() {
    let log = Scene::default().write("flipped");
    let whole = std::fs::read(&log).expect("the log can be read");
    let summary = mcap::Summary::read(&whole).expect("an index").expect("an index");
    assert!(summary.chunk_indexes.len() > 3);
    for chunk in &summary.chunk_indexes {
        let mut bytes = whole.clone();
        bytes[(chunk.chunk_start_offset + chunk.chunk_length / 2) as usize] ^= 4;
        std::fs::write(&log, bytes).expect("the log can be written");
        let (said, code) = info(&log);
        assert!(
            code == Some(1) && said.contains("is damaged at byte"),
            "{chunk:?}: {said}"
        );
    }
}

#[test]
fn a_run_and_info_agree_on_late_sweeps_topics_of_sweeps_and_stamps_of_truth() {
    let last = picked("mast-last", |message| {
        let (agent, topic) = message.parts();
        agent != "mast" || topic == "pose" || message.sequence == 19
    });
    reported(
        &last,
        "mast-last",
        "mast: 19 of 20 sweeps are missing",
        "`mast`: 19 of 20 sweeps are missing",
    );
    let half = picked("half-of-sweeps", |message| {
        message.topic != "/mast/sweeps" || message.sequence % 2 == 0
    });
    let words = "10 of 20 sweeps are on one of `points` and `sweeps` alone";
    reported(&half, "half-of-sweeps", words, words);
    let ahead = changed("truth-ahead", |message| {
        if message.topic == "/mast/ground_truth" || message.topic == "/mast/ground_truth_info" {
            message.shift(400_000_000);
        }
    });
    let words = "stamps 0.310 s later than log times";
    reported(&ahead, "truth-ahead", words, words);
}

#[test]
fn the_last_sweeps_without_detections_are_counted() {
    for (name, keeps, count) in [
        ("bare-18", (|n| n != 18) as fn(u32) -> bool, 1),
        ("bare-19", |n| n != 19, 1),
        ("bare-half", |n| n < 10, 10),
    ] {
        let log = picked(name, |message| {
            !message.topic.starts_with("/mast/detections") || keeps(message.sequence)
        });
        let words = format!("{count} of 20 sweeps have no recorded detections");
        reported(&log, name, &format!("mast: {words}"), &format!("`mast`: {words}"));
    }
    // A log that ends before detections come lacks none.
    let late = |message: &mut Raw| {
        if message.parts().1.starts_with("detections") {
            message.log_time += 150_000_000;
        }
        message.log_time < crate::scene::T0 + 2_000_000_000
    };
    let log = picked("bare-end", late);
    assert_eq!(info(&log).1, Some(0), "{}", info(&log).0);
}

#[test]
fn transforms_of_the_map_that_are_not_at_the_poses_are_named() {
    let in_map = |name: &str, off: f64| {
        changed(name, |message| {
            if message.topic == "/mast/points" {
                let (stamp, points) = cloud::decode(&message.data).expect("a cloud");
                message.data.clear();
                cloud::encode(&mut message.data, stamp, "map", &points);
            }
            if message.topic == "/tf" && message.data.windows(9).any(|part| part == b"mast/body") {
                let half = 0.45 * std::f64::consts::PI;
                let place = Pose::from_parts([45.0 + off, 12.0, 0.0], [0.0, 0.0, half.sin(), half.cos()]);
                let place = place.expect("a rotation").map_from_frame;
                let stamp = message.publish_time;
                message.data.clear();
                pose::encode_transform(&mut message.data, stamp, "map", "mast/body", &place);
            }
        })
    };
    let near = in_map("map-near", 0.3);
    assert_eq!(offline(&near, "map-near").code, 0);
    let words = "20 of 20 sweeps were brought from the frame of the map to the body by transforms on /tf";
    reported(
        &in_map("map-far", 400.0),
        "map-far",
        words,
        "the first is 400.000 m and 0.00° off",
    );
}

#[test]
fn a_topic_of_another_type_is_named() {
    let base = Scene::default().write("types-base");
    // Poses on the topic of points.
    let log = rewrite_with(
        &base,
        "types",
        &[["/lidar/points", "/car/pose"]],
        |_| {},
        |message| {
            let topic = if message.topic == "/car/pose" {
                "/lidar/points".into()
            } else {
                message.topic.clone()
            };
            vec![Raw { topic, ..message }]
        },
    );
    let expected =
        "topic `/lidar/points` has another type: expected sensor_msgs/msg/PointCloud2 as cdr, found geometry_msgs";
    let (said, code) = info(&log);
    assert!(code == Some(1) && said.contains(expected), "{said}");
    let log = rewrite_with(
        &base,
        "slashless",
        &[["mast/pose", "/mast/pose"]],
        |_| {},
        |message| {
            let topic = if message.topic == "/mast/pose" {
                "mast/pose".into()
            } else {
                message.topic.clone()
            };
            vec![Raw { topic, ..message }]
        },
    );
    let said = offline(&log, "slashless")
        .err
        .split_whitespace()
        .collect::<Vec<_>>()
        .join(" ");
    assert!(
        said.contains("has no topic `/mast/pose`") && said.contains("/mast/sweeps, /tf, mast/pose"),
        "{said}"
    );
}

#[test]
fn what_shows_only_in_a_run_is_found_before_it() {
    let stops = picked("mast-truth-stops", |message| {
        let (agent, topic) = message.parts();
        agent != "mast" || !topic.starts_with("ground_truth") || message.sequence < 8
    });
    let words = "sweeps of the ego were scored without the truth of mast";
    reported(&stops, "mast-truth-stops", words, words);
    let late = changed("late-companions", |message| {
        if message.topic == "/mast/detections_info" {
            message.log_time += 300_000_000;
        }
    });
    let words = "played without velocities and covariances";
    reported(&late, "late-companions", words, words);
}

#[test]
fn poses_that_do_not_fit_the_boxes_of_the_other_are_named() {
    let moved = |name: &str, by: f64| with_poses(name, "/mast/pose", |pose, _| pose[0] += by);
    let near = moved("mast-near", 0.8);
    assert_eq!((offline(&near, "mast-near").code, info(&near).1), (0, Some(0)));
    let ran = reported(
        &moved("mast-moved", 3.0),
        "mast-moved",
        "positions of parked objects differ by more than 1 m between the truth of the two agents",
        "lie more than 1 m apart (median 3.0 m)",
    );
    assert!(ran.ap("0.5") < 1.0, "{}", ran.notes());
}

#[test]
fn scores_of_a_recording_tell_the_faults_of_its_log() {
    let twice = with_boxes("truth-turned-again", "ground_truth", |object, of_companion| {
        object.yaw += if of_companion { 1.0 } else { 0.0 };
    });
    let whole = Scene::default().write("evaluated");
    for (name, log, code) in [("evaluated-turned", twice, 3), ("evaluated", whole, 0)] {
        let ran = offline(&log, name);
        assert_eq!(ran.code, code, "{ran:?}");
        let out = Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("ran-{name}-late_fusion"));
        let mut files = common::files_below(&out).into_iter();
        let recording = files
            .find(|path| path.ends_with("recording.mcap"))
            .expect("a recording");
        for more in [vec![], vec!["--frames"]] {
            let (log, recording) = (log.to_string_lossy(), recording.to_string_lossy());
            let args = [vec!["evaluate", &log, "--detections", &recording], more].concat();
            let output = common::realo(args);
            let said = common::text(&output.stdout) + &common::text(&output.stderr);
            assert_eq!(output.status.code(), Some(code), "{name}: {said}");
            let is_reported = said.contains("objects of the ground truth have another heading");
            assert_eq!(is_reported, code == 3, "{name}: {said}");
        }
    }
}

#[test]
fn truth_whose_companion_is_missing_is_counted() {
    for (name, missing) in [("half-infos", "ground_truth_info"), ("half-truths", "ground_truth")] {
        let log = picked(name, |message| {
            message.parts() != ("car", missing) || message.sequence % 2 == 0
        });
        let words = "messages of ground truth or own labels were left out, because the message or its `_info` with the same stamp is missing";
        let ran = offline(&log, name);
        assert!(ran.code == 3 && ran.notes().contains(words), "{name}: {}", ran.notes());
        assert_eq!(info(&log).1, Some(3), "{name}");
    }
    let none = picked("mast-without-truth", |message| {
        let (agent, topic) = message.parts();
        agent != "mast" || !topic.starts_with("ground_truth")
    });
    let words = "20 of 20 sweeps of the ego were scored without the truth of mast";
    reported(&none, "mast-without-truth", words, words);
}

#[test]
fn an_agent_that_the_record_does_not_name_is_reported() {
    let base = Scene::default().write("undeclared-base");
    let record = |record: &mut BTreeMap<String, String>| {
        let mut agents: Vec<serde_json::Value> = serde_json::from_str(&record["agents"]).expect("JSON");
        agents.retain(|agent| agent["name"] != "mast");
        record.insert("agents".into(), serde_json::to_string(&agents).expect("JSON"));
    };
    let log = rewrite_with(&base, "undeclared", &[], record, |message| vec![message]);
    let words = "messages were not played, because `agents` of the log's record `realo` does not name the agent";
    reported(&log, "undeclared", words, words);
}

#[test]
fn poses_that_nothing_can_have_are_reported() {
    let with = |name: &str, change: fn(&mut [f64], u32)| with_poses(name, "/car/pose", change);
    let order = with("pose-wxyz", |pose, _| pose[3..].rotate_right(1));
    let words = "is the quaternion in the order x, y, z, w?";
    reported(&order, "pose-wxyz", words, words);
    let jumps = with("pose-jumps", |pose, n| pose[0] += if n % 9 == 0 { 20.0 } else { 0.0 });
    let words = "poses jump faster than any vehicle drives";
    reported(&jumps, "pose-jumps", words, words);
    let far = with("pose-far", |pose, n| pose[1] += if n == 3 { 1e300 } else { 0.0 });
    let words = "expected a position within 80,000 km of the map's origin";
    reported(&far, "pose-far", words, words);
}

#[test]
fn truth_of_which_nothing_is_scored_is_found_before_a_run() {
    // That of the mast has a class that is scored.
    let log = changed("truth-class", |message| {
        if message.topic == "/car/ground_truth" {
            let (stamp, mut found) = boxes::decode(&message.data).expect("boxes");
            found.0.iter_mut().for_each(|object| object.class = "Tram".into());
            message.data.clear();
            boxes::encode(&mut message.data, stamp, "car/body", &found.0);
        }
    });
    let words = "objects of the ground truth were not scored, because protocol `default` has no class for `Tram`";
    let ran = offline(&log, "truth-class");
    assert!(ran.code == 3 && ran.notes().contains(words), "{}", ran.notes());
    let (said, code) = info(&log);
    assert!(code == Some(3) && said.contains("`Tram`"), "{said}");
}

#[test]
fn sweeps_of_some_agents_without_points_are_played_by_detections() {
    let log = picked("mast-without-points", |message| message.topic != "/mast/points");
    let ran = offline(&log, "mast-without-points");
    assert!(
        ran.code == 0 && ran.err.contains("a log without points of mast"),
        "{}",
        ran.err
    );
    assert_eq!((ran.ap("0.5"), info(&log).1), (1.0, Some(0)), "{}", ran.notes());
}
