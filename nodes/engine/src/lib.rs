//! What a stage owes its graph, as one state machine: queues, slots, joins, order, wakes, counting, fates, the end.
//!
//! [`Engine`] knows no clock and does no I/O: messages and the time go in, calls of stages and what leaves come out. The
//! virtual driver, the process on dora and the [`testkit`] are loops around it. Any number of stages, and any number of
//! agents a stage.

mod engine;
mod event;
mod intake;
mod stage;
pub mod testkit;
#[cfg(test)]
mod tests;
mod wiring;

pub use engine::{Engine, EngineError, Leaving, Servers, Step, Task, Ticket};
pub use intake::Overflow;
pub use stage::{Call, Called, Gone};
pub use wiring::{Feed, Wired, Wiring};
