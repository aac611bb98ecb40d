//! Whose messages were fused, and why those of others were not.

use std::cmp::Reverse;
use std::collections::BTreeSet;

use realo_operator::{Books, Loss, Meaning, NodeBooks};
use realo_schemas::Kind;
use realo_schemas::report::Fate;
use serde::{Deserialize, Serialize};

use crate::causes::{LossNotes, rank};
use crate::notes::{grouped, listed};
use crate::{LinkBooks, RunResult};

/// What is said of an agent whose messages were never used.
pub const UNUSED: &str = "no message was used";

/// What cooperation came to.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Cooperation {
    /// Runs in which somebody could cooperate with the ego.
    pub runs: u64,
    /// Those of them in which no message of a collaborator was used.
    pub in_vain: u64,
    /// Collaborators of whom nothing was used.
    pub unused: Vec<Unused>,
}

/// A collaborator of whom nothing was used.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Unused {
    /// The log; empty where it has no name.
    pub log: String,
    /// Who would have used it.
    pub ego: String,
    /// The collaborator.
    pub agent: String,
    /// Why, in words.
    pub why: String,
}

impl Cooperation {
    /// What a run's books say; `None` where its graph takes nothing from others.
    pub(crate) fn of(result: &RunResult, books: &Books) -> Option<Self> {
        let inputs = || books.nodes.values().flat_map(|node| node.inputs.values());
        let fuses = inputs().any(|input| input.accounts.iter().any(|kind| *kind != Kind::AgentState));
        if !fuses {
            return None;
        }
        let mut unused = Vec::new();
        let others = collaborators(result);
        for agent in &others {
            let books_of = books_of(result, agent);
            if !books_of.iter().any(may_be_used) {
                unused.push(Unused {
                    log: result.logs.concat(),
                    ego: result.egos.concat(),
                    why: why(agent, &books_of, result, books),
                    agent: agent.clone(),
                });
            }
        }
        Some(Cooperation {
            runs: u64::from(!others.is_empty()),
            in_vain: u64::from(!others.is_empty() && unused.len() == others.len()),
            unused,
        })
    }

    /// Adds what another run came to.
    pub fn add(&mut self, other: &Cooperation) {
        self.runs += other.runs;
        self.in_vain += other.in_vain;
        self.unused.extend(other.unused.iter().cloned());
    }

    /// Whether no run used anything of anybody.
    pub fn added_nothing(&self) -> bool {
        self.runs > 0 && self.in_vain == self.runs
    }

    pub(crate) fn notes(&self, result: &RunResult, losses: &LossNotes) -> Vec<String> {
        let of_one = |unused: &Unused| {
            let why = losses.of_unused.get(&unused.agent).unwrap_or(&unused.why);
            format!("{}: {UNUSED}: {why}", unused.agent)
        };
        let mut notes: Vec<String> = match result.runs {
            1 => self.unused.iter().map(of_one).collect(),
            _ => self.pooled().into_iter().collect(),
        };
        notes.extend(self.verdict(result));
        notes
    }

    /// What the numbers are where some or all runs used nothing of others.
    fn verdict(&self, result: &RunResult) -> Option<String> {
        if self.in_vain == 0 {
            return None;
        }
        let which = match self.runs {
            1 => String::new(),
            runs => format!(" in {} of {runs} runs", self.in_vain),
        };
        let (total, skipped) = (result.frames.total, result.frames.skipped);
        let numbers = match skipped {
            0 => "these are the numbers of the ego alone".to_string(),
            _ if result.frames.processed == 0 => {
                "the ego gave no boxes either: these numbers say nothing of fusion".into()
            }
            _ => format!(
                "these are the numbers of the ego alone, which gave no boxes for {} of {} sweeps",
                grouped(skipped),
                grouped(total)
            ),
        };
        let link = if result.frames.processed == 0 && skipped > 0 {
            "and"
        } else {
            "so"
        };
        Some(format!(
            "cooperation added nothing{which}: no message of another agent was used, {link} {numbers}"
        ))
    }

    /// Of several runs: who was not used in which of them, and why the first was not.
    fn pooled(&self) -> Option<String> {
        let first = self.unused.first()?;
        let name = |unused: &Unused| match unused.log.is_empty() {
            true => format!("{} (ego {})", unused.agent, unused.ego),
            false => format!("{} (log {}, ego {})", unused.agent, unused.log, unused.ego),
        };
        let names: Vec<String> = self.unused.iter().map(name).collect();
        let more = match names.len() {
            1 => "",
            _ => "; of the first: ",
        };
        let why = match more {
            "" => format!(": {}", first.why),
            _ => format!("{more}{}", first.why),
        };
        Some(format!(
            "no message was used of {}{why}",
            listed(&names).trim_end_matches(':')
        ))
    }
}

/// Who could cooperate with the egos: who is on the air, or who takes part in the log.
fn collaborators(result: &RunResult) -> BTreeSet<String> {
    // Names may hold a hyphen, so a link is looked up and not taken apart.
    let sends = |agent: &&String| {
        let mut egos = result.egos.iter();
        egos.any(|ego| result.links.contains_key(&format!("{agent}-{ego}")))
    };
    let mut others: BTreeSet<String> = result.agents.iter().filter(sends).cloned().collect();
    others.extend(result.peers.iter().map(|peer| peer.name.clone()));
    if !has_radio(result) {
        others.extend(result.agents.iter().cloned());
    }
    others.retain(|agent| !result.egos.contains(agent));
    others
}

fn has_radio(result: &RunResult) -> bool {
    result.nodes.values().any(|node| node.operator == "radio")
}

/// The books of what an agent sent to the egos, but for where it is.
fn books_of(result: &RunResult, agent: &str) -> Vec<LinkBooks> {
    let links = result
        .egos
        .iter()
        .filter_map(|ego| result.links.get(&format!("{agent}-{ego}")));
    let kinds = links.flatten().filter(|(kind, _)| **kind != Kind::AgentState.as_str());
    kinds.map(|(_, books)| books.clone()).collect()
}

/// What an agent sent to the egos but for where it is, and what was kept back because it was out of range.
pub(crate) fn sent_and_kept(result: &RunResult, agent: &str) -> [u64; 2] {
    let books = books_of(result, agent);
    let sum = |get: fn(&LinkBooks) -> u64| books.iter().map(get).sum();
    [sum(|books| books.sent), sum(|books| books.out_of_range)]
}

/// Messages that were not sent to an ego because somebody's position was not known.
fn unplaced(agent: &str, books: &Books) -> u64 {
    let carries = |node: &&NodeBooks| {
        let mut channels = node.channels.iter();
        channels.any(|channel| channel.from == agent && channel.kind != Kind::AgentState)
    };
    let losses = books.nodes.values().filter(carries);
    let losses = losses.filter_map(|node| node.losses.get("unplaced")?.agents.get(agent));
    losses.map(|share| share.count).sum()
}

/// Whether messages were used, or nobody says what became of some: a fusion of one's own may not tell.
fn may_be_used(books: &LinkBooks) -> bool {
    let accounted = books.accounted.iter();
    let mut accounted = accounted.map(|accounted| (accounted.fates.used, accounted.unaccounted));
    accounted.any(|(used, unaccounted)| used > 0 || unaccounted > 0)
}

/// What became of all that an agent has sent, most first.
fn why(agent: &str, books_of: &[LinkBooks], result: &RunResult, books: &Books) -> String {
    let stale = books.nodes.values().find_map(|node| node.explained.get(&Fate::Stale));
    let stale = stale.map_or("were too old", |words| words);
    let sum = |get: fn(&LinkBooks) -> u64| books_of.iter().map(get).sum::<u64>();
    let fate = |get: fn(&crate::Fates) -> u64| -> u64 {
        let accounted = books_of.iter().filter_map(|books| books.accounted);
        accounted.map(|accounted| get(&accounted.fates)).sum()
    };
    let out_of_range = sum(|books| books.out_of_range);
    let unplaced = unplaced(agent, books).min(out_of_range);
    let mut ways = [
        (
            unplaced,
            "were not sent, because the position of their sender or receiver was not known",
        ),
        (
            out_of_range - unplaced,
            "were not sent, because the agents were out of the link's range",
        ),
        (sum(|books| books.lost), "were lost on the way"),
        (fate(|fates| fates.skipped), "were skipped by a busy stage"),
        (
            fate(|fates| fates.over_limit),
            "were left out, because others were nearer and the fusion takes no more (`max_collaborators`)",
        ),
        (
            fate(|fates| fates.distrusted),
            "were left out by a guard, because the ego could not confirm them",
        ),
        (fate(|fates| fates.stale), stale),
        (
            fate(|fates| fates.superseded),
            "were superseded by newer ones before they were asked for",
        ),
        (fate(|fates| fates.rejected), "were rejected"),
        (fate(|fates| fates.in_flight), "arrived after the ego's last sweep"),
    ];
    ways.sort_by_key(|(n, _)| Reverse(*n));
    let said: Vec<String> = ways
        .iter()
        .filter(|(n, _)| *n > 0)
        .map(|(n, words)| format!("{} {words}", grouped(*n)))
        .collect();
    match said.is_empty() {
        false => said.join(", "),
        true => format!("none was sent{}", cause(agent, result)),
    }
}

/// What the agent lost before anything could be sent.
fn cause(agent: &str, result: &RunResult) -> String {
    let losses = result
        .nodes
        .iter()
        .flat_map(|(id, node)| node.losses.iter().map(move |(counter, loss)| (id, counter, loss)));
    let lost = |(id, counter, loss): (&String, &String, &Loss)| {
        let share = loss.agents.get(agent).filter(|share| share.count > 0)?;
        let note = loss.note.replace("{node}", id).replace("{agent}", agent);
        let found = loss
            .found
            .get(agent)
            .map(|words| format!(" ({words})"))
            .unwrap_or_default();
        let is_fault = loss.meaning == Meaning::LogFault;
        Some((
            (is_fault, Reverse(rank(counter)), share.count),
            format!(": {} {note}{found}", grouped(share.count)),
        ))
    };
    // What the log is the cause of goes first, of that the deepest cause, then the most.
    match losses.filter_map(lost).max_by_key(|(place, _)| *place) {
        Some((_, words)) => words,
        None if has_radio(result) => String::from(", or none came"),
        None => String::new(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Accounted, Fates, NodeSummary, Settings};

    #[test]
    fn messages_of_which_a_fusion_does_not_tell_may_be_used() {
        let books = |used, stale, unaccounted| LinkBooks {
            sent: 20,
            accounted: Some(Accounted {
                fates: Fates {
                    used,
                    stale,
                    ..Fates::default()
                },
                unaccounted,
            }),
            ..LinkBooks::default()
        };
        assert!(may_be_used(&books(1, 19, 0)));
        assert!(may_be_used(&books(0, 0, 20)));
        assert!(!may_be_used(&books(0, 20, 0)));
        assert!(!may_be_used(&LinkBooks::default()));
    }

    #[test]
    fn names_with_hyphens_are_found_by_their_links() {
        let mut result = RunResult::new(Settings::default());
        result.egos = vec!["car-1".into()];
        result.agents = ["car-1", "rsu-1", "rsu", "1"].map(String::from).to_vec();
        result.links.insert("rsu-1-car-1".into(), Default::default());
        let found = |result: &RunResult| collaborators(result).into_iter().collect::<Vec<_>>();
        assert_eq!(
            found(&result),
            ["1", "rsu", "rsu-1"],
            "without a radio all of the log may take part"
        );
        let radio = NodeSummary {
            operator: "radio".into(),
            ..NodeSummary::default()
        };
        result.nodes.insert("v2x".into(), radio);
        assert_eq!(found(&result), ["rsu-1"], "with one, who is on the air");
    }
}
