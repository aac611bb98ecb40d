//! Our expansion of modules against dora's own, and what both refuse.

use std::path::{Path, PathBuf};
use std::process::Command;

use serde_yaml::{Mapping, Value};

use super::{FlatGraph, Graph};

/// The dora program of the machine; tests that need it say so loudly where there is none.
pub(crate) fn dora() -> Option<PathBuf> {
    let target = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../target");
    let named = std::env::var_os("REALO_DORA").map(PathBuf::from);
    let local = ["dora", "dora-cli/bin/dora", "dora/bin/dora"].map(|path| target.join(path));
    let path = std::env::var_os("PATH").unwrap_or_default();
    let searched = std::env::split_paths(&path).map(|folder| folder.join("dora"));
    let works = |program: &PathBuf| {
        let version = Command::new(program).arg("--version").output();
        version.is_ok_and(|out| String::from_utf8_lossy(&out.stdout).contains(" 1.1."))
    };
    let found = named.into_iter().chain(local).chain(searched).find(works);
    if found.is_none() {
        skipped::skip(
            "dora 1.1 in REALO_DORA, target/dora-cli or PATH, to compare our expansion of modules with its own",
        );
    }
    found
}

/// The words of every host that a file or what dora makes of it has.
fn hosts(document: &Value) -> Vec<(String, String)> {
    let nodes = document["nodes"].as_sequence().unwrap().iter();
    let words = nodes.filter_map(|node| Some((node["id"].as_str()?.into(), node.get("args")?.as_str()?.into())));
    words
        .filter(|(_, args): &(_, String)| args.starts_with("host "))
        .collect()
}

/// What `dora expand` makes of a file, read by our reader; `Err` holds its message.
pub(crate) fn expanded_by(dora: &Path, file: &Path) -> Result<FlatGraph, String> {
    let out = Command::new(dora).arg("expand").arg(file).output().unwrap();
    if !out.status.success() {
        return Err(String::from_utf8_lossy(&out.stderr).into_owned());
    }
    let mut document: Value = serde_yaml::from_slice(&out.stdout).unwrap();
    let written: Value = serde_yaml::from_slice(&std::fs::read(file).unwrap()).unwrap();
    let found = hosts(&document);
    let kept = hosts(&written).into_iter().all(|host| found.contains(&host));
    assert!(
        kept,
        "{}: dora leaves hosts as they are, found {found:?}",
        file.display()
    );
    // dora writes values that it has read: a dollar is a dollar there.
    for node in document["nodes"].as_sequence_mut().unwrap() {
        let Some(env) = node.get_mut("env").and_then(Value::as_mapping_mut) else {
            continue;
        };
        for (_, value) in env.iter_mut() {
            if let Value::String(text) = value {
                *text = text.replace('$', "$$");
            }
        }
    }
    let text = serde_yaml::to_string(&document).unwrap();
    Ok(Graph::parse(&text, file).unwrap().expand().unwrap())
}

/// Without the defaults that dora writes out.
fn normalized(mut graph: FlatGraph) -> FlatGraph {
    graph.settings = without_defaults(&graph.settings);
    for node in &mut graph.nodes {
        node.other = without_defaults(&node.other);
        // dora reads a text that looks like a number as a number; a process gets the same text.
        for value in node.env.values_mut().filter(|value| !value.is_string()) {
            *value = serde_yaml::to_string(value).unwrap().trim().into();
        }
        for input in node.inputs.values_mut() {
            input.queue_policy = input.queue_policy.take().filter(|policy| policy != "drop_oldest");
        }
    }
    graph
}

fn without_defaults(keys: &Mapping) -> Mapping {
    let mut out = Mapping::new();
    let mut sorted: Vec<(&str, &Value)> = keys.iter().map(|(key, value)| (key.as_str().unwrap(), value)).collect();
    sorted.sort_by_key(|(key, _)| *key);
    for (key, value) in sorted {
        match (key, value) {
            ("restart_policy", Value::String(policy)) if policy == "never" => {}
            ("max_restarts", Value::Number(n)) if n.as_u64() == Some(0) => {}
            ("debug", _) => {}
            ("deploy", Value::Mapping(deploy)) => {
                out.insert(key.into(), deploy.get("machine").cloned().unwrap_or_default());
            }
            ("shared_memory_pool_size", Value::String(text)) => {
                let megabytes: u64 = text.strip_suffix("MB").unwrap().parse().unwrap();
                out.insert(key.into(), (megabytes << 20).into());
            }
            (_, value) => {
                out.insert(key.into(), value.clone());
            }
        }
    }
    out
}

pub(crate) fn compare(dora: &Path, file: &Path) {
    let ours = FlatGraph::load(file).unwrap_or_else(|error| panic!("{error}"));
    let theirs = expanded_by(dora, file).unwrap_or_else(|error| panic!("{}: {error}", file.display()));
    same(&processes(&ours), &processes(&theirs), file);
    same(&normalized(ours.clone()), &normalized(theirs), file);
    // What we write for dora is the same graph once more.
    let folder = tempfile::tempdir().unwrap();
    let written = folder.path().join("graph.yml");
    std::fs::write(&written, ours.to_yaml().unwrap()).unwrap();
    let again = expanded_by(dora, &written).unwrap_or_else(|error| panic!("{}: {error}", file.display()));
    let stages = |graph: FlatGraph| {
        normalized(FlatGraph {
            hosts: Vec::new(),
            ..graph
        })
    };
    same(&stages(again), &stages(ours), file);
}

/// What dora starts of a graph, as a graph without hosts.
fn processes(graph: &FlatGraph) -> FlatGraph {
    let mut nodes: Vec<_> = graph.processes().into_iter().cloned().collect();
    for node in &mut nodes {
        node.outlets.clear();
    }
    normalized(FlatGraph {
        nodes,
        hosts: Vec::new(),
        ..graph.clone()
    })
}

fn same(ours: &FlatGraph, theirs: &FlatGraph, file: &Path) {
    assert_eq!(ours.settings, theirs.settings, "{}", file.display());
    for (ours, theirs) in ours.nodes.iter().zip(&theirs.nodes) {
        assert_eq!(ours, theirs, "{}", file.display());
    }
    assert_eq!(ours.nodes.len(), theirs.nodes.len(), "{}", file.display());
}

pub(crate) fn write(folder: &Path, files: &[(&str, &str)]) {
    for (name, text) in files {
        let file = folder.join(name);
        std::fs::create_dir_all(file.parent().unwrap()).unwrap();
        std::fs::write(file, text).unwrap();
    }
}

const NASTY: &[(&str, &str)] = &[
    (
        "g.yml",
        r#"
strict_types: true
exit_when_nodes_finish: true
env: { GLOBAL: "one" }
nodes:
  - id: src
    name: the source
    path: bin/realo
    args: 'node src text="two words" $PARAM_NOT ${HOME}'
    env: { A: "x", N: 3, B: true, F: 1.5 }
    outputs: [b, a, op/x]
    shared_memory_pool_size: 128MB
    cpu_affinity: [0, 1]
  - id: cav0
    module: modules/agent.yml
    inputs: { data: { source: src/a, queue_size: 7, input_timeout: 2.5 }, extra: dora/timer/millis/10 }
    params: { sleep: "1", sleep_more: "$PARAM_SLEEP again=${_param.sleep}", Dollar: "$5" }
    env: { A: "outer", C: "c" }
    build: echo outer
  - id: cav1.x
    module: modules/agent.yml
    inputs: { data: src/op/x }
    params: { sleep: "2" }
  - id: sink
    path: /abs/realo
    inputs:
      one: { source: cav0/enc_out, queue_size: 200, queue_policy: drop_oldest }
      two: cav1.x/deep_out
      three: cav0.inner.core/raw
      four: { source: dora/logs/info/cav0.enc, queue_policy: backpressure, queue_size: 3 }
"#,
    ),
    (
        "modules/agent.yml",
        r#"
module: { name: agent, inputs: [data], inputs_optional: [extra], outputs: [enc_out, deep_out] }
build: echo module
nodes:
  - id: enc
    path: ../bin/realo
    args: "operator enc sleep=$PARAM_SLEEP more=$PARAM_SLEEP_MORE b=${_param.sleep} no=$PARAM_SLEE"
    inputs: { data: _mod/data, extra: { source: _mod/extra, queue_size: 9 }, back: inner/deep_out, log: dora/logs/info/enc }
    input_types: { data: std/core/v1/Bytes }
    outputs: [enc_out]
    output_types: { enc_out: std/core/v1/Bytes }
    env: { A: "inner", C2: "$$5" }
    build: echo own
  - id: inner
    module: nested/deep.yml
    inputs: { x: { source: _mod/data, queue_size: 5 }, y: enc/enc_out, z: src/b }
    params: { sleep: "$PARAM_SLEEP" }
    build: echo nested
  - id: free
    path: dynamic
    inputs: { deep: { source: inner/deep_out, queue_policy: backpressure } }
"#,
    ),
    (
        "modules/nested/deep.yml",
        r#"
module: { name: deep, inputs: [x, y], inputs_optional: [z, w], outputs: [deep_out] }
nodes:
  - id: core
    path: ../../bin/../bin/realo
    args: x=$PARAM_SLEEP
    inputs: { x: { source: _mod/x, queue_size: 6 }, y: _mod/y, z: _mod/z, w: _mod/w, self: tail/t }
    outputs: [raw, deep_out]
    restart_policy: on-failure
    max_restarts: 2
  - id: tail
    module: leaf.yml
    inputs: { i: core/raw }
"#,
    ),
    (
        "modules/nested/leaf.yml",
        "module: { name: leaf, inputs: [i], outputs: [t] }\nnodes: [{ id: t, path: leaf.py, inputs: { i: _mod/i }, outputs: [t] }]",
    ),
    ("plain.yml", "nodes: [{ id: only, path: ./bin/realo, args: 'a  b' }]"),
    (
        "deployed.yml",
        "nodes: [{ id: m, module: modules/nested/leaf.yml, inputs: { i: s/o }, deploy: { machine: rsu } }, \
         { id: s, path: a/b, outputs: [o], deploy: { machine: ego } }]",
    ),
];

#[test]
fn expands_nasty_modules_as_dora_does() {
    let folder = tempfile::tempdir().unwrap();
    write(folder.path(), NASTY);
    let Some(dora) = dora() else { return };
    for file in ["g.yml", "plain.yml", "deployed.yml"] {
        compare(&dora, &folder.path().join(file));
    }
}

#[test]
fn expands_nasty_modules_to_what_is_written_here() {
    let folder = tempfile::tempdir().unwrap();
    write(folder.path(), NASTY);
    let graph = FlatGraph::load(&folder.path().join("g.yml")).unwrap();
    let ids: Vec<&str> = graph.nodes.iter().map(|node| node.id.as_str()).collect();
    let agent = |id: &str| ["enc", "inner.core", "inner.tail.t", "free"].map(|node| format!("{id}.{node}"));
    let expected = [
        vec!["src".to_string()],
        agent("cav0").into(),
        agent("cav1.x").into(),
        vec!["sink".into()],
    ]
    .concat();
    assert_eq!(ids, expected);
    let enc = graph.node("cav0.enc").unwrap();
    let args = [
        "operator",
        "enc",
        "sleep=1",
        "more=$PARAM_SLEEP",
        "again=${_param.sleep}",
        "b=1",
        "no=$PARAM_SLEE",
    ];
    assert_eq!(enc.args, args);
    assert_eq!(enc.inputs["data"].queue_size, Some(7));
    assert_eq!(enc.inputs["back"].output(), Some(("cav0.inner.core", "deep_out")));
    assert!(!graph.node("cav1.x.enc").unwrap().inputs.contains_key("extra"));
    assert_eq!(enc.env["A"], Value::from("inner"));
    assert_eq!(enc.env["PARAM_DOLLAR"], Value::from("$$5"));
    assert_eq!(enc.path, folder.path().join("bin/realo"));
    assert_eq!(graph.node("cav0.free").unwrap().path, Path::new("dynamic"));
    let sink = graph.node("sink").unwrap();
    assert_eq!(sink.inputs["two"].output(), Some(("cav1.x.inner.core", "deep_out")));
}

#[test]
fn a_wire_within_a_module_may_name_a_node_of_a_module_beside_it() {
    let folder = tempfile::tempdir().unwrap();
    let outer = "module: { name: outer, inputs: [], outputs: [] }\nnodes:\n  - { id: a, module: inner.yml }\n  \
                 - { id: b, path: p, inputs: { i: a.second/t } }";
    let inner = "module: { name: inner, inputs: [], outputs: [] }\nnodes: [{ id: first, path: p, outputs: [t] }, { id: second, path: p, outputs: [t] }]";
    write(
        folder.path(),
        &[
            ("g.yml", "nodes: [{ id: m, module: modules/outer.yml }]"),
            ("modules/outer.yml", outer),
            ("modules/inner.yml", inner),
        ],
    );
    let graph = FlatGraph::load(&folder.path().join("g.yml")).unwrap();
    assert_eq!(
        graph.node("m.b").unwrap().inputs["i"].output(),
        Some(("m.a.second", "t"))
    );
}

/// Graphs that both refuse, and what our message says.
const REFUSED: &[(&str, &str, &str)] = &[
    ("nodes: [{ id: m, module: m/none.yml }]", "", "none.yml"),
    (
        "nodes: [{ id: m, module: ../up.yml }]",
        "",
        "outside the graph's folder",
    ),
    ("nodes: [{ id: m, module: /abs.yml }]", "", "relative"),
    (
        "nodes: [{ id: m, module: m/a.yml }]",
        "module: { name: a, inputs: [x] }\nnodes: []",
        "needs the input `x`",
    ),
    (
        "nodes: [{ id: m, module: m/a.yml, inputs: { clouds: s/o } }]",
        "module: { name: a, inputs_optional: [cloud] }\nnodes: []",
        "has no input `clouds` (did you mean `cloud`?)",
    ),
    (
        "nodes: [{ id: m, module: m/a.yml }]",
        "module: { name: a, outputs: [o] }\nnodes: [{ id: x, path: ../p, outputs: [o] }, { id: y, path: ../p, outputs: [o] }]",
        "several of its nodes make",
    ),
    (
        "nodes: [{ id: m, module: m/a.yml }]",
        "module: { name: a, outputs: [o] }\nnodes: []",
        "none of its nodes makes",
    ),
    (
        "nodes: [{ id: m, module: m/a.yml }]",
        "module: { name: a }\nnodes: [{ id: x, path: ../../p }]",
        "leaves the graph's folder",
    ),
    (
        "nodes: [{ id: m, module: m/a.yml }]",
        "module: { name: a }\nnodes: [{ id: x, module: a.yml }]",
        "uses itself",
    ),
    (
        "nodes: [{ id: m, module: m/a.yml }]",
        "module: { name: a }\nnodes: [{ id: x, path: ../p, inputs: { p: _mod/q } }]",
        "declares no input `q`",
    ),
    (
        "nodes: [{ id: m, module: m/a.yml }, { id: s, path: p, inputs: { p: m/boxs } }]",
        "module: { name: a, outputs: [boxes] }\nnodes: [{ id: x, path: ../p, outputs: [boxes] }]",
        "it has no output `boxs` (did you mean `boxes`?)",
    ),
    (
        "nodes: [{ id: m, module: m/a.yml }, { id: m.x, path: p }]",
        "module: { name: a }\nnodes: [{ id: x, path: ../p }]",
        "two nodes have the id `m.x`",
    ),
    (
        "nodes: [{ id: m, module: m/a.yml, params: { a: '1', A: '2' } }]",
        "module: { name: a }\nnodes: []",
        "differ in case",
    ),
    (
        "nodes: [{ id: m, module: m/a.yml, outputs: [o] }]",
        "module: { name: a, outputs: [o] }\nnodes: [{ id: x, path: ../p, outputs: [o] }]",
        "unknown key `outputs`",
    ),
    (
        "nodes: [{ id: m, module: m/a.yml }]",
        "modul: { name: a }\nnodes: []",
        "unknown key `modul`",
    ),
];

#[test]
fn refuses_what_dora_refuses_and_says_what_is_wrong() {
    let dora = dora();
    for (graph, module, expected) in REFUSED {
        let folder = tempfile::tempdir().unwrap();
        let root = folder.path().join("dataflows");
        write(
            &root,
            &[
                ("g.yml", graph),
                ("m/a.yml", module),
                ("../up.yml", "module: { name: up }\nnodes: []"),
            ],
        );
        let file = root.join("g.yml");
        let error = FlatGraph::load(&file).unwrap_err().to_string();
        assert!(error.contains(expected), "{graph}\n{error}");
        if let Some(dora) = &dora {
            assert!(expanded_by(dora, &file).is_err(), "dora takes {graph}");
        }
    }
}

#[test]
fn follows_links_as_dora_does() {
    let folder = tempfile::tempdir().unwrap();
    let leaf = "module: { name: leaf, outputs: [t] }\nnodes: [{ id: t, path: leaf.py, outputs: [t] }]";
    let graph = |module: &str| format!("nodes: [{{ id: m, module: {module} }}]");
    let files = [
        ("far/modules/leaf.yml", leaf),
        ("far/other.yml", leaf),
        ("flows/linked.yml", &graph("modules/leaf.yml")),
        ("flows/escaping.yml", &graph("modules/../other.yml")),
    ];
    write(folder.path(), &files);
    std::os::unix::fs::symlink(folder.path().join("far/modules"), folder.path().join("flows/modules")).unwrap();
    let linked = folder.path().join("flows/linked.yml");
    let escaping = folder.path().join("flows/escaping.yml");
    let flat = FlatGraph::load(&linked).unwrap();
    assert_eq!(flat.nodes[0].path, folder.path().join("flows/modules/leaf.py"));
    assert!(FlatGraph::load(&escaping).is_err());
    let Some(dora) = dora() else { return };
    compare(&dora, &linked);
    assert!(expanded_by(&dora, &escaping).is_err());
}

#[test]
fn expands_every_shipped_graph_as_dora_does() {
    let Some(dora) = dora() else { return };
    let dataflows = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../../dataflows")
        .canonicalize()
        .unwrap();
    let files = std::fs::read_dir(&dataflows)
        .unwrap()
        .map(|entry| entry.unwrap().path());
    let mut graphs: Vec<PathBuf> = files
        .filter(|file| file.extension().is_some_and(|end| end == "yml"))
        .collect();
    graphs.sort();
    assert!(!graphs.is_empty());
    for file in graphs {
        compare(&dora, &file);
    }
}

#[test]
fn recorded_detections_take_the_place_of_detect_modules() {
    let folder = tempfile::tempdir().unwrap();
    let detect = |node: &str| {
        format!("module: {{ name: {node}, outputs: [boxes] }}\nnodes: [{{ id: {node}, path: ../p, outputs: [boxes] }}]")
    };
    let outer = "module: { name: outer }\nnodes: [{ id: d, module: detect.network.yml }]";
    let files = [
        (
            "g.yml",
            "nodes: [{ id: a, module: modules/detect.network.yml }, { id: b, module: modules/outer.yml }]",
        ),
        ("none.yml", "nodes: [{ id: a, path: p }]"),
        (
            "followed.yml",
            "nodes: [{ id: a, module: modules/detect.network.tracked.yml }]",
        ),
        ("modules/detect.network.tracked.yml", &detect("network-tracked")),
        ("modules/detect.recorded.tracked.yml", &detect("recorded-tracked")),
        ("modules/outer.yml", outer),
        ("modules/detect.network.yml", &detect("network")),
        ("modules/detect.recorded.yml", &detect("recorded")),
    ];
    write(folder.path(), &files);
    let load = |file: &str| {
        Graph::load(&folder.path().join(file))
            .unwrap()
            .with_detection("recorded")
            .expand()
    };
    let ids = |file| {
        load(file)
            .unwrap()
            .nodes
            .into_iter()
            .map(|node| node.id)
            .collect::<Vec<String>>()
    };
    assert_eq!(ids("g.yml"), ["a.recorded", "b.d.recorded"]);
    assert_eq!(
        ids("followed.yml"),
        ["a.recorded-tracked"],
        "what follows the boxes stays"
    );
    let error = load("none.yml").unwrap_err().to_string();
    assert!(error.contains("no module `detect.*.yml`"), "{error}");
}
