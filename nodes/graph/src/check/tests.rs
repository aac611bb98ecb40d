use std::path::Path;

use realo_schemas::{Message, Nanos, PayloadType};

use super::*;
use crate::Graph;
use realo_operator::{
    Books, Describe, Error, Gateway, Operator, Outputs, Port, PortError, PortId, Settings, Side, Sink, Source,
    StageInputs, StageOutputs, Waker,
};

#[derive(Settings, serde::Serialize, serde::Deserialize)]
struct Settings {
    /// A number.
    threshold: f64,
}

const CLOUDS: &[PayloadType] = &[PayloadType::PointCloud];
const BOXES: &[PayloadType] = &[PayloadType::Boxes];
const STATES: &[PayloadType] = &[PayloadType::AgentState];
const PACKETS: &[PayloadType] = &[PayloadType::Packet];
const REPORTS: &[PayloadType] = &[PayloadType::Report];
const TRUTH: &[PayloadType] = &[PayloadType::GroundTruth];
const CONTENT: &[PayloadType] = &[PayloadType::PointCloud, PayloadType::Boxes, PayloadType::AgentState];

const fn port(name: &'static str, types: &'static [PayloadType]) -> Port {
    Port::new(name, types, "what a test needs")
}

macro_rules! stage {
    ($kind:ident, $type:ident, $name:literal, [$($inputs:expr),*], [$($outputs:expr),*]) => {
        struct $type;
        const _: () = {
            #[derive(Debug)]
            pub struct Input;
            impl StageInputs for Input {
                const PORTS: &'static [Port] = &[$($inputs),*];
                fn read(_: PortId, _: Message) -> Result<Self, PortError> {
                    Ok(Input)
                }
            }
            pub enum Output {}
            impl StageOutputs for Output {
                const PORTS: &'static [Port] = &[$($outputs),*];
                fn into_message(self) -> (PortId, Message) {
                    match self {}
                }
            }
            impl Describe for $type {
                type Settings = Settings;
                type Input = Input;
                type Output = Output;
                const NAME: &'static str = $name;
                const ABOUT: &'static str = "a stage of a test";
            }
        };
        stage!($kind, $type);
    };
    (operator, $type:ident) => {
        impl Operator for $type {
            fn build(_: Settings) -> Result<Self, Error> {
                Ok($type)
            }
            fn on_input(&mut self, _: Self::Input, _: &mut Outputs<Self::Output>) -> Result<(), Error> {
                Ok(())
            }
        }
    };
    (source, $type:ident) => {
        impl Source for $type {
            fn build(_: Settings) -> Result<Self, Error> {
                Ok($type)
            }
            fn next(&mut self) -> Result<Option<(Nanos, Self::Output)>, Error> {
                Ok(None)
            }
        }
    };
    (gateway, $type:ident) => {
        impl Gateway for $type {
            fn build(_: Settings) -> Result<Self, Error> {
                Ok($type)
            }
            fn open(&mut self, _: Waker) -> Result<(), Error> {
                Ok(())
            }
            fn on_input(&mut self, _: Self::Input, _: &mut Outputs<Self::Output>) -> Result<(), Error> {
                Ok(())
            }
            fn on_wake(&mut self, _: Nanos, _: &mut Outputs<Self::Output>) -> Result<(), Error> {
                Ok(())
            }
            fn on_end(&mut self, _: &mut Outputs<Self::Output>) -> Result<(), Error> {
                Ok(())
            }
        }
    };
    (sink, $type:ident) => {
        impl Sink for $type {
            fn build(_: Settings) -> Result<Self, Error> {
                Ok($type)
            }
            fn accept(&mut self, _: Self::Input) -> Result<(), Error> {
                Ok(())
            }
            fn finish(&mut self, _: &Books) -> Result<(), Error> {
                Ok(())
            }
        }
    };
}

stage!(
    source,
    Player,
    "player",
    [],
    [
        port("ego_clouds", CLOUDS).of(Side::Ego),
        port("ego_recorded", BOXES).of(Side::Ego),
        port("clouds", CLOUDS).of(Side::Others),
        port("recorded", BOXES).of(Side::Others),
        port("poses", STATES).of(Side::Others),
        port("ego_poses", STATES).of(Side::Ego),
        port("truth", TRUTH).of(Side::Ego)
    ]
);
stage!(
    operator,
    Detect,
    "recorded-detections",
    [port("clouds", CLOUDS), port("recorded", BOXES)],
    [port("proposals", BOXES)]
);
stage!(operator, Nms, "nms", [port("proposals", BOXES)], [port("boxes", BOXES)]);
stage!(
    operator,
    Encoder,
    "transmission-encoder",
    [
        port("data", CONTENT),
        port("state", STATES).of(Side::EgoReceived).optional()
    ],
    [port("packets", PACKETS)]
);
stage!(
    operator,
    Decoder,
    "transmission-decoder",
    [port("packets", PACKETS)],
    [port("data", CONTENT)]
);
stage!(
    operator,
    Link,
    "link",
    [
        port("ego", PACKETS).of(Side::Ego).optional(),
        port("others", PACKETS).of(Side::Others),
        port("ego_state", STATES).of(Side::Ego),
        port("states", STATES).of(Side::Others)
    ],
    [
        port("to_ego", PACKETS).of(Side::OthersReceived),
        port("to_others", PACKETS).of(Side::EgoReceived),
        port("report", REPORTS)
    ]
);
stage!(
    operator,
    Bank,
    "feature-bank",
    [
        port("ego", CONTENT).of(Side::Ego).query(),
        port("others", CONTENT).of(Side::OthersReceived)
    ],
    [
        port("selections", &[PayloadType::Selection]).of(Side::Ego),
        port("report", REPORTS)
    ]
);
stage!(
    operator,
    Fusion,
    "fusion-boxes",
    [
        port("ego", BOXES).of(Side::Ego).joined("frame"),
        port("selections", &[PayloadType::Selection])
            .of(Side::Ego)
            .joined("frame")
    ],
    [port("boxes", BOXES), port("report", REPORTS)]
);
stage!(
    operator,
    Evaluator,
    "evaluator",
    [
        port("truth", TRUTH).of(Side::Ego).on_wire("truth"),
        port("boxes", BOXES).of(Side::Ego).on_wire("boxes")
    ],
    [port("report", REPORTS)]
);
stage!(
    sink,
    Results,
    "results",
    [
        port("boxes", BOXES).of(Side::Ego).on_wire("boxes"),
        port("truth", TRUTH).of(Side::Ego).on_wire("truth"),
        port("evaluation", REPORTS).of(Side::Ego)
    ],
    []
);
stage!(
    sink,
    Recorder,
    "recorder",
    [
        port("boxes", BOXES).of(Side::Ego),
        port("ego_boxes", BOXES).of(Side::Ego).optional(),
        port("other_boxes", BOXES).of(Side::Others).optional(),
        port("ego_state", STATES).of(Side::Ego).optional(),
        port("states", STATES).of(Side::Others).optional(),
        port("truth", TRUTH).of(Side::Ego).optional(),
        port("ego_clouds", CLOUDS).of(Side::Ego).optional(),
        port("clouds", CLOUDS).of(Side::Others).optional()
    ],
    []
);

stage!(
    gateway,
    Radio,
    "radio",
    [port("packets", PACKETS), port("state", STATES).optional()],
    [port("states", PACKETS).of(Side::EgoReceived)]
);

pub(crate) const REGISTRY: Registry = Registry(&[
    Registration::gateway::<Radio>(),
    Registration::source::<Player>(),
    Registration::operator::<Detect>(),
    Registration::operator::<Nms>(),
    Registration::operator::<Encoder>(),
    Registration::operator::<Decoder>(),
    Registration::operator::<Link>(),
    Registration::operator::<Bank>(),
    Registration::operator::<Fusion>(),
    Registration::operator::<Evaluator>(),
    Registration::sink::<Results>(),
    Registration::sink::<Recorder>(),
]);

/// Late fusion without poses; every line that a case changes stands for itself.
pub(crate) const GRAPH: &str = r#"
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
  - id: ego-detect
    path: bin/realo
    args: operator recorded-detections
    inputs:
      clouds: player/ego_clouds
      recorded: player/ego_recorded
    outputs: [proposals]
    output_types: { proposals: realo/v1/Boxes }
  - id: ego-nms
    path: bin/realo
    args: operator nms threshold=0.15
    inputs: { proposals: ego-detect/proposals }
    outputs: [boxes]
    output_types: { boxes: realo/v1/Boxes }
  - id: detect
    path: bin/realo
    args: operator recorded-detections
    inputs:
      clouds: player/clouds
      recorded: player/recorded
    outputs: [proposals]
    output_types: { proposals: realo/v1/Boxes }
  - id: encoder
    path: bin/realo
    args: operator transmission-encoder
    inputs: { data: detect/proposals }
    outputs: [packets]
    output_types: { packets: realo/v1/Packet }
  - id: link
    path: bin/realo
    args: operator link
    inputs:
      others: encoder/packets
      ego_state: player/ego_poses
      states: player/poses
    outputs: [to_ego, report]
    output_types: { to_ego: realo/v1/Packet, report: realo/v1/Report }
  - id: decoder
    path: bin/realo
    args: operator transmission-decoder
    inputs: { packets: link/to_ego }
    outputs: [data]
    output_types: { data: realo/v1/Boxes }
  - id: bank
    path: bin/realo
    args: operator feature-bank
    inputs:
      ego: ego-nms/boxes
      others: decoder/data
    outputs: [selections, report]
    output_types: { selections: realo/v1/Selection, report: realo/v1/Report }
  - id: fusion
    path: bin/realo
    args: operator fusion-boxes
    inputs:
      ego: ego-nms/boxes # fusion
      selections: bank/selections
    outputs: [boxes, report]
    output_types: { boxes: realo/v1/Boxes, report: realo/v1/Report }
  - id: evaluator
    path: bin/realo
    args: operator evaluator
    inputs:
      truth: player/truth
      boxes: fusion/boxes # evaluator
    outputs: [report]
    output_types: { report: realo/v1/Report }
  - id: results
    path: bin/realo
    args: node results
    inputs:
      boxes: fusion/boxes # results
      truth: player/truth
      evaluation: evaluator/report
"#;

fn graph(text: &str) -> FlatGraph {
    let graph = Graph::parse(text, Path::new("/graphs/g.yml")).and_then(|graph| graph.expand());
    graph.unwrap_or_else(|error| panic!("{error}"))
}

fn findings(text: &str) -> Vec<Finding> {
    validate(&graph(text), &REGISTRY)
}

/// What a text is with one part of it replaced.
pub(crate) fn changed(text: &str, from: &str, to: &str) -> String {
    let changed = text.replacen(from, to, 1);
    assert_ne!(changed, text, "{from}");
    changed
}

/// Checks that each of these is part of something that is found in the graph.
pub(crate) fn assert_found(graph: &FlatGraph, expected: &[&str]) {
    let found: Vec<String> = validate(graph, &REGISTRY).iter().map(Finding::to_string).collect();
    for part in expected {
        assert!(
            found.iter().any(|finding| finding.contains(part)),
            "no `{part}` in\n{}",
            found.join("\n")
        );
    }
}

#[test]
fn finds_nothing_in_a_sound_graph() {
    assert_eq!(findings(GRAPH), []);
}

#[test]
fn a_graph_for_machines_says_of_every_node_where_it_runs() {
    let placed = "path: bin/realo\n    deploy: { machine: compute, working_dir: ../../dataflows }";
    let all = graph(&graph_of_all(placed));
    assert_eq!(validate(&all, &REGISTRY), []);
    assert_eq!(written_findings(&all), []);
    assert_eq!(all.machines(), ["compute"].into());
    assert!(all.on_one_machine() == graph(GRAPH));
    let but_one = graph(&changed(&graph_of_all(placed), placed, "path: bin/realo"));
    assert_found(
        &but_one,
        &["warning: node `player`: expected `deploy: { machine: NAME }`, as other nodes have, found none; dora starts"],
    );
    let nowhere = changed(&graph_of_all(placed), ", working_dir: ../../dataflows", "");
    let expected =
        "warning: node `player`: expected `working_dir` in its `deploy`, found none; dora starts it in _work/SESSION";
    assert_found(&graph(&nowhere), &[expected]);
    for (from, to, expected) in [
        ("machine:", "machin:", "found `machin`; did you mean `machine`?"),
        (
            "machine: compute",
            "machine: 3",
            "error: node `player`: expected `deploy: { machine: NAME, working_dir: PATH }`",
        ),
    ] {
        assert_found(&graph(&changed(&graph_of_all(placed), from, to)), &[expected]);
    }
    let whole = changed(
        GRAPH,
        "strict_types: true",
        "strict_types: true\ndeploy: { machin: compute }",
    );
    let found = written_findings(&graph(&whole));
    assert!(
        found.len() == 1
            && found[0]
                .to_string()
                .starts_with("error: graph: expected a `deploy` with machine"),
        "{found:?}"
    );
    // By labels, dora chooses the machine.
    let labels = changed(&graph_of_all(placed), "machine: compute", "labels: { gpu: \"true\" }");
    assert_eq!(findings(&labels), []);
}

fn graph_of_all(placed: &str) -> String {
    GRAPH.replace("path: bin/realo", placed)
}

#[test]
fn what_a_foreign_node_gives_makes_no_lane_of_what_is_reported_beside_it() {
    let reported = r#"
  - { id: camera, path: bin/camera, outputs: [boxes], output_types: { boxes: realo/v1/Boxes } }
  - id: tell
    path: bin/realo
    args: operator transmission-encoder
    inputs: { data: player/ego_poses }
    outputs: [packets]
  - id: tell-too
    path: bin/realo
    args: operator transmission-encoder
    inputs: { data: player/poses }
    outputs: [packets]
  - id: back
    path: bin/realo
    args: operator link
    inputs: { ego: tell/packets, others: tell-too/packets, ego_state: player/ego_poses, states: player/poses }
    outputs: [to_others]
  - id: hear
    path: bin/realo
    args: operator transmission-decoder
    inputs: { packets: back/to_others }
    outputs: [data]
"#;
    let lanes = |state: &str| -> Vec<String> {
        let inputs = format!("{{ data: camera/boxes, state: {state} }}");
        let text = changed(GRAPH, "{ data: detect/proposals }", &inputs) + reported;
        let found = findings(&text).into_iter().map(|finding| finding.to_string());
        found.filter(|finding| finding.contains("through a link")).collect()
    };
    assert_eq!(lanes("hear/data"), Vec::<String>::new());
    let found = lanes("player/ego_poses");
    assert!(found.len() == 1 && found[0].contains("port `state`"), "{found:?}");
}

/// What is written in place of what, and what is found then.
const CASES: &[(&str, &str, &[&str])] = &[
    (
        "{ data: realo/v1/Boxes }",
        "{ data: realo/v1/FeatureMap }",
        &[
            "error: node `decoder`, port `packets`: expected packets of features, as its outputs are typed, found packets of boxes, \
             which `encoder` sends; the parts of the graph do not fit",
        ],
    ),
    (
        "{ data: detect/proposals }",
        "{ data: player/clouds }",
        &["expected packets of boxes, as its outputs are typed, found packets of points, which `encoder` sends"],
    ),
    (
        "operator transmission-decoder",
        "operator transmission-decoder kind=points",
        &["expected a `kind` that is sent: packets of boxes, which `encoder` sends, found kind=points"],
    ),
    (
        "operator nms threshold=0.15",
        "operator nms threshold=$PARAM_OVERLAP",
        &[
            "error: node `ego-nms`: expected a value for each parameter, found `threshold=$PARAM_OVERLAP`; write `overlap` under the \
             `params`",
        ],
    ),
    (
        "strict_types: true",
        "",
        &["warning: graph: expected `strict_types: true`, found none; write"],
    ),
    (
        "operator nms threshold",
        "operator nsm threshold",
        &["error: node `ego-nms`: expected", "did you mean `nms`?"],
    ),
    (
        "node player",
        "operator player",
        &["`player` is a node: write `node player`"],
    ),
    (
        "args: node results",
        "args: results",
        &[
            "error: node `results`: expected `operator NAME`",
            "no result is written",
        ],
    ),
    (
        "threshold=0.15",
        "treshold=0.15",
        &[
            "node `ego-nms`: expected settings of `nms`",
            "did you mean `threshold`?",
        ],
    ),
    ("threshold=0.15", "threshold=$PARAM_T", &["`threshold=$PARAM_T`"]),
    (
        "threshold=0.15",
        "threshold=$LEAST",
        &["`threshold=$LEAST`", "`env` at the graph's head"],
    ),
    (
        "output_types: { data: realo/v1/Boxes }",
        "",
        &[
            "error: node `decoder`, port `data`: expected `realo/v1/PointCloud` or",
            "found no type; add it to `output_types`",
        ],
    ),
    (
        "output_types: { data: realo/v1/Boxes }",
        "output_types: { data: realo/v1/Box }",
        &[
            "port `data`",
            "found `realo/v1/Box` (did you mean `realo/v1/Boxes`?)",
            "port `others`: expected `realo/v1/PointCloud` or `realo/v1/Boxes` or `realo/v1/AgentState`, found `realo/v1/Box` from `decoder/data`",
        ],
    ),
    (
        "output_types: { data: realo/v1/Boxes }",
        "output_types: { data: realo/v1/Packet }",
        &[
            "port `data`: expected `realo/v1/PointCloud` or `realo/v1/Boxes` or `realo/v1/AgentState`, found `realo/v1/Packet`",
            "port `others`: expected `realo/v1/PointCloud` or `realo/v1/Boxes` or `realo/v1/AgentState`, found `realo/v1/Packet`",
        ],
    ),
    (
        "proposals: ego-detect/proposals",
        "proposals: { source: ego-detect/proposals, queue_policy: backpressure }",
        &["warning: node `ego-nms`, port `proposals`: expected no `queue_policy`, found `backpressure`"],
    ),
    (
        "proposals: ego-detect/proposals",
        "proposals: { source: ego-detect/proposals, input_timeout: 0.5 }",
        &["warning: node `ego-nms`, port `proposals`: expected no `input_timeout`, found one"],
    ),
    (
        "proposals: ego-detect/proposals",
        "proposals: dora/timer/millis/100",
        &["error: node `ego-nms`, port `proposals`: expected an output of a node, found `dora/timer/millis/100`"],
    ),
    (
        "inputs: { proposals: ego-detect/proposals }",
        "inputs: { proposals: ego-detect/proposals }\n    input_types: { proposals: realo/v1/PointCloud }",
        &[
            "node `ego-nms`, port `proposals`: expected `realo/v1/Boxes`, found `realo/v1/PointCloud`; correct the type",
            "port `proposals`: expected `realo/v1/PointCloud`, found `realo/v1/Boxes` from `ego-detect/proposals`",
        ],
    ),
    (
        "inputs: { proposals: ego-detect/proposals }",
        "inputs: { proposals: ego-detect/proposals }\n    input_types: { box: realo/v1/Boxes }",
        &["port `box`: expected a port of the node, found only its entry in `input_types`"],
    ),
    (
        "proposals: ego-detect/proposals",
        "proposals: player/ego_clouds",
        &["port `proposals`: expected `realo/v1/Boxes`, found `realo/v1/PointCloud` from `player/ego_clouds`"],
    ),
    (
        "ego-detect/proposals",
        "ego-detct/boxes",
        &["port `proposals`", "no node `ego-detct` (did you mean `ego-detect`?)"],
    ),
    (
        "ego-detect/proposals",
        "ego-detect/proposal",
        &["found `ego-detect/proposal` (did you mean `proposals`?)"],
    ),
    (
        "ego-detect/proposals",
        "ego-nms/boxes",
        &["error: graph: expected no cycle, found", "ego-nms > ego-nms"],
    ),
    (
        "      selections: bank/selections\n",
        "",
        &[
            "port `selections`: expected a wire to this required input, found none; wire it under `inputs`: what a test needs",
        ],
    ),
    (
        "      selections:",
        "      selection:",
        &[
            "port `selection`: expected an input of `fusion-boxes`: ego, selections, found `selection` (did you mean `selections`?)",
            "required",
        ],
    ),
    (
        "outputs: [to_ego, report]",
        "outputs: [to_ego, report, to_egos]",
        &["port `to_egos`: expected an output of `link`"],
    ),
    (
        "args: node results",
        "args: node results\n    health_check_timeout: 2.0",
        &["kills a healthy sink"],
    ),
    (
        "args: node results",
        "args: node results\n    restart_policy: always",
        &["no `restart_policy`, found `always`"],
    ),
    // Lanes.
    (
        "player/ego_recorded",
        "player/recorded",
        &[
            "node `ego-detect`: expected inputs of one lane, found `clouds` takes the ego's data, from `player/ego_clouds`; `recorded` takes the others' data",
        ],
    ),
    (
        "decoder/data",
        "detect/proposals",
        &[
            "node `bank`, port `others`: expected the others' data, through a link, found the others' data, from `detect/proposals`; what the others send must cross a link",
        ],
    ),
    (
        "data: detect/proposals",
        "data: ego-nms/boxes",
        &["node `link`, port `others`: expected the others' data, found the ego's data"],
    ),
    (
        "player/ego_poses",
        "player/poses",
        &["node `link`, port `ego_state`: expected the ego's data"],
    ),
    (
        "ego: ego-nms/boxes\n",
        "ego: decoder/data\n",
        &[
            "node `bank`, port `ego`: expected the ego's data",
            "node `fusion`, port `ego`: expected `decoder/data`, which asks `bank`",
        ],
    ),
    (
        "ego-nms/boxes # fusion",
        "ego-detect/proposals",
        &[
            "node `fusion`, port `ego`: expected `ego-nms/boxes`, which asks `bank` for the selections, found `ego-detect/proposals`",
        ],
    ),
    (
        "fusion/boxes # evaluator",
        "detect/proposals",
        &[
            "node `evaluator`, port `boxes`: expected the ego's data, found the others' data",
            "node `results`, port `boxes`: expected `detect/proposals`",
        ],
    ),
    (
        "fusion/boxes # results",
        "ego-nms/boxes",
        &["node `results`, port `boxes`: expected `fusion/boxes`, as `evaluator` takes it, found `ego-nms/boxes`"],
    ),
];

#[test]
fn finds_what_is_wrong_and_says_how_to_mend_it() {
    for (from, to, expected) in CASES {
        assert_found(&graph(&changed(GRAPH, from, to)), expected);
    }
}

/// Nodes beside the sound graph, and all that is found then.
#[test]
fn other_programs_are_noted_and_plug_ins_asked() {
    let asked = |more: &str, answer: Answer| {
        let graph = Graph::parse(&format!("{GRAPH}{more}"), Path::new("/graphs/g.yml")).unwrap();
        let mut paths = Vec::new();
        let found = validate_asking(&graph.expand().unwrap(), &REGISTRY, &mut |node| {
            paths.push(node.program().unwrap().to_string());
            answer.clone()
        });
        (found.iter().map(Finding::to_string).collect::<Vec<_>>(), paths)
    };
    let viewer = "  - { id: viewer, path: viewer.py, inputs: { boxes: fusion/boxes, tick: dora/timer/millis/100 } }\n";
    let (found, paths) = asked(viewer, None);
    assert!(paths.is_empty(), "only plug-ins are asked");
    assert_eq!(found.len(), 1, "{found:?}");
    assert!(
        found[0].starts_with("note: node `viewer`: expected a stage of realo, found the program viewer.py"),
        "{found:?}"
    );

    let plug_in =
        "  - { id: mine, path: bin/realo, args: program bin/mine x=1, inputs: { proposals: fusion/boxes } }\n";
    let (found, paths) = asked(plug_in, None);
    assert_eq!(paths, ["bin/mine"]);
    assert_eq!(found.len(), 1, "{found:?}");
    assert!(found[0].starts_with("note: node `mine`") && found[0].contains("without starting it"));
    let (found, _) = asked(plug_in, Some(Err("node `mine`: it said nothing".into())));
    assert_eq!(found.len(), 1, "{found:?}");
    assert!(
        found[0].starts_with("error: node `mine`: expected a program that hosts an operator, found it said nothing"),
        "{found:?}"
    );
    let nms = REGISTRY.find("operator", "nms").unwrap();
    assert_eq!(asked(plug_in, Some(Ok(nms))), (vec![], vec!["bin/mine".to_string()]));
    let wrong = plug_in.replace("proposals: fusion", "proposal: fusion");
    let (found, _) = asked(&wrong, Some(Ok(nms)));
    assert!(
        found
            .iter()
            .any(|line| line.contains("found `proposal` (did you mean `proposals`?)")),
        "{found:?}"
    );
}

#[test]
fn ports_that_differ_from_what_a_program_declares_are_named() {
    let text = "nodes: [{ id: a, path: bin/realo, args: program p, inputs: { proposal: b/o }, outputs: [boxes], \
                output_types: { boxes: realo/v1/Boxes } }]";
    let graph = Graph::parse(text, Path::new("/g.yml")).unwrap().expand().unwrap();
    let found = misdeclared(&graph.nodes[0], REGISTRY.find("operator", "nms").unwrap());
    let ports: Vec<Option<&str>> = found.iter().map(|finding| finding.port.as_deref()).collect();
    assert_eq!(ports, [Some("proposal"), Some("proposals")], "{found:?}");
}

#[test]
fn one_results_node_and_no_more() {
    let (head, results) = GRAPH.split_at(GRAPH.find("  - id: results").unwrap());
    let found = findings(head);
    assert_eq!(found.len(), 1, "{found:?}");
    let said = found[0].to_string();
    assert!(
        said.starts_with("warning: graph: expected a `results` node, found none"),
        "{said}"
    );
    let twice = format!("{GRAPH}{}", results.replace("id: results", "id: again"));
    let found = findings(&twice);
    assert_eq!(found.len(), 1, "{found:?}");
    let said = found[0].to_string();
    assert!(
        said.starts_with("error: graph: expected one `results` node, found 2"),
        "{said}"
    );
}
