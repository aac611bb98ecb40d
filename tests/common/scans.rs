//! Two sweeps of a moving LiDAR with the transform between them, as small_gicp's repository has them (`data/`, MIT).

use std::path::Path;

use nalgebra::{Isometry3, Matrix3, Rotation3, UnitQuaternion, Vector3};
use realo_schemas::PointCloud;

/// The two sweeps, each in the frame of its sensor.
pub struct Pair {
    pub source: PointCloud,
    pub target: PointCloud,
    /// As small_gicp aligns them.
    pub target_from_source: Isometry3<f64>,
}

/// Those of `$REALO_SHARED/data/registration`, where it is.
pub fn pair() -> Option<Pair> {
    let folder = skipped::shared("data/registration")?;
    Some(Pair {
        source: ply(&folder.join("source.ply")),
        target: ply(&folder.join("target.ply")),
        target_from_source: transform(&folder.join("T_target_source.txt")),
    })
}

/// A PLY file of x, y, z and intensity, each an f32.
fn ply(path: &Path) -> PointCloud {
    let bytes = std::fs::read(path).unwrap();
    let end = b"end_header\n";
    let body = bytes.windows(end.len()).position(|window| window == end).unwrap() + end.len();
    let head = str::from_utf8(&bytes[..body]).unwrap();
    let count = head
        .lines()
        .find_map(|line| line.strip_prefix("element vertex "))
        .unwrap();
    let n: usize = count.parse().unwrap();
    assert_eq!(bytes.len() - body, 16 * n, "{}", path.display());
    let points = bytes[body..].as_chunks::<16>().0;
    let column = |axis: usize| -> Vec<f32> {
        let at = |point: &[u8; 16]| f32::from_le_bytes(std::array::from_fn(|i| point[4 * axis + i]));
        points.iter().map(at).collect()
    };
    PointCloud::new(column(0), column(1), column(2), vec![0; n], vec![0; n], vec![0; n]).unwrap()
}

/// A 4×4 matrix, row-major.
fn transform(path: &Path) -> Isometry3<f64> {
    let text = std::fs::read_to_string(path).unwrap();
    let numbers: Vec<f64> = text.split_whitespace().map(|word| word.parse().unwrap()).collect();
    let rotation = Matrix3::from_fn(|i, j| numbers[4 * i + j]);
    let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix(&rotation));
    Isometry3::from_parts(Vector3::new(numbers[3], numbers[7], numbers[11]).into(), rotation)
}
