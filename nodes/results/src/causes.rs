//! Which losses explain others: what is wrong with the log, before what follows from it.

use std::borrow::Cow;
use std::collections::{BTreeMap, BTreeSet};

use realo_operator::{Loss, Meaning, Share};

use crate::cooperation::sent_and_kept;
use crate::notes::{INVALID_TRUTH, RADIO_ALONE, RUNS_ALONE, sentence};
use crate::result::LOG_CUT;
use crate::{NodeSummary, RunResult};

/// Counters of faults of a log that explain other losses, the deepest first, each with the counters that it explains.
const CAUSES: [(&str, &[&str]); 4] = [
    (
        "clock_off",
        &[
            "no_common_time",
            "no_pose",
            "late_pose",
            "not_deskewed",
            "sweeps_missing",
            "detections_without_sweep",
            "detections_without_info",
            "truth_without_sweep",
            "unplaced",
            "no_ego_state",
        ],
    ),
    ("no_common_time", &["unplaced", "no_ego_state", "sweeps_missing"]),
    (
        "poses_unusable",
        &["no_pose", "late_pose", "not_deskewed", "unplaced", "no_ego_state"],
    ),
    ("no_pose", &["late_pose", "not_deskewed", "unplaced", "no_ego_state"]),
];
/// Faults of a log that make scores wrong: their notes stand first, and they are never why an agent was not used.
const OF_SCORES: [&str; 1] = ["truth_not_joined"];
/// Counters for which both ends of a link must have a position: they may be due to an agent other than their own.
const OF_TWO_AGENTS: [&str; 2] = ["unplaced", "no_ego_state"];

/// The counters of operators and nodes that notes know by their names.
pub fn named_counters() -> BTreeSet<&'static str> {
    let causes = CAUSES
        .iter()
        .flat_map(|(cause, explained)| explained.iter().chain([cause]));
    let others = OF_SCORES
        .iter()
        .chain(&OF_TWO_AGENTS)
        .chain(&[INVALID_TRUTH, LOG_CUT, RUNS_ALONE, RADIO_ALONE]);
    causes.chain(others).copied().collect()
}

/// How deep a cause is; the deepest is 0.
pub fn rank(counter: &str) -> usize {
    let place = CAUSES.iter().position(|(name, _)| *name == counter);
    place.unwrap_or(CAUSES.len())
}

/// The notes of all losses, by their place among the other notes.
#[derive(Default)]
pub struct LossNotes {
    /// Faults of the log that make scores wrong, then those that concern an ego.
    pub of_egos: Vec<String>,
    /// By collaborator of whom no message was used: the fault of the log that is the reason, without the agent's name.
    pub of_unused: BTreeMap<String, String>,
    /// All other faults of the log.
    pub faults: Vec<String>,
    /// Losses that follow from a fault named before.
    pub consequences: Vec<String>,
    /// Losses that the log is not the cause of.
    pub others: Vec<String>,
}

/// What was lost of one agent at one node.
struct Entry<'a> {
    node: &'a str,
    summary: &'a NodeSummary,
    counter: &'a str,
    loss: &'a Loss,
    agent: &'a str,
    share: Share,
    /// The agent whose fault explains it.
    cause: Option<&'a str>,
}

impl Entry<'_> {
    fn is_fault(&self) -> bool {
        self.loss.meaning == Meaning::LogFault
    }

    /// Whether it may follow from another entry: no more than that was lost, of the same agent or over a link of an ego.
    fn follows_from(&self, cause: &Entry, explained: &[&str], egos: &BTreeSet<&str>) -> bool {
        let is_near = self.agent == cause.agent
            || (OF_TWO_AGENTS.contains(&self.counter) && (egos.contains(cause.agent) || egos.contains(self.agent)));
        is_near && explained.contains(&self.counter) && self.share.count <= cause.share.count
    }
}

/// The notes of all losses of a run.
pub fn loss_notes(result: &RunResult) -> LossNotes {
    let egos: BTreeSet<&str> = result.egos.iter().map(String::as_str).collect();
    let mut entries = entries(result);
    find_causes(&mut entries, &egos);
    let mut notes = LossNotes::default();
    let of_unused = reasons_of_unused(result, &entries);
    for (agent, at) in &of_unused {
        let entry = &entries[*at];
        let mut loss = entry.loss.clone();
        loss.agents.retain(|other, _| other == agent);
        let said = sentence(entry.node, &loss);
        let prefix = format!("{agent}: ");
        let said = said.strip_prefix(&prefix).unwrap_or(&said).to_string();
        notes.of_unused.insert(agent.to_string(), said);
    }
    let is_left = |at: usize| !of_unused.values().any(|used| *used == at);
    let pick = |wanted: &dyn Fn(&Entry) -> bool| -> Vec<&Entry> {
        let mut picked: Vec<(usize, &Entry)> = entries
            .iter()
            .enumerate()
            .filter(|(at, entry)| is_left(*at) && wanted(entry))
            .collect();
        picked.sort_by_key(|(_, entry)| rank(entry.counter));
        picked.into_iter().map(|(_, entry)| entry).collect()
    };
    let is_cause = |entry: &Entry| entry.is_fault() && entry.cause.is_none();
    let of_scores = |entry: &Entry| is_cause(entry) && OF_SCORES.contains(&entry.counter);
    let of_ego = |entry: &Entry| is_cause(entry) && rank(entry.counter) < CAUSES.len() && egos.contains(entry.agent);
    notes.of_egos = [sentences(&pick(&of_scores)), sentences(&pick(&of_ego))].concat();
    notes.faults = sentences(&pick(&|entry| is_cause(entry) && !of_scores(entry) && !of_ego(entry)));
    // Of an agent of whom nothing was used that is said already.
    let unused = result.cooperation.iter().flat_map(|cooperation| &cooperation.unused);
    let unused: BTreeSet<&str> = unused.map(|unused| unused.agent.as_str()).collect();
    let is_said = |entry: &Entry| OF_TWO_AGENTS.contains(&entry.counter) && unused.contains(entry.agent);
    notes.consequences = sentences(&pick(&|entry| entry.cause.is_some() && !is_said(entry)));
    notes.others = sentences(&pick(&|entry| !entry.is_fault() && entry.cause.is_none()));
    notes
}

/// All that is worth a note, by node, counter and agent.
fn entries(result: &RunResult) -> Vec<Entry<'_>> {
    let losses = result.nodes.iter().flat_map(|(node, summary)| {
        let losses = summary.losses.iter();
        losses.map(move |(counter, loss)| (node, summary, counter, loss))
    });
    let losses = losses.filter(|(.., loss)| loss.meaning != Meaning::Plain);
    losses
        .flat_map(|(node, summary, counter, loss)| {
            loss.worth_a_note().map(move |(agent, share)| Entry {
                node,
                summary,
                counter,
                loss,
                agent,
                share,
                cause: None,
            })
        })
        .collect()
}

fn find_causes(entries: &mut [Entry], egos: &BTreeSet<&str>) {
    for (name, explained) in CAUSES {
        for cause in 0..entries.len() {
            if entries[cause].counter != name || entries[cause].cause.is_some() {
                continue;
            }
            let agent = entries[cause].agent;
            for at in 0..entries.len() {
                if entries[at].cause.is_none() && entries[at].follows_from(&entries[cause], explained, egos) {
                    entries[at].cause = Some(agent);
                }
            }
        }
    }
}

/// By collaborator of whom nothing was used: the entry that is the reason. Of several runs no one entry is.
fn reasons_of_unused<'a>(result: &'a RunResult, entries: &[Entry]) -> BTreeMap<&'a str, usize> {
    let unused = result.cooperation.iter().filter(|_| result.runs == 1);
    let unused = unused.flat_map(|cooperation| &cooperation.unused);
    unused
        .filter_map(|unused| {
            let agent = unused.agent.as_str();
            let faults = entries.iter().enumerate().filter(|(_, entry)| {
                let explains = match sent_and_kept(result, agent) {
                    [0, 0] => true,
                    [0, _] => rank(entry.counter) < CAUSES.len(),
                    _ => entry.counter == "no_common_time",
                };
                let is_fault = entry.is_fault() && !OF_SCORES.contains(&entry.counter);
                entry.agent == agent && is_fault && entry.cause.is_none() && explains
            });
            let deepest = faults.min_by_key(|(_, entry)| (rank(entry.counter), std::cmp::Reverse(entry.share.count)));
            Some((agent, deepest?.0))
        })
        .collect()
}

/// A sentence for each counter; nodes of one kind that say the same of it are added up.
fn sentences(entries: &[&Entry]) -> Vec<String> {
    let mut grouped: Vec<(&Entry, Loss)> = Vec::new();
    for entry in entries {
        let mut part = entry.loss.clone();
        part.agents.retain(|agent, _| agent == entry.agent);
        part.found.retain(|agent, _| agent == entry.agent);
        if let Some(cause) = entry.cause {
            part.remedy = Cow::Owned(format!("this follows from what is said of {cause} above"));
        }
        let names_node = [&part.note, &part.remedy].iter().any(|text| text.contains("{node}"));
        let same = grouped.iter_mut().find(|(known, loss)| {
            let one_place = known.node == entry.node
                || (!names_node && known.summary.operator == entry.summary.operator && known.counter == entry.counter);
            one_place && (&loss.note, &loss.remedy) == (&part.note, &part.remedy)
        });
        match same {
            Some((_, loss)) => loss.add(&part),
            None => grouped.push((entry, part)),
        }
    }
    grouped.iter().map(|(entry, loss)| sentence(entry.node, loss)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Cooperation, Samples, Settings, Unused};

    fn loss(meaning: Meaning, note: &str, agents: &[(&str, u64, u64)]) -> Loss {
        let share = |(agent, count, of): &(&str, u64, u64)| (agent.to_string(), Share { count: *count, of: *of });
        Loss {
            meaning,
            note: Cow::Owned(note.into()),
            remedy: Cow::Borrowed("look there"),
            agents: agents.iter().map(share).collect(),
            ..Loss::default()
        }
    }

    /// A node, its operator, a counter, what it means, and whose.
    type Said<'a> = (&'a str, &'a str, &'a str, Meaning, &'a [(&'a str, u64, u64)]);

    fn run(said: &[Said], unused: &[&str], skipped: u64) -> RunResult {
        let mut result = RunResult::new(Settings::default());
        result.egos = vec!["car".into()];
        (result.frames.total, result.frames.skipped, result.frames.processed) = (20, skipped, 20 - skipped);
        for (node, operator, counter, meaning, agents) in said {
            let summary = result.nodes.entry(node.to_string()).or_default();
            summary.operator = operator.to_string();
            summary.losses.insert(
                counter.to_string(),
                loss(*meaning, &format!("{counter} happened"), agents),
            );
        }
        let of = |agent: &&str| Unused {
            log: String::new(),
            ego: "car".into(),
            agent: agent.to_string(),
            why: "20 were too old".into(),
        };
        result.cooperation = Some(Cooperation {
            runs: 1,
            in_vain: u64::from(!unused.is_empty()),
            unused: unused.iter().map(of).collect(),
        });
        result.conclude(&Samples::default());
        result
    }

    use Meaning::{LogFault, Loss as Lost};

    #[test]
    fn the_clock_of_the_ego_comes_first_and_what_follows_from_it_says_so_once() {
        let result = run(
            &[
                ("ego.sync", "sync", "no_pose", LogFault, &[("car", 20, 20)]),
                ("player", "player", "clock_off", LogFault, &[("car", 52, 112)]),
                ("v2x.link", "link", "unplaced", Lost, &[("mast", 20, 20)]),
                ("v2x.state-link", "link", "unplaced", Lost, &[("mast", 20, 20)]),
            ],
            &["mast"],
            20,
        );
        let expected = [
            "car: 52 of 112 clock_off happened; look there",
            "mast: no message was used: 20 were too old",
            "cooperation added nothing: no message of another agent was used, and the ego gave no boxes either: these numbers say \
             nothing of fusion",
            "car: 20 of 20 no_pose happened; this follows from what is said of car above",
            "20 of 20 sweeps of the ego gave no boxes",
        ];
        assert_eq!(result.notes, expected);
        assert_eq!(result.first_notes().concat(), expected[..3]);
    }

    #[test]
    fn the_fault_of_an_agent_of_whom_nothing_came_is_said_with_that() {
        let result = run(
            &[
                (
                    "player",
                    "player",
                    "clock_off",
                    LogFault,
                    &[("mast", 20, 60), ("other", 1, 60)],
                ),
                (
                    "player",
                    "player",
                    "detections_without_sweep",
                    LogFault,
                    &[("mast", 20, 20)],
                ),
            ],
            &["mast"],
            3,
        );
        let expected = [
            "mast: no message was used: 20 of 60 clock_off happened; look there",
            "cooperation added nothing: no message of another agent was used, so these are the numbers of the ego alone, which \
             gave no boxes for 3 of 20 sweeps",
            "other: 1 of 60 clock_off happened; look there",
            "mast: 20 of 20 detections_without_sweep happened; this follows from what is said of mast above",
            "3 of 20 sweeps of the ego gave no boxes",
        ];
        assert_eq!(result.notes, expected);
    }

    #[test]
    fn truth_that_scores_lack_stands_first_and_is_no_reason_for_unused_messages() {
        let result = run(
            &[
                ("player", "player", "clock_off", LogFault, &[("car", 1, 60)]),
                ("player", "player", "truth_not_joined", LogFault, &[("mast", 20, 20)]),
            ],
            &["mast"],
            0,
        );
        let expected = [
            "mast: 20 of 20 truth_not_joined happened; look there",
            "car: 1 of 60 clock_off happened; look there",
            "mast: no message was used: 20 were too old",
        ];
        assert_eq!(result.notes[..3], expected);
    }

    #[test]
    fn a_fault_smaller_than_a_loss_does_not_explain_it() {
        let result = run(
            &[
                ("player", "player", "clock_off", LogFault, &[("car", 1, 112)]),
                ("ego.sync", "sync", "no_pose", LogFault, &[("car", 20, 20)]),
                ("v2x.link", "link", "unplaced", Lost, &[("mast", 20, 20)]),
                ("v2x.state-link", "link", "unplaced", Lost, &[("mast", 20, 20)]),
            ],
            &[],
            0,
        );
        let expected = [
            "car: 1 of 112 clock_off happened; look there",
            "car: 20 of 20 no_pose happened; look there",
            "mast: 40 of 40 unplaced happened; this follows from what is said of car above",
        ];
        assert_eq!(result.notes, expected);
    }

    #[test]
    fn losses_that_the_log_does_not_explain_keep_their_remedy_and_stand_last() {
        let result = run(
            &[
                ("a.nms", "nms", "invalid", Lost, &[("car", 2, 9)]),
                ("b.nms", "nms", "invalid", Lost, &[("car", 1, 9)]),
                ("ego.sync", "sync", "duplicate", LogFault, &[("car", 1, 20)]),
            ],
            &["mast"],
            0,
        );
        let expected = [
            "mast: no message was used: 20 were too old",
            "cooperation added nothing: no message of another agent was used, so these are the numbers of the ego alone",
            "car: 1 of 20 duplicate happened; look there",
            "car: 3 of 18 invalid happened; look there",
        ];
        assert_eq!(result.notes, expected);
    }
}
