//! How long fixes supported an estimate, and for how long others that agree with each other have contradicted it since. The first seconds of a
//! drive are no better witness than the next: receivers start between buildings, too.

use nalgebra::{Matrix2, Vector2};
use realo_schemas::{Nanos, to_seconds};

/// An estimate that fixes supported for so long is believed as [`crate::Limits`] say, ns.
const KNOWN: Nanos = 10_000_000_000;
/// Other fixes outvote one that rests on less after as long a time, but not before so long, and so many.
const LEAST: (Nanos, u32) = (2_000_000_000, 5);
/// Fixes that come later after each other count as if they came so long after, ns.
const APART: Nanos = 1_000_000_000;
/// Fixes agree that are so many standard deviations of the unit apart, m.
const AGREE: f64 = 3.0;

/// What fixes say of the estimate.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Witness {
    /// How long they supported it, ns.
    support: Nanos,
    /// The last one that did.
    last: Option<Nanos>,
    against: Option<Against>,
}

/// Fixes that were refused one after the other, and agree with each other.
#[derive(Clone, Debug, PartialEq)]
struct Against {
    since: Nanos,
    last: Nanos,
    count: u32,
    /// Sum of how far off they were, m.
    sum: Vector2<f64>,
}

impl Witness {
    /// Takes a fix that was used.
    pub fn support(&mut self, stamp: Nanos) {
        let since = self.last.replace(stamp).map_or(0, |last| stamp - last);
        self.support = self.support.saturating_add(since.min(APART));
        self.against = None;
    }

    /// Takes a fix that was refused; `off`: how far, m. `unit`: standard deviation of the receiver on the ground, m.
    pub fn contradict(&mut self, stamp: Nanos, off: Vector2<f64>, unit: f64) {
        let agrees = |last: &Against| {
            let mean = last.sum / f64::from(last.count);
            stamp - last.last <= APART && (off - mean).norm() <= AGREE * unit
        };
        let against = self.against.take().filter(agrees).unwrap_or(Against {
            since: stamp,
            last: stamp,
            count: 0,
            sum: Vector2::zeros(),
        });
        self.against = Some(Against {
            last: stamp,
            count: against.count.saturating_add(1),
            sum: against.sum + off,
            ..against
        });
    }

    /// Whether fixes that contradict weigh as much as those before.
    pub fn is_outvoted(&self) -> bool {
        let (least, count) = LEAST;
        self.support < KNOWN
            && self.against.as_ref().is_some_and(|against| {
                against.count >= count && against.last - against.since >= least.max(self.support)
            })
    }

    /// What the chance that the others are right adds to the covariance of the place, m².
    pub fn doubt(&self) -> Matrix2<f64> {
        let against = self.against.as_ref().filter(|_| self.support < KNOWN);
        let Some(against) = against else {
            return Matrix2::zeros();
        };
        let [seconds, support] = [against.last - against.since, self.support].map(to_seconds);
        let chance = seconds / (seconds + support).max(to_seconds(APART));
        let off = against.sum / f64::from(against.count);
        off * off.transpose() * chance
    }
}

#[cfg(test)]
mod tests {
    use realo_schemas::from_seconds;

    use super::*;

    /// Fixes ten times a second: used for so many seconds, then refused for so many; `off`: how far at a time, m.
    fn after(used: f64, refused: f64, off: impl Fn(f64) -> f64) -> Witness {
        let mut witness = Witness::default();
        for k in 0..=(10.0 * (used + refused)) as u32 {
            let at = 0.1 * f64::from(k);
            let stamp = from_seconds(at);
            if at <= used + 1e-9 {
                witness.support(stamp);
            } else {
                witness.contradict(stamp, Vector2::new(off(at), 0.0), 1.7);
            }
        }
        witness
    }

    #[test]
    fn as_long_a_time_outvotes_a_short_one_and_nothing_a_long_one() {
        for (used, refused, expected) in [
            (5.0, 4.9, false),
            (5.0, 5.2, true),
            (0.5, 1.9, false),
            (0.5, 2.2, true),
            (10.5, 10.0, false),
            (20.0, 29.0, false),
        ] {
            assert_eq!(
                after(used, refused, |_| 10.0).is_outvoted(),
                expected,
                "{used} {refused}"
            );
        }
        // Fixes that do not agree with each other outvote nobody.
        let scattered = after(5.0, 8.0, |at| if (at as u32).is_multiple_of(2) { 10.0 } else { -10.0 });
        assert!(!scattered.is_outvoted());
    }

    #[test]
    fn doubt_grows_to_half_of_the_distance_and_none_is_left_after_long() {
        let sigma = |used, refused| after(used, refused, |_| 10.0).doubt()[(0, 0)].sqrt();
        assert_eq!(sigma(5.0, 0.0), 0.0);
        assert!(sigma(5.0, 1.0) < sigma(5.0, 3.0));
        assert!((sigma(5.0, 5.1) - 50f64.sqrt()).abs() < 0.2);
        assert_eq!(sigma(10.5, 9.0), 0.0);
    }
}
