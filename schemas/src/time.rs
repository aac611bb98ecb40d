/// Time on a log's line (ns since the epoch) or a duration in ns.
pub type Nanos = i64;

/// Seconds to the nearest nanosecond.
pub fn from_seconds(seconds: f64) -> Nanos {
    (seconds * 1e9).round() as Nanos
}

/// Nanoseconds to seconds.
pub fn to_seconds(nanos: Nanos) -> f64 {
    nanos as f64 * 1e-9
}

/// Offline, what is fused has stamps that differ by at most this; inclusive.
pub const OFFLINE_REACH: Nanos = 50_000_000;

/// Stamps that differ by no more are the same, ns: seconds in double precision are rounded to 238 ns.
pub const SAME_STAMP: Nanos = 1_000;

/// Whether two stamps are the same but for what float seconds round.
pub fn is_same_stamp(one: Nanos, other: Nanos) -> bool {
    one.abs_diff(other) <= SAME_STAMP.unsigned_abs()
}

/// Time lines that differ by less are taken for one, ns.
const SAME: Nanos = 1_000_000;

/// Whether two time lines that lie so far apart, which is likely off by `uncertainty`, are taken for one.
pub fn are_one_time_line(offset: Nanos, uncertainty: Nanos) -> bool {
    offset.saturating_abs() <= SAME.max(uncertainty.saturating_mul(3))
}

/// Nanoseconds to milliseconds.
pub fn to_millis(nanos: Nanos) -> f64 {
    nanos as f64 * 1e-6
}
