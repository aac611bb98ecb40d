//! When a stage is called: each agent has a server of its own in each.

use std::collections::{BTreeMap, BTreeSet};

use realo_schemas::Nanos;

use crate::world::Said;

/// What an agent said, at some point of the graph.
#[derive(Clone, Copy, Debug)]
pub struct At<'w> {
    pub said: &'w Said,
    pub ready: Nanos,
    /// The state of the ego by which its sender brought it to the ego's frame.
    pub by: Option<&'w Said>,
}

impl<'w> At<'w> {
    pub fn log(said: &'w Said) -> Self {
        At {
            said,
            ready: said.ready,
            by: None,
        }
    }

    pub fn agent(&self) -> &'w str {
        &self.said.agent
    }

    pub fn place(&self, class: Class, port: usize) -> Place<'w> {
        (self.ready, class, port, self.agent(), self.said.seq)
    }
}

/// Order of what happens in a stage at one instant.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Class {
    ServerFree,
    State,
    Data,
    Wake,
    Query,
}

/// Place among the calls of a stage: time, class, port, agent, seq.
pub type Place<'w> = (Nanos, Class, usize, &'w str, u64);

/// The place of a call that waited for its server.
pub fn freed(at: Nanos, agent: &str) -> Place<'_> {
    (at, Class::ServerFree, 0, agent, 0)
}

/// Ports that keep everything: the calls of a stage in order. Each agent has a server of its own, so that
/// start = max(input ready, server free); who waited comes before all else of the instant in which it starts.
pub fn serve_all<'w, T>(mut arrivals: Vec<(Place<'w>, T)>, compute: Nanos) -> Vec<(Place<'w>, T)> {
    arrivals.sort_by_key(|(place, _)| *place);
    let mut free = BTreeMap::new();
    for (place, _) in &mut arrivals {
        let agent = place.3;
        let free = free.entry(agent).or_insert(Nanos::MIN);
        if *free > place.0 {
            *place = freed(*free, agent);
        }
        *free = place.0 + compute;
    }
    arrivals.sort_by_key(|(place, _)| *place);
    arrivals
}

/// What came of a port that keeps the newest of each agent.
#[derive(Default)]
pub struct Served<'w> {
    /// The calls: when they began, and what the stage was called with, ready when the call was done.
    pub calls: Vec<(Place<'w>, At<'w>)>,
    pub skipped: Vec<At<'w>>,
}

impl<'w> Served<'w> {
    pub fn done(&self) -> Vec<At<'w>> {
        self.calls.iter().map(|(_, at)| *at).collect()
    }
}

/// A port that keeps the newest of each agent.
pub fn serve_latest<'w>(arrivals: &[At<'w>], compute: Nanos) -> Served<'w> {
    let mut served = Served::default();
    let agents: BTreeSet<&str> = arrivals.iter().map(At::agent).collect();
    for agent in agents {
        let mut arrivals: Vec<At> = arrivals.iter().filter(|at| at.agent() == agent).copied().collect();
        arrivals.sort_by_key(|at| (at.ready, at.said.seq));
        let mut free = Nanos::MIN;
        let mut waiting: Option<At> = None;
        let mut call = |at: At<'w>, start: Place<'w>| {
            let ready = start.0 + compute;
            served.calls.push((start, At { ready, ..at }));
            ready
        };
        for at in arrivals {
            if let Some(first) = waiting.take_if(|_| free <= at.ready) {
                free = call(first, freed(free, first.agent()));
            }
            if free <= at.ready {
                free = call(at, at.place(Class::Data, 0));
            } else if waiting.is_some_and(|waiting| waiting.said.stamp > at.said.stamp) {
                served.skipped.push(at);
            } else {
                served.skipped.extend(waiting.replace(at));
            }
        }
        waiting.map(|last| call(last, freed(free, last.agent())));
    }
    served
}
