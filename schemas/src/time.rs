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

/// Nanoseconds to milliseconds.
pub fn to_millis(nanos: Nanos) -> f64 {
    nanos as f64 * 1e-6
}
