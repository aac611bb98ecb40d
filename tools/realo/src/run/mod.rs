//! `realo run`: prepares graphs, has them run, and checks that the runs are complete.

mod batch;
mod beside;
mod choices;
mod compute;
mod cost;
mod decisions;
pub mod described;
mod dora;
mod folders;
mod foxglove;
mod lane;
mod limit;
mod live;
mod localization;
mod machine;
mod named;
mod networks;
mod nodes;
mod pace;
mod points;
mod prepare;
mod realtime;
mod replace;
mod replay;
mod resume;
mod tether;
mod view;

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use clap::ValueEnum;
use eyre::{Report, Result, WrapErr, bail, eyre};
use realo_cli::signals::{self, Ending};
use realo_cli::{find, one_of, program};
use realo_graph::FlatGraph;
use realo_operator::{Registration, Role};
use realo_player::Coop;
use realo_results::{Run, RunResult};
use realo_stages::Project;

use crate::tables::{self, Show};
use crate::{Outcome, registry, roles};
use batch::{Batch, Unfinished};
use folders::Folders;
use view::View;

pub(crate) use batch::count;
pub(crate) use compute::refuse_measured;
pub use dora::find as find_dora;
pub(crate) use dora::on_this_machine as dora_on_this_machine;
pub(crate) use limit::PERFECT;
pub use localization::PoseSource;
pub(crate) use machine::{Check, checks, cores, threads_of_virtual as check_threads};
pub(crate) use networks::Networks;
pub(crate) use nodes::{argument, decided_argument};
pub(crate) use pace::{Pace, pace};
pub(crate) use points::{Prepared, link_of, names_of, prepared};
pub(crate) use prepare::RunPlan;
pub use prepare::{LaneRun, lane};
pub(crate) use replace::apply as replace_stages;
pub use replay::replay;
pub(crate) use replay::{one, outline};
pub(crate) use resume::log_content;
pub use tether::{TetheredArgs, tethered};
pub use view::ViewArgs;

/// Runs graphs over logs and prints what came out, side by side
#[derive(clap::Args, Clone)]
pub struct Args {
    /// Dataflow files, or names of shipped ones
    #[arg(required = true)]
    pub graphs: Vec<PathBuf>,
    /// Logs to play, each in a run of its own [default: the demo log, made on first use]
    #[arg(long)]
    pub log: Vec<PathBuf>,
    /// realtime: every stage a process on dora; virtual: exact and repeatable, in one process
    #[arg(long, value_enum)]
    pub mode: Option<Mode>,
    /// No delays and exact poses, pairs by stamp; implies virtual
    #[arg(long)]
    pub offline: bool,
    /// Seconds of log time per second (realtime)
    #[arg(long)]
    pub rate: Option<f64>,
    /// Who cooperates [default: every vehicle is ego in turn, all others collaborate]
    #[arg(long, value_parser = one_of(Coop::RESTRICTED))]
    pub coop: Option<Coop>,
    /// The ego [default: each that the mode allows, in turn]
    #[arg(long)]
    pub ego: Option<String>,
    /// Only these agents take part
    #[arg(long, value_delimiter = ',')]
    pub agents: Vec<String>,
    /// How long stages take in virtual time: a TOML file of stage = ns (a realtime run leaves a compute.toml), `paper`, or `measured`:
    /// what each call takes on this machine, one at a time, which no run repeats exactly
    #[arg(long)]
    pub compute: Option<PathBuf>,
    /// Evaluation protocol: a name or a file [default: the log's]
    #[arg(long)]
    pub protocol: Option<String>,
    #[allow(missing_docs, reason = "clap would print it")]
    #[command(flatten)]
    pub choices: Choices,
    /// Where results go [default: out/GRAPH]
    #[arg(long)]
    pub out: Option<PathBuf>,
    /// Do not play once more with the poses of the log to say what --localization costs
    #[arg(long)]
    pub no_cost: bool,
    /// Go on with a batch that ended early: complete runs of the same graph, settings, model and log are taken as they are
    #[arg(long)]
    pub resume: bool,
    #[allow(missing_docs, reason = "clap would print it")]
    #[command(flatten)]
    pub view: ViewArgs,
    #[allow(missing_docs, reason = "clap would print it")]
    #[command(flatten)]
    pub show: Show,
}

/// What changes a graph, whoever runs it.
#[derive(clap::Args, Clone)]
pub struct Choices {
    /// Channel model of the links: a name, a file, or settings: delay_ms=90,loss=0.05 (docs/reference/links.md)
    #[arg(long)]
    pub link: Option<String>,
    /// Where agents get their poses from [default: each node's own, recorded in shipped graphs]
    #[arg(long, value_name = "SOURCE", value_parser = one_of(PoseSource::ALL))]
    pub localization: Option<PoseSource>,
    /// Map for --localization map, made by `realo map build`
    #[arg(long, value_name = "FILE")]
    pub map: Option<PathBuf>,
    /// Agents report the detections that the log recorded
    #[arg(long)]
    pub recorded_detections: bool,
    /// Model file of every detector, or the name of a shipped one, as `lite` [default: each node's own]
    #[arg(long)]
    pub model: Option<PathBuf>,
    /// Kernels of the networks: auto, portable (the same bits on every machine), avx2, avx512, avx512bf16, amx [default: auto]
    #[arg(long)]
    pub isa: Option<String>,
    /// Number type of the networks: auto (the model's), f32, bf16, int8 [default: auto]
    #[arg(long)]
    pub precision: Option<String>,
    /// What computes the networks: cpu, or cuda where the build has it [default: cpu]
    #[arg(long)]
    pub device: Option<String>,
    /// What becomes of messages whose stamps step, run backwards or are of another clock: drop, rebase (stamps by their arrival), or
    /// trust [default: what is seconds off is left out]
    #[arg(long, value_parser = ["drop", "rebase", "trust"])]
    pub stamps: Option<String>,
    /// Who brings what crosses the link to the ego's frame: its receiver, or its sender as foreseen by the ego's newest known state
    #[arg(long, value_parser = one_of(Project::ALL))]
    pub project: Option<Project>,
    /// Seed of the links' jitter and loss
    #[arg(long)]
    pub seed: Option<u64>,
    /// stage.key=value: changes a setting of a stage
    #[arg(long)]
    pub set: Vec<String>,
    /// STAGE="program PATH key=value …" or STAGE="operator NAME …": puts another stage in the place of one, or a new one
    /// before an input of one: STAGE.INPUT="…" (docs/reference/plugins.md)
    #[arg(long)]
    pub replace: Vec<String>,
}

impl Choices {
    /// The settings in a table's rare rows that were chosen, by the names of these rows.
    fn given(&self) -> Vec<String> {
        let rows = [
            ("model", self.model.is_some()),
            (
                "isa",
                self.isa.is_some() || self.precision.is_some() || self.device.is_some(),
            ),
            ("seed", self.seed.is_some()),
        ];
        let given = rows.into_iter().filter(|(_, is_given)| *is_given);
        given.map(|(name, _)| name.to_string()).collect()
    }
}

/// Which driver runs the graph.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Mode {
    /// On dora, by the wall clock.
    Realtime,
    /// As a discrete-event simulation.
    Virtual,
}

impl Mode {
    /// The mode's name in results.
    pub fn as_str(self) -> &'static str {
        match self {
            Mode::Realtime => "realtime",
            Mode::Virtual => "virtual",
        }
    }
}

impl Args {
    /// Whether the calls of a run take time of this machine, so that it leaves a compute profile.
    fn leaves_profile(&self, mode: Mode) -> bool {
        mode == Mode::Realtime || self.compute.as_deref().is_some_and(compute::is_measured)
    }

    /// The driver that the options ask for.
    ///
    /// # Errors
    /// Options that exclude each other.
    pub fn driver(&self) -> Result<Mode> {
        let mode = match (self.mode, self.offline) {
            (Some(Mode::Realtime), true) => {
                bail!("--offline has no delays and runs in virtual time: drop --mode realtime")
            }
            (Some(mode), _) => mode,
            (None, true) => Mode::Virtual,
            (None, false) => Mode::Realtime,
        };
        if self.offline && (self.choices.link.is_some() || self.compute.is_some()) {
            bail!("--offline has neither delays nor loss: drop --link and --compute, or --offline");
        }
        if self.no_cost && !self.choices.localization.is_some_and(PoseSource::is_estimated) {
            bail!(
                "--no-cost: only what --localization map or gnss costs is found by playing once more: drop --no-cost"
            );
        }
        if mode == Mode::Realtime && self.compute.is_some() {
            bail!("--compute is for virtual time; in realtime stages take what they take: add --mode virtual");
        }
        if mode == Mode::Virtual && self.rate.is_some() {
            bail!("--rate is for realtime; virtual time runs as fast as it can");
        }
        if let Some(rate) = self.rate
            && !(rate.is_finite() && rate > 0.0)
        {
            bail!("--rate: expected a positive number, found {rate}");
        }
        Ok(mode)
    }
}

/// Loads the networks of a graph as its nodes would, all from one model file if there is one, and builds its operators.
///
/// # Errors
/// A model or weights that cannot be had, a model file for a graph without a network, kernels that this processor lacks,
/// models that do not fit together, a value that a node does not take.
pub fn check_networks(graph: FlatGraph, model: Option<&Path>) -> Result<()> {
    let graph = anchored(graph, model)?;
    Networks::default().check(&graph)?;
    check_nodes(&graph, Asked::All)
}

/// A graph with absolute paths, and with one model file for all if there is one.
///
/// # Errors
/// A model file for a graph without a network.
pub fn anchored(mut graph: FlatGraph, model: Option<&Path>) -> Result<FlatGraph> {
    nodes::anchor_paths(&mut graph)?;
    if let Some(model) = model {
        nodes::set_model(&mut graph, model)?;
    }
    Ok(graph)
}

/// The same without loading a network: looks whether models and weights are there.
///
/// # Errors
/// A model or weights that are not there, a value that a node does not take.
pub fn check_files(mut graph: FlatGraph, model: Option<&Path>) -> Result<()> {
    nodes::anchor_paths(&mut graph)?;
    networks::find_all(&graph, model)?;
    check_nodes(&graph, Asked::All)
}

/// Which nodes are asked what keeps them from a run.
#[derive(Clone, Copy, PartialEq)]
enum Asked {
    All,
    /// They need no log.
    Operators,
}

/// Has nodes say what keeps them from a run, before their processes do.
///
/// # Errors
/// What all those say.
fn check_nodes(graph: &FlatGraph, asked: Asked) -> Result<()> {
    says(graph, |known, settings| match known.role {
        Role::Operator => build(known, settings),
        _ if asked == Asked::Operators => Ok(()),
        Role::Source | Role::Sink | Role::Gateway => (known.examine)(settings),
    })
}

/// Builds an operator; networks are looked at once for all, and all else opens files and sockets.
fn build(known: &Registration, settings: &[String]) -> Result<(), realo_operator::Error> {
    match known.setting(roles::MODEL) {
        Some(_) => Ok(()),
        None => (known.build)(settings).map(drop),
    }
}

/// Asks every node of ours.
fn says(graph: &FlatGraph, ask: impl Fn(&Registration, &[String]) -> Result<(), realo_operator::Error>) -> Result<()> {
    let errors = graph.nodes.iter().filter_map(|node| {
        let error = ask(node.registration(&registry())?, node.settings()).err()?;
        Some(format!("node `{}`: {error}", node.id))
    });
    let errors: Vec<String> = errors.collect();
    match errors.is_empty() {
        true => Ok(()),
        false => bail!("{}", errors.join("\n  ")),
    }
}

/// Processes whose program is not there, and is not this one.
pub fn missing_programs(graph: &FlatGraph) -> Vec<String> {
    let is_missing = |process: &&realo_graph::FlatNode| {
        let named_by_path = process.path.components().count() > 1;
        !process.is_realo() && named_by_path && !process.path.exists()
    };
    let missing = graph.processes().into_iter().filter(is_missing);
    let programs = missing.map(|process| (&process.id, process.path.display().to_string()));
    let folder = graph.file.parent().unwrap_or(Path::new("/"));
    let plug_ins = graph.nodes.iter().filter_map(|node| {
        let path = folder.join(node.program()?);
        (!path.exists()).then(|| (&node.id, path.display().to_string()))
    });
    let all = programs.chain(plug_ins);
    all.map(|(id, path)| {
        format!("node `{id}`: no program {path}: build it, or correct the path, which is seen from the graph's folder")
    })
    .collect()
}

/// The runs of one graph.
struct Planned<'a> {
    /// The graph's name.
    name: &'a str,
    /// Its file.
    graph: PathBuf,
    batch: Batch,
    /// Settings that the graph was not given, for who reads its results.
    skipped: Option<String>,
}

/// Runs every graph over every log and ego, pools, and prints. A graph that fails takes no other one with it: the table has
/// the others, and its error follows.
pub fn main(args: &Args) -> Result<Outcome> {
    signals::catch(realo_host::virtual_time::end_all)?;
    if let Some(file) = live::asked(args) {
        return live::main(args, &file);
    }
    let mut args = args.clone();
    let mode = args.driver()?;
    machine::threads_of_virtual()?;
    choices::settle_all(&mut args.choices);
    let view = args.view.start()?;
    let mut failures = Failures::of(args.graphs.len());
    let is_there = find_graphs(&mut args.graphs, &mut failures)?;
    let args = &args;
    let names = names(&args.graphs)?;
    let mut planned = plan(args, mode, &names, &is_there, &mut failures)?;
    if let Some(view) = &view {
        view.check(planned.iter().flat_map(|planned| planned.batch.plans()))?;
    }
    signals::begin();
    let mut folders = Folders::default();
    for Planned { name, batch, .. } in &mut planned {
        folders.lock(&dir_of(args, name))?;
        if args.leaves_profile(mode) {
            folders.claim_profile(&dir_of(args, name))?;
        }
        batch.claim(&mut folders, args.resume)?;
    }
    let runs = play(args, mode, &mut planned, &mut failures, view.as_ref())?;
    // What did not come to its end has the files of the run before again.
    if runs.len() == names.len() {
        folders.keep_new();
    }
    drop(folders);
    let references = match args.show.is_table() {
        true => cost::references(args, mode, &planned, &runs),
        false => Vec::new(),
    };
    show(args, &runs, &references);
    let outcome = conclude(&planned, &runs, &failures);
    if let Some(view) = view.filter(|_| !runs.is_empty()) {
        view.stay(&args.view);
    }
    Ok(outcome)
}

/// Puts the files of graphs in the place of their names; says which are there. One that is not keeps its place, so that
/// results of the others go where they always do.
fn find_graphs(graphs: &mut [PathBuf], failures: &mut Failures) -> Result<Vec<bool>> {
    let mut is_there = Vec::new();
    for path in graphs {
        let found = failures.note(&path.display().to_string(), find::graph(path))?;
        is_there.push(found.is_some());
        if let Some(found) = found {
            *path = found;
        }
    }
    Ok(is_there)
}

/// The runs of all graphs that are there, each with the settings that it has a place for.
fn plan<'a>(
    args: &Args,
    mode: Mode,
    names: &'a [String],
    is_there: &[bool],
    failures: &mut Failures,
) -> Result<Vec<Planned<'a>>> {
    let there = args.graphs.iter().zip(names).zip(is_there);
    let there: Vec<(&PathBuf, &String)> = there
        .filter(|(_, is_there)| **is_there)
        .map(|(graph, _)| graph)
        .collect();
    let graphs: Vec<PathBuf> = there.iter().map(|(graph, _)| graph.to_path_buf()).collect();
    let mut planned: Vec<Planned> = Vec::new();
    for (fitted, (graph, name)) in choices::fit(&args.choices, &graphs).into_iter().zip(there) {
        let skipped = fitted.note();
        if let Some(note) = &skipped {
            eprintln!("realo: {name}: {note}");
        }
        let own = Args {
            choices: fitted.choices,
            ..args.clone()
        };
        let batch = failures.note(name, prepare::batch(&own, mode, graph, name))?;
        let graph = graph.clone();
        planned.extend(batch.map(|batch| Planned {
            name,
            graph,
            batch,
            skipped,
        }));
    }
    let mut plans = planned.iter().flat_map(|planned| planned.batch.plans());
    if args.choices.project.is_some() && !planned.is_empty() && !plans.any(RunPlan::can_project) {
        return Err(prepare::nobody_projects(&names.join(", ")));
    }
    refuse_without_network(&args.choices, &planned, names)?;
    Ok(planned)
}

/// Refuses options of networks where no graph of the run has one.
fn refuse_without_network(choices: &Choices, planned: &[Planned], names: &[String]) -> Result<()> {
    for (decided, option, is_given) in [
        (roles::ISA, "--isa", choices.isa.is_some()),
        (roles::PRECISION, "--precision", choices.precision.is_some()),
        (roles::DEVICE, "--device", choices.device.is_some()),
    ] {
        let mut plans = planned.iter().flat_map(|planned| planned.batch.plans());
        let follows = |plan: &RunPlan| nodes::deciding(&plan.graph, decided).next().is_some();
        if is_given && !planned.is_empty() && !plans.any(follows) {
            let names = names.join(", ");
            bail!("{option}: no network runs in {names}: drop {option}, or --recorded-detections where it is given");
        }
    }
    Ok(())
}

/// Has the runs run, graph by graph, and pools what those of each came to, until a signal comes.
fn play<'a>(
    args: &Args,
    mode: Mode,
    planned: &mut [Planned<'a>],
    failures: &mut Failures,
    view: Option<&View>,
) -> Result<Vec<(&'a str, Run)>> {
    let mut runs = Vec::new();
    for Planned {
        name, batch, skipped, ..
    } in planned
    {
        if mode == Mode::Realtime
            && let Some(plan) = batch.plans().first()
        {
            machine::open_doors(&plan.graph)
                .iter()
                .for_each(|line| eprintln!("realo: {line}"));
        }
        let done = match (batch.run(mode, args.rate.unwrap_or(1.0), view), signals::first()) {
            (Err(reason), Some(ending)) => {
                eprintln!("realo: {}", ended_early(ending, mode, &reason));
                break;
            }
            (done, _) => done.and_then(|done| {
                let notes = batch.notes().into_iter().chain(skipped.clone());
                pool(args, mode, name, notes.collect(), batch.ended_by(), &done)
            }),
        };
        let pooled = failures.note(name, done)?;
        runs.extend(pooled.map(|pooled| (*name, pooled)));
        if signals::first().is_some() {
            break;
        }
    }
    Ok(runs)
}

/// Prints what matters, the table, and where the results are. `references`: runs that say what localization cost, with their folders.
fn show(args: &Args, runs: &[(&str, Run)], references: &[(String, Run)]) {
    let named: Vec<(&str, &Run)> = runs.iter().map(|(name, run)| (*name, run)).collect();
    if !named.is_empty() && args.show.is_table() {
        let earlier = match &named[..] {
            [(name, _)] => beside::earlier(&dir_of(args, name)),
            _ => Vec::new(),
        };
        let is_reference = |name: &String| references.iter().any(|(reference, _)| reference == name);
        let earlier: Vec<(String, Run)> = earlier.into_iter().filter(|(name, _)| !is_reference(name)).collect();
        tables::print_opening(&named, &borrowed(&earlier), &borrowed(references), &next(args, &named));
    }
    if !named.is_empty() {
        args.show.print(&named);
    }
    if args.show.is_table() {
        named
            .iter()
            .for_each(|(name, _)| println!("results in {}", dir_of(args, name).display()));
    }
}

fn borrowed(runs: &[(String, Run)]) -> Vec<(&str, &Run)> {
    runs.iter().map(|(name, run)| (name.as_str(), run)).collect()
}

/// The commands that show more of runs.
fn next(args: &Args, runs: &[(&str, &Run)]) -> String {
    let folders = runs
        .iter()
        .map(|(name, _)| program::quoted(&dir_of(args, name).to_string_lossy()));
    let folders: Vec<String> = folders.collect();
    let realo = program::called();
    format!(
        "{realo} report {} shows every sweep; {realo} graph {} the graph with what was measured; --verbose all rows.",
        folders.join(" "),
        folders[0]
    )
}

/// Says what was not played and what failed; how the command ends.
fn conclude(planned: &[Planned], runs: &[(&str, Run)], failures: &Failures) -> Outcome {
    let batches = || planned.iter().map(|planned| &planned.batch);
    let not_played: BTreeSet<String> = batches().flat_map(Batch::reasons).collect();
    not_played
        .iter()
        .for_each(|reason| eprintln!("realo: not played: {reason}"));
    let has_failed = failures.reported();
    if let Some(ending) = signals::first() {
        if !runs.is_empty() {
            eprintln!("realo: ended by {ending}; these are the results until then");
        }
        return Outcome::Ended(ending.number());
    }
    let results = || runs.iter().map(|(_, run)| &run.result);
    let has_faults = results().any(|result| result.log_faults() > 0);
    let has_failed_stages = results().any(RunResult::has_failed_stages);
    // A graph that scores nothing has no frames. Where the log is the cause, a note says so.
    let gave_nothing = |result: &&RunResult| {
        let no_boxes = result.frames.total > 0 && result.frames.processed == 0;
        no_boxes && (result.has_failed_stages() || result.log_faults() == 0)
    };
    let without_boxes = results().find(gave_nothing);
    if let Some(result) = without_boxes {
        let why = match result.has_failed_stages() {
            true => ", because a stage failed on its messages; the first note says which",
            false => ": no sweep of the ego came to the end of the graph in time; the notes say what was lost",
        };
        eprintln!("realo: no boxes to score{why}");
    }
    let is_partial = has_faults || has_failed_stages || batches().any(Batch::is_partial);
    match (has_failed || without_boxes.is_some(), is_partial) {
        (true, _) => Outcome::Failed,
        (false, true) => Outcome::Partial,
        (false, false) => Outcome::Complete,
    }
}

/// What a run that a signal ended without results leaves.
fn ended_early(ending: Ending, mode: Mode, reason: &Report) -> String {
    match mode {
        Mode::Virtual if reason.is::<Unfinished>() => format!(
            "ended by {ending} before the end of the log: no results of this run; earlier ones stay, and --resume goes on \
             with a batch"
        ),
        Mode::Virtual | Mode::Realtime => format!("ended by {ending}: {reason:#}"),
    }
}

/// Pools the runs of a graph, and writes what they came to; `ended_by`: a signal kept some from their end.
fn pool(
    args: &Args,
    mode: Mode,
    name: &str,
    notes: Vec<String>,
    ended_by: Option<Ending>,
    done: &[Run],
) -> Result<Run> {
    let mut pooled = realo_report::pool(done)?;
    pooled.result.notes.splice(0..0, notes);
    pooled.result.ended_by = ended_by.map(|ending| ending.to_string());
    let dir = dir_of(args, name);
    realo_report::write_run(&dir, &pooled)?;
    if args.leaves_profile(mode) {
        compute::write(&dir, mode, &pooled).wrap_err_with(|| format!("{}", dir.display()))?;
    }
    Ok(pooled)
}

/// Graphs that failed beside others.
struct Failures {
    graphs: usize,
    failed: Vec<(String, Report)>,
}

impl Failures {
    fn of(graphs: usize) -> Self {
        let failed = Vec::new();
        Failures { graphs, failed }
    }

    /// Keeps a graph's error for later.
    ///
    /// # Errors
    /// That error, if there is no other graph.
    fn note<T>(&mut self, graph: &str, result: Result<T>) -> Result<Option<T>> {
        match result {
            Ok(value) => Ok(Some(value)),
            Err(error) if self.graphs == 1 => Err(error),
            Err(error) => {
                if self.failed.len() + 1 < self.graphs {
                    eprintln!("realo: {graph} failed; its error follows when the other graphs have run");
                }
                self.failed.push((graph.into(), error));
                Ok(None)
            }
        }
    }

    /// Reports all errors, and whether there was one.
    fn reported(&self) -> bool {
        // A log that is missing is the same error of every graph.
        let mut known: Vec<String> = Vec::new();
        for (graph, error) in &self.failed {
            let text = format!("{error:#}");
            if !known.contains(&text) {
                eprintln!("realo: {graph}: {text}");
                known.push(text);
            }
        }
        !self.failed.is_empty()
    }
}

/// Where a graph's results go.
fn dir_of(args: &Args, graph: &str) -> PathBuf {
    match &args.out {
        Some(out) if args.graphs.len() == 1 => out.clone(),
        Some(out) => out.join(graph),
        None => Path::new("out").join(graph),
    }
}

/// The graphs' names: their file stems.
fn names(graphs: &[PathBuf]) -> Result<Vec<String>> {
    let mut names = Vec::new();
    for graph in graphs {
        let name = graph
            .file_stem()
            .ok_or_else(|| eyre!("{}: not a file name", graph.display()))?;
        let name = name.to_string_lossy().into_owned();
        if names.contains(&name) {
            bail!("two graphs are named `{name}`: rename one, so that their results can be told apart");
        }
        names.push(name);
    }
    Ok(names)
}
