//! Modules, replaced by their nodes exactly as `dora expand` does.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use serde_yaml::Value;

use super::read::{self, Module, Node};
use super::{FlatGraph, Graph, GraphError, Input, InputSource, params, paths};

/// dora's limit on modules within modules.
const MAX_DEPTH: usize = 8;

/// Where a module's outputs come from: output -> (node, its output).
type Outlets = BTreeMap<String, (String, String)>;

pub(super) fn expand(graph: &Graph) -> Result<FlatGraph, GraphError> {
    let root = graph.file.parent().unwrap_or(Path::new("/")).to_path_buf();
    let mut expansion = Expansion {
        root: &root,
        detection: graph.detection.as_deref(),
        swapped: 0,
        open: Vec::new(),
    };
    let nodes = expansion.nodes(graph.nodes.clone(), &root, &graph.file)?;
    if graph.detection.is_some() && expansion.swapped == 0 {
        return Err(GraphError::NoDetectModule {
            file: graph.file.clone(),
        });
    }
    let mut ids = BTreeSet::new();
    if let Some(node) = nodes.iter().find(|node| !ids.insert(&node.id)) {
        return Err(GraphError::Duplicate {
            file: graph.file.clone(),
            id: node.id.clone(),
        });
    }
    FlatGraph::new(graph.file.clone(), graph.settings.clone(), nodes)
}

struct Expansion<'a> {
    /// The graph's folder.
    root: &'a Path,
    /// Name of the detection that takes every other's place.
    detection: Option<&'a str>,
    /// Modules of detection.
    swapped: usize,
    /// The module files that are being expanded, outermost first.
    open: Vec<PathBuf>,
}

impl Expansion<'_> {
    /// The flat nodes of a graph whose modules' files are named relative to `base`.
    fn nodes(&mut self, nodes: Vec<Node>, base: &Path, file: &Path) -> Result<Vec<Node>, GraphError> {
        self.level(nodes, base, file).map(|(nodes, _)| nodes)
    }

    /// Replaces the modules among `nodes`; gives the flat nodes, and for each output name all that produce it.
    fn level(&mut self, nodes: Vec<Node>, base: &Path, file: &Path) -> Result<(Vec<Node>, Producers), GraphError> {
        let mut flat = Vec::new();
        let mut producers = Producers::new();
        let mut modules: BTreeMap<String, Outlets> = BTreeMap::new();
        for node in nodes {
            let Some(module) = node.module.clone() else {
                for output in &node.outputs {
                    producers
                        .entry(output.clone())
                        .or_default()
                        .push((node.id.clone(), output.clone()));
                }
                flat.push(node);
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

    /// The module that stands for `module`: another one where a detection is asked for.
    fn detection(&self, module: &str) -> String {
        let Some(name) = self.detection.filter(|_| is_detection(module)) else {
            return module.to_string();
        };
        match module.rsplit_once('/') {
            Some((folder, _)) => format!("{folder}/detect.{name}.yml"),
            None => format!("detect.{name}.yml"),
        }
    }

    fn module(
        &mut self,
        outer: &Node,
        module: &str,
        base: &Path,
        wrong: &dyn Fn(String) -> GraphError,
    ) -> Result<(Vec<Node>, Outlets), GraphError> {
        let place = paths::module(module, base, self.root).map_err(wrong)?;
        if self.open.contains(&place.canonical) {
            return Err(wrong(format!("its file {} uses itself", place.canonical.display())));
        }
        if self.open.len() >= MAX_DEPTH {
            return Err(wrong(format!("more than {MAX_DEPTH} modules within each other")));
        }
        let content = read::module(&place.canonical)?;
        check_inputs(&content, outer).map_err(wrong)?;
        params::check_names(&outer.params).map_err(wrong)?;
        let declared = content.outputs.clone();
        let name = content.name.clone();
        let inner = self.inner_nodes(content, outer, &place.folder).map_err(wrong)?;
        self.open.push(place.canonical.clone());
        let result = self.level(inner, &place.folder, &place.canonical);
        self.open.pop();
        let (mut nodes, producers) = result?;
        if let Some(build) = &outer.build {
            nodes.iter_mut().for_each(|node| prepend_build(node, build));
        }
        let outlets = outlets(&name, &declared, &producers).map_err(wrong)?;
        Ok((nodes, outlets))
    }

    /// The module's nodes as they stand in the outer graph, modules among them not yet replaced.
    fn inner_nodes(&self, module: Module, outer: &Node, folder: &Path) -> Result<Vec<Node>, String> {
        let siblings: BTreeSet<String> = module.nodes.iter().map(|node| node.id.clone()).collect();
        let mut nodes = Vec::new();
        for mut node in module.nodes {
            node.id = format!("{}.{}", outer.id, node.id);
            node.inputs = inner_inputs(&node.inputs, outer, &siblings, &module.inputs_optional)
                .map_err(|reason| format!("its node `{}`: {reason}", node.id))?;
            if let Some(path) = &node.path {
                let path = paths::from_module(path, folder, self.root);
                node.path = Some(path.map_err(|reason| format!("its node `{}`: {reason}", node.id))?);
            }
            node.deploy = node.deploy.or_else(|| outer.deploy.clone());
            for (name, value) in &outer.env {
                node.env.entry(name.clone()).or_insert_with(|| value.clone());
            }
            node.args = node.args.map(|args| params::substitute(&args, &outer.params));
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
            nodes.push(node);
        }
        Ok(nodes)
    }
}

/// For each output name, the nodes and outputs that make it.
type Producers = BTreeMap<String, Vec<(String, String)>>;

/// Whether a module file, by its name, detects and can be swapped for another that does.
pub(super) fn is_detection(module: &str) -> bool {
    let file = module.rsplit('/').next().unwrap_or(module);
    file.starts_with("detect.") && file.ends_with(".yml")
}

fn check_inputs(module: &Module, outer: &Node) -> Result<(), String> {
    if let Some(missing) = module.inputs.iter().find(|port| !outer.inputs.contains_key(*port)) {
        return Err(format!(
            "module `{}` needs the input `{missing}`; wire it under `inputs`",
            module.name
        ));
    }
    let declared: Vec<&str> = module
        .inputs
        .iter()
        .chain(&module.inputs_optional)
        .map(String::as_str)
        .collect();
    match outer.inputs.keys().find(|port| !declared.contains(&port.as_str())) {
        Some(port) => {
            let nearest = crate::config::nearest_name(port, declared.iter().copied());
            let hint = super::error::hint(&nearest);
            Err(format!(
                "module `{}` has no input `{port}`{hint}; it has: {}",
                module.name,
                declared.join(", ")
            ))
        }
        None => Ok(()),
    }
}

/// The inputs of a module's node as the outer graph wires them; an optional one without a wire is left out.
fn inner_inputs(
    inputs: &BTreeMap<String, Input>,
    outer: &Node,
    siblings: &BTreeSet<String>,
    optional: &BTreeSet<String>,
) -> Result<BTreeMap<String, Input>, String> {
    let mut wired = BTreeMap::new();
    for (port, input) in inputs {
        let mut input = input.clone();
        match &mut input.source {
            InputSource::Output { node, output } if node == "_mod" => match outer.inputs.get(output) {
                Some(wire) => input = input.fed_by(wire),
                None if optional.contains(output) => continue,
                None => return Err(format!("input `{port}`: the module declares no input `{output}`")),
            },
            InputSource::Output { node, .. } if siblings.contains(node) => *node = format!("{}.{node}", outer.id),
            InputSource::Output { .. } => {}
            InputSource::Builtin(source) => {
                let node = source
                    .strip_prefix("dora/logs/")
                    .and_then(|filter| filter.split_once('/'));
                if let Some((level, node)) = node.filter(|(_, node)| siblings.contains(*node)) {
                    *source = format!("dora/logs/{level}/{}.{node}", outer.id);
                }
            }
        }
        wired.insert(port.clone(), input);
    }
    Ok(wired)
}

fn outlets(module: &str, declared: &BTreeSet<String>, producers: &Producers) -> Result<Outlets, String> {
    let find = |output: &String| match producers.get(output).map(Vec::as_slice) {
        Some([source]) => Ok((output.clone(), source.clone())),
        None | Some([]) => Err(format!(
            "module `{module}` declares the output `{output}`, which none of its nodes makes"
        )),
        Some(many) => {
            let names: Vec<String> = many.iter().map(|(node, output)| format!("{node}/{output}")).collect();
            let names = names.join(", ");
            Err(format!(
                "module `{module}` declares the output `{output}`, which several of its nodes make: {names}; \
                 take it off the module's outputs and name the inner node where it is used"
            ))
        }
    };
    declared.iter().map(find).collect()
}

/// Turns inputs from modules into inputs from the nodes that make them.
fn rewire(node: &mut Node, modules: &BTreeMap<String, Outlets>, file: &Path) -> Result<(), GraphError> {
    for (port, input) in &mut node.inputs {
        let InputSource::Output { node: source, output } = &mut input.source else {
            continue;
        };
        let Some(outlets) = modules.get(source) else { continue };
        let Some((inner, inner_output)) = outlets.get(output) else {
            let known: Vec<&str> = outlets.keys().map(String::as_str).collect();
            let hint = super::error::hint(&crate::config::nearest_name(output, known.iter().copied()));
            let reason = format!(
                "it has no output `{output}`{hint}, which node `{}` takes for its input `{port}`; it has: {}",
                node.id,
                known.join(", ")
            );
            return Err(GraphError::Module {
                file: file.into(),
                node: source.clone(),
                reason,
            });
        };
        *source = inner.clone();
        *output = inner_output.clone();
    }
    Ok(())
}

fn prepend_build(node: &mut Node, build: &str) {
    node.build = Some(match node.build.take() {
        Some(existing) => format!("{build}\n{existing}"),
        None => build.to_string(),
    });
}
