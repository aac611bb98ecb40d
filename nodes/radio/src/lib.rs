//! Packets between agents on different machines, fresh on links that are slow, lossy and shared.
//!
//! - [`protocol`]: what goes out when to one peer, and what came in, without socket or clock.
//! - [`station`]: an agent among its peers, likewise; with [`books`] of what became of messages, the [`offset`] of clocks and the [`course`] of ways.
//! - [`keys`] of agents, what they [`seal`], and why something is a [`refusal`].
//! - [`session`]: Zenoh's settings; [`network`]: Zenoh, and the thread that drives a station.
//! - [`Radio`]: the node of a graph.

pub mod body;
pub mod books;
pub mod course;
mod endpoint;
mod error;
pub mod keys;
pub mod network;
mod node;
pub mod offset;
pub mod protocol;
pub mod refusal;
pub mod seal;
pub mod session;
pub mod station;
mod unheard;

/// The clocks of the machine, between which a [`station`]'s times are moved.
pub use realo_clock as clock;

pub use endpoint::{Endpoint, NoEndpoint};
pub use error::RadioError;
pub use node::{Radio, Settings};
