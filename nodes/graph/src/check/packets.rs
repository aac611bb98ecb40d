//! What crosses a link: whoever unpacks it must take what the others packed.

use std::collections::BTreeSet;

use realo_operator::{Port, Registration, Role};
use realo_schemas::{Kind, PayloadType};

use super::ports::payload_type;
use super::wires::{Wires, carries};
use super::{Findings, FlatGraph, FlatNode, Severity};

/// What is known of the packets on a wire: their kinds, and the stages that pack them.
#[derive(Default)]
struct Packed {
    kinds: BTreeSet<Kind>,
    by: BTreeSet<String>,
}

pub(super) fn check(graph: &FlatGraph, stages: &[Option<&'static Registration>], findings: &mut Findings) {
    let wires = Wires { graph, stages };
    for (node, stage) in graph.nodes.iter().zip(stages) {
        let Some(stage) = stage.filter(|stage| unpacks(stage)) else {
            continue;
        };
        for port in stage.inputs.iter().filter(|port| is_packet(port)) {
            let Some((source, output)) = node.inputs.get(port.name).and_then(|input| input.output()) else {
                continue;
            };
            let mut packed = Packed::default();
            let is_known = wires
                .packers((source, output), &mut BTreeSet::new(), &mut packed)
                .is_some();
            if is_known && !packed.kinds.is_empty() {
                taken(node, port, &packed, findings);
            }
        }
    }
}

/// Whether a stage makes messages of packets, and no packets.
fn unpacks(stage: &Registration) -> bool {
    stage.role == Role::Operator && stage.inputs.iter().any(is_packet) && !stage.outputs.iter().any(is_packet)
}

fn is_packet(port: &Port) -> bool {
    port.types == [PayloadType::Packet]
}

/// The kind of messages of a port, as a graph types it.
fn kind_of(written: Option<&String>) -> Option<Kind> {
    Kind::of(payload_type(written?.split('[').next()?)?)
}

fn taken(node: &FlatNode, port: &Port, packed: &Packed, findings: &mut Findings) {
    let words = |kinds: &BTreeSet<Kind>| kinds.iter().map(|kind| kind.as_str()).collect::<Vec<_>>().join(" and ");
    let by: Vec<String> = packed.by.iter().map(|id| format!("`{id}`")).collect();
    let sent = format!("packets of {}, which {} sends", words(&packed.kinds), by.join(" and "));
    let only = node.settings().iter().find_map(|setting| setting.strip_prefix("kind="));
    let only: Option<Kind> = only.and_then(|kind| kind.parse().ok());
    if let Some(only) = only.filter(|kind| !packed.kinds.contains(kind)) {
        let mend = "it would take none of them: correct its `kind`, or have the others send that";
        let expected = format!("a `kind` that is sent: {sent}");
        return findings.port(Severity::Error, node, port.name, expected, format!("kind={only}"), mend);
    }
    let made: BTreeSet<Kind> = node
        .outputs
        .iter()
        .filter_map(|output| kind_of(node.output_types.get(output)))
        .collect();
    let come = only.map_or(packed.kinds.clone(), |only| [only].into());
    if !made.is_empty() && !come.is_subset(&made) {
        let mend = "the parts of the graph do not fit: have the others send what the fusion takes; where several kinds cross, \
                    `kind` says which of them this decoder takes";
        let expected = format!("packets of {}, as its outputs are typed", words(&made));
        findings.port(Severity::Error, node, port.name, expected, sent, mend);
    }
}

impl<'a> Wires<'a> {
    /// Finds who packs what comes on an output; `None` where that is not known, as behind a radio.
    fn packers(
        &self,
        (id, output): (&'a str, &'a str),
        seen: &mut BTreeSet<(&'a str, &'a str)>,
        packed: &mut Packed,
    ) -> Option<()> {
        if !seen.insert((id, output)) {
            return Some(());
        }
        let (node, stage) = self.at(id).filter(|(_, stage)| stage.role == Role::Operator)?;
        let carried = |port: &&Port| is_packet(port) && carries(port, stage, output);
        let carried: Vec<&Port> = stage.inputs.iter().filter(carried).collect();
        if carried.is_empty() {
            // Packets are made of the first input, and of those that a setting calls for beside it, but for feedback.
            let wired = |port: &&Port| node.inputs.contains_key(port.name);
            let mut wired = stage.inputs.iter().filter(wired);
            let first = wired.next()?;
            let beside = wired.filter(|port| port.needed.is_some() && !port.feedback);
            for port in std::iter::once(first).chain(beside) {
                let (source, output) = node.inputs.get(port.name)?.output()?;
                let kind = kind_of(self.graph.node(source)?.output_types.get(output))?;
                packed.kinds.insert(kind);
            }
            packed.by.insert(node.id.clone());
            return Some(());
        }
        let wires = carried.iter().filter_map(|port| node.inputs.get(port.name));
        wires
            .map(|wire| wire.output())
            .try_for_each(|source| self.packers(source?, seen, packed))
    }
}
