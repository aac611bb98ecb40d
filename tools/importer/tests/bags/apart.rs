//! What one recorder said in several bags: clouds in one, poses in another.

use std::path::{Path, PathBuf};

use super::wire::{Recorded, transform};
use super::world::{BASE, MS, Names, PLAIN, SWEEPS, T0, place, recording};
use super::writers::ros1;
use super::{Played, import, played};

const MINE: &str =
    "agents:\n  car:\n    clouds: /velodyne_points\n    frame: base_link\n    pose: /odom\n    truth: /ground_truth\n";

/// The topics of a recording in two bags: those that `is_first` takes, and the others.
fn split(dir: &Path, names: [&str; 2], start: f64, is_first: impl Fn(&Recorded) -> bool) -> [PathBuf; 2] {
    let (first, second): (Vec<Recorded>, Vec<Recorded>) = recording(PLAIN, start, 0).into_iter().partition(is_first);
    let paths = names.map(|name| dir.join(name));
    for (path, messages) in paths.iter().zip([first, second]) {
        ros1(path, &messages, "none");
    }
    paths
}

fn is_of_lidar(message: &Recorded) -> bool {
    ["/velodyne_points", "/tf_static"].contains(&message.topic)
}

/// What a log has of the whole recording.
fn of_one_bag(dir: &Path) -> Played {
    let bag = dir.join("whole.bag");
    ros1(&bag, &recording(PLAIN, 0.0, 0), "none");
    let log = dir.join("whole.mcap");
    import(&[bag], Some(MINE), &log).unwrap();
    played(&log, "car")
}

#[test]
fn two_bags_of_a_vehicle_are_read_as_one() {
    let dir = tempfile::tempdir().unwrap();
    let bags = split(dir.path(), ["lidar.bag", "my gnss.bag"], 0.0, is_of_lidar);
    let map = MINE.replace("car:\n", "car:\n    bag: [lidar.bag, my gnss.bag]\n");
    let log = dir.path().join("log.mcap");
    let summary = import(&bags, Some(&map), &log).unwrap();
    assert_eq!(summary.bags.len(), 2, "{summary}");
    assert_eq!(summary.warnings, [""; 0]);
    assert_eq!(played(&log, "car"), of_one_bag(dir.path()));
}

#[test]
fn the_draft_takes_two_bags_of_a_vehicle_together() {
    let dir = tempfile::tempdir().unwrap();
    let [lidar, gnss] = split(dir.path(), ["lidar.bag", "my gnss.bag"], 0.0, is_of_lidar);
    let log = dir.path().join("log.mcap");
    // The order in which they are given says nothing.
    let summary = import(&[gnss, lidar], None, &log).unwrap();
    let draft = summary.draft.unwrap();
    assert!(
        draft.contains("bag: [lidar.bag, 'my gnss.bag']  # read as one, of one clock"),
        "{draft}"
    );
    assert!(draft.contains("pose: /odom") && draft.contains("  ego:"), "{draft}");
    assert_eq!(played(&log, "ego"), of_one_bag(dir.path()));
}

#[test]
fn poses_in_another_bag_are_named_with_the_remedy() {
    let dir = tempfile::tempdir().unwrap();
    let bags = split(dir.path(), ["lidar.bag", "my gnss.bag"], 0.0, is_of_lidar);
    let log = dir.path().join("log.mcap");
    let write = "write `bag: [lidar.bag, my gnss.bag]`";
    let error = import(&bags, Some(MINE), &log).unwrap_err().to_string();
    for part in [
        "agents.car.pose",
        "lidar.bag` has no topic `/odom`",
        "my gnss.bag` has such",
        write,
    ] {
        assert!(error.contains(part), "{part}: {error}");
    }
    // What a shell does not take as one word is quoted.
    let command = format!("`realo info {}` lists all", bags[0].display());
    assert!(error.contains(&command), "{error}");
    let tf = MINE
        .replace("pose: /odom", "pose: tf")
        .replace("    truth: /ground_truth\n", "");
    let error = import(&bags, Some(&tf), &log).unwrap_err().to_string();
    assert!(
        error.contains("or are they in another file?") && error.contains(write),
        "{error}"
    );
}

#[test]
fn transforms_of_a_second_bag_place_the_clouds_of_the_first() {
    let dir = tempfile::tempdir().unwrap();
    let [lidar, other] = split(dir.path(), ["lidar.bag", "odom.bag"], 0.0, |message| {
        message.topic == "/velodyne_points"
    });
    let moving = (0..5 * SWEEPS).map(|step| {
        let stamp = T0 + step * 20 * MS;
        transform("/tf", stamp + MS, stamp, ["map", "base_link"], place(0.0, stamp))
    });
    let mut messages: Vec<Recorded> = recording(PLAIN, 0.0, 0);
    messages.retain(|message| message.topic == "/tf_static");
    messages.extend(moving);
    let tf = dir.path().join("tf.bag");
    ros1(&tf, &messages, "none");
    let map = MINE
        .replace("pose: /odom", "pose: tf")
        .replace("car:\n", "car:\n    bag: [tf.bag, lidar.bag, odom.bag]\n");
    let log = dir.path().join("log.mcap");
    import(&[lidar, other, tf], Some(&map), &log).unwrap();
    let (found, expected) = (played(&log, "car"), of_one_bag(dir.path()));
    assert_eq!((found.clouds, found.truth), (expected.clouds, expected.truth));
    let last = |poses: &[(i64, nalgebra::Isometry3<f64>)]| poses.last().unwrap().1.translation.vector;
    assert!((last(&found.poses) - last(&expected.poses)).norm() < 0.11);
}

#[test]
fn a_bag_that_two_agents_share_does_not_compare_their_clocks() {
    let dir = tempfile::tempdir().unwrap();
    let names = |start| recording(Names { truth: None, ..PLAIN }, start, 0);
    let [a, b] = ["a.bag", "b.bag"].map(|name| dir.path().join(name));
    ros1(&a, &names(0.0), "none");
    ros1(&b, &names(20.0), "none");
    let [truth, _] = split(dir.path(), ["truth.bag", "rest.bag"], 0.0, |message| {
        message.topic == "/ground_truth"
    });
    let agent = |name: &str| {
        format!(
            "  {name}:\n    bag: [{name}.bag, truth.bag]\n    clouds: /velodyne_points\n    frame: base_link\n    height: {BASE}\n    pose: /odom\n    truth: /ground_truth\n"
        )
    };
    let log = dir.path().join("log.mcap");
    let bags = [a, b, truth];
    let summary = import(&bags, Some(&format!("agents:\n{}{}", agent("a"), agent("b"))), &log).unwrap();
    let said = summary.to_string();
    assert!(said.contains("taken as one by header time"), "{said}");
    assert!(summary.agents.iter().all(|agent| agent.truths > 0), "{said}");
    assert_ne!(
        played(&log, "a").truth,
        played(&log, "b").truth,
        "each in its own frame"
    );
    // An agent that takes nothing of it leaves a warning where nobody else does.
    let alone = agent("a")
        .replace("[a.bag, truth.bag]", "a.bag")
        .replace("    truth: /ground_truth\n", "");
    let summary = import(&bags, Some(&format!("agents:\n{alone}")), &log).unwrap();
    let said = summary.warnings.join("\n");
    assert!(
        said.contains("no agent takes anything of") && said.contains("truth.bag"),
        "{said}"
    );
}

#[test]
fn lists_of_bags_that_do_not_fit_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    let bags = split(dir.path(), ["lidar.bag", "gnss.bag"], 0.0, is_of_lidar);
    let log = dir.path().join("log.mcap");
    for (list, expected) in [
        ("[lidar.bag, lidar.bag]", "bag: `lidar.bag` is there twice"),
        ("[lidar.bag, wheels.bag]", "found `wheels.bag`"),
        ("{a: b}", "bag: expected the path of a bag or a list of them"),
    ] {
        let map = MINE.replace("car:\n", &format!("car:\n    bag: {list}\n"));
        let error = import(&bags, Some(&map), &log).unwrap_err().to_string();
        assert!(error.contains(expected), "{error}");
    }
}
