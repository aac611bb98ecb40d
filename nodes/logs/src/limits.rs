//! What separates a fault of a log from what is usual: one set of numbers for `realo info` and for the player.

use realo_schemas::Nanos;

/// Agents whose sweeps are farther apart have no time in common, ns.
pub const APART: Nanos = 500_000_000;
/// Truth farther from a sweep belongs to another one, ns.
pub const TRUTH_WINDOW: Nanos = 500_000_000;
/// Shorter times without a sweep are not gaps, ns.
pub const SHORTEST_GAP: Nanos = 500_000_000;
/// Times of fewer periods without a sweep are not gaps.
pub const SHORTEST_GAP_PERIODS: Nanos = 5;
/// Poses may go on for so long after the last sweep, ns.
pub const POSES_MORE: Nanos = 1_000_000_000;
