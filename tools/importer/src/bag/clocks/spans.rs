//! From when to when agents have sweeps.

use std::collections::BTreeSet;

use realo_logs::cloud::CloudReader;
use realo_schemas::{Nanos, to_seconds};

use super::super::Import;
use super::super::heads::stamp_of;
use super::super::small::Small;
use crate::ImportError;

/// Two agents whose sweeps have no time in common, the earlier one first; `None` where all have one. `moves`: what is added to the
/// stamps of each agent, ns.
///
/// Clouds are read only up to the time from which all agents have sweeps.
///
/// # Errors
/// Bags that cannot be read.
pub fn apart(import: &Import, small: &Small, moves: &[Nanos]) -> Result<Option<[usize; 2]>, ImportError> {
    let firsts: Vec<Nanos> = (0..moves.len())
        .map(|agent| first(small, agent).saturating_add(moves[agent]))
        .collect();
    let Some(latest) = (0..firsts.len()).max_by_key(|agent| firsts[*agent]) else {
        return Ok(None);
    };
    for (agent, moved) in moves.iter().enumerate().filter(|(agent, _)| *agent != latest) {
        let until = firsts[latest].saturating_sub(*moved);
        if last(import, agent, until)?.is_none_or(|last| last < until) {
            return Ok(Some([agent, latest]));
        }
    }
    Ok(None)
}

/// Refuses agents whose sweeps have no time in common. `moves`: what is added to the stamps of each agent, ns.
///
/// # Errors
/// Agents without a time in common; bags that cannot be read.
pub fn have_time_in_common(import: &Import, small: &Small, moves: &[Nanos]) -> Result<(), ImportError> {
    let Some(both) = apart(import, small, moves)? else {
        return Ok(());
    };
    let mut spans = Vec::new();
    for agent in both {
        let [first, last] = [
            first(small, agent),
            last(import, agent, Nanos::MAX)?.unwrap_or_default(),
        ]
        .map(|time| to_seconds(time.saturating_add(moves[agent])));
        let name = &import.agents[agent].name;
        spans.push(format!("`{name}` has sweeps from {first:.3} to {last:.3} s"));
    }
    let path = import.joined.bags[import.agents[both[1]].bag].path();
    let reason = format!(
        "expected agents with a time in common; {}; if their clocks differ, give `offset` (s) of one of them in the map file, or `clock: log`; \
         if they drove at different times, make a log of each (`--agents NAME`)",
        spans.join(", ")
    );
    Err(ImportError::content(path, reason))
}

/// The earliest stamp of an agent's first sweeps, ns.
fn first(small: &Small, agent: usize) -> Nanos {
    let stamps = small.agents[agent].heads[0].stamps.iter();
    stamps.map(|[stamp, _]| *stamp).min().unwrap_or_default()
}

/// The latest stamp of an agent's sweeps, or the first one that is not before `until`, ns; `None` without a sweep.
fn last(import: &Import, agent: usize, until: Nanos) -> Result<Option<Nanos>, ImportError> {
    let agent = &import.agents[agent];
    let bag = &import.joined.bags[agent.bag];
    let wanted = agent.clouds[0].connection;
    let mut messages = bag.messages(&BTreeSet::from([wanted]))?;
    let mut last = None;
    while last.is_none_or(|last| last < until)
        && let Some(message) = messages.next()?
    {
        let connection = &bag.connections()[message.connection];
        let read = connection
            .reader_of(&message)
            .and_then(|mut input| CloudReader::read(&mut input));
        // Clouds that cannot be read are left out and counted later.
        if let Ok(reader) = read {
            last = last.max(Some(stamp_of(import.map.clock, reader.stamp, message.log_time)));
        }
    }
    Ok(last)
}
