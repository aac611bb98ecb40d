//! What the graph asks of this process, known before it joins dora.

use std::collections::BTreeMap;

use serde_yaml::Value;

/// Where dora tells a process what it is.
const VARIABLE: &str = "DORA_NODE_CONFIG";

/// Id and ports of a process.
pub(super) struct Plan {
    pub id: String,
    /// By input: `node/output` behind it.
    pub inputs: BTreeMap<String, String>,
    pub outputs: Vec<String>,
}

impl Plan {
    /// What dora tells this process.
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
        Ok(Plan {
            id: id.ok_or("expected a text `node_id`, found none")?.into(),
            inputs: inputs.collect(),
            outputs: outputs
                .filter_map(|output| Some(output.as_str()?.to_string()))
                .collect(),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reads_what_dora_writes() {
        let text = "node_id: ego\nrun_config:\n  inputs:\n    clouds: player/ego_clouds\n    poses:\n      source: \
                    player/ego_poses\n      queue_size: 10\n  outputs: [boxes, state]\n";
        let plan = Plan::read(text).unwrap();
        assert_eq!(plan.id, "ego");
        assert_eq!(plan.inputs["clouds"], "player/ego_clouds");
        assert_eq!(plan.inputs["poses"], "player/ego_poses");
        assert_eq!(plan.outputs, ["boxes", "state"]);
        assert!(Plan::read("node_id: 3").is_err() && Plan::read("[").is_err());
    }
}
