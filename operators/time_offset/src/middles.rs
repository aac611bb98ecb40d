//! When samples were taken that are means.

use realo_schemas::Nanos;

/// Samples of an IMU are this far apart until it is known, and at most so far, ns.
const PERIOD: Nanos = 10_000_000;
const LONGEST: Nanos = 50_000_000;

/// The middle of each sample that is the mean of the time since the sample before, and is stamped at its end, as those of an IMU are.
#[derive(Clone, Copy, Debug)]
pub struct Middles {
    /// From the sample before the last to the last, ns.
    period: Nanos,
    last: Option<Nanos>,
}

impl Default for Middles {
    fn default() -> Self {
        Middles {
            period: PERIOD,
            last: None,
        }
    }
}

impl Middles {
    /// The middle of the next sample, by its stamp. After a gap, samples are taken to be as far apart as before it.
    pub fn of(&mut self, stamp: Nanos) -> Nanos {
        let apart = self.last.replace(stamp).map(|last| stamp.saturating_sub(last));
        self.period = apart
            .filter(|apart| (1..=LONGEST).contains(apart))
            .unwrap_or(self.period);
        stamp.saturating_sub(self.period / 2)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn half_a_period_goes_off() {
        let mut middles = Middles::default();
        let found = [0, 4, 8, 500, 502, 502].map(|ms: Nanos| middles.of(ms * 1_000_000));
        assert_eq!(found, [-5, 2, 6, 498, 501, 501].map(|ms: Nanos| ms * 1_000_000));
    }
}
