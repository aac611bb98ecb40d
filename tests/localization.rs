//! Agents that find their own poses: the options, errors in the result, and what is refused.

mod common;

use std::path::{Path, PathBuf};

use common::{folder, realo, realo_ok, run_virtual, simulated, text};
use serde_json::Value;

const DRIVE: &str = "--scenario loop --seed 900 --place 900 --seconds 8 --key-hz 1 --agents cav1,rsu1 --vehicle-sensor spinning-16 \
                     --roadside-sensor spinning-16";

fn drive(name: &str, more: &[&str]) -> PathBuf {
    let args: Vec<&str> = DRIVE.split_whitespace().chain(more.iter().copied()).collect();
    simulated(name, &args)
}

fn shown(path: &Path) -> String {
    path.to_string_lossy().into_owned()
}

/// The map of the drive.
fn map(log: &Path, out: &Path) -> String {
    let out = shown(out);
    realo_ok(["map", "build", &shown(log), "-o", &out]);
    out
}

fn run(name: &str, log: &Path, more: &[&str]) -> Value {
    let args = [["--recorded-detections", "--ego", "cav1"].as_slice(), more].concat();
    run_virtual(name, "late_fusion", log, &args)
}

/// What a run says that must fail.
fn refused(log: &Path, more: &[&str]) -> String {
    let (log, out) = (shown(log), shown(&folder("localization-refused")));
    let args = [
        &[
            "run",
            "late_fusion",
            "--recorded-detections",
            "--mode",
            "virtual",
            "--ego",
            "cav1",
            "--log",
            &log,
            "--out",
            &out,
        ],
        more,
    ]
    .concat();
    let output = realo(args);
    assert_eq!(output.status.code(), Some(1), "{}", text(&output.stdout));
    text(&output.stderr)
}

#[test]
fn errors_of_every_agent_are_in_the_result_and_recorded_poses_have_none() {
    let log = drive("localization", &["--inertial", "tactical"]);
    let folder = folder("localization");
    let map = map(&log, &folder.join("loop.map"));
    let recorded = run("localization-recorded", &log, &[]);
    assert!(recorded["localization"].is_null());
    let by_map = run("localization-map", &log, &["--localization", "map", "--map", &map]);
    assert!(by_map["localization"].is_object(), "{by_map}");
    let of = |result: &Value, agent: &str, path: &str| result.pointer(&format!("/localization/{agent}{path}")).cloned();
    let number =
        |result: &Value, agent: &str, path: &str| of(result, agent, path).and_then(|v| v.as_f64()).unwrap_or(f64::NAN);
    for agent in ["cav1", "rsu1"] {
        assert_eq!(number(&by_map, agent, "/frames"), 80.0);
        assert!(number(&by_map, agent, "/availability") > 0.8, "{by_map}");
        assert!(
            number(&by_map, agent, "/position_m/p95") < 0.15,
            "{}",
            by_map["localization"]
        );
        assert!(
            number(&by_map, agent, "/heading_deg/p95") < 0.3,
            "{}",
            by_map["localization"]
        );
    }
    let by_gnss = run("localization-gnss", &log, &["--localization", "gnss"]);
    assert!(number(&by_gnss, "cav1", "/position_m/p95") > number(&by_map, "cav1", "/position_m/p95"));
    let sources = [&recorded, &by_gnss].map(|result| result["pose_source"].as_str());
    assert_eq!(sources, [None, Some("gnss")]);
    assert!(
        by_map["pose_source"]
            .as_str()
            .is_some_and(|source| source.starts_with("map (loop.map-"))
    );
    // The same by hand.
    let set = ["ego", "others"].map(|lane| format!("{lane}.sense.localization.source=gnss"));
    let by_hand = run("localization-set", &log, &["--set", &set[0], "--set", &set[1]]);
    assert_eq!(by_hand["localization"], by_gnss["localization"]);
    // What does not know where it is sends nothing, and is named.
    let unsent = |result: &Value| {
        result
            .pointer("/nodes/others.sender/counters/unplaced_messages")
            .cloned()
    };
    let init = |result: &Value| {
        result
            .pointer("/nodes/others.sense.localization/counters/init")
            .cloned()
    };
    assert!(init(&by_gnss).is_some(), "a unit needs some positions");
    assert_eq!(unsent(&by_gnss), init(&by_gnss));
}

#[test]
fn what_cannot_be_localised_is_refused_by_name() {
    let log = drive("localization", &["--inertial", "tactical"]);
    let bare = drive("localization-bare", &[]);
    let folder = folder("localization-refusals");
    let map_file = map(&log, &folder.join("loop.map"));
    let text = refused(&log, &["--localization", "map"]);
    assert!(text.contains("add --map FILE"), "{text}");
    let text = refused(&log, &["--map", &map_file]);
    assert!(text.contains("--localization map"), "{text}");
    let text = refused(&bare, &["--localization", "gnss"]);
    assert!(
        text.contains("/cav1/imu") && text.contains("--localization recorded"),
        "{text}"
    );
    let text = refused(&log, &["--localization", "map", "--map", &shown(&log)]);
    assert!(text.contains("realo map build"), "{text}");
    let away = drive(
        "localization-away",
        &["--inertial", "tactical", "--map-offset", "3000,500"],
    );
    let text = refused(&away, &["--localization", "map", "--map", &map_file]);
    assert!(
        text.contains("a map of another place") && text.contains("cav1 at ("),
        "{text}"
    );
}
