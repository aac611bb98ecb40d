//! What stages count that read points or give boxes, whatever computes their network.

use realo_operator::{Counter, Outputs};

/// Counts sweeps in which a network cannot find anything.
pub const EMPTY_SWEEPS: Counter = Counter::log_fault(
    "empty_sweeps",
    "sweeps that have no point in the model's grid, so that nothing can be found in them",
    "sweeps have no point in the range of the model, so that nothing was found in them",
    "where the log has detections in place of points, play these (`--recorded-detections`); else points are expected in metres, in \
     the body frame of their agent (docs/reference/log-format.md)",
);
/// Counts points that no pillar takes.
pub const OVER_POINTS: Counter = Counter::plain(
    "over_points",
    "points left out: they came after the last that their pillar takes",
);
/// Counts boxes beyond the best.
pub const OVER_LIMIT_BOXES: Counter = Counter::plain(
    "over_limit_boxes",
    "detections above the min score, but not among the best 1,000",
);

/// Counts a sweep of an agent, of so many points, as [`EMPTY_SWEEPS`] if it is empty.
pub fn count_empty<O>(out: &mut Outputs<O>, agent: &str, points: usize, is_empty: bool) {
    out.count_of(&EMPTY_SWEEPS, agent, u64::from(is_empty), 1);
    if is_empty {
        out.found(&EMPTY_SWEEPS, agent, || match points {
            0 => "the first has no points".into(),
            all => format!("the first has {all} points, all beyond the range or not finite"),
        });
    }
}
