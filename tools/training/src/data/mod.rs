//! Training data: frames of all agents, from simulator seeds or logs, and the samples that are drawn from them.

mod cells;
mod crowd;
mod decoys;
mod frame;
mod frames;
mod left_out;
mod loader;
mod logged;
mod maps;
mod outline;
mod resize;
mod sample;
mod simulated;

pub use decoys::{Decoys, Supply};
pub use frame::{AgentSweep, Earlier, Frame, Return, Seen};
pub(crate) use frame::{REACH, write_whole};
pub(crate) use frames::world;
pub use frames::{Frames, SimulatedFrames};
pub use left_out::{Cause, LeftOut, left_out_once};
pub use loader::{Batch, Sampling};
pub(crate) use loader::{LATER, gather};
pub use logged::{LoggedData, LoggedFrames};
pub use maps::Member;
pub(crate) use maps::{MapEncoder, Party, Project};
pub use sample::{Augmentation, Cast, REACH as PARTNER_REACH, Sample};
pub(crate) use sample::{PlacedSweep, Scene, near};
