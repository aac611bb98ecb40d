//! What the graph asks of this process, known before it joins dora.

use std::collections::{BTreeMap, BTreeSet};

use serde_yaml::Value;

/// Where dora describes a process.
const VARIABLE: &str = "DORA_NODE_CONFIG";

/// Name and ports of a process.
pub(super) struct Plan {
    pub id: String,
    /// By input: `node/output` behind it.
    pub inputs: BTreeMap<String, String>,
    /// Those that another process takes.
    pub outputs: Vec<String>,
    /// Outputs from which a way leads back to this process.
    pub returning: BTreeSet<String>,
}

/// A process of the graph: its id, and `node/output` behind each of its inputs.
type Process = (String, Vec<String>);

impl Plan {
    /// What dora says of this process.
    ///
    /// # Errors
    /// A process that dora did not start.
    pub fn of_this_process() -> Result<Self, String> {
        let text = std::env::var(VARIABLE).map_err(|_| {
            "this command is what a graph starts: run `realo run GRAPH`, or `dora run GRAPH`".to_string()
        })?;
        Plan::read(&text).map_err(|reason| format!("{VARIABLE}: {reason}; take dora 1.1"))
    }

    fn read(text: &str) -> Result<Self, String> {
        let config: Value = serde_yaml::from_str(text).map_err(|error| error.to_string())?;
        let run = config.get("run_config").ok_or("expected `run_config`, found none")?;
        let id = config.get("node_id").and_then(Value::as_str);
        let inputs = run.get("inputs").and_then(Value::as_mapping).into_iter().flatten();
        let inputs = inputs.filter_map(|(port, input)| {
            let mapping = input.get("source").unwrap_or(input);
            Some((
                port.as_str()?.to_string(),
                mapping.as_str().unwrap_or_default().to_string(),
            ))
        });
        let outputs = run.get("outputs").and_then(Value::as_sequence).into_iter().flatten();
        let id = id.ok_or("expected a text `node_id`, found none")?;
        let graph = processes(&config);
        let is_taken = |output: &String| {
            let wire = format!("{id}/{output}");
            graph.iter().any(|(_, sources)| sources.contains(&wire))
        };
        let outputs: Vec<String> = outputs
            .filter_map(|output| Some(output.as_str()?.to_string()))
            .filter(is_taken)
            .collect();
        let returns = |output: &&String| leads_back(&graph, id, output);
        let names = names(&config);
        let short = |id: &str| names.get(id).cloned().unwrap_or(id.into());
        let inputs = inputs.map(|(port, source)| match source.split_once('/') {
            Some((node, output)) => (port, format!("{}/{output}", short(node))),
            None => (port, source),
        });
        Ok(Plan {
            id: short(id),
            inputs: inputs.collect(),
            returning: outputs.iter().filter(returns).cloned().collect(),
            outputs,
        })
    }
}

/// What the processes of the graph are called, where that is not their id.
fn names(config: &Value) -> BTreeMap<String, String> {
    let nodes = config.get("dataflow_descriptor").and_then(|graph| graph.get("nodes"));
    let nodes = nodes.and_then(Value::as_sequence).into_iter().flatten();
    let known = nodes.filter_map(|node| {
        let args = node.get("args").and_then(Value::as_str).unwrap_or_default();
        Some((
            node.get("id")?.as_str()?,
            args.split_whitespace().next().unwrap_or_default(),
        ))
    });
    realo_graph::short_names(known)
}

/// The processes of the graph that this one is part of.
fn processes(config: &Value) -> Vec<Process> {
    let nodes = config.get("dataflow_descriptor").and_then(|graph| graph.get("nodes"));
    let nodes = nodes.and_then(Value::as_sequence).into_iter().flatten();
    let read = nodes.filter_map(|node| {
        let inputs = node.get("inputs").and_then(Value::as_mapping).into_iter().flatten();
        let sources = inputs.filter_map(|(_, input)| input.get("source").unwrap_or(input).as_str());
        Some((
            node.get("id")?.as_str()?.to_string(),
            sources.map(String::from).collect(),
        ))
    });
    read.collect()
}

/// Whether what a process sends on an output can come back to it.
fn leads_back(graph: &[Process], id: &str, output: &str) -> bool {
    let takes = |(_, sources): &&Process, wanted: &dyn Fn(&str) -> bool| sources.iter().any(|source| wanted(source));
    let direct = format!("{id}/{output}");
    let first = graph
        .iter()
        .filter(|process| takes(process, &|source| source == direct));
    let mut open: Vec<&str> = first.map(|(id, _)| id.as_str()).collect();
    let mut seen = BTreeSet::new();
    while let Some(reached) = open.pop() {
        if reached == id {
            return true;
        }
        if seen.insert(reached) {
            let from = format!("{reached}/");
            let next = graph
                .iter()
                .filter(|process| takes(process, &|source| source.starts_with(&from)));
            open.extend(next.map(|(id, _)| id.as_str()));
        }
    }
    false
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn knows_which_outputs_lead_back() {
        let text = "node_id: v2x\nrun_config: { outputs: [to_ego, to_others] }\ndataflow_descriptor:\n  nodes:\n  - { id: others, \
                    inputs: { from_ego: { source: v2x/to_others, queue_size: 3 } } }\n  - { id: v2x, inputs: { packets: \
                    others/packets } }\n  - { id: fusion, inputs: { packets: v2x/to_ego } }\n  - { id: score, inputs: { boxes: \
                    fusion/boxes } }\n";
        let plan = Plan::read(text).unwrap();
        assert_eq!(plan.returning, ["to_others".to_string()].into());
    }

    #[test]
    fn a_module_of_processes_is_no_part_of_their_names() {
        let text = "node_id: method.fusion\nrun_config: { inputs: { ego: method.ego/boxes, packets: { source: scene.v2x/to_ego }, \
                    far: bank.nms/boxes } }\ndataflow_descriptor:\n  nodes:\n  - { id: method.fusion, args: host f.yml }\n  - { id: method.ego, args: \
                    host e.yml }\n  - { id: scene.v2x, args: node radio }\n  - { id: bank.nms, args: operator nms }\n";
        let plan = Plan::read(text).unwrap();
        assert_eq!((plan.id.as_str(), plan.inputs["ego"].as_str()), ("fusion", "ego/boxes"));
        assert_eq!(plan.inputs["packets"], "v2x/to_ego");
        assert_eq!(
            plan.inputs["far"], "bank.nms/boxes",
            "a module of single stages is part of their names"
        );
    }

    #[test]
    fn reads_what_dora_writes() {
        let text = "node_id: ego\nrun_config:\n  inputs:\n    clouds: player/ego_clouds\n    poses:\n      source: \
                    player/ego_poses\n      queue_size: 10\n  outputs: [boxes, packets, state]\ndataflow_descriptor: { nodes: [{ id: \
                    score, inputs: { boxes: ego/boxes, state: { source: ego/state } } }] }\n";
        let plan = Plan::read(text).unwrap();
        assert_eq!(plan.id, "ego");
        assert_eq!(plan.inputs["clouds"], "player/ego_clouds");
        assert_eq!(plan.inputs["poses"], "player/ego_poses");
        assert_eq!(plan.outputs, ["boxes", "state"], "nobody takes the packets");
        assert!(plan.returning.is_empty());
        assert!(Plan::read("node_id: 3").is_err() && Plan::read("[").is_err());
    }
}
