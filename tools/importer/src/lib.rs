//! Brings recorded datasets into logs.
//!
//! So far one: DAIR-V2X-C ([`dair`]), pairs of a vehicle's and a roadside unit's LiDAR sweeps with labels.

mod dair;
mod error;
mod pcd;

pub use dair::{ROADSIDE, RoadsideStamp, Summary, VEHICLE, dair, lidar_height};
pub use error::ImportError;
pub use pcd::{PcdCloud, parse_pcd, read_pcd};
