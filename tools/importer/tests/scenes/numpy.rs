//! Folders of numpy's arrays, as archives and as files.

use std::fs;
use std::io::{Cursor, Write as _};
use std::path::Path;

use nalgebra::{Matrix4, Point3};
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipWriter};

use crate::AGENTS;
use crate::layouts::write;
use crate::reading::{import, read};
use crate::round_trip::compare;
use crate::world::{Agent, CARS, matrix};

const START: i64 = 1_577_836_800_000_000_000;
const PERIOD: i64 = 100_000_000;
const FRAMES: u64 = 3;

pub fn npy(descr: &str, shape: &str, bytes: &[u8]) -> Vec<u8> {
    let head = format!("{{'descr': '{descr}', 'fortran_order': False, 'shape': ({shape}), }}\n");
    let length = (head.len() as u16).to_le_bytes();
    [b"\x93NUMPY\x01\x00", &length[..], head.as_bytes(), bytes].concat()
}

pub fn doubles(numbers: &[f64]) -> Vec<u8> {
    numbers.iter().flat_map(|number| number.to_le_bytes()).collect()
}

/// Agents that are level, so that boxes in the frames of their LiDARs turn about z alone.
fn agents() -> [Agent; 3] {
    let named = |agent: Agent, folder| {
        let [x, y, z, _, yaw, _] = agent.six;
        Agent {
            folder,
            six: [x, y, z, 0.0, yaw, 0.0],
            ..agent
        }
    };
    [
        named(AGENTS[0], "cav1"),
        named(AGENTS[1], "2"),
        named(AGENTS[2], "rsu1"),
    ]
}

struct Sweep {
    points: Vec<u8>,
    pose: Matrix4<f64>,
    boxes: Vec<u8>,
    classes: Vec<u8>,
    tracks: Vec<u8>,
}

fn sweep(agent: &Agent, number: usize, frame: u64) -> Sweep {
    let pose = matrix(agent.at(frame));
    let lidar_from_world = pose.try_inverse().unwrap();
    let seen = agent.sees(frame, number);
    let row = |point: &Point3<f64>| {
        let at = lidar_from_world.transform_point(point);
        [at.x as f32, at.y as f32, at.z as f32, 0.5]
    };
    let points: Vec<u8> = seen.iter().flat_map(row).flat_map(f32::to_le_bytes).collect();
    let cars = agent
        .labels
        .iter()
        .map(|id| CARS.iter().find(|car| car.id == *id).unwrap());
    let (mut boxes, mut tracks, mut classes) = (Vec::new(), Vec::new(), Vec::new());
    for car in cars {
        let at = lidar_from_world.transform_point(&Point3::from(car.center));
        boxes.extend([at.x, at.y, at.z]);
        boxes.extend(car.size);
        boxes.push((car.yaw - agent.six[4]).to_radians());
        tracks.extend((car.id as i64).to_le_bytes());
        classes.extend("Van".chars().flat_map(|c| (c as u32).to_le_bytes()));
    }
    let count = agent.labels.len();
    Sweep {
        points: npy("<f4", &format!("{}, 4", seen.len()), &points),
        pose,
        boxes: npy("<f8", &format!("{count}, 7"), &doubles(&boxes)),
        tracks: npy("<i8", &format!("{count},"), &tracks),
        classes: npy("<U3", &format!("{count},"), &classes),
    }
}

fn row_by_row(pose: &Matrix4<f64>) -> Vec<u8> {
    doubles(pose.transpose().as_slice())
}

pub fn npz(arrays: &[(&str, Vec<u8>)], method: CompressionMethod) -> Vec<u8> {
    let mut archive = ZipWriter::new(Cursor::new(Vec::new()));
    for (name, bytes) in arrays {
        let options = SimpleFileOptions::default().compression_method(method);
        archive.start_file(format!("{name}.npy"), options).unwrap();
        archive.write_all(bytes).unwrap();
    }
    archive.finish().unwrap().into_inner()
}

fn archives(dir: &Path, method: CompressionMethod) {
    for (number, agent) in agents().iter().enumerate() {
        for frame in 0..FRAMES {
            let Sweep {
                points,
                pose,
                boxes,
                classes,
                tracks,
            } = sweep(agent, number, frame);
            let arrays = [
                ("points", points),
                ("pose", npy("<f8", "4, 4", &row_by_row(&pose))),
                ("boxes", boxes),
                ("classes", classes),
                ("tracks", tracks),
            ];
            write(
                &dir.join(agent.folder).join(format!("{frame:06}.npz")),
                &npz(&arrays, method),
            );
        }
    }
}

fn compare_all(out: &Path, class: &str) {
    let (_, found) = read(out);
    assert_eq!(found.len(), 3 * FRAMES as usize);
    for (number, (agent, name)) in agents().iter().zip(["cav1", "cav_2", "rsu1"]).enumerate() {
        for frame in 0..FRAMES {
            let read = &found[&(name.to_string(), START + frame as i64 * PERIOD)];
            compare(read, agent, number, frame);
            assert!(read.own.iter().all(|object| &*object.class == class));
            assert_eq!(read.own.len(), agent.labels.len());
        }
    }
}

#[test]
fn archives_of_arrays_come_back_with_points_poses_boxes_classes_and_tracks() {
    for method in [CompressionMethod::Stored, CompressionMethod::Deflated] {
        let dir = tempfile::tempdir().unwrap();
        archives(&dir.path().join("data/scene"), method);
        let out = dir.path().join("out.mcap");
        let summary = &import("numpy", &dir.path().join("data"), &out, &[]).unwrap()[0];
        assert_eq!(
            (summary.scene.as_str(), summary.frames, summary.truth_boxes),
            ("scene", 3, 36)
        );
        assert!(
            summary.residuals.iter().all(|residual| residual.metres.unwrap() < 0.1),
            "{summary}"
        );
        compare_all(&out, "Van");
    }
}

#[test]
fn files_of_arrays_have_their_boxes_and_poses_beside_them() {
    let dir = tempfile::tempdir().unwrap();
    let scene = dir.path().join("scene");
    for (number, agent) in agents().iter().enumerate() {
        let folder = scene.join(agent.folder);
        let mut poses = Vec::new();
        for frame in 0..FRAMES {
            let sweep = sweep(agent, number, frame);
            write(&folder.join(format!("{frame:06}.npy")), &sweep.points);
            write(&folder.join(format!("{frame:06}_boxes.npy")), &sweep.boxes);
            poses.extend(row_by_row(&sweep.pose));
        }
        write(&folder.join("poses.npy"), &npy("<f8", "3, 4, 4", &poses));
    }
    let out = dir.path().join("out.mcap");
    import("numpy", &scene, &out, &[]).unwrap();
    compare_all(&out, "Car");
    let boxes = scene.join(agents()[0].folder).join("000001_boxes.npy");
    let whole = fs::read(&boxes).unwrap();
    fs::remove_file(&boxes).unwrap();
    assert!(
        std::process::Command::new("mkfifo")
            .arg(&boxes)
            .status()
            .unwrap()
            .success()
    );
    let error = import("numpy", &scene, &out, &[]).unwrap_err();
    assert!(
        error.contains("a named pipe, expected a file") && error.contains("000001_boxes.npy"),
        "labels are not left out: {error}"
    );
    fs::remove_file(&boxes).unwrap();
    write(&boxes, &whole);
    let error = {
        write(&scene.join("2/poses.npy"), &npy("<f8", "2, 7", &[0; 112]));
        import("numpy", &scene, &out, &[]).unwrap_err()
    };
    assert!(
        error.contains("poses.npy") && error.contains("each of the 3 sweeps") && error.contains("[2, 7]"),
        "{error}"
    );
}

#[test]
fn poses_are_matrices_of_three_or_four_rows_or_quaternions_with_the_real_part_last() {
    let dir = tempfile::tempdir().unwrap();
    let agent = agents()[0];
    let Sweep { points, pose, .. } = sweep(&agent, 0, 0);
    let half = agent.six[4].to_radians() / 2.0;
    let [x, y, z, ..] = agent.at(0);
    let rows = doubles(&pose.transpose().as_slice()[..12]);
    let forms = [
        npy("<f8", "3, 4", &rows),
        npy("<f8", "7,", &doubles(&[x, y, z, 0.0, 0.0, half.sin(), half.cos()])),
    ];
    for (frame, form) in forms.into_iter().enumerate() {
        let arrays = [("points", points.clone()), ("pose", form)];
        write(
            &dir.path().join(format!("scene/cav1/{frame}.npz")),
            &npz(&arrays, CompressionMethod::Stored),
        );
    }
    let out = dir.path().join("out.mcap");
    import("numpy", dir.path(), &out, &[]).unwrap();
    let (_, found) = read(&out);
    for frame in 0..2 {
        compare(&found[&("cav1".to_string(), START + frame * PERIOD)], &agent, 0, 0);
    }
}

#[test]
fn what_an_archive_lacks_or_has_wrong_is_named() {
    let sound = || {
        let Sweep {
            points, pose, boxes, ..
        } = sweep(&agents()[0], 0, 0);
        vec![
            ("points", points),
            ("pose", npy("<f8", "4, 4", &row_by_row(&pose))),
            ("boxes", boxes),
        ]
    };
    let lefthanded = Matrix4::from_diagonal(&nalgebra::Vector4::new(1.0, -1.0, 1.0, 1.0));
    let cases: [(&str, Option<Vec<u8>>, &str); 9] = [
        ("pose", None, "expected an array `pose`, found `points`, `boxes`"),
        ("points", None, "expected an array `points`"),
        ("pose", Some(npy("<f8", "6,", &doubles(&[0.0; 6]))), "a pose of 4×4"),
        (
            "pose",
            Some(npy("<f8", "4, 4", &row_by_row(&lefthanded))),
            "a right-handed rotation",
        ),
        (
            "points",
            Some(npy("<f4", "2, 2", &[0; 16])),
            "1 × damaged cloud\n    scene/1/000007.npz: array `points`: expected a matrix of 3 to 16 columns, found the shape [2, 2]",
        ),
        (
            "boxes",
            Some(npy("<f8", "1, 6", &[0; 48])),
            "1 × damaged labels\n    scene/1/000007.npz: boxes: expected a matrix of 7 columns, found the shape [",
        ),
        (
            "boxes",
            Some(npy("<f8", "1, 7", &doubles(&[f64::NAN; 7]))),
            "expected 7 finite numbers in row 0",
        ),
        (
            "boxes",
            Some(npy("<f8", "1, 7", &doubles(&[9.0, 0.0, 0.0, 4.0, 2.0, 1.5, 90.0]))),
            "boxes: yaw in row 0: expected radians within ±4π, found 90, which looks like degrees: 90° are 1.5708 rad; if it is in degrees, \
             save numpy.deg2rad of that column",
        ),
        (
            "pose",
            Some(npy("<f4", "2, 8", &[0; 64])),
            "1 × damaged pose\n    scene/1/000007.npz: array `pose`: expected a pose of 4×4, 3×4 or 7 numbers (x, y, z, qx, qy, qz, qw), found \
             the shape [2, 8] of float32",
        ),
    ];
    for (name, other, expected) in cases {
        let dir = tempfile::tempdir().unwrap();
        let mut arrays = sound();
        let place = arrays.iter().position(|(known, _)| *known == name).unwrap();
        match other {
            Some(bytes) => arrays[place].1 = bytes,
            None => drop(arrays.remove(place)),
        }
        let path = dir.path().join("scene/1/000007.npz");
        write(&path, &npz(&arrays, CompressionMethod::Stored));
        let error = import("numpy", dir.path(), &dir.path().join("out.mcap"), &[]).unwrap_err();
        assert!(
            error.contains(expected) && error.contains("000007.npz"),
            "{name}: {error}"
        );
    }
    let more: [(&str, Vec<u8>, &str); 5] = [
        (
            "labels",
            npy("<f8", "0,", &[]),
            "expected no arrays but `points`, `pose`, `boxes`, `classes`, `tracks`, found `labels`",
        ),
        (
            "tracks",
            npy("<f8", "3,", &doubles(&[1.0, f64::NAN, 2.0])),
            "tracks: expected whole numbers from 0 to 2^53",
        ),
        (
            "tracks",
            npy("<i8", "3,", &[1i64 << 60, 5, 6].map(i64::to_le_bytes).concat()),
            "from 0 to 2^53",
        ),
        (
            "tracks",
            npy("<i8", "3,", &[5i64, 6, 5].map(i64::to_le_bytes).concat()),
            "found 5 again in row 2",
        ),
        (
            "tracks",
            npy("<i8", "2,", &[5i64, 6].map(i64::to_le_bytes).concat()),
            "one for each of the 3 boxes, found the shape [2]",
        ),
    ];
    for (name, bytes, expected) in more {
        let dir = tempfile::tempdir().unwrap();
        let arrays = [sound(), vec![(name, bytes)]].concat();
        write(
            &dir.path().join("scene/1/7.npz"),
            &npz(&arrays, CompressionMethod::Stored),
        );
        let error = import("numpy", dir.path(), &dir.path().join("out.mcap"), &[]).unwrap_err();
        assert!(error.contains(expected), "{name}: {error}");
    }
    let dir = tempfile::tempdir().unwrap();
    let none = [
        sound(),
        vec![("tracks", npy("<i8", "3,", &[-1i64; 3].map(i64::to_le_bytes).concat()))],
    ]
    .concat();
    write(
        &dir.path().join("scene/1/7.npz"),
        &npz(&none, CompressionMethod::Stored),
    );
    let summary = &import("numpy", dir.path(), &dir.path().join("out.mcap"), &[]).unwrap()[0];
    assert_eq!(summary.truth_boxes, 3, "each is an object of its own");
    write(
        &dir.path().join("scene/1/0007.npz"),
        &npz(&none, CompressionMethod::Stored),
    );
    let error = import("numpy", dir.path(), &dir.path().join("out.mcap"), &[]).unwrap_err();
    assert!(error.contains("one file for number 7, found `0007.npz` too"), "{error}");
    let dir = tempfile::tempdir().unwrap();
    write(&dir.path().join("scene/1/000000.npy"), &sound()[0].1);
    let error = import("numpy", dir.path(), &dir.path().join("out.mcap"), &[]).unwrap_err();
    assert!(
        error.contains("poses.npy") && error.contains("a pose for each of the 1"),
        "{error}"
    );
    let dir = tempfile::tempdir().unwrap();
    fs::create_dir_all(dir.path().join("scene/1")).unwrap();
    let error = import("numpy", dir.path(), &dir.path().join("out.mcap"), &[]).unwrap_err();
    assert!(error.contains("000000.npz") && error.contains("found none"), "{error}");
    for (name, call) in [("000000.npz", "numpy.savez(FILE"), ("000000.npy", "numpy.save(FILE")] {
        let dir = tempfile::tempdir().unwrap();
        write(
            &dir.path().join("scene/1").join(name),
            b"\x80\x04\x95\x0b\x00\x00\x00\x00\x00\x00\x00}\x94\x8c\x01a\x94K\x01s.",
        );
        write(
            &dir.path().join("scene/1/poses.npy"),
            &npy("<f8", "1, 7", &doubles(&[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])),
        );
        let error = import("numpy", dir.path(), &dir.path().join("out.mcap"), &[]).unwrap_err();
        for part in [name, "found a pickle of Python, which is never loaded", call] {
            assert!(error.contains(part), "no `{part}` in {error}");
        }
    }
    write(&dir.path().join("scene/1/000000.npz"), b"PK\x03\x04 half");
    let error = import("numpy", dir.path(), &dir.path().join("out.mcap"), &[]).unwrap_err();
    assert!(
        error.contains("no such archive") && error.contains("1 × damaged arrays"),
        "{error}"
    );
}

#[test]
fn boxes_of_size_0_are_named_by_the_file_and_array_they_are_in() {
    let flat = npy("<f8", "1, 7", &doubles(&[9.0, 0.0, 0.0, 4.0, 0.0, 1.5, 0.0]));
    let Sweep { points, pose, .. } = sweep(&agents()[0], 0, 0);
    let dir = tempfile::tempdir().unwrap();
    let arrays = [
        ("points", points.clone()),
        ("pose", npy("<f8", "4, 4", &row_by_row(&pose))),
        ("boxes", flat.clone()),
    ];
    write(
        &dir.path().join("scene/1/000007.npz"),
        &npz(&arrays, CompressionMethod::Stored),
    );
    let error = import("numpy", dir.path(), &dir.path().join("out.mcap"), &[]).unwrap_err();
    let line = "scene/1/000007.npz: array `boxes`: object `1:0` (`Car`): expected a box of more than 0, at most 100 m, within 1000 m of \
                its agent, found one of [4.00, 0.00, 1.50] m";
    assert!(error.contains(line) && !error.contains("_boxes.npy"), "{error}");
    let dir = tempfile::tempdir().unwrap();
    write(&dir.path().join("scene/1/000007.npy"), &points);
    write(&dir.path().join("scene/1/000007_boxes.npy"), &flat);
    write(
        &dir.path().join("scene/1/poses.npy"),
        &npy("<f8", "1, 4, 4", &row_by_row(&pose)),
    );
    let error = import("numpy", dir.path(), &dir.path().join("out.mcap"), &[]).unwrap_err();
    assert!(error.contains("scene/1/000007_boxes.npy: object `1:0`"), "{error}");
}
