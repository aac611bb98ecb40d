//! Clocks that are off, as runs find them: said with a bound, and dropped, put right or trusted as asked.

use std::path::{Path, PathBuf};

use serde_json::Value;

use crate::common;
use crate::scene::{Ran, Raw, Scene, T0, rewrite, run, run_ego};

const S: i64 = 1_000_000_000;
const MS: i64 = 1_000_000;
const MODES: [(&str, &[&str]); 2] = [("offline", &["--offline"]), ("virtual", &["--mode", "virtual"])];

/// Two vehicles with inertial units, whose clocks and sweeps are as `more` says.
fn drive(name: &str, more: &[&str]) -> PathBuf {
    let args = "--seed 911 --seconds 6 --no-clouds --key-hz 10 --agents cav1,cav2 --inertial consumer --vehicle-sensor spinning-16";
    common::simulated(name, &[&args.split(' ').collect::<Vec<_>>(), more].concat())
}

fn late_fusion(log: &Path, name: &str, more: &[&str]) -> Ran {
    run_ego("cav1", "late_fusion", log, name, more)
}

fn result(ran: &Ran) -> &Value {
    ran.result.as_ref().unwrap_or_else(|| panic!("no result: {}", ran.err))
}

/// What the result has of the clock of a sensor.
fn clock<'a>(ran: &'a Ran, agent: &str, sensor: &str) -> &'a Value {
    let clocks = result(ran)["clocks"].as_array().expect("clocks");
    let mut clocks = clocks.iter();
    let is = |clock: &&Value| clock["agent"] == agent && clock["sensor"] == sensor;
    clocks.find(is).unwrap_or_else(|| panic!("no {agent} {sensor}"))
}

/// Offset and bound, ms.
fn offset(clock: &Value) -> [f64; 2] {
    ["offset_ms", "bound_ms"].map(|name| clock[name].as_f64().unwrap_or_else(|| panic!("no {name}: {clock}")))
}

/// Messages of cav2 that were used.
fn used(ran: &Ran) -> u64 {
    result(ran)["links"]["cav2-cav1"]["boxes"]["used"].as_u64().unwrap_or(0)
}

const VIRTUAL: &[&str] = &["--mode", "virtual"];

fn with<'a>(mode: &[&'a str], stamps: &'a str) -> Vec<&'a str> {
    [mode, &["--stamps", stamps]].concat()
}

#[test]
fn an_offset_is_said_with_its_bound_where_it_is_one() {
    let right = late_fusion(&drive("offsets-right", &[]), "offsets-right", VIRTUAL);
    assert!(!right.out.contains("clocks"), "{}", right.out);
    let log = drive(
        "offsets-80",
        &["--clock-error", "cav2=80,20", "--sweep-phase", "cav2=37.5"],
    );
    let ran = late_fusion(&log, "offsets-80", VIRTUAL);
    for (agent, truth) in [("cav1", 0.0), ("cav2", -80.0)] {
        let [offset, bound] = offset(clock(&ran, agent, "imu"));
        assert!(
            (offset - truth).abs() <= bound && bound <= 5.0,
            "{agent}: {offset} ± {bound}"
        );
        let lidar = clock(&ran, agent, "lidar");
        let [offset, bound] = self::offset(lidar);
        assert!((offset - truth).abs() <= bound, "{agent}: {lidar}");
    }
    assert!(
        ran.out.contains("clocks: to be added to stamps ± bound, ms"),
        "{}",
        ran.out
    );
    assert!(
        ran.out.contains("cav2 imu") && !ran.out.contains("cav1 imu"),
        "{}",
        ran.out
    );
    assert!(used(&ran) > 0);
    // Offline nothing arrives.
    let offline = late_fusion(&log, "offsets-80-offline", &["--offline"]);
    assert!(clock(&offline, "cav2", "imu")["offset_ms"].is_null());
}

#[test]
fn sweeps_of_any_phase_get_their_poses() {
    for phase in ["0", "12.5", "49", "99"] {
        let name = format!("offsets-phase-{phase}");
        let log = drive(&name, &["--sweep-phase", &format!("cav2={phase}")]);
        let ran = late_fusion(&log, &name, VIRTUAL);
        let counters = &result(&ran)["nodes"]["others.sense.sync"]["counters"];
        assert!(
            counters["no_pose"].is_null() && counters["not_deskewed"].is_null(),
            "{phase}: {counters}"
        );
        assert!(
            ran.code == 0 && used(&ran) >= 55,
            "{phase}: {} used, {}",
            used(&ran),
            ran.notes()
        );
    }
}

#[test]
fn a_step_of_a_clock_is_named_and_taken_back() {
    let log = drive("offsets-step", &["--clock-error", "cav2=0,0,600@3"]);
    let usual = late_fusion(&log, "offsets-step", VIRTUAL);
    let notes = usual.notes();
    assert!(notes.contains("clock stepped by 0.2 s or more"), "{notes}");
    assert_eq!(
        clock(&usual, "cav2", "lidar")["step_ms"].as_f64().map(f64::round),
        Some(600.0)
    );
    assert!(usual.out.contains("stepped by +600"), "{}", usual.out);
    let clean = late_fusion(&drive("offsets-right", &[]), "offsets-clean", VIRTUAL);
    let ran = late_fusion(&log, "offsets-step-rebased", &with(VIRTUAL, "rebase"));
    let [few, all] = [used(&ran), used(&clean)];
    assert!(few <= all && few + 3 >= all, "{few} of {all}");
    assert!(ran.notes().contains("got other stamps"), "{}", ran.notes());
    let back = drive("offsets-back", &["--clock-error", "cav2=0,0,-700@3"]);
    let rebased = late_fusion(&back, "offsets-back", &with(VIRTUAL, "rebase"));
    // A step back is sure after 0.7 s.
    assert!(
        used(&rebased) + 12 >= used(&clean),
        "{} of {}",
        used(&rebased),
        used(&clean)
    );
    let dropped = late_fusion(&back, "offsets-back-dropped", &with(VIRTUAL, "drop"));
    assert!(
        dropped.notes().contains("were left out") && used(&dropped) < 35,
        "{}",
        dropped.notes()
    );
}

#[test]
fn a_clock_by_another_time_is_put_right_to_the_bit_in_all_modes() {
    let clean = drive("offsets-right", &[]);
    for (name, error) in [
        ("tai", "cav2=37000"),
        ("weeks", "cav2=-619315200000"),
        ("ego", "cav1=18000"),
    ] {
        let log = drive(&format!("offsets-{name}"), &["--clock-error", error]);
        for (mode, options) in MODES {
            let expected = late_fusion(&clean, &format!("offsets-{name}-{mode}-clean"), options);
            let rebased = late_fusion(&log, &format!("offsets-{name}-{mode}"), &with(options, "rebase"));
            assert!(rebased.code == 0, "{name} {mode}: {rebased:?}");
            for part in ["accuracy", "frames", "age_ms"] {
                assert_eq!(result(&rebased)[part], result(&expected)[part], "{name} {mode} {part}");
            }
            assert!(
                rebased.notes().contains("got other stamps") && rebased.out.contains("lidar"),
                "{name} {mode}: {}",
                rebased.out
            );
            if name == "ego" {
                continue;
            }
            let usual = late_fusion(&log, &format!("offsets-{name}-{mode}-usual"), options);
            assert!(used(&usual) == 0 && usual.code == 3, "{name} {mode}");
            assert!(
                usual.out.contains("cav2") && usual.out.contains("another clock, left out"),
                "{name} {mode}: {}",
                usual.out
            );
        }
    }
}

/// The scene with each message changed.
fn changed(name: &str, mut change: impl FnMut(&mut Raw)) -> PathBuf {
    let base = Scene::default().write(&format!("{name}-base"));
    rewrite(&base, name, |mut message| {
        change(&mut message);
        vec![message]
    })
}

fn is_of_mast(message: &Raw) -> bool {
    message.parts().0 == "mast" && message.parts().1 != "ground_truth_markers"
}

#[test]
fn a_clock_that_counts_from_boot_is_put_right_by_arrivals() {
    let log = changed("offsets-boot", |message| {
        if is_of_mast(message) {
            message.shift(4_280 * S - T0);
        }
    });
    for (mode, options) in MODES {
        let ran = run(
            "late_fusion",
            &log,
            &format!("offsets-boot-{mode}"),
            &with(options, "rebase"),
        );
        assert_eq!(ran.code, 0, "{mode}: {ran:?}");
        assert!(ran.ap("0.5") >= 0.95, "{mode}: {}", ran.ap("0.5"));
        assert!(
            ran.notes().contains("time since the sensor or its computer started"),
            "{mode}: {}",
            ran.notes()
        );
    }
}

#[test]
fn stamps_that_repeat_run_backwards_or_stand_still_are_left_out_if_asked_for() {
    let number = |message: &Raw| (message.header_stamp() - T0).div_euclid(100 * MS);
    type Instead = fn(i64) -> i64;
    let faults: [(&str, Instead, u64); 3] = [
        ("repeat", |number| if number == 7 { 6 } else { number }, 1),
        (
            "backwards",
            |number| if number % 5 == 4 { number - 2 } else { number },
            4,
        ),
        ("still", |number| number.min(12), 7),
    ];
    for (name, instead, left_out) in faults {
        let log = changed(&format!("offsets-{name}"), |message| {
            if is_of_mast(message) && message.parts().1 != "pose" {
                let number = number(message);
                message.shift((instead(number) - number) * 100 * MS);
            }
        });
        for rule in ["drop", "rebase"] {
            for (mode, options) in MODES {
                let ran = run(
                    "late_fusion",
                    &log,
                    &format!("offsets-{name}-{rule}-{mode}"),
                    &with(options, rule),
                );
                let counted = result(&ran)["nodes"]["player"]["counters"]["stamps_left_out"].as_u64();
                // Its points, and the topic that says when they were taken.
                assert_eq!(counted, Some(2 * left_out), "{name} {rule} {mode}: {}", ran.notes());
                assert!(ran.notes().contains("mast: "), "{name} {rule} {mode}: {}", ran.notes());
            }
        }
    }
}

#[test]
fn an_agent_with_no_time_in_common_is_in_the_table() {
    let log = changed("offsets-apart", |message| {
        if is_of_mast(message) {
            message.shift(3_600 * S);
            message.log_time += 3_600 * S;
        }
    });
    for (mode, options) in MODES {
        let ran = run("late_fusion", &log, &format!("offsets-apart-{mode}"), options);
        assert!(
            ran.out.contains("no time in common with the ego"),
            "{mode}: {}",
            ran.out
        );
        let three = ["no_fusion", "late_fusion_tracked"].map(common::graph);
        let list = run(
            "late_fusion",
            &log,
            &format!("offsets-apart-list-{mode}"),
            &[options, &[&three[0], &three[1]]].concat(),
        );
        assert!(list.out.contains("mast: no time in common"), "{mode}: {}", list.out);
    }
}

#[test]
fn other_rules_are_refused_by_name() {
    let log = Scene::default().write("offsets-rule");
    let ran = run("late_fusion", &log, "offsets-rule", &["--offline", "--stamps", "guess"]);
    assert!(ran.code == 2 && ran.err.contains("drop, rebase, trust"), "{ran:?}");
}
