//! Makes of an agent's raw streams what the other stages can rely on: sweeps in order, each with its pose, without the
//! agent's own motion, its own body and points that are no numbers.
//!
//! Poses between two recorded ones are interpolated, and beyond the newest one carried on by its motion, over at most
//! `max_gap_ms`; so a sweep waits for nothing that it can do without, but 2 ms for a pose that its last points need and that
//! by the rhythm of the others must be on its way. If its pose cannot be known that way it waits up to `patience_ms`, and is then
//! dropped and counted as `no_pose`, or as `late_pose` if the pose comes after all.
//!
//! A log may have one pose for each sweep and none near it: that pose is exact, but nothing says how the agent moved;
//! such a sweep passes as it is (`not_deskewed`), without velocity.
//!
//! Each sensor has a clock. Its stamps are watched, and handled as the setting `stamps` says; at the end the result has its offset with a
//! bound: by the quickest messages, and of an inertial unit by the turning that the poses show too.

mod agent_track;
mod clean;
mod clocks;
mod operator;

pub use agent_track::{AgentTrack, Pairing, PosePoint};
pub use clean::{Cleaned, OwnBody, clean};
pub use operator::{Input, Output, Settings, Sync};
