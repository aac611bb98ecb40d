//! Voxel maps of what stands still, and where on them a sweep was taken.
//!
//! - [`MapBuilder`] makes a [`VoxelMap`] of sweeps with poses, and leaves out what moves. [`VoxelMap::open`] uses a file in place.
//! - [`Registrar`] finds the pose of a sweep by Gauss-Newton: distances to the planes in the voxels of its points, or to their
//!   distributions, with a Geman-McClure kernel. All is precomputed on the map's side: nothing is searched for but cells in a table.
//!
//! # Frames and numbers
//! `map_from_body * point_in_body` is in the frame of the poses that the map was built from. A map has an origin of its own, in f64.
//! Points are placed from the cell where the body is, so that no f32 is larger than a sweep is wide.
//!
//! The same input gives the same bits on any machine and with any number of threads: points are taken in chunks of 1,024, whose sums are
//! added in their order.
//!
//! # Sources
//! Voxels with distributions: Magnusson 2009 (NDT); their use for a fast GICP: Koide et al. 2021 (VGICP, small_gicp). Robust kernel: Geman
//! and McClure 1985. Degenerate directions: Zhang, Kaess and Singh 2016.

mod builder;
mod cell;
mod coarse;
mod eigen;
mod error;
mod file;
mod gather;
mod map;
mod observe;
mod registrar;
mod rows;
mod sample;
mod table;
#[cfg(test)]
mod town;
mod view;
mod voxel;

pub use builder::{MapBuilder, MapSettings, PosedSweep};
pub use error::{AlignError, BuildError, Flaw, MapError, SettingError};
pub use file::MAGIC;
pub use map::{Closure, MapInfo, VoxelMap};
pub use observe::Direction;
pub use registrar::{Alignment, Around, FoundAround, Registrar, RegistrarSettings, Search};
pub use sample::{Sample, Sampler};
pub use voxel::Voxel;
