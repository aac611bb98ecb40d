//! Files that several layouts have.

use std::fs;
use std::path::Path;

use nalgebra::Isometry3;
use serde_json::{Value, json};

/// Writes a file and the folders above it.
pub fn write(path: &Path, bytes: &[u8]) {
    fs::create_dir_all(path.parent().expect("a folder")).expect("folders can be made");
    fs::write(path, bytes).expect("it can be written");
}

/// Writes a file of JSON.
pub fn write_json(path: &Path, value: &Value) {
    write(path, value.to_string().as_bytes());
}

/// Rows of x, y, z and intensity.
pub fn rows(points: &[[f32; 3]], intensities: &[f32]) -> Vec<u8> {
    let rows = points.iter().zip(intensities);
    rows.flat_map(|([x, y, z], intensity)| [*x, *y, *z, *intensity])
        .flat_map(f32::to_le_bytes)
        .collect()
}

/// A binary PCD file.
pub fn pcd(points: &[[f32; 3]], intensities: &[f32]) -> Vec<u8> {
    let n = points.len();
    let head = format!(
        "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\nWIDTH {n}\nHEIGHT 1\n\
         VIEWPOINT 0 0 0 1 0 0 0\nPOINTS {n}\nDATA binary\n"
    );
    [head.into_bytes(), rows(points, intensities)].concat()
}

/// The four rows of a pose.
pub fn matrix(pose: &Isometry3<f64>) -> Value {
    let matrix = pose.to_homogeneous();
    json!([0, 1, 2, 3].map(|row| [0, 1, 2, 3].map(|column| matrix[(row, column)])))
}
