//! Folders of numpy's arrays.

use std::io::{Cursor, Write as _};
use std::path::Path;

use nalgebra::Isometry3;
use zip::ZipWriter;
use zip::write::SimpleFileOptions;

use crate::files::{rows, write};
use crate::scene::{HEIGHT, Scene, Sweep};

/// An array as numpy's files have it.
pub fn npy(descr: &str, shape: &str, bytes: impl IntoIterator<Item = u8>) -> Vec<u8> {
    let head = format!("{{'descr': '{descr}', 'fortran_order': False, 'shape': ({shape}), }}\n");
    let length = (head.len() as u16).to_le_bytes();
    let mut file = [b"\x93NUMPY\x01\x00", &length[..], head.as_bytes()].concat();
    file.extend(bytes);
    file
}

fn doubles(numbers: impl IntoIterator<Item = f64>) -> impl Iterator<Item = u8> {
    numbers.into_iter().flat_map(f64::to_le_bytes)
}

fn row_by_row(pose: &Isometry3<f64>) -> Vec<f64> {
    pose.to_homogeneous().transpose().as_slice().to_vec()
}

/// An archive of arrays.
pub fn npz<'a>(arrays: impl IntoIterator<Item = (&'a str, Vec<u8>)>) -> Vec<u8> {
    let mut archive = ZipWriter::new(Cursor::new(Vec::new()));
    for (name, bytes) in arrays {
        archive
            .start_file(format!("{name}.npy"), SimpleFileOptions::default())
            .expect("a file");
        archive.write_all(&bytes).expect("it can be written");
    }
    archive.finish().expect("an archive").into_inner()
}

/// Writes an archive for each sweep.
pub fn write_scene(scene: &Scene, data: &Path) {
    for agent in &scene.agents {
        for (frame, sweep) in agent.sweeps.iter().enumerate() {
            write(
                &data.join(format!("scene/{}/{frame:06}.npz", agent.name)),
                &archive(sweep),
            );
        }
    }
}

fn archive(sweep: &Sweep) -> Vec<u8> {
    let count = sweep.own.len();
    let boxes = sweep.own.iter().flat_map(|object| {
        let [x, y, z] = object.center;
        [x, y, z - HEIGHT, object.length, object.width, object.height, object.yaw]
    });
    let tracks = sweep
        .own
        .iter()
        .flat_map(|object| object.track.expect("a track").to_le_bytes());
    // Texts of one width, filled up with zeros.
    let widest = sweep.own.iter().map(|object| object.class.len()).max().unwrap_or(1);
    let classes = sweep.own.iter().flat_map(|object| {
        let letters = object.class.chars().map(|letter| letter as u32);
        letters
            .chain(std::iter::repeat(0))
            .take(widest)
            .flat_map(u32::to_le_bytes)
    });
    let points = rows(&sweep.in_lidar(HEIGHT), &sweep.intensities());
    let pose = row_by_row(&sweep.map_from_lidar(HEIGHT));
    npz([
        ("points", npy("<f4", &format!("{}, 4", sweep.cloud().len()), points)),
        ("pose", npy("<f8", "4, 4", doubles(pose))),
        ("boxes", npy("<f8", &format!("{count}, 7"), doubles(boxes))),
        ("tracks", npy("<u8", &format!("{count},"), tracks)),
        ("classes", npy(&format!("<U{widest}"), &format!("{count},"), classes)),
    ])
}
