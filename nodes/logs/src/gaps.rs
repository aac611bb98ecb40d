//! Sweeps that are missing, and sweeps without detections: gaps in an agent's data, and where these begin late or stop early.
//! A time in which no agent has sweeps is none: the recording paused.

use std::collections::BTreeMap;

use realo_schemas::{Name, Nanos};

use crate::limits::{APART, POSES_MORE, SHORTEST_GAP, SHORTEST_GAP_PERIODS};
use crate::words::seconds;

/// What is said of sweeps that are missing, after how many of how many: what happened, and what to try.
pub const SWEEPS_MISSING: [&str; 2] = [
    "sweeps are missing: its data have gaps, begin late or stop early",
    "look whether its sensor or its recording stopped, and cut the log to the time that all agents have",
];
/// What is said of sweeps without detections, likewise.
pub const SWEEPS_WITHOUT_DETECTIONS: [&str; 2] = [
    "sweeps have no recorded detections, so that no boxes are fused or scored for them",
    "write `detections` for every sweep, without boxes where nothing was found",
];

/// The sweeps and poses of a pass so far.
#[derive(Default)]
pub struct Gaps {
    spans: BTreeMap<Name, Span>,
    /// By agent: stamp of the newest pose.
    poses: BTreeMap<Name, Nanos>,
    holes: Vec<Hole>,
}

/// A long time between two sweeps of an agent.
struct Hole {
    agent: Name,
    /// Stamps of the two sweeps, ns.
    from: Nanos,
    until: Nanos,
    /// The agent's time between sweeps, ns.
    period: Nanos,
    /// Whether the agent has poses in it.
    has_poses: bool,
    missing: Missing,
}

/// The sweeps of an agent.
struct Span {
    first: Nanos,
    last: Nanos,
    /// Times between sweeps without gaps, and how many.
    steps: (Nanos, Nanos),
    /// The first pose that is later than the newest sweep by more than a period.
    pose_since: Option<Nanos>,
}

/// Sweeps that are missing.
#[derive(Clone, Debug, PartialEq)]
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
    let is_gap = gap > SHORTEST_GAP.max(period.saturating_mul(SHORTEST_GAP_PERIODS));
    is_gap.then(|| (gap + period / 2).div_euclid(period).max(1).unsigned_abs())
}

impl Gaps {
    /// Takes a sweep.
    pub fn sweep(&mut self, agent: &Name, stamp: Nanos) {
        let span = self.spans.entry(agent.clone()).or_insert(Span {
            first: stamp,
            last: stamp,
            steps: (0, 0),
            pose_since: None,
        });
        let (from, step, since) = (span.last, stamp - span.last, span.last - span.first);
        if step <= 0 {
            return;
        }
        span.last = stamp;
        let pose = span.pose_since.take();
        let found = span.period().and_then(|period| {
            let sweeps = missing(period, step)?.saturating_sub(1).max(1);
            let place = format!("none for {} s, {} s after its first", seconds(step), seconds(since));
            Some(Hole {
                agent: agent.clone(),
                from,
                until: stamp,
                period,
                has_poses: pose.is_some_and(|pose| pose < stamp - period),
                missing: Missing { sweeps, place },
            })
        });
        match found {
            Some(hole) => self.holes.push(hole),
            None => span.steps = (span.steps.0 + step, span.steps.1 + 1),
        }
    }

    /// Takes a pose.
    pub fn pose(&mut self, agent: &Name, stamp: Nanos) {
        let newest = self.poses.entry(agent.clone()).or_insert(stamp);
        *newest = stamp.max(*newest);
        let Some(span) = self.spans.get_mut(agent) else { return };
        if span.period().is_some_and(|period| stamp > span.last + period) {
            span.pose_since.get_or_insert(stamp);
        }
    }

    /// What is missing between sweeps of an agent while others have some or its own poses go on.
    pub fn middle(&self) -> Vec<(Name, Missing)> {
        let is_lost = |hole: &&Hole| hole.has_poses || self.spans.keys().any(|other| self.goes_on(other, hole));
        let lost = self.holes.iter().filter(is_lost);
        lost.map(|hole| (hole.agent.clone(), hole.missing.clone())).collect()
    }

    /// Whether another agent has sweeps in a hole.
    fn goes_on(&self, other: &Name, hole: &Hole) -> bool {
        if *other == hole.agent {
            return false;
        }
        let covers = |own: &Hole| {
            let slack = hole.period.max(own.period);
            own.agent == *other && own.from <= hole.from + slack && own.until >= hole.until - slack
        };
        self.spans.get(other).is_some_and(|span| {
            span.first < hole.until - hole.period
                && span.last > hole.from + hole.period
                && !self.holes.iter().any(covers)
        })
    }

    /// What is missing in the [middle](Gaps::middle), and before the first and after the last sweeps of agents that have some
    /// while `ego` has, or of all; forgets all. An agent's own poses tell too that its sweeps stopped.
    pub fn end(&mut self, ego: Option<&Name>) -> Vec<(Name, Missing)> {
        let mut found = self.middle();
        let Gaps { mut spans, poses, .. } = std::mem::take(self);
        if let Some(ego) = ego {
            let Some((begin, end)) = spans.get(ego).map(|span| (span.first, span.last)) else {
                return found;
            };
            spans.retain(|_, span| span.first - end <= APART && begin - span.last <= APART);
        }
        let first = spans.values().map(|span| span.first).min().unwrap_or_default();
        let last = spans.values().map(|span| span.last).max().unwrap_or_default();
        let shortest = spans.values().filter_map(Span::period).min();
        for (agent, span) in &spans {
            let Some(period) = span.period().or(shortest) else {
                continue;
            };
            let newest_pose = poses.get(agent).copied().unwrap_or(last);
            let by_poses = newest_pose.saturating_sub(POSES_MORE);
            let early = match by_poses > last {
                true => {
                    let more = seconds(newest_pose - span.last);
                    (
                        by_poses - span.last,
                        format!("its last is {more} s earlier than its last pose"),
                    )
                }
                false => {
                    let gap = last - span.last;
                    (
                        gap,
                        format!("its last is {} s earlier than the last of all", seconds(gap)),
                    )
                }
            };
            let begins = span.first - first;
            let late = (
                begins,
                format!("its first is {} s later than the first of all", seconds(begins)),
            );
            for (gap, place) in [early, late] {
                if let Some(sweeps) = missing(period, gap) {
                    found.push((agent.clone(), Missing { sweeps, place }));
                }
            }
        }
        found
    }
}

/// The sweeps of an agent for which no detections have come yet.
#[derive(Default)]
pub struct Bare {
    /// When each is ready, by its stamp.
    open: BTreeMap<Nanos, Nanos>,
    all: u64,
    /// The longest time from a sweep to its detections, ns.
    delay: Nanos,
}

/// Sweeps without detections.
#[derive(Debug, PartialEq)]
pub struct Lack {
    /// How many.
    pub count: u64,
    /// Of so many.
    pub of: u64,
    /// Which is the first, in words.
    pub place: String,
}

impl Bare {
    /// Takes a sweep.
    pub fn sweep(&mut self, stamp: Nanos, ready: Nanos) {
        self.open.insert(stamp, ready);
        self.all += 1;
    }

    /// Takes detections.
    pub fn detections(&mut self, stamp: Nanos, ready: Nanos) {
        if let Some(of_sweep) = crate::same(&self.open, stamp).and_then(|at| self.open.remove(&at)) {
            self.delay = self.delay.max(ready.saturating_sub(of_sweep));
        }
    }

    /// What is missing when all messages until a log time, inclusive, were taken. Those of the last sweeps may have come later, by the
    /// delay of the others. `elsewhere`: detections of the agent that belong to no sweep, of which that is said already.
    pub fn end(&self, end: Nanos, elsewhere: u64) -> Option<Lack> {
        let is_over = |(_, ready): &(&Nanos, &Nanos)| ready.saturating_add(self.delay) <= end;
        let mut lost = self.open.iter().filter(is_over).map(|(stamp, _)| *stamp);
        let first = lost.next()?;
        let count = 1 + lost.count() as u64;
        (count > elsewhere).then(|| Lack {
            count,
            of: self.all,
            place: format!("the first at {} s", seconds(first)),
        })
    }
}

#[cfg(test)]
mod tests {
    use realo_schemas::SAME_STAMP;

    use super::*;

    const MS: Nanos = 1_000_000;

    /// What is missing of agents with sweeps at these times, ms.
    fn found(agents: &[(&str, Vec<Nanos>)]) -> Vec<(String, u64, String)> {
        let mut gaps = Gaps::default();
        for (agent, times) in agents {
            let name = Name::from(*agent);
            times.iter().for_each(|time| gaps.sweep(&name, time * MS));
        }
        let found = gaps.end(Some(&agents[0].0.into()));
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
            [("rsu1".into(), 20, "none for 2.100 s, 2.900 s after its first".into())]
        );
        let said = found(&[ego.clone(), ("rsu1", every(100, 2_000, 6_000))]);
        let expected = [
            (
                "rsu1".into(),
                40,
                "its last is 4.000 s earlier than the last of all".into(),
            ),
            (
                "rsu1".into(),
                20,
                "its first is 2.000 s later than the first of all".into(),
            ),
        ];
        assert_eq!(said, expected);
        // Those that have no time in common are named elsewhere; one sweep has the period of others.
        assert_eq!(found(&[ego.clone(), ("rsu1", every(100, 37_000, 40_000))]), []);
        assert_eq!(found(&[ego, ("rsu1", vec![0])])[0].1, 99);
    }

    #[test]
    fn a_pause_of_the_recording_is_no_gap_but_of_agents_whose_poses_go_on() {
        let with_pause = |period: Nanos, from: Nanos| -> Vec<Nanos> {
            let all = every(period, 0, 10_000).into_iter();
            all.filter(|time| *time < from || *time >= from + 2_300).collect()
        };
        let both = [("ego", with_pause(100, 3_000)), ("rsu1", with_pause(50, 3_040))];
        assert_eq!(found(&both), []);
        assert_eq!(found(&both[..1]), []);
        // Who pauses longer than the others misses sweeps, and so does who has none while only one of them pauses.
        let longer = [("ego", with_pause(100, 3_000)), ("rsu1", with_pause(50, 4_000))];
        assert_eq!(found(&longer).len(), 2);

        let ego = Name::from("ego");
        let of_poses = |poses: &[Nanos]| {
            let mut gaps = Gaps::default();
            for time in every(10, 0, 10_000) {
                if poses.contains(&time) {
                    gaps.pose(&ego, time * MS);
                }
                if time % 100 == 0 && !(3_000..5_300).contains(&time) {
                    gaps.sweep(&ego, time * MS);
                }
            }
            gaps.end(None).len()
        };
        assert_eq!(of_poses(&every(100, 0, 3_000)), 0);
        assert_eq!(of_poses(&[2_900, 5_250, 5_300]), 0);
        assert_eq!(of_poses(&every(10, 0, 10_000)), 1);
    }

    #[test]
    fn an_agents_own_poses_tell_that_its_sweeps_stopped() {
        let said = |poses_until: Nanos| {
            let (mut gaps, ego) = (Gaps::default(), Name::from("ego"));
            every(100, 0, 2_000)
                .into_iter()
                .for_each(|time| gaps.sweep(&ego, time * MS));
            every(50, 0, poses_until)
                .into_iter()
                .for_each(|time| gaps.pose(&ego, time * MS));
            gaps.end(None)
        };
        assert_eq!(said(3_000), []);
        let found = said(4_000);
        assert_eq!((found.len(), found[0].1.sweeps), (1, 11));
        assert_eq!(found[0].1.place, "its last is 2.050 s earlier than its last pose");
    }

    #[test]
    fn sweeps_without_detections_are_counted_but_for_those_whose_may_come_later() {
        let lack = |has: fn(&Nanos) -> bool, delay: Nanos, elsewhere: u64| {
            let mut bare = Bare::default();
            for time in every(100, 0, 2_000) {
                bare.sweep(time * MS, (time + 90) * MS);
            }
            for time in every(100, 0, 2_000).into_iter().filter(has) {
                bare.detections(time * MS + SAME_STAMP, (time + 90 + delay) * MS);
            }
            bare.end(2_000 * MS, elsewhere)
                .map(|lack| (lack.count, lack.of, lack.place))
        };
        let first: fn(&Nanos) -> bool = |time| *time < 1_800;
        assert_eq!(lack(first, 0, 0), Some((2, 20, "the first at 1.800 s".into())));
        assert_eq!(lack(first, 50, 0).map(|lack| lack.0), Some(1));
        assert_eq!(lack(first, 150, 0), None);
        let holes: fn(&Nanos) -> bool = |time| !(500..800).contains(time);
        assert_eq!(lack(holes, 50, 2), Some((3, 20, "the first at 0.500 s".into())));
        assert_eq!(lack(holes, 50, 3), None, "these are said already");
    }
}
