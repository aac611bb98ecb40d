//! Stamps and poses of other recorders: sensors on another clock, publish times that are not stamps, few poses, stamps that
//! float seconds have rounded.

use std::path::{Path, PathBuf};

use realo_logs::{cloud, pose};
use realo_schemas::{Nanos, PoseStatus};

use crate::common;
use crate::scene::{Ran, Raw, Scene, T0, info, rewrite, run};

const S: Nanos = 1_000_000_000;
const MS: Nanos = 1_000_000;
const MODES: [(&str, &[&str]); 2] = [("offline", &["--offline"]), ("virtual", &["--mode", "virtual"])];

/// The scene with each message changed.
fn changed(name: &str, scene: &Scene, mut change: impl FnMut(&mut Raw)) -> PathBuf {
    let base = scene.write(&format!("{name}-base"));
    rewrite(&base, name, |mut message| {
        change(&mut message);
        vec![message]
    })
}

/// The scene with the clouds of an agent on another clock.
fn on_another_clock(name: &str, agent: &str, by: Nanos) -> PathBuf {
    changed(name, &Scene::default(), |message| {
        if message.parts().0 == agent && ["points", "sweeps"].contains(&message.parts().1) {
            message.shift(by);
        }
    })
}

fn late_fusion(log: &Path, name: &str, mode: &[&str]) -> Ran {
    run("late_fusion", log, name, mode)
}

/// The first note where scores lack the mast's truth.
const WITHOUT_TRUTH: &str = "mast: 20 of 20 sweeps of the ego were scored without the truth of mast";

const WEEKS: Nanos = 1024 * 7 * 86_400 * S;

#[test]
fn a_lidar_on_another_clock_is_named_with_the_kind_of_clock() {
    for (name, by, kind) in [
        (
            "tai",
            37 * S,
            "36.910 s later than log times: looks like TAI against UTC",
        ),
        (
            "tai-earlier",
            -37 * S,
            "37.090 s earlier than log times: looks like UTC against TAI",
        ),
        ("gps", 18 * S, "looks like GPS time against UTC"),
        (
            "boot",
            4_280 * S - T0,
            "looks like time since the sensor or its computer started",
        ),
        ("rollover", -WEEKS, "week number has rolled over (1024 weeks)"),
    ] {
        let log = on_another_clock(name, "mast", by);
        for (mode, options) in MODES {
            let ran = late_fusion(&log, &format!("{name}-{mode}"), options);
            let notes = ran.notes();
            assert_eq!(ran.code, 3, "{name} {mode}: {notes}");
            assert!(
                notes.contains(": 20 of ") && notes.contains(kind),
                "{name} {mode}: {notes}"
            );
            assert!(notes.contains("set the sensor's clock"), "{name} {mode}: {notes}");
            assert!(notes.starts_with("mast: no message was used"), "{name} {mode}: {notes}");
        }
        let (said, code) = info(&log);
        assert!(
            said.contains("PROBLEM: `mast`: 40 of ") || said.contains("PROBLEM: `mast`: 20 of "),
            "{said}"
        );
        assert!(said.contains(kind) && code == Some(3), "{said}");
    }
}

#[test]
fn a_lidar_on_another_clock_is_named_in_realtime() {
    let log = on_another_clock("tai-realtime", "mast", 37 * S);
    common::machine::decided(|| {
        let ran = late_fusion(&log, "tai-realtime", &["--mode", "realtime"]);
        assert_eq!(ran.code, 3, "{ran:?}");
        assert!(
            ran.notes().contains("36.910 s later than log times: looks like TAI"),
            "{}",
            ran.notes()
        );
    });
}

#[test]
fn an_ego_on_another_clock_is_refused() {
    let log = on_another_clock("ego-boot", "car", 4_280 * S - T0);
    for (mode, options) in MODES {
        let ran = late_fusion(&log, &format!("ego-boot-{mode}"), options);
        assert_eq!(ran.code, 1, "{ran:?}");
        assert!(ran.err.contains("the clock of `car`, the ego, is off"), "{}", ran.err);
    }
}

#[test]
fn one_sweep_of_the_ego_on_another_clock_is_left_out_and_counted() {
    for (name, lost) in [("ego-first-off", 0..1), ("ego-few-off", 0..9)] {
        let log = changed(name, &Scene::default(), |message| {
            let is_sweep = ["points", "sweeps"].contains(&message.parts().1);
            let number = (message.header_stamp() - T0).div_euclid(100 * MS);
            if message.parts().0 == "car" && is_sweep && lost.contains(&number) {
                message.shift(-37 * S);
            }
        });
        for (mode, options) in MODES {
            let ran = late_fusion(&log, &format!("{name}-{mode}"), options);
            assert_eq!(ran.code, 3, "{name} {mode}: {ran:?}");
            let notes = ran.notes();
            let said = format!("car: {} of ", lost.end);
            assert!(
                notes.starts_with(&said) && notes.contains("looks like UTC against TAI"),
                "{name} {mode}: {notes}"
            );
            let result = ran.result.as_ref().expect("a result");
            assert_eq!(result["frames"]["total"], 20 - lost.end, "{name} {mode}");
        }
        let (said, code) = info(&log);
        assert!(said.contains("PROBLEM: `car`: ") && code == Some(3), "{said}");
        assert_eq!(said.matches("PROBLEM").count(), 1, "it is said once: {said}");
    }
}

#[test]
fn an_agent_that_is_moved_as_a_whole_is_named() {
    let moved = |name: &str, by: Nanos, log_too: bool| {
        changed(name, &Scene::default(), |message| {
            if message.parts().0 == "mast" && message.parts().1 != "ground_truth_markers" {
                message.shift(by);
            }
            if message.parts().0 == "mast" && log_too {
                message.log_time += by;
            }
        })
    };
    for (name, by, log_too, words, problem) in [
        ("all-tai", 37 * S, false, "looks like TAI", "`mast`: "),
        (
            "all-logged",
            37 * S,
            true,
            "no time in common",
            "have no time in common",
        ),
        ("all-200", 200 * MS, false, "0.200 s later than log times", "`mast`: "),
    ] {
        let log = moved(name, by, log_too);
        for (mode, options) in MODES {
            let ran = late_fusion(&log, &format!("{name}-{mode}"), options);
            assert_eq!(ran.code, 3, "{name} {mode}: {ran:?}");
            let notes = ran.notes();
            assert!(notes.contains(words), "{name} {mode}: {notes}");
            // Half of the objects have points of the mast alone: without its truth AP would read 1.0.
            assert_eq!(
                notes.starts_with(WITHOUT_TRUTH),
                by > S,
                "{name} {mode}, first of all: {notes}"
            );
            assert!(
                by < S || notes.contains("mast: no message was used"),
                "{name} {mode}: {notes}"
            );
        }
        let (said, code) = info(&log);
        assert!(
            said.contains("PROBLEM: ") && said.contains(problem) && code == Some(3),
            "{said}"
        );
    }
}

#[test]
fn the_header_has_the_stamp_and_the_log_time_says_when_it_is_known() {
    let all = [
        "pose",
        "detections",
        "detections_info",
        "ground_truth",
        "ground_truth_info",
    ];
    let truth = &all[3..];
    for (name, topics) in [
        ("late-poses", &all[..1]),
        ("late-boxes", &all[1..]),
        ("late-infos", &all[4..]),
        ("late-truth", truth),
    ] {
        let published = changed(name, &Scene::default(), |message| {
            if topics.contains(&message.parts().1) {
                message.publish_time += 400 * MS;
            }
        });
        let virtual_time = late_fusion(&published, &format!("{name}-virtual"), MODES[1].1);
        assert_eq!(
            (virtual_time.code, virtual_time.ap("0.5")),
            (3, 0.975),
            "{name}: {virtual_time:?}"
        );
        let logged = changed(&format!("{name}-logged"), &Scene::default(), |message| {
            if topics.contains(&message.parts().1) {
                message.publish_time += 150 * MS;
                message.log_time += 150 * MS;
            }
        });
        let offline = late_fusion(&logged, &format!("{name}-offline"), MODES[0].1);
        assert_eq!((offline.code, offline.ap("0.5")), (3, 1.0), "{name}: {offline:?}");
        let notes = offline.notes();
        assert!(
            notes.contains("publish time that is not the stamp of their header"),
            "{notes}"
        );
        let (said, code) = info(&published);
        assert!(
            code == Some(3) && said.contains("the first is 0.400 s later than it"),
            "{said}"
        );
    }
}

#[test]
fn without_stamps_in_headers_the_publish_time_counts() {
    let log = changed("no-headers", &Scene::default(), |message| {
        if !["/tf", "/tf_static"].contains(&message.topic.as_str()) && !message.topic.ends_with("markers") {
            message.set_header_stamp(0);
        }
    });
    let ran = late_fusion(&log, "no-headers", MODES[0].1);
    assert_eq!((ran.code, ran.ap("0.5")), (0, 1.0), "{ran:?}");
}

#[test]
fn a_mast_that_tells_its_pose_once_is_there_at_all_times() {
    let once = Scene {
        pose_hz: [20, 0],
        ..Scene::default()
    };
    let first = once.write("mast-once");
    // A latched pose has the stamp of when the mast was set up; another comes when half of the sweeps are over.
    let latched = changed("mast-latched", &once, |message| {
        if message.topic == "/mast/pose" {
            message.shift(-3_600 * S);
        }
    });
    let late = changed("mast-late", &once, |message| {
        if message.topic == "/mast/pose" {
            message.shift(1_000 * MS);
            message.log_time += 1_000 * MS;
        }
    });
    let slow = Scene {
        pose_hz: [20, 2],
        ..Scene::default()
    }
    .write("mast-slow");
    for (name, log) in [("once", first), ("latched", latched), ("late", late), ("slow", slow)] {
        assert_eq!(
            run("no_fusion", &log, &format!("mast-{name}"), MODES[0].1).ap("0.5"),
            0.5
        );
        for ((mode, options), right) in MODES.into_iter().zip([1.0, 0.975]) {
            let ran = late_fusion(&log, &format!("mast-{name}-{mode}"), options);
            assert_eq!((ran.code, ran.ap("0.5")), (0, right), "{name} {mode}: {}", ran.notes());
        }
        let (said, code) = info(&log);
        assert!(!said.contains("PROBLEM") && code == Some(0), "{name}: {said}");
    }
}

#[test]
fn a_vehicle_with_one_pose_or_slow_poses_says_why_and_what_helps() {
    for (name, hz, words, problem) in [
        ("car-once", 0, "at least two are needed", "it has one pose"),
        (
            "car-5hz",
            5,
            "(poses 200 ms apart, max_gap_ms=150)",
            "10 of 20 sweeps have no pose: poses come every 200 ms",
        ),
    ] {
        let log = Scene {
            pose_hz: [hz, 20],
            ..Scene::default()
        }
        .write(name);
        for (mode, options) in MODES {
            let ran = late_fusion(&log, &format!("{name}-{mode}"), options);
            assert_eq!(ran.code, 3, "{name} {mode}: {ran:?}");
            assert!(
                ran.notes().contains(words) && ran.notes().contains("max_gap_ms=…"),
                "{name} {mode}: {}",
                ran.notes()
            );
        }
        let (said, code) = info(&log);
        assert!(said.contains(problem) && code == Some(3), "{said}");
    }
    let log = Scene {
        pose_hz: [5, 5],
        ..Scene::default()
    }
    .write("bridged");
    let bridged = ["--offline", "--set", "ego.sense.sync.max_gap_ms=200"];
    let ran = late_fusion(&log, "bridged", &bridged);
    assert_eq!((ran.code, ran.ap("0.5")), (0, 1.0), "{ran:?}");
    for hz in [7, 10] {
        let log = Scene {
            pose_hz: [hz, hz],
            ..Scene::default()
        }
        .write(&format!("hz{hz}"));
        let ran = late_fusion(&log, &format!("hz{hz}"), MODES[0].1);
        assert_eq!((ran.code, ran.ap("0.5")), (0, 1.0), "{ran:?}");
    }
}

#[test]
fn stamps_are_joined_within_a_microsecond_and_the_nearest_is_said() {
    let moved = |name: &str, by: Nanos| {
        changed(name, &Scene::default(), |message| {
            let stream = message.parts().1;
            if stream.starts_with("detections") || stream.starts_with("ground_truth") && !stream.ends_with("markers") {
                message.shift(by);
            }
        })
    };
    for (name, by) in [("float-early", -128), ("float-late", 128), ("most", 1_000)] {
        let log = moved(name, by);
        for ((mode, options), right) in MODES.into_iter().zip([1.0, 0.975]) {
            let ran = late_fusion(&log, &format!("{name}-{mode}"), options);
            assert_eq!((ran.code, ran.ap("0.5")), (0, right), "{name} {mode}: {}", ran.notes());
        }
        assert_eq!(info(&log).1, Some(0));
    }
    let log = moved("twelve", 12 * MS);
    for (mode, options) in MODES {
        let ran = late_fusion(&log, &format!("twelve-{mode}"), options);
        assert_eq!(ran.code, 3, "{ran:?}");
        let notes = ran.notes();
        assert!(
            notes.matches("(the nearest is 12.000 ms away)").count() >= 3,
            "{mode}: {notes}"
        );
        assert!(
            notes.contains("recorded detections") && notes.contains("ground truth"),
            "{mode}: {notes}"
        );
    }
    let (said, code) = info(&log);
    assert!(
        said.contains("/car/ground_truth: 20 of 20 messages have the stamp of no sweep: the nearest is 12.000 ms away"),
        "{said}"
    );
    assert!(said.contains("/mast/detections: 20 of 20") && code == Some(3), "{said}");
}

#[test]
fn info_tells_who_stops_and_what_the_protocol_drops() {
    let base = Scene::default().write("stops-base");
    let (said, code) = info(&base);
    assert!(
        !said.contains("PROBLEM") && !said.contains("dropped") && code == Some(0),
        "{said}"
    );
    let log = rewrite(&base, "stops", |message| {
        let is_left_out = message.parts().0 == "mast" && message.log_time > T0 + S;
        if is_left_out { Vec::new() } else { vec![message] }
    });
    let (said, code) = info(&log);
    assert!(
        said.contains(
            "PROBLEM: `mast`: 11 of 20 sweeps are missing: its data have gaps, begin late or stop early (its last is 1.080 s earlier \
             than the last of all)"
        ) && code == Some(3),
        "{said}"
    );
    let unicorn = Scene {
        class: |index| if index == 2 { "Unicorn" } else { "Car" },
        ..Scene::default()
    };
    let (said, code) = info(&unicorn.write("unicorn"));
    assert!(
        said.contains("of 320 boxes of ground truth") && said.contains("`Unicorn` 40") && code == Some(0),
        "{said}"
    );
}

#[test]
fn truth_or_detections_alone_on_another_clock_are_named() {
    let off = "looks like TAI against UTC";
    for (name, agent, stream, by, log_too, kind) in [
        ("truth-tai", "", "ground_truth", 37 * S, true, off),
        ("truth-stamp", "", "ground_truth", 37 * S, false, off),
        (
            "truth-earlier",
            "",
            "ground_truth",
            -37 * S,
            false,
            "looks like UTC against TAI",
        ),
        ("boxes-tai", "mast", "detections", 37 * S, true, off),
    ] {
        let log = changed(name, &Scene::default(), |message| {
            let (of, topic) = message.parts();
            let is_moved =
                topic.starts_with(stream) && !topic.ends_with("markers") && (agent.is_empty() || of == agent);
            if is_moved {
                message.shift(by);
                message.log_time += if log_too { by } else { 0 };
            }
        });
        let (said, code) = info(&log);
        assert!(said.contains("PROBLEM: ") && said.contains(kind), "{name}: {said}");
        assert_eq!(code, Some(3), "{name}: {said}");
        for (mode, options) in MODES {
            let ran = late_fusion(&log, &format!("{name}-{mode}"), options);
            assert_eq!(ran.code, 3, "{name} {mode}: {ran:?}");
            let reported = if stream == "detections" {
                "no recorded detections"
            } else {
                kind
            };
            let notes = ran.notes();
            let is_reported = notes.contains(reported) || notes.contains("recorded detections were left out");
            assert!(is_reported, "{name} {mode}: {notes}");
        }
    }
}

#[test]
fn truth_of_one_agent_alone_on_another_clock_is_the_first_note() {
    let truth_of = |agent: &'static str, log_too: bool| {
        move |message: &mut Raw| {
            let (of, topic) = message.parts();
            if of == agent && topic.starts_with("ground_truth") && !topic.ends_with("markers") {
                message.shift(37 * S);
                message.log_time += if log_too { 37 * S } else { 0 };
            }
        }
    };
    let of_ego = "car: 20 of 20 messages of ground truth were left out";
    for (name, agent, log_too, first) in [
        ("mast-truth-tai", "mast", false, WITHOUT_TRUTH),
        ("mast-truth-logged", "mast", true, WITHOUT_TRUTH),
        ("car-truth-logged", "car", true, of_ego),
    ] {
        let log = changed(name, &Scene::default(), truth_of(agent, log_too));
        let (said, code) = info(&log);
        let problem = format!("PROBLEM: /{agent}/ground_truth: ");
        let is_named = said.contains(&problem) || said.contains(&format!("PROBLEM: `{agent}`: "));
        assert!(
            is_named && said.contains("looks like TAI") && code == Some(3),
            "{name}: {said}"
        );
        for (mode, options) in MODES {
            let ran = late_fusion(&log, &format!("{name}-{mode}"), options);
            assert_eq!(ran.code, 3, "{name} {mode}: {ran:?}");
            assert!(ran.notes().starts_with(first), "{name} {mode}: {}", ran.notes());
        }
    }
}

#[test]
fn two_stamps_of_one_message_hide_nothing_else() {
    let log = changed("two-stamps-and-truth", &Scene::default(), |message| {
        match message.parts() {
            ("car", "pose") => message.publish_time += 400 * MS,
            ("mast", stream) if stream.starts_with("detections") => message.shift(12 * MS),
            _ => {}
        }
    });
    let (said, code) = info(&log);
    for part in [
        "PROBLEM: /car/pose: the publish time of ",
        "PROBLEM: /mast/detections: 20 of 20 messages have the stamp of no sweep",
    ] {
        assert!(said.contains(part), "no `{part}` in {said}");
    }
    assert_eq!(code, Some(3));
}

#[test]
fn a_map_frame_may_begin_with_a_slash() {
    let slashed = |message: &mut Raw| {
        if message.parts().1 == "pose" {
            let (stamp, state) = pose::decode(&message.data, PoseStatus::Recorded).expect("a pose");
            message.data.clear();
            pose::encode(&mut message.data, stamp, "/map", &state);
        }
    };
    let log = changed("slashed-map", &Scene::default(), slashed);
    for ((mode, options), right) in MODES.into_iter().zip([1.0, 0.975]) {
        let ran = late_fusion(&log, &format!("slashed-map-{mode}"), options);
        assert_eq!((ran.code, ran.ap("0.5")), (0, right), "{mode}: {}", ran.notes());
    }
    let (said, code) = info(&log);
    assert!(!said.contains("PROBLEM") && code == Some(0), "{said}");
}

#[test]
fn transforms_bridge_no_longer_gaps_than_poses() {
    // Points of the car in the map; /tf, where the poses are too, lacks half a second.
    let base = Scene::default().write("tf-gap-base");
    let log = rewrite(&base, "tf-gap", |mut message| {
        let is_gone = message.topic == "/tf" && (T0 + 450 * MS..T0 + 950 * MS).contains(&message.log_time);
        if message.parts() == ("car", "points") {
            let (stamp, points) = cloud::decode(&message.data).expect("a cloud");
            message.data.clear();
            cloud::encode(&mut message.data, stamp, "map", &points);
        }
        if is_gone { vec![] } else { vec![message] }
    });
    let out = common::folder("tf-gap-run");
    let graph = common::graph("no_fusion");
    let (path, folder) = (log.to_string_lossy(), out.to_string_lossy());
    let args = [
        "run",
        &graph,
        "--log",
        &path,
        "--ego",
        "car",
        "--offline",
        "--out",
        &folder,
    ];
    let output = common::realo(args);
    assert_eq!(output.status.code(), Some(3), "{}", common::text(&output.stderr));
    let result = common::json(&out.join("result.json"));
    let notes = result["notes"].to_string();
    let gap = "transforms of `car/body` on /tf are 550 ms apart there, at most 150 ms are bridged";
    for part in ["car: 5 of 20 sweeps were left out, because no transform brings", gap] {
        assert!(notes.contains(part), "no `{part}` in {notes}");
    }
    let frames = &result["frames"];
    assert_eq!(
        (&frames["total"], &frames["skipped"]),
        (&20.into(), &5.into()),
        "{frames}"
    );
    let (said, code) = info(&log);
    let problem = "PROBLEM: `car`: 5 of 20 sweeps have no pose in the body frame";
    assert!(
        said.contains(problem) && said.contains(gap) && code == Some(3),
        "{said}"
    );
}
