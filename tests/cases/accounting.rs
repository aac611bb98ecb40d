//! What is dropped is said in the notes.

use std::path::PathBuf;
use std::process::Command;

use realo_logs::boxes;
use realo_schemas::Box3;

use crate::common;
use crate::scene::{SWEEP, Scene, T0, info, rewrite, run, run_ego};

fn of_classes(name: &str, class: fn(usize) -> &'static str) -> PathBuf {
    Scene {
        class,
        ..Scene::default()
    }
    .write(name)
}

#[test]
fn the_case_of_classes_does_not_matter() {
    let all: fn(usize) -> &'static str = |_| "car";
    let mixed: fn(usize) -> &'static str = |index| if index % 2 == 0 { "CAR" } else { "Car" };
    for (name, class) in [("class-lower", all), ("class-mixed", mixed)] {
        let log = of_classes(name, class);
        let alone = run("no_fusion", &log, name, &["--offline"]);
        assert_eq!((alone.code, alone.ap("0.5")), (0, 0.5), "{alone:?}");
        let late = run("late_fusion", &log, name, &["--offline"]);
        assert_eq!((late.code, late.ap("0.5")), (0, 1.0), "{late:?}");
    }
}

#[test]
fn classes_that_the_protocol_drops_are_named_with_how_many() {
    let log = of_classes(
        "class-dropped",
        |index| if index % 4 == 0 { "tram\u{e9}" } else { "Car" },
    );
    let ran = run("late_fusion", &log, "class-dropped", &["--offline"]);
    assert_eq!(ran.code, 0, "the protocol says so: {ran:?}");
    let notes = ran.notes();
    assert!(notes.contains("tram\u{e9}") && notes.contains("40 of 160"), "{notes}");
}

#[test]
fn detections_of_classes_that_the_protocol_lacks_are_no_table() {
    let base = Scene::default().write("class-foreign-base");
    for (name, agents, code) in [("class-foreign", &["car", "mast"][..], 3), ("class-half", &["mast"], 0)] {
        let log = rewrite(&base, name, |mut message| {
            let (agent, stream) = message.parts();
            if agents.contains(&agent) && stream == "detections" {
                let places = 0..message.data.len() - 3;
                let cars: Vec<usize> = places.filter(|at| message.data[*at..].starts_with(b"Car")).collect();
                cars.iter()
                    .for_each(|at| message.data[*at..*at + 3].copy_from_slice(b"Foo"));
            }
            vec![message]
        });
        let ran = run("late_fusion", &log, name, &["--offline"]);
        assert_eq!(ran.code, code, "{ran:?}");
        let notes = ran.notes();
        assert!(
            notes.contains("detections were not scored") && notes.contains("`Foo` ("),
            "{notes}"
        );
        let (said, of_info) = info(&log);
        assert!(
            said.contains("of 160 recorded detections, classes that protocol `default` does not score: `Foo`"),
            "{said}"
        );
        assert_eq!((of_info, said.contains("PROBLEM")), (Some(code), code == 3), "{said}");
    }
}

#[test]
fn truth_of_a_collaborator_that_stops_early_is_counted() {
    let base = Scene::default().write("truth-stops-base");
    let log = rewrite(&base, "truth-stops", |message| {
        let is_truth = message.topic.starts_with("/mast/ground_truth");
        match is_truth && message.publish_time > T0 + 3 * SWEEP {
            true => Vec::new(),
            false => vec![message],
        }
    });
    let ran = run("late_fusion", &log, "truth-stops", &["--offline"]);
    assert_eq!(ran.code, 3, "{ran:?}");
    let notes = ran.notes();
    assert!(
        notes.contains("of 20 sweeps of the ego were scored without the truth of mast"),
        "{notes}"
    );
}

#[test]
fn truth_that_was_logged_late_is_scored() {
    let base = Scene::default().write("truth-late-base");
    for (name, agent) in [("truth-late-all", ""), ("truth-late-mast", "/mast")] {
        let log = rewrite(&base, name, |mut message| {
            if message.topic.starts_with(agent) && message.topic.contains("/ground_truth") {
                message.log_time += 50 * SWEEP;
            }
            vec![message]
        });
        let ran = run("late_fusion", &log, name, &["--offline"]);
        assert_eq!((ran.code, ran.ap("0.5")), (0, 1.0), "{ran:?}");
    }
}

#[test]
fn a_log_of_boxes_alone_is_reported_how_to_play_them() {
    let log = Scene {
        points: false,
        ..Scene::default()
    }
    .write("boxes-alone");
    let late = common::graph("late_fusion");
    let played = |name: &str, more: &[&str]| {
        let out = common::folder(name);
        let output = Command::new(common::REALO)
            .args(["run", &late, "--ego", "car", "--offline"])
            .args(more)
            .arg("--log")
            .arg(&log)
            .arg("--out")
            .arg(&out)
            .output();
        let code = output.expect("realo can be started").status.code();
        (code, common::json(&out.join("result.json"))["notes"][0].to_string())
    };
    let (code, first) = played("boxes-alone-detector", &[]);
    assert_eq!(code, Some(3), "{first}");
    assert!(
        first.contains("car: 20 of 20 (the first has no points)") && first.contains("--recorded-detections"),
        "{first}"
    );
    let (code, _) = played("boxes-alone-recorded", &["--recorded-detections"]);
    assert_eq!(code, Some(0));
}

#[test]
fn cooperation_that_added_nothing_is_said_first_and_in_the_table() {
    // The mast has no sweep: its detections belong to nothing.
    let base = Scene::default().write("unused-base");
    let log = rewrite(&base, "unused", |mut message| {
        if message.parts() == ("mast", "detections") || message.parts() == ("mast", "detections_info") {
            message.shift(SWEEP / 2);
        }
        vec![message]
    });
    let ran = run("late_fusion", &log, "unused", &["--offline"]);
    assert_eq!((ran.code, ran.ap("0.5")), (3, 0.5), "{ran:?}");
    let notes = ran.notes();
    assert!(notes.starts_with("mast: no message was used"), "{notes}");
    assert!(
        notes.contains(": 20 of 20 messages") && notes.contains("no sweep has their stamp"),
        "{notes}"
    );
    assert!(ran.out.contains("cooperation added nothing"), "{}", ran.out);
    assert!(ran.out.contains("all (added nothing)"), "{}", ran.out);
    let first = ran.out.lines().find(|line| line.starts_with("note"));
    assert!(
        first.is_some_and(|line| line.contains("mast: no message was used")),
        "{}",
        ran.out
    );
}

#[test]
fn what_comes_late_is_a_note_and_no_fault_of_the_log() {
    let log = Scene::default().write("late");
    let late = ["--mode", "virtual", "--link", "delay_ms=700"];
    let ran = run("late_fusion", &log, "late", &late);
    assert_eq!((ran.code, ran.ap("0.5")), (0, 0.5), "{ran:?}");
    let notes = ran.notes();
    assert!(notes.starts_with("mast: no message was used"), "{notes}");
    assert!(notes.contains("older than 400 ms"), "{notes}");
}

#[test]
fn an_agent_whose_data_stop_midway_is_named() {
    let base = Scene::default().write("stops-base");
    let log = rewrite(&base, "stops", |message| {
        let is_gone = message.parts().0 == "mast" && message.header_stamp() >= T0 + 10 * SWEEP;
        if is_gone { vec![] } else { vec![message] }
    });
    for mode in [&["--offline"][..], &["--mode", "virtual"]] {
        let ran = run("late_fusion", &log, &format!("stops-{}", mode.len()), mode);
        assert_eq!(ran.code, 3, "{ran:?}");
        let notes = ran.notes();
        let words = "10 of 20 sweeps are missing: its data have gaps, begin late or stop early";
        let said = format!("mast: {words} (its last is 0.980 s earlier than the last of all)");
        assert!(notes.contains(&said), "{notes}");
    }
    let (said, code) = info(&log);
    assert!(
        said.contains("PROBLEM: `mast`: 10 of 20 sweeps are missing") && code == Some(3),
        "{said}"
    );
}

#[test]
fn gaps_in_the_middle_are_the_same_for_info_and_run() {
    let base = Scene::default().write("gap-base");
    let log = rewrite(&base, "gap", |message| {
        let (agent, stream) = message.parts();
        let sweep = (message.header_stamp() - T0).div_euclid(SWEEP);
        let is_gone = agent == "mast" && stream != "pose" && (6..14).contains(&sweep);
        if is_gone { vec![] } else { vec![message] }
    });
    let words = "8 of 20 sweeps are missing: its data have gaps, begin late or stop early (none for 0.900 s, 0.500 s after its first)";
    let ran = run("late_fusion", &log, "gap", &["--offline"]);
    assert_eq!(ran.code, 3, "{ran:?}");
    assert!(ran.notes().contains(&format!("mast: {words}")), "{}", ran.notes());
    let (said, code) = info(&log);
    assert!(
        said.contains(&format!("PROBLEM: `mast`: {words}")) && code == Some(3),
        "{said}"
    );
}

/// A box of each message of an agent's topic, changed.
fn with_boxes(name: &str, topic: &str, change: impl Fn(&mut Box3)) -> PathBuf {
    let base = Scene::default().write(&format!("{name}-base"));
    rewrite(&base, name, |mut message| {
        if message.topic == topic {
            let frame = format!("{}/body", message.parts().0);
            let (stamp, mut found) = boxes::decode(&message.data).expect("boxes");
            change(&mut found.0[1]);
            message.data.clear();
            boxes::encode(&mut message.data, stamp, &frame, &found.0);
        }
        vec![message]
    })
}

#[test]
fn boxes_at_absurd_places_or_of_absurd_sizes_are_named() {
    let far: fn(&mut Box3) = |object| object.center[0] = 1e30;
    let large: fn(&mut Box3) = |object| object.length = 101.0;
    let detections = "mast: 20 of 80 recorded detections were left out, because no object can have such numbers";
    let truth = "car: 20 of 160 objects of the ground truth were not scored, because no object can have such numbers";
    for (name, topic, change, words, fault) in [
        (
            "far-boxes",
            "/mast/detections",
            far,
            detections,
            "a distance of 1.000e30 m",
        ),
        (
            "large-boxes",
            "/mast/detections",
            large,
            detections,
            "a size of 1.010e2 × ",
        ),
        ("far-truth", "/car/ground_truth", far, truth, "a distance of 1.000e30 m"),
    ] {
        let log = with_boxes(name, topic, change);
        for mode in [&["--offline"][..], &["--mode", "virtual"]] {
            let ran = run("late_fusion", &log, &format!("{name}-{}", mode.len()), mode);
            assert_eq!(ran.code, 3, "{name}: {ran:?}");
            let said = format!("{words} (the first has {fault}");
            let notes = ran.notes();
            assert!(notes.contains(&said), "{name}: {notes}");
            assert_eq!(notes.matches("no object can have").count(), 1, "{name}: {notes}");
        }
        let (said, code) = info(&log);
        let problem = format!("PROBLEM: {topic}: 20 of ");
        assert!(
            said.contains(&problem) && said.contains(fault) && code == Some(3),
            "{name}: {said}"
        );
    }
}

#[test]
fn a_truck_trailer_and_a_box_at_the_edge_of_sight_are_fine() {
    let log = with_boxes("long-boxes", "/mast/detections", |object| {
        object.center[0] = 9_000.0;
        object.length = 60.0;
    });
    let ran = run("late_fusion", &log, "long-boxes", &["--offline"]);
    assert_eq!(ran.code, 0, "{ran:?}");
    assert!(!ran.notes().contains("no object can have"), "{}", ran.notes());
}

#[test]
fn agents_whose_names_hold_hyphens_cooperate() {
    let scene = Scene {
        agents: ["car-1", "mast-1-car"],
        ..Scene::default()
    };
    let log = scene.write("hyphens");
    let ran = run_ego("car-1", "late_fusion", &log, "hyphens", &["--offline"]);
    assert_eq!((ran.code, ran.ap("0.5")), (0, 1.0), "{}", ran.notes());
    let cooperation = &ran.result.as_ref().expect("a result")["cooperation"];
    assert_eq!((&cooperation["runs"], &cooperation["in_vain"]), (&1.into(), &0.into()));
    assert!(!ran.notes().contains("no message was used"), "{}", ran.notes());
}

#[test]
fn sweeps_without_detections_are_named() {
    let base = Scene::default().write("hole-base");
    let log = rewrite(&base, "hole", |message| {
        let (agent, stream) = message.parts();
        let sweep = (message.header_stamp() - T0).div_euclid(SWEEP);
        let is_gone = agent == "mast" && stream.starts_with("detections") && (5..10).contains(&sweep);
        if is_gone { vec![] } else { vec![message] }
    });
    for mode in [&["--offline"][..], &["--mode", "virtual"]] {
        let ran = run("late_fusion", &log, &format!("hole-{}", mode.len()), mode);
        assert_eq!(ran.code, 3, "{ran:?}");
        let notes = ran.notes();
        assert!(
            notes.contains("mast: 5 of 20 sweeps have no recorded detections"),
            "{notes}"
        );
    }
    let info = common::realo(["info", &log.to_string_lossy()]);
    let said = common::text(&info.stdout);
    assert!(
        said.contains("PROBLEM: `mast`: 5 of 20 sweeps have no recorded detections"),
        "{said}"
    );
}

#[test]
fn poses_in_another_frame_are_named_with_it() {
    let base = Scene::default().write("odo-base");
    let log = rewrite(&base, "odo", |mut message| {
        if message.parts() == ("mast", "pose") {
            let frame = &mut message.data[16..19];
            assert_eq!(frame, b"map");
            frame.copy_from_slice(b"odo");
        }
        vec![message]
    });
    let ran = run("late_fusion", &log, "odo", &["--offline"]);
    assert_eq!(ran.code, 3, "{ran:?}");
    assert!(
        ran.notes().contains("its frame is `odo`, expected `map`"),
        "{}",
        ran.notes()
    );
    let info = common::realo(["info", &log.to_string_lossy()]);
    let said = common::text(&info.stdout);
    assert!(said.contains("PROBLEM: /mast/pose: "), "{said}");
}

#[test]
fn objects_with_too_few_points_are_a_note_where_they_are_many() {
    // Nobody has points on half of the objects, as where collaborators' truth has other tracks.
    let base = Scene::default().write("few-base");
    let log = rewrite(&base, "few", |message| {
        let is_truth = message.parts().1.starts_with("ground_truth");
        if message.parts().0 == "mast" && is_truth {
            vec![]
        } else {
            vec![message]
        }
    });
    let ran = run("late_fusion", &log, "few", &["--offline"]);
    let notes = ran.notes();
    assert!(
        notes.contains(
            "80 of 160 objects of the ground truth were not scored, because the agents together have too few points"
        ),
        "{notes}"
    );
}

#[test]
fn a_healthy_log_has_no_notes_of_losses() {
    let log = Scene::default().write("healthy");
    for mode in [&["--offline"][..], &["--mode", "virtual"]] {
        let ran = run("late_fusion", &log, &format!("healthy-{}", mode.len()), mode);
        assert_eq!(ran.code, 0, "{ran:?}");
        let notes = ran.notes();
        for word in ["mast: ", "car: ", " of 20 "] {
            assert!(!notes.contains(word), "{notes}");
        }
    }
}

#[test]
fn truth_of_unknown_classes_alone_is_the_first_note() {
    let log = of_classes("class-unknown", |_| "Tram");
    let ran = run("no_fusion", &log, "class-unknown", &["--offline"]);
    assert_eq!(ran.code, 3, "{ran:?}");
    assert!(
        ran.notes()
            .starts_with("160 of 160 objects of the ground truth were not scored"),
        "{}",
        ran.notes()
    );
}
