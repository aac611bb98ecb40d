//! Modules, replaced by their nodes exactly as `dora expand` does; and those that `realo host` runs, whose nodes become
//! stages of one process.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use realo_documents::shown;
use serde_yaml::Value;

use super::read::{self, Module, Node, Part};
use super::{FlatGraph, Graph, GraphError, Input, InputSource, params, paths, variables};

/// dora's limit on modules within modules.
const MAX_DEPTH: usize = 8;

/// Stands for whoever feeds the inputs of a module that is looked at alone.
pub const OUTSIDE: &str = "_outside";

/// The stages of a module that a process of this id hosts, with `inner.key=value` settings.
///
/// `ports`: the inputs and outputs that the graph gives the process (`None`: all of the module); its inputs come from
/// [`OUTSIDE`]. The module's file is seen from `folder`.
///
/// # Errors
/// [`GraphError`] for a module that cannot be read or does not have these ports, or a setting of none of its stages.
pub fn hosted(
    id: &str,
    module: &str,
    settings: &[String],
    ports: Option<(&[String], &[String])>,
    folder: &Path,
) -> Result<FlatGraph, GraphError> {
    let file = paths::absolute(&folder.join(module))?;
    let (inputs, outputs) = match ports {
        Some((inputs, outputs)) => (inputs.to_vec(), outputs.to_vec()),
        None => {
            let declared = read::module(&file)?;
            let inputs = declared.inputs.into_iter().chain(declared.inputs_optional);
            (inputs.collect(), declared.outputs.into_iter().collect())
        }
    };
    let outside = |port: &String| (port.clone(), Input::from_outside(port));
    let words = ["host", module].into_iter().chain(settings.iter().map(String::as_str));
    let args = shlex::try_join(words).map_err(|error| GraphError::Node {
        file: file.clone(),
        node: id.into(),
        reason: error.to_string(),
    })?;
    let node = Node {
        id: id.into(),
        path: Some("realo".into()),
        args: Some(args),
        inputs: inputs.iter().map(outside).collect(),
        outputs: outputs.into_iter().collect(),
        ..Node::default()
    };
    let graph = Graph {
        file: paths::absolute(&folder.join(id))?,
        settings: Default::default(),
        nodes: vec![node],
        detection: None,
    };
    as_dora(&graph, true)
}

/// Where a module's outputs come from: output -> (node, its output).
type Outlets = BTreeMap<String, (String, String)>;

pub(super) fn expand(graph: &Graph) -> Result<FlatGraph, GraphError> {
    Ok(as_dora(graph, false)?.with_short_names())
}

/// The graph with the names that dora gives; `alone`: one process, whose outputs are all taken.
fn as_dora(graph: &Graph, alone: bool) -> Result<FlatGraph, GraphError> {
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

/// Nodes that a graph may have with all its modules replaced: more than a machine runs processes and threads for.
const MAX_NODES: usize = 1024;
/// What their texts and the files of all modules may have, each as often as it is used, bytes.
const MAX_TEXT: usize = 8 << 20;

/// How large a graph has become: modules that use others twice make it twice as large with every one.
#[derive(Default)]
struct Size {
    nodes: usize,
    text: usize,
}

impl Size {
    fn take(&mut self, nodes: usize, text: usize) -> Result<(), String> {
        self.nodes += nodes;
        self.text = self.text.saturating_add(text);
        if self.nodes > MAX_NODES {
            return Err(format!(
                "expected at most {MAX_NODES} nodes in the graph with all its modules replaced, found more; \
                 look for a module that is used again and again"
            ));
        }
        if self.text > MAX_TEXT {
            return Err(format!(
                "expected at most {MAX_TEXT} bytes of text in the graph with all its modules replaced, found more; \
                 look for a long text that goes into many nodes: `env`, `build`, `params`"
            ));
        }
        Ok(())
    }
}

/// Bytes of a node's texts.
fn weight(node: &Node) -> usize {
    let texts = |map: &BTreeMap<String, String>| map.iter().map(|(key, value)| key.len() + value.len()).sum::<usize>();
    let optional = |text: &Option<String>| text.as_ref().map_or(0, String::len);
    let inputs = node.inputs.iter().map(|(port, input)| {
        let source = match &input.source {
            InputSource::Output { node, output } => node.len() + output.len(),
            InputSource::Builtin(source) => source.len(),
        };
        port.len() + source
    });
    let env = node.env.iter().map(|(name, value)| name.len() + weight_of(value));
    node.id.len()
        + [&node.path, &node.module, &node.args, &node.build]
            .map(optional)
            .iter()
            .sum::<usize>()
        + [&node.params, &node.input_types, &node.output_types]
            .map(texts)
            .iter()
            .sum::<usize>()
        + inputs.chain(env).sum::<usize>()
        + node.outputs.iter().map(String::len).sum::<usize>()
        + node.deploy.as_ref().map_or(0, weight_of)
        + node
            .other
            .iter()
            .map(|(key, value)| weight_of(key) + weight_of(value))
            .sum::<usize>()
}

fn weight_of(value: &Value) -> usize {
    match value {
        Value::Null | Value::Bool(_) | Value::Number(_) => 1,
        Value::String(text) => 1 + text.len(),
        Value::Sequence(list) => 1 + list.iter().map(weight_of).sum::<usize>(),
        Value::Mapping(map) => {
            1 + map
                .iter()
                .map(|(key, value)| weight_of(key) + weight_of(value))
                .sum::<usize>()
        }
        Value::Tagged(tagged) => 1 + weight_of(&tagged.value),
    }
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

    /// Refuses a host within a host.
    fn hosts_nothing(&self, node: &Node, file: &Path) -> Result<(), GraphError> {
        match (&self.host, hosted_by(node, file)?) {
            (Some(host), Some(Hosted { module, .. })) => Err(GraphError::Module {
                file: file.into(),
                node: node.id.clone(),
                reason: format!(
                    "it stands in a module that `{host}` hosts: write `module: {module}`, its stages run in the same process"
                ),
            }),
            _ => Ok(()),
        }
    }

    /// The processes, and behind each host its stages.
    fn with_stages(&mut self, processes: Vec<Node>) -> Result<Vec<Node>, GraphError> {
        let mut taken: BTreeSet<(String, String)> = BTreeSet::new();
        let offered: BTreeMap<&str, Vec<&str>> = processes
            .iter()
            .filter(|node| is_host(node))
            .map(|node| (node.id.as_str(), node.outputs.iter().map(String::as_str).collect()))
            .collect();
        for node in &processes {
            for (port, input) in &node.inputs {
                let Some((source, output)) = input.output() else {
                    continue;
                };
                taken.insert((source.into(), output.into()));
                if let Some(offered) = offered.get(source).filter(|offered| !offered.contains(&output)) {
                    return Err(GraphError::Module {
                        file: node.file.clone(),
                        node: source.into(),
                        reason: no_output(output, offered, &node.id, port),
                    });
                }
            }
        }
        let mut nodes = Vec::new();
        for node in processes {
            let Some(hosted) = hosted_by(&node, &node.file)? else {
                nodes.push(node);
                continue;
            };
            let is_taken = |output: &String| self.alone || taken.contains(&(node.id.clone(), output.clone()));
            let used: BTreeSet<String> = node.outputs.iter().filter(|output| is_taken(output)).cloned().collect();
            let (stages, outlets) = self.host(&node, &hosted, &used)?;
            self.hosts.insert(node.id.clone(), outlets);
            nodes.extend(stages);
        }
        Ok(nodes)
    }

    /// The process of a host, and its stages: those that something needs of which an output is in `used`. Its module's file
    /// is seen from the graph's folder, where dora starts it.
    fn host(
        &mut self,
        node: &Node,
        Hosted { module, settings }: &Hosted,
        used: &BTreeSet<String>,
    ) -> Result<(Vec<Node>, Outlets), GraphError> {
        let wrong = |reason| GraphError::Module {
            file: node.file.clone(),
            node: node.id.clone(),
            reason,
        };
        let module = self.detection(module);
        self.swapped += usize::from(is_detection(&module));
        let outer = Node {
            params: BTreeMap::new(),
            ..node.clone()
        };
        self.host = Some(node.id.clone());
        let expanded = self.module(&outer, &module, self.root, &wrong);
        self.host = None;
        let (mut stages, mut outlets) = expanded?;
        if let Some(output) = used.iter().find(|output| !outlets.contains_key(*output)) {
            let known: Vec<&str> = outlets.keys().map(String::as_str).collect();
            let hint = super::error::hint(&realo_operator::config::nearest_name(output, known.iter().copied()));
            let known = known.join(", ");
            return Err(wrong(format!(
                "its module has no output `{output}`{hint}; it has: {known}"
            )));
        }
        let offered: Outlets = outlets
            .clone()
            .into_iter()
            .filter(|(output, _)| node.outputs.contains(output))
            .collect();
        outlets.retain(|output, _| used.contains(output));
        for setting in settings {
            take_inputs(&mut stages, &node.id, setting).map_err(&wrong)?;
        }
        leave_out(&mut stages, &outlets);
        let is_left = |stage: &String| stages.iter().any(|left| left.id == *stage);
        if let Some((output, (stage, _))) = outlets.iter().find(|(_, (stage, _))| !is_left(stage)) {
            return Err(wrong(format!(
                "nothing comes out of its output `{output}`: nobody feeds the stage `{stage}` behind it; wire the optional \
                 inputs that it needs, or take the output away"
            )));
        }
        past_the_module(node, &stages).map_err(&wrong)?;
        for stage in &mut stages {
            stage.part = Part::In(node.id.clone());
            // A program that is not realo is refused by the checks under its own name.
            if stage.path.as_deref().is_some_and(is_realo) {
                stage.path.clone_from(&node.path);
            }
        }
        for setting in settings {
            set_inner(&mut stages, &node.id, setting).map_err(&wrong)?;
        }
        let file = paths::hosted_module(&module, self.root).map_err(&wrong)?;
        let named = Path::new(&module).file_name().unwrap_or_default();
        let words = [
            "host".to_string(),
            file.folder.join(named).to_string_lossy().into_owned(),
        ];
        let words = words.iter().chain(settings).map(String::as_str);
        let args = shlex::try_join(words).map_err(|error| wrong(error.to_string()))?;
        let process = Node {
            args: Some(args),
            part: Part::Host,
            outlets,
            ..node.clone()
        };
        stages.insert(0, process);
        Ok((stages, offered))
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

/// What `realo host` is asked to run.
struct Hosted {
    module: String,
    settings: Vec<String>,
}

fn is_realo(path: &str) -> bool {
    Path::new(path).file_name().is_some_and(|name| name == "realo")
}

/// A setting as hosts read it: `stage=program PATH …` and `stage=operator NAME …` put another stage in the place of one.
fn whole_stage(setting: String) -> String {
    match setting.split_once('=') {
        Some((stage, words)) if words.starts_with("program ") || words.starts_with("operator ") => {
            let stage = stage
                .strip_suffix(super::flat::STAGE)
                .and_then(|inner| inner.strip_suffix('.'))
                .unwrap_or(stage);
            format!("{stage}.{}={words}", super::flat::STAGE)
        }
        _ => setting,
    }
}

/// The module that a node's process hosts; `None` for any other node.
fn hosted_by(node: &Node, file: &Path) -> Result<Option<Hosted>, GraphError> {
    if !node.path.as_deref().is_some_and(is_realo) {
        return Ok(None);
    }
    let words = shlex::split(node.args.as_deref().unwrap_or_default()).unwrap_or_default();
    let mut words = words.into_iter();
    if words.next().as_deref() != Some("host") {
        return Ok(None);
    }
    match words.next() {
        Some(module) if module.len() > read::MAX_PATH => Err(GraphError::Node {
            file: file.into(),
            node: node.id.clone(),
            reason: format!(
                "expected the file of a module behind `host`, found `{}`",
                shown(&module)
            ),
        }),
        Some(module) => Ok(Some(Hosted {
            module,
            settings: words.map(whole_stage).collect(),
        })),
        None => Err(GraphError::Node {
            file: file.into(),
            node: node.id.clone(),
            reason: "expected `host MODULE` with the file of a module, found `host` alone".into(),
        }),
    }
}

/// The file of the module that a node stands for or hosts; `folder` holds the file in which the node is written.
pub(super) fn module_of(node: &Node, folder: &Path, graphs: &Path) -> Option<PathBuf> {
    match &node.module {
        Some(module) => Some(folder.join(module)),
        None => Some(graphs.join(hosted_by(node, graphs).ok()??.module)),
    }
}

/// Leaves out the stages that do nothing for this process: those that nobody feeds, and those of which nobody outside takes
/// anything, directly or through others.
fn leave_out(stages: &mut Vec<Node>, outlets: &Outlets) {
    while let Some(at) = stages.iter().position(|stage| stage.starved) {
        let starved = stages.remove(at);
        for stage in stages.iter_mut() {
            let before = stage.inputs.len();
            stage
                .inputs
                .retain(|_, input| input.output().is_none_or(|(node, _)| node != starved.id));
            stage.starved |= stage.inputs.len() < before && stage.inputs.is_empty();
        }
    }
    let sinks = stages.iter().filter(|stage| stage.outputs.is_empty());
    let mut open: Vec<String> = sinks.map(|stage| stage.id.clone()).collect();
    open.extend(outlets.values().map(|(stage, _)| stage.clone()));
    let mut needed = BTreeSet::new();
    while let Some(id) = open.pop() {
        if let Some(stage) = stages.iter().find(|stage| stage.id == id && !needed.contains(&id)) {
            let sources = stage.inputs.values().filter_map(Input::output);
            open.extend(sources.map(|(node, _)| node.to_string()));
        }
        needed.insert(id);
    }
    stages.retain(|stage| needed.contains(&stage.id));
}

/// dora gives a process what its own inputs name and nothing else.
fn past_the_module(host: &Node, stages: &[Node]) -> Result<(), String> {
    let inside: BTreeSet<&str> = stages.iter().map(|stage| stage.id.as_str()).collect();
    let wired: BTreeSet<&InputSource> = host.inputs.values().map(|wire| &wire.source).collect();
    for stage in stages {
        for (port, input) in &stage.inputs {
            let Some((node, _)) = input.output() else { continue };
            if !inside.contains(node) && !wired.contains(&input.source) {
                return Err(format!(
                    "its stage `{}` takes `{}` for its input `{port}` past the module's inputs; give the module an input for it",
                    stage.id, input.source
                ));
            }
        }
    }
    Ok(())
}

/// Gives a hosted stage the inputs of another, where a setting says so: `inner.:takes=other`.
fn take_inputs(stages: &mut [Node], host: &str, setting: &str) -> Result<(), String> {
    let parts = setting.split_once('=');
    let takes = parts.and_then(|(left, other)| Some((left.rsplit_once('.')?, other)));
    let Some(((inner, _), other)) = takes.filter(|((_, key), _)| *key == super::flat::TAKES) else {
        return Ok(());
    };
    let find = |inner: &str| stages.iter().position(|stage| stage.id == format!("{host}.{inner}"));
    let (Some(taker), Some(other)) = (find(inner), find(other)) else {
        return Err(format!("setting `{}`: no stage of this name", shown(setting)));
    };
    stages[taker].inputs = stages[other].inputs.clone();
    stages[taker].starved = stages[other].starved;
    Ok(())
}

/// Changes an argument of a hosted stage: `inner.key=value`.
fn set_inner(stages: &mut [Node], host: &str, setting: &str) -> Result<(), String> {
    let written = shown(setting);
    let wrong = || format!("setting `{written}` is not of the form node.key=value");
    let (left, value) = setting.split_once('=').ok_or_else(wrong)?;
    let (inner, key) = left.rsplit_once('.').ok_or_else(wrong)?;
    let id = format!("{host}.{inner}");
    let known: Vec<String> = stages
        .iter()
        .filter_map(|stage| stage.id.strip_prefix(host)?.strip_prefix('.').map(str::to_string))
        .collect();
    let Some(stage) = stages.iter_mut().find(|stage| stage.id == id) else {
        let nearest = realo_operator::config::nearest_name(inner, known.iter().map(String::as_str));
        let hint = super::error::hint(&nearest);
        return Err(format!(
            "setting `{written}`: no stage `{}`{hint}; there are: {}",
            shown(inner),
            known.join(", ")
        ));
    };
    if key == super::flat::STAGE {
        stage.args = Some(value.into());
        return Ok(());
    }
    if key == super::flat::TAKES {
        return Ok(());
    }
    let mut words = shlex::split(stage.args.as_deref().unwrap_or_default()).unwrap_or_default();
    match words.as_mut_slice() {
        [word, path, ..] if key == super::flat::PROGRAM && word == super::flat::PROGRAM => *path = value.into(),
        _ => super::flat::set_argument(&mut words, key, value),
    }
    let args = shlex::try_join(words.iter().map(String::as_str)).map_err(|error| error.to_string())?;
    stage.args = Some(args);
    Ok(())
}

/// For each output name, the nodes and outputs that make it.
type Producers = BTreeMap<String, Vec<(String, String)>>;

/// Whether a module file, by its name, detects and can be swapped for another that does.
pub(super) fn is_detection(module: &str) -> bool {
    let file = module.rsplit('/').next().unwrap_or(module);
    file.starts_with("detect.") && file.ends_with(".yml")
}

/// The parameters that a module of processes names are those that its node gives. A module within it, or a program that is
/// not ours, may read them from its environment.
fn check_params(module: &Module, outer: &Node) -> Result<(), String> {
    let ours = |node: &Node| node.path.as_deref().is_some_and(is_realo);
    let named: BTreeSet<String> = module
        .nodes
        .iter()
        .filter_map(|node| node.args.as_deref())
        .flat_map(params::named)
        .collect();
    let known = || named.iter().cloned().collect::<Vec<_>>().join(", ");
    let given: BTreeSet<String> = outer.params.keys().map(|key| key.to_lowercase()).collect();
    if let Some(unused) = given
        .iter()
        .find(|key| !named.contains(*key))
        .filter(|_| module.nodes.iter().all(ours))
    {
        let nearest = realo_operator::config::nearest_name(unused, named.iter().map(String::as_str));
        let hint = super::error::hint(&nearest);
        return Err(format!(
            "module `{}` has no parameter `{unused}`{hint}; it has: {}",
            module.name,
            known()
        ));
    }
    for node in module.nodes.iter().filter(|node| is_host(node)) {
        let missing = params::named(node.args.as_deref().unwrap_or_default());
        if let Some(missing) = missing.into_iter().find(|key| !given.contains(key)) {
            return Err(format!(
                "module `{}` needs the parameter `{missing}` for its node `{}`; write it under `params`",
                module.name, node.id
            ));
        }
    }
    Ok(())
}

/// Whether a process of ours hosts a module.
fn is_host(node: &Node) -> bool {
    let args = node.args.as_deref().unwrap_or_default();
    node.path.as_deref().is_some_and(is_realo) && args.split_whitespace().next() == Some("host")
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
            let nearest = realo_operator::config::nearest_name(port, declared.iter().copied());
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

/// That something has no output which a node takes.
fn no_output(output: &str, known: &[&str], taker: &str, port: &str) -> String {
    let hint = super::error::hint(&realo_operator::config::nearest_name(output, known.iter().copied()));
    let known = known.join(", ");
    format!("it has no output `{output}`{hint}, which node `{taker}` takes for its input `{port}`; it has: {known}")
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
            let reason = no_output(output, &known, &node.id, port);
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
