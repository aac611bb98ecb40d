//! Processes that host a module: `realo host MODULE [stage.key=value …]`.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use realo_documents::shown;
use realo_operator::config::{did_you_mean, nearest_name};

use super::ports::no_output;
use super::{Expansion, Outlets, as_dora, is_detection, stages};
use crate::flat::STAGE;
use crate::read::{self, Node, Part};
use crate::{FlatGraph, Graph, GraphError, Input, paths};

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

impl Expansion<'_> {
    /// Refuses a host within a host.
    pub(super) fn hosts_nothing(&self, node: &Node, file: &Path) -> Result<(), GraphError> {
        match (&self.host, hosted_by(node, file)?) {
            (Some(host), Some(Hosted { module, .. })) => Err(GraphError::Module {
                file: file.into(),
                node: node.id.clone(),
                reason: format!(
                    "it is in a module that `{host}` hosts: write `module: {module}`, its stages run in the same process"
                ),
            }),
            _ => Ok(()),
        }
    }

    /// The processes, and behind each host its stages.
    pub(super) fn with_stages(&mut self, processes: Vec<Node>) -> Result<Vec<Node>, GraphError> {
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
        Hosted {
            module: named,
            settings,
        }: &Hosted,
        used: &BTreeSet<String>,
    ) -> Result<(Vec<Node>, Outlets), GraphError> {
        let wrong = |reason| GraphError::Module {
            file: node.file.clone(),
            node: node.id.clone(),
            reason,
        };
        stages::once_each(settings).map_err(&wrong)?;
        let module = self.detection(named);
        self.swapped += usize::from(is_detection(&module));
        let (mut nodes, mut outlets) = self.inside(node, &module, &wrong)?;
        let of_stages = outputs_of_stages(&nodes, &node.id);
        has_outputs(&outlets, &of_stages, used).map_err(&wrong)?;
        for (name, made) in of_stages {
            outlets.entry(name).or_insert(made);
        }
        let mut offered = outlets.clone();
        offered.retain(|output, _| node.outputs.contains(output));
        outlets.retain(|output, _| used.contains(output));
        stages::choose(&mut nodes, node, settings, &outlets).map_err(&wrong)?;
        for stage in &mut nodes {
            stage.part = Part::In(node.id.clone());
            // A program that is not realo is refused by the checks under its own name.
            if stage.path.as_deref().is_some_and(is_realo) {
                stage.path.clone_from(&node.path);
            }
        }
        for setting in settings {
            let set = stages::set(&mut nodes, &node.id, setting);
            set.map_err(|reason| wrong(reason + &in_place_of(&module, named)))?;
        }
        let process = Node {
            args: Some(self.host_args(&module, settings).map_err(&wrong)?),
            part: Part::Host,
            outlets,
            ..node.clone()
        };
        nodes.insert(0, process);
        Ok((nodes, offered))
    }

    /// The nodes of the module that a process hosts; parameters are for modules of processes alone.
    fn inside(
        &mut self,
        host: &Node,
        module: &str,
        wrong: &dyn Fn(String) -> GraphError,
    ) -> Result<(Vec<Node>, Outlets), GraphError> {
        let outer = Node {
            params: BTreeMap::new(),
            ..host.clone()
        };
        self.host = Some(host.id.clone());
        let expanded = self.module(&outer, module, self.root, wrong);
        self.host = None;
        expanded
    }

    /// The arguments with which dora starts a host.
    fn host_args(&self, module: &str, settings: &[String]) -> Result<String, String> {
        let file = paths::hosted_module(module, self.root)?;
        let named = Path::new(module).file_name().unwrap_or_default();
        let module = file.folder.join(named).to_string_lossy().into_owned();
        let words = ["host", &module].into_iter();
        let words = words.chain(settings.iter().map(String::as_str));
        shlex::try_join(words).map_err(|error| error.to_string())
    }
}

/// What explains a stage that is missing where another detection took the place of the one that the graph names.
fn in_place_of(module: &str, named: &str) -> String {
    match module == named {
        true => String::new(),
        false => format!(
            "; --recorded-detections has put {module} in the place of {named}: a setting of a stage that only the other has \
             must go, or --recorded-detections"
        ),
    }
}

/// The outputs of stages under the names that a graph may give them: `STAGE.OUTPUT`. So a process sends an output that its
/// module does not have, or that several of its stages have.
fn outputs_of_stages(stages: &[Node], host: &str) -> Outlets {
    let mut outlets = Outlets::new();
    for stage in stages {
        let Some(name) = stage.id.strip_prefix(host).and_then(|inner| inner.strip_prefix('.')) else {
            continue;
        };
        for output in &stage.outputs {
            outlets.insert(format!("{name}.{output}"), (stage.id.clone(), output.clone()));
        }
    }
    outlets
}

/// Refuses outputs that others take of a host and that neither its module nor a stage of it has.
fn has_outputs(outlets: &Outlets, of_stages: &Outlets, used: &BTreeSet<String>) -> Result<(), String> {
    let is_known = |output: &&String| outlets.contains_key(*output) || of_stages.contains_key(*output);
    let Some(output) = used.iter().find(|output| !is_known(output)) else {
        return Ok(());
    };
    let names = |outlets: &Outlets| outlets.keys().cloned().collect::<Vec<String>>().join(", ");
    let known = outlets.keys().chain(of_stages.keys()).map(String::as_str);
    let hint = did_you_mean(&nearest_name(output, known));
    let module = match outlets.is_empty() {
        true => "it has none".to_string(),
        false => format!("it has: {}", names(outlets)),
    };
    Err(format!(
        "its module has no output `{output}`{hint}; {module}; its stages, as STAGE.OUTPUT: {}",
        names(of_stages)
    ))
}

/// What `realo host` is asked to run.
pub(super) struct Hosted {
    module: String,
    settings: Vec<String>,
}

pub(super) fn is_realo(path: &str) -> bool {
    Path::new(path).file_name().is_some_and(|name| name == "realo")
}

/// Whether a process of ours hosts a module.
pub(super) fn is_host(node: &Node) -> bool {
    let args = node.args.as_deref().unwrap_or_default();
    node.path.as_deref().is_some_and(is_realo) && args.split_whitespace().next() == Some("host")
}

/// A setting as hosts read it: `stage=program PATH …` and `stage=operator NAME …` put another stage in the place of one.
fn whole_stage(setting: String) -> String {
    match setting.split_once('=') {
        Some((stage, words)) if words.starts_with("program ") || words.starts_with("operator ") => {
            let stage = stage
                .strip_suffix(STAGE)
                .and_then(|inner| inner.strip_suffix('.'))
                .unwrap_or(stage);
            format!("{stage}.{}={words}", STAGE)
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
pub(crate) fn module_of(node: &Node, folder: &Path, graphs: &Path) -> Option<PathBuf> {
    match &node.module {
        Some(module) => Some(folder.join(module)),
        None => Some(graphs.join(hosted_by(node, graphs).ok()??.module)),
    }
}
