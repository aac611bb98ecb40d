//! Which sweeps of collaborators no fusion can take, for a fusion takes the nearest and enough others are nearer for certain.
//!
//! That is only so where every message arrives at once: whoever sets the setting `fused_at_most` has to know.

use realo_logs::{Entry, Log, LogError, Stream};
use realo_schemas::{Name, Nanos, OFFLINE_REACH};

/// Positions are kept so far apart, ns.
const STEP: Nanos = 40_000_000;
/// Positions are known between two that are no farther apart than this, ns.
const GAP: Nanos = 300_000_000;
/// What a position may differ by from the one that a message has, m.
const SLACK: f64 = 1.0;
/// A message is taken for certain up to this age, ns; a bank's window is not shorter.
const AGE: Nanos = 300_000_000;
/// A message is not taken at a greater age, ns; a bank's window is not longer.
const ASKED: Nanos = 500_000_000;

/// When and where agents are, and how many collaborators a fusion takes.
pub struct Nearest {
    limit: usize,
    offline: bool,
    /// By rank, the ego's first.
    tracks: Vec<Track>,
}

#[derive(Default)]
struct Track {
    /// By rising stamps: where in `map`, m.
    positions: Vec<(Nanos, [f64; 2])>,
    /// Stamps and times at which sweeps are ready, by rising stamps.
    sweeps: Vec<[Nanos; 2]>,
}

impl Nearest {
    /// Reads poses and times of sweeps; `None` where the log does not say when sweeps were without their points.
    pub fn read(
        log: &Log,
        agents: &[Name],
        limit: usize,
        offline: bool,
        poses: impl Fn(&str) -> Stream,
    ) -> Result<Option<Self>, LogError> {
        if !agents.iter().all(|agent| log.has(agent, Stream::Sweeps)) {
            return Ok(None);
        }
        let wanted = agents
            .iter()
            .flat_map(|agent| [(&**agent, poses(agent)), (&**agent, Stream::Sweeps)]);
        let wanted: Vec<(&str, Stream)> = wanted.collect();
        let mut reader = log.read(&wanted, Nanos::MIN, Nanos::MAX)?;
        let mut tracks: Vec<Track> = agents.iter().map(|_| Track::default()).collect();
        while let Some(entry) = reader.next()? {
            if let Some(rank) = agents.iter().position(|agent| *agent == entry.agent) {
                tracks[rank].add(&entry);
            }
        }
        for track in &mut tracks {
            track.sweeps.sort_unstable();
        }
        Ok(Some(Nearest { limit, offline, tracks }))
    }

    /// Whether a sweep of a collaborator is for nobody: at each sweep of the ego that could take it, others are nearer for certain,
    /// as many as a fusion takes.
    pub fn is_too_far(&self, rank: usize, stamp: Nanos, ready: Nanos) -> bool {
        let mut asked = self.asking(stamp, ready).peekable();
        rank > 0 && asked.peek().is_some() && asked.all(|query| self.enough_are_nearer(rank, stamp, query))
    }

    /// The ego's sweeps that could take a sweep of another agent.
    fn asking(&self, stamp: Nanos, ready: Nanos) -> impl Iterator<Item = [Nanos; 2]> {
        let sweeps = self.tracks[0].sweeps.iter();
        sweeps.copied().filter(move |query| match self.offline {
            true => (query[0] - stamp).abs() <= OFFLINE_REACH,
            false => query[1] >= ready && query[1] <= stamp.saturating_add(ASKED),
        })
    }

    /// Whether, when the ego asks, as many others as a fusion takes have messages and are nearer than an agent at a stamp.
    fn enough_are_nearer(&self, rank: usize, stamp: Nanos, query: [Nanos; 2]) -> bool {
        let Some(own) = self.distance(rank, stamp, query[0]) else {
            return false;
        };
        let is_nearer = |other: usize| {
            self.farthest(other, query)
                .is_some_and(|most| most + SLACK < own - SLACK)
        };
        let others = (1..self.tracks.len()).filter(|other| *other != rank && is_nearer(*other));
        others.take(self.limit).count() == self.limit
    }

    /// The largest distance of an agent at the stamps of those of its messages that may be fused when the ego asks; `None`
    /// where none is there for certain.
    fn farthest(&self, rank: usize, [stamp, ready]: [Nanos; 2]) -> Option<f64> {
        let track = &self.tracks[rank];
        let first = track
            .sweeps
            .partition_point(|sweep| sweep[0] < stamp.saturating_sub(2 * AGE));
        let sweeps = track.sweeps[first..]
            .iter()
            .take_while(|sweep| sweep[0] <= ready.max(stamp) + OFFLINE_REACH);
        let there = sweeps.filter(|[own, own_ready]| match self.offline {
            true => (own - stamp).abs() <= OFFLINE_REACH,
            false => *own_ready <= ready && ready - own <= AGE,
        });
        let distances: Option<Vec<f64>> = there.map(|[own, _]| self.distance(rank, *own, stamp)).collect();
        distances?.into_iter().reduce(f64::max)
    }

    /// From where the ego is at the stamp of its sweep to where an agent is at the stamp of its own, m.
    fn distance(&self, rank: usize, stamp: Nanos, ego_stamp: Nanos) -> Option<f64> {
        let (ego, other) = (self.tracks[0].at(ego_stamp)?, self.tracks[rank].at(stamp)?);
        Some((ego[0] - other[0]).hypot(ego[1] - other[1]))
    }
}

impl Track {
    fn add(&mut self, entry: &Entry) {
        if entry.stream == Stream::Sweeps {
            return self.sweeps.push([entry.stamp(), entry.ready()]);
        }
        let is_apart = |(last, _): &(Nanos, _)| entry.stamp() >= last + STEP;
        if let Some(state) = entry.pose().ok().filter(|_| self.positions.last().is_none_or(is_apart)) {
            let place = state.map_from_body.translation;
            self.positions.push((entry.stamp(), [place.x, place.y]));
        }
    }

    /// Where the agent is at a stamp.
    fn at(&self, stamp: Nanos) -> Option<[f64; 2]> {
        let next = self.positions.partition_point(|(known, _)| *known < stamp);
        let (before, after) = (
            next.checked_sub(1).map(|at| self.positions[at]),
            self.positions.get(next).copied(),
        );
        match (before, after) {
            (Some((from, a)), Some((to, b))) if to - from <= GAP => {
                let share = (stamp - from) as f64 / (to - from) as f64;
                Some([0, 1].map(|axis| a[axis] + share * (b[axis] - a[axis])))
            }
            _ => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: Nanos = 1_000_000;

    /// An agent with a sweep every 100 ms, that is at x + speed · t.
    fn track(x: f64, speed: f64, phase: Nanos) -> Track {
        let stamps = |step: Nanos| (0..6_000 / step).map(move |k| k * step * MS);
        let at = |stamp: Nanos| [x + speed * (stamp as f64 / 1e9), 0.0];
        Track {
            positions: stamps(50).map(|stamp| (stamp, at(stamp))).collect(),
            sweeps: stamps(100)
                .map(|stamp| [stamp + phase, stamp + phase + 50 * MS])
                .collect(),
        }
    }

    fn far(nearest: &Nearest, rank: usize) -> Vec<bool> {
        let sweeps = nearest.tracks[rank].sweeps.iter();
        sweeps
            .map(|[stamp, ready]| nearest.is_too_far(rank, *stamp, *ready))
            .collect()
    }

    fn nearest(limit: usize, offline: bool, others: Vec<Track>) -> Nearest {
        let mut tracks = vec![track(0.0, 0.0, 0)];
        tracks.extend(others);
        Nearest { limit, offline, tracks }
    }

    #[test]
    fn who_is_farther_than_enough_others_at_every_sweep_is_too_far() {
        for offline in [false, true] {
            let all = || {
                vec![
                    track(10.0, 0.0, 20 * MS),
                    track(-25.0, 0.0, 30 * MS),
                    track(60.0, 0.0, 10 * MS),
                ]
            };
            let two = nearest(2, offline, all());
            let middle = |far: Vec<bool>| far[10..40].to_vec();
            for (rank, expected) in [(1, false), (2, false), (3, true)] {
                assert_eq!(
                    middle(far(&two, rank)),
                    [expected; 30],
                    "rank {rank}, offline {offline}"
                );
            }
            assert!(!far(&nearest(3, offline, all()), 3).contains(&true), "all are taken");
            assert!(!far(&two, 0).contains(&true), "the ego is no collaborator");
        }
    }

    #[test]
    fn whoever_may_be_fused_is_played() {
        // As far as another within the slack.
        let close = nearest(1, false, vec![track(30.0, 0.0, 0), track(31.5, 0.0, 0)]);
        assert!(!far(&close, 2).contains(&true));
        // It comes nearer than the other after two and a half seconds.
        let passing = nearest(1, false, vec![track(40.0, 0.0, 0), track(90.0, -20.0, 0)]);
        let away = far(&passing, 2);
        assert!(
            away[8..20].iter().all(|far| *far) && !away[24..].contains(&true),
            "{away:?}"
        );
        // The other one falls silent for a second.
        let mut silent = track(10.0, 0.0, 0);
        silent
            .sweeps
            .retain(|[stamp, _]| !(2_000 * MS..3_000 * MS).contains(stamp));
        let gap = far(&nearest(1, false, vec![silent, track(60.0, 0.0, 0)]), 2);
        assert!(
            gap[5..15].iter().all(|far| *far) && !gap[18..29].contains(&true) && gap[35],
            "{gap:?}"
        );
        // Nobody knows where the other one is.
        let mut lost = track(10.0, 0.0, 0);
        lost.positions.truncate(20);
        let lost = far(&nearest(1, false, vec![lost, track(60.0, 0.0, 0)]), 2);
        assert!(!lost[10..].contains(&true), "{lost:?}");
    }
}
