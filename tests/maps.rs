//! Maps from logs: the same file every time, described, and refused where they cannot be.

mod common;

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use common::{REALO, folder, realo, realo_ok, simulated, text};
use serde_json::Value;

/// Three seconds of a vehicle and a roadside unit.
fn log() -> PathBuf {
    let args = "--seed 914 --seconds 3 --key-hz 1 --agents cav1,rsu1";
    simulated("maps", &args.split(' ').collect::<Vec<_>>())
}

fn shown(path: &Path) -> String {
    path.to_string_lossy().into_owned()
}

fn build(out: &Path, more: &[&str]) -> String {
    let (log, out) = (shown(&log()), shown(out));
    realo_ok([&["map", "build", &log, "-o", &out], more].concat())
}

fn info(map: &Path) -> Value {
    serde_json::from_str(&realo_ok(["map", "info", "--json", &shown(map)])).unwrap()
}

#[test]
fn a_map_is_drawn_from_above() {
    let home = folder("maps_drawn");
    let map = home.join("town.map");
    build(&map, &[]);
    let picture = home.join("town.svg");
    let said = realo_ok(["render".into(), map.clone(), "-o".into(), picture.clone()]);
    assert!(said.contains("town.map") && said.contains("voxels of 1 m"), "{said}");
    let svg = std::fs::read_to_string(&picture).expect("it is there");
    roxmltree::Document::parse(&svg).expect("it is XML");
    assert!(svg.contains("#56b4e9") && !svg.contains("NaN"));
    let error = refused(&[
        "render",
        &shown(&map),
        "--frame",
        "3",
        "-o",
        &shown(&picture),
        "--force",
    ]);
    assert!(error.contains("has no frame"), "{error}");
}

/// What a command says on standard error, which must fail.
fn refused(args: &[&str]) -> String {
    let output = realo(args);
    assert_eq!(output.status.code(), Some(1), "{args:?}\n{}", text(&output.stdout));
    text(&output.stderr)
}

#[test]
fn a_map_is_the_same_file_every_time_and_says_what_it_is_of() {
    let folder = folder("maps");
    let [one, again, vehicle] = ["one.map", "again.map", "vehicle.map"].map(|name| folder.join(name));
    let said = build(&one, &["--poses", "true"]);
    build(&again, &["--poses", "true"]);
    assert!(fs::read(&one).unwrap() == fs::read(&again).unwrap());
    let described = info(&one);
    assert_eq!(
        (&described["sweeps"], &described["frame"]),
        (&Value::from(60), &Value::from("map"))
    );
    let voxels = described["voxels"].as_u64().unwrap();
    assert!(
        voxels > 1000 && said.contains(&format!("voxels    {voxels} of 1 m")),
        "{said}"
    );
    assert!(described["planar"].as_u64().unwrap() > voxels / 4, "{described}");
    assert!(described["left_out"].as_u64().unwrap() > 0, "{described}");

    build(&vehicle, &["--agents", "cav1", "--voxel", "0.5"]);
    let described = info(&vehicle);
    assert_eq!(
        (&described["sweeps"], &described["voxel_m"]),
        (&Value::from(30), &Value::from(0.5))
    );
}

#[test]
fn what_cannot_be_built_or_read_is_refused_by_name() {
    let folder = folder("maps_refused");
    let (log, notes) = (shown(&log()), folder.join("notes.txt"));
    fs::write(&notes, "what I must not forget").unwrap();
    let map = shown(&folder.join("street.map"));
    let said = refused(&["map", "build", &log, "-o", &shown(&notes)]);
    assert!(
        said.contains("refuse to overwrite") && said.contains("notes.txt"),
        "{said}"
    );
    let said = refused(&["map", "build", &log, &log, "-o", &map]);
    assert!(said.contains("given twice"), "{said}");
    let said = refused(&["map", "info", &shown(&folder)]);
    assert!(
        said.contains("a folder") && said.matches("a folder").count() == 1,
        "{said}"
    );
    let said = refused(&["map", "build", &log, "-o", &map, "--agents", "cav7"]);
    assert!(said.contains("--agents cav7"), "{said}");
    let said = refused(&["map", "build", &log, "-o", &map, "--voxel", "0"]);
    assert!(said.contains("`voxel_m`: expected 0.05 to 10, found 0"), "{said}");
    let bare = simulated(
        "maps_bare",
        &["--seed", "914", "--seconds", "1", "--no-clouds", "--agents", "cav1"],
    );
    let said = refused(&["map", "build", &shown(&bare), "-o", &map]);
    assert!(said.contains("expected an agent with sweeps"), "{said}");
    assert!(!Path::new(&map).exists());

    let said = refused(&["map", "info", &shown(&notes)]);
    assert!(said.contains("notes.txt") && said.contains("realo map build"), "{said}");
    build(Path::new(&map), &["--agents", "cav1"]);
    let mut bytes = fs::read(&map).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle] ^= 1;
    fs::write(&map, bytes).unwrap();
    let said = refused(&["map", "info", &map]);
    assert!(said.contains("checksum") && said.contains("street.map"), "{said}");
}

/// Eight seconds of a drive with motion sensors.
fn drive(name: &str, more: &[&str]) -> PathBuf {
    let args = "--scenario loop --seed 900 --place 900 --seconds 8 --key-hz 1 --agents cav1,rsu1 --vehicle-sensor spinning-16 \
                --roadside-sensor spinning-16";
    let args: Vec<&str> = args.split_whitespace().chain(more.iter().copied()).collect();
    simulated(name, &args)
}

#[test]
fn poses_are_found_by_sensors_and_what_is_wrong_is_told() {
    let folder = folder("maps_estimated");
    let log = shown(&drive("maps_estimated", &["--inertial", "tactical"]));
    let maps = ["one.map", "three.map"].map(|name| folder.join(name));
    let said = ["1", "3"].iter().zip(&maps).map(|(threads, map)| {
        let args = ["map", "build", &log, "--poses", "estimated", "-o", &shown(map)];
        let output = Command::new(REALO)
            .args(args)
            .env("RAYON_NUM_THREADS", threads)
            .output();
        let output = output.expect("realo starts");
        assert!(output.status.success(), "{}", text(&output.stderr));
        [text(&output.stdout), text(&output.stderr)]
    });
    let said: Vec<[String; 2]> = said.collect();
    assert!(
        fs::read(&maps[0]).unwrap() == fs::read(&maps[1]).unwrap(),
        "threads change bytes"
    );
    let [out, notes] = &said[0];
    assert!(
        out.contains("before loops were closed") && out.contains("aligned as a whole"),
        "{out}"
    );
    assert!(
        notes.contains("cav1: no loop was closed") && notes.contains("`rsu1` does not drive"),
        "{notes}"
    );

    let described = info(&maps[0]);
    assert_eq!(described["closure"]["loops"], Value::from(0));
    assert!(described["closure"]["keyframes"].as_u64().unwrap() > 5, "{described}");
    // Over a short way GNSS without corrections says little.
    assert!(described["pose_sigmas"][0].as_f64().unwrap() > 0.3, "{described}");
    assert!(info_text(&maps[0]).contains("none was closed among"));
    // A map by given poses has no graph.
    build(&folder.join("given.map"), &["--agents", "cav1"]);
    assert!(info(&folder.join("given.map"))["closure"].is_null());

    let bare = shown(&drive("maps_estimated_bare", &[]));
    let map = shown(&folder.join("bare.map"));
    let said = refused(&["map", "build", &bare, "--poses", "estimated", "-o", &map]);
    assert!(
        said.contains("/cav1/imu") && said.contains("--poses recorded"),
        "{said}"
    );
    let said = refused(&[
        "map",
        "build",
        &log,
        "--poses",
        "estimated",
        "--agents",
        "rsu1",
        "-o",
        &map,
    ]);
    assert!(said.contains("expected a vehicle"), "{said}");
}

fn info_text(map: &Path) -> String {
    realo_ok(["map", "info", &shown(map)])
}
