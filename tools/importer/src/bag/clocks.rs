//! How the clocks of bags differ: by what is in them, or by the map file.

use std::path::Path;

use realo_schemas::{Nanos, to_millis, to_seconds};

use super::Import;
use super::small::Small;
use crate::ImportError;

/// Stamps and log times that are nearer are of one clock, ns.
const ONE_CLOCK: Nanos = 1_000_000_000;
/// So many messages of two bags must be equal.
const LEAST_EQUAL: usize = 3;
/// Half of the offsets of equal messages must be within this of their median, ns.
const SPREAD: Nanos = 50_000_000;

/// What is added to times of an agent, ns.
#[derive(Clone, Debug, Default)]
pub struct AgentClock {
    /// To stamps.
    pub stamp: Nanos,
    /// To log times, so that they are of the clock of the stamps.
    pub ready: Nanos,
}

/// The clocks of all agents.
pub struct Clocks {
    /// By agent.
    pub agents: Vec<AgentClock>,
    /// How they were found, a line each.
    pub words: Vec<String>,
}

/// Finds the offsets between the clocks.
///
/// # Errors
/// Agents that have no time in common.
pub fn joined(import: &Import, small: &Small) -> Result<Clocks, ImportError> {
    let mut words = Vec::new();
    let by_bag: Vec<Option<Nanos>> = (0..import.bags.len())
        .map(|bag| of_bag(import, small, bag, &mut words))
        .collect();
    let behind: Vec<Nanos> = (0..import.agents.len()).map(|agent| behind(small, agent)).collect();
    let is_other = |agent: usize| behind[agent].abs() > ONE_CLOCK;
    let span = |agent: usize| {
        let heads = &small.agents[agent].heads[0].stamps;
        let first = heads.first().map_or(0, |[stamp, _]| *stamp);
        let bag = import.bags[import.agents[agent].bag].span().unwrap_or_default();
        [first, first.saturating_add(bag[1].saturating_sub(bag[0]))]
    };
    let overlap = |a: [Nanos; 2], b: [Nanos; 2]| a[0] <= b[1] && b[0] <= a[1];
    let spans: Vec<[Nanos; 2]> = (0..import.agents.len()).map(span).collect();
    let apart = spans
        .iter()
        .any(|span| spans.iter().any(|other| !overlap(*span, *other)));
    let mut agents = Vec::new();
    for (place, agent) in import.agents.iter().enumerate() {
        let name = &agent.name;
        let stamp = match (agent.map.offset, by_bag[agent.bag]) {
            (Some(seconds), _) => {
                words.push(format!("clock of `{name}`: {seconds:+.4} s by the map file"));
                (seconds * 1e9) as Nanos
            }
            (None, Some(offset)) => offset,
            (None, None) if apart && is_other(place) => {
                words.push(format!(
                    "clock of `{name}`: its stamps are {:+.3} s from its log times, and agents have no time in common by their stamps; they \
                     are taken as log time by the quickest message",
                    to_seconds(behind[place])
                ));
                behind[place]
            }
            (None, None) => 0,
        };
        // Log times of another clock than the stamps' are brought to it by the quickest message.
        let own = if is_other(place) { behind[place] } else { 0 };
        agents.push(AgentClock {
            stamp,
            ready: stamp.saturating_sub(own),
        });
    }
    let moved: Vec<[Nanos; 2]> = spans
        .iter()
        .zip(&agents)
        .map(|(span, clock)| span.map(|time| time.saturating_add(clock.stamp)))
        .collect();
    for (place, span) in moved.iter().enumerate() {
        if let Some(other) = moved[..place].iter().position(|other| !overlap(*other, *span)) {
            let [a, b] = [other, place].map(|agent| {
                let [first, last] = moved[agent];
                let name = &import.agents[agent].name;
                format!(
                    "`{name}` has sweeps from {:.3} to {:.3} s",
                    to_seconds(first),
                    to_seconds(last)
                )
            });
            let path: &Path = import.bags[import.agents[place].bag].path();
            let reason = format!(
                "expected agents with a time in common; {a}, {b}; give `offset` (s) of one of them in the map file, or `clock: log`"
            );
            return Err(ImportError::content(path, reason));
        }
    }
    let is_joined = import.agents.iter().any(|agent| agent.bag != import.agents[0].bag);
    if is_joined && words.is_empty() {
        words.push(format!(
            "clocks of the bags: taken as one by {} time; nothing in the bags says otherwise (`offset` in the map file)",
            import.map.clock.as_str()
        ));
    }
    Ok(Clocks { agents, words })
}

/// Log time less stamp of the quickest of an agent's first clouds, ns.
fn behind(small: &Small, agent: usize) -> Nanos {
    let heads = small.agents[agent].heads.iter();
    let behind = heads.flat_map(|heads| {
        heads
            .stamps
            .iter()
            .map(|[stamp, log_time]| log_time.saturating_sub(*stamp))
    });
    behind.min().unwrap_or(0)
}

/// The offset of a bag's clock that its messages say.
fn of_bag(import: &Import, small: &Small, bag: usize, words: &mut Vec<String>) -> Option<Nanos> {
    let path = import.bags[bag].path().display();
    let mut references = small.bags[bag].references.clone();
    if let Some(offset) = median(&mut references) {
        words.push(format!(
            "clock of `{path}`: {:+.3} ms by {} time references, which say how far its reference is ahead",
            to_millis(offset),
            references.len()
        ));
        return Some(offset);
    }
    if bag == 0 {
        return None;
    }
    let first = &small.bags[0].seen;
    let seen = small.bags[bag].seen.iter();
    let equal = seen.filter_map(|(hash, time)| Some(first.get(hash).copied()??.saturating_sub((*time)?)));
    let mut equal: Vec<Nanos> = equal.collect();
    let offset = median(&mut equal).filter(|_| equal.len() >= LEAST_EQUAL)?;
    let mut spread: Vec<Nanos> = equal
        .iter()
        .map(|other| other.saturating_sub(offset).saturating_abs())
        .collect();
    let spread = median(&mut spread)?;
    if spread > SPREAD {
        return None;
    }
    words.push(format!(
        "clock of `{path}`: {:+.3} ms, half of them within {:.3} ms, by {} messages that it and `{}` recorded; write `offset: 0` if the \
         stamps of both are GPS time",
        to_millis(offset),
        to_millis(spread),
        equal.len(),
        import.bags[0].path().display()
    ));
    Some(offset)
}

fn median(values: &mut [Nanos]) -> Option<Nanos> {
    values.sort_unstable();
    values.get(values.len() / 2).copied()
}
