//! Inputs and machines that people met elsewhere: each gives the right value, or an error that says what to do.

#[path = "../common/mod.rs"]
mod common;

mod accounting;
mod clocks;
mod compared;
mod doors;
mod faults;
mod growth;
mod life;
mod offsets;
mod plugins;
mod refused;
mod scene;
mod sweep;
mod tables;
mod values;
mod writers;
