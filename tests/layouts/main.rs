//! A scene of the simulator, written in the layouts of data sets, imported and run: points, poses and boxes come back, and late fusion
//! finds the same to the digit.

#[path = "../common/mod.rs"]
mod common;

mod arrays;
mod dair;
mod family;
mod files;
mod scene;
mod tumtraf;
mod urbaning;

use std::ffi::OsString;
use std::fs;
use std::path::Path;

use common::{folder, lab_ok, run_virtual};

use crate::family::{COOPERSCENE, V2V4REAL, V2X_REAL};
use crate::scene::{HEIGHT, Scene, original, same};

/// Runs a command of the workbench from a place to another one.
fn lab_to(words: &[&str], from: &Path, to: &Path, set: &[&str]) {
    let mut all: Vec<OsString> = words.iter().map(Into::into).collect();
    all.extend([from.into(), "-o".into(), to.into()]);
    all.extend(set.iter().map(OsString::from));
    lab_ok(all);
}

/// Imports what is below a folder.
fn import(kind: &str, data: &Path, log: &Path, set: &[&str]) {
    lab_to(&["import", kind], data, log, set);
}

/// What a strategy scores.
fn table(name: &str, graph: &str, log: &Path, ego: &str) -> serde_json::Value {
    let args = ["--offline", "--isa", "portable", "--ego", ego, "--protocol", "default"];
    let mut result = run_virtual(&format!("layouts_{name}_{graph}"), graph, log, &args);
    let frames = &result["frames"];
    assert_eq!(frames["key"], frames["total"], "{name}: all frames are scored");
    result["accuracy"].take()
}

/// Brings a scene to a layout and back to a log, runs it, and compares all with the log that it came from. `there_and_back`: from the log
/// and its scene to a folder of data, and from there to a log.
fn goes_round(kind: &str, agents: &str, names: &[&str], there_and_back: impl FnOnce(&Path, &Scene, &Path, &Path)) {
    let log = original(agents);
    let (scene, dir) = (Scene::read(&log), folder(&format!("layouts_{kind}")));
    let back = dir.join("back.mcap");
    there_and_back(&log, &scene, &dir.join("data"), &back);
    let found = Scene::read(&back);
    same(&scene, &found, names);
    // Without points of each agent it is not known what an ego by itself can see.
    let graphs: &[&str] = if found.counts_points() {
        &["late_fusion", "no_fusion"]
    } else {
        &["late_fusion"]
    };
    for graph in graphs {
        let before = table(&format!("{kind}_before"), graph, &log, &scene.agents[0].name);
        let after = table(&format!("{kind}_after"), graph, &back, names[0]);
        let map = &before["v2x-real"]["mAP"]["0.5"];
        assert!(map.as_f64() > Some(0.3), "{kind}: {map}");
        assert_eq!(after, before, "{kind}: {graph}");
    }
    fs::remove_dir_all(dir).expect("the folder can be removed");
}

/// A layout that is written here, of LiDARs that are level and so far over the ground.
fn written(kind: &str, agents: &str, names: &[&str], write: impl FnOnce(&Scene, &Path)) {
    goes_round(kind, agents, names, |_, scene, data, back| {
        write(scene, data);
        let set = ["--level", "none", "--height", &HEIGHT.to_string()];
        import(kind, data, back, if kind == "dair" { &[] } else { &set });
    });
}

#[test]
fn v2x_real() {
    written(
        "v2x-real",
        "cav1,cav2,rsu1",
        &["cav_1", "cav_2", "rsu_1"],
        |scene, data| V2X_REAL.write(scene, data),
    );
}

#[test]
fn v2v4real() {
    written("v2v4real", "cav1,cav2", &["cav_0", "cav_1"], |scene, data| {
        V2V4REAL.write(scene, data)
    });
}

#[test]
fn cooperscene() {
    written(
        "cooperscene",
        "cav1,cav2,rsu1",
        &["cav_1", "cav_2", "rsu_0"],
        |scene, data| {
            COOPERSCENE.write(scene, data);
        },
    );
}

#[test]
fn dair() {
    written("dair", "cav1,rsu1", &["vehicle", "roadside"], |scene, data| {
        dair::write_scene(scene, data, false);
    });
}

#[test]
fn v2x_seq() {
    written("v2x-seq", "cav1,rsu1", &["vehicle", "roadside"], |scene, data| {
        dair::write_scene(scene, data, true)
    });
}

#[test]
fn tumtraf() {
    written(
        "tumtraf",
        "cav1,rsu1",
        &[tumtraf::NAMES[0], tumtraf::NAMES[1]],
        tumtraf::write_scene,
    );
}

#[test]
fn urbaning() {
    written("urbaning", "cav1,cav2,rsu1", &urbaning::NAMES, urbaning::write_scene);
}

#[test]
fn numpy() {
    written(
        "numpy",
        "cav1,cav2,rsu1",
        &["cav1", "cav2", "rsu1"],
        arrays::write_scene,
    );
}

#[test]
fn kitti() {
    goes_round("kitti", "cav1", &["cav_1"], |log, scene, data, back| {
        lab_to(&["export", "kitti"], log, data, &[]);
        let height = scene.agents[0].height.to_string();
        import("kitti", data, back, &["--height", &height]);
    });
}

#[test]
fn rosbag2() {
    goes_round(
        "rosbag2",
        "cav1,cav2,rsu1",
        &["cav1", "cav2", "rsu1"],
        |log, _, data, back| {
            lab_to(&["export", "rosbag2"], log, data, &[]);
            let map = data.join("map.yml");
            import("bag", data, back, &["--map", map.to_str().expect("a path of text")]);
        },
    );
}
