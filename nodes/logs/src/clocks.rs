//! How far the clocks of agents lie from each other, as their logs tell.

use realo_schemas::{Nanos, are_one_time_line};
use serde::{Deserialize, Serialize};

/// How far another agent's clock lies from the clock of a log.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PeerClock {
    /// The other agent.
    pub peer: String,
    /// When that was so, on the log's clock, ns.
    pub at: Nanos,
    /// Its clock minus the log's, ns.
    pub offset: Nanos,
    /// What that is likely off by, ns.
    pub uncertainty: Nanos,
    /// What its clock gains on the log's, s/s.
    pub drift: f64,
}

/// Clocks that drift by more are no clocks.
const MOST_DRIFT: f64 = 0.01;

impl PeerClock {
    /// Why it cannot be; `None` if it can.
    pub(crate) fn fault(&self) -> Option<String> {
        let drifts = self.drift.is_finite() && self.drift.abs() <= MOST_DRIFT;
        let far = self.offset.checked_abs().is_none_or(|offset| offset > Nanos::MAX / 4);
        (!drifts || far || self.uncertainty < 0).then(|| {
            format!(
                "clock of `{}`: expected an offset and uncertainty in ns and a drift within ±{MOST_DRIFT}, found {}, {} and {}",
                self.peer, self.offset, self.uncertainty, self.drift
            )
        })
    }

    /// From the peer's times to those of the log.
    pub(crate) fn to_log(&self) -> Shift {
        match are_one_time_line(self.offset, self.uncertainty) {
            true => Shift::default(),
            false => Shift {
                at: self.at.saturating_add(self.offset),
                by: -self.offset,
                drift: -self.drift,
            },
        }
    }

    /// From the times of the log to the peer's.
    pub(crate) fn to_peer(&self) -> Shift {
        match are_one_time_line(self.offset, self.uncertainty) {
            true => Shift::default(),
            false => Shift {
                at: self.at,
                by: self.offset,
                drift: self.drift,
            },
        }
    }
}

/// From one clock to another.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Shift {
    /// When it was known, on the clock that it is from, ns.
    pub at: Nanos,
    /// What times are moved by then, ns.
    pub by: Nanos,
    /// What that grows by, s/s.
    pub drift: f64,
}

impl Shift {
    /// What a time is moved by.
    pub fn of(&self, time: Nanos) -> Nanos {
        let since = time.saturating_sub(self.at) as f64;
        self.by.saturating_add((self.drift * since).round() as Nanos)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const SECOND: Nanos = 1_000_000_000;

    #[test]
    fn clocks_that_agree_move_nothing() {
        let near = PeerClock {
            peer: "rsu1".into(),
            at: 7 * SECOND,
            offset: 400_000,
            uncertainty: 50_000,
            drift: 1e-4,
        };
        assert_eq!((near.to_log(), near.to_peer()), Default::default());
        let unsure = PeerClock {
            offset: 4_000_000,
            uncertainty: 2_000_000,
            ..near
        };
        assert_eq!(unsure.to_log(), Shift::default());
    }

    proptest! {
        #[test]
        fn there_and_back_is_where_it_was(
            offset in -100 * SECOND..100 * SECOND,
            drift in -1e-4f64..1e-4,
            since in -3600 * SECOND..3600 * SECOND,
        ) {
            prop_assume!(offset.abs() > 2_000_000);
            let at = 1_700_000_000 * SECOND;
            let clock = PeerClock { peer: "b".into(), at, offset, uncertainty: 1000, drift };
            let there = at + since + clock.to_peer().of(at + since);
            prop_assert!((there - (at + since) - offset - (drift * since as f64) as Nanos).abs() < 100);
            let back = there + clock.to_log().of(there);
            // The drift of the drift: 1e-8 of an hour.
            prop_assert!((back - (at + since)).abs() < 50_000, "{}", back - at - since);
        }
    }
}
