use std::collections::BTreeMap;

use realo_schemas::file;
use realo_schemas::report::Peer;
use realo_scoring::{Accuracy, Dropped, Ignored, Intervals, Orders, PointsBin, RangeBin, Scores, Table, score};
use serde::{Deserialize, Serialize};

use crate::{Fates, Samples, Spread};

/// Version of the files; a reader refuses what is newer.
pub const VERSION: u32 = 1;
/// Names `result.json`.
pub const RESULT: &str = "realo/result";

/// The player's counter of runs over a cut log.
const LOG_CUT: &str = "log_truncated";
/// What the player left out of an agent, before its name.
const TOO_FAR: &str = "too_far_";
/// The player's count of an agent's intensities that did not fit into a byte, and of tracks that two agents give to
/// different objects.
const LIMITED: &str = "intensities_limited_";
const TRACKS: &str = "tracks_differ_";
/// So many cut logs are named; the field `logs_cut` has all.
const CUT_NAMED: usize = 5;

/// What a run gave: `result.json`. In virtual time it is the same bit by bit on every run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct RunResult {
    /// [`RESULT`].
    pub schema: String,
    /// [`VERSION`].
    pub version: u32,
    /// The run came to an orderly end; the file is written last and only then.
    pub complete: bool,
    /// What ended the run before its log did, such as `SIGTERM` or `Ctrl-C`; what came until then is scored.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub ended_by: Option<String>,
    /// What was run.
    #[serde(flatten)]
    pub settings: Settings,
    /// Runs that were pooled, 1 for a single one.
    pub runs: u64,
    /// Names of the logs, where they are known.
    pub logs: Vec<String>,
    /// Those of them that are cut: what lies before the cut was played.
    #[serde(default)]
    pub logs_cut: Vec<String>,
    /// The egos.
    pub egos: Vec<String>,
    /// The agents of the mode, ego first.
    pub agents: Vec<String>,
    /// Name of the evaluation's protocol; `None` without evaluation, as all that follows from it.
    pub protocol: Option<String>,
    /// Sweeps of the ego.
    pub frames: Frames,
    /// Against all objects of the mode; a key frame without boxes misses all of its objects.
    pub accuracy: Option<Orders<Accuracy>>,
    /// Against the objects that the ego alone sees; the others are ignored.
    pub accuracy_seen: Option<Orders<Accuracy>>,
    /// As `accuracy`, over the frames for which boxes came.
    pub accuracy_processed: Option<Orders<Accuracy>>,
    /// By super-class and IoU.
    pub precision_recall_by_range: Option<Table<Vec<RangeBin>>>,
    /// Recall by the ego's own points on an object.
    #[serde(default)]
    pub recall_by_points: Option<Table<Vec<PointsBin>>>,
    /// 95 % intervals by resampling logs; `None` with fewer than two.
    pub intervals: Option<Intervals>,
    /// Detections that did not count, and why.
    pub dropped_detections: Option<Dropped>,
    /// Objects that did not count, and why.
    pub dropped_truths: Option<Dropped>,
    /// What is in no view of the labels and was ignored; `None` where the protocol does not ask.
    #[serde(default)]
    pub in_no_view: Option<Ignored>,
    /// By `<from>-<to>` and kind.
    pub links: BTreeMap<String, BTreeMap<String, LinkBooks>>,
    /// Agents on other machines, as the ego knew them at the end; of pooled runs all of them.
    #[serde(default)]
    pub peers: Vec<Peer>,
    /// Ages of the data that were used.
    pub age_ms: AgeTable,
    /// What dora did not deliver, or not once and in order.
    pub transport: Transport,
    /// By node id: every node above the results.
    pub nodes: BTreeMap<String, NodeSummary>,
    /// What a reader must know.
    pub notes: Vec<String>,
}

/// What was run, as the graph was told.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Settings {
    /// Name of the graph.
    pub graph: String,
    /// `realtime`, `virtual` or `offline`.
    pub mode: String,
    /// Who collaborates: `v2v`, `v2i`, `i2i`, or empty.
    pub coop: String,
    /// The ego; of pooled runs all of them.
    pub ego: String,
    /// Profile of the link.
    pub link: String,
    /// Compute profile of virtual time.
    pub compute: String,
    /// Seed of jitter and loss.
    pub seed: String,
    /// Kernel path of the networks.
    pub isa: String,
    /// The networks: name of the model and a hash of its file and weights.
    #[serde(default)]
    pub model: String,
    /// Who brings what crosses the link to the ego's frame: `receiver`, `sender`, or empty where nobody can choose.
    #[serde(default)]
    pub project: String,
    /// The collaborators whose messages came out of the log, and in brackets where the time comes from that making them
    /// took: `measured`, or the name of a compute profile; empty where every agent computed.
    #[serde(default)]
    pub precomputed: String,
    /// Arguments changed by hand, `node.key=value`; files by their names alone.
    #[serde(default)]
    pub set: String,
}

/// Sweeps of the ego.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Frames {
    /// All.
    pub total: u64,
    /// Those that are scored.
    pub key: u64,
    /// Those for which no boxes came.
    pub skipped: u64,
    /// Scored ones for which no boxes came.
    pub key_skipped: u64,
    /// Those for which boxes came.
    pub processed: u64,
}

impl Frames {
    /// Adds the sweeps of another run.
    pub fn add(&mut self, other: &Frames) {
        self.total += other.total;
        self.key += other.key;
        self.skipped += other.skipped;
        self.key_skipped += other.key_skipped;
        self.processed += other.processed;
    }
}

/// What crossed one link, of one kind.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct LinkBooks {
    /// Messages that entered the channel.
    pub sent: u64,
    /// Their bytes.
    pub bytes: u64,
    /// Messages that the channel lost.
    pub lost: u64,
    /// Extra copies that the channel made; no messages.
    pub duplicated: u64,
    /// Messages that the range gate kept out; not part of `sent`.
    pub out_of_range: u64,
    /// What became of the others, where a fusion of the ego takes them.
    #[serde(flatten, default, skip_serializing_if = "Option::is_none")]
    pub accounted: Option<Accounted>,
}

/// The terms that, with `lost`, make up `sent`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Accounted {
    /// By what became of them.
    #[serde(flatten)]
    pub fates: Fates,
    /// `sent` - `lost` - the terms: 0, unless dora lost messages or reports between stages.
    pub unaccounted: i64,
}

impl LinkBooks {
    /// Adds what another run says of the same channel; it is accounted for only if both are.
    pub fn add(&mut self, other: &LinkBooks) {
        self.sent += other.sent;
        self.bytes += other.bytes;
        self.lost += other.lost;
        self.duplicated += other.duplicated;
        self.out_of_range += other.out_of_range;
        self.accounted = self.accounted.zip(other.accounted).map(|(mut sum, other)| {
            sum.fates.add(&other.fates);
            sum.unaccounted += other.unaccounted;
            sum
        });
    }
}

/// Ages of the data that were used, of all kinds and of each.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct AgeTable {
    /// Of all kinds.
    #[serde(flatten)]
    pub all: Spread,
    /// By kind.
    pub by_kind: BTreeMap<String, Spread>,
}

/// What dora did to messages between nodes; apart from the links' books.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Transport {
    /// By `<node>.<input>`: inputs to which something happened.
    pub edges: BTreeMap<String, EdgeBooks>,
    /// Messages that were not delivered, of all inputs.
    pub total_lost: u64,
}

/// What dora did on one edge.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct EdgeBooks {
    /// Not delivered, or too late to be put in order.
    pub lost: u64,
    /// Delivered more than once.
    pub repeated: u64,
    /// Delivered out of order, and put in order again.
    pub reordered: u64,
}

impl Transport {
    /// Adds what happened on an edge.
    pub fn add(&mut self, edge: &str, books: &EdgeBooks) {
        if *books == EdgeBooks::default() {
            return;
        }
        let sum = self.edges.entry(edge.into()).or_default();
        sum.lost += books.lost;
        sum.repeated += books.repeated;
        sum.reordered += books.reordered;
        self.total_lost += books.lost;
    }
}

/// What a node counted.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct NodeSummary {
    /// Operator or node name.
    pub operator: String,
    /// Messages that it could not take.
    pub errors: u64,
    /// The first of them, and why.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub first_error: Option<String>,
    /// Messages that it passed over because it was busy.
    pub skipped: u64,
    /// Parts of sets that never became complete.
    pub unjoined: u64,
    /// Its own counters.
    pub counters: BTreeMap<String, u64>,
}

impl NodeSummary {
    /// Adds what the same node counted in another run.
    pub fn add(&mut self, other: &NodeSummary) {
        self.operator.clone_from(&other.operator);
        self.errors += other.errors;
        self.first_error = self.first_error.take().or_else(|| other.first_error.clone());
        self.skipped += other.skipped;
        self.unjoined += other.unjoined;
        for (counter, n) in &other.counters {
            *self.counters.entry(counter.clone()).or_default() += n;
        }
    }
}

impl RunResult {
    /// The result of a run of which nothing is known yet.
    pub fn new(settings: Settings) -> Self {
        RunResult {
            schema: RESULT.into(),
            version: VERSION,
            complete: true,
            ended_by: None,
            settings,
            runs: 1,
            logs: Vec::new(),
            logs_cut: Vec::new(),
            egos: Vec::new(),
            agents: Vec::new(),
            protocol: None,
            frames: Frames::default(),
            accuracy: None,
            accuracy_seen: None,
            accuracy_processed: None,
            precision_recall_by_range: None,
            recall_by_points: None,
            intervals: None,
            dropped_detections: None,
            dropped_truths: None,
            in_no_view: None,
            links: BTreeMap::new(),
            peers: Vec::new(),
            age_ms: AgeTable::default(),
            transport: Transport::default(),
            nodes: BTreeMap::new(),
            notes: Vec::new(),
        }
    }

    /// Fills in all that follows from the samples and from what was counted: scores, ages and notes.
    pub fn conclude(&mut self, samples: &Samples) {
        self.age_ms = samples.ages();
        if self.runs == 1 && self.counter(LOG_CUT) > 0 {
            self.logs_cut.clone_from(&self.logs);
        }
        self.notes = self.own_notes();
        if let Some(evaluation) = &samples.evaluation {
            self.take_scores(score(evaluation));
        }
    }

    fn take_scores(&mut self, scores: Scores) {
        self.protocol = Some(scores.protocol);
        self.frames.key = scores.frames.key;
        self.frames.key_skipped = scores.frames.skipped;
        self.accuracy = Some(scores.accuracy);
        self.accuracy_seen = Some(scores.accuracy_seen);
        self.accuracy_processed = Some(scores.accuracy_processed);
        self.precision_recall_by_range = Some(scores.by_range);
        self.recall_by_points = Some(scores.by_points);
        self.intervals = scores.intervals;
        self.dropped_detections = Some(scores.dropped_detections);
        self.dropped_truths = Some(scores.dropped_truths);
        self.in_no_view = scores.in_no_view;
        if scores.boxes_without_truth > 0 {
            let n = scores.boxes_without_truth;
            self.notes.push(format!(
                "{n} messages with boxes have no truth of the same sweep: they are not scored"
            ));
        }
        self.notes.extend(scores.notes);
    }

    /// A counter of all nodes together, e.g. the player's `log_truncated`.
    pub fn counter(&self, name: &str) -> u64 {
        self.nodes.values().filter_map(|node| node.counters.get(name)).sum()
    }

    /// Several runs over a cut log (one for each ego) do not make it several.
    fn note_of_cut_logs(&self) -> Option<String> {
        let (cut, all) = (self.logs_cut.len(), self.logs.len());
        let runs = self.counter(LOG_CUT);
        let which = match cut {
            0 if runs == 0 => return None,
            // Nobody told the names.
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

    /// Which agents the player levelled, and by how much their bodies tilt in any log.
    fn note_of_levelled_agents(&self) -> Option<String> {
        let counters = self.nodes.values().flat_map(|node| node.counters.keys());
        let mut agents: BTreeMap<&str, f64> = BTreeMap::new();
        for (agent, tilt) in counters.filter_map(|counter| levelled(counter)) {
            let most = agents.entry(agent).or_default();
            *most = most.max(tilt);
        }
        let said: Vec<String> = agents
            .iter()
            .map(|(agent, most)| format!("{agent}, which tilts by up to {most:.2}°"))
            .collect();
        (!said.is_empty()).then(|| format!("levelled while played, by the poses of the log: {}", said.join("; ")))
    }

    /// Whose sweeps the player left out, since no fusion could take what is made of them.
    fn note_of_far_agents(&self) -> Option<String> {
        let mut agents: BTreeMap<&str, u64> = BTreeMap::new();
        for (counter, n) in self.nodes.values().flat_map(|node| &node.counters) {
            if let Some(agent) = counter.strip_prefix(TOO_FAR) {
                *agents.entry(agent).or_default() += n;
            }
        }
        let said: Vec<String> = agents
            .iter()
            .map(|(agent, n)| format!("{agent} ({n} sweeps)"))
            .collect();
        (!said.is_empty()).then(|| {
            format!(
                "not computed, and in no books, because as many others as the fusion takes were nearer to the ego: {}; the player's `fused_at_most=null` computes them",
                said.join(", ")
            )
        })
    }

    /// Counters whose names begin so, by what follows.
    fn counted(&self, prefix: &str) -> BTreeMap<&str, u64> {
        let mut counted: BTreeMap<&str, u64> = BTreeMap::new();
        for (counter, n) in self.nodes.values().flat_map(|node| &node.counters) {
            if let Some(rest) = counter.strip_prefix(prefix) {
                *counted.entry(rest).or_default() += n;
            }
        }
        counted.retain(|_, n| *n > 0);
        counted
    }

    /// What of the log's values did not fit.
    fn notes_of_values(&self) -> Vec<String> {
        let limited = self.counted(LIMITED).into_iter().map(|(agent, n)| {
            format!(
                "{agent}: {n} intensities of points did not fit and were limited to 0…255; `realo info` says how they are scaled, by \
                 the first ten sweeps: write them as bytes"
            )
        });
        let tracks = self.counted(TRACKS).into_iter().map(|(agents, n)| {
            format!(
                "tracks of {agents} name different objects ({n} positions of tracks that both have lie more than 5 m apart), so \
                 points of collaborators count for the wrong objects: give an object the same track in the truth of all agents"
            )
        });
        limited.chain(tracks).collect()
    }

    /// Whose messages came to a fusion that had taken all that it takes.
    fn note_of_limit(&self) -> Option<String> {
        let over = self.channels().filter_map(|(link, _, books)| {
            let over = books.accounted?.fates.over_limit;
            (over > 0).then(|| format!("{link} ({over} of {})", books.sent))
        });
        let said: Vec<String> = over.collect();
        (!said.is_empty()).then(|| {
            format!(
                "beyond the collaborators that the fusion takes (`max_collaborators`, or the agents of its model), which are the nearest to the ego: {}",
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
        let alone = self.counter("runs_alone");
        note(
            alone > 0,
            format!(
                "in {alone} of {} runs no agent of the log may collaborate: the ego was alone",
                self.runs
            ),
        );
        let levelled = self.note_of_levelled_agents();
        note(levelled.is_some(), levelled.unwrap_or_default());
        let far = self.note_of_far_agents();
        note(far.is_some(), far.unwrap_or_default());
        let beyond = self.note_of_limit();
        note(beyond.is_some(), beyond.unwrap_or_default());
        self.notes_of_values().into_iter().for_each(|text| note(true, text));
        let tilted = self.counter("tilted_poses");
        note(
            tilted > 0,
            format!(
                "{tilted} poses are not level and were played as they are, beside precomputed packets or since the log says that it \
                 is not to be levelled: networks look for the ground at z = 0"
            ),
        );
        let unusable = self.counter("poses_unusable");
        note(
            unusable > 0,
            format!(
                "{unusable} poses of the log were left out: expected finite numbers and a quaternion that is not zero; `realo import log` \
                 names the first"
            ),
        );
        let skipped = self.frames.skipped;
        note(
            skipped > 0,
            format!("{skipped} of {} sweeps of the ego gave no boxes", self.frames.total),
        );
        for (id, node) in self.nodes.iter().filter(|(_, node)| node.errors > 0) {
            let first = node
                .first_error
                .as_deref()
                .map(|error| format!("; the first: {}", file::shown(error)));
            let first = first.unwrap_or_default();
            note(
                true,
                format!(
                    "node {id} ({}) could not take {} messages{first}",
                    node.operator, node.errors
                ),
            );
        }
        for (id, node) in &self.nodes {
            let invalid = node.counters.get("invalid_boxes").copied().unwrap_or(0);
            note(
                invalid > 0,
                format!(
                    "node {id} ({}) left out {invalid} boxes that are not finite, have no extent or a score outside [0, 1]",
                    node.operator
                ),
            );
        }
        for (id, node) in &self.nodes {
            let is_alone = node.operator == "radio" && node.counters.get("alone").is_some_and(|alone| *alone > 0);
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
                        "link {link}: {unaccounted} of {} {kind} messages are not accounted for",
                        books.sent
                    ),
                );
            }
        }
        notes
    }

    /// Every channel: link, kind and its books.
    pub fn channels(&self) -> impl Iterator<Item = (&str, &str, &LinkBooks)> {
        self.links
            .iter()
            .flat_map(|(link, kinds)| kinds.iter().map(move |(kind, books)| (&**link, &**kind, books)))
    }
}

/// Agent and degrees of the player's counter of sweeps that it levelled, `levelled_AGENT_by_DEGREES`.
fn levelled(counter: &str) -> Option<(&str, f64)> {
    let (agent, degrees) = counter.strip_prefix("levelled_")?.rsplit_once("_by_")?;
    let degrees: f64 = degrees.parse().ok()?;
    degrees.is_finite().then_some((agent, degrees))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn agents_that_were_levelled_are_named_with_their_greatest_tilt() {
        let mut result = RunResult::new(Settings::default());
        let counters = [
            "levelled_a_by_b_by_0.40",
            "levelled_a_by_b_by_2.26",
            "levelled_mast_by_0.53",
        ];
        let player = NodeSummary {
            counters: counters.map(|counter| (counter.to_string(), 20)).into(),
            ..NodeSummary::default()
        };
        result.nodes.insert("player".into(), player);
        result.conclude(&Samples::default());
        let said = "levelled while played, by the poses of the log: a_by_b, which tilts by up to 2.26°; mast, which tilts by up to 0.53°";
        assert_eq!(result.notes, [said]);
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
