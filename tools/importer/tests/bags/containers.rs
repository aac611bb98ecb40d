//! Every container and compression gives the same log.

use std::fs;
use std::path::{Path, PathBuf};

use super::wire::{Recorded, Wire};
use super::world::{BASE, MOUNTED, MS, PLAIN, SWEEPS, T0, objects, place, points, recording};
use super::writers::{PACKINGS, db3, mcap, metadata, ros1, zstd_file};
use super::{Played, import, played};

/// A folder of ROS 2 with parts of so many messages.
fn folder(dir: &Path, messages: &[Recorded], per_part: usize, packing: &str) -> PathBuf {
    fs::create_dir(dir).unwrap();
    let mut names = Vec::new();
    for (k, part) in messages.chunks(per_part).enumerate() {
        let path = dir.join(format!("bag_{k}.db3"));
        db3(&path, part, Wire::Little, packing == "MESSAGE");
        names.push(format!("bag_{k}.db3"));
        if packing == "FILE" {
            zstd_file(&path);
            names[k] += ".zstd";
        }
    }
    let names: Vec<&str> = names.iter().map(String::as_str).collect();
    let format = if packing.is_empty() { "" } else { "zstd" };
    metadata(dir, &names, [format, packing], messages.len());
    dir.into()
}

/// The same recording in every container.
pub fn all(dir: &Path, messages: &[Recorded]) -> Vec<(String, PathBuf)> {
    let mut bags = Vec::new();
    for packing in PACKINGS {
        let path = dir.join(format!("{packing}.bag"));
        ros1(&path, messages, packing);
        bags.push((format!("ROS 1, {packing}"), path));
    }
    for (name, wire) in [("little", Wire::Little), ("big", Wire::Big), ("ros1", Wire::Ros1)] {
        let path = dir.join(format!("{name}.mcap"));
        mcap(&path, messages, wire);
        bags.push((format!("MCAP, {name}"), path));
    }
    let packed = dir.join("packed.mcap");
    mcap(&packed, messages, Wire::Little);
    zstd_file(&packed);
    bags.push((".mcap.zstd".into(), dir.join("packed.mcap.zstd")));
    let single = dir.join("single.db3");
    db3(&single, messages, Wire::Big, false);
    bags.push(("SQLite".into(), single));
    for (name, per_part, packing) in [
        ("one", 1000, ""),
        ("split", 20, ""),
        ("files", 30, "FILE"),
        ("messages", 1000, "MESSAGE"),
    ] {
        bags.push((
            format!("folder, {name}"),
            folder(&dir.join(name), messages, per_part, packing),
        ));
    }
    bags
}

#[test]
fn every_container_gives_the_same_log() {
    let dir = tempfile::tempdir().unwrap();
    let messages = recording(PLAIN, 0.0, 0);
    let mut first: Option<Played> = None;
    for (name, bag) in all(dir.path(), &messages) {
        let log = dir.path().join("log.mcap");
        let summary = import(&[bag], None, &log).unwrap_or_else(|error| panic!("{name}: {error}"));
        assert!(
            summary.notes.is_empty() && summary.left_out.is_empty(),
            "{name}: {summary}"
        );
        assert_eq!(summary.agents[0].sweeps as i64, SWEEPS, "{name}");
        let found = played(&log, "ego");
        match &first {
            None => first = Some(found),
            Some(first) => assert!(*first == found, "{name} gives another log"),
        }
    }
    check(&first.unwrap());
}

fn check(log: &Played) {
    assert_eq!((log.clouds.len() as i64, log.poses.len() as i64), (SWEEPS, 5 * SWEEPS));
    for (k, (stamp, ready, cloud)) in log.clouds.iter().enumerate() {
        let at = T0 + k as i64 * 100 * MS;
        assert_eq!((*stamp, *ready), (at, at + 95 * MS));
        assert_eq!(cloud.len(), points().len());
        for (i, point) in points().iter().enumerate() {
            let expected = [
                f64::from(point[0]) + 1.0,
                f64::from(point[1]),
                f64::from(point[2]) + MOUNTED + BASE,
            ];
            let found = [cloud.x[i], cloud.y[i], cloud.z[i]];
            let off = (0..3)
                .map(|axis| (f64::from(found[axis]) - expected[axis]).abs())
                .fold(0.0, f64::max);
            assert!(
                off < 0.02,
                "the height is found to a centimetre or two: {found:?} for {expected:?}"
            );
            let time = (90e6 * i as f64 / points().len() as f64) as i32;
            assert!((cloud.time[i] - time).abs() < 1000, "{} for {time}", cloud.time[i]);
            assert_eq!((cloud.intensity[i], cloud.ring[i]), ((i % 100) as u8, (i % 32) as u16));
        }
    }
    for (stamp, pose) in &log.poses {
        let [x, y, ..] = place(0.0, *stamp);
        let found = pose.translation.vector;
        assert!(
            (found.x - x).abs() < 1e-9 && (found.y - y).abs() < 1e-9 && found.z.abs() < 0.02,
            "{found}"
        );
    }
    assert_eq!(log.truth.len() as i64, SWEEPS);
    for (k, (stamp, boxes)) in log.truth.iter().enumerate() {
        let [x, y, ..] = place(0.0, *stamp);
        assert_eq!(boxes.len(), 2);
        for (found, (class, track, at, size)) in boxes.iter().zip(objects(*stamp)) {
            assert_eq!(
                (found.class.to_string().as_str(), found.track),
                (class, track.parse().ok())
            );
            assert_eq!([found.length, found.width, found.height], size);
            // No truth is before the first sweep, so that has the truth of 40 ms later.
            let tolerance = if k == 0 { 8.0 * 0.041 } else { 1e-6 };
            assert!((found.center[0] - (at[0] - x)).abs() < tolerance, "{k}: {found:?}");
            assert!((found.center[1] - (at[1] - y)).abs() < 1e-9 && (found.yaw - at[3]).abs() < 1e-9);
        }
    }
}

#[test]
fn messages_out_of_order_are_sorted() {
    let dir = tempfile::tempdir().unwrap();
    let mut messages = recording(PLAIN, 0.0, 0);
    let sorted = dir.path().join("sorted.bag");
    ros1(&sorted, &messages, "none");
    messages.reverse();
    let turned = dir.path().join("turned.bag");
    ros1(&turned, &messages, "bz2");
    let logs = [sorted, turned].map(|bag| {
        let log = bag.with_extension("mcap");
        import(&[bag], None, &log).unwrap();
        played(&log, "ego")
    });
    assert!(logs[0] == logs[1]);
}
