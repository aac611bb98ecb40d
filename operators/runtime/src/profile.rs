use std::collections::BTreeMap;
use std::path::Path;

use realo_schemas::Nanos;
use serde::{Deserialize, Serialize};

/// How long each stage takes in virtual time.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ComputeProfile {
    /// Node id to ns per call; a node that is not named takes no time.
    #[serde(default)]
    pub nodes: BTreeMap<String, Nanos>,
}

impl ComputeProfile {
    /// Reads a profile from TOML: a table `[nodes]` of node id = ns.
    ///
    /// # Errors
    /// Names the file and what does not fit.
    pub fn read(path: &Path) -> Result<Self, String> {
        let text = std::fs::read_to_string(path).map_err(|error| {
            let path = path.display();
            format!("{path}: {error}; a compute profile is a TOML file of `node id = ns`, as a realtime run leaves one in its folder (compute.toml)")
        })?;
        let profile: ComputeProfile = toml::from_str(&text).map_err(|error| format!("{}: {error}", path.display()))?;
        match profile.nodes.iter().find(|(_, nanos)| **nanos < 0) {
            Some((node, nanos)) => Err(format!(
                "{}: node `{node}`: expected a duration in ns of 0 or more, found {nanos}",
                path.display()
            )),
            None => Ok(profile),
        }
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
