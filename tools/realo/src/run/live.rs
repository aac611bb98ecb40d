//! Runs of a graph that plays no log: it goes on with what programs bring from outside, until Ctrl-C or until they end.

use std::path::{Path, PathBuf};

use eyre::{Result, bail, eyre};
use realo_cli::{Outcome, find, signals};
use realo_graph::{FlatGraph, Graph};

use super::folders::Folders;
use super::nodes::{argument, decide, decided_argument, deciding, set_model};
use super::realtime::{self, Started};
use super::{Args, Asked, Choices, Mode, check_nodes, machine, prepare, show};
use crate::roles;

/// The file of a graph that plays no log; `None` of all others.
pub fn asked(args: &Args) -> Option<PathBuf> {
    let [only] = &args.graphs[..] else { return None };
    // What cannot be found or read is said by the run of a log.
    let file = find::graph(only).ok()?;
    let graph = Graph::load(&file).ok()?.expand().ok()?;
    let mut programs = graph.nodes.iter().filter(|node| node.program().is_some());
    let brings = programs.any(|node| node.inputs.is_empty());
    let plays = deciding(&graph, roles::LOG).next().is_some();
    (brings && !plays).then_some(file)
}

/// Runs the graph of a file, and prints what came out.
///
/// # Errors
/// Options that need a log; what keeps the graph from running; which node failed.
pub fn main(args: &Args, file: &Path) -> Result<Outcome> {
    if let Some(option) = of_logs(args) {
        let file = file.display();
        bail!(
            "{option}: {file} plays no log, but what its programs bring; drop the option, or set what they take by --set"
        );
    }
    let graph = prepared(args, file)?;
    let results = deciding(&graph, roles::OUT).find_map(|node| argument(node, decided_argument(node, roles::OUT)?));
    let out = PathBuf::from(results.ok_or_else(|| eyre!("{}: expected a folder of results", file.display()))?);
    let name = file.file_stem().unwrap_or_default().to_string_lossy();
    check_nodes(&graph, Asked::All).map_err(|error| eyre!("{} cannot run:\n  {error}", file.display()))?;
    signals::begin();
    let mut folders = Folders::default();
    folders.lock(&out)?;
    folders.claim(&out, &recordings(&graph, &out))?;
    machine::open_doors(&graph)
        .iter()
        .for_each(|line| eprintln!("realo: {line}"));
    let started = Started {
        name: &name,
        graph: &graph,
        out: &out,
        seconds: None,
    };
    realtime::start(&started, 1.0, None)?;
    folders.keep_new();
    drop(folders);
    let run = realo_report::pool(&[realo_results::read_run(&out)?])?;
    let shown = Args {
        out: Some(out.clone()),
        ..args.clone()
    };
    show(&shown, &[(&*name, run)], &[]);
    Ok(match signals::first() {
        Some(ending) => {
            eprintln!("realo: ended by {ending}; these are the results until then");
            Outcome::Ended(ending.number())
        }
        None => Outcome::Complete,
    })
}

/// What its recorders write into the folder of results.
fn recordings(graph: &FlatGraph, out: &Path) -> Vec<PathBuf> {
    let nodes = deciding(graph, roles::RECORDING);
    let files = nodes.filter_map(|node| argument(node, decided_argument(node, roles::RECORDING)?));
    files.map(PathBuf::from).filter(|file| file.starts_with(out)).collect()
}

/// The graph with what the options put into it.
fn prepared(args: &Args, file: &Path) -> Result<FlatGraph> {
    let mut set = prepare::settings(args)?;
    let graph = prepare::base_graph(args, &mut set, file, &[roles::OUT])?;
    prepare::report_machines(&graph, file);
    let mut graph = graph.on_one_machine();
    if let Some(model) = &args.choices.model {
        set_model(&mut graph, model)?;
    }
    if let Some(out) = &args.out {
        let out = std::path::absolute(out)?;
        decide(&mut graph, roles::OUT, &out.to_string_lossy());
        for node in &mut graph.nodes {
            if let Some(key) = decided_argument(node, roles::RECORDING) {
                let file = PathBuf::from(argument(node, key).unwrap_or_default());
                let name = file.file_name().unwrap_or("recording.mcap".as_ref());
                node.set(key, &out.join(name).to_string_lossy());
            }
        }
    }
    Ok(graph)
}

/// The first option that only a run of a log has.
fn of_logs(args: &Args) -> Option<&'static str> {
    let Choices {
        link,
        localization,
        map,
        recorded_detections,
        isa,
        precision,
        device,
        stamps,
        project,
        seed,
        model: _,
        set: _,
        replace: _,
    } = &args.choices;
    let given = [
        ("--log", !args.log.is_empty()),
        ("--offline", args.offline),
        ("--mode virtual", args.mode == Some(Mode::Virtual)),
        ("--rate", args.rate.is_some()),
        ("--coop", args.coop.is_some()),
        ("--ego", args.ego.is_some()),
        ("--agents", !args.agents.is_empty()),
        ("--compute", args.compute.is_some()),
        ("--protocol", args.protocol.is_some()),
        ("--no-cost", args.no_cost),
        ("--resume", args.resume),
        ("--view and --foxglove", args.view.is_asked()),
        ("--link", link.is_some()),
        ("--localization", localization.is_some()),
        ("--map", map.is_some()),
        ("--recorded-detections", *recorded_detections),
        ("--isa", isa.is_some()),
        ("--precision", precision.is_some()),
        ("--device", device.is_some()),
        ("--stamps", stamps.is_some()),
        ("--project", project.is_some()),
        ("--seed", seed.is_some()),
    ];
    given
        .into_iter()
        .find_map(|(option, is_given)| is_given.then_some(option))
}
