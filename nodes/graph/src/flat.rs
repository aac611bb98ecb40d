//! A graph without modules: the stages that drivers run, and the processes that dora starts.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::str::FromStr;

use serde_yaml::{Mapping, Value};

use super::read::{Node, Part};
use super::{Graph, GraphError, OUTSIDE, params, paths};
use realo_documents::shown;
use realo_operator::config::nearest_name;
use realo_operator::{Registration, Registry};

/// A graph without modules.
#[derive(Clone, Debug, PartialEq)]
pub struct FlatGraph {
    /// The dataflow file, from the root.
    pub file: PathBuf,
    /// The file's keys besides `nodes`, e.g. `strict_types`.
    pub settings: Mapping,
    /// The stages as declared, those of a module in its place.
    pub nodes: Vec<FlatNode>,
    /// The processes that host several stages.
    pub hosts: Vec<FlatNode>,
    /// By the name of each process that a module only groups, the id of that module.
    pub groups: BTreeMap<String, String>,
}

/// One stage of a graph, or one process.
#[derive(Clone, Debug, PartialEq)]
pub struct FlatNode {
    /// Name; a module's node is `module.node`.
    pub id: String,
    /// The program, from the root; a bare name is searched for by the system.
    pub path: PathBuf,
    /// Its arguments.
    pub args: Vec<String>,
    /// Environment as dora's YAML has it: `$NAME` stands for a variable, `$$` for a dollar.
    pub env: BTreeMap<String, Value>,
    /// By port.
    pub inputs: BTreeMap<String, Input>,
    /// Declared outputs.
    pub outputs: BTreeSet<String>,
    /// Type by input port, e.g. `realo/v1/Boxes`.
    pub input_types: BTreeMap<String, String>,
    /// Type by output port.
    pub output_types: BTreeMap<String, String>,
    /// Keys that only dora reads, e.g. `shared_memory_pool_size`.
    pub other: Mapping,
    /// The process that hosts it; `None`: it is one itself.
    pub host: Option<String>,
    /// Of a process that hosts several: for each of its outputs the stage and the stage's output behind it.
    pub outlets: BTreeMap<String, (String, String)>,
}

/// One wire of a graph, at its receiving end.
#[derive(Clone, Debug, PartialEq)]
pub struct Input {
    /// Where it comes from.
    pub source: InputSource,
    /// Messages that dora keeps; `None` is dora's default, 10.
    pub queue_size: Option<u64>,
    /// `drop_oldest` (default) or `backpressure`.
    pub queue_policy: Option<String>,
    /// Seconds of silence after which dora closes the input.
    pub input_timeout: Option<f64>,
}

/// The sending end of a wire.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum InputSource {
    /// An output of a node.
    Output {
        /// The node's id.
        node: String,
        /// The output's name.
        output: String,
    },
    /// Something that dora itself sends, e.g. `dora/timer/millis/100`.
    Builtin(String),
}

impl std::fmt::Display for InputSource {
    fn fmt(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
        match self {
            InputSource::Output { node, output } => write!(f, "{node}/{output}"),
            InputSource::Builtin(source) => f.write_str(source),
        }
    }
}

impl From<InputSource> for Input {
    fn from(source: InputSource) -> Self {
        Input {
            source,
            queue_size: None,
            queue_policy: None,
            input_timeout: None,
        }
    }
}

impl Input {
    /// One that whoever looks at its node alone feeds, under this name.
    pub(super) fn from_outside(name: &str) -> Self {
        Input::from(InputSource::Output {
            node: OUTSIDE.into(),
            output: name.into(),
        })
    }

    /// The sending node and its output, unless dora itself sends.
    pub fn output(&self) -> Option<(&str, &str)> {
        match &self.source {
            InputSource::Output { node, output } => Some((node, output)),
            InputSource::Builtin(_) => None,
        }
    }

    /// This input of a module's node, fed by a wire of the module; the node's own options win.
    pub(super) fn fed_by(&self, wire: &Input) -> Input {
        Input {
            source: wire.source.clone(),
            queue_size: self.queue_size.or(wire.queue_size),
            queue_policy: self.queue_policy.clone().or_else(|| wire.queue_policy.clone()),
            input_timeout: self.input_timeout.or(wire.input_timeout),
        }
    }
}

/// A change of one setting: `stage.key=value`. Ids contain dots, so the last one before `=` divides stage and key.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Setting {
    /// The node's id.
    pub node: String,
    /// The setting.
    pub key: String,
    /// Its value as written.
    pub value: String,
}

impl FromStr for Setting {
    type Err = GraphError;

    fn from_str(text: &str) -> Result<Self, GraphError> {
        let parts = text
            .split_once('=')
            .and_then(|(left, value)| Some((left.rsplit_once('.')?, value)));
        match parts {
            Some(((node, key), value)) if !node.is_empty() && !key.is_empty() => Ok(Setting {
                node: node.into(),
                key: key.into(),
                value: value.into(),
            }),
            _ => Err(GraphError::Setting(text.into())),
        }
    }
}

impl FlatNode {
    fn new(node: Node, file: &Path, root: &Path) -> Result<Self, GraphError> {
        let wrong = |reason: String| GraphError::Node {
            file: file.into(),
            node: node.id.clone(),
            reason,
        };
        let text = node.args.as_deref().unwrap_or_default();
        let args = shlex::split(text).ok_or_else(|| wrong(format!("args `{}`: a quote is not closed", shown(text))))?;
        let path = paths::of_node(node.path.as_deref().unwrap_or_default(), root);
        let mut other = node.other;
        let build = node.build.map(Value::String);
        for (key, value) in [("build", build), (DEPLOY, node.deploy)] {
            if let Some(value) = value {
                other.insert(key.into(), value);
            }
        }
        Ok(FlatNode {
            id: node.id,
            path,
            args,
            env: node.env,
            inputs: node.inputs,
            outputs: node.outputs,
            input_types: node.input_types,
            output_types: node.output_types,
            other,
            outlets: node.outlets,
            host: match node.part {
                Part::In(host) => Some(host),
                Part::Alone | Part::Host => None,
            },
        })
    }

    /// A stage by itself: the words behind `realo`, and inputs that come from [`OUTSIDE`].
    pub fn alone(id: &str, words: &[String], inputs: &[String]) -> Self {
        FlatNode {
            id: id.into(),
            path: "realo".into(),
            args: words.to_vec(),
            env: BTreeMap::new(),
            inputs: inputs
                .iter()
                .map(|port| (port.clone(), Input::from_outside(port)))
                .collect(),
            outputs: BTreeSet::new(),
            input_types: BTreeMap::new(),
            output_types: BTreeMap::new(),
            other: Mapping::new(),
            host: None,
            outlets: BTreeMap::new(),
        }
    }

    /// The machine that it is to run on, if the graph names one.
    pub fn machine(&self) -> Option<&str> {
        self.deployed("machine")?.as_str()
    }

    /// What the graph says of where it runs.
    pub(super) fn deployed(&self, key: &str) -> Option<&Value> {
        self.other.get(DEPLOY)?.get(key).filter(|value| !value.is_null())
    }

    /// Whether the program is the binary that hosts our operators and nodes.
    pub fn is_realo(&self) -> bool {
        self.path.file_name().is_some_and(|name| name == "realo")
    }

    /// `operator` or `node`, and the name after it, if the arguments begin so.
    pub fn stage(&self) -> Option<(&str, &str)> {
        match self.args.as_slice() {
            [word, name, ..] if word == "operator" || word == "node" => Some((word, name)),
            _ => None,
        }
    }

    /// The program of a plug-in that the node runs: `program PATH`.
    pub fn program(&self) -> Option<&str> {
        match self.args.as_slice() {
            [word, path, ..] if self.is_realo() && word == "program" => Some(path),
            _ => None,
        }
    }

    /// Gives a plug-in another path.
    pub fn set_program(&mut self, path: &str) {
        if self.program().is_some() {
            self.args[1] = path.into();
        }
    }

    /// The `key=value` settings of a stage; those of another program are all its own.
    pub fn settings(&self) -> &[String] {
        let first = if self.is_realo() { 2 } else { 0 };
        self.args.get(first..).unwrap_or_default()
    }

    /// What the registry has of this node; `None` for a foreign node or an unknown name.
    pub fn registration(&self, registry: &Registry) -> Option<&'static Registration> {
        let (word, name) = self.stage().filter(|_| self.is_realo())?;
        registry.find(word, name).ok()
    }

    /// A setting that names a parameter which nobody gave, and the parameter.
    pub fn parameter(&self) -> Option<(&str, String)> {
        let mut settings = self.settings().iter();
        settings.find_map(|setting| Some((setting.as_str(), params::named(setting).into_iter().next()?)))
    }

    /// Changes or adds the setting `key=value`.
    pub fn set(&mut self, key: &str, value: &str) {
        set_argument(&mut self.args, key, value);
    }

    fn to_yaml(&self) -> Result<Mapping, String> {
        let mut out = Mapping::new();
        let mut put = |key: &str, value: Value| out.insert(key.into(), value);
        put("id", self.id.clone().into());
        let path = self
            .path
            .to_str()
            .ok_or_else(|| format!("path {:?} is not UTF-8", self.path))?;
        put("path", path.into());
        if !self.args.is_empty() {
            let args = shlex::try_join(self.args.iter().map(String::as_str)).map_err(|error| error.to_string())?;
            put("args", args.into());
        }
        if !self.env.is_empty() {
            put(
                "env",
                self.env
                    .iter()
                    .map(|(name, value)| (name.clone().into(), value.clone()))
                    .collect::<Mapping>()
                    .into(),
            );
        }
        if !self.inputs.is_empty() {
            let inputs = self
                .inputs
                .iter()
                .map(|(port, input)| (port.clone().into(), input_to_yaml(input)));
            put("inputs", inputs.collect::<Mapping>().into());
        }
        if !self.outputs.is_empty() {
            put(
                "outputs",
                self.outputs.iter().cloned().map(Value::from).collect::<Vec<_>>().into(),
            );
        }
        for (key, types) in [("input_types", &self.input_types), ("output_types", &self.output_types)] {
            if !types.is_empty() {
                let types = types
                    .iter()
                    .map(|(port, name)| (port.clone().into(), name.clone().into()));
                put(key, types.collect::<Mapping>().into());
            }
        }
        out.extend(self.other.iter().map(|(key, value)| (key.clone(), value.clone())));
        Ok(out)
    }
}

/// Where a process runs, among the keys that only dora reads.
pub(super) const DEPLOY: &str = "deploy";

/// What stands for the path of a stage's program among the settings of its host.
pub(super) const PROGRAM: &str = "program";

/// What stands for all the words of a stage among the settings of its host; no argument has a `:`.
pub(super) const STAGE: &str = ":stage";

/// What names, among the settings of its host, the stage whose inputs a stage takes.
pub(super) const TAKES: &str = ":takes";

/// What puts, among the settings of its host, a new stage before an input of another: `STAGE.PORT INPUT OUTPUT`.
pub(super) const BEFORE: &str = ":before";

/// Changes or adds `key=value` among the words of a command line.
pub(super) fn set_argument(words: &mut Vec<String>, key: &str, value: &str) {
    let argument = format!("{key}={value}");
    let prefix = format!("{key}=");
    match words.iter_mut().find(|word| word.starts_with(&prefix)) {
        Some(existing) => *existing = argument,
        None => words.push(argument),
    }
}

fn input_to_yaml(input: &Input) -> Value {
    let source = Value::from(input.source.to_string());
    let mut long = Mapping::new();
    long.insert("source".into(), source.clone());
    let options = [
        ("queue_size", input.queue_size.map(Value::from)),
        ("queue_policy", input.queue_policy.clone().map(Value::from)),
        ("input_timeout", input.input_timeout.map(Value::from)),
    ];
    long.extend(
        options
            .into_iter()
            .filter_map(|(key, value)| Some((key.into(), value?))),
    );
    if long.len() == 1 { source } else { long.into() }
}

impl FlatGraph {
    pub(super) fn new(file: PathBuf, settings: Mapping, nodes: Vec<Node>) -> Result<Self, GraphError> {
        let root = file.parent().unwrap_or(Path::new("/"));
        let (hosts, nodes): (Vec<Node>, Vec<Node>) = nodes.into_iter().partition(|node| node.part == Part::Host);
        let flat = |nodes: Vec<Node>| nodes.into_iter().map(|node| FlatNode::new(node, &file, root)).collect();
        let (hosts, nodes): (Result<_, GraphError>, Result<_, GraphError>) = (flat(hosts), flat(nodes));
        let (hosts, nodes) = (hosts?, nodes?);
        Ok(FlatGraph {
            file,
            settings,
            nodes,
            hosts,
            groups: BTreeMap::new(),
        })
    }

    /// Reads and expands a dataflow file.
    ///
    /// # Errors
    /// As [`Graph::load`] and [`Graph::expand`].
    pub fn load(path: &Path) -> Result<Self, GraphError> {
        Graph::load(path)?.expand()
    }

    /// A stage by its id.
    pub fn node(&self, id: &str) -> Option<&FlatNode> {
        self.nodes.iter().find(|node| node.id == id)
    }

    /// The same graph with a process for each stage.
    pub fn apart(mut self) -> Self {
        self.nodes.iter_mut().for_each(|node| node.host = None);
        self.hosts.clear();
        self
    }

    /// The same graph for one machine, wherever its processes are to run.
    pub fn on_one_machine(mut self) -> Self {
        for node in self.nodes.iter_mut().chain(&mut self.hosts) {
            node.other.shift_remove(DEPLOY);
        }
        self
    }

    /// The machines that its processes are to run on, by name.
    pub fn machines(&self) -> BTreeSet<&str> {
        self.processes().into_iter().filter_map(FlatNode::machine).collect()
    }

    /// The processes that dora starts, in the order of their first stages.
    pub fn processes(&self) -> Vec<&FlatNode> {
        let mut processes: Vec<&FlatNode> = Vec::new();
        for node in &self.nodes {
            let process = match &node.host {
                Some(host) => self.hosts.iter().find(|process| process.id == *host),
                None => Some(node),
            };
            let known = |process: &&FlatNode| processes.iter().any(|known| known.id == process.id);
            processes.extend(process.filter(|process| !known(process)));
        }
        processes
    }

    /// Changes or adds a setting of a node; whether the node takes it [`super::validate`] says.
    ///
    /// # Errors
    /// [`GraphError::UnknownNode`], with the nearest id.
    pub fn set(&mut self, id: &str, key: &str, value: &str) -> Result<(), GraphError> {
        if let Some(node) = self.nodes.iter_mut().find(|node| node.id == id) {
            node.set(key, value);
            return Ok(());
        }
        Err(self.unknown(id))
    }

    /// That there is no stage of this id, the nearest, and all that there are.
    pub(super) fn unknown(&self, id: &str) -> GraphError {
        let known: Vec<&str> = self.nodes.iter().map(|node| node.id.as_str()).collect();
        let inside = known
            .iter()
            .find(|known| known.strip_prefix(id).is_some_and(|rest| rest.starts_with('.')));
        let nearest = inside
            .map(|id| id.to_string())
            .or_else(|| nearest_name(id, known.iter().copied()));
        GraphError::UnknownNode {
            file: self.file.clone(),
            id: id.into(),
            nearest,
            known: known.join(", "),
        }
    }

    /// Lets every stage be hosted by this binary, so that a graph runs on the program that read it. Its name must be
    /// `realo`, by which stages are distinguished from foreign programs.
    pub fn host_in(&mut self, realo: &Path) {
        let processes = self.nodes.iter_mut().chain(&mut self.hosts);
        for node in processes.filter(|node| node.is_realo()) {
            node.path = realo.to_path_buf();
        }
    }

    /// The graph as a dataflow file for dora, paths from the root; its types stay in [`FlatGraph::types`].
    ///
    /// # Errors
    /// [`GraphError::Node`] for an argument or path that YAML or a command line cannot hold.
    pub fn to_yaml(&self) -> Result<String, GraphError> {
        let mut nodes = Vec::new();
        for node in self.processes() {
            let wrong = |reason| GraphError::Node {
                file: self.file.clone(),
                node: node.id.clone(),
                reason,
            };
            nodes.push(Value::from(self.reported(node).to_yaml().map_err(wrong)?));
        }
        let mut out = self.settings.clone();
        out.insert("nodes".into(), nodes.into());
        serde_yaml::to_string(&out).map_err(|error| GraphError::Yaml {
            file: self.file.clone(),
            reason: error.to_string(),
        })
    }

    /// A process with all the arguments of the stages that it hosts.
    fn reported(&self, process: &FlatNode) -> FlatNode {
        let mut process = process.clone();
        for input in process.inputs.values_mut() {
            input.source = self.as_dora_has_it(&input.source);
        }
        let inner = format!("{}.", process.id);
        for stage in self
            .nodes
            .iter()
            .filter(|stage| stage.host.as_ref() == Some(&process.id))
        {
            let name = stage.id.strip_prefix(&inner).unwrap_or(&stage.id);
            if let Some(program) = stage.program() {
                set_argument(&mut process.args, &format!("{name}.{PROGRAM}"), program);
            }
            for (key, value) in stage.settings().iter().filter_map(|setting| setting.split_once('=')) {
                set_argument(&mut process.args, &format!("{name}.{key}"), value);
            }
        }
        process
    }

    /// The sending end of a wire by its process: dora knows no stages within one.
    pub(super) fn as_dora_has_it(&self, source: &InputSource) -> InputSource {
        let InputSource::Output { node, output } = source else {
            return source.clone();
        };
        let host = self.node(node).and_then(|stage| stage.host.as_ref());
        let host = host.and_then(|host| self.hosts.iter().find(|process| process.id == *host));
        let made = (node.clone(), output.clone());
        let outlet = host.and_then(|host| {
            let (name, _) = host.outlets.iter().find(|(_, behind)| **behind == made)?;
            Some((host.id.clone(), name.clone()))
        });
        match outlet {
            Some((node, output)) => InputSource::Output { node, output },
            None => source.clone(),
        }
    }

    /// The folder of type definitions that dora looks for beside the graph.
    pub fn types(&self) -> PathBuf {
        self.file.with_file_name("types")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn graph(text: &str) -> FlatGraph {
        Graph::parse(text, Path::new("/data/g.yml")).unwrap().expand().unwrap()
    }

    #[test]
    fn settings_split_at_the_last_dot_before_the_value() {
        let setting: Setting = "ego.detect.head.path=a.b=c".parse().unwrap();
        let expected = Setting {
            node: "ego.detect.head".into(),
            key: "path".into(),
            value: "a.b=c".into(),
        };
        assert_eq!(setting, expected);
        for bad in ["a=b", "a.b", ".a=b", "a.=b", ""] {
            assert!(bad.parse::<Setting>().is_err(), "{bad}");
        }
    }

    #[test]
    fn changes_and_adds_settings() {
        let mut graph = graph("nodes: [{id: ego.nms, path: /x/realo, args: operator nms threshold=0.2}]");
        graph.set("ego.nms", "threshold", "0.3").unwrap();
        graph.set("ego.nms", "note", "two words").unwrap();
        assert_eq!(
            graph.nodes[0].args,
            ["operator", "nms", "threshold=0.3", "note=two words"]
        );
        assert_eq!(graph.nodes[0].stage(), Some(("operator", "nms")));
        assert_eq!(graph.nodes[0].settings().len(), 2);
        let again = Graph::parse(&graph.to_yaml().unwrap(), Path::new("/data/g.yml"))
            .unwrap()
            .expand()
            .unwrap();
        assert_eq!(again, graph);
        let error = graph.set("ego", "threshold", "1").unwrap_err().to_string();
        assert!(error.contains("no node `ego` (did you mean `ego.nms`?)"), "{error}");
    }

    #[test]
    fn a_node_of_its_own_takes_from_the_process_of_a_stage() {
        let folder = tempfile::tempdir().unwrap();
        let module = "module: { name: m, outputs: [boxes] }\nnodes: [{ id: nms, path: realo, args: operator nms, outputs: [boxes] }]";
        std::fs::write(folder.path().join("m.yml"), module).unwrap();
        let text = "nodes: [{ id: ego, path: /x/realo, args: host m.yml, outputs: [boxes] }, { id: mine, path: /x/mine, inputs: { \
                    in: ego/boxes } }]";
        let flat = Graph::parse(text, &folder.path().join("g.yml"))
            .unwrap()
            .expand()
            .unwrap();
        assert_eq!(
            flat.node("mine").unwrap().inputs["in"].output(),
            Some(("ego.nms", "boxes"))
        );
        let written = flat.to_yaml().unwrap();
        assert!(written.contains("in: ego/boxes"), "{written}");
    }

    #[test]
    fn refuses_an_open_quote() {
        let error = Graph::parse("nodes: [{id: a, path: x, args: \"a 'b\"}]", Path::new("g.yml"))
            .unwrap()
            .expand();
        assert!(error.unwrap_err().to_string().contains("quote"));
    }
}
