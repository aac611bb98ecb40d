use std::path::{Path, PathBuf};

use realo_operator::config::did_you_mean;

/// Why a graph could not be read or changed.
#[derive(Debug, thiserror::Error)]
pub enum GraphError {
    /// A file that cannot be read.
    #[error("{}: {reason}", file.display())]
    Read {
        /// The file.
        file: PathBuf,
        /// What the system says.
        reason: std::io::Error,
    },
    /// Not YAML.
    #[error("{}: not a YAML document: {reason}", file.display())]
    Yaml {
        /// The file.
        file: PathBuf,
        /// What the parser says, with line and column.
        reason: String,
    },
    /// A value of the wrong form.
    #[error("{}: {at}: expected {expected}, found {found}", file.display())]
    Value {
        /// The file.
        file: PathBuf,
        /// Node and key.
        at: String,
        /// What belongs there.
        expected: String,
        /// What is there.
        found: String,
    },
    /// A key that dora does not have there.
    #[error("{}: {at}: unknown key `{key}`{}; there may be: {known}", file.display(), did_you_mean(.nearest))]
    Key {
        /// The file.
        file: PathBuf,
        /// The node, or the part of the file.
        at: String,
        /// The key.
        key: String,
        /// The most similar key that exists.
        nearest: Option<String>,
        /// All keys that may stand there.
        known: String,
    },
    /// A module that does not fit.
    #[error("{}: module node `{node}`: {reason}", file.display())]
    Module {
        /// The file that uses the module.
        file: PathBuf,
        /// The node that stands for the module, by its full id.
        node: String,
        /// What does not fit, and what to do.
        reason: String,
    },
    /// Nothing to run.
    #[error(
        "{}: the dataflow, nodes: expected one node or more, found {found}; a node is {{id: NAME, path: PROGRAM}} or \
         {{id: NAME, module: FILE}}, and dataflows/late_fusion.yml is a whole graph",
        file.display()
    )]
    Empty {
        /// The graph.
        file: PathBuf,
        /// What is there instead.
        found: &'static str,
    },
    /// Two nodes of one name.
    #[error("{}: two nodes have the id `{id}`; give one another name", file.display())]
    Duplicate {
        /// The graph.
        file: PathBuf,
        /// The id.
        id: String,
    },
    /// A cycle.
    #[error("{}: the graph has a cycle: {}; remove one of these edges", file.display(), nodes.join(" > "))]
    Cycle {
        /// The graph.
        file: PathBuf,
        /// The nodes along it, the first one again at the end.
        nodes: Vec<String>,
    },
    /// An input from a node that does not exist.
    #[error("{}: node `{node}`, input `{port}`: no node `{source_id}`{}", file.display(), did_you_mean(.nearest))]
    Source {
        /// The graph.
        file: PathBuf,
        /// The node that has the input.
        node: String,
        /// The input.
        port: String,
        /// The node that it names.
        source_id: String,
        /// The most similar id that exists.
        nearest: Option<String>,
    },
    /// A node that a setting names and the graph does not have.
    #[error("{}: no node `{id}`{}; the graph has: {known}", file.display(), did_you_mean(.nearest))]
    UnknownNode {
        /// The graph.
        file: PathBuf,
        /// The id.
        id: String,
        /// The most similar id that exists.
        nearest: Option<String>,
        /// All ids.
        known: String,
    },
    /// An input that a replacement names and that nothing feeds.
    #[error("{}: nothing feeds an input `{input}` of `{node}`{}; its inputs are: {known}", file.display(), did_you_mean(.nearest))]
    UnknownInput {
        /// The graph.
        file: PathBuf,
        /// The stage.
        node: String,
        /// The input.
        input: String,
        /// The most similar one that it has.
        nearest: Option<String>,
        /// All that it has.
        known: String,
    },
    /// A setting that is not of the form `stage.key=value`.
    #[error("setting `{0}` is not of the form stage.key=value")]
    Setting(String),
    /// A replacement that is not of the form `STAGE=program PATH key=value`.
    #[error(
        "replacement `{0}`: expected `STAGE=program PATH key=value …` or `STAGE=operator NAME key=value …`, found {1}; STAGE may be STAGE.INPUT, to put a new stage before an input"
    )]
    Replacement(String, String),
    /// `--recorded-detections` for a graph that does not detect.
    #[error(
        "{}: no module `detect.*.yml` whose detections could be replaced by recorded ones; \
         run the graph without --recorded-detections",
        file.display()
    )]
    NoDetectModule {
        /// The graph.
        file: PathBuf,
    },
    /// A node whose program or arguments cannot be written or split.
    #[error("{}: node `{node}`: {reason}", file.display())]
    Node {
        /// The graph.
        file: PathBuf,
        /// The node.
        node: String,
        /// Why.
        reason: String,
    },
}

impl GraphError {
    pub(super) fn read(file: &Path) -> impl FnOnce(std::io::Error) -> GraphError + '_ {
        move |reason| GraphError::Read {
            file: file.into(),
            reason,
        }
    }
}
