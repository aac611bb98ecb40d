//! Modules, replaced by their nodes exactly as `dora expand` does; and those that `realo host` runs, whose nodes become
//! stages of one process.

mod hosting;
mod ports;
mod quoting;
mod size;
mod stages;

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use serde_yaml::Value;

use self::hosting::is_realo;
pub(super) use self::hosting::module_of;
pub use self::hosting::{OUTSIDE, hosted};
use self::ports::{check_inputs, check_params, inner_inputs, outlets, rewire};
use self::size::{Size, weight};
use super::read::{self, Module, Node, Part};
use super::{FlatGraph, Graph, GraphError, params, paths, variables};

/// dora's limit on modules within modules.
const MAX_DEPTH: usize = 8;

/// Where a module's outputs come from: output -> (node, its output).
type Outlets = BTreeMap<String, (String, String)>;

/// For each output name, the nodes and outputs that make it.
type Producers = BTreeMap<String, Vec<(String, String)>>;

pub(super) fn expand(graph: &Graph) -> Result<FlatGraph, GraphError> {
    Ok(as_dora(graph, false)?.with_short_names())
}

/// The graph with the names that dora gives; `alone`: one process, whose outputs are all taken.
pub(super) fn as_dora(graph: &Graph, alone: bool) -> Result<FlatGraph, GraphError> {
    let root = graph.file.parent().unwrap_or(Path::new("/")).to_path_buf();
    let mut expansion = Expansion {
        root: &root,
        variables: variables::of_graph(&graph.settings),
        alone,
        detection: graph.detection.as_deref(),
        swapped: 0,
        open: Vec::new(),
        host: None,
        hosts: BTreeMap::new(),
        size: Size::default(),
    };
    for node in &graph.nodes {
        let wrong = |reason| GraphError::Node {
            file: graph.file.clone(),
            node: node.id.clone(),
            reason,
        };
        expansion.size.take(1, weight(node)).map_err(wrong)?;
    }
    let mut nodes = graph.nodes.clone();
    for node in &mut nodes {
        fill_in(node, &expansion.variables, &graph.file)?;
    }
    let (processes, _) = expansion.level(nodes, &root, &graph.file)?;
    let mut ids = BTreeSet::new();
    if let Some(twice) = processes.iter().find(|node| !ids.insert(&node.id)) {
        return Err(GraphError::Duplicate {
            file: graph.file.clone(),
            id: twice.id.clone(),
        });
    }
    let mut nodes = expansion.with_stages(processes)?;
    if graph.detection.is_some() && expansion.swapped == 0 {
        return Err(GraphError::NoDetectModule {
            file: graph.file.clone(),
        });
    }
    if nodes.is_empty() {
        return Err(GraphError::Empty {
            file: graph.file.clone(),
            found: match graph.nodes.is_empty() {
                true => "an empty list",
                false => "modules without nodes alone",
            },
        });
    }
    let (mut stages, mut processes) = (BTreeSet::new(), BTreeSet::new());
    for node in &nodes {
        let (is_stage, is_process) = (node.part != Part::Host, !matches!(node.part, Part::In(_)));
        if is_stage && !stages.insert(&node.id) || is_process && !processes.insert(&node.id) {
            return Err(GraphError::Duplicate {
                file: graph.file.clone(),
                id: node.id.clone(),
            });
        }
    }
    // dora knows the outputs of a process, stages know whose they are.
    for node in nodes.iter_mut().filter(|node| node.part != Part::Host) {
        rewire(node, &expansion.hosts, &graph.file)?;
    }
    FlatGraph::new(graph.file.clone(), graph.settings.clone(), nodes)
}

/// Replaces the names of variables in the arguments of a process of ours.
fn fill_in(node: &mut Node, known: &BTreeMap<String, String>, file: &Path) -> Result<(), GraphError> {
    let args = node
        .args
        .as_deref()
        .filter(|_| node.path.as_deref().is_some_and(is_realo));
    let named = args.filter(|args| variables::named(args).is_some());
    let Some(words) = named.and_then(shlex::split) else {
        return Ok(());
    };
    let words = words
        .iter()
        .map(|word| variables::with_variables(word, |name| known.get(name).cloned()));
    let words: Vec<String> = words.collect();
    let args = shlex::try_join(words.iter().map(String::as_str)).map_err(|error| GraphError::Node {
        file: file.into(),
        node: node.id.clone(),
        reason: error.to_string(),
    })?;
    node.args = Some(args);
    Ok(())
}

struct Expansion<'a> {
    /// The graph's folder.
    root: &'a Path,
    /// What the graph says once for all its nodes.
    variables: BTreeMap<String, String>,
    /// Whether one process is looked at without those that take its outputs.
    alone: bool,
    /// Name of the detection that takes every other's place.
    detection: Option<&'a str>,
    /// Modules of detection.
    swapped: usize,
    /// The module files that are being expanded, outermost first.
    open: Vec<PathBuf>,
    /// The process that hosts what is being expanded.
    host: Option<String>,
    /// By process: where its outputs come from.
    hosts: BTreeMap<String, Outlets>,
    size: Size,
}

impl Expansion<'_> {
    /// Replaces the modules among `nodes`, whose files are named relative to `base`; gives the flat nodes, and for each
    /// output name all that produce it.
    fn level(&mut self, nodes: Vec<Node>, base: &Path, file: &Path) -> Result<(Vec<Node>, Producers), GraphError> {
        let mut flat = Vec::new();
        let mut producers = Producers::new();
        let mut modules = BTreeMap::new();
        for node in nodes {
            let Some(module) = node.module.clone() else {
                self.hosts_nothing(&node, file)?;
                for output in &node.outputs {
                    producers
                        .entry(output.clone())
                        .or_default()
                        .push((node.id.clone(), output.clone()));
                }
                flat.push(Node {
                    file: file.into(),
                    ..node
                });
                continue;
            };
            let wrong = |reason| GraphError::Module {
                file: file.into(),
                node: node.id.clone(),
                reason,
            };
            let (inner, outlets) = self.module(&node, &self.detection(&module), base, &wrong)?;
            self.swapped += usize::from(is_detection(&module));
            for (output, source) in &outlets {
                producers.entry(output.clone()).or_default().push(source.clone());
            }
            modules.insert(node.id.clone(), outlets);
            flat.extend(inner);
        }
        for node in &mut flat {
            rewire(node, &modules, file)?;
        }
        Ok((flat, producers))
    }

    /// The module that stands for `module`: another one where a detection is asked for. `detect.network.tracked.yml` becomes
    /// `detect.recorded.tracked.yml`: what a lane does with its boxes stays.
    fn detection(&self, module: &str) -> String {
        let Some(name) = self.detection.filter(|_| is_detection(module)) else {
            return module.to_string();
        };
        let (folder, file) = module.split_at(module.rfind('/').map_or(0, |at| at + 1));
        let words = file.strip_prefix("detect.").and_then(|words| words.split_once('.'));
        format!("{folder}detect.{name}.{}", words.map_or("yml", |(_, rest)| rest))
    }

    fn module(
        &mut self,
        outer: &Node,
        module: &str,
        base: &Path,
        wrong: &dyn Fn(String) -> GraphError,
    ) -> Result<(Vec<Node>, Outlets), GraphError> {
        let place = match self.host {
            Some(_) => paths::hosted_module(module, base),
            None => paths::module(module, base, self.root),
        };
        let place = place.map_err(wrong)?;
        if self.open.contains(&place.canonical) {
            return Err(wrong(format!("its file {} uses itself", place.canonical.display())));
        }
        if self.open.len() >= MAX_DEPTH {
            return Err(wrong(format!("more than {MAX_DEPTH} modules within each other")));
        }
        let content = read::module(&place.canonical)?;
        self.size.take(0, content.bytes).map_err(wrong)?;
        check_inputs(&content, outer).map_err(wrong)?;
        params::check_names(&outer.params).map_err(wrong)?;
        if self.host.is_none() {
            check_params(&content, outer).map_err(wrong)?;
        }
        let declared = content.outputs.clone();
        let name = content.name.clone();
        let inner = self.inner_nodes(content, outer, &place.folder).map_err(wrong)?;
        self.open.push(place.canonical.clone());
        let result = self.level(inner, &place.folder, &place.canonical);
        self.open.pop();
        let (mut nodes, producers) = result?;
        if let Some(build) = &outer.build {
            self.size.take(0, nodes.len() * build.len()).map_err(wrong)?;
            nodes.iter_mut().for_each(|node| prepend_build(node, build));
        }
        let outlets = outlets(&name, &declared, &producers).map_err(wrong)?;
        Ok((nodes, outlets))
    }

    /// The module's nodes as they stand in the outer graph, modules among them not yet replaced.
    fn inner_nodes(&mut self, module: Module, outer: &Node, folder: &Path) -> Result<Vec<Node>, String> {
        let siblings: BTreeSet<String> = module.nodes.iter().map(|node| node.id.clone()).collect();
        let mut nodes = Vec::new();
        for mut node in module.nodes {
            node.id = format!("{}.{}", outer.id, node.id);
            let takes = !node.inputs.is_empty();
            node.inputs = inner_inputs(&node.inputs, outer, &siblings, &module.inputs_optional)
                .map_err(|reason| format!("its node `{}`: {reason}", node.id))?;
            node.starved = takes && node.inputs.is_empty();
            if let Some(path) = node.path.as_ref().filter(|_| self.host.is_none()) {
                let path = paths::from_module(path, folder, self.root);
                node.path = Some(path.map_err(|reason| format!("its node `{}`: {reason}", node.id))?);
            }
            node.deploy = node.deploy.or_else(|| outer.deploy.clone());
            if node.path.as_deref().is_some_and(is_realo) {
                let check = quoting::check(node.args.as_deref().unwrap_or_default(), &outer.params, self.root);
                check.map_err(|reason| format!("its node `{}`: {reason}", node.id))?;
            }
            for (name, value) in &outer.env {
                node.env.entry(name.clone()).or_insert_with(|| value.clone());
            }
            node.args = node
                .args
                .map(|args| params::substitute(&args, &outer.params))
                .transpose()
                .map_err(|reason| format!("its node `{}`: {reason}", node.id))?;
            if self.host.is_none() {
                fill_in(&mut node, &self.variables, folder).map_err(|error| error.to_string())?;
            }
            for (key, value) in &outer.params {
                // dora sets the parameter as it is; in a file `$$` says so.
                node.env.insert(
                    format!("PARAM_{}", key.to_uppercase()),
                    Value::String(value.replace('$', "$$")),
                );
            }
            if let Some(build) = &module.build {
                prepend_build(&mut node, build);
            }
            self.size.take(1, weight(&node))?;
            nodes.push(node);
        }
        Ok(nodes)
    }
}

/// Whether a module file, by its name, detects and can be swapped for another that does.
pub(super) fn is_detection(module: &str) -> bool {
    let file = module.rsplit('/').next().unwrap_or(module);
    file.starts_with("detect.") && file.ends_with(".yml")
}

fn prepend_build(node: &mut Node, build: &str) {
    node.build = Some(match node.build.take() {
        Some(existing) => format!("{build}\n{existing}"),
        None => build.to_string(),
    });
}
