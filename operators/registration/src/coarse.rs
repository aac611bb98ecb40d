//! The same map with voxels twice as wide, for guesses that are voxels off.

use crate::cell::{cell_of, key_of};
use crate::file::made;
use crate::map::{MapInfo, VoxelMap};
use crate::table::CellTable;
use crate::voxel::{BYTES, Moments, Record};

/// Joins eight voxels each; every one of them counts the same, however many points it has, for near ones have most.
pub(crate) fn coarsened(map: &VoxelMap) -> VoxelMap {
    let MapInfo {
        voxel_m, thickness_m, ..
    } = *map.info();
    let mut table = CellTable::with_capacity(map.len() / 4);
    let mut cells: Vec<(u64, Moments)> = Vec::new();
    for record in map.records().iter().map(Record) {
        let cell = cell_of(record.key());
        let parent = cell.map(|number| number.div_euclid(2));
        let key = key_of(parent);
        let place = table.get_or_insert(key) as usize;
        if place == cells.len() {
            cells.push((key, Moments::default()));
        }
        let mean = record.mean();
        let in_parent = |axis: usize| f64::from(cell[axis] - 2 * parent[axis]) + f64::from(mean[axis]);
        let from_centre = std::array::from_fn(|axis| (in_parent(axis) - 1.0) * voxel_m);
        cells[place].1.add_spread(from_centre, record.covariance(thickness_m));
    }
    cells.sort_unstable_by_key(|(key, _)| *key);
    let encode = |(key, moments): &(u64, Moments)| moments.encode(*key, 2.0 * voxel_m, 2.0 * thickness_m);
    let records: Vec<[u8; BYTES]> = cells.iter().map(encode).collect();
    let info = MapInfo {
        voxel_m: 2.0 * voxel_m,
        thickness_m: 2.0 * thickness_m,
        ..map.info().clone()
    };
    made(info, &records)
}

#[cfg(test)]
mod tests {
    use nalgebra::Point3;

    use super::*;

    /// A wall across x in cells of 1 m, at x = -2.75, of 4 m by 4 m.
    fn wall() -> VoxelMap {
        let mut records = Vec::new();
        for y in -2..2 {
            for z in -2..2 {
                let mut moments = Moments::default();
                for i in 0..400 {
                    let [y, z] = [i % 20, i / 20].map(|step| f64::from(step) * 0.05 - 0.475);
                    moments.add([-0.25 + 0.02 * f64::from(i % 3 - 1), y, z]);
                }
                records.push(moments.encode(key_of([-3, y, z]), 1.0, 0.05));
            }
        }
        let info = MapInfo {
            frame: "map".into(),
            voxel_m: 1.0,
            thickness_m: 0.05,
            origin: Point3::new(100.0, 200.0, 300.0),
            pose_sigmas: [0.0; 3],
            sweeps: 1,
            span: [0; 2],
            left_out: 0,
            closure: None,
        };
        made(info, &records)
    }

    #[test]
    fn a_wall_is_the_same_wall_in_wider_voxels() {
        let (fine, coarse) = (wall(), coarsened(&wall()));
        assert_eq!((fine.len(), coarse.len(), coarse.info().voxel_m), (16, 4, 2.0));
        for voxel in coarse.voxels() {
            assert_eq!((voxel.cell[0], voxel.points), (-2, 4));
            assert!(voxel.is_planar && voxel.normal.x > 0.9999, "{voxel:?}");
            assert!((voxel.mean.x - 97.25).abs() < 1e-3, "{voxel:?}");
            // A wall of 2 m has a variance of 1/3 m² along it.
            let information = voxel.information.diagonal();
            assert!(
                (information.y - 3.0).abs() < 0.1 && (information.z - 3.0).abs() < 0.1,
                "{information}"
            );
            assert!((information.x - 100.0).abs() < 1.0, "{information}");
        }
    }
}
