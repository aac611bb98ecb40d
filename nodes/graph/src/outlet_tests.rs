//! Outputs of a host by their stage: `STAGE.OUTPUT`.

use super::check::tests::REGISTRY;
use super::dora_tests::{compare, dora};
use super::host_tests::{GRAPH, folder, load};
use super::{FlatGraph, Graph, hosted, validate};

/// The graph whose fusion takes an output of the ego's `sense.sync`, of this type by the ego's own words.
fn taking(output: &str, of_type: &str) -> String {
    let declared =
        format!("outputs: [boxes, {output}]\n    output_types: {{ boxes: realo/v1/Boxes, {output}: {of_type} }}");
    GRAPH
        .replacen(
            "outputs: [boxes]\n    output_types: { boxes: realo/v1/Boxes }",
            &declared,
            1,
        )
        .replace("ego: ego/boxes", &format!("ego: ego/{output}"))
        .replace(" nms.threshold=0.3", "")
}

const PROPOSALS: &str = "sense.sync.proposals";

#[test]
fn a_process_sends_an_output_of_a_stage_that_its_module_does_not_have() {
    let folder = folder(&[("g.yml", &taking(PROPOSALS, "realo/v1/Boxes"))]);
    let graph = load(folder.path()).unwrap();
    let bank = graph.node("fusion.bank").unwrap();
    assert_eq!(bank.inputs["ego"].source.to_string(), "ego.sense.sync/proposals");
    assert!(graph.node("ego.nms").is_none(), "nobody takes its boxes");
    let ego = &graph.hosts[0];
    assert_eq!(ego.outlets[PROPOSALS], ("ego.sense.sync".into(), "proposals".into()));
    assert_eq!(validate(&graph, &REGISTRY), []);
    let again = Graph::parse(&graph.to_yaml().unwrap(), &graph.file)
        .unwrap()
        .expand()
        .unwrap();
    assert_eq!(again.nodes, graph.nodes);
    if let Some(dora) = dora() {
        compare(&dora, &folder.path().join("g.yml"));
    }
    let inputs = ["clouds", "recorded"].map(String::from);
    let alone = hosted(
        "ego",
        &ego.args[1],
        &[],
        Some((&inputs, &[PROPOSALS.into()])),
        folder.path(),
    )
    .unwrap();
    assert_eq!(alone.hosts[0].outlets[PROPOSALS], ego.outlets[PROPOSALS]);
}

#[test]
fn two_stages_with_an_output_of_one_name_both_send_it() {
    let twice = "module: { name: twice, inputs: [ego, packets], outputs: [] }\nnodes:\n  \
                 - { id: one, module: fuse.yml, inputs: { ego: _mod/ego, packets: _mod/packets } }\n  \
                 - { id: two, module: fuse.yml, inputs: { ego: one/boxes, packets: _mod/packets } }\n";
    let graph = GRAPH
        .replace("modules/fuse.yml", "modules/twice.yml")
        .replace("boxes: fusion/boxes", "boxes: fusion/two.fusion.boxes")
        .replace(
            "{ ego: ego/boxes, packets: v2x/to_ego }\n    outputs: [boxes]\n    output_types: { boxes: realo/v1/Boxes }",
            "{ ego: ego/boxes, packets: v2x/to_ego }\n    outputs: [two.fusion.boxes]\n    output_types: { two.fusion.boxes: \
             realo/v1/Boxes }",
        );
    let folder = folder(&[("g.yml", &graph), ("modules/twice.yml", twice)]);
    let graph: FlatGraph = load(folder.path()).unwrap();
    let source = |node: &str, port: &str| graph.node(node).unwrap().inputs[port].source.to_string();
    assert_eq!(source("score.results", "boxes"), "fusion.two.fusion/boxes");
    assert_eq!(source("fusion.two.bank", "ego"), "fusion.one.fusion/boxes");
    assert_eq!(validate(&graph, &REGISTRY), []);
}

#[test]
fn a_wrong_name_lists_what_there_is() {
    let refused = |output: &str| {
        let folder = folder(&[("g.yml", &taking(output, "realo/v1/Boxes"))]);
        load(folder.path()).unwrap_err()
    };
    let error = refused("sense.sync.proposal");
    let expected = "module node `ego`: its module has no output `sense.sync.proposal` (did you mean `sense.sync.proposals`?); it \
                    has: boxes, packets; its stages, as STAGE.OUTPUT: nms.boxes, receiver.data, sender.packets, sense.sync.proposals";
    assert!(error.contains(expected), "{error}");
    let error = refused("sense.proposals");
    assert!(error.contains("(did you mean `sense.sync.proposals`?)"), "{error}");
    // Nobody feeds the ego's receiver.
    let error = refused("receiver.data");
    assert!(
        error.contains("nobody feeds the stage `ego.receiver` behind it"),
        "{error}"
    );
}

#[test]
fn its_type_is_that_of_the_stage() {
    let folder = folder(&[("g.yml", &taking(PROPOSALS, "realo/v1/PointCloud"))]);
    let findings = validate(&load(folder.path()).unwrap(), &REGISTRY);
    let found: Vec<String> = findings.iter().map(ToString::to_string).collect();
    assert!(
        found.iter().any(|finding| finding.contains(PROPOSALS)
            && finding.contains("expected `realo/v1/Boxes`, as `ego.sense.sync` sends it")),
        "{found:?}"
    );
}
