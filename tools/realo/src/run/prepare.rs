//! From options to runs: which graph, log and ego, with which arguments, and where results go.

use std::path::{Path, PathBuf};

use eyre::{Result, WrapErr, bail, eyre};
use realo_logs::{Log, Stream};
use realo_runtime::graph::{self, FlatGraph, FlatNode, Graph, Setting, Severity};

use super::{Args, Mode, dir_of};
use crate::{REGISTRY, demo};

/// One run: a graph over a log with an ego.
pub struct Cell {
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
    pub compute: Option<PathBuf>,
}

/// The operator that can project.
const ENCODER: &str = "transmission-encoder";

/// The runs of one graph.
pub fn cells(args: &Args, mode: Mode, path: &Path, name: &str) -> Result<Vec<Cell>> {
    let graph = base_graph(args, path)?;
    let logs = logs(args, &graph)?;
    let mut cells = Vec::new();
    let mut names = Vec::new();
    for log_path in &logs {
        let stem = log_path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        if names.contains(&stem) {
            bail!("two logs are named `{stem}`: rename one, so that their results can be told apart");
        }
        names.push(stem.clone());
        let log = Log::open(log_path)?;
        if let Some(cut) = log.truncation() {
            eprintln!("realo: {}: {cut}", log_path.display());
        }
        let coop = args.coop.map_or(realo_player::Coop::All, super::Coop::for_player);
        let plan = realo_player::plan(&log, args.ego.as_deref().unwrap_or_default(), coop, &args.agents)?;
        for planned in plan.runs {
            let ego = planned.ego;
            if planned.collaborators.is_empty() {
                eprintln!("realo: {stem}: no agent can collaborate with {ego} in mode {coop}: it runs alone");
            }
            let out = dir_of(args, name).join(&stem).join(&ego);
            let mut cell = Cell {
                name: format!("{name}, {stem}, {ego}"),
                graph: graph.clone(),
                seconds: log
                    .span()
                    .map_or(0.0, |(first, last)| realo_schemas::to_seconds(last - first)),
                truncated: log.truncation().is_some(),
                compute: args.compute.clone(),
                out,
            };
            set_arguments(&mut cell, args, mode, name, log_path, &log, &ego, coop.as_str())?;
            check(&cell.graph)?;
            cells.push(cell);
        }
    }
    Ok(cells)
}

fn base_graph(args: &Args, path: &Path) -> Result<FlatGraph> {
    let graph = Graph::load(path)?;
    let graph = if args.recorded_detections {
        graph.with_recorded_detections()
    } else {
        graph
    };
    let mut flat = graph.expand()?;
    anchor_paths(&mut flat)?;
    let takes_states = |node: &FlatNode| {
        let encoder = node.registration(&REGISTRY).is_some_and(|known| known.name == ENCODER);
        encoder && node.inputs.contains_key("state")
    };
    if args.project.is_some() && !flat.nodes.iter().any(takes_states) {
        bail!(
            "--project: {} has no {ENCODER} whose input `state` gets the ego's states, so no sender can project",
            flat.file.display()
        );
    }
    for text in &args.set {
        let setting: Setting = text.parse()?;
        flat.set(&setting.node, &setting.key, &setting.value)?;
    }
    Ok(flat)
}

/// Makes the paths that a graph gives in its arguments absolute. A value that begins with `./` or `../` is one, seen from
/// the graph's folder, where dora starts the nodes.
fn anchor_paths(graph: &mut FlatGraph) -> Result<()> {
    let folder = std::path::absolute(graph.file.parent().unwrap_or(Path::new(".")))?;
    for node in &mut graph.nodes {
        let relative = |setting: &String| {
            let (key, value) = setting.split_once('=')?;
            let is_path = value.starts_with("./") || value.starts_with("../");
            is_path.then(|| (key.to_string(), lexically_normal(&folder.join(value))))
        };
        let found: Vec<(String, PathBuf)> = node.settings().iter().filter_map(relative).collect();
        for (key, path) in found {
            node.set(&key, &path.to_string_lossy());
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
    let player = graph
        .nodes
        .iter()
        .find(|node| node.registration(&REGISTRY).is_some_and(|r| r.name == "player"));
    let player = player.ok_or_else(|| eyre!("{}: no node `player` to play a log", graph.file.display()))?;
    let written = player
        .settings()
        .iter()
        .find_map(|arg| arg.strip_prefix("log="))
        .map(PathBuf::from);
    let log = written.unwrap_or_else(|| realo_player::Config::default().log);
    let log = lexically_normal(&std::path::absolute(
        graph.file.parent().unwrap_or(Path::new(".")).join(log),
    )?);
    if log.ends_with(demo::FILE) {
        demo::make(&log)?;
    }
    Ok(vec![log])
}

/// The path without `..`, as it is written (no link is followed).
fn lexically_normal(path: &Path) -> PathBuf {
    let mut normal = PathBuf::new();
    for part in path.components() {
        match part {
            std::path::Component::ParentDir => drop(normal.pop()),
            part => normal.push(part),
        }
    }
    normal
}

#[allow(clippy::too_many_arguments)]
fn set_arguments(
    cell: &mut Cell,
    args: &Args,
    mode: Mode,
    name: &str,
    log_path: &Path,
    log: &Log,
    ego: &str,
    coop: &str,
) -> Result<()> {
    let out = std::path::absolute(&cell.out)?;
    let stem = log_path.file_stem().unwrap_or_default().to_string_lossy();
    let mode_name = if args.offline { "offline" } else { mode.as_str() };
    let agents = args.agents.join(",");
    let protocol = args.protocol.as_deref().unwrap_or(&log.info().protocol);
    let log_path = log_path.to_string_lossy();
    let folder = out.to_string_lossy();
    let recording = out.join("recording.mcap");
    let mut settings = vec![
        ("player", "log", &*log_path),
        ("player", "ego", ego),
        ("player", "coop", coop),
        ("player", "agents", &agents),
        ("evaluator", "protocol", protocol),
        ("recorder", "path", recording.to_str().unwrap_or_default()),
        ("results", "out", &*folder),
        ("results", "graph", name),
        ("results", "log", &*stem),
        ("results", "mode", mode_name),
        ("results", "coop", coop),
        ("results", "ego", ego),
        ("link", "ego", ego),
    ];
    let has = |stream| log.info().agents.iter().any(|agent| log.has(&agent.name, stream));
    if has(Stream::Sweeps) && !has(Stream::Points) {
        eprintln!("realo: {stem}: a log without points; its sweeps are played empty");
        settings.push(("player", "points", "false"));
    }
    let model = args.model.as_ref().map(std::path::absolute).transpose()?;
    let model = model.as_deref().map(Path::to_string_lossy);
    for stage in ["pillar-encoder", "detection-head"] {
        settings.extend(model.as_deref().map(|model| (stage, "model", model)));
    }
    if args.recorded_detections {
        settings.push(("player", "detections", "required"));
    }
    if let Some(project) = args.project {
        settings.push((ENCODER, "project", project.as_str()));
    }
    if args.offline {
        settings.extend(["player", "link", "feature-bank"].map(|stage| (stage, "offline", "true")));
    }
    let rate = args.rate.map(|rate| rate.to_string());
    settings.extend(rate.as_deref().map(|rate| ("player", "rate", rate)));
    for stage in ["link", "results"] {
        let key = if stage == "link" { "profile" } else { "link" };
        settings.extend(args.link.as_deref().map(|profile| (stage, key, profile)));
    }
    let seed = args.seed.map(|seed| seed.to_string());
    for stage in ["link", "results"] {
        settings.extend(seed.as_deref().map(|seed| (stage, "seed", seed)));
    }
    let compute = args
        .compute
        .as_ref()
        .and_then(|path| path.file_stem())
        .map(|stem| stem.to_string_lossy());
    settings.extend(compute.as_deref().map(|compute| ("results", "compute", compute)));
    let graph = &mut cell.graph;
    for (stage, key, value) in settings {
        let of_stage = |node: &&mut FlatNode| {
            let known = node.registration(&REGISTRY).is_some_and(|known| known.name == stage);
            known && (key != "project" || node.inputs.contains_key("state"))
        };
        graph
            .nodes
            .iter_mut()
            .filter(of_stage)
            .for_each(|node| node.set(key, value));
    }
    // What the user set by hand stands above what the options imply.
    for text in &args.set {
        let setting: Setting = text.parse()?;
        graph.set(&setting.node, &setting.key, &setting.value)?;
    }
    Ok(())
}

/// Refuses a graph with errors and prints its warnings.
fn check(graph: &FlatGraph) -> Result<()> {
    let findings = graph::validate(graph, &REGISTRY);
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
