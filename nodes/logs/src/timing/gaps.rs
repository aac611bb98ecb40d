//! Gaps between sweeps, and clocks that differ.

use realo_schemas::{Name, Nanos, SAME_STAMP};

use super::truth::no_common_time;
use super::{AgentTimes, stamps};
use crate::Stream;
use crate::gaps::{Gaps, SWEEPS_MISSING};

/// Agents whose sweeps have no time in common with those of an agent before them.
pub(super) fn apart(agents: &[AgentTimes]) -> Vec<String> {
    let spans = agents.iter().filter_map(|times| {
        let sweeps = stamps(times.sweeps());
        Some((&times.agent, [*sweeps.first()?, *sweeps.last()?]))
    });
    let spans: Vec<_> = spans.collect();
    let of = |index: usize| {
        let (other, span) = spans[index];
        let mut before = spans[..index].iter();
        let (one, words) = before.find_map(|(one, own)| {
            let words = no_common_time(*own, span, &format!("those of `{one}`"))?;
            Some((one, words))
        })?;
        Some(format!(
            "`{one}` and `{other}` have no time in common: the sweeps of `{other}` are apart, {words}; move stamps and log times of one \
             of them when the log is written"
        ))
    };
    (0..spans.len()).filter_map(of).collect()
}

/// Sweeps that are missing: in the middle of each agent's, and, where all have a time in common, at their beginning and end.
pub(super) fn gaps(agents: &[AgentTimes], with_ends: bool) -> Vec<String> {
    let mut gaps = Gaps::default();
    for times in agents {
        let agent = Name::from(times.agent.as_str());
        let sweeps = stamps(times.sweeps()).into_iter().map(|stamp| (stamp, true));
        let streams = [Stream::Pose, Stream::PoseTruth].into_iter();
        let poses = streams
            .flat_map(|stream| times.stamps(stream))
            .map(|stamp| (stamp, false));
        let mut all: Vec<(Nanos, bool)> = sweeps.chain(poses).collect();
        all.sort_unstable();
        for (stamp, is_sweep) in all {
            match is_sweep {
                true => gaps.sweep(&agent, stamp),
                false => gaps.pose(&agent, stamp),
            }
        }
    }
    let found = match with_ends {
        true => gaps.end(None),
        false => gaps.middle(),
    };
    let [note, remedy] = SWEEPS_MISSING;
    let of_agent = |times: &AgentTimes| {
        let own: Vec<_> = found.iter().filter(|(agent, _)| **agent == *times.agent).collect();
        let (_, first) = own.first()?;
        let lost: u64 = own.iter().map(|(_, missing)| missing.sweeps).sum();
        let all = lost + times.sweeps().len() as u64;
        let agent = &times.agent;
        Some(format!("`{agent}`: {lost} of {all} {note} ({}); {remedy}", first.place))
    };
    // Where some sweeps are of another clock, that is said already.
    let known = agents.iter().filter(|times| times.off_sweeps() == 0);
    known.filter_map(of_agent).collect()
}

/// Those that are the same as none of the others, both rising.
pub(super) fn unmatched(stamps: &[Nanos], others: &[Nanos]) -> Vec<Nanos> {
    let is_lost = |stamp: &Nanos| others.is_empty() || nearest(others, *stamp) > SAME_STAMP;
    stamps.iter().copied().filter(is_lost).collect()
}

/// How far the nearest of rising stamps lies, ns.
pub(super) fn nearest(stamps: &[Nanos], stamp: Nanos) -> Nanos {
    let next = stamps.partition_point(|other| *other < stamp);
    let around = &stamps[next.saturating_sub(1)..stamps.len().min(next + 1)];
    around
        .iter()
        .map(|other| (other - stamp).abs())
        .min()
        .unwrap_or(Nanos::MAX)
}

pub(super) fn median_gap(stamps: &[Nanos]) -> Nanos {
    let mut gaps: Vec<Nanos> = stamps.array_windows().map(|[one, next]| next - one).collect();
    gaps.sort_unstable();
    gaps.get(gaps.len() / 2).copied().unwrap_or(0)
}
