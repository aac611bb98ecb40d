//! Which node is behind a wire, for checks that follow wires through stages.

use realo_operator::{Port, Registration, Side};

use super::{FlatGraph, FlatNode};

/// The nodes of a graph with the stages that they host.
pub(super) struct Wires<'a> {
    pub graph: &'a FlatGraph,
    /// In the order of the graph's nodes.
    pub stages: &'a [Option<&'static Registration>],
}

impl<'a> Wires<'a> {
    /// A node and its stage; `None` where no stage is known.
    pub fn at(&self, id: &str) -> Option<(&'a FlatNode, &'static Registration)> {
        let at = self.graph.nodes.iter().position(|node| node.id == id)?;
        Some((&self.graph.nodes[at], self.stages[at]?))
    }
}

/// Whether what comes on an input leaves by an output: a link has a way there and a way back.
pub(super) fn carries(input: &Port, stage: &Registration, output: &str) -> bool {
    match (input.side, stage.output(output).and_then(|(_, port)| port.side)) {
        (Some(from), Some(to)) => matches!(
            (from, to),
            (Side::Others, Side::OthersReceived) | (Side::Ego, Side::EgoReceived)
        ),
        _ => true,
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use realo_operator::Registry;

    use super::*;
    use crate::Graph;
    use crate::check::maps::tests::{MAPS, PACKETS, port, stage};
    use crate::check::unfit_maps;

    static REGISTRY: Registry = Registry(&[
        stage("encoder", &[], &[port("made", MAPS)]),
        stage("sender", &[port("messages", MAPS)], &[port("packets", PACKETS)]),
        stage("receiver", &[port("packets", PACKETS)], &[port("messages", MAPS)]),
        stage(
            "link",
            &[
                port("from_others", PACKETS).of(Side::Others),
                port("from_ego", PACKETS).of(Side::Ego),
            ],
            &[
                port("to_ego", PACKETS).of(Side::OthersReceived),
                port("to_others", PACKETS).of(Side::EgoReceived),
            ],
        ),
        stage("head", &[port("map", MAPS)], &[]),
    ]);

    /// What is found where the others send maps of 64 channels over a link and the ego maps of 8, and heads take so many.
    fn found(at_ego: u32, at_others: u32) -> Vec<String> {
        let node = |id: &str, name: &str, inputs: &str| {
            format!(
                "  - {{ id: {id}, path: bin/realo, args: operator {name}, inputs: {{ {inputs} }}, outputs: [made, packets, messages, to_ego, \
                 to_others] }}\n"
            )
        };
        let text = [
            "nodes:\n".to_string(),
            node("others", "encoder out=64", ""),
            node("ego", "encoder out=8", ""),
            node("others_send", "sender", "messages: others/made"),
            node("ego_send", "sender", "messages: ego/made"),
            node(
                "link",
                "link",
                "from_others: others_send/packets, from_ego: ego_send/packets",
            ),
            node("ego_take", "receiver", "packets: link/to_ego"),
            node("others_take", "receiver", "packets: link/to_others"),
            node("ego_head", &format!("head in={at_ego}"), "map: ego_take/messages"),
            node(
                "others_head",
                &format!("head in={at_others}"),
                "map: others_take/messages",
            ),
        ];
        let graph = Graph::parse(&text.concat(), Path::new("/nowhere/g.yml"))
            .unwrap()
            .expand()
            .unwrap();
        let stages: Vec<_> = graph.nodes.iter().map(|node| node.registration(&REGISTRY)).collect();
        unfit_maps(&graph, &stages).iter().map(ToString::to_string).collect()
    }

    #[test]
    fn maps_of_two_sizes_on_the_two_ways_of_a_link_are_not_mixed_up() {
        let fine = found(64, 8);
        assert!(fine.is_empty(), "{fine:?}");
        // Each head is compared with what comes its way, and with nothing else.
        let crossed = found(8, 64);
        assert_eq!(crossed.len(), 2, "{crossed:?}");
        for (line, head, expected, maker, made) in [
            (&crossed[0], "ego_head", 8, "others", 64),
            (&crossed[1], "others_head", 64, "ego", 8),
        ] {
            let words = format!(
                "node `{head}`, port `map`: expected maps of {expected} channels (in.onnx), found {made} channels from `{maker}`"
            );
            assert!(line.contains(&words), "{line}");
        }
    }

    #[test]
    fn a_stage_without_sides_carries_every_input_to_every_output() {
        let link = REGISTRY.0.iter().find(|stage| stage.name == "link").unwrap();
        let ways = |input: usize| ["to_ego", "to_others"].map(|output| carries(&link.inputs[input], link, output));
        assert_eq!([ways(0), ways(1)], [[true, false], [false, true]]);
        let sender = REGISTRY.0.iter().find(|stage| stage.name == "sender").unwrap();
        assert!(carries(&sender.inputs[0], sender, "packets"));
    }
}
