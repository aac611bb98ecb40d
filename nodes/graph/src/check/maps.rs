//! Sizes of BEV maps: an input whose network takes maps of one size must not get others.

use std::collections::BTreeSet;

use realo_operator::{Class, KnownMap, Port, Registration, Role};
use realo_schemas::PayloadType;

use super::wires::{Wires, carries};
use super::{Findings, FlatGraph, FlatNode, Severity};

/// What carries maps as they are.
const CARRIERS: [PayloadType; 2] = [PayloadType::Packet, PayloadType::Selection];

pub(super) fn check(graph: &FlatGraph, stages: &[Option<&'static Registration>], findings: &mut Findings) {
    let wires = Wires { graph, stages };
    for (node, stage) in graph.nodes.iter().zip(stages) {
        let Some(stage) = stage else { continue };
        for port in stage.inputs {
            let Some(wire) = node.inputs.get(port.name).and_then(|input| input.output()) else {
                continue;
            };
            let Some(taken) = known(node, stage, port) else {
                continue;
            };
            let mut made = Vec::new();
            wires.makers(wire, &mut BTreeSet::new(), &mut made);
            for (maker, map) in made {
                if let Some((dimension, expected, found)) = taken.differs(&map) {
                    let expected = format!("maps of {expected} {dimension} ({})", taken.by);
                    let found = format!("{found} {dimension} from `{}` ({})", maker.id, map.by);
                    let mend = "take files that were made for each other";
                    findings.port(Severity::Error, node, port.name, expected, found, mend);
                }
            }
        }
    }
}

/// What is known of the maps of a port.
fn known(node: &FlatNode, stage: &Registration, port: &Port) -> Option<KnownMap> {
    let of_program = || port.map.cloned();
    let of_settings = || {
        let maps = (stage.maps)(node.settings());
        maps.into_iter()
            .find_map(|(name, map)| (name == port.name).then_some(map))
    };
    of_program().or_else(of_settings)
}

impl<'a> Wires<'a> {
    /// Finds who made the maps that come on an output, through stages that carry them as they are; those of others are not known.
    fn makers(
        &self,
        (id, output): (&'a str, &'a str),
        seen: &mut BTreeSet<(&'a str, &'a str)>,
        made: &mut Vec<(&'a FlatNode, KnownMap)>,
    ) {
        if !seen.insert((id, output)) {
            return;
        }
        let Some((node, stage)) = self.at(id) else { return };
        let Some((_, port)) = stage.output(output) else { return };
        if let Some(map) = known(node, stage, port) {
            made.push((node, map));
            return;
        }
        if !is_carrier(stage) {
            return;
        }
        for input in stage
            .inputs
            .iter()
            .filter(|input| !input.feedback && input.class != Class::Query && may_hold_maps(input))
            .filter(|input| carries(input, stage, output))
        {
            if let Some(wire) = node.inputs.get(input.name).and_then(|input| input.output()) {
                self.makers(wire, seen, made);
            }
        }
    }
}

/// Whether a stage packs maps, carries packets, unpacks or chooses: it changes no size of a map.
fn is_carrier(stage: &Registration) -> bool {
    let mut ports = stage.inputs.iter().chain(stage.outputs);
    let crosses = ports.any(|port| port.types.iter().any(|kind| *kind == CARRIERS[0]));
    let chooses = stage.outputs.iter().any(|port| port.types.contains(&CARRIERS[1]));
    stage.role == Role::Operator && (crosses || chooses)
}

fn may_hold_maps(port: &Port) -> bool {
    port.types.contains(&PayloadType::FeatureMap) || port.types.iter().any(|kind| CARRIERS.contains(kind))
}

#[cfg(test)]
pub(super) mod tests {
    use std::path::Path;

    use realo_operator::Registry;

    use super::*;
    use crate::Graph;
    use crate::check::unfit_maps;

    pub const MAPS: &[PayloadType] = &[PayloadType::FeatureMap];
    pub const PACKETS: &[PayloadType] = &[PayloadType::Packet];
    const SELECTIONS: &[PayloadType] = &[PayloadType::Selection];

    pub const fn port(name: &'static str, types: &'static [PayloadType]) -> Port {
        Port::new(name, types, "")
    }

    /// `in=64` and `out=32` say channels, `rows=100` the rows of both.
    fn maps(settings: &[String]) -> Vec<(&'static str, KnownMap)> {
        let number = |key: &str| {
            let found = settings
                .iter()
                .find_map(|setting| setting.strip_prefix(key)?.strip_prefix('='));
            found.and_then(|number| number.parse().ok())
        };
        let map = |port, key: &str| {
            let size = [number("rows"), None, number(key)];
            let by = format!("{key}.onnx");
            (port, KnownMap { size, by })
        };
        vec![
            map("ego", "in"),
            map("selections", "in"),
            map("map", "in"),
            map("made", "out"),
        ]
    }

    /// A stage that takes and makes maps as its arguments say.
    pub const fn stage(name: &'static str, inputs: &'static [Port], outputs: &'static [Port]) -> Registration {
        Registration {
            name,
            about: "",
            role: Role::Operator,
            inputs,
            outputs,
            settings: &[],
            counters: &[],
            defaults: Default::default,
            check: |_| Ok(()),
            examine: |_| Ok(()),
            maps,
            build: |_| Err("".into()),
        }
    }

    static REGISTRY: Registry = Registry(&[
        stage("encoder", &[], &[port("made", MAPS)]),
        stage("sender", &[port("messages", MAPS)], &[port("packets", PACKETS)]),
        stage("receiver", &[port("packets", PACKETS)], &[port("messages", MAPS)]),
        stage("bank", &[port("others", MAPS)], &[port("chosen", SELECTIONS)]),
        stage("blur", &[port("messages", MAPS)], &[port("blurred", MAPS)]),
        stage(
            "fusion",
            &[port("ego", MAPS), port("selections", SELECTIONS)],
            &[port("made", MAPS)],
        ),
        stage("head", &[port("map", MAPS)], &[]),
    ]);

    /// What is found in a graph of these settings.
    fn found(own: &str, others: &str, fusion: &str, head: &str, after: &str) -> Vec<String> {
        let node = |id: &str, name: &str, settings: &str, inputs: &str| {
            format!(
                "  - {{ id: {id}, path: bin/realo, args: operator {name} {settings}, inputs: {{ {inputs} }}, outputs: [made, packets, messages, chosen, blurred] }}\n"
            )
        };
        let text = [
            "nodes:\n".to_string(),
            node("own", "encoder", own, ""),
            node("others", "encoder", others, ""),
            node("send", "sender", "", "messages: others/made"),
            node("take", "receiver", "", "packets: send/packets"),
            node("bank", "bank", "", "others: take/messages"),
            node("fuse", "fusion", fusion, "ego: own/made, selections: bank/chosen"),
            node("blur", "blur", "", "messages: fuse/made"),
            node("head", "head", head, &format!("map: {after}")),
        ];
        let graph = Graph::parse(&text.concat(), Path::new("/nowhere/g.yml"))
            .unwrap()
            .expand()
            .unwrap();
        let stages: Vec<_> = graph.nodes.iter().map(|node| node.registration(&REGISTRY)).collect();
        unfit_maps(&graph, &stages).iter().map(ToString::to_string).collect()
    }

    #[test]
    fn maps_of_another_size_are_found_through_what_carries_them() {
        let fine = found("out=64", "out=64", "in=64 out=32", "in=32", "fuse/made");
        assert!(fine.is_empty(), "{fine:?}");
        let all = found(
            "out=64 rows=100",
            "out=8",
            "in=32 out=32 rows=100",
            "in=16",
            "fuse/made",
        );
        let expected = [
            "error: node `fuse`, port `ego`: expected maps of 32 channels (in.onnx), found 64 channels from `own` (out.onnx); take files that \
             were made for each other",
            "error: node `fuse`, port `selections`: expected maps of 32 channels (in.onnx), found 8 channels from `others` (out.onnx); take \
             files that were made for each other",
            "error: node `head`, port `map`: expected maps of 16 channels (in.onnx), found 32 channels from `fuse` (out.onnx); take files that \
             were made for each other",
        ];
        assert_eq!(all, expected);
        let rows = found("rows=50", "", "rows=100", "", "fuse/made");
        assert!(
            rows.len() == 1 && rows[0].contains("expected maps of 100 rows (in.onnx), found 50 rows"),
            "{rows:?}"
        );
    }

    #[test]
    fn what_any_number_may_be_or_another_stage_makes_is_not_known() {
        let dynamic = found("", "out=64", "in=64", "in=32", "fuse/made");
        assert!(dynamic.is_empty(), "{dynamic:?}");
        let behind_another = found("out=64", "out=64", "in=64 out=64", "in=32", "blur/blurred");
        assert!(behind_another.is_empty(), "{behind_another:?}");
    }
}
