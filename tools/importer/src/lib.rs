//! Brings recorded datasets into logs.
//!
//! So far one: DAIR-V2X-C ([`dair`]), pairs of a vehicle's and a roadside unit's LiDAR sweeps with labels.

mod dair;
mod error;
mod pcd;

pub use dair::{LIDAR_HEIGHT_M, ROADSIDE, RoadsideStamp, Summary, VEHICLE, dair};
pub use error::ImportError;
pub use pcd::{PcdCloud, read_pcd};
