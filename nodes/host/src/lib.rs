//! Runs the stages of a graph: as a process on dora ([`dora`]), or all of them in virtual time ([`virtual_time`]).
//!
//! Both are loops around the [`realo_engine::Engine`]. [`Program`] is a plug-in that takes part in either.

pub mod dora;
mod profile;
mod program;
mod reorder;
mod shared;
mod stages;
mod tap;
pub mod virtual_time;

pub use profile::ComputeProfile;
pub use program::{Child, Guard, Program, interpreter, python};
pub use shared::{Outline, Shared, Sharing};
pub use stages::{BuildError, Stages};
pub use tap::{Inlet, Seen, Sweeps, TAP_VARIABLE, Tap};
