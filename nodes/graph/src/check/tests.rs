use std::path::Path;

use realo_schemas::{Message, Nanos, PayloadType};

use super::*;
use crate::Graph;
use realo_operator::{Argument, Books, Describe, Error, Operator, Outputs, Port, PortId, Sink, Source};

#[derive(Default, serde::Serialize, serde::Deserialize)]
struct Settings {
    threshold: f64,
}

const CLOUDS: &[PayloadType] = &[PayloadType::PointCloud];
const BOXES: &[PayloadType] = &[PayloadType::Boxes];
const STATES: &[PayloadType] = &[PayloadType::EgoState];
const PACKETS: &[PayloadType] = &[PayloadType::Packet];
const REPORTS: &[PayloadType] = &[PayloadType::Report];
const TRUTH: &[PayloadType] = &[PayloadType::GroundTruth];
const CONTENT: &[PayloadType] = &[PayloadType::PointCloud, PayloadType::Boxes, PayloadType::EgoState];

const fn port(name: &'static str, types: &'static [PayloadType]) -> Port {
    Port::new(name, types, "what a test needs")
}

macro_rules! stage {
    ($kind:ident, $type:ident, $name:literal, [$($inputs:expr),*], [$($outputs:expr),*]) => {
        struct $type;
        impl Describe for $type {
            type Config = Settings;
            const NAME: &'static str = $name;
            const ABOUT: &'static str = "a stage of a test";
            const ARGUMENTS: &'static [Argument] = &[Argument { name: "threshold", about: "a number" }];
            const INPUTS: &'static [Port] = &[$($inputs),*];
            const OUTPUTS: &'static [Port] = &[$($outputs),*];
        }
        stage!($kind, $type);
    };
    (operator, $type:ident) => {
        impl Operator for $type {
            fn new(_: Settings) -> Result<Self, Error> {
                Ok($type)
            }
            fn on_input(&mut self, _: PortId, _: Message, _: &mut Outputs) -> Result<(), Error> {
                Ok(())
            }
        }
    };
    (source, $type:ident) => {
        impl Source for $type {
            fn new(_: Settings) -> Result<Self, Error> {
                Ok($type)
            }
            fn next(&mut self) -> Result<Option<(Nanos, PortId, Message)>, Error> {
                Ok(None)
            }
        }
    };
    (sink, $type:ident) => {
        impl Sink for $type {
            fn new(_: Settings) -> Result<Self, Error> {
                Ok($type)
            }
            fn accept(&mut self, _: PortId, _: Message) -> Result<(), Error> {
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
        port("ego_clouds", CLOUDS),
        port("ego_recorded", BOXES),
        port("clouds", CLOUDS),
        port("recorded", BOXES),
        port("poses", STATES),
        port("ego_poses", STATES),
        port("truth", TRUTH)
    ]
);
stage!(
    operator,
    Detect,
    "recorded-detections",
    [port("clouds", CLOUDS), port("recorded", BOXES)],
    [port("boxes", BOXES)]
);
stage!(operator, Nms, "nms", [port("boxes", BOXES)], [port("boxes", BOXES)]);
stage!(
    operator,
    Encoder,
    "transmission-encoder",
    [port("data", CONTENT), port("state", STATES).optional()],
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
        port("ego", PACKETS).optional(),
        port("others", PACKETS),
        port("ego_state", STATES),
        port("states", STATES)
    ],
    [
        port("to_ego", PACKETS),
        port("to_others", PACKETS),
        port("report", REPORTS)
    ]
);
stage!(
    operator,
    Bank,
    "feature-bank",
    [port("ego", CONTENT).query(), port("others", CONTENT)],
    [port("selections", &[PayloadType::Selection]), port("report", REPORTS)]
);
stage!(
    operator,
    Fusion,
    "fusion-boxes",
    [port("ego", BOXES), port("selections", &[PayloadType::Selection])],
    [port("boxes", BOXES), port("report", REPORTS)]
);
stage!(
    operator,
    Evaluator,
    "evaluator",
    [port("truth", TRUTH), port("boxes", BOXES)],
    [port("report", REPORTS)]
);
stage!(
    sink,
    Results,
    "results",
    [port("boxes", BOXES), port("truth", TRUTH), port("evaluation", REPORTS)],
    []
);
stage!(
    sink,
    Recorder,
    "recorder",
    [
        port("boxes", BOXES),
        port("ego_boxes", BOXES).optional(),
        port("other_boxes", BOXES).optional(),
        port("ego_state", STATES).optional(),
        port("states", STATES).optional(),
        port("truth", TRUTH).optional(),
        port("ego_clouds", CLOUDS).optional(),
        port("clouds", CLOUDS).optional()
    ],
    []
);

pub(crate) const REGISTRY: Registry = Registry(&[
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
      ego_poses: realo/v1/EgoState
      poses: realo/v1/EgoState
      truth: realo/v1/GroundTruth
    shared_memory_pool_size: 128MB
  - id: ego-detect
    path: bin/realo
    args: operator recorded-detections
    inputs:
      clouds: { source: player/ego_clouds, queue_size: 200 }
      recorded: { source: player/ego_recorded, queue_size: 200 }
    input_types: { clouds: realo/v1/PointCloud, recorded: realo/v1/Boxes }
    outputs: [boxes]
    output_types: { boxes: realo/v1/Boxes }
  - id: ego-nms
    path: bin/realo
    args: operator nms threshold=0.15
    inputs: { boxes: { source: ego-detect/boxes, queue_size: 200 } }
    input_types: { boxes: realo/v1/Boxes }
    outputs: [boxes]
    output_types: { boxes: realo/v1/Boxes }
  - id: detect
    path: bin/realo
    args: operator recorded-detections
    inputs:
      clouds: { source: player/clouds, queue_size: 200 }
      recorded: { source: player/recorded, queue_size: 200 }
    input_types: { clouds: realo/v1/PointCloud, recorded: realo/v1/Boxes }
    outputs: [boxes]
    output_types: { boxes: realo/v1/Boxes }
  - id: encoder
    path: bin/realo
    args: operator transmission-encoder
    inputs: { data: { source: detect/boxes, queue_size: 200 } }
    input_types: { data: realo/v1/Boxes }
    outputs: [packets]
    output_types: { packets: realo/v1/Packet }
  - id: link
    path: bin/realo
    args: operator link
    inputs:
      others: { source: encoder/packets, queue_size: 200 }
      ego_state: { source: player/ego_poses, queue_size: 200 }
      states: { source: player/poses, queue_size: 200 }
    input_types: { others: realo/v1/Packet, ego_state: realo/v1/EgoState, states: realo/v1/EgoState }
    outputs: [to_ego, report]
    output_types: { to_ego: realo/v1/Packet, report: realo/v1/Report }
  - id: decoder
    path: bin/realo
    args: operator transmission-decoder
    inputs: { packets: { source: link/to_ego, queue_size: 200 } }
    input_types: { packets: realo/v1/Packet }
    outputs: [data]
    output_types: { data: realo/v1/Boxes }
  - id: bank
    path: bin/realo
    args: operator feature-bank
    inputs:
      ego: { source: ego-nms/boxes, queue_size: 200 }
      others: { source: decoder/data, queue_size: 200 }
    input_types: { ego: realo/v1/Boxes, others: realo/v1/Boxes }
    outputs: [selections, report]
    output_types: { selections: realo/v1/Selection, report: realo/v1/Report }
  - id: fusion
    path: bin/realo
    args: operator fusion-boxes
    inputs:
      ego: { source: ego-nms/boxes, queue_size: 200 } # fusion
      selections: { source: bank/selections, queue_size: 200 }
    input_types: { ego: realo/v1/Boxes, selections: realo/v1/Selection }
    outputs: [boxes, report]
    output_types: { boxes: realo/v1/Boxes, report: realo/v1/Report }
  - id: evaluator
    path: bin/realo
    args: operator evaluator
    inputs:
      truth: { source: player/truth, queue_size: 200 }
      boxes: { source: fusion/boxes, queue_size: 200 } # evaluator
    input_types: { truth: realo/v1/GroundTruth, boxes: realo/v1/Boxes }
    outputs: [report]
    output_types: { report: realo/v1/Report }
  - id: results
    path: bin/realo
    args: node results
    inputs:
      boxes: { source: fusion/boxes, queue_size: 200 } # results
      truth: { source: player/truth, queue_size: 200 }
      evaluation: { source: evaluator/report, queue_size: 200 }
    input_types: { boxes: realo/v1/Boxes, truth: realo/v1/GroundTruth, evaluation: realo/v1/Report }
"#;

fn findings(text: &str) -> Vec<Finding> {
    let graph = Graph::parse(text, Path::new("/graphs/g.yml")).and_then(|graph| graph.expand());
    validate(&graph.unwrap_or_else(|error| panic!("{error}")), &REGISTRY)
}

#[test]
fn finds_nothing_in_a_sound_graph() {
    assert_eq!(findings(GRAPH), []);
    assert_eq!(check_tables(&REGISTRY), Vec::<String>::new());
}

/// What is written in place of what, and what is found then.
const CASES: &[(&str, &str, &[&str])] = &[
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
            "node `ego-nms`: expected arguments of `nms`",
            "did you mean `threshold`?",
        ],
    ),
    ("threshold=0.15", "threshold=$PARAM_T", &["`threshold=$PARAM_T`"]),
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
            "port `others`: expected `realo/v1/Boxes`, found `realo/v1/Box`",
        ],
    ),
    (
        "output_types: { data: realo/v1/Boxes }",
        "output_types: { data: realo/v1/Packet }",
        &[
            "port `data`: expected `realo/v1/PointCloud` or `realo/v1/Boxes` or `realo/v1/EgoState`, found `realo/v1/Packet`",
            "port `others`: expected `realo/v1/Boxes`",
        ],
    ),
    (
        "ego-detect/boxes, queue_size: 200",
        "ego-detect/boxes, queue_size: 20",
        &["warning: node `ego-nms`, port `boxes`: expected `queue_size` ≥ 200, found 20"],
    ),
    (
        "{ source: ego-detect/boxes, queue_size: 200 }",
        "ego-detect/boxes",
        &["found none, which means 10; write `{ source: ego-detect/boxes, queue_size: 200 }`"],
    ),
    (
        "ego-detect/boxes, queue_size: 200",
        "ego-detect/boxes, queue_size: 200, queue_policy: backpressure",
        &["found `backpressure`"],
    ),
    (
        "ego-detect/boxes",
        "ego-detct/boxes",
        &["port `boxes`", "no node `ego-detct` (did you mean `ego-detect`?)"],
    ),
    (
        "ego-detect/boxes",
        "ego-detect/box",
        &["found `ego-detect/box` (did you mean `boxes`?)"],
    ),
    (
        "ego-detect/boxes",
        "ego-nms/boxes",
        &["error: graph: expected no cycle, found", "ego-nms > ego-nms"],
    ),
    (
        "      selections: { source: bank/selections, queue_size: 200 }\n",
        "",
        &[
            "port `selections`: expected a wire to this required input",
            "only its entry in `input_types`",
        ],
    ),
    (
        "      selections: {",
        "      selection: {",
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
        "    shared_memory_pool_size: 128MB\n",
        "",
        &[
            "warning: node `player`: expected `shared_memory_pool_size: 128MB`",
            "clouds",
        ],
    ),
    (
        "shared_memory_pool_size: 128MB",
        "shared_memory_pool_size: 8 mb",
        &["node `player`", "8 mb"],
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
        "detect/boxes",
        &[
            "node `bank`, port `others`: expected the others' data, through a link, found the others' data, from `detect/boxes`; what the others send must cross a link",
        ],
    ),
    (
        "detect/boxes, queue_size: 200 } }\n    input_types: { data",
        "ego-nms/boxes, queue_size: 200 } }\n    input_types: { data",
        &["node `link`, port `others`: expected the others' data, found the ego's data"],
    ),
    (
        "player/ego_poses",
        "player/poses",
        &["node `link`, port `ego_state`: expected the ego's data"],
    ),
    (
        "ego: { source: ego-nms/boxes, queue_size: 200 }\n",
        "ego: { source: decoder/data, queue_size: 200 }\n",
        &[
            "node `bank`, port `ego`: expected the ego's data",
            "node `fusion`, port `ego`: expected `decoder/data`, which asks `bank`",
        ],
    ),
    (
        "ego-nms/boxes, queue_size: 200 } # fusion",
        "ego-detect/boxes, queue_size: 200 }",
        &[
            "node `fusion`, port `ego`: expected `ego-nms/boxes`, which asks `bank` for the selections, found `ego-detect/boxes`",
        ],
    ),
    (
        "fusion/boxes, queue_size: 200 } # evaluator",
        "detect/boxes, queue_size: 200 }",
        &[
            "node `evaluator`, port `boxes`: expected the ego's data, found the others' data",
            "node `results`, port `boxes`: expected `detect/boxes`",
        ],
    ),
    (
        "fusion/boxes, queue_size: 200 } # results",
        "ego-nms/boxes, queue_size: 200 }",
        &["node `results`, port `boxes`: expected `fusion/boxes`, as `evaluator` takes it, found `ego-nms/boxes`"],
    ),
];

#[test]
fn finds_what_is_wrong_and_says_how_to_mend_it() {
    for (from, to, expected) in CASES {
        let text = GRAPH.replacen(from, to, 1);
        assert_ne!(text, GRAPH, "{from}");
        let found: Vec<String> = findings(&text).iter().map(Finding::to_string).collect();
        for part in *expected {
            assert!(
                found.iter().any(|finding| finding.contains(part)),
                "{to}: no `{part}` in\n{}",
                found.join("\n")
            );
        }
    }
}

#[test]
fn a_foreign_node_is_noted_and_its_ports_must_be_typed() {
    let foreign = r#"
  - id: viewer
    path: viewer.py
    inputs: { boxes: { source: fusion/boxes, queue_size: 200 }, tick: dora/timer/millis/100 }
    input_types: { boxes: realo/v1/Boxes }
"#;
    let found = findings(&format!("{GRAPH}{foreign}"));
    assert_eq!(
        found.iter().map(|finding| finding.severity).collect::<Vec<_>>(),
        [Severity::Note],
        "{found:?}"
    );
    let untyped = foreign.replace("    input_types: { boxes: realo/v1/Boxes }\n", "");
    let found = findings(&format!("{GRAPH}{untyped}"));
    let ports: Vec<Option<&str>> = found.iter().map(|finding| finding.port.as_deref()).collect();
    assert_eq!(ports, [None, Some("boxes")], "{found:?}");
}

#[test]
fn packets_of_clouds_need_a_pool_too() {
    let clouds = GRAPH
        .replace("source: detect/boxes", "source: player/clouds")
        .replace(
            "input_types: { data: realo/v1/Boxes }",
            "input_types: { data: realo/v1/PointCloud }",
        )
        .replace(
            "output_types: { data: realo/v1/Boxes }",
            "output_types: { data: realo/v1/PointCloud }",
        );
    let pools: Vec<String> = findings(&clouds)
        .into_iter()
        .filter(|finding| finding.expected.contains("shared_memory_pool_size"))
        .map(|finding| finding.node)
        .collect();
    assert_eq!(pools, ["encoder", "link", "decoder", "bank"]);
}
