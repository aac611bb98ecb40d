//! Agents that find their own poses: the options, errors in the result, and what is refused.

mod common;
#[path = "common/scans.rs"]
mod scans;

use std::path::{Path, PathBuf};

use common::{folder, json, realo, realo_ok, run_virtual, simulated, text};
use nalgebra::{Isometry3, Vector3};
use realo_logs::{
    ANTENNA_FRAME, AgentInfo, AgentKind, FixReading, IMU_FRAME, ImuReading, LogInfo, LogWriter, MapOrigin, sensor_frame,
};
use realo_schemas::{AgentState, FixQuality, Nanos, PointCloud, PoseStatus};
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

/// A run of late fusion in virtual time.
fn played<'a>(log: &'a str, out: &'a str, more: &[&'a str]) -> Vec<&'a str> {
    let mut args = vec![
        "run",
        "late_fusion",
        "--recorded-detections",
        "--mode",
        "virtual",
        "--ego",
        "cav1",
    ];
    args.extend(["--log", log, "--out", out]);
    args.extend(more);
    args
}

/// What a run says that must fail.
fn refused(log: &Path, more: &[&str]) -> String {
    let output = realo(played(&shown(log), &shown(&folder("localization-refused")), more));
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

/// What localization costs is said by a run with the poses of the log, which is made once.
#[test]
fn a_table_says_what_localization_costs() {
    let log = drive("localization", &["--inertial", "tactical"]);
    let folder = folder("localization-cost");
    let out = folder.join("gnss");
    let (log, out_shown) = (shown(&log), shown(&out));
    let run = |more: &[&str]| {
        let args = played(&log, &out_shown, &["--localization", "gnss"]);
        let output = realo([args.as_slice(), more].concat());
        assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
        (text(&output.stdout), text(&output.stderr))
    };
    let recorded = folder.join("gnss_recorded");
    let (table, said) = run(&["--no-cost"]);
    assert!(
        !table.contains("Localization, at") && !said.contains("once more"),
        "{said}"
    );
    assert!(!recorded.exists());
    run(&["--json"]);
    assert!(!recorded.exists(), "a program compares by itself");
    let (table, said) = run(&[]);
    assert!(said.contains("once more with the poses of the log"), "{said}");
    let mean = |folder: &Path| {
        let result = json(&folder.join("result.json"));
        result.pointer("/accuracy/sorted/mAP/0.5").unwrap().as_f64().unwrap()
    };
    let (own, exact) = (mean(&out), mean(&recorded));
    // Lines are broken anywhere.
    let words = |text: &str| text.split_whitespace().collect::<Vec<_>>().join(" ");
    let expected = format!(
        "poses of gnss cost {:.3} in late_fusion: {own:.3}, and {exact:.3} with",
        exact - own
    );
    assert!(words(&table).contains(&expected), "{table}");
    let (again, said) = run(&[]);
    assert!(!said.contains("once more"), "{said}");
    assert!(words(&again).contains(&expected), "{again}");
    // Results of another run are never replaced.
    std::fs::remove_file(recorded.join(".recorded-poses")).unwrap();
    std::fs::remove_file(recorded.join("localization/cav1/result.json")).unwrap();
    let (_, said) = run(&[]);
    assert!(
        said.contains("holds something else") && said.contains("--no-cost"),
        "{said}"
    );
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

/// A log of a vehicle that stands for 8 s, with one sweep two times a second, an inertial unit, and a receiver that is off by up to 2 m.
fn standing(path: &Path, cloud: &PointCloud, map_from_body: &Isometry3<f64>) {
    const START: Nanos = 1_700_000_000_000_000_000;
    const MS: Nanos = 1_000_000;
    let geodetic = [48.0, 11.0, 500.0];
    let origin = MapOrigin::new(geodetic).expect("a place on the Earth");
    let vehicle = AgentInfo {
        name: "car".into(),
        kind: AgentKind::Vehicle,
        footprint: None,
        sensor: String::new(),
        sensor_position: None,
    };
    let info = LogInfo {
        map_origin: Some(geodetic),
        ..LogInfo::new("two sweeps of another maker", vec![vehicle])
    };
    let mut log = LogWriter::create(path, &info).expect("a log");
    for sensor in [IMU_FRAME, ANTENNA_FRAME] {
        let written = log.mount("car", START, &sensor_frame("car", sensor), &Isometry3::identity());
        written.expect("a mount is written");
    }
    let up = map_from_body.rotation.inverse() * Vector3::z() * 9.81;
    for k in 0..800 {
        let stamp = START + k * 10 * MS;
        // What noise a unit has: a saw, which is never twice the same within a second.
        let noise = |step: Nanos| ((k * step) % 101 - 50) as f64 / 50.0;
        let imu = ImuReading {
            angular_rate: [1e-3 * noise(37), 1e-3 * noise(41), 1e-3 * noise(43)],
            specific_force: (up + 0.01 * Vector3::new(noise(47), noise(53), noise(59))).into(),
            variance: Some([1e-6, 1e-4]),
        };
        log.imu("car", stamp, stamp + MS, &imu).expect("a sample is written");
        if k % 10 == 0 {
            let off = Vector3::new(2.0 * noise(61), 2.0 * noise(67), 2.0 * noise(71));
            let fix = FixReading {
                quality: Some(FixQuality::Single),
                geodetic: origin.from_map((map_from_body.translation.vector + off).into()),
                covariance: Some([2.0, 0.0, 0.0, 0.0, 2.0, 0.0, 0.0, 0.0, 2.0]),
            };
            log.fix("car", stamp, stamp + MS, &fix).expect("a fix is written");
        }
        let state = AgentState {
            map_from_body: *map_from_body,
            covariance: None,
            velocity: None,
            angular_rate: None,
            status: PoseStatus::Recorded,
        };
        log.pose("car", stamp, stamp + MS, &state).expect("a pose is written");
        log.pose_truth("car", stamp, stamp + MS, &state)
            .expect("a pose is written");
        if k % 50 == 0 {
            log.cloud("car", stamp, stamp + 100 * MS, cloud)
                .expect("a sweep is written");
        }
    }
    log.finish().expect("a whole log");
}

#[test]
fn sweeps_of_another_maker_are_placed_on_their_map() {
    let Some(scans::Pair {
        source,
        target,
        target_from_source,
    }) = scans::pair()
    else {
        return;
    };
    let folder = folder("localization-pair");
    let [mapped, log] = ["target.mcap", "source.mcap"].map(|name| folder.join(name));
    standing(&mapped, &target, &Isometry3::identity());
    standing(&log, &source, &target_from_source);
    let map = map(&mapped, &folder.join("target.map"));
    let more = ["--localization", "map", "--map", &map, "--ego", "car"];
    let result = run_virtual("localization-scans", "no_fusion", &log, &more);
    let number = |path: &str| {
        let found = result.pointer(&format!("/localization/car{path}"));
        found.and_then(Value::as_f64).unwrap_or(f64::NAN)
    };
    let all = &result["localization"];
    assert!(number("/availability") >= 0.5, "{all}");
    // As far as methods agree on this pair.
    assert!(number("/position_m/p95") <= 0.05, "{all}");
    assert!(number("/heading_deg/p95") <= 0.5, "{all}");
}
