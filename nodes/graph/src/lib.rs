//! Dataflow files: reading, expansion of modules and hosts, changes from the command line, checks.
//!
//! A graph is a plain dora dataflow. [`Graph::load`] reads one, [`Graph::expand`] replaces its modules exactly as
//! `dora expand` does and looks into the modules that `realo host` runs, [`FlatGraph::set`] changes a setting,
//! [`FlatGraph::to_yaml`] writes it for `dora run`, and [`validate`] finds what dora does not check. Of dora's node kinds,
//! those with a `path` and modules are read.

mod audit;
mod check;
mod error;
mod expand;
mod flat;
mod names;
mod order;
mod params;
mod paths;
mod place;
mod read;
mod replace;
mod rewire;
mod variables;

#[cfg(test)]
mod dora_tests;
#[cfg(test)]
mod host_tests;
#[cfg(test)]
mod outlet_tests;
#[cfg(test)]
mod types_tests;

use std::path::{Path, PathBuf};

use serde_yaml::Mapping;

pub use audit::audit;
pub use check::{Answer, Finding, Severity, misdeclared, unfit_maps, validate, validate_asking, written_findings};
pub use error::GraphError;
pub use expand::{OUTSIDE, hosted};
pub use flat::{FlatGraph, FlatNode, Input, InputSource, Setting};
pub use names::short_names;
pub use paths::normalized;
pub use replace::Replacement;
pub use variables::with_variables;

/// Prefix of our types in graphs, as dora derives it from the place of `types/realo/v1.yml`.
pub const TYPE_PREFIX: &str = "realo/v1/";

/// A dataflow file as written, its modules not yet replaced.
#[derive(Clone, Debug)]
pub struct Graph {
    file: PathBuf,
    settings: Mapping,
    nodes: Vec<read::Node>,
    /// Name of the detection that takes every other's place.
    detection: Option<String>,
}

impl Graph {
    /// Reads a dataflow file; its modules are read by [`Graph::expand`].
    ///
    /// # Errors
    /// [`GraphError`] names the file, the node and the key, what was expected and what was found.
    pub fn load(path: &Path) -> Result<Self, GraphError> {
        Graph::parse(&read::text_of(path)?, path)
    }

    /// Reads the text of a dataflow that lies (or would lie) at `path`.
    ///
    /// # Errors
    /// As [`Graph::load`].
    pub fn parse(text: &str, path: &Path) -> Result<Self, GraphError> {
        let file = paths::absolute(path)?;
        let (settings, nodes) = read::dataflow(text, path)?;
        Ok(Graph {
            file,
            settings,
            nodes,
            detection: None,
        })
    }

    /// Uses `detect.<name>.yml` in place of every module `detect.*.yml`, and `detect.<name>.tracked.yml` in place of every
    /// `detect.*.tracked.yml`; [`Graph::expand`] refuses a graph without such a module. With `recorded` the agents report the
    /// detections of the log.
    pub fn with_detection(mut self, name: &str) -> Self {
        self.detection = Some(name.to_string());
        self
    }

    /// The graph with every module replaced by its nodes.
    ///
    /// # Errors
    /// [`GraphError`] for a module that cannot be read, does not fit its inputs, or lies outside the graph's folder.
    pub fn expand(&self) -> Result<FlatGraph, GraphError> {
        expand::expand(self)
    }
}
