mod books;
mod boxes;

use std::collections::BTreeMap;

use realo_operator::{Counts, Loss, Meaning};
use realo_schemas::report::{Peer, SensorClock};
use realo_scoring::{
    Accuracy, Dropped, Ignored, Intervals, LocalizationScores, Orders, PointsBin, RangeBin, Scores, Table, TrackScores,
    score,
};
use serde::{Deserialize, Serialize};

use crate::cooperation::Cooperation;
use crate::notes::sentence;
use crate::sink::happened;
use crate::{Samples, Spread, notes};
pub use books::{Accounted, EdgeBooks, LinkBooks, Transport};
pub use boxes::FinalBoxes;

/// Version of the files; a reader refuses what is newer.
pub const VERSION: u32 = 2;
/// Names `result.json`.
pub const RESULT: &str = "realo/result";

/// The player's counter of runs over a cut log.
pub(crate) const LOG_CUT: &str = "log_truncated";

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
    /// Boxes that the graph's last stage sent; `None` where no list of boxes came, or the run was made after the fact.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub boxes: Option<FinalBoxes>,
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
    /// Identities and velocities by super-class; `None` where detections or objects have no identities.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub tracking: Option<BTreeMap<String, TrackScores>>,
    /// By agent, how well it knew where it was; `None` where no pose was estimated.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub localization: Option<BTreeMap<String, LocalizationScores>>,
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
    /// What cooperation came to; `None` where nothing of others is fused.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub cooperation: Option<Cooperation>,
    /// Agents on other machines, as the ego knew them at the end; of pooled runs all of them.
    #[serde(default)]
    pub peers: Vec<Peer>,
    /// The clocks of agents' sensors, by agent and sensor, as they were found at the end.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub clocks: Vec<SensorClock>,
    /// Ages of the data that were used.
    pub age_ms: AgeTable,
    /// What dora did not deliver, or not once and in order.
    pub transport: Transport,
    /// By node id: every node above the results.
    pub nodes: BTreeMap<String, NodeSummary>,
    /// What a reader must know.
    pub notes: Vec<String>,
}

/// What was run, with the settings that the graph got.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Settings {
    /// Name of the graph.
    pub graph: String,
    /// A hash of the graph as it was run: stages, wires and settings, but for what other settings say and where files lie;
    /// empty where nobody prepared the run.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub graph_hash: String,
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
    /// Where poses were estimated from: `gnss` or `map`, with the map's name and hash; empty where the log gave them.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub pose_source: String,
    /// The collaborators whose messages came out of the log, and in brackets where the time comes from that making them
    /// took: `measured`, or the name of a compute profile; empty where every agent computed.
    #[serde(default)]
    pub precomputed: String,
    /// Settings changed by hand, `stage.key=value`; files by their names, with a hash.
    #[serde(default)]
    pub set: String,
    /// Plug-ins, `stage=name-hash`; empty where every stage is realo's.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub programs: String,
    /// Seconds of log time per second of a realtime run that had `--rate`; empty otherwise.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub rate: String,
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

/// Ages of the data that were used, of all kinds and of each.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct AgeTable {
    /// Of all kinds.
    #[serde(flatten)]
    pub all: Spread,
    /// By kind.
    pub by_kind: BTreeMap<String, Spread>,
}

/// What a node counted.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct NodeSummary {
    /// Operator or node name.
    pub operator: String,
    /// Calls that failed: by a message that the operator could not take (several that it takes together are one call), a wake
    /// or the end of the stream.
    pub errors: u64,
    /// The first of them, and why.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub first_error: Option<String>,
    /// Calls by messages, of an operator.
    #[serde(default)]
    pub calls: u64,
    /// Calls by wakes, of an operator.
    #[serde(default)]
    pub wakes: u64,
    /// Runs in which the operator failed on half of its messages or more, or failed and sent nothing at all.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub failed_runs: u64,
    /// Messages that it skipped because it was busy.
    pub skipped: u64,
    /// The same by input, where there are any.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub skipped_at: BTreeMap<String, u64>,
    /// Messages that it sent, by output.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub sent: BTreeMap<String, u64>,
    /// Parts of sets that never became complete.
    pub unjoined: u64,
    /// Its own counters.
    pub counters: BTreeMap<String, u64>,
    /// More about those of them that are losses.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub losses: BTreeMap<String, Loss>,
}

fn is_zero(number: &u64) -> bool {
    *number == 0
}

impl NodeSummary {
    /// What was lost at an operator that ran outside of a graph.
    pub fn of_losses(operator: &str, counts: Counts) -> NodeSummary {
        let losses = counts.losses.into_iter();
        NodeSummary {
            operator: operator.into(),
            losses: losses
                .filter_map(|(counter, loss)| happened((&counter.into_owned(), &loss)))
                .collect(),
            ..NodeSummary::default()
        }
    }

    /// A sentence for each fault of the log that it counted.
    pub fn fault_notes(&self) -> Vec<String> {
        let faults = self.losses.values().filter(|loss| loss.meaning == Meaning::LogFault);
        faults.map(|loss| sentence(&self.operator, loss)).collect()
    }

    /// Adds what the same node counted in another run.
    pub fn add(&mut self, other: &NodeSummary) {
        self.operator.clone_from(&other.operator);
        self.errors += other.errors;
        self.first_error = self.first_error.take().or_else(|| other.first_error.clone());
        self.calls += other.calls;
        self.wakes += other.wakes;
        self.failed_runs += other.failed_runs;
        self.skipped += other.skipped;
        self.unjoined += other.unjoined;
        for (sum, more) in [(&mut self.skipped_at, &other.skipped_at), (&mut self.sent, &other.sent)] {
            more.iter()
                .for_each(|(port, n)| *sum.entry(port.clone()).or_default() += n);
        }
        for (counter, n) in &other.counters {
            *self.counters.entry(counter.clone()).or_default() += n;
        }
        for (counter, loss) in &other.losses {
            self.losses.entry(counter.clone()).or_default().add(loss);
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
            boxes: None,
            accuracy: None,
            accuracy_seen: None,
            accuracy_processed: None,
            precision_recall_by_range: None,
            recall_by_points: None,
            tracking: None,
            localization: None,
            intervals: None,
            dropped_detections: None,
            dropped_truths: None,
            in_no_view: None,
            links: BTreeMap::new(),
            cooperation: None,
            peers: Vec::new(),
            clocks: Vec::new(),
            age_ms: AgeTable::default(),
            transport: Transport::default(),
            nodes: BTreeMap::new(),
            notes: Vec::new(),
        }
    }

    /// Adds what is known of a clock by another run: of each sensor of an agent there is one entry, in the order of their names.
    pub fn add_clock(&mut self, clock: &SensorClock) {
        self.clock(clock, SensorClock::add);
    }

    /// Takes in what another stage of the same run knows of a clock.
    pub fn join_clock(&mut self, clock: &SensorClock) {
        self.clock(clock, SensorClock::join);
    }

    fn clock(&mut self, clock: &SensorClock, with: fn(&mut SensorClock, &SensorClock)) {
        let of = |clock: &SensorClock| (clock.agent.clone(), clock.sensor.clone());
        match self.clocks.binary_search_by_key(&of(clock), of) {
            Ok(at) => with(&mut self.clocks[at], clock),
            Err(at) => self.clocks.insert(at, clock.clone()),
        }
    }

    /// Whether an operator failed on half of its messages or more in some run, or failed and sent nothing at all.
    pub fn has_failed_stages(&self) -> bool {
        self.nodes.values().any(|node| node.failed_runs > 0)
    }

    /// How much was lost because of what the logs hold.
    pub fn log_faults(&self) -> u64 {
        let losses = self.nodes.values().flat_map(|node| node.losses.values());
        let faults = losses.filter(|loss| loss.meaning == Meaning::LogFault);
        let boxes = self.dropped_truths.as_ref().map_or(0, |dropped| dropped.invalid);
        faults.map(Loss::count).fold(
            boxes + self.unknown_classes() + self.without_points(),
            u64::saturating_add,
        )
    }

    /// What is said of boxes that are not scored, where what the log holds is the cause.
    pub fn unscored(&self) -> Vec<String> {
        match self.log_faults() {
            0 => Vec::new(),
            _ => notes::unscored(self),
        }
    }

    /// Objects of the ground truth that have too few points, where no other object is scored.
    fn without_points(&self) -> u64 {
        let accuracy = self.accuracy.iter();
        let mut counts = accuracy.flat_map(|accuracy| accuracy.sorted.counts.values().flat_map(BTreeMap::values));
        match &self.dropped_truths {
            Some(dropped) if counts.all(|counts| counts.total == 0) => dropped.few_points,
            _ => 0,
        }
    }

    /// Objects of the ground truth, and detections, of classes that the protocol does not score, where it scores none of all.
    fn unknown_classes(&self) -> u64 {
        let counts = self
            .accuracy
            .iter()
            .flat_map(|accuracy| accuracy.sorted.counts.values());
        let counts = || counts.clone().flat_map(BTreeMap::values);
        let objects = counts().any(|counts| counts.total > 0);
        let detections = counts().any(|counts| counts.true_positives + counts.false_positives > 0);
        let unknown = |dropped: &Option<Dropped>, is_scored: bool| match dropped {
            Some(dropped) if !is_scored => dropped.classes.values().sum(),
            _ => 0,
        };
        unknown(&self.dropped_truths, objects) + unknown(&self.dropped_detections, detections)
    }

    /// Fills in all that follows from the samples and from what was counted: scores, ages and notes.
    pub fn conclude(&mut self, samples: &Samples) {
        self.age_ms = samples.ages();
        if self.runs == 1 && self.counter(LOG_CUT) > 0 {
            self.logs_cut.clone_from(&self.logs);
        }
        self.notes = notes::of(self);
        let scores = samples.localization.iter();
        let scores = scores.filter_map(|(agent, frames)| Some((agent.clone(), LocalizationScores::of(frames)?)));
        self.localization = Some(scores.collect()).filter(|scores: &BTreeMap<_, _>| !scores.is_empty());
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
        self.tracking = scores.tracking;
        self.intervals = scores.intervals;
        self.dropped_detections = Some(scores.dropped_detections);
        self.dropped_truths = Some(scores.dropped_truths);
        self.in_no_view = scores.in_no_view;
        let unscored = notes::unscored(self);
        // A table without any score says so before all else.
        let at = if self.unknown_classes() > 0 {
            0
        } else {
            self.notes.len()
        };
        self.notes.splice(at..at, unscored);
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

    /// Every channel: link, kind and its books.
    pub fn channels(&self) -> impl Iterator<Item = (&str, &str, &LinkBooks)> {
        self.links
            .iter()
            .flat_map(|(link, kinds)| kinds.iter().map(move |(kind, books)| (&**link, &**kind, books)))
    }
}
