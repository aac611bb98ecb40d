//! What the methods' operations on candle's tensors are made of: weights by their keys, agents' maps in the ego's cells, and
//! functions that gradients lead back through.

mod agent;
mod named;
pub mod ops;
mod placed;
pub mod planes;

pub use agent::{Agent, AgentMap, OwnMap, placed};
pub use named::Tensors;
pub use placed::Placed;
