//! YAML of dataflows and modules as typed values; stricter than dora, which overlooks unknown keys of inputs.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use serde_yaml::{Mapping, Value};

use realo_documents::shown;

use super::place::Place;
use super::{GraphError, Input, InputSource};

/// Inputs and the like that a node may have, and items that any other list or mapping may have.
pub(super) const MAX_ENTRIES: usize = 1000;

/// Bytes of a name: dora makes names of files of some.
pub(super) const MAX_NAME: usize = 200;

/// Bytes of a path: more than systems take.
pub(super) const MAX_PATH: usize = 4096;

const DATAFLOW_KEYS: &[&str] = &[
    "nodes",
    "strict_types",
    "env",
    "type_rules",
    "exit_when_nodes_finish",
    "health_check_interval",
    "debug",
    "deploy",
];

/// What a node that runs a file may have; a module node has those of [`MODULE_NODE_KEYS`].
const NODE_KEYS: &[&str] = &[
    "id",
    "name",
    "description",
    "path",
    "path_sha256",
    "args",
    "env",
    "inputs",
    "outputs",
    "input_types",
    "output_types",
    "output_framing",
    "output_metadata",
    "pattern",
    "send_stdout_as",
    "send_logs_as",
    "min_log_level",
    "max_log_size",
    "max_rotated_files",
    "build",
    "restart_policy",
    "max_restarts",
    "restart_delay",
    "max_restart_delay",
    "restart_window",
    "shared_memory_pool_size",
    "health_check_timeout",
    "finish_grace_secs",
    "startup_timeout",
    "cpu_affinity",
    "deploy",
];

const MODULE_NODE_KEYS: &[&str] = &[
    "id",
    "name",
    "description",
    "module",
    "inputs",
    "params",
    "env",
    "build",
    "deploy",
];

/// Keys of node kinds that dora has and we do not read.
const OTHER_KINDS: &[&str] = &["operator", "operators", "ros2", "hub", "git", "branch", "tag", "rev"];

/// Longest time, s: a thousand years; more is no duration to dora.
const MAX_SECONDS: f64 = 3.2e10;

const INPUT_KEYS: &[&str] = &["source", "queue_size", "queue_policy", "input_timeout"];

/// What a node is to the processes of its graph.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) enum Part {
    /// A process of its own.
    #[default]
    Alone,
    /// A process that hosts the stages of a module.
    Host,
    /// A stage in the process of this id.
    In(String),
}

/// A node as written.
#[derive(Clone, Debug, Default)]
pub(super) struct Node {
    /// The file in which it is written.
    pub file: PathBuf,
    pub part: Part,
    /// Of a host: for each of its outputs the stage and the stage's output behind it.
    pub outlets: BTreeMap<String, (String, String)>,
    /// Whether all its inputs are optional ones of its module that nobody feeds.
    pub starved: bool,
    pub id: String,
    pub path: Option<String>,
    pub module: Option<String>,
    pub params: BTreeMap<String, String>,
    pub args: Option<String>,
    /// As dora's YAML has them: `$NAME` stands for a variable, `$$` for a dollar.
    pub env: BTreeMap<String, Value>,
    pub inputs: BTreeMap<String, Input>,
    pub outputs: BTreeSet<String>,
    pub input_types: BTreeMap<String, String>,
    pub output_types: BTreeMap<String, String>,
    pub build: Option<String>,
    pub deploy: Option<Value>,
    /// Keys that only dora reads.
    pub other: Mapping,
}

/// A module file.
pub(super) struct Module {
    pub name: String,
    pub inputs: BTreeSet<String>,
    pub inputs_optional: BTreeSet<String>,
    pub outputs: BTreeSet<String>,
    pub build: Option<String>,
    /// Length of the file.
    pub bytes: usize,
    pub nodes: Vec<Node>,
}

/// Reads a file of bounded size.
pub(super) fn text_of(file: &Path) -> Result<String, GraphError> {
    realo_documents::read(file).map_err(GraphError::read(file))
}

/// The keys of a dataflow besides `nodes`, and its nodes.
pub(super) fn dataflow(text: &str, file: &Path) -> Result<(Mapping, Vec<Node>), GraphError> {
    let place = Place::new(file, "the dataflow");
    let value = document(text, file)?;
    let mut top = place.mapping(&value)?.clone();
    place.known_keys(&top, DATAFLOW_KEYS)?;
    let nodes = top.shift_remove("nodes").unwrap_or(Value::Null);
    top.retain(|_, value| !value.is_null());
    Ok((top, read_nodes(&place, &nodes)?))
}

/// A module file's content.
pub(super) fn module(file: &Path) -> Result<Module, GraphError> {
    let place = Place::new(file, "the module");
    if file.exists() && !file.is_file() {
        return Err(place.wrong("a module's file", "a folder or a device; name a .yml file".into()));
    }
    let text = text_of(file)?;
    let value = document(&text, file)?;
    let top = place.mapping(&value)?;
    place.known_keys(top, &["module", "nodes", "build"])?;
    let place = place.under("module");
    let header = place.mapping(top.get("module").unwrap_or(&Value::Null))?;
    place.known_keys(header, &["name", "inputs", "inputs_optional", "outputs"])?;
    let ports = |key: &str| match header.get(key) {
        Some(list) => place.under(key).names(list),
        None => Ok(BTreeSet::new()),
    };
    let module = Module {
        name: place.under("name").name(header.get("name").unwrap_or(&Value::Null))?,
        inputs: ports("inputs")?,
        inputs_optional: ports("inputs_optional")?,
        outputs: ports("outputs")?,
        build: place.under("build").optional_text(top.get("build"))?,
        bytes: text.len(),
        nodes: read_nodes(
            &Place::new(file, "the module"),
            top.get("nodes").unwrap_or(&Value::Null),
        )?,
    };
    match module.inputs.intersection(&module.inputs_optional).next() {
        Some(port) => Err(place.wrong(
            "inputs that are required or optional",
            format!("`{port}` in both lists"),
        )),
        None => Ok(module),
    }
}

pub(super) fn document(text: &str, file: &Path) -> Result<Value, GraphError> {
    realo_documents::yaml(text).map_err(|reason| GraphError::Yaml {
        file: file.into(),
        reason,
    })
}

fn read_nodes(place: &Place, value: &Value) -> Result<Vec<Node>, GraphError> {
    let place = place.under("nodes");
    let nodes = value
        .as_sequence()
        .ok_or_else(|| place.expected("a list of nodes", value))?;
    let nodes: Vec<Node> = nodes
        .iter()
        .enumerate()
        .map(|(index, node)| read_node(&place, index, node))
        .collect::<Result<_, _>>()?;
    // Of two modules the nodes inside would collide, of which nobody has written the names.
    let mut known = BTreeSet::new();
    match nodes.iter().find(|node| !known.insert(&node.id)) {
        Some(twice) => Err(GraphError::Duplicate {
            file: place.file.into(),
            id: twice.id.clone(),
        }),
        None => Ok(nodes),
    }
}

fn read_node(place: &Place, index: usize, value: &Value) -> Result<Node, GraphError> {
    let place = place.under(&format!("{index}"));
    let keys = place.mapping(value)?;
    let id = place.under("id").text(keys.get("id").unwrap_or(&Value::Null))?;
    let place = Place::new(place.file, &format!("node `{}`", shown(&id)));
    check_id(&place, &id)?;
    let given = |key: &str| keys.get(key).filter(|value| !value.is_null());
    if let Some(kind) = OTHER_KINDS.iter().find(|kind| given(kind).is_some()) {
        return Err(place.wrong(
            "a node with `path`, or a module",
            format!("a dora node of kind `{kind}`"),
        ));
    }
    let module = place.under("module").optional_path(given("module"))?;
    place.known_keys(keys, if module.is_some() { MODULE_NODE_KEYS } else { NODE_KEYS })?;
    let path = place.under("path").optional_path(given("path"))?;
    if path.is_none() && module.is_none() {
        return Err(place.wrong("a `path` or a `module`", "neither".into()));
    }
    let mut other = keys.clone();
    let ours = [
        "id",
        "module",
        "path",
        "params",
        "args",
        "env",
        "inputs",
        "outputs",
        "input_types",
        "output_types",
    ];
    other.retain(|key, value| {
        let key = key.as_str().unwrap_or_default();
        !value.is_null() && !ours.contains(&key) && !["build", "deploy", "name", "description"].contains(&key)
    });
    Ok(Node {
        path,
        module,
        params: place.under("params").texts(given("params"))?,
        args: place.under("args").optional_text(given("args"))?,
        env: read_env(&place.under("env"), given("env"))?,
        inputs: read_inputs(&place.under("inputs"), given("inputs"))?,
        outputs: given("outputs")
            .map(|list| place.under("outputs").names(list))
            .transpose()?
            .unwrap_or_default(),
        input_types: place.under("input_types").texts(given("input_types"))?,
        output_types: place.under("output_types").texts(given("output_types"))?,
        build: place.under("build").optional_text(given("build"))?,
        deploy: given("deploy").cloned(),
        other,
        id,
        file: place.file.into(),
        part: Part::Alone,
        outlets: BTreeMap::new(),
        starved: false,
    })
}

/// dora's rule for node ids.
fn check_id(place: &Place, id: &str) -> Result<(), GraphError> {
    let allowed = |c: char| c.is_ascii_alphanumeric() || "_-.".contains(c);
    let fits =
        !id.is_empty() && id.len() <= MAX_NAME && !id.starts_with('.') && id != "dora" && id.chars().all(allowed);
    if fits {
        return Ok(());
    }
    Err(place.under("id").wrong(
        "at most 200 letters, digits, `_`, `-`, `.`, no `.` at the head, not `dora`",
        format!("`{}`", shown(id)),
    ))
}

fn read_env(place: &Place, value: Option<&Value>) -> Result<BTreeMap<String, Value>, GraphError> {
    let entries = place.entries(value)?.into_iter();
    let read = entries.map(|(name, value)| match value {
        Value::Bool(_) | Value::Number(_) | Value::String(_) => Ok((name.to_string(), value.clone())),
        other => Err(place.under(name).expected("a text, a number or a truth value", other)),
    });
    read.collect()
}

fn read_inputs(place: &Place, value: Option<&Value>) -> Result<BTreeMap<String, Input>, GraphError> {
    let entries = place.entries(value)?.into_iter();
    entries
        .map(|(port, value)| Ok((port.to_string(), read_input(&place.under(port), value)?)))
        .collect()
}

fn read_input(place: &Place, value: &Value) -> Result<Input, GraphError> {
    if let Value::String(source) = value {
        return Ok(Input::from(read_source(place, source)?));
    }
    let keys = value
        .as_mapping()
        .ok_or_else(|| place.expected("`node/output` or a mapping with `source`", value))?;
    place.known_keys(keys, INPUT_KEYS)?;
    let given = |key: &str| keys.get(key).filter(|value| !value.is_null());
    let source = place.under("source").text(keys.get("source").unwrap_or(&Value::Null))?;
    let number = |key: &str, value: &Value| place.under(key).expected("a number ≥ 0", value);
    let queue_size = given("queue_size")
        .map(|v| v.as_u64().ok_or_else(|| number("queue_size", v)))
        .transpose()?;
    let seconds = |value: &Value| value.as_f64().filter(|seconds| (0.0..=MAX_SECONDS).contains(seconds));
    let timeout = given("input_timeout")
        .map(|v| seconds(v).ok_or_else(|| number("input_timeout", v)))
        .transpose()?;
    let queue_policy = place.under("queue_policy").optional_text(given("queue_policy"))?;
    if let Some(policy) = queue_policy
        .as_deref()
        .filter(|policy| !["drop_oldest", "backpressure"].contains(policy))
    {
        return Err(place
            .under("queue_policy")
            .wrong("`drop_oldest` or `backpressure`", format!("`{}`", shown(policy))));
    }
    Ok(Input {
        queue_size,
        queue_policy,
        input_timeout: timeout,
        ..Input::from(read_source(place, &source)?)
    })
}

fn read_source(place: &Place, text: &str) -> Result<InputSource, GraphError> {
    let wrong = || place.wrong("`node/output`", format!("`{}`", shown(text)));
    let (node, output) = text.split_once('/').ok_or_else(wrong)?;
    let empty_part = output.split('/').any(str::is_empty);
    if node == "dora" && text.len() <= 2 * MAX_NAME {
        return Ok(InputSource::Builtin(text.to_string()));
    }
    if node.is_empty() || empty_part || text.len() > 2 * MAX_NAME {
        return Err(wrong());
    }
    Ok(InputSource::Output {
        node: node.to_string(),
        output: output.to_string(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn error(text: &str) -> String {
        dataflow(text, Path::new("g.yml")).unwrap_err().to_string()
    }

    #[test]
    fn names_the_place_of_what_does_not_fit() {
        let cases = [
            (
                "nodes: [{id: a, path: x, input: {}}]",
                "g.yml: node `a`: unknown key `input` (did you mean `inputs`?)",
            ),
            (
                "nodes: [{id: a, path: x, inputs: {p: {source: b/o, queue_sise: 3}}}]",
                "node `a`, inputs, p: unknown key `queue_sise` (did you mean `queue_size`?)",
            ),
            (
                "nodes: [{id: a, path: x, inputs: {p: b}}]",
                "node `a`, inputs, p: expected `node/output`, found `b`",
            ),
            ("nodes: [{id: a, path: x, inputs: {p: b//o}}]", "found `b//o`"),
            (
                "nodes: [{id: a, path: x, inputs: {p: {source: b/o, queue_size: -3}}}]",
                "expected a number ≥ 0",
            ),
            (
                "nodes: [{id: a, path: x, args: 3}]",
                "node `a`, args: expected a text (quote numbers), found the number 3",
            ),
            (
                "nodes: [{id: a, module: x, params: {k: 1}}]",
                "params, k: expected a text",
            ),
            ("nodes: [{id: a, module: x, outputs: [k]}]", "unknown key `outputs`"),
            ("nodes: [{id: a b, path: x}]", "found `a b`"),
            ("nodes: [{id: a}]", "expected a `path` or a `module`, found neither"),
            (
                "nodes: [{id: a, operator: {python: x.py}}]",
                "a dora node of kind `operator`",
            ),
            ("nodes: [{id: a, path: x, outputs: [o, o]}]", "`o` twice"),
            (
                "nodes: [3]",
                "the dataflow, nodes, 0: expected a mapping, found the number 3",
            ),
            (
                "nodes: [{id: a, module: x}, {id: b, path: x}, {id: a, module: y}]",
                "g.yml: two nodes have the id `a`; give one another name",
            ),
            ("nodes: {a: 1}", "expected a list of nodes, found a mapping"),
            (
                "strict_type: true\nnodes: []",
                "unknown key `strict_type` (did you mean `strict_types`?)",
            ),
            ("nodes: [", "not a YAML document"),
            ("", "expected a mapping, found nothing"),
        ];
        for (text, expected) in cases {
            let found = error(text);
            assert!(found.contains(expected), "{text}\n  {found}\n  {expected}");
        }
    }

    #[test]
    fn reads_both_forms_of_an_input() {
        let text = "nodes: [{id: a, path: x, inputs: {p: b.c/o/q, r: {source: dora/timer/millis/10, queue_size: 3}}}]";
        let (_, nodes) = dataflow(text, Path::new("g.yml")).unwrap();
        let source = InputSource::Output {
            node: "b.c".into(),
            output: "o/q".into(),
        };
        assert_eq!(nodes[0].inputs["p"], Input::from(source));
        let timer = Input::from(InputSource::Builtin("dora/timer/millis/10".into()));
        assert_eq!(
            nodes[0].inputs["r"],
            Input {
                queue_size: Some(3),
                ..timer
            }
        );
    }
}
