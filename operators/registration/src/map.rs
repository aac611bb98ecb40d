//! A voxel map, for looking up.

use std::sync::OnceLock;

use nalgebra::Point3;
use realo_schemas::Nanos;

use crate::cell::key_of;
use crate::coarse::coarsened;
use crate::file::Bytes;
use crate::table::CellTable;
use crate::voxel::{BYTES, Record, Voxel};

/// What a map says of itself.
#[derive(Clone, Debug, PartialEq)]
pub struct MapInfo {
    /// Name of the frame that its poses were given in.
    pub frame: String,
    /// Side of a voxel, m.
    pub voxel_m: f64,
    /// Surfaces are taken to be at least this thick (standard deviation), m.
    pub thickness_m: f64,
    /// Lower corner of cell (0, 0, 0) in that frame, m.
    pub origin: Point3<f64>,
    /// Standard deviations of the poses that placed its sweeps, in the mean: on the ground along each axis, up, m, and of the heading, rad.
    pub pose_sigmas: [f64; 3],
    /// Sweeps that it was built from.
    pub sweeps: u64,
    /// Stamps of the first and the last of them, ns.
    pub span: [Nanos; 2],
    /// Cells that were left out: seen too seldom, or seen empty too often.
    pub left_out: u64,
    /// How a pose graph found the poses; `None` where they were given.
    pub closure: Option<Closure>,
}

/// How a pose graph found the poses of a map's sweeps.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Closure {
    /// Keyframes in the graph, 1 or more.
    pub keyframes: u64,
    /// Loops that were closed.
    pub loops: u64,
    /// What loops were off before and after, root mean square, m.
    pub residuals_m: [f64; 2],
    /// The same of turns, rad.
    pub residuals_rad: [f64; 2],
}

/// Surfaces of what stands still, one per voxel. Immutable: it is made by [`MapBuilder`](crate::MapBuilder), or read from a file.
#[derive(Debug)]
pub struct VoxelMap {
    info: MapInfo,
    bytes: Bytes,
    /// Where the records are in `bytes`.
    records: std::ops::Range<usize>,
    table: CellTable,
    /// The same with voxels twice as wide, once somebody asks.
    coarser: OnceLock<Box<VoxelMap>>,
}

impl VoxelMap {
    /// A map of records whose keys rise, which the caller has checked.
    pub(crate) fn of(info: MapInfo, bytes: Bytes, records: std::ops::Range<usize>) -> Self {
        let mut table = CellTable::with_capacity(records.len() / BYTES);
        let all = bytes.as_slice()[records.clone()].as_chunks::<BYTES>().0;
        for record in all {
            table.get_or_insert(Record(record).key());
        }
        VoxelMap {
            info,
            bytes,
            records,
            table,
            coarser: OnceLock::new(),
        }
    }

    /// What it says of itself.
    pub fn info(&self) -> &MapInfo {
        &self.info
    }

    /// Number of voxels.
    pub fn len(&self) -> usize {
        self.records.len() / BYTES
    }

    /// Whether it has no voxel.
    pub fn is_empty(&self) -> bool {
        self.records.is_empty()
    }

    /// The file's bytes.
    pub fn as_bytes(&self) -> &[u8] {
        self.bytes.as_slice()
    }

    /// All voxels, by rising x, then y, then z of their cells.
    pub fn voxels(&self) -> impl Iterator<Item = Voxel> {
        self.records().iter().map(|bytes| self.decoded(bytes))
    }

    /// The voxel of a cell, in voxels from the origin; `None` where nothing stands.
    pub fn voxel(&self, cell: [i32; 3]) -> Option<Voxel> {
        let place = self.table.get(key_of(cell))?;
        self.records().get(place as usize).map(|bytes| self.decoded(bytes))
    }

    fn decoded(&self, bytes: &[u8; BYTES]) -> Voxel {
        Record(bytes).voxel(&self.info.origin, self.info.voxel_m, self.info.thickness_m)
    }

    /// How far from the origin cells have keys, m.
    pub fn reach_m(&self) -> f64 {
        f64::from((1 << 20) - 2) * self.info.voxel_m
    }

    /// Makes what wide searches need, so that none of them waits for it.
    pub fn prepare(&self) {
        self.coarser();
    }

    /// The same map with voxels twice as wide; it is made when it is first asked for.
    pub(crate) fn coarser(&self) -> &VoxelMap {
        self.coarser.get_or_init(|| Box::new(coarsened(self)))
    }

    pub(crate) fn records(&self) -> &[[u8; BYTES]] {
        self.bytes.as_slice()[self.records.clone()].as_chunks().0
    }

    pub(crate) fn table(&self) -> &CellTable {
        &self.table
    }
}
