use realo_schemas::Nanos;

const SECOND: Nanos = 1_000_000_000;
/// TAI is so far ahead of UTC, s, since 2017; no further leap second has been announced.
const TAI: Nanos = 37 * SECOND;
/// GPS time is so far ahead of UTC.
const GPS: Nanos = 18 * SECOND;
/// After so many weeks the counter of GPS weeks starts again.
const ROLLOVER: Nanos = 1_024 * 7 * 86_400 * SECOND;
/// Clocks that count from boot have not counted longer, ns: five years.
const BOOT: Nanos = 5 * 365 * 86_400 * SECOND;
/// The year 2000.
const Y2K: Nanos = 946_684_800 * SECOND;
/// A message is no older than this when it arrives, and no younger than minus this, where the clock is right.
pub(crate) const TOLERANCE: Nanos = 2 * SECOND;

/// What a clock counts, as far as its offset shows it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Epoch {
    /// The same as the reference, within two seconds.
    Same,
    /// TAI, 37 s ahead.
    Tai,
    /// GPS time, 18 s ahead.
    Gps,
    /// The time since the device was switched on.
    Boot,
    /// UTC, so many times 1,024 weeks behind (below 0: ahead), as after a rollover of GPS weeks.
    Weeks(i64),
    /// Something else.
    Unknown,
}

impl Epoch {
    /// Its name in results; `None` for the reference's own.
    pub fn name(self) -> Option<&'static str> {
        match self {
            Epoch::Same => None,
            Epoch::Tai => Some("tai"),
            Epoch::Gps => Some("gps"),
            Epoch::Boot => Some("boot"),
            Epoch::Weeks(_) => Some("weeks"),
            Epoch::Unknown => Some("other"),
        }
    }

    /// What is to be added to stamps, ns; `None` where the kind of clock does not say it.
    pub fn shift(self) -> Option<Nanos> {
        match self {
            Epoch::Same => Some(0),
            Epoch::Tai => Some(-TAI),
            Epoch::Gps => Some(-GPS),
            Epoch::Weeks(count) => ROLLOVER.checked_mul(count),
            Epoch::Boot | Epoch::Unknown => None,
        }
    }
}

/// What a clock counts whose message with a stamp arrives at a time of the reference clock.
pub fn epoch_of(stamp: Nanos, arrival: Nanos) -> Epoch {
    let behind = arrival.saturating_sub(stamp);
    let near = |shift: Nanos| behind.saturating_sub(shift).saturating_abs() <= TOLERANCE;
    if near(0) {
        return Epoch::Same;
    }
    if near(-TAI) {
        return Epoch::Tai;
    }
    if near(-GPS) {
        return Epoch::Gps;
    }
    let weeks = (behind as f64 / ROLLOVER as f64).round() as i64;
    if weeks != 0 && ROLLOVER.checked_mul(weeks).is_some_and(near) {
        return Epoch::Weeks(weeks);
    }
    if (0..BOOT).contains(&stamp) && arrival > Y2K {
        return Epoch::Boot;
    }
    Epoch::Unknown
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn clocks_are_told_by_their_offsets() {
        let now = 1_790_000_000 * SECOND;
        let weeks = 1_024 * 7 * 86_400;
        let cases = [
            (0, Epoch::Same),
            (-2, Epoch::Same),
            (1, Epoch::Same),
            (37, Epoch::Tai),
            (36, Epoch::Tai),
            (18, Epoch::Gps),
            (-weeks, Epoch::Weeks(1)),
            (1 - 2 * weeks, Epoch::Weeks(2)),
            (weeks, Epoch::Weeks(-1)),
            (-37, Epoch::Unknown),
            (3_600, Epoch::Unknown),
            (100 - weeks, Epoch::Unknown),
        ];
        for (ahead, expected) in cases {
            let stamp = now + ahead * SECOND;
            assert_eq!(epoch_of(stamp, now), expected, "{ahead} s ahead");
            if let Some(shift) = expected.shift() {
                assert!((stamp + shift - now).abs() <= TOLERANCE, "{ahead} s ahead");
            }
        }
        assert_eq!(epoch_of(0, now), Epoch::Boot);
        assert_eq!(epoch_of(86_400 * SECOND, now), Epoch::Boot);
        assert_eq!(epoch_of(5 * SECOND, 6 * SECOND), Epoch::Same);
        for (stamp, arrival) in [(Nanos::MIN, Nanos::MAX), (Nanos::MAX, Nanos::MIN), (Nanos::MIN, 0)] {
            assert_eq!(epoch_of(stamp, arrival), Epoch::Unknown);
        }
    }
}
