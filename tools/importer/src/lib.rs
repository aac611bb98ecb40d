//! Brings recorded datasets into logs.
//!
//! DAIR-V2X-C ([`dair`]) are pairs of a vehicle's and a roadside unit's LiDAR sweeps with labels; [`relevel`] makes the body
//! frames of a log level that are not.

mod dair;
mod error;
mod level;
mod pcd;
mod relevel;

pub use dair::{DairOptions, DairStep, ROADSIDE, RoadsideStamp, Summary, VEHICLE, dair, dair_with, lidar_height};
pub use error::ImportError;
pub use level::{Level, Plane};
pub use pcd::{PcdCloud, parse_pcd, read_pcd};
pub use relevel::{relevel, relevel_with};

/// Text of a file as part of a line of ours.
fn shown(text: &str) -> String {
    text.chars().take(40).collect::<String>().escape_debug().collect()
}
