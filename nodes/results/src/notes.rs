//! The sentences that a reader must know.

use std::cmp::Reverse;

use realo_operator::{Loss, Share};
use realo_schemas::geometry::PLAUSIBLE_BOX;
use realo_scoring::{Counts, Dropped};

use crate::causes::{LossNotes, loss_notes};
use crate::result::LOG_CUT;
use crate::{NodeSummary, RunResult};

/// So many cut logs are named; the field `logs_cut` has all.
const CUT_NAMED: usize = 5;
/// So many agents are named in a note.
const AGENTS_NAMED: usize = 5;
/// The player's counter of runs in which nobody may cooperate.
pub(crate) const RUNS_ALONE: &str = "runs_alone";
/// The player's counter of objects of the truth that no object can be.
pub(crate) const INVALID_TRUTH: &str = "invalid_truth";
/// The radio's counter of runs in which nothing came of other agents.
pub(crate) const RADIO_ALONE: &str = "alone";
/// Characters of a counter's words: those of plug-ins may be of any length.
const CHARACTERS: usize = 400;

/// All notes but those of scores: first which stages failed on messages, then the faults of the log that concern an ego, then
/// whose messages were never used, then what else is wrong with the log, what follows from that, what disturbed the run, and what was lost.
pub fn of(result: &RunResult) -> Vec<String> {
    let losses = loss_notes(result);
    [
        result.notes_of_failures(),
        losses.of_egos.clone(),
        result.notes_of_unused(&losses),
        losses.faults,
        losses.consequences,
        result.own_notes(),
        losses.others,
    ]
    .concat()
}

/// What of the truth and of the detections was not scored, because the protocol has no class for it or it is no box.
pub(crate) fn unscored(result: &RunResult) -> Vec<String> {
    let counts = result
        .accuracy
        .iter()
        .flat_map(|accuracy| accuracy.sorted.counts.values());
    let counts: Vec<Counts> = counts.filter_map(|by_iou| by_iou.values().next().copied()).collect();
    let objects = counts.iter().map(|counts| counts.total).sum();
    let detections = counts
        .iter()
        .map(|counts| counts.true_positives + counts.false_positives)
        .sum();
    let egos: Vec<String> = result
        .egos
        .iter()
        .map(|ego| plain(&realo_documents::shown(ego)))
        .collect();
    let whose = match egos.is_empty() {
        true => String::new(),
        false => format!("{}: ", listed(&egos).trim_end_matches(':')),
    };
    let truths = (
        ["objects of the ground truth", "the program that wrote the log"],
        &result.dropped_truths,
        objects,
        names_invalid_truth(result),
    );
    let boxes = (
        ["detections", "the stage that makes the final boxes"],
        &result.dropped_detections,
        detections,
        false,
    );
    let mut notes = Vec::new();
    for ([what, producer], dropped, scored, is_named) in [truths, boxes] {
        let Some(dropped) = dropped else { continue };
        let unscored = Unscored {
            what,
            producer,
            protocol: result.protocol.as_deref().unwrap_or_default(),
            whose: &whose,
            dropped,
            scored,
        };
        notes.extend(unscored.notes(is_named, result.log_faults() > 0));
    }
    notes
}

/// Objects or detections of which some were not scored.
struct Unscored<'a> {
    what: &'static str,
    /// Who can correct their numbers.
    producer: &'static str,
    protocol: &'a str,
    /// The egos, as a sentence begins with them.
    whose: &'a str,
    dropped: &'a Dropped,
    scored: u64,
}

impl Unscored<'_> {
    /// Why they were not; `is_named`: invalid ones have been named elsewhere; `is_faulty`: so have faults of the log.
    fn notes(&self, is_named: bool, is_faulty: bool) -> Vec<String> {
        let dropped = self.dropped;
        let mostly = |n: u64| n > 0 && 2 * n >= self.all();
        let mut said = Vec::new();
        if self.strange() > 0 {
            said.push(self.line(self.strange(), &self.classes()));
        }
        if dropped.invalid > 0 && !is_named {
            let why = format!(
                "no object can have such numbers; {PLAUSIBLE_BOX}: correct {}",
                self.producer
            );
            said.push(self.whose.to_string() + &self.line(dropped.invalid, &why));
        }
        if mostly(dropped.own_body) {
            let why = "they are on the ego's own body; look whether its `footprint` in the log is its outline in metres, and whether \
                       boxes are in the body frame";
            said.push(self.whose.to_string() + &self.line(dropped.own_body, why));
        }
        if mostly(dropped.outside) {
            let why = format!(
                "they are outside the range of protocol `{}`; look whether boxes are in the body frame of their agent",
                self.protocol
            );
            said.push(self.whose.to_string() + &self.line(dropped.outside, &why));
        }
        // Far objects have few points in every log; many of them do not.
        if mostly(dropped.few_points) {
            let faults = match is_faulty {
                false => "",
                true => "the faults of the log named above may be why; else ",
            };
            let why = format!(
                "the agents together have too few points on them (`min_points` of protocol `{}`); {faults}look whether the log \
                 has the points of all agents, and whether these give an object one track",
                self.protocol
            );
            said.push(self.line(dropped.few_points, &why));
        }
        said
    }

    fn strange(&self) -> u64 {
        self.dropped.classes.values().sum()
    }

    fn all(&self) -> u64 {
        let dropped = self.dropped;
        self.scored + self.strange() + dropped.invalid + dropped.outside + dropped.own_body + dropped.few_points
    }

    fn line(&self, n: u64, why: &str) -> String {
        let [n, all] = [n, self.all()].map(grouped);
        format!("{n} of {all} {} were not scored, because {why}", self.what)
    }

    /// Which classes the protocol does not know, most frequent first.
    fn classes(&self) -> String {
        let mut classes: Vec<(&String, &u64)> = self.dropped.classes.iter().collect();
        classes.sort_by_key(|(_, count)| Reverse(**count));
        let classes: Vec<String> = classes
            .iter()
            .map(|(class, count)| format!("`{}` ({})", plain(&realo_documents::shown(class)), grouped(**count)))
            .collect();
        format!(
            "protocol `{}` has no class for {}; a protocol of your own may name them (docs/reference/protocols.md)",
            self.protocol,
            listed(&classes).trim_end_matches(':')
        )
    }
}

/// Whether the player counted objects of the truth that no object can be: their note is that counter's.
fn names_invalid_truth(result: &RunResult) -> bool {
    let mut losses = result.nodes.values().flat_map(|node| node.losses.iter());
    losses.any(|(counter, loss)| counter == INVALID_TRUTH && loss.count() > 0)
}

/// A loss at a node: whose, how many, why, what to try.
pub(crate) fn sentence(node: &str, loss: &Loss) -> String {
    let agents: Vec<(&str, Share)> = agents_of(loss);
    let names: Vec<&str> = agents.iter().map(|(agent, _)| *agent).collect();
    let words = |text: &str| {
        let text = text.replace("{node}", node).replace("{agent}", &listed(&names));
        plain(&realo_documents::head(&text, CHARACTERS))
    };
    let found = |agent: &str| match loss.found.get(agent) {
        Some(words) => format!(" ({})", plain(&realo_documents::head(words, CHARACTERS))),
        None => String::new(),
    };
    let (mut note, remedy) = (words(&loss.note), words(&loss.remedy));
    let counts: Vec<String> = match agents[..] {
        [(agent, share)] => {
            note += &found(agent);
            vec![count_of(agent, share)]
        }
        _ => agents
            .iter()
            .map(|(agent, share)| count_of(agent, *share) + &found(agent))
            .collect(),
    };
    match remedy.is_empty() {
        true => format!("{} {note}", listed(&counts)),
        false => format!("{} {note}; {remedy}", listed(&counts)),
    }
}

/// Whom something was lost of; most first.
fn agents_of(loss: &Loss) -> Vec<(&str, Share)> {
    let mut agents: Vec<(&str, Share)> = loss.worth_a_note().collect();
    agents.sort_by_key(|(_, share)| Reverse(share.count));
    agents
}

/// `rsu1: 3 of 20`.
fn count_of(agent: &str, share: Share) -> String {
    let whose = match agent.is_empty() {
        true => String::new(),
        false => format!("{}: ", plain(&realo_documents::shown(agent))),
    };
    match share.of {
        0 => format!("{whose}{}", grouped(share.count)),
        of => format!("{whose}{} of {}", grouped(share.count), grouped(of)),
    }
}

/// As a terminal may have it.
fn plain(text: &str) -> String {
    text.chars().map(|c| if c.is_control() { ' ' } else { c }).collect()
}

/// The first few of a list, and how many more there are.
pub(crate) fn listed<T: AsRef<str>>(all: &[T]) -> String {
    let first: Vec<&str> = all.iter().take(AGENTS_NAMED).map(AsRef::as_ref).collect();
    match all.len() - first.len() {
        0 => first.join(", "),
        more => format!("{} and {more} more:", first.join(", ")),
    }
}

/// A number with commas.
pub(crate) fn grouped(n: u64) -> String {
    let digits = n.to_string();
    let mut text = String::new();
    for (place, digit) in digits.chars().enumerate() {
        if place > 0 && (digits.len() - place).is_multiple_of(3) {
            text.push(',');
        }
        text.push(digit);
    }
    text
}

impl RunResult {
    /// Those of its notes that stand first: which stages failed on messages, then the faults of the log that concern an ego,
    /// then whose messages were never used.
    pub fn first_notes(&self) -> [Vec<String>; 3] {
        let losses = loss_notes(self);
        let unused = self.notes_of_unused(&losses);
        [self.notes_of_failures(), losses.of_egos, unused]
    }

    /// A sentence for each stage that failed on messages; those that failed on most first.
    fn notes_of_failures(&self) -> Vec<String> {
        let failed = self.nodes.iter().filter(|(_, node)| node.errors > 0);
        let mut failed: Vec<(&String, &NodeSummary)> = failed.collect();
        failed.sort_by_key(|(_, node)| Reverse((node.failed_runs, node.errors)));
        failed.into_iter().map(|(id, node)| failure(id, node)).collect()
    }

    fn notes_of_unused(&self, losses: &LossNotes) -> Vec<String> {
        let cooperation = self.cooperation.iter();
        cooperation
            .flat_map(|cooperation| cooperation.notes(self, losses))
            .collect()
    }

    /// Several runs over a cut log (one for each ego) do not make it several.
    fn note_of_cut_logs(&self) -> Option<String> {
        let (cut, all) = (self.logs_cut.len(), self.logs.len());
        let runs = self.counter(LOG_CUT);
        let which = match cut {
            0 if runs == 0 => return None,
            // No one gave the names.
            0 if self.runs == 1 => "the log is cut".into(),
            0 => format!("{runs} of {} runs played a cut log", self.runs),
            _ if all == 1 => format!("the log {} is cut", self.logs_cut[0]),
            1..=CUT_NAMED => format!("{cut} of {all} logs are cut ({})", self.logs_cut.join(", ")),
            _ => format!(
                "{cut} of {all} logs are cut ({}, …)",
                self.logs_cut[..CUT_NAMED].join(", ")
            ),
        };
        Some(format!("{which}: what lies before the cut was played"))
    }

    /// Whose messages a fusion left out, because it takes no more.
    fn note_of_limit(&self) -> Option<String> {
        let over = self.channels().filter_map(|(link, _, books)| {
            let over = books.accounted?.fates.over_limit;
            (over > 0).then(|| format!("{} of {} of {link}", grouped(over), grouped(books.sent)))
        });
        let said: Vec<String> = over.collect();
        (!said.is_empty()).then(|| {
            format!(
                "messages were not fused, because they are beyond the collaborators that the fusion takes (`max_collaborators`, or the agents of \
                 its model) and others were nearer to the ego: {}; a higher `max_collaborators` takes more, up to the agents of the model",
                said.join(", ")
            )
        })
    }

    fn own_notes(&self) -> Vec<String> {
        let mut notes = Vec::new();
        let mut note = |condition: bool, text: String| {
            if condition {
                notes.push(text);
            }
        };
        let lost = self.transport.total_lost;
        note(
            lost > 0,
            format!("dora lost {lost} messages between nodes: the scores are those of a disturbed run"),
        );
        let cut = self.note_of_cut_logs();
        note(cut.is_some(), cut.unwrap_or_default());
        let alone = self.counter(RUNS_ALONE);
        note(
            alone > 0,
            format!(
                "in {alone} of {} runs no agent of the log may collaborate: the ego was alone",
                self.runs
            ),
        );
        let beyond = self.note_of_limit();
        note(beyond.is_some(), beyond.unwrap_or_default());
        let skipped = self.frames.skipped;
        note(
            skipped > 0,
            format!("{skipped} of {} sweeps of the ego gave no boxes", self.frames.total),
        );
        for (id, node) in &self.nodes {
            // What came and was refused says itself why.
            let is_alone = node.operator == "radio"
                && node.counters.get(RADIO_ALONE).is_some_and(|alone| *alone > 0)
                && node.losses.is_empty();
            note(
                is_alone,
                format!(
                    "node {id} (radio) took no message of another agent: look whether `{id}.connect` here or there is the other \
                     machine's address, its graph runs, and both have one `{id}.site`"
                ),
            );
        }
        for (link, kind, books) in self.channels() {
            if let Some(unaccounted) = books.accounted.map(|books| books.unaccounted).filter(|n| *n != 0) {
                note(
                    true,
                    format!(
                        "link {link}: {unaccounted} of {} {kind} messages are not accounted for, so it is not known whether they \
                         were used; a fusion of your own says so by `used` (docs/reference/plugins.md)",
                        books.sent
                    ),
                );
            }
        }
        notes
    }
}

/// What a stage failed on: how many, the first and why, what to try.
fn failure(id: &str, node: &NodeSummary) -> String {
    let (all, what) = match (node.calls, node.wakes) {
        // Gateways are also called by the network, so calls are not counted for them.
        (0, 0) => (0, "messages"),
        (calls, 0) => (calls, "messages"),
        (calls, wakes) => (calls + wakes, "calls (messages and wakes)"),
    };
    let of = match all {
        0 => String::new(),
        // The end of the stream is a call too.
        all => format!(" of {}", grouped(all.max(node.errors))),
    };
    let first = node.first_error.as_deref().map(|error| {
        let words = plain(&realo_documents::head(error, CHARACTERS));
        format!("; the first: {}", words.trim_end())
    });
    let first = first.unwrap_or_default();
    let operator = &node.operator;
    format!(
        "{id} ({operator}) failed on {}{of} {what}{first}; correct the operator, or what it is given",
        grouped(node.errors)
    )
}

#[cfg(test)]
mod tests {
    use realo_operator::Meaning;

    use super::*;
    use crate::{Samples, Settings};

    #[test]
    fn stages_that_failed_are_named_first_with_the_first_error_and_what_to_try() {
        let failed = |id: &str, errors, calls, wakes, runs| {
            let node = NodeSummary {
                operator: "mine".into(),
                errors,
                first_error: Some("input `selections`, cav1 3: no boxes".into()),
                calls,
                wakes,
                failed_runs: runs,
                ..NodeSummary::default()
            };
            (id.to_string(), node)
        };
        let mut result = RunResult::new(Settings::default());
        result.frames.total = 20;
        result.frames.skipped = 20;
        result.nodes = [
            failed("a", 3, 1_000, 500, 0),
            failed("fusion.fusion", 20, 20, 0, 1),
            failed("v2x", 2, 0, 0, 0),
        ]
        .into();
        result.conclude(&Samples::default());
        let ending = "; the first: input `selections`, cav1 3: no boxes; correct the operator, or what it is given";
        let expected = [
            format!("fusion.fusion (mine) failed on 20 of 20 messages{ending}"),
            format!("a (mine) failed on 3 of 1,500 calls (messages and wakes){ending}"),
            format!("v2x (mine) failed on 2 messages{ending}"),
            "20 of 20 sweeps of the ego gave no boxes".to_string(),
        ];
        assert_eq!(result.notes, expected);
        assert_eq!(result.first_notes().concat(), expected[..3]);
        assert!(result.has_failed_stages());
    }

    #[test]
    fn a_loss_says_whose_how_many_what_was_found_and_what_to_try() {
        let share = |agent: &str, count, of| (agent.to_string(), Share { count, of });
        let loss = |agents: &[(String, Share)]| Loss {
            meaning: Meaning::Loss,
            note: "sweeps were dropped at `{node}`".into(),
            remedy: "write poses of {agent}".into(),
            agents: agents.iter().cloned().collect(),
            found: [("a".to_string(), "poses 200 ms apart".to_string())].into(),
            ..Loss::default()
        };
        let one = sentence("ego.sync", &loss(&[share("a", 1_200, 2_000)]));
        assert_eq!(
            one,
            "a: 1,200 of 2,000 sweeps were dropped at `ego.sync` (poses 200 ms apart); write poses of a"
        );
        let two = sentence("ego.sync", &loss(&[share("a", 1, 0), share("b", 2, 2)]));
        assert_eq!(
            two,
            "b: 2 of 2, a: 1 (poses 200 ms apart) sweeps were dropped at `ego.sync`; write poses of b, a"
        );
    }

    fn run_over(log: &str) -> RunResult {
        let mut result = RunResult::new(Settings::default());
        result.logs = [log]
            .into_iter()
            .filter(|log| !log.is_empty())
            .map(String::from)
            .collect();
        let player = NodeSummary {
            counters: [(LOG_CUT.to_string(), 1)].into(),
            ..NodeSummary::default()
        };
        result.nodes.insert("player".into(), player);
        result.conclude(&Samples::default());
        result
    }

    #[test]
    fn a_cut_log_is_named() {
        let said = |result: &RunResult| result.notes.join("; ");
        assert_eq!(
            said(&run_over("a")),
            "the log a is cut: what lies before the cut was played"
        );
        assert_eq!(
            said(&run_over("")),
            "the log is cut: what lies before the cut was played"
        );
        let whole = RunResult::new(Settings::default());
        assert_eq!(whole.note_of_cut_logs(), None);
    }

    #[test]
    fn logs_are_counted_not_runs() {
        // Two egos on each of two logs; one log is cut.
        let mut pooled = RunResult::new(Settings::default());
        pooled.runs = 4;
        pooled.logs = vec!["a".into(), "b".into()];
        pooled.logs_cut = vec!["b".into()];
        pooled.nodes = run_over("b").nodes;
        pooled
            .nodes
            .get_mut("player")
            .unwrap()
            .counters
            .insert(LOG_CUT.into(), 2);
        pooled.conclude(&Samples::default());
        assert!(
            pooled.notes[0].starts_with("1 of 2 logs are cut (b): "),
            "{:?}",
            pooled.notes
        );
        pooled.logs_cut.clear();
        pooled.conclude(&Samples::default());
        assert!(
            pooled.notes[0].starts_with("2 of 4 runs played a cut log: "),
            "{:?}",
            pooled.notes
        );
        let names = |n: usize| (0..n).map(|i| format!("log{i}")).collect::<Vec<_>>();
        (pooled.logs, pooled.logs_cut) = (names(9), names(5));
        assert!(
            pooled
                .note_of_cut_logs()
                .unwrap()
                .starts_with("5 of 9 logs are cut (log0, log1, log2, log3, log4): ")
        );
        pooled.logs_cut = names(6);
        assert!(
            pooled
                .note_of_cut_logs()
                .unwrap()
                .starts_with("6 of 9 logs are cut (log0, log1, log2, log3, log4, …): ")
        );
    }
}
