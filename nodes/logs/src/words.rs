//! Words that several messages say alike.

use realo_schemas::Nanos;

/// How far the nearest of some times is, in words: "the nearest is 12.000 ms away"; `None`: there is none.
pub fn nearest_words(far: Option<Nanos>) -> String {
    match far.map(Nanos::unsigned_abs) {
        None => "there is none".into(),
        Some(far) if far < 1_000_000_000 => format!("the nearest is {:.3} ms away", far as f64 * 1e-6),
        Some(far) => format!("the nearest is {:.3} s away", far as f64 * 1e-9),
    }
}

/// On which side of another a time is that is `by` ns after it: "earlier than" or "later than".
pub fn side(by: Nanos) -> &'static str {
    if by < 0 { "earlier than" } else { "later than" }
}

/// Seconds to the millisecond, without a sign.
pub(crate) fn seconds(time: Nanos) -> String {
    format!("{:.3}", time.unsigned_abs() as f64 * 1e-9)
}

/// The nearest whole milliseconds.
pub(crate) fn millis(time: Nanos) -> Nanos {
    time.saturating_add(500_000).div_euclid(1_000_000)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_are_said_in_their_unit_and_with_their_side() {
        assert_eq!(nearest_words(Some(-12_000_000)), "the nearest is 12.000 ms away");
        assert_eq!(nearest_words(Some(37_000_000_000)), "the nearest is 37.000 s away");
        assert_eq!(nearest_words(None), "there is none");
        assert_eq!([side(-1), side(1)], ["earlier than", "later than"]);
        assert_eq!((seconds(-1_500_000_000), millis(1_500_000)), ("1.500".to_string(), 2));
    }
}
