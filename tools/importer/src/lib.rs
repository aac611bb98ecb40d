//! Brings recorded datasets into logs.
//!
//! [`KINDS`] has the kinds of data sets, each behind the trait [`Importer`]; [`look_at`] says which of them a folder is. DAIR-V2X-C
//! ([`dair`]) are pairs of a vehicle's and a roadside unit's LiDAR sweeps with labels; V2X-Seq-SPD has sequences of such. The others are scenes of agents with a cloud
//! and labels for each frame. Bags of ROS are recordings of topics, and a map file says whose they are. [`relevel`] makes the body frames of a log level that are not.

mod bag;
mod clouds;
mod dair;
mod error;
mod faults;
mod files;
mod kinds;
mod level;
mod options;
mod pcd;
mod places;
mod relevel;
mod rows;
mod scenes;
mod yaml;

pub use bag::{BagAgent, BagSummary};
pub use dair::{DairOptions, DairStep, ROADSIDE, RoadsideStamp, Summary, VEHICLE, dair, dair_with, lidar_height};
pub use error::ImportError;
pub use kinds::{FolderMemory, Imported, Importer, Job, KINDS, Kind, Seen, importer, list, look_at};
pub use level::{Level, Plane};
pub use options::{BoxPlace, Handed, OPTIONS, OptionInfo, Options, SweepStamp, option_info};
pub use pcd::{PcdCloud, parse_pcd, read_pcd};
pub use relevel::{relevel, relevel_with};
pub use scenes::{AgentSummary, Fit, Residual, SceneSummary};

/// Text of a file as part of a line of ours.
fn shown(text: &str) -> String {
    text.chars().take(40).collect::<String>().escape_debug().collect()
}
