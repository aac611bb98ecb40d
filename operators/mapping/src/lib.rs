//! The poses of drives by their own sensors: odometry, loops and GNSS in one graph.
//!
//! | step | what it does |
//! |---|---|
//! | [`Odometry`] | the error-state filter over IMU, wheels and sweeps; each sweep is registered to a local map of the last keyframes. GNSS takes no part, so nothing is counted twice |
//! | alignment | places each piece of a drive on its positions of GNSS, by a heading and a shift |
//! | loop closure | keyframes near others of an earlier pass are registered to a submap of these |
//! | [`Lean`] | what loops say of a sensor that leans; its sweeps are to be followed again with that slope |
//! | pose graph | odometry edges, loop edges, anchors of GNSS; all drives in one graph ([`realo_pose_graph`]) |
//! | [`Mapped`] | the poses of each drive, how well they are known, and what became of loops and anchors |
//!
//! A *piece* is a part of a drive without a break in its odometry. A piece without GNSS has a place only where loops join it to another;
//! loops are looked for where poses are near each other, so such a piece is left out, unless it is all there is.
//!
//! # Frames
//! `odom`: begins where the odometry of a piece sets out, x along the vehicle, z up. `map`: that of the positions of GNSS. Body frames are level.

mod align;
mod anchors;
mod drive;
mod errors;
mod join;
mod keyframe;
mod lean;
mod local_map;
mod loops;
mod odometry;
mod solve;
mod track;

pub use align::Planar;
pub use anchors::{Fix, FixFaults};
pub use drive::{Drive, Piece};
pub use errors::{Errors, Spread, errors};
pub use keyframe::Keyframe;
pub use lean::{Lean, levelled};
pub use odometry::{Counts, Odometry, OdometrySettings, Taken};
pub use solve::{Mapped, MappedDrive, MappingError, Summary, solve};
