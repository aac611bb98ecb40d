//! For tests: files that somebody damaged, by accident or on purpose, and the memory that reading them takes.
//!
//! A test that uses this crate has its allocator.

mod bytes;
mod memory;
mod yaml;

pub use bytes::{Draw, cases};
pub use memory::most_held;
pub use yaml::damaged_yaml;
