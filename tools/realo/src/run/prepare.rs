//! From options to runs: which graph, log and ego, with which arguments, and where results go.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use eyre::{Report, Result, WrapErr, bail, eyre};
use realo_cli::campaign::digest;
use realo_graph::{FlatGraph, Graph, Setting, Severity, normalized};
use realo_host::ComputeProfile;
use realo_logs::{LaneStage, Log};
use realo_player::PlannedRun;
use realo_results::scoring::Protocol;
use realo_results::{GraphStages, RunSettings, Settings};

use super::batch::{Batch, Unplayable};
use super::decisions::Decisions;
use super::lane::{self, SendingLane};
use super::networks::{self, Networks};
use super::nodes::{anchor_paths, argument, decided_argument, deciding, given, is_path, registration, takers, values};
use super::{Args, Mode, choices, compute, described, dir_of, limit, localization, replace, resume};
use crate::fit::protocol_fits;
use crate::{demo, registry, roles};

/// One run: a graph over a log with an ego.
pub struct RunPlan {
    /// What is shown while it runs.
    pub name: String,
    /// The graph with all its arguments.
    pub graph: FlatGraph,
    /// Where its results go; emptied before it starts.
    pub out: PathBuf,
    /// Length of the log, s.
    pub seconds: f64,
    /// Whether the log was cut.
    pub truncated: bool,
    /// How long stages take in virtual time.
    pub compute: ComputeProfile,
    /// What the result reports of the run.
    run_settings: RunSettings,
}

/// The file in a run's folder that says what its result reports of it.
pub(super) const SETTINGS_FILE: &str = "run.json";

impl RunPlan {
    /// Whether somebody can choose who brings what crosses the link to the ego's frame.
    pub fn can_project(&self) -> bool {
        !self.run_settings.settings.project.is_empty()
    }

    /// Whether agents estimate their poses.
    pub fn estimates_poses(&self) -> bool {
        !self.run_settings.settings.pose_source.is_empty()
    }

    /// The files in the folder of its results that it records into.
    pub fn recordings(&self) -> Vec<PathBuf> {
        let file = |node| given(node, decided_argument(node, roles::RECORDING)?).map(PathBuf::from);
        let files = deciding(&self.graph, roles::RECORDING).filter_map(file);
        files.filter(|file| file.parent() == Some(&self.out)).collect()
    }

    /// Name of the log, and a hash of what it holds.
    pub fn log(&self) -> (String, &str) {
        (stem(Path::new(&self.run_settings.log)), &self.run_settings.log_hash)
    }

    /// What the run is known by when it is prepared again.
    pub fn fingerprint(&self) -> &str {
        &self.run_settings.fingerprint
    }

    /// What its result depends on, by name.
    pub fn parts(&self) -> Result<BTreeMap<String, String>> {
        let RunSettings { settings, log_hash, .. } = &self.run_settings;
        let parts = [
            ("version", env!("CARGO_PKG_VERSION").to_string()),
            ("log", log_hash.clone()),
            ("graph", settings.graph_hash.clone()),
            ("model", settings.model.clone()),
            ("kernels", settings.isa.clone()),
            ("settings", digest(&serde_json::to_string(settings)?)),
            ("files and settings", self.fingerprint().to_string()),
        ];
        Ok(parts.map(|(name, value)| (name.to_string(), value)).into())
    }

    /// The log's file.
    pub fn log_path(&self) -> PathBuf {
        PathBuf::from(&self.run_settings.log)
    }

    /// The ego.
    pub fn ego(&self) -> &str {
        &self.run_settings.settings.ego
    }

    /// Writes what the result reports of the run to where the graph has it.
    pub fn write_settings(&self) -> Result<()> {
        let path = self.out.join(SETTINGS_FILE);
        let text = serde_json::to_string_pretty(&self.run_settings)?;
        std::fs::write(&path, text).wrap_err_with(|| format!("{}", path.display()))
    }
}

/// What options of their own decide, and the option.
const OWNED: &[(&str, &str)] = &[
    (roles::LOG, "--log"),
    (roles::EGO, "--ego"),
    (roles::COOP, "--coop"),
    (roles::AGENTS, "--agents"),
    (roles::OFFLINE, "--offline"),
    (roles::OUT, "--out"),
    (roles::RUN_SETTINGS, "--link, --seed and the like"),
];

/// The runs of one graph. A log that cannot be played does not keep the others from it.
///
/// # Errors
/// Options that no run can follow; logs of which none can be played.
pub fn batch(args: &Args, mode: Mode, path: &Path, name: &str) -> Result<Batch> {
    batch_with(args, mode, path, name, &mut Networks::default())
}

/// The same with networks that other batches look at as well.
///
/// # Errors
/// As [`batch`].
pub fn batch_with(args: &Args, mode: Mode, path: &Path, name: &str, networks: &mut Networks) -> Result<Batch> {
    let mut set = settings(args)?;
    let graph = base_graph(args, &mut set, path, &[roles::LOG, roles::OUT])?;
    if mode == Mode::Realtime {
        report_machines(&graph, path);
    }
    let graph = graph.on_one_machine();
    let own = values(&graph, roles::OWN, str::to_string);
    if !own.is_empty() && !args.agents.is_empty() {
        bail!(
            "--agents: {} is the graph of one agent, {own}, and the others have graphs of their own: start those that take part, and \
             say by --ego whose this one is",
            path.display()
        );
    }
    // Making the demo log takes long; what a network lacks is known before.
    networks::find_all(&graph, args.choices.model.as_deref())?;
    let logs = logs(args, &graph)?;
    distinct(&logs)?;
    let mut planner = Planner {
        described: described::stages(&graph),
        compute: compute::profile(args.compute.as_deref(), &graph)?,
        args,
        mode,
        name,
        graph,
        own,
        set,
        logs,
        networks,
        unplayable: Unplayable::default(),
    };
    let mut plans = Vec::new();
    for log_path in planner.logs.clone() {
        plans.extend(planner.plans_of(&log_path)?);
    }
    Batch::new(plans, planner.unplayable)
}

/// Refuses logs of one name: the folders of their results would be the same.
fn distinct(logs: &[PathBuf]) -> Result<()> {
    let mut names: Vec<String> = Vec::new();
    for log in logs {
        let name = stem(log);
        if names.contains(&name) {
            bail!("two logs are named `{name}`: rename one, so that their results can be told apart");
        }
        names.push(name);
    }
    Ok(())
}

/// What makes the runs of one graph.
struct Planner<'a> {
    args: &'a Args,
    mode: Mode,
    /// The graph's name.
    name: &'a str,
    /// The graph with what `--set` and `--replace` say.
    graph: FlatGraph,
    /// The agent whose graph it is; empty where it is everybody's.
    own: String,
    set: Vec<Setting>,
    compute: ComputeProfile,
    logs: Vec<PathBuf>,
    networks: &'a mut Networks,
    unplayable: Unplayable,
    /// What results say of the graph.
    described: GraphStages,
}

impl Planner<'_> {
    /// The runs over one log; a log that cannot be played has none, and its reason is kept.
    fn plans_of(&mut self, log_path: &Path) -> Result<Vec<RunPlan>> {
        let stem = stem(log_path);
        let Some(log) = self.unplayable.check(&stem, Log::open(log_path)) else {
            return Ok(Vec::new());
        };
        if let Some(cut) = log.truncation() {
            eprintln!("realo: {}: {cut}", log_path.display());
        }
        let args = self.args;
        let coop = args.coop.unwrap_or_default();
        let ego = args.ego.as_deref().unwrap_or(&self.own);
        let plan = realo_player::plan(&log, ego, coop, &args.agents);
        let Some(plan) = self.unplayable.check(&stem, plan) else {
            return Ok(Vec::new());
        };
        let mut plans = Vec::new();
        for planned in plan.runs {
            if planned.collaborators.is_empty() {
                let ego = &planned.ego;
                eprintln!("realo: {stem}: no agent can collaborate with {ego} in mode {coop}: it runs alone");
            }
            plans.extend(self.plan(log_path, &log, &planned, coop.as_str())?);
        }
        Ok(plans)
    }

    /// The run of one ego; `None`, with its reason kept, where the log cannot give it.
    fn plan(&mut self, log_path: &Path, log: &Log, planned: &PlannedRun, coop: &str) -> Result<Option<RunPlan>> {
        let (args, stem) = (self.args, stem(log_path));
        let out = std::path::absolute(dir_of(args, self.name).join(&stem).join(&planned.ego))?;
        let decisions = Decisions {
            args,
            mode: self.mode,
            graph: self.name,
            log_path,
            log,
            ego: &planned.ego,
            coop,
            out: &out,
        };
        let (graph, mut settings) = decisions.apply(&self.graph, &self.set)?;
        let name = format!("{}, {stem}, {}", self.name, planned.ego);
        let localised = localization::check(&graph, log, planned);
        if self.unplayable.check(&name, localised).is_none() {
            return Ok(None);
        }
        let words = self.networks.check(&graph)?;
        (settings.isa, settings.model) = (words.kernels, words.models);
        settings.graph_hash = described::hash(&self.described);
        let played = fitting_protocols(&graph, log, &planned.ego)
            .and_then(|()| lane::precomputed(&graph, log, planned, args.offline, self.networks));
        let Some(played) = self.unplayable.check(&name, played) else {
            return Ok(None);
        };
        let graph = match played {
            Some((played, words)) => {
                settings.precomputed = words;
                played
            }
            None => graph,
        };
        let graph = self.checked(graph, &settings)?;
        let decided = [serde_json::to_string(&settings)?, serde_json::to_string(&self.compute)?];
        let fingerprint = resume::fingerprint(&graph, log_path, &out, &decided)?;
        Ok(Some(RunPlan {
            name,
            graph,
            seconds: log
                .span()
                .map_or(0.0, |(first, last)| realo_schemas::to_seconds(last - first)),
            truncated: log.truncation().is_some(),
            compute: self.compute.clone(),
            run_settings: RunSettings {
                log: log_path.to_string_lossy().into_owned(),
                machine: match self.mode {
                    Mode::Realtime => format!("{}, realo {}", realo_cli::cpu(), env!("CARGO_PKG_VERSION")),
                    _ => String::new(),
                },
                log_hash: resume::log_content(log_path)?,
                settings,
                graph: self.described.clone(),
                given: args.choices.given(),
                fingerprint,
            },
            out,
        }))
    }

    /// The graph as it runs; refused where it cannot.
    fn checked(&mut self, mut graph: FlatGraph, settings: &Settings) -> Result<FlatGraph> {
        let takes_no_time = self.args.compute.is_none() && settings.precomputed.is_empty();
        if self.mode == Mode::Virtual && takes_no_time {
            limit::leave_out_too_far(&mut graph, self.args.offline, self.networks)?;
        }
        refuse_to_overwrite(&graph, &self.logs)?;
        check(&graph)?;
        let checked = match self.mode {
            Mode::Realtime => super::check_nodes(&graph, super::Asked::All),
            // In virtual time the others are built before anything is started.
            Mode::Virtual => super::check_nodes(&graph, super::Asked::Operators),
        };
        checked.map_err(|error| eyre!("{} cannot run:\n  {error}", self.graph.file.display()))?;
        Ok(graph)
    }
}

/// Refuses protocols that cannot score the ego of the log.
fn fitting_protocols(graph: &FlatGraph, log: &Log, ego: &str) -> Result<()> {
    for node in deciding(graph, roles::PROTOCOL) {
        if let Some(name) = decided_argument(node, roles::PROTOCOL).and_then(|key| argument(node, key)) {
            protocol_fits(&Protocol::load(&name)?, log, ego)?;
        }
    }
    Ok(())
}

/// Says that all machines of a graph are this one.
pub(super) fn report_machines(graph: &FlatGraph, path: &Path) {
    let machines: Vec<&str> = graph.machines().into_iter().collect();
    if !machines.is_empty() {
        eprintln!(
            "realo: {}: what it has for the machines {} runs on this one; `dora start --attach {0}` starts it on theirs \
             (docs/reference/machines.md)",
            path.display(),
            machines.join(", ")
        );
    }
}

/// The lane of the agents that send, alone.
pub struct LaneRun {
    /// Its stages and the player, with all their arguments.
    pub graph: FlatGraph,
    /// The stage that gives packets to the link.
    pub stage: String,
    /// Its output.
    pub output: String,
    /// All that decides what it makes.
    pub described: Vec<LaneStage>,
    /// How long its stages take, if that is said.
    pub compute: Option<ComputeProfile>,
}

/// The lane that sends to the one ego of the one log of the options.
///
/// # Errors
/// As [`batch`]; a graph in which nobody sends what is made of sweeps.
pub fn lane(args: &Args) -> Result<LaneRun> {
    let mut set = settings(args)?;
    let path = &realo_cli::find::graph(&args.graphs[0])?;
    let base = base_graph(args, &mut set, path, &[roles::LOG, roles::OUT])?;
    let compute = args
        .compute
        .as_deref()
        .map(|profile| compute::profile(Some(profile), &base));
    let compute = compute.transpose()?;
    if let Some(stranger) = compute
        .iter()
        .find_map(|profile| profile.stranger(|id| base.node(id).is_some()))
    {
        bail!(
            "--compute: it names `{stranger}`, which is not a stage of {}",
            path.display()
        );
    }
    let log_path = std::path::absolute(&args.log[0])?;
    let log = Log::open(&log_path)?;
    let decisions = Decisions {
        args,
        mode: Mode::Virtual,
        graph: "",
        log_path: &log_path,
        log: &log,
        ego: args.ego.as_deref().unwrap_or_default(),
        coop: realo_player::Coop::All.as_str(),
        // Nothing is written there.
        out: Path::new("results"),
    };
    let (graph, settings) = decisions.apply(&base, &set)?;
    if args.choices.project.is_some() && settings.project.is_empty() {
        return Err(nobody_projects(&path.display().to_string()));
    }
    let mut networks = Networks::default();
    networks.check(&graph)?;
    check(&graph)?;
    let Some(lane) = SendingLane::of(&graph)? else {
        let file = path.display();
        bail!("{file}: no agent sends what it makes of its sweeps in this graph: there is nothing to precompute");
    };
    if lane.knows_ego(&graph) {
        eprintln!("realo: senders project: what they send is for {} alone", decisions.ego);
    }
    Ok(LaneRun {
        described: lane.described(&graph, &mut networks)?,
        graph: lane.cut_out(&graph),
        stage: lane.stage,
        output: lane.output,
        compute,
    })
}

/// The error of `--project` where it decides nothing.
pub fn nobody_projects(graphs: &str) -> Report {
    let node = takers(roles::PROJECT);
    eyre!("--project: no {node} of {graphs} gets the ego's states, so no sender can project")
}

/// What `--set` says.
pub(super) fn settings(args: &Args) -> Result<Vec<Setting>> {
    let mut set = args.choices.set.clone();
    choices::settle(&mut set);
    set.iter().map(|text| Ok(text.parse()?)).collect()
}

/// The graph of a file with what the options put into it; `needed`: roles that its nodes must have. Paths that are set become absolute:
/// they are relative to where the user is.
pub(super) fn base_graph(args: &Args, set: &mut [Setting], path: &Path, needed: &[&'static str]) -> Result<FlatGraph> {
    let graph = Graph::load(path)?;
    let graph = if args.choices.recorded_detections {
        graph.with_detection("recorded")
    } else {
        graph
    };
    let mut flat = graph.expand()?;
    replace::apply(&mut flat, &args.choices.replace, true)?;
    refuse_unfilled(&flat)?;
    anchor_paths(&mut flat)?;
    for needed in needed.iter().copied() {
        if deciding(&flat, needed).next().is_none() {
            let (file, node) = (flat.file.display(), takers(needed));
            bail!("{file}: expected a node `{node}`, found none; without it, start the graph with `dora run`");
        }
    }
    for setting in set {
        let node = flat.node(&setting.node);
        let decides = |decided| node.and_then(|node| decided_argument(node, decided)) == Some(&*setting.key);
        if let Some((_, option)) = OWNED.iter().find(|(decided, _)| decides(*decided)) {
            bail!("--set {}.{}: decided by {option}", setting.node, setting.key);
        }
        let known = node.and_then(registration);
        if is_path(known, &setting.key, &setting.value, Path::new("")) {
            setting.value = std::path::absolute(&setting.value)?.to_string_lossy().into_owned();
        }
        flat.set(&setting.node, &setting.key, &setting.value)?;
    }
    Ok(flat)
}

/// Refuses what a graph leaves open or says wrongly although the options of a run decide it: the same graph is started without
/// them too.
fn refuse_unfilled(graph: &FlatGraph) -> Result<()> {
    let file = graph.file.display();
    let findings: Vec<String> = realo_graph::written_findings(graph)
        .iter()
        .map(ToString::to_string)
        .collect();
    if !findings.is_empty() {
        bail!("{file} cannot run:\n  {}", findings.join("\n  "));
    }
    for node in &graph.nodes {
        let id = &node.id;
        for decided in [roles::LOG, roles::OUT] {
            let defaults = registration(node).map(|known| (known.defaults)());
            let may_be_empty = |argument: &str| defaults.as_ref().is_some_and(|defaults| defaults[argument] == "");
            let argument = decided_argument(node, decided).filter(|argument| !may_be_empty(argument));
            if let Some(argument) = argument.filter(|argument| given(node, argument) == Some("")) {
                bail!("{file}: node `{id}`: setting `{argument}`: expected a path, found nothing");
            }
        }
    }
    Ok(())
}

/// Refuses a graph that would record into a log that is played.
fn refuse_to_overwrite(graph: &FlatGraph, logs: &[PathBuf]) -> Result<()> {
    let same = |a: &Path, b: &Path| a.canonicalize().is_ok_and(|a| b.canonicalize().is_ok_and(|b| a == b));
    for node in deciding(graph, roles::RECORDING) {
        let argument = decided_argument(node, roles::RECORDING).unwrap_or_default();
        let path = PathBuf::from(given(node, argument).unwrap_or_default());
        if let Some(log) = logs.iter().find(|log| same(log, &path)) {
            let (id, log) = (&node.id, log.display());
            bail!("node `{id}` would record into {log}, which is played: choose another --out");
        }
    }
    Ok(())
}

/// The logs that are asked for, absolute; without any the graph's own, made first if it is the demo log.
fn logs(args: &Args, graph: &FlatGraph) -> Result<Vec<PathBuf>> {
    if !args.log.is_empty() {
        return args
            .log
            .iter()
            .map(|log| std::path::absolute(log).wrap_err_with(|| format!("{}", log.display())))
            .collect();
    }
    let log = deciding(graph, roles::LOG).find_map(|node| argument(node, decided_argument(node, roles::LOG)?));
    let log = log.ok_or_else(|| eyre!("{}: no node plays a log", graph.file.display()))?;
    let folder = std::path::absolute(graph.file.parent().unwrap_or(Path::new(".")))?;
    let log = normalized(&folder.join(log));
    if log.ends_with(demo::FILE) {
        demo::make(&log)?;
    }
    Ok(vec![log])
}

pub(super) fn stem(path: &Path) -> String {
    path.file_stem().unwrap_or_default().to_string_lossy().into_owned()
}

/// Refuses a graph with errors and prints its warnings.
fn check(graph: &FlatGraph) -> Result<()> {
    let missing = super::missing_programs(graph);
    if !missing.is_empty() {
        bail!("{} cannot run:\n  {}", graph.file.display(), missing.join("\n  "));
    }
    let findings = realo_graph::validate(graph, &registry());
    let warnings = findings.iter().filter(|f| f.severity == Severity::Warning);
    warnings.for_each(|finding| eprintln!("realo: {}: {finding}", graph.file.display()));
    let errors: Vec<String> = findings
        .iter()
        .filter(|f| f.severity == Severity::Error)
        .map(|finding| finding.to_string())
        .collect();
    if errors.is_empty() {
        return Ok(());
    }
    bail!("{} cannot run:\n  {}", graph.file.display(), errors.join("\n  "))
}
