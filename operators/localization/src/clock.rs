//! Whether the clock of an agent's motion sensors goes on as it did, and as that of its sweeps does.

use realo_schemas::Nanos;

/// A clock that jumps by so much was set, ns.
const SET: Nanos = 200_000_000;
/// So many samples in a row with earlier stamps are of a clock that was set back; so many that come too early, of one that was set ahead.
const BACK: u32 = 5;
const AHEAD: u32 = 2;
/// Sweeps come no more than so much earlier after their stamps than samples do, ns: they arrive when they are whole.
const EARLY: Nanos = 300_000_000;
/// Sweeps in a row that show that the two clocks are apart, or together again.
const SWEEPS: u32 = 5;

/// The clock of an agent's inertial unit.
#[derive(Clone, Debug, Default)]
pub(crate) struct MotionClock {
    newest: Option<Nanos>,
    /// Samples in a row that are before the newest, and the stamp of the last one.
    back: (u32, Nanos),
    /// Least time from a stamp to the arrival, ns, and samples in a row that came earlier.
    least: Option<Nanos>,
    ahead: u32,
    /// The last sample's time from its stamp to its arrival, ns.
    delay: Nanos,
    /// How much longer sweeps took than samples, ns, before the clock was set; `None` while it goes as it did.
    before: Option<Nanos>,
    longer: Option<Nanos>,
    /// Sweeps in a row that are apart, and since then those that are not.
    apart: u32,
    together: u32,
}

impl MotionClock {
    /// Takes a sample's stamp, and when it arrived; whether the clock was set.
    pub fn sample(&mut self, stamp: Nanos, arrival: Nanos) -> bool {
        let delay = arrival.saturating_sub(stamp);
        let is_back = self.newest.is_some_and(|newest| stamp < newest.saturating_sub(SET));
        let is_ahead = self.least.is_some_and(|least| delay < least.saturating_sub(SET));
        let (count, last) = self.back;
        self.back = match is_back {
            true if count > 0 && stamp > last => (count + 1, stamp),
            true => (1, stamp),
            false => (0, stamp),
        };
        self.ahead = if is_ahead { self.ahead + 1 } else { 0 };
        self.delay = delay;
        if self.back.0 >= BACK || self.ahead >= AHEAD {
            *self = MotionClock {
                newest: Some(stamp),
                least: Some(delay),
                delay,
                before: self.before.or(self.longer),
                ..MotionClock::default()
            };
            return true;
        }
        if !is_back {
            self.newest = self.newest.max(Some(stamp));
        }
        if !is_ahead {
            self.least = Some(self.least.map_or(delay, |least| least.min(delay)));
        }
        false
    }

    /// Takes a sweep's stamp, and when it arrived; whether its clock is another one than that of the motion sensors. That shows where
    /// sweeps come earlier than they can, and where one clock was set and the other was not.
    pub fn is_apart(&mut self, stamp: Nanos, arrival: Nanos) -> bool {
        if self.newest.is_none() {
            return false;
        }
        let longer = arrival.saturating_sub(stamp).saturating_sub(self.delay);
        let changed = self
            .before
            .is_some_and(|before| longer.abs_diff(before) > EARLY.unsigned_abs());
        if longer < -EARLY || changed {
            (self.apart, self.together) = (self.apart.saturating_add(1), 0);
        } else {
            self.together += 1;
            if self.together >= SWEEPS {
                (self.apart, self.before) = (0, None);
                self.longer = Some(longer);
            }
        }
        self.apart >= SWEEPS
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: Nanos = 1_000_000;

    /// Plays 100 samples and 10 sweeps a second for 20 s, whose clocks are off by so much at a time, all ms. When the clock was found to be
    /// set, and from when to when sweeps are apart.
    fn played(motion: impl Fn(i64) -> i64, sweeps: impl Fn(i64) -> i64) -> (Vec<i64>, Vec<i64>) {
        let mut clock = MotionClock::default();
        let (mut set, mut apart) = (Vec::new(), Vec::new());
        for at in (0..20_000).step_by(10) {
            if clock.sample((at + motion(at)) * MS, (at + 2 + at / 10 % 3) * MS) {
                set.push(at);
            }
            // A sweep is there when it is whole.
            if at % 100 == 90 && clock.is_apart((at - 90 + sweeps(at)) * MS, at * MS) {
                apart.push(at);
            }
        }
        (set, apart)
    }

    #[test]
    fn a_clock_that_goes_on_is_neither_set_nor_apart() {
        assert_eq!(played(|_| 0, |_| 0), (vec![], vec![]));
        // Both are off by the same, drift, or are late now and then.
        assert_eq!(played(|_| -5_000, |_| -5_000), (vec![], vec![]));
        assert_eq!(played(|at| at / 1_000, |at| at / 1_000), (vec![], vec![]));
        assert_eq!(played(|at| -(at % 700) / 5, |at| -(at % 300)), (vec![], vec![]));
    }

    #[test]
    fn a_clock_that_all_sensors_have_is_set_once() {
        for step in [-1_000, 1_000, -300, 250] {
            let stepped = |at: i64| if at < 8_000 { 0 } else { step };
            let (set, apart) = played(stepped, stepped);
            assert_eq!((set.len(), &apart[..]), (1, &[][..]), "{step}: {set:?}");
            assert!((8_000..8_100).contains(&set[0]), "{step}: {set:?}");
        }
    }

    #[test]
    fn a_clock_that_is_set_alone_parts_sweeps_from_motion_until_it_is_right_again() {
        for step in [-1_000, 1_000] {
            let stepped = |at: i64| if (8_000..14_000).contains(&at) { step } else { 0 };
            for (set, apart) in [played(stepped, |_| 0), played(|_| 0, stepped)] {
                // Of sweeps alone nothing tells a clock that was set back from sweeps that arrive late.
                if set.is_empty() && step < 0 {
                    continue;
                }
                let (first, last) = (apart.first().copied(), apart.last().copied());
                assert!(
                    first.is_some_and(|at| (8_000..9_000).contains(&at)),
                    "{step}: {set:?} {apart:?}"
                );
                assert!(
                    last.is_some_and(|at| (13_500..15_000).contains(&at)),
                    "{step}: {set:?} {apart:?}"
                );
            }
        }
    }

    #[test]
    fn clocks_that_were_never_together_are_apart() {
        let (set, apart) = played(|_| -1_000, |_| 0);
        assert_eq!((set.len(), apart.len()), (0, 196));
        // Where stamps are all that is known of arrivals, nothing shows.
        let mut clock = MotionClock::default();
        assert!((0..1_000).all(|at| !clock.sample(at * MS, at * MS) && !clock.is_apart(at * MS, at * MS)));
    }
}
