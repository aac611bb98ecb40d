//! Modules that `realo host` runs: their stages, their processes, and what is refused.

use std::path::Path;

use super::check::tests::{REGISTRY, assert_found, changed};
use super::dora_tests::{compare, dora, write};
use super::{FlatGraph, FlatNode, Graph, OUTSIDE, audit, hosted, validate};

pub(super) const GRAPH: &str = r#"
strict_types: true
nodes:
  - id: player
    path: bin/realo
    args: node player
    outputs: [ego_clouds, ego_recorded, clouds, recorded, ego_poses, poses, truth]
    output_types:
      ego_clouds: realo/v1/PointCloud
      ego_recorded: realo/v1/Boxes
      clouds: realo/v1/PointCloud
      recorded: realo/v1/Boxes
      ego_poses: realo/v1/AgentState
      poses: realo/v1/AgentState
      truth: realo/v1/GroundTruth
  - id: ego
    path: bin/realo
    args: host modules/detect.network.yml nms.threshold=0.3
    inputs: { clouds: player/ego_clouds, recorded: player/ego_recorded }
    outputs: [boxes]
    output_types: { boxes: realo/v1/Boxes }
  - id: others
    path: bin/realo
    args: host modules/detect.network.yml
    inputs: { clouds: player/clouds, recorded: player/recorded, from_ego: v2x/to_others }
    outputs: [packets]
    output_types: { packets: realo/v1/Packet }
  - id: v2x
    path: bin/realo
    args: host modules/v2x.yml
    inputs: { packets: others/packets, ego_state: player/ego_poses, states: player/poses }
    outputs: [to_ego, to_others]
    output_types: { to_ego: realo/v1/Packet, to_others: realo/v1/Packet }
  - id: fusion
    path: bin/realo
    args: host modules/fuse.yml
    inputs: { ego: ego/boxes, packets: v2x/to_ego }
    outputs: [boxes]
    output_types: { boxes: realo/v1/Boxes }
  - id: score
    path: bin/realo
    args: host modules/score.yml
    inputs: { boxes: fusion/boxes, truth: player/truth }
"#;

const SENSE: &str = "
module: { name: sense, inputs: [clouds, recorded], outputs: [proposals] }
nodes:
  - id: sync
    path: ../bin/realo
    args: operator recorded-detections threshold=0.5
    inputs: { clouds: _mod/clouds, recorded: _mod/recorded }
    outputs: [proposals]
    output_types: { proposals: realo/v1/Boxes }
";

const LANE: &str = "
module: { name: lane, inputs: [clouds, recorded], inputs_optional: [from_ego], outputs: [boxes, packets] }
nodes:
  - { id: sense, module: sense.yml, inputs: { clouds: _mod/clouds, recorded: _mod/recorded } }
  - id: nms
    path: ../bin/realo
    args: operator nms threshold=0.15
    inputs: { proposals: sense/proposals }
    outputs: [boxes]
    output_types: { boxes: realo/v1/Boxes }
  - id: receiver
    path: ../bin/realo
    args: operator transmission-decoder
    inputs: { packets: _mod/from_ego }
    outputs: [data]
    output_types: { data: realo/v1/AgentState }
  - id: sender
    path: ../bin/realo
    args: operator transmission-encoder
    inputs: { data: nms/boxes, state: receiver/data }
    outputs: [packets]
    output_types: { packets: realo/v1/Packet }
";

const V2X: &str = "
module: { name: v2x, inputs: [packets, ego_state, states], outputs: [to_ego, to_others] }
nodes:
  - id: link
    path: ../bin/realo
    args: operator link
    inputs: { others: _mod/packets, ego_state: _mod/ego_state, states: _mod/states }
    outputs: [to_ego]
    output_types: { to_ego: realo/v1/Packet }
  - id: ego-sender
    path: ../bin/realo
    args: operator transmission-encoder
    inputs: { data: _mod/ego_state }
    outputs: [packets]
    output_types: { packets: realo/v1/Packet }
  - id: sender
    path: ../bin/realo
    args: operator transmission-encoder
    inputs: { data: _mod/states }
    outputs: [packets]
    output_types: { packets: realo/v1/Packet }
  - id: state-link
    path: ../bin/realo
    args: operator link
    inputs: { ego: ego-sender/packets, others: sender/packets, ego_state: _mod/ego_state, states: _mod/states }
    outputs: [to_others]
    output_types: { to_others: realo/v1/Packet }
";

const FUSE: &str = "
module: { name: fuse, inputs: [ego, packets], outputs: [boxes] }
nodes:
  - id: receiver
    path: ../bin/realo
    args: operator transmission-decoder
    inputs: { packets: _mod/packets }
    outputs: [data]
    output_types: { data: realo/v1/Boxes }
  - id: bank
    path: ../bin/realo
    args: operator feature-bank
    inputs: { ego: _mod/ego, others: receiver/data }
    outputs: [selections]
    output_types: { selections: realo/v1/Selection }
  - id: fusion
    path: ../bin/realo
    args: operator fusion-boxes
    inputs: { ego: _mod/ego, selections: bank/selections }
    outputs: [boxes]
    output_types: { boxes: realo/v1/Boxes }
";

const SCORE: &str = "
module: { name: score, inputs: [boxes, truth], outputs: [] }
nodes:
  - id: evaluator
    path: ../bin/realo
    args: operator evaluator
    inputs: { truth: _mod/truth, boxes: _mod/boxes }
    outputs: [report]
    output_types: { report: realo/v1/Report }
  - id: results
    path: ../bin/realo
    args: node results
    inputs: { boxes: _mod/boxes, truth: _mod/truth, evaluation: evaluator/report }
";

/// A folder of graphs; `changes` are files in place of, or beside, the sound ones.
pub(super) fn folder(changes: &[(&str, &str)]) -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    let recorded = LANE
        .replace("name: lane", "name: recorded")
        .replace("id: nms", "id: suppress")
        .replace("nms/boxes", "suppress/boxes");
    write(
        folder.path(),
        &[
            ("g.yml", GRAPH),
            ("modules/sense.yml", SENSE),
            ("modules/detect.network.yml", LANE),
            ("modules/detect.recorded.yml", &recorded),
            ("modules/v2x.yml", V2X),
            ("modules/fuse.yml", FUSE),
            ("modules/score.yml", SCORE),
        ],
    );
    write(folder.path(), changes);
    folder
}

pub(super) fn load(folder: &Path) -> Result<FlatGraph, String> {
    FlatGraph::load(&folder.join("g.yml")).map_err(|error| error.to_string())
}

/// Why a graph with this change is refused.
fn refused(from: &str, to: &str) -> String {
    load(folder(&[("g.yml", &changed(GRAPH, from, to))]).path()).unwrap_err()
}

fn ids(nodes: &[FlatNode]) -> Vec<&str> {
    nodes.iter().map(|node| node.id.as_str()).collect()
}

const STAGES: [&str; 16] = [
    "player",
    "ego.sense.sync",
    "ego.nms",
    "others.sense.sync",
    "others.nms",
    "others.receiver",
    "others.sender",
    "v2x.link",
    "v2x.ego-sender",
    "v2x.sender",
    "v2x.state-link",
    "fusion.receiver",
    "fusion.bank",
    "fusion.fusion",
    "score.evaluator",
    "score.results",
];

#[test]
fn hosts_are_replaced_by_the_stages_that_do_something_for_them() {
    let folder = folder(&[]);
    let graph = load(folder.path()).unwrap();
    assert_eq!(ids(&graph.nodes), STAGES);
    // Nobody takes what the ego would send, and nobody feeds its receiver.
    let hosts: Vec<Option<&str>> = graph.nodes.iter().map(|node| node.host.as_deref()).collect();
    assert_eq!(hosts[..4], [None, Some("ego"), Some("ego"), Some("others")]);
    let node = |id: &str| graph.node(id).unwrap();
    assert_eq!(
        node("ego.sense.sync").args,
        ["operator", "recorded-detections", "threshold=0.5"]
    );
    assert_eq!(node("ego.nms").args, ["operator", "nms", "threshold=0.3"]);
    assert_eq!(node("others.nms").args, ["operator", "nms", "threshold=0.15"]);
    let wire = |id: &str, port: &str| node(id).inputs[port].source.to_string();
    assert_eq!(wire("ego.sense.sync", "clouds"), "player/ego_clouds");
    assert_eq!(wire("ego.nms", "proposals"), "ego.sense.sync/proposals");
    assert_eq!(wire("fusion.bank", "ego"), "ego.nms/boxes");
    assert_eq!(wire("others.receiver", "packets"), "v2x.state-link/to_others");
    assert_eq!(
        node("ego.nms").path,
        folder.path().join("bin/realo"),
        "the program of its process"
    );
    assert_eq!(ids(&graph.hosts), ["ego", "others", "v2x", "fusion", "score"]);
    let fusion = &graph.hosts[3];
    assert_eq!(
        fusion.inputs["ego"].source.to_string(),
        "ego/boxes",
        "dora knows processes"
    );
    assert_eq!(
        fusion.outlets["boxes"],
        ("fusion.fusion".to_string(), "boxes".to_string())
    );
    assert_eq!(graph.hosts[0].outlets.len(), 1, "what the graph declares");
    let processes: Vec<&str> = graph.processes().iter().map(|process| process.id.as_str()).collect();
    assert_eq!(processes, ["player", "ego", "others", "v2x", "fusion", "score"]);
    assert_eq!(validate(&graph, &REGISTRY), []);
}

#[test]
fn a_folder_of_hosted_modules_is_audited() {
    let folder = folder(&[]);
    let all: String = realo_schemas::PayloadType::ALL
        .iter()
        .map(|name| format!("  {name}: {{}}\n"))
        .collect();
    let graph = GRAPH.replace(" nms.threshold=0.3", "");
    let types = format!("types:\n{all}");
    write(folder.path(), &[("g.yml", &graph), ("types/realo/v1.yml", &types)]);
    assert_eq!(audit(&REGISTRY, folder.path()), Vec::<String>::new());
    write(
        folder.path(),
        &[("modules/lonely.yml", "module: { name: lonely }\nnodes: []")],
    );
    let found = audit(&REGISTRY, folder.path());
    assert!(
        found.len() == 1 && found[0].contains("lonely.yml: no graph uses"),
        "{found:?}"
    );
}

#[test]
fn a_module_gives_the_same_stages_and_wires_in_one_process_or_in_many() {
    let many = GRAPH
        .replace("    path: bin/realo\n    args: host ", "    module: ")
        .replace("network.yml nms.threshold=0.3", "network.yml");
    let many: Vec<&str> = many
        .lines()
        .filter(|line| {
            ![
                "outputs: [boxes]",
                "outputs: [packets]",
                "outputs: [to_",
                "output_types: {",
            ]
            .iter()
            .any(|key| line.contains(key))
        })
        .collect();
    let folder = folder(&[("many.yml", &many.join("\n"))]);
    let one = load(folder.path()).unwrap();
    let mut many = FlatGraph::load(&folder.path().join("many.yml")).unwrap();
    many.set("ego.nms", "threshold", "0.3").unwrap();
    assert!(many.hosts.is_empty() && many.nodes.iter().all(|node| node.host.is_none()));
    for stage in &one.nodes {
        let same = FlatNode {
            host: None,
            ..stage.clone()
        };
        assert_eq!(many.node(&stage.id), Some(&same));
    }
    let more: Vec<&str> = ids(&many.nodes)
        .into_iter()
        .filter(|id| one.node(id).is_none())
        .collect();
    assert_eq!(more, ["ego.receiver", "ego.sender"], "processes that would do nothing");
}

#[test]
fn what_is_written_for_dora_has_the_processes_with_all_arguments() {
    let folder = folder(&[]);
    let mut graph = load(folder.path()).unwrap();
    graph.set("ego.sense.sync", "threshold", "two words").unwrap();
    graph.set("score.results", "out", "/x").unwrap();
    graph.host_in(Path::new("/opt/realo"));
    let text = graph.to_yaml().unwrap();
    let elsewhere = Path::new("/elsewhere/graph.yml");
    let (_, nodes) = super::read::dataflow(&text, elsewhere).unwrap();
    let words: Vec<(&str, Vec<String>)> = nodes
        .iter()
        .map(|node| (node.id.as_str(), shlex::split(node.args.as_ref().unwrap()).unwrap()))
        .collect();
    let file = |name: &str| folder.path().join("modules").join(name).to_str().unwrap().to_string();
    let host = |name: &str, settings: &[&str]| {
        let mut words = vec!["host".to_string(), file(name)];
        words.extend(settings.iter().map(|word| word.to_string()));
        words
    };
    let lane = "detect.network.yml";
    let expected = [
        ("player", vec!["node".to_string(), "player".into()]),
        (
            "ego",
            host(lane, &["nms.threshold=0.3", "sense.sync.threshold=two words"]),
        ),
        (
            "others",
            host(lane, &["sense.sync.threshold=0.5", "nms.threshold=0.15"]),
        ),
        ("v2x", host("v2x.yml", &[])),
        ("fusion", host("fuse.yml", &[])),
        ("score", host("score.yml", &["results.out=/x"])),
    ];
    assert_eq!(words, expected);
    assert!(nodes.iter().all(|node| node.path.as_deref() == Some("/opt/realo")));
    let again = Graph::parse(&text, elsewhere).unwrap().expand().unwrap();
    assert_eq!(again.nodes, graph.nodes);
    assert_eq!(again.settings, graph.settings);
    assert_eq!(again.to_yaml().unwrap(), text);
}

#[test]
fn a_process_reads_the_stages_that_the_graph_gives_it() {
    let folder = folder(&[]);
    let graph = load(folder.path()).unwrap();
    let texts = |texts: &[&str]| texts.iter().map(|text| text.to_string()).collect::<Vec<_>>();
    for process in &graph.hosts {
        let (module, settings) = (&process.args[1], &process.args[2..]);
        let inputs: Vec<String> = process.inputs.keys().cloned().collect();
        let outputs: Vec<String> = process.outputs.iter().cloned().collect();
        let read = hosted(&process.id, module, settings, Some((&inputs, &outputs)), folder.path()).unwrap();
        assert_eq!(read.hosts[0].outlets, process.outlets);
        let stages: Vec<&FlatNode> = graph
            .nodes
            .iter()
            .filter(|node| node.host.as_ref() == Some(&process.id))
            .collect();
        assert_eq!(read.nodes.len(), stages.len());
        for (read, stage) in read.nodes.iter().zip(stages) {
            assert_eq!((&read.id, &read.args), (&stage.id, &stage.args));
            for (port, input) in &read.inputs {
                let (source, output) = input.output().unwrap();
                match source {
                    OUTSIDE => assert!(process.inputs.contains_key(output)),
                    _ => assert_eq!(*input, stage.inputs[port]),
                }
            }
            assert_eq!(read.inputs.len(), stage.inputs.len(), "{}", read.id);
        }
    }
    let all = hosted("x", "modules/detect.network.yml", &[], None, folder.path()).unwrap();
    assert_eq!(ids(&all.nodes), ["x.sense.sync", "x.nms", "x.receiver", "x.sender"]);
    assert_eq!(
        all.node("x.receiver").unwrap().inputs["packets"].output(),
        Some((OUTSIDE, "from_ego"))
    );
    let wrong = |module: &str, settings: &[&str], inputs: &[&str], outputs: &[&str]| {
        let read = hosted(
            "x",
            module,
            &texts(settings),
            Some((&texts(inputs), &texts(outputs))),
            folder.path(),
        );
        read.unwrap_err().to_string()
    };
    let lane = "modules/detect.network.yml";
    assert!(wrong("modules/none.yml", &[], &[], &[]).contains("none.yml"));
    assert!(wrong(lane, &[], &["clouds"], &["boxes"]).contains("needs the input `recorded`"));
    assert!(wrong(lane, &[], &["clouds", "recorded"], &["boxs"]).contains("did you mean `boxes`?"));
    assert!(wrong(lane, &["nsm.x=1"], &["clouds", "recorded"], &["boxes"]).contains("did you mean `nms`?"));
}

#[test]
fn refuses_what_a_host_cannot_be() {
    let cases = [
        (
            "nms.threshold=0.3",
            "nsm.threshold=0.3",
            "module node `ego`: setting `nsm.threshold=0.3`: no stage `nsm` (did you mean `nms`?); there are: sense.sync, nms",
        ),
        ("nms.threshold=0.3", "sender.threshold=0.3", "no stage `sender`"),
        (
            "nms.threshold=0.3",
            "threshold=0.3",
            "is not of the form stage.key=value",
        ),
        (
            "nms.threshold=0.3",
            "nms.threshold",
            "is not of the form stage.key=value",
        ),
        (
            "host modules/detect.network.yml nms.threshold=0.3",
            "host",
            "node `ego`: expected `host MODULE` with the file of a module, found `host` alone",
        ),
        (
            "host modules/v2x.yml",
            "host modules/none.yml",
            "module node `v2x`: its file",
        ),
        (
            "clouds: player/ego_clouds, ",
            "",
            "module node `ego`: module `lane` needs the input `clouds`",
        ),
        (
            "{ clouds: player/ego_clouds",
            "{ cloud: player/poses, clouds: player/ego_clouds",
            "module `lane` has no input `cloud` (did you mean `clouds`?)",
        ),
        (
            "ego: ego/boxes",
            "ego: ego/packets",
            "module node `ego`: it has no output `packets`, which node `fusion` takes for its input `ego`; it has: boxes",
        ),
        ("id: others", "id: ego", "two nodes have the id `ego"),
        ("id: player", "id: ego.nms", "two nodes have the id `ego.nms`"),
        ("id: player", "id: ego", "two nodes have the id `ego`"),
    ];
    for (from, to, expected) in cases {
        let error = refused(from, to);
        assert!(error.contains(expected), "{to}\n{error}");
    }
}

#[test]
fn refuses_an_output_that_a_module_has_not_and_somebody_takes() {
    let offers = GRAPH.replacen("outputs: [boxes]", "outputs: [boxes, packet]", 1);
    assert!(load(folder(&[("g.yml", &offers)]).path()).is_ok(), "nobody takes it");
    let takes = changed(&offers, "ego: ego/boxes", "ego: ego/packet");
    let error = load(folder(&[("g.yml", &takes)]).path()).unwrap_err();
    let expected =
        "module node `ego`: its module has no output `packet` (did you mean `packets`?); it has: boxes, packets";
    assert!(error.contains(expected), "{error}");
}

const CAR: &str = "
module: { name: car, inputs: [clouds, recorded], outputs: [boxes] }
nodes:
  - id: lane
    path: ../bin/realo
    args: host $PARAM_LANE
    inputs: { clouds: _mod/clouds, recorded: _mod/recorded }
    outputs: [boxes]
";

/// A graph whose modules of processes get parameters.
fn with_params(params: &str) -> Result<FlatGraph, String> {
    let car = format!(
        "  - {{ id: car, module: modules/car.yml, inputs: {{ clouds: player/clouds, recorded: player/recorded }}, params: {params} }}"
    );
    let graph = format!(
        "env: {{ OVERLAP: much }}\nnodes:\n  - {{ id: player, path: bin/realo, args: node player, outputs: [clouds, recorded] }}\n\
         {car}\n  - {{ id: last, path: bin/last, inputs: {{ boxes: car/boxes }} }}\n"
    );
    let folder = folder(&[("g.yml", &graph), ("modules/car.yml", CAR)]);
    let flat = load(folder.path())?;
    if let Some(dora) = dora() {
        compare(&dora, &folder.path().join("g.yml"));
    }
    Ok(flat)
}

#[test]
fn parameters_choose_what_a_module_hosts() {
    let flat = with_params("{ lane: modules/detect.network.yml nms.threshold=$OVERLAP }").unwrap();
    assert_eq!(flat.node("lane.nms").unwrap().settings(), ["threshold=much"]);
    let own = "{ lane: modules/detect.network.yml \"nms=program plug/nms.py overlap=$OVERLAP\" }";
    let flat = with_params(own).unwrap();
    assert_eq!(
        flat.node("lane.nms").unwrap().args,
        ["program", "plug/nms.py", "overlap=much"]
    );
    let shipped = "{ lane: modules/detect.network.yml \"nms=operator other\" }";
    assert_eq!(
        with_params(shipped).unwrap().node("lane.nms").unwrap().args,
        ["operator", "other"]
    );
}

#[test]
fn refuses_parameters_that_a_module_does_not_name_or_lacks() {
    for (params, expected) in [
        (
            "{ lain: x.yml }",
            "module node `car`: module `car` has no parameter `lain` (did you mean `lane`?); it has: lane",
        ),
        (
            "{}",
            "module node `car`: module `car` needs the parameter `lane` for its node `lane`; write it under `params`",
        ),
        ("{ lane: modules/none.yml }", "none.yml"),
        (
            "{ lane: modules/detect.network.yml nms.threshold=1 nms.threshold=2 }",
            "`nms.threshold` is set twice, by `nms.threshold=1` and by `nms.threshold=2`",
        ),
        (
            "{ lane: 'modules/detect.network.yml my models/a.toml' }",
            "parameter `lane`: expected a value and settings",
        ),
        (
            "{ lane: 'modules/detect.network.yml \"nmb=program x\"' }",
            "no stage `nmb` (did you mean `nms`?)",
        ),
    ] {
        let error = with_params(params).unwrap_err();
        assert!(error.contains(expected), "{params}\n{error}");
    }
}

#[test]
fn refuses_modules_that_a_process_cannot_host() {
    let stage = |id: &str, rest: &str| format!("  - {{ id: {id}, path: ../bin/realo, {rest} }}\n");
    let head = "module: { name: m, inputs_optional: [clouds, recorded], outputs: [boxes] }\nnodes:\n";
    let cases = [
        (
            format!("{head}{}", stage("inner", "args: host sense.yml")),
            "module node `ego.inner`: it is in a module that `ego` hosts: write `module: sense.yml`",
        ),
        (
            format!(
                "{head}{}",
                stage(
                    "nms",
                    "args: operator nms, inputs: { proposals: others/packets }, outputs: [boxes]"
                )
            ),
            "its stage `ego.nms` takes `others/packets` for its input `proposals` past the module's inputs",
        ),
        (
            format!("{head}  - {{ id: again, module: detect.network.yml }}\n"),
            "uses itself",
        ),
    ];
    for (module, expected) in cases {
        let graph = GRAPH.replace(" nms.threshold=0.3", "");
        let folder = folder(&[("g.yml", &graph), ("modules/detect.network.yml", &module)]);
        let error = load(folder.path()).unwrap_err();
        assert!(error.contains(expected), "{expected}\n{error}");
    }
}

#[test]
fn an_output_that_nothing_makes_is_named_with_the_stage_behind_it() {
    let module = LANE.replace(
        "clouds, recorded], inputs_optional: [",
        "clouds, recorded], inputs_optional: [late, ",
    );
    let module = module.replace("outputs: [boxes, packets]", "outputs: [boxes, packets, data]");
    let graph = GRAPH.replacen("outputs: [boxes]", "outputs: [boxes, data]", 1);
    let taker = "  - { id: taker, path: bin/taker, inputs: { data: ego/data } }\n";
    let graph = format!("{}\n{taker}", graph.trim_end());
    let folder = folder(&[("g.yml", &graph), ("modules/detect.network.yml", &module)]);
    let error = load(folder.path()).unwrap_err();
    let expected = "nothing comes out of its output `data`: nobody feeds the stage `ego.receiver` behind it";
    assert!(error.contains(expected), "{error}");
}

#[test]
fn stages_behind_one_that_nobody_feeds_are_left_out_too() {
    // x takes an optional input alone, y takes x alone, z takes y and something else.
    let stage = |id: &str, inputs: &str, outputs: &str| {
        format!(
            "  - {{ id: {id}, path: ../bin/realo, args: operator {id}, inputs: {{ {inputs} }}, outputs: [{outputs}] }}\n"
        )
    };
    let module = format!(
        "module: {{ name: m, inputs: [a], inputs_optional: [b], outputs: [z] }}\nnodes:\n{}{}{}{}",
        stage("x", "i: _mod/b", "x"),
        stage("y", "i: x/x", "y"),
        stage("z", "i: y/y, j: _mod/a", "z"),
        stage("sink", "i: y/y", "")
    );
    let graph = "nodes: [{ id: s, path: s, outputs: [o] }, { id: h, path: realo, args: host m.yml, inputs: { a: s/o }, outputs: [z] }, \
                 { id: t, path: t, inputs: { z: h/z } }]";
    let folder = folder(&[("g.yml", graph), ("m.yml", &module)]);
    let flat = load(folder.path()).unwrap();
    assert_eq!(ids(&flat.nodes), ["s", "h.z", "t"]);
    let ports: Vec<&String> = flat.nodes[1].inputs.keys().collect();
    assert_eq!(ports, ["j"]);
    let fed = graph.replace("a: s/o", "a: s/o, b: s/o");
    write(folder.path(), &[("g.yml", &fed)]);
    assert_eq!(
        ids(&load(folder.path()).unwrap().nodes),
        ["s", "h.x", "h.y", "h.z", "h.sink", "t"]
    );
    let quiet = fed.replace("z: h/z", "z: s/o");
    write(folder.path(), &[("g.yml", &quiet)]);
    let left = load(folder.path()).unwrap();
    assert_eq!(
        ids(&left.nodes),
        ["s", "h.x", "h.y", "h.sink", "t"],
        "a sink is reason enough, an output that nobody takes is none"
    );
}

#[test]
fn a_host_within_a_module_is_seen_from_the_graphs_folder_and_wired_by_stages() {
    let car = "
module: { name: car, inputs: [clouds, recorded], outputs: [boxes] }
nodes:
  - id: lane
    path: ../bin/realo
    args: host modules/detect.network.yml
    inputs: { clouds: _mod/clouds, recorded: _mod/recorded }
    outputs: [boxes]
";
    let graph = "
nodes:
  - { id: player, path: bin/realo, args: node player, outputs: [clouds, recorded] }
  - { id: car, module: modules/car.yml, inputs: { clouds: player/clouds, recorded: player/recorded } }
  - { id: last, path: bin/realo, args: operator nms, inputs: { proposals: car/boxes }, outputs: [boxes] }
  - { id: direct, path: bin/realo, args: operator nms, inputs: { proposals: car.lane/boxes } }
  - { id: post, path: bin/realo, args: host modules/post.yml, inputs: { proposals: car/boxes }, outputs: [boxes] }
  - { id: after, path: bin/after, inputs: { boxes: post/boxes } }
";
    let post = "module: { name: post, inputs: [proposals], outputs: [boxes] }\n\
                nodes: [{ id: nms, path: ../bin/realo, args: operator nms, inputs: { proposals: _mod/proposals }, outputs: [boxes] }]";
    let folder = folder(&[("g.yml", graph), ("modules/car.yml", car), ("modules/post.yml", post)]);
    let flat = load(folder.path()).unwrap();
    let lane = ["lane.sense.sync", "lane.nms"];
    assert_eq!(
        ids(&flat.nodes),
        ["player", lane[0], lane[1], "last", "direct", "post.nms", "after"],
        "`car` only groups processes"
    );
    for id in ["last", "direct", "post.nms"] {
        let wire = &flat.node(id).unwrap().inputs["proposals"];
        assert_eq!(wire.output(), Some(("lane.nms", "boxes")), "{id}");
    }
    assert_eq!(flat.hosts[1].inputs["proposals"].output(), Some(("lane", "boxes")));
    assert!(flat.ranks(&realo_operator::Registry(&[])).is_ok());
    let Some(dora) = dora() else { return };
    compare(&dora, &folder.path().join("g.yml"));
}

#[test]
fn dora_leaves_hosts_as_they_are() {
    let folder = folder(&[]);
    let Some(dora) = dora() else { return };
    compare(&dora, &folder.path().join("g.yml"));
}

#[test]
fn another_detection_takes_the_place_in_hosts_too() {
    let folder = folder(&[("one.yml", &GRAPH.replace(" nms.threshold=0.3", ""))]);
    let file = folder.path().join("one.yml");
    let graph = Graph::load(&file).unwrap().with_detection("recorded").expand().unwrap();
    assert!(graph.node("ego.suppress").is_some() && graph.node("others.suppress").is_some());
    assert!(graph.node("ego.nms").is_none());
    assert!(
        graph.hosts[0].args[1].ends_with("modules/detect.recorded.yml"),
        "{:?}",
        graph.hosts[0].args
    );
    let score = GRAPH.replace("modules/detect.network.yml", "modules/other.yml");
    write(folder.path(), &[("score.yml", &score), ("modules/other.yml", LANE)]);
    let error = Graph::load(&folder.path().join("score.yml"))
        .unwrap()
        .with_detection("recorded")
        .expand();
    assert!(error.unwrap_err().to_string().contains("no module `detect.*.yml`"));
}

#[test]
fn the_path_of_a_hosted_plug_in_is_a_setting() {
    let lane = LANE.replace("operator nms threshold=0.15", "program plugs/nms.py threshold=0.15");
    let graph = GRAPH.replace("nms.threshold=0.3", "nms.program=mine.py nms.threshold=0.3");
    let folder = folder(&[("g.yml", &graph), ("modules/detect.network.yml", &lane)]);
    let mut graph = load(folder.path()).unwrap();
    assert_eq!(
        graph.node("ego.nms").unwrap().args,
        ["program", "mine.py", "threshold=0.3"]
    );
    assert_eq!(graph.node("others.nms").unwrap().program(), Some("plugs/nms.py"));
    assert_eq!(graph.node("others.nms").unwrap().settings(), ["threshold=0.15"]);
    assert_eq!(graph.node("ego.sense.sync").unwrap().program(), None);
    let stage = |graph: &FlatGraph, id: &str| graph.nodes.iter().position(|node| node.id == id).unwrap();
    let at = stage(&graph, "others.nms");
    graph.nodes[at].set_program("/abs/nms.py");
    let at = stage(&graph, "others.sender");
    graph.nodes[at].set_program("/abs/nms.py");
    assert_eq!(graph.nodes[at].args, ["operator", "transmission-encoder"]);
    let again = Graph::parse(&graph.to_yaml().unwrap(), Path::new("/x/g.yml"))
        .unwrap()
        .expand()
        .unwrap();
    assert_eq!(again.nodes, graph.nodes);
}

#[test]
fn settings_reach_hosted_stages_and_unknown_ones_are_refused() {
    let folder = folder(&[]);
    let mut graph = load(folder.path()).unwrap();
    graph.set("others.sense.sync", "threshold", "0.9").unwrap();
    assert_eq!(graph.node("others.sense.sync").unwrap().settings(), ["threshold=0.9"]);
    let mut error = |id: &str| graph.set(id, "threshold", "1").unwrap_err().to_string();
    assert!(error("ego").contains("no node `ego` (did you mean `ego.sense.sync`?)"));
    assert!(error("ego.nsm").contains("no node `ego.nsm` (did you mean `ego.nms`?)"));
    assert!(error("othe").contains("the graph has: player, ego.sense.sync"));
}

#[test]
fn what_is_wrong_with_a_hosted_graph_is_found() {
    let cases = [
        (
            "output_types: { boxes: realo/v1/Boxes }",
            "",
            "error: node `ego`, port `boxes`: expected `realo/v1/Boxes`, as `ego.nms` sends it, found no type",
        ),
        (
            "output_types: { boxes: realo/v1/Boxes }",
            "output_types: { boxes: realo/v1/Packet }",
            "error: node `ego`, port `boxes`: expected `realo/v1/Boxes`, as `ego.nms` sends it, found `realo/v1/Packet`",
        ),
        (
            "output_types: { boxes: realo/v1/Boxes }",
            "output_types: { boxes: realo/v1/Boxes, packets: realo/v1/Packet }",
            "error: node `ego`, port `packets`: expected a port of the node, found only its entry in `output_types`",
        ),
        (
            "nms.threshold=0.3",
            "nms.treshold=0.3",
            "error: node `ego.nms`: expected settings of `nms`, found unknown setting `treshold`",
        ),
        (
            "args: host modules/score.yml",
            "args: host modules/score.yml\n    health_check_timeout: 2.0",
            "error: node `score`: expected no `health_check_timeout` on a sink",
        ),
        (
            "args: host modules/v2x.yml",
            "args: host modules/v2x.yml\n    restart_policy: on-failure",
            "warning: node `v2x`: expected no `restart_policy`, found `on-failure`",
        ),
        (
            "recorded: player/ego_recorded",
            "recorded: player/recorded",
            "error: node `ego.sense.sync`: expected inputs of one lane",
        ),
        (
            "ego: ego/boxes",
            "ego: { source: ego/boxes, queue_policy: backpressure }",
            "warning: node `fusion.bank`, port `ego`: expected no `queue_policy`",
        ),
    ];
    for (from, to, expected) in cases {
        let folder = folder(&[("g.yml", &changed(GRAPH, from, to))]);
        assert_found(&load(folder.path()).unwrap(), &[expected]);
    }
    let foreign = changed(LANE, "path: ../bin/realo", "path: ../nms.py");
    let graph = load(folder(&[("modules/detect.network.yml", &foreign)]).path()).unwrap();
    let expected = "error: node `ego.nms`: expected a stage of realo, found the program";
    assert_found(&graph, &[expected]);
}

#[test]
fn a_graph_without_nodes_is_refused() {
    let module = ("modules/none.yml", "module: { name: none }\nnodes: []");
    for (graph, found) in [
        ("nodes: []", "found an empty list"),
        (
            "nodes: [{ id: m, module: modules/none.yml }]",
            "found modules without nodes alone",
        ),
    ] {
        let folder = tempfile::tempdir().unwrap();
        write(folder.path(), &[("g.yml", graph), module]);
        let error = load(folder.path()).unwrap_err();
        for words in [
            "g.yml: the dataflow, nodes: expected one node or more",
            found,
            "{id: NAME, path: PROGRAM}",
        ] {
            assert!(error.contains(words), "{error}");
        }
    }
}
