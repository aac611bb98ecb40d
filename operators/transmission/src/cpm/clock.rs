//! Stamps of messages and `TimestampIts` of ETSI TS 102 894-2: milliseconds that have passed since the first of 2004,
//! leap seconds included.

use realo_schemas::Nanos;

/// The first of 2004, 00:00 UTC, s since 1970.
const EPOCH: i64 = 1_072_915_200;
/// When the leap seconds since then were over, s since 1970: 2006, 2009, July of 2012, July of 2015, 2017 (IERS Bulletin C).
const LEAPS: [i64; 5] = [
    1_136_073_600,
    1_230_768_000,
    1_341_100_800,
    1_435_708_800,
    1_483_228_800,
];
/// Largest `TimestampIts`.
const GREATEST: i64 = 4_398_046_511_103;
const MILLI: Nanos = 1_000_000;

/// The nearest millisecond of a stamp in ns since 1970; `None` before 2004 or after 2143.
pub fn timestamp_of(stamp: Nanos) -> Option<u64> {
    let unix_ms = stamp.checked_add(MILLI / 2)?.div_euclid(MILLI);
    let leaps = LEAPS.iter().filter(|leap| **leap * 1000 <= unix_ms).count() as i64;
    let timestamp = unix_ms - EPOCH * 1000 + leaps * 1000;
    u64::try_from(timestamp).ok().filter(|_| timestamp <= GREATEST)
}

/// The stamp of a `TimestampIts`, ns since 1970. Within a leap second, which that time does not have, it is that of the second
/// after it.
pub(crate) fn stamp_of(timestamp: u64) -> Option<Nanos> {
    let timestamp = i64::try_from(timestamp)
        .ok()
        .filter(|timestamp| *timestamp <= GREATEST)?;
    let without = |leaps: usize| timestamp + EPOCH * 1000 - leaps as i64 * 1000;
    let is_over = |leaps: usize| leaps == 0 || without(leaps) >= LEAPS[leaps - 1] * 1000;
    let leaps = (0..=LEAPS.len()).rev().find(|leaps| is_over(*leaps))?;
    Some(without(leaps) * MILLI)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const SECOND: Nanos = 1_000_000_000;

    #[test]
    fn times_are_those_that_the_standard_gives() {
        // The example at TimestampIts: the first of 2007, 00:00 UTC. The first of 2022 is 5 s ahead of UTC.
        assert_eq!(timestamp_of(1_167_609_600 * SECOND), Some(94_694_401_000));
        let since_2004 = 1_640_995_200 - EPOCH;
        assert_eq!(
            timestamp_of(1_640_995_200 * SECOND),
            Some((since_2004 as u64 + 5) * 1000)
        );
        assert_eq!(timestamp_of(EPOCH * SECOND), Some(0));
        assert_eq!(timestamp_of(EPOCH * SECOND - SECOND), None);
        assert_eq!(timestamp_of(0), None);
        assert_eq!(timestamp_of(i64::MAX), None);
        assert_eq!(stamp_of(u64::MAX), None);
        assert_eq!(timestamp_of(stamp_of(GREATEST as u64).unwrap()), Some(GREATEST as u64));
    }

    #[test]
    fn a_leap_second_is_one_more() {
        for leap in LEAPS {
            let (before, after) = (leap * SECOND - MILLI, leap * SECOND);
            let [before, after] = [before, after].map(|stamp| timestamp_of(stamp).unwrap());
            assert_eq!(after - before, 1001);
            assert_eq!(stamp_of(before), Some(leap * SECOND - MILLI));
            assert_eq!(stamp_of(after), Some(leap * SECOND));
            // 23:59:60.5
            assert_eq!(stamp_of(before + 501), Some(leap * SECOND + SECOND / 2));
        }
    }

    proptest! {
        #[test]
        fn stamps_come_back_to_half_a_millisecond(stamp in EPOCH * SECOND..5_000_000_000 * SECOND) {
            let back = stamp_of(timestamp_of(stamp).unwrap()).unwrap();
            prop_assert!((back - stamp).abs() <= MILLI / 2);
        }
    }
}
