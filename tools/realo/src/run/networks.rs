//! The networks of a graph, looked at before anything is started or claimed.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use eyre::{Result, WrapErr, bail};
use realo_runtime::graph::{FlatGraph, FlatNode, InputSource};

use super::prepare::{given, lexically_normal, stage_of};

const ENCODER: &str = "pillar-encoder";
const HEAD: &str = "detection-head";

/// What is known of a network: its identity and the kernels that it runs on.
type Known = (String, String);

/// The networks that were looked at, by model file and `isa`; runs over many logs have the same ones.
#[derive(Default)]
pub struct Networks(BTreeMap<(PathBuf, String), Known>);

impl Networks {
    fn known(&mut self, path: &Path, isa: &str) -> Result<&Known> {
        let key = (path.to_path_buf(), isa.to_string());
        if !self.0.contains_key(&key) {
            let loaded = realo_nn::load(path, isa, 1)?;
            let choice = loaded.network.choice();
            let kernels = format!("{} on {}", choice.precision, choice.isa);
            self.0.insert(key.clone(), (loaded.identity, kernels));
        }
        Ok(&self.0[&key])
    }

    /// Loads every network of a graph; gives the kernels that they run on, empty without a network.
    ///
    /// # Errors
    /// A model or weights that cannot be had, kernels that this processor lacks, and a head behind the encoder of
    /// another model; each names the node.
    pub fn check(&mut self, graph: &FlatGraph) -> Result<String> {
        let mut identities: BTreeMap<&str, (PathBuf, String)> = BTreeMap::new();
        let mut kernels = BTreeSet::new();
        for node in &graph.nodes {
            let Some(stage) = stage_of(node).filter(|stage| [ENCODER, HEAD].contains(stage)) else {
                continue;
            };
            let path = model_of(graph, node, stage)?;
            let isa = given(node, "isa").unwrap_or("auto");
            let (identity, runs_on) = self.known(&path, isa).wrap_err_with(|| format!("node `{}`", node.id))?;
            kernels.insert(runs_on.clone());
            identities.insert(&node.id, (path, identity.clone()));
        }
        for node in graph.nodes.iter().filter(|node| stage_of(node) == Some(HEAD)) {
            for input in node.inputs.values() {
                let InputSource::Output { node: source, .. } = &input.source else {
                    continue;
                };
                let (Some((theirs, a)), Some((ours, b))) = (identities.get(&**source), identities.get(&*node.id))
                else {
                    continue;
                };
                if a != b {
                    let (id, ours, theirs) = (&node.id, ours.display(), theirs.display());
                    bail!("node `{id}` has model {ours}, but `{source}` before it has {theirs}: name one in both");
                }
            }
        }
        Ok(kernels.into_iter().collect::<Vec<_>>().join(", "))
    }
}

/// The model file of a node, seen from the graph's folder.
fn model_of(graph: &FlatGraph, node: &FlatNode, stage: &str) -> Result<PathBuf> {
    let own = match stage {
        ENCODER => realo_pillar_encoder::Config::default().model,
        _ => realo_detection_head::Config::default().model,
    };
    let model = given(node, "model").map_or(own, PathBuf::from);
    let folder = std::path::absolute(graph.file.parent().unwrap_or(Path::new(".")))?;
    Ok(lexically_normal(&folder.join(model)))
}
