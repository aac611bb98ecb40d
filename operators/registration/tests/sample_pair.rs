//! Two sweeps of a moving LiDAR with the transform between them, as small_gicp's repository has them (`data/`, MIT).
//!
//! Reads `$REALO_SHARED/data/registration`.

use std::path::Path;

use nalgebra::{Isometry3, Matrix3, Rotation3, UnitQuaternion, Vector3};
use realo_registration::{MapBuilder, MapSettings, PosedSweep, Registrar, RegistrarSettings, Search, VoxelMap};
use realo_schemas::PointCloud;

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

fn transform(path: &Path) -> Isometry3<f64> {
    let text = std::fs::read_to_string(path).unwrap();
    let numbers: Vec<f64> = text.split_whitespace().map(|word| word.parse().unwrap()).collect();
    let rotation = Matrix3::from_fn(|i, j| numbers[4 * i + j]);
    let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix(&rotation));
    Isometry3::from_parts(Vector3::new(numbers[3], numbers[7], numbers[11]).into(), rotation)
}

/// The map of one sweep alone.
fn map_of(cloud: &PointCloud) -> VoxelMap {
    let settings = MapSettings {
        range_m: [0.0, 100.0],
        min_points: 6,
        min_sweeps: 1,
        apart_s: 0.0,
        empty_share: 1.0,
        ..MapSettings::default()
    };
    let mut builder = MapBuilder::new(settings, "target").unwrap();
    let sweep = PosedSweep {
        agent: "car",
        stamp: 0,
        cloud,
        map_from_body: &Isometry3::identity(),
        sensor: [0.0; 3],
        sigmas: [0.0; 3],
    };
    builder.add(&sweep).unwrap();
    builder.finish(|_, _| ()).unwrap()
}

struct Pair {
    source: PointCloud,
    map: VoxelMap,
    expected: Isometry3<f64>,
    registrar: Registrar,
}

fn pair() -> Option<Pair> {
    let folder = skipped::shared("data/registration")?;
    let [source, target] = ["source.ply", "target.ply"].map(|name| ply(&folder.join(name)));
    let settings = RegistrarSettings {
        sample_m: 0.25,
        range_m: [0.0, 100.0],
        ..RegistrarSettings::default()
    };
    Some(Pair {
        source,
        map: map_of(&target),
        expected: transform(&folder.join("T_target_source.txt")),
        registrar: Registrar::new(settings).unwrap(),
    })
}

impl Pair {
    /// Aligns from a guess; whether it ends at small_gicp's transform.
    fn is_found(&mut self, guess: &Isometry3<f64>, search: Search) -> bool {
        let alignment = self.registrar.align(&self.map, &self.source, guess, search).unwrap();
        let found = alignment.map_from_body;
        let shift = (found.translation.vector - self.expected.translation.vector).norm();
        let turn = found.rotation.angle_to(&self.expected.rotation).to_degrees();
        println!("{search:?}: {shift:.3} m, {turn:.3}°, {:.3}", alignment.structure_share);
        alignment.converged && shift < 0.05 && turn < 0.5
    }
}

#[test]
fn the_pair_is_aligned_as_small_gicp_aligns_it() {
    let Some(mut pair) = pair() else { return };
    for search in [Search::Track, Search::Wide] {
        assert!(pair.is_found(&Isometry3::identity(), search), "{search:?}");
    }
}

#[test]
fn a_wide_search_finds_it_from_five_metres_and_nine_degrees() {
    let Some(mut pair) = pair() else { return };
    let expected = pair.expected;
    for k in 0..8 {
        let angle = std::f64::consts::TAU * f64::from(k) / 8.0;
        let yaw = if k % 2 == 0 { 9f64 } else { -9.0 }.to_radians();
        let guess = Isometry3::from_parts(
            (expected.translation.vector + 5.1 * Vector3::new(libm::cos(angle), libm::sin(angle), 0.0)).into(),
            UnitQuaternion::from_scaled_axis(Vector3::z() * yaw) * expected.rotation,
        );
        assert!(pair.is_found(&guess, Search::Wide), "start {k}");
    }
}
