//! Training data: frames of all agents, from simulator seeds or logs, and the samples that are drawn from them.

mod cells;
mod crowd;
mod decoys;
mod frame;
mod frames;
mod loader;
mod logged;
mod maps;
mod outline;
mod resize;
mod sample;
mod simulated;

pub use decoys::{Decoys, Supply};
pub(crate) use frame::write_whole;
pub use frame::{AgentSweep, Earlier, Frame, Return, Seen};
pub(crate) use frames::world;
pub use frames::{Frames, SimulatedFrames};
pub use loader::{Batch, Input, Recipe};
pub(crate) use loader::{LATER, gather};
pub use logged::LoggedFrames;
pub(crate) use maps::{MapEncoder, Party, Project};
pub use sample::{Augmentation, Cast, Sample};
pub(crate) use sample::{Scene, near};
