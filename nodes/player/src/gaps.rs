//! Sweeps that are missing: gaps in an agent's data, and where these begin late or stop early.

use std::collections::BTreeMap;

use realo_schemas::{Name, Nanos, to_seconds};

/// Shorter gaps are no gaps, ns; nor are those of fewer periods.
const LEAST: (Nanos, Nanos) = (500_000_000, 5);

/// The sweeps of a pass so far.
#[derive(Default)]
pub struct Gaps(BTreeMap<Name, Span>);

/// The sweeps of an agent.
struct Span {
    first: Nanos,
    last: Nanos,
    /// Times between sweeps without gaps, and how many.
    steps: (Nanos, Nanos),
}

/// Sweeps that are missing.
#[derive(Debug, PartialEq)]
pub struct Missing {
    /// How many there would be.
    pub sweeps: u64,
    /// Where, in words.
    pub place: String,
}

impl Span {
    fn period(&self) -> Option<Nanos> {
        self.steps.0.checked_div(self.steps.1).filter(|period| *period > 0)
    }
}

/// How many sweeps of a period fit into a time in which there is none.
fn missing(period: Nanos, gap: Nanos) -> Option<u64> {
    let is_gap = gap > LEAST.0.max(period.saturating_mul(LEAST.1));
    is_gap.then(|| (gap + period / 2).div_euclid(period).max(1).unsigned_abs())
}

impl Gaps {
    /// Takes a sweep; says what is missing since the one before.
    pub fn sweep(&mut self, agent: &Name, stamp: Nanos) -> Option<Missing> {
        let span = self.0.entry(agent.clone()).or_insert(Span {
            first: stamp,
            last: stamp,
            steps: (0, 0),
        });
        let (step, since) = (stamp - span.last, span.last - span.first);
        if step <= 0 {
            return None;
        }
        span.last = stamp;
        let found = span.period().and_then(|period| {
            let sweeps = missing(period, step)?.saturating_sub(1).max(1);
            let place = format!(
                "none for {:.3} s, {:.3} s behind its first",
                to_seconds(step),
                to_seconds(since)
            );
            Some(Missing { sweeps, place })
        });
        if found.is_none() {
            span.steps = (span.steps.0 + step, span.steps.1 + 1);
        }
        found
    }

    /// What is missing before the first and behind the last sweeps of agents that have some while the ego has; forgets all.
    pub fn end(&mut self, ego: &Name) -> Vec<(Name, Missing)> {
        let mut spans = std::mem::take(&mut self.0);
        let Some((begin, end)) = spans.get(ego).map(|span| (span.first, span.last)) else {
            return Vec::new();
        };
        spans.retain(|_, span| span.first <= end && span.last >= begin);
        let first = spans.values().map(|span| span.first).min().unwrap_or(begin);
        let last = spans.values().map(|span| span.last).max().unwrap_or(end);
        let shortest = spans.values().filter_map(Span::period).min();
        let mut found = Vec::new();
        for (agent, span) in &spans {
            let Some(period) = span.period().or(shortest) else {
                continue;
            };
            let early = (last - span.last, "its last is", "before the last of all");
            for (gap, what, side) in [early, (span.first - first, "its first is", "behind the first of all")] {
                if let Some(sweeps) = missing(period, gap) {
                    let place = format!("{what} {:.3} s {side}", to_seconds(gap));
                    found.push((agent.clone(), Missing { sweeps, place }));
                }
            }
        }
        found
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: Nanos = 1_000_000;

    /// What is missing of agents with sweeps at these times, ms.
    fn found(agents: &[(&str, Vec<Nanos>)]) -> Vec<(String, u64, String)> {
        let mut gaps = Gaps::default();
        let mut found = Vec::new();
        for (agent, times) in agents {
            let name = Name::from(*agent);
            found.extend(
                times
                    .iter()
                    .filter_map(|time| gaps.sweep(&name, time * MS))
                    .map(|gap| (name.clone(), gap)),
            );
        }
        found.extend(gaps.end(&agents[0].0.into()));
        let plain = |(agent, gap): (Name, Missing)| (agent.to_string(), gap.sweeps, gap.place);
        found.into_iter().map(plain).collect()
    }

    fn every(period: Nanos, from: Nanos, until: Nanos) -> Vec<Nanos> {
        (from / period..until / period).map(|k| k * period).collect()
    }

    #[test]
    fn regular_sweeps_of_any_rate_have_no_gaps() {
        let slow = every(500, 0, 10_000);
        let some_lost: Vec<Nanos> = every(100, 0, 10_000)
            .into_iter()
            .filter(|time| time % 400 != 0)
            .collect();
        assert_eq!(
            found(&[("ego", every(100, 0, 10_000)), ("slow", slow), ("lossy", some_lost)]),
            []
        );
        assert_eq!(found(&[("ego", vec![0])]), []);
    }

    #[test]
    fn gaps_and_ends_say_how_much_is_missing_and_where() {
        let ego = ("ego", every(100, 0, 10_000));
        let mut broken = every(100, 0, 3_000);
        broken.extend(every(100, 5_000, 10_000));
        let said = found(&[ego.clone(), ("rsu1", broken)]);
        assert_eq!(
            said,
            [("rsu1".into(), 20, "none for 2.100 s, 2.900 s behind its first".into())]
        );
        let said = found(&[ego.clone(), ("rsu1", every(100, 2_000, 6_000))]);
        let expected = [
            ("rsu1".into(), 40, "its last is 4.000 s before the last of all".into()),
            ("rsu1".into(), 20, "its first is 2.000 s behind the first of all".into()),
        ];
        assert_eq!(said, expected);
        // Those that have no time in common are told of elsewhere; one sweep has the period of others.
        assert_eq!(found(&[ego.clone(), ("rsu1", every(100, 37_000, 40_000))]), []);
        assert_eq!(found(&[ego, ("rsu1", vec![0])])[0].1, 99);
    }
}
