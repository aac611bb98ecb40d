//! Many runs by one plan, in one folder or in several that come together.
//!
//! - [`Plan`]: an ordered list of [`Item`]s. Each has a key, which is its folder, and digests of all that its result depends on.
//! - [`Shard`]: the part of a plan that one machine runs: `3/16`.
//! - [`Folder`]: a plan with the results beside it. An item is done when its record is there and its digests are the same.
//! - [`execute`]: runs items on several threads. One that fails does not keep the others from running.
//!
//! What a run is, who calls it knows. Nothing here prints, catches signals or reads a clock but to time the runs.

mod execute;
mod folder;
mod plan;
mod shard;

pub use execute::{Ended, Task, execute};
pub use folder::{Earlier, Folder, FolderError, PLAN_FILE, RECORD_FILE};
pub use plan::{Item, Plan, PlanError, digest};
pub use shard::{Shard, ShardError};
