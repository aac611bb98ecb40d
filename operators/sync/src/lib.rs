//! Makes of an agent's raw streams what the other stages can rely on: sweeps in order, each with its pose, without the
//! agent's own motion, its own body and points that are no numbers.
//!
//! | port | direction | types | meaning |
//! |---|---|---|---|
//! | `poses` | in, all, state | AgentState | poses of the agents, at any rate |
//! | `clouds` | in, latest | PointCloud | raw sweeps, each point in the body frame at its own time |
//! | `clouds` | out | PointCloud | the sweeps in the body frame at their stamp; `header.pose` is map_from_body then |
//! | `states` | out | AgentState | pose and motion at each sweep's stamp, with the sweep's seq, stamp and ready |
//!
//! Poses between two recorded ones are interpolated, and beyond the newest one carried on by its motion, over at most
//! `max_gap_ms`; so a sweep waits for nothing that it can do without, but 2 ms for a pose that its last points need and that
//! by the rhythm of the others must be on its way. If its pose cannot be known that way it waits up to `patience_ms`, and is then
//! dropped and counted as `no_pose`, or as `late_pose` if the pose comes after all.
//!
//! A log may have one pose for each sweep and none near it: that pose is exact, but nothing says how the agent moved;
//! such a sweep passes as it is (`not_deskewed`), without velocity.
//!
//! | counter | meaning |
//! |---|---|
//! | `nan_points`, `own_body_points` | points dropped from sweeps |
//! | `duplicate`, `out_of_order` | sweeps dropped: same stamp as the last one, or older |
//! | `no_pose`, `late_pose` | sweeps dropped: the pose never became known, or only after `patience_ms` |
//! | `not_deskewed` | sweeps that passed although the motion during them is not known |

mod clean;
mod lane;
mod operator;

pub use clean::{Cleaned, OwnBody, clean};
pub use lane::{Lane, Pairing, PosePoint};
pub use operator::{Sync, SyncConfig};
