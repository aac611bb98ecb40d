use std::collections::BTreeMap;
use std::path::Path;

use realo_schemas::Nanos;
use serde::Serialize;

/// How long each stage takes in virtual time.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
#[serde(transparent)]
pub struct ComputeProfile {
    /// Node id to ns per call; a node that is not named takes no time.
    pub nodes: BTreeMap<String, Nanos>,
}

impl ComputeProfile {
    /// Reads a profile from TOML: `node id = ns`; an id with dots may be quoted or a table.
    ///
    /// # Errors
    /// Names the file and what does not fit.
    pub fn read(path: &Path) -> Result<Self, String> {
        let shown = path.display();
        let text = std::fs::read_to_string(path).map_err(|error| {
            format!(
                "{shown}: {error}; a compute profile is a TOML file of `node id = ns`, as a realtime run leaves one in \
                 its folder (compute.toml)"
            )
        })?;
        let table: toml::Table = toml::from_str(&text).map_err(|error| format!("{shown}: {error}"))?;
        let mut nodes = BTreeMap::new();
        collect("", &table, &mut nodes).map_err(|problem| format!("{shown}: {problem}"))?;
        Ok(ComputeProfile { nodes })
    }

    /// The profile as TOML.
    pub fn to_toml(&self) -> String {
        toml::to_string(self).expect("a table of integers is TOML")
    }

    /// Time of a call of a node.
    pub fn of(&self, node: &str) -> Nanos {
        self.nodes.get(node).copied().unwrap_or(0)
    }
}

fn collect(above: &str, table: &toml::Table, nodes: &mut BTreeMap<String, Nanos>) -> Result<(), String> {
    for (key, value) in table {
        let id = if above.is_empty() {
            key.clone()
        } else {
            format!("{above}.{key}")
        };
        match value {
            toml::Value::Table(inner) => collect(&id, inner, nodes)?,
            toml::Value::Integer(nanos) if *nanos >= 0 => {
                nodes.insert(id, *nanos);
            }
            other => {
                return Err(format!(
                    "node `{id}`: expected a duration in ns of 0 or more, found {other}"
                ));
            }
        }
    }
    Ok(())
}
