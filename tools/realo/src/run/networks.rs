//! The networks of a graph, looked at before anything is started or claimed.

use crate::roles;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use eyre::{Result, WrapErr, bail, eyre};
use realo_graph::{FlatGraph, FlatNode, InputSource};
use realo_methods::Model;
use realo_methods::{AUTO, Kernels, Loaded};

use super::nodes::{argument, decided_argument, deciding, registration, set_model};

/// A network that was looked at; as long as it is kept, whoever loads it too shares it.
struct Known {
    loaded: Loaded,
    /// What it runs on, on this processor.
    kernels: String,
}

impl Known {
    /// What it runs on, as a node says.
    fn runs_on(&self, node: &FlatNode) -> String {
        let device = decided_argument(node, roles::DEVICE).and_then(|name| argument(node, name));
        match device.filter(|device| device != "cpu") {
            Some(device) => format!("{} on {device}", self.loaded.precision),
            None => self.kernels.clone(),
        }
    }
}

/// The networks of a graph in words, each once; empty without any.
#[derive(Debug, Default, PartialEq, Eq)]
pub struct Words {
    /// Names of the models, with a hash of model file and weights.
    pub models: String,
    /// Precisions and instruction sets.
    pub kernels: String,
}

/// Looks for a model file and its weights.
fn find(path: &Path) -> Result<()> {
    if !path.exists() {
        bail!("{}: no such model file; --model FILE names another one", path.display());
    }
    let weights = Model::read(path)?.weights_beside(path);
    if let Some(weights) = weights.iter().find(|weights| !weights.exists()) {
        bail!(
            "{}: this model has no weights, {} is not there, the file that its `name`, `weights` or `encoder` names: \
             `realo-lab checkpoint convert` makes them of a PyTorch checkpoint, `realo-lab train` trains detectors and fusions; \
             --model FILE, or --set STAGE.model=FILE, names a model that has some",
            path.display(),
            weights.display()
        );
    }
    Ok(())
}

/// Looks for the models of a graph whose paths are absolute, and for their weights; loads none. `model` is that of all.
///
/// # Errors
/// What is not there, or a file that is no model; each names the node.
pub fn find_all(graph: &FlatGraph, model: Option<&Path>) -> Result<()> {
    let mut graph = graph.clone();
    if let Some(model) = model {
        set_model(&mut graph, model)?;
    }
    for node in deciding(&graph, roles::MODEL) {
        if let Some(path) = decided_argument(node, roles::MODEL).and_then(|key| argument(node, key)) {
            find(Path::new(&path)).wrap_err_with(|| format!("node `{}`", node.id))?;
        }
    }
    Ok(())
}

/// The networks that were looked at, by model file, `isa` and `precision`; runs over many logs have the same ones.
#[derive(Default)]
pub struct Networks(BTreeMap<(PathBuf, String, String), Known>);

impl Networks {
    fn known(&mut self, path: &Path, isa: &str, precision: &str) -> Result<&Known> {
        let key = (path.to_path_buf(), isa.to_string(), precision.to_string());
        if !self.0.contains_key(&key) {
            find(path)?;
            let kernels = Kernels {
                isa,
                precision,
                threads: 1,
            };
            let loaded = realo_methods::load(path, kernels)?;
            let choice = loaded.network.choice();
            let kernels = format!("{} on {}", choice.precision, choice.isa);
            self.0.insert(key.clone(), Known { loaded, kernels });
        }
        Ok(&self.0[&key])
    }

    /// Name of the model of a node, with a hash of its file and weights; `None` without a network.
    ///
    /// # Errors
    /// A model or weights that cannot be had.
    pub fn identity(&mut self, node: &FlatNode) -> Result<Option<String>> {
        let known = self.of_node(node)?;
        Ok(known.map(|(_, known)| known.loaded.identity.clone()))
    }

    /// Agents that the model of a node takes, the ego among them; `None` without a network that fuses.
    ///
    /// # Errors
    /// A model or weights that cannot be had.
    pub fn agents(&mut self, node: &FlatNode) -> Result<Option<usize>> {
        let known = self.of_node(node)?;
        let arch = known.map(|(_, known)| &known.loaded.model.arch);
        Ok(arch.filter(|arch| arch.fuses()).map(|arch| arch.agents()))
    }

    fn of_node(&mut self, node: &FlatNode) -> Result<Option<(PathBuf, &Known)>> {
        let value = |decided| decided_argument(node, decided).and_then(|name| argument(node, name));
        let Some(path) = value(roles::MODEL).map(PathBuf::from) else {
            return Ok(None);
        };
        let [isa, precision] = [roles::ISA, roles::PRECISION].map(|of| value(of).unwrap_or_else(|| AUTO.into()));
        let known = self.known(&path, &isa, &precision)?;
        Ok(Some((path, known)))
    }

    /// Loads every network of a graph.
    ///
    /// # Errors
    /// A model or weights that cannot be had, kernels that this processor lacks, a stage that refuses its model, and a part of
    /// a network behind one of another model; each names the node.
    pub fn check(&mut self, graph: &FlatGraph) -> Result<Words> {
        let mut identities: BTreeMap<&str, (PathBuf, String)> = BTreeMap::new();
        let mut kernels = BTreeSet::new();
        for node in deciding(graph, roles::MODEL) {
            let known = self.of_node(node).wrap_err_with(|| format!("node `{}`", node.id))?;
            let Some((path, known)) = known else {
                continue;
            };
            let identity = known.loaded.identity.clone();
            kernels.insert(known.runs_on(node));
            if let Some(known) = registration(node) {
                let built = (known.build)(node.settings());
                built.map_err(|error| eyre!("node `{}`: {error}", node.id))?;
            }
            identities.insert(&node.id, (path, identity));
        }
        for node in deciding(graph, roles::MODEL) {
            let Some((ours, b)) = identities.get(&*node.id) else {
                continue;
            };
            for source in behind(graph, node, |id| identities.contains_key(id)) {
                let (theirs, a) = &identities[source];
                if a != b {
                    let (id, ours, theirs) = (&node.id, ours.display(), theirs.display());
                    bail!("node `{id}` has model {ours}, but `{source}` before it has {theirs}: name one in both");
                }
            }
        }
        let models: BTreeSet<String> = identities.into_values().map(|(_, identity)| identity).collect();
        let words = |set: BTreeSet<String>| set.into_iter().collect::<Vec<_>>().join(", ");
        Ok(Words {
            models: words(models),
            kernels: words(kernels),
        })
    }
}

/// The nearest stages before a node that are such, whatever lies between: what they send reaches it.
fn behind<'a>(graph: &'a FlatGraph, node: &'a FlatNode, is_such: impl Fn(&str) -> bool) -> BTreeSet<&'a str> {
    let (mut open, mut seen, mut found) = (vec![node], BTreeSet::new(), BTreeSet::new());
    while let Some(node) = open.pop() {
        for input in node.inputs.values() {
            let InputSource::Output { node: source, .. } = &input.source else {
                continue;
            };
            match is_such(source) {
                true => _ = found.insert(&**source),
                false if seen.insert(&**source) => open.extend(graph.nodes.iter().find(|node| node.id == *source)),
                false => {}
            }
        }
    }
    found
}
