//! Two sweeps of a moving LiDAR with the transform between them, as small_gicp's repository has them (`data/`, MIT).
//!
//! Reads `$REALO_SHARED/data/registration`.

#[path = "../../../tests/common/scans.rs"]
mod scans;

use nalgebra::{Isometry3, UnitQuaternion, Vector3};
use realo_registration::{MapBuilder, MapSettings, PosedSweep, Registrar, RegistrarSettings, Search, VoxelMap};
use realo_schemas::PointCloud;

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
    let scans::Pair {
        source,
        target,
        target_from_source,
    } = scans::pair()?;
    let settings = RegistrarSettings {
        sample_m: 0.25,
        range_m: [0.0, 100.0],
        ..RegistrarSettings::default()
    };
    Some(Pair {
        source,
        map: map_of(&target),
        expected: target_from_source,
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
