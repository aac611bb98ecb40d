//! How far the clocks of agents lie from each other, as their logs tell.

use realo_schemas::{Nanos, are_one_time_line};
use serde::{Deserialize, Serialize};

use crate::Stream;
use crate::words::{seconds, side};

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

/// Stamps may be so much later than the log time, ns: clocks of sensors and of the recorder are not exactly in step.
const AHEAD_TOLERATED: Nanos = 50_000_000;
/// Stamps that are this much later than the log time are of another clock, ns.
const AHEAD_MOST: Nanos = 1_000_000_000;
/// Sweeps and poses that were logged later than this are of another clock, ns.
pub const BEHIND_MOST: Nanos = 2_000_000_000;

/// How a stamp lies to the log time of its message, which is when the message existed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Step {
    /// Earlier, as it must, or at most 50 ms later.
    InStep,
    /// Up to 1 s later.
    Ahead,
    /// So far away that the stamps are of another clock.
    Off,
}

impl Step {
    /// Of a message of a stream. Boxes and packets may be computed late: only early ones show a clock that is off.
    pub fn of(stream: Stream, stamp: Nanos, ready: Nanos) -> Step {
        let sensed = stream.is_motion()
            || matches!(
                stream,
                Stream::Pose | Stream::PoseTruth | Stream::Sweeps | Stream::Points
            );
        match stamp.saturating_sub(ready) {
            ahead if ahead > AHEAD_MOST => Step::Off,
            ahead if ahead > AHEAD_TOLERATED => Step::Ahead,
            ahead if sensed && ahead < -BEHIND_MOST => Step::Off,
            _ => Step::InStep,
        }
    }
}

/// How far a stamp lies from its log time and what clock that looks like, e.g. "stamps 36.910 s later than log times: …".
pub fn clock_words(stamp: Nanos, ready: Nanos) -> String {
    let ahead = stamp.saturating_sub(ready);
    let far = format!("stamps {} s {} log times", seconds(ahead), side(ahead));
    match kind_of_clock(stamp, ready) {
        Some(kind) => format!("{far}: looks like {kind}"),
        None => far,
    }
}

const SECOND: Nanos = 1_000_000_000;
const YEAR: Nanos = 365 * 86_400 * SECOND;
/// A message is logged this long after its stamp at most, where only the clocks tell stamp and log time apart.
const LATENCY: Nanos = 600_000_000;
/// What the time from 1970 to 1980 is, where GPS begins to count, s.
const GPS_EPOCH: Nanos = 315_964_800;
/// What the week number of GPS counts to, s.
const ROLLOVER: Nanos = 1024 * 7 * 86_400;
/// Seconds by which the clock of the stamps is ahead of the clock of the log times, and what the two are.
const LEAPS: [(Nanos, &str); 6] = [
    (37, "TAI against UTC, 37 leap seconds (PTP gives TAI)"),
    (-37, "UTC against TAI, 37 leap seconds (PTP gives TAI)"),
    (18, "GPS time against UTC, 18 leap seconds"),
    (-18, "UTC against GPS time, 18 leap seconds"),
    (19, "TAI against GPS time, 19 s"),
    (-19, "GPS time against TAI, 19 s"),
];

/// What kind of clock gives `stamp` when that of the log gives `log_time`; `None` where that is unknown.
pub fn kind_of_clock(stamp: Nanos, log_time: Nanos) -> Option<String> {
    let ahead = stamp.saturating_sub(log_time);
    let is_near = |offset: Nanos| {
        let late = (offset * SECOND).saturating_sub(ahead);
        (-AHEAD_TOLERATED..=LATENCY).contains(&late)
    };
    let leap = |base: Nanos| {
        let known = LEAPS.iter().find(|(leap, _)| is_near(base + leap));
        known.map(|(_, words)| *words)
    };
    for weeks in [-1, 1, -2, 2] {
        let (base, turns) = (weeks * ROLLOVER, weeks.abs() * 1024);
        if is_near(base) || leap(base).is_some() {
            let whose = if weeks < 0 { "" } else { "log times of " };
            return Some(format!(
                "{whose}a GPS receiver whose week number has rolled over ({turns} weeks)"
            ));
        }
    }
    if [0, 18].into_iter().any(|leaps| is_near(leaps - GPS_EPOCH)) {
        return Some("GPS time that counts from 1980".into());
    }
    if [0, 18].into_iter().any(|leaps| is_near(GPS_EPOCH - leaps)) {
        return Some("log times of GPS that count from 1980".into());
    }
    let counts_from_start = |time: Nanos, other: Nanos| (0..10 * YEAR).contains(&time) && other > 30 * YEAR;
    if counts_from_start(stamp, log_time) {
        let since = seconds(stamp);
        return Some(format!("time since the sensor or its computer started ({since} s)"));
    }
    if counts_from_start(log_time, stamp) {
        return Some("log times that count from when the recorder started".into());
    }
    if let Some(words) = leap(0) {
        return Some(words.into());
    }
    let quarters = (1..=56).flat_map(|n: Nanos| [n, -n]);
    let zone = quarters.into_iter().find(|n| is_near(n * 900));
    zone.map(|n| format!("local time against UTC ({} h)", n as f64 / 4.0))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn clocks_are_reported_by_what_they_differ() {
        let now = 1_700_000_000 * SECOND;
        let kind = |offset: Nanos, latency: Nanos| kind_of_clock(now + offset, now + latency).unwrap_or_default();
        for latency in [0, 90_000_000, 500_000_000] {
            assert!(kind(37 * SECOND, latency).starts_with("TAI against UTC"));
            assert!(kind(-37 * SECOND, latency).starts_with("UTC against TAI"));
            assert!(kind(18 * SECOND, latency).starts_with("GPS time against UTC"));
            assert!(kind(-18 * SECOND, latency).starts_with("UTC against GPS time"));
            assert!(kind(19 * SECOND, latency).starts_with("TAI against GPS time"));
            assert!(kind(-19 * SECOND, latency).starts_with("GPS time against TAI"));
            assert!(kind(1024 * 7 * 86_400 * SECOND, latency).starts_with("log times of a GPS receiver"));
            assert!(kind(GPS_EPOCH * SECOND, latency).starts_with("log times of GPS"));
            assert!(kind(-1024 * 7 * 86_400 * SECOND, latency).contains("1024 weeks"));
            assert!(kind((18 - 1024 * 7 * 86_400) * SECOND, latency).contains("1024 weeks"));
            assert!(kind((18 - GPS_EPOCH) * SECOND, latency).contains("1980"));
            assert!(kind(4_280 * SECOND - now, latency).contains("started (4280.000 s)"));
            assert!(kind(2 * 3600 * SECOND, latency).contains("local time against UTC (2 h)"));
        }
        assert_eq!(kind_of_clock(now + 25 * SECOND, now), None);
        assert!(kind_of_clock(now, 4_280 * SECOND).unwrap().contains("recorder"));
        assert!(
            clock_words(now + 37 * SECOND, now + 90_000_000)
                .starts_with("stamps 36.910 s later than log times: looks like TAI")
        );
    }

    #[test]
    fn stamps_lie_before_the_log_time_within_what_is_tolerated() {
        let step = |ahead: Nanos| {
            [Stream::Points, Stream::Detections].map(|stream| Step::of(stream, SECOND * 9 + ahead, SECOND * 9))
        };
        let ms = SECOND / 1_000;
        assert_eq!(step(50 * ms), [Step::InStep; 2]);
        assert_eq!(step(51 * ms), [Step::Ahead; 2]);
        assert_eq!(step(1_001 * ms), [Step::Off; 2]);
        assert_eq!(step(-2_000 * ms), [Step::InStep; 2]);
        assert_eq!(step(-2_001 * ms), [Step::Off, Step::InStep]);
    }

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
