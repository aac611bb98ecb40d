use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use realo_operator::{Books, Describe, Error, Inputs, Loss, Meaning, NoOutput, NodeBooks, Settings, Sink, Tally};
use realo_schemas::report::{self, Fated, Peer, Phase, from_report};
use realo_schemas::{AgentState, Boxes, GroundTruth, Header, Kind, Name, Report};
use realo_scoring::{EvaluationReport, TOPIC};
use realo_time_offset::StampRule;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use crate::files::{Beside, write_run_with};
use crate::localization::{Estimates, stamp_rule};
use crate::progress::Progress;
use crate::timing::Pace;
use crate::{
    Cooperation, EdgeBooks, GraphStages, Ledger, NodeSummary, ResultsError, Run, RunResult, Samples, Timing,
    TimingSamples, add_name, claim, link_books,
};

/// Settings of [`Results`].
#[derive(Clone, Debug, PartialEq, Settings, Serialize, Deserialize)]
pub struct Settings {
    /// Folder of the files; an earlier run's files in it are replaced.
    #[setting(default = "../target/realo/run", role = "out", filled)]
    pub out: PathBuf,
    /// File with the settings of the run that the result reports (JSON); empty = the graph is named as the folder is.
    #[setting(role = "run_settings")]
    pub run_settings: PathBuf,
    /// What becomes of messages whose stamps are wrong, as the player has it: localization is compared with the truth at the stamps that it
    /// played.
    #[setting(role = "stamps")]
    pub stamps: StampRule,
}

/// What whoever prepared a run knows of it.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct RunSettings {
    /// The log's path, or its name alone, by which pooled runs are resampled. The name stands in the result, the path in
    /// `timing.json` only.
    pub log: String,
    /// The machine that runs the graph in realtime; empty where times are not those of a machine.
    pub machine: String,
    /// A hash of what the log holds; empty where it is not known.
    pub log_hash: String,
    /// What was run.
    pub settings: crate::Settings,
    /// The graph, as [`Samples::graph`] has it.
    pub graph: GraphStages,
    /// What was chosen, as [`Samples::given`] has it.
    pub given: Vec<String>,
    /// A hash of all that decides the run, by which whoever prepares it again knows it; no result has it.
    pub fingerprint: String,
}

impl Settings {
    fn run_settings(&self) -> Result<RunSettings, ResultsError> {
        if self.run_settings.as_os_str().is_empty() {
            let graph = self.out.file_name().unwrap_or_default().to_string_lossy().into_owned();
            let settings = crate::Settings {
                graph,
                ..crate::Settings::default()
            };
            return Ok(RunSettings {
                settings,
                ..RunSettings::default()
            });
        }
        let file = || self.run_settings.clone();
        let text = std::fs::read_to_string(&self.run_settings)
            .map_err(|error| ResultsError::RunFile { file: file(), error })?;
        serde_json::from_str(&text).map_err(|error| ResultsError::RunSettings { file: file(), error })
    }
}

/// Sweeps for which something came, each counted once however often it came.
#[derive(Default)]
struct Sweeps {
    known: BTreeSet<(Name, u64)>,
    pace: Pace,
}

impl Sweeps {
    /// Whether it is the first of its sweep.
    fn add(&mut self, header: &Header) -> bool {
        let is_first = self.known.insert((header.agent.clone(), header.seq));
        if is_first {
            self.pace.add(header.stamp);
        }
        is_first
    }
}

/// Closes the books of a run and writes result.json, timing.json and evaluation.json.
#[derive(Describe)]
#[stage(output = NoOutput)]
pub struct Results {
    out: PathBuf,
    stamps: StampRule,
    log: String,
    log_path: Option<String>,
    machine: Option<String>,
    result: RunResult,
    samples: Samples,
    timing: TimingSamples,
    ledger: Ledger,
    boxes: Sweeps,
    truth: Sweeps,
    realtime: bool,
    /// Where agents said that they were, as far as that was estimated.
    estimates: Estimates,
    /// What the ways from agents on other machines were like.
    courses: BTreeMap<String, Vec<Phase>>,
    progress: Progress,
}

/// What comes in.
#[derive(Debug, Inputs)]
pub enum Input {
    /// The final boxes.
    #[port(optional, of(Ego), on_wire(realo_scoring::BOXES_WIRE))]
    Boxes(Header, Boxes),
    /// One for every sweep of the ego.
    #[port(optional, of(Ego), on_wire(realo_scoring::TRUTH_WIRE))]
    Truth(Header, GroundTruth),
    /// Topic `evaluation`, of the evaluator.
    #[port(optional, of(Ego))]
    Evaluation(Header, Report),
    /// The ego's states.
    #[port(optional, of(Ego))]
    EgoState(Header, AgentState),
    /// The collaborators' states.
    #[port(optional, of(Others))]
    States(Header, AgentState),
    /// Topic `peers`, of the radio.
    #[port(optional)]
    Peers(Header, Report),
}

impl Sink for Results {
    fn build(settings: Settings) -> Result<Self, Error> {
        claim(&settings.out)?;
        let RunSettings {
            log,
            log_hash,
            settings: run,
            machine,
            graph,
            given,
            ..
        } = settings.run_settings()?;
        let (log, log_path) = name_and_path(log);
        let mut samples = Samples {
            graph,
            given,
            ..Samples::default()
        };
        if !log_hash.is_empty() {
            samples.logs.insert(log.clone(), log_hash);
        }
        Ok(Results {
            log,
            log_path,
            machine: (!machine.is_empty()).then_some(machine),
            result: RunResult::new(run),
            samples,
            timing: TimingSamples::default(),
            ledger: Ledger::default(),
            boxes: Sweeps::default(),
            truth: Sweeps::default(),
            realtime: false,
            estimates: Estimates::default(),
            progress: Progress::new(&settings.out, !settings.run_settings.as_os_str().is_empty()),
            courses: BTreeMap::new(),
            stamps: settings.stamps,
            out: settings.out,
        })
    }

    fn accept(&mut self, input: Input) -> Result<(), Error> {
        match input {
            Input::Boxes(header, boxes) => {
                self.progress.boxes(header.stamp, header.clock.is_some());
                self.take_boxes(&header, &boxes);
            }
            Input::Truth(header, truth) => self.take_truth(&header, &truth),
            Input::Evaluation(header, report) => self.take_evaluation(document(&header, &report, TOPIC)?)?,
            Input::EgoState(header, state) | Input::States(header, state) => self.estimates.add(&header, &state),
            Input::Peers(header, report) => {
                let mut peers: Vec<Peer> = document(&header, &report, report::PEERS)?;
                let courses = peers
                    .iter_mut()
                    .map(|peer| (peer.name.clone(), std::mem::take(&mut peer.course)));
                self.courses.extend(courses.filter(|(_, course)| !course.is_empty()));
                self.result.peers.extend(peers);
            }
        }
        Ok(())
    }

    fn fates(&mut self, fates: &[Fated]) -> Result<(), Error> {
        fates.iter().for_each(|fated| self.ledger.take(fated));
        self.progress.fates(fates);
        Ok(())
    }

    fn finish(&mut self, books: &Books) -> Result<(), Error> {
        let estimates = std::mem::take(&mut self.estimates);
        // A player may have a rule of its own.
        let stamps = match self.stamps {
            StampRule::DropFar => stamp_rule(&self.samples.graph),
            decided => decided,
        };
        let found = estimates.against(self.log_path.as_deref().map(Path::new), stamps);
        self.samples.localization = found.frames;
        let mut run = self.close(books);
        run.result.notes.extend(found.notes);
        let beside = Beside {
            courses: std::mem::take(&mut self.courses),
            trajectories: found.trajectories,
        };
        Ok(write_run_with(&self.out, &run, &beside)?)
    }
}

/// A log's name, and its path if that is known.
fn name_and_path(log: String) -> (String, Option<String>) {
    let path = Path::new(&log);
    match path.file_stem().filter(|_| path.components().count() > 1) {
        Some(stem) => (stem.to_string_lossy().into_owned(), Some(log)),
        None => (log, None),
    }
}

/// The document of a report, which must be of the port's topic.
fn document<T: DeserializeOwned>(header: &Header, report: &Report, expected: &'static str) -> Result<T, Error> {
    if &*report.topic != expected {
        let (found, header) = (report.topic.clone(), header.clone().into());
        return Err(ResultsError::Topic {
            expected,
            found,
            header,
        }
        .into());
    }
    Ok(from_report::<T>(report)?)
}

impl Results {
    fn take_boxes(&mut self, header: &Header, boxes: &Boxes) {
        if self.boxes.add(header) {
            self.result.boxes.get_or_insert_default().take(boxes);
        }
        self.realtime |= header.clock.is_some();
        self.timing.add_way(header);
        add_name(&mut self.result.egos, &header.agent);
    }

    fn take_truth(&mut self, header: &Header, truth: &GroundTruth) {
        self.truth.add(header);
        self.realtime |= header.clock.is_some();
        self.result.frames.key += u64::from(truth.key);
        add_name(&mut self.result.egos, &header.agent);
        truth
            .agents
            .iter()
            .for_each(|agent| add_name(&mut self.result.agents, agent));
    }

    fn take_evaluation(&mut self, report: EvaluationReport) -> Result<(), ResultsError> {
        if self.samples.evaluation.is_some() {
            return Err(ResultsError::SecondEvaluation);
        }
        let mut evaluation = report.evaluation;
        for scene in &mut evaluation.scenes {
            scene.name.clone_from(&self.log);
        }
        self.samples.evaluation = Some(evaluation);
        Ok(())
    }

    /// All that is known at the end.
    fn close(&mut self, books: &Books) -> Run {
        let mut result = self.result.clone();
        let settings = &mut result.settings;
        if settings.mode.is_empty() {
            settings.mode = if self.realtime { "realtime" } else { "virtual" }.into();
        }
        if settings.ego.is_empty() {
            settings.ego = result.egos.join(", ");
        }
        add_name(&mut result.egos, &settings.ego);
        add_name(&mut result.logs, &self.log);
        // Boxes under the header of another sweep answer none.
        let (sweeps, processed) = match self.truth.known.is_empty() {
            true => (&self.boxes, self.boxes.pace.count),
            false => (
                &self.truth,
                self.boxes.known.intersection(&self.truth.known).count() as u64,
            ),
        };
        let (total, duration) = (sweeps.pace.count, sweeps.pace.duration());
        result.frames.processed = processed;
        result.frames.total = total;
        result.frames.skipped = total - processed;
        self.close_links(&mut result, books);
        take_books(&mut result, books);
        result.cooperation = Cooperation::of(&result, books);
        result.conclude(&self.samples);
        let mut timing = std::mem::take(&mut self.timing);
        timing.add_books(books);
        timing.processed = processed;
        timing.duration_ns = duration;
        let timing = Timing {
            log_path: self.log_path.take(),
            machine: self.machine.take(),
            ..Timing::of(timing)
        };
        result.notes.extend(timing.late_note(&result.settings));
        Run {
            result,
            timing,
            samples: std::mem::take(&mut self.samples),
        }
    }

    fn close_links(&mut self, result: &mut RunResult, books: &Books) {
        let (settled, ages) = std::mem::take(&mut self.ledger).close();
        self.samples.ages_ns = ages;
        result.links = link_books(&settled, books);
    }
}

/// What the nodes counted, and what dora did between them.
fn take_books(result: &mut RunResult, books: &Books) {
    for (id, node) in &books.nodes {
        let mut summary = NodeSummary {
            operator: node.name.clone(),
            errors: node.errors,
            first_error: node.first_error.clone(),
            calls: calls(node, |trigger| !is_wake(trigger)),
            wakes: calls(node, is_wake),
            failed_runs: u64::from(has_failed(node)),
            counters: node.counters.clone(),
            losses: node.losses.iter().filter_map(happened).collect(),
            sent: node
                .outputs
                .iter()
                .map(|(port, sent)| (port.clone(), sent.total()))
                .collect(),
            ..NodeSummary::default()
        };
        node.clocks.iter().for_each(|clock| result.join_clock(clock));
        let busy = skipped_of_others(node, &result.egos);
        summary.losses.extend(happened((&"skipped".into(), &busy)));
        for (port, input) in &node.inputs {
            let skipped = input.skipped.total();
            summary.skipped += skipped;
            summary
                .skipped_at
                .extend((skipped > 0).then(|| (port.clone(), skipped)));
            summary.unjoined += input.unjoined.total();
            let edge = EdgeBooks {
                lost: input.transport_lost,
                repeated: input.transport_repeated,
                reordered: input.transport_reordered,
            };
            result.transport.add(&format!("{id}.{port}"), &edge);
        }
        result.nodes.insert(id.clone(), summary);
    }
}

/// The calls of an operator by what triggered them.
fn calls(node: &NodeBooks, wanted: impl Fn(&str) -> bool) -> u64 {
    let triggers = node.compute.iter().filter(|(trigger, _)| wanted(trigger));
    triggers.map(|(_, durations)| durations.count()).sum()
}

/// Whether a trigger is a wake that the operator asked for.
fn is_wake(trigger: &str) -> bool {
    trigger.split(" > ").next() == Some("wake")
}

/// Whether little or nothing came of an operator because its calls failed.
fn has_failed(node: &NodeBooks) -> bool {
    let is_operator = calls(node, |_| true) > 0;
    let is_silent = node.outputs.values().all(|sent| sent.total() == 0);
    let by_messages = calls(node, |trigger| !is_wake(trigger));
    let failed = node.errors.saturating_sub(node.other_errors);
    let fails_often = failed > 0 && 2 * failed >= by_messages;
    node.errors > 0 && is_operator && (fails_often || is_silent)
}

/// What a busy node skipped of collaborators' data; sweeps of the ego without boxes are said of the frames.
fn skipped_of_others(node: &NodeBooks, egos: &[String]) -> Loss {
    let mut loss = Loss {
        meaning: Meaning::Loss,
        note: "messages were skipped at `{node}`, because it was busy".into(),
        remedy: "`realo compare DIR --full` lists the latency of each stage; `--rate 0.5` plays at half the speed"
            .into(),
        ..Loss::default()
    };
    let is_data = |kind: &Kind| matches!(kind, Kind::Points | Kind::Features | Kind::Boxes);
    let of = |tally: &Tally, agent: &str| -> u64 {
        let kinds = tally.0.get(agent).into_iter().flatten();
        kinds.filter(|(kind, _)| is_data(kind)).map(|(_, n)| n).sum()
    };
    for input in node.inputs.values() {
        for agent in input.skipped.0.keys().filter(|agent| !egos.contains(agent)) {
            let count = of(&input.skipped, agent);
            let share = loss.agents.entry(agent.clone()).or_default();
            (share.count, share.of) = (share.count + count, share.of + count + of(&input.received, agent));
        }
    }
    loss
}

/// A loss without the agents of whom nothing was lost; `None` if that is so of all.
pub(crate) fn happened((counter, loss): (&String, &Loss)) -> Option<(String, Loss)> {
    let mut loss = loss.clone();
    loss.agents.retain(|_, share| share.count > 0);
    (!loss.agents.is_empty()).then(|| (counter.clone(), loss))
}

#[cfg(test)]
mod tests;
