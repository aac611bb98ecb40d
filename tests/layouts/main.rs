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
use crate::scene::{FRAMES, HEIGHT, Labels, Scene, assert_same, original};

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

/// Accuracy of a graph on a log.
fn accuracy(name: &str, graph: &str, log: &Path, ego: &str) -> serde_json::Value {
    let args = ["--offline", "--isa", "portable", "--ego", ego, "--protocol", "default"];
    let mut result = run_virtual(&format!("layouts_{name}_{graph}"), graph, log, &args);
    let frames = ["key", "total"].map(|key| result["frames"][key].as_u64());
    assert_eq!(frames, [Some(FRAMES); 2], "{name}: all frames are scored");
    result["accuracy"].take()
}

/// A layout, with the agents of its scene by their names in the original, and in the log that comes back.
struct Layout {
    kind: &'static str,
    agents: &'static str,
    names: &'static [&'static str],
    labels: Labels,
}

/// Brings a scene to a layout and back to a log, runs it, and compares all with the log that it came from. `there_and_back`: from the log
/// and its scene to a folder of data, and from there to a log.
fn goes_round(layout: &Layout, there_and_back: impl FnOnce(&Path, &Scene, &Path, &Path)) {
    let Layout {
        kind,
        agents,
        names,
        labels,
    } = layout;
    let log = original(agents);
    let (scene, dir) = (Scene::read(&log), folder(&format!("layouts_{kind}")));
    let back = dir.join("back.mcap");
    there_and_back(&log, &scene, &dir.join("data"), &back);
    assert_same(&scene, &Scene::read(&back), names, *labels);
    // Without points of each agent it is not known what an ego by itself can see.
    let graphs: &[&str] = match labels {
        Labels::OfEachAgent | Labels::OfAll => &["late_fusion", "no_fusion"],
        Labels::Given => &["late_fusion"],
    };
    for graph in graphs {
        let before = accuracy(&format!("{kind}_before"), graph, &log, &scene.agents[0].name);
        let after = accuracy(&format!("{kind}_after"), graph, &back, names[0]);
        let map = &before["v2x-real"]["mAP"]["0.5"];
        assert!(map.as_f64() > Some(0.3), "{kind}: {map}");
        assert_eq!(after, before, "{kind}: {graph}");
    }
    fs::remove_dir_all(dir).expect("the folder can be removed");
}

/// Checks a layout that is written here, with level LiDARs [`HEIGHT`] over the ground.
fn written(layout: &Layout, write: impl FnOnce(&Scene, &Path)) {
    let height = HEIGHT.to_string();
    written_for(layout, &["--level", "none", "--height", &height], write);
}

/// The same with other options of the import.
fn written_for(layout: &Layout, set: &[&str], write: impl FnOnce(&Scene, &Path)) {
    goes_round(layout, |_, scene, data, back| {
        write(scene, data);
        import(layout.kind, data, back, set);
    });
}

#[test]
fn v2x_real() {
    let layout = Layout {
        kind: "v2x-real",
        agents: "cav1,cav2,rsu1",
        names: &["cav_1", "cav_2", "rsu_1"],
        labels: Labels::OfEachAgent,
    };
    written(&layout, |scene, data| V2X_REAL.write(scene, data));
}

#[test]
fn v2v4real() {
    let layout = Layout {
        kind: "v2v4real",
        agents: "cav1,cav2",
        names: &["cav_0", "cav_1"],
        labels: Labels::OfEachAgent,
    };
    written(&layout, |scene, data| V2V4REAL.write(scene, data));
}

#[test]
fn cooperscene() {
    let layout = Layout {
        kind: "cooperscene",
        agents: "cav1,cav2,rsu1",
        names: &["cav_1", "cav_2", "rsu_0"],
        labels: Labels::OfEachAgent,
    };
    written(&layout, |scene, data| COOPERSCENE.write(scene, data));
}

#[test]
fn dair() {
    let layout = Layout {
        kind: "dair",
        agents: "cav1,rsu1",
        names: &["vehicle", "roadside"],
        labels: Labels::Given,
    };
    written_for(&layout, &[], |scene, data| dair::write_scene(scene, data, false));
}

#[test]
fn v2x_seq() {
    let layout = Layout {
        kind: "v2x-seq",
        agents: "cav1,rsu1",
        names: &["vehicle", "roadside"],
        labels: Labels::Given,
    };
    written(&layout, |scene, data| dair::write_scene(scene, data, true));
}

#[test]
fn tumtraf() {
    let layout = Layout {
        kind: "tumtraf",
        agents: "cav1,rsu1",
        names: &tumtraf::NAMES,
        labels: Labels::OfAll,
    };
    written(&layout, tumtraf::write_scene);
}

#[test]
fn urbaning() {
    let layout = Layout {
        kind: "urbaning",
        agents: "cav1,cav2,rsu1",
        names: &urbaning::NAMES,
        labels: Labels::OfAll,
    };
    written(&layout, urbaning::write_scene);
}

#[test]
fn numpy() {
    let layout = Layout {
        kind: "numpy",
        agents: "cav1,cav2,rsu1",
        names: &["cav1", "cav2", "rsu1"],
        labels: Labels::OfEachAgent,
    };
    written(&layout, arrays::write_scene);
}

#[test]
fn kitti() {
    let layout = Layout {
        kind: "kitti",
        agents: "cav1",
        names: &["cav_1"],
        labels: Labels::OfEachAgent,
    };
    goes_round(&layout, |log, scene, data, back| {
        lab_to(&["export", "kitti"], log, data, &[]);
        let height = scene.agents[0].height.to_string();
        import("kitti", data, back, &["--height", &height]);
    });
}

#[test]
fn rosbag2() {
    let layout = Layout {
        kind: "rosbag2",
        agents: "cav1,cav2,rsu1",
        names: &["cav1", "cav2", "rsu1"],
        labels: Labels::OfAll,
    };
    goes_round(&layout, |log, _, data, back| {
        lab_to(&["export", "rosbag2"], log, data, &[]);
        let map = data.join("map.yml");
        import("bag", data, back, &["--map", map.to_str().expect("a path of text")]);
    });
}
