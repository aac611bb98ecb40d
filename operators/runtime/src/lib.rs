//! The operator trait, graphs, and the two drivers that run them.
//!
//! - [`Operator`], [`Source`], [`Sink`]: what a stage implements; [`Port`] its contract.
//! - [`graph`]: reads, expands and checks YAML dataflows.
//! - [`virtual_time`]: a discrete-event simulation in one process, bit-identical on every run.
//! - [`realtime`]: hosts one stage as a dora process.
//! - [`pipe`]: hosts one operator as a child of a run in virtual time.
//! - [`testkit`]: what every fusion operator owes its graph, as checks for its tests.
//! - [`run`]: the whole `main` of a plug-in; it serves both drivers.

mod books;
pub mod config;
pub mod graph;
mod host;
mod intake;
mod operator;
pub mod pipe;
mod port;
mod profile;
pub mod realtime;
mod registry;
mod reorder;
mod stage;
pub mod testkit;
pub mod virtual_time;
mod wiring;

pub use books::{Books, Durations, InputBooks, NodeBooks, Tally};
pub use host::{HostError, host, run};
pub use intake::Overflow;
pub use operator::{Argument, Describe, Error, Operator, Outputs, Sink, Source, unexpected, wrong_port};
pub use port::{Class, Port, PortId, Queue, WrongType};
pub use profile::ComputeProfile;
pub use registry::{AnyOperator, AnySink, AnySource, Built, Registration, Registry, Role};
pub use wiring::{Node, Wiring};
