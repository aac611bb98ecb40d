//! Compute profiles: of a run, what its stages really took; of the paper, its inference times.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use eyre::{Result, WrapErr, bail, eyre};
use realo_graph::{FlatGraph, FlatNode};
use realo_host::ComputeProfile;
use realo_methods::Model;
use realo_results::Run;

use super::Mode;
use super::nodes::{argument, decided_argument, deciding};
use crate::{registry, roles};
use realo_cli::paper::PaperTimes;

/// Name of the profile that charges what the paper measured.
const PAPER: &str = "paper";
/// Name of the profile that charges what calls take on this machine while they are made.
const MEASURED: &str = "measured";
/// What a run leaves whose calls take time.
pub const FILE: &str = "compute.toml";
/// How it begins, whichever run left it.
pub const HEAD: &str = "# Median duration of each stage's calls in a ";

/// Whether a run wrote a file of that name.
pub fn is_of_run(text: &[u8]) -> bool {
    text.starts_with(HEAD.as_bytes())
}

/// The profile that is asked for: a file, `paper` or `measured`; without one computing takes no time.
///
/// # Errors
/// A file that is no profile; `paper` for a graph without a network.
pub fn profile(named: Option<&Path>, graph: &FlatGraph) -> Result<ComputeProfile> {
    match named {
        None => Ok(ComputeProfile::default()),
        Some(name) if name == Path::new(PAPER) => paper(graph),
        Some(name) if is_measured(name) => Ok(ComputeProfile::as_measured()),
        Some(path) => ComputeProfile::read(path)
            .map_err(|error| eyre!("--compute: expected a file, `{PAPER}` or `{MEASURED}`: {error}")),
    }
}

/// Whether a profile is what calls take on this machine while they are made.
pub fn is_measured(named: &Path) -> bool {
    named == Path::new(MEASURED)
}

/// Refuses to measure calls where several runs go on at a time.
///
/// # Errors
/// If it is asked for.
pub fn refuse_measured<'a>(mut named: impl Iterator<Item = &'a Path>) -> Result<()> {
    if named.any(is_measured) {
        bail!(
            "--compute {MEASURED}: a sweep makes several runs at a time, so none has the machine to itself: measure once by `realo run \
             --mode virtual --compute {MEASURED}`, and give the sweep the {FILE} that it leaves"
        );
    }
    Ok(())
}

/// Writes `compute.toml`: the median duration of each stage's calls, by what triggered them.
pub fn write(dir: &Path, mode: Mode, run: &Run) -> Result<()> {
    let profile = ComputeProfile::to_toml(&run.timing.compute_ns);
    let kind = match mode {
        Mode::Realtime => "realtime run",
        Mode::Virtual => "run in virtual time that measured them",
    };
    let head = format!("{HEAD}{kind}, ns. For `realo run --mode virtual --compute`.\n");
    std::fs::write(dir.join(FILE), head + &profile)?;
    Ok(())
}

/// The paper's inference time of the method, charged to the ego's last network stage.
fn paper(graph: &FlatGraph) -> Result<ComputeProfile> {
    let own = of_the_ego(graph);
    let ranks = graph.ranks(&registry())?;
    let networks = graph
        .nodes
        .iter()
        .enumerate()
        .filter(|(index, node)| own.contains(index) && decided_argument(node, roles::MODEL).is_some());
    let Some((_, last)) = networks.max_by_key(|(index, _)| ranks[*index]) else {
        bail!(
            "--compute {PAPER}: {} has no network of the ego whose time the paper tells: drop it, or --recorded-detections",
            graph.file.display()
        );
    };
    let times = PaperTimes::get();
    let method = own
        .iter()
        .filter_map(|index| times.inference(graph.nodes[*index].registration(&registry())?.name));
    let named = decided_argument(last, roles::MODEL).and_then(|name| argument(last, name));
    let path = graph.file.with_file_name(named.unwrap_or_default());
    let network = Model::read(&path).wrap_err_with(|| format!("node `{}`", last.id))?.arch;
    let of_network = || times.inference(&network.to_string());
    let Some(nanos) = method.max().or_else(of_network) else {
        bail!("--compute {PAPER}: the paper tells no time of `{network}`: drop it");
    };
    Ok(ComputeProfile {
        nanos: BTreeMap::from([(last.id.clone(), nanos)]),
        ..ComputeProfile::default()
    })
}

/// The stages whose outputs reach the results without crossing a link.
fn of_the_ego(graph: &FlatGraph) -> BTreeSet<usize> {
    let place = |id: &str| graph.nodes.iter().position(|node| node.id == id);
    let mut open: Vec<usize> = deciding(graph, roles::OUT).filter_map(|node| place(&node.id)).collect();
    let mut own = BTreeSet::new();
    let is_link = |node: &FlatNode| decided_argument(node, roles::LINK).is_some();
    while let Some(index) = open.pop() {
        let node = &graph.nodes[index];
        if is_link(node) || !own.insert(index) {
            continue;
        }
        let sources = node.inputs.values().filter_map(|input| input.output());
        open.extend(sources.filter_map(|(source, _)| place(source)));
    }
    own
}

#[cfg(test)]
mod tests {
    use realo_graph::Graph;

    use super::*;

    fn graph(name: &str) -> FlatGraph {
        let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
        FlatGraph::load(&root.join(format!("dataflows/{name}.yml"))).unwrap()
    }

    #[test]
    fn the_papers_time_is_charged_to_the_egos_last_network_stage() {
        let cases = [
            ("no_fusion", "ego.head", 43_700_000),
            ("late_fusion", "ego.head", 43_700_000),
            ("late_fusion_tracked", "ego.head", 43_700_000),
            ("early_fusion", "fusion.head", 80_900_000),
            ("fcooper", "fusion.head", 61_600_000),
            ("attfuse", "fusion.head", 68_600_000),
        ];
        for (name, stage, nanos) in cases {
            let profile = profile(Some(Path::new("paper")), &graph(name)).unwrap();
            assert_eq!(profile.nanos, [(stage.to_string(), nanos)].into(), "{name}");
        }
        let recorded = Graph::load(Path::new(&graph("late_fusion").file))
            .unwrap()
            .with_detection("recorded");
        let error = profile(Some(Path::new("paper")), &recorded.expand().unwrap()).unwrap_err();
        assert!(error.to_string().contains("no network of the ego"), "{error}");
    }
}
