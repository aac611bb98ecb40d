//! The workbench: it makes logs, weights and measurements for what runs in the car.
//!
//! One file for each subcommand, and a folder for the benches. Graphs are run by `realo`, the program beside it.

pub mod bench;
mod checkpoint;
mod command;
mod conformance;
mod emulate;
mod export;
mod import;
pub mod measure;
mod option;
mod paper;
mod quantize;
mod score;
mod simulate;
mod statistics;
mod train;

pub use command::{command_line, main, run};
