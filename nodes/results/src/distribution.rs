use realo_operator::Durations;
use realo_schemas::Nanos;
use serde::{Deserialize, Serialize};

/// A distribution in a few numbers, ms; `None` where nothing was measured.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Spread {
    /// Half of all are not greater.
    pub p50: Option<f64>,
    /// 95 % of all are not greater.
    pub p95: Option<f64>,
    /// 99 % of all are not greater.
    pub p99: Option<f64>,
    /// The largest.
    pub max: Option<f64>,
    /// How many.
    pub count: u64,
}

impl Spread {
    /// Of durations.
    pub fn of(durations: &Durations) -> Self {
        Spread {
            p50: millis(durations.quantile(0.5)),
            p95: millis(durations.quantile(0.95)),
            p99: millis(durations.quantile(0.99)),
            max: millis(durations.max()),
            count: durations.count(),
        }
    }

    /// Of ages.
    pub fn of_ages(ages: &Ages) -> Self {
        Spread {
            p50: millis(ages.quantile(0.5)),
            p95: millis(ages.quantile(0.95)),
            p99: millis(ages.quantile(0.99)),
            max: millis(ages.quantile(1.0)),
            count: ages.count(),
        }
    }
}

fn millis(nanos: Option<Nanos>) -> Option<f64> {
    // A division keeps 41.7 ms what it is; a product with 1e-6 does not.
    nanos.map(|nanos| nanos as f64 / 1e6)
}

/// Ages of data, which offline may be negative: the data are younger than what they are fused with.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Ages {
    /// Of ages below 0, their negatives, ns.
    #[serde(default, skip_serializing_if = "is_empty")]
    pub negative: Durations,
    /// Ages of 0 and more, ns.
    #[serde(default, skip_serializing_if = "is_empty")]
    pub positive: Durations,
}

fn is_empty(durations: &Durations) -> bool {
    durations.count() == 0
}

impl Ages {
    /// Adds an age.
    pub fn record(&mut self, age: Nanos) {
        if age < 0 {
            self.negative.record(age.saturating_neg());
        } else {
            self.positive.record(age);
        }
    }

    /// Number of ages.
    pub fn count(&self) -> u64 {
        self.negative.count() + self.positive.count()
    }

    /// The age that a share of all do not exceed, `None` without any.
    pub fn quantile(&self, share: f64) -> Option<Nanos> {
        let (younger, all) = (self.negative.count(), self.count());
        let rank = ((share * all as f64).ceil() as u64).clamp(1, all.max(1));
        match rank <= younger {
            true => nth(&self.negative, younger - rank + 1).map(|nanos| -nanos),
            false => nth(&self.positive, rank - younger),
        }
    }

    /// How far the data lie from what they are fused with, whichever is younger.
    pub fn distances(&self) -> Ages {
        let mut positive = self.positive.clone();
        positive.merge(&self.negative);
        Ages {
            negative: Durations::default(),
            positive,
        }
    }

    /// Adds all ages of another distribution.
    pub fn merge(&mut self, other: &Ages) {
        self.negative.merge(&other.negative);
        self.positive.merge(&other.positive);
    }
}

/// The `n`th duration, from 1 for the smallest.
fn nth(durations: &Durations, n: u64) -> Option<Nanos> {
    // Half a step below the n/count-quantile, so that rounding never reaches the next one.
    durations.quantile((n as f64 - 0.5) / durations.count() as f64)
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: Nanos = 1_000_000;

    fn near(found: Option<Nanos>, expected: Nanos) -> bool {
        found.is_some_and(|found| (found - expected).abs() <= expected.abs() / 500)
    }

    #[test]
    fn orders_ages_across_zero() {
        let mut ages = Ages::default();
        assert_eq!((ages.quantile(0.5), ages.count()), (None, 0));
        [-50, -20, -10, 0, 30, 40].iter().for_each(|ms| ages.record(ms * MS));
        let expected = [-50, -20, -10, 0, 30, 40];
        for (i, ms) in expected.iter().enumerate() {
            let share = (i + 1) as f64 / 6.0;
            assert!(near(ages.quantile(share), ms * MS), "{i}: {:?}", ages.quantile(share));
        }
        assert!(near(ages.quantile(0.0), -50 * MS));
        let distances = ages.distances();
        assert_eq!(distances.count(), 6);
        for (share, ms) in [(0.0, 0), (0.5, 20), (1.0, 50)] {
            assert!(near(distances.quantile(share), ms * MS), "{share}");
        }
    }

    #[test]
    fn survives_json_and_merges_exactly() {
        let (mut one, mut other, mut both) = (Ages::default(), Ages::default(), Ages::default());
        for i in 0..500 {
            let age = (i * 7919 % 997 - 300) * 123_457;
            [&mut one, &mut other][(i % 2) as usize].record(age);
            both.record(age);
        }
        let text = serde_json::to_string(&other).unwrap();
        one.merge(&serde_json::from_str(&text).unwrap());
        assert_eq!(Spread::of_ages(&one), Spread::of_ages(&both));
        assert_eq!(
            serde_json::to_string(&one).unwrap(),
            serde_json::to_string(&both).unwrap()
        );
    }

    #[test]
    fn says_milliseconds() {
        let mut durations = Durations::default();
        assert_eq!(Spread::of(&durations), Spread::default());
        durations.record(1_000);
        assert_eq!(Spread::of(&durations).max, Some(0.001));
    }
}
