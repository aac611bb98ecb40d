//! Parts of a network that a training leaves as they are.

use std::collections::{BTreeSet, HashSet};
use std::fmt;
use std::str::FromStr;

use realo_methods::Model;
use realo_nn::layers::Layers;
use serde::{Deserialize, Serialize};

/// A part of a network.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Part {
    /// What makes an agent's map of its points.
    Encoder,
    /// What makes less of that map, and of the less a map again.
    Compressor,
    /// What makes one map of several agents'.
    Fusion,
    /// What finds boxes in a map.
    Heads,
}

impl Part {
    /// All of them.
    pub const ALL: [Part; 4] = [Part::Encoder, Part::Compressor, Part::Fusion, Part::Heads];
}

/// Parts in words.
pub(crate) fn listed(parts: &[Part]) -> String {
    let names: Vec<String> = parts.iter().map(Part::to_string).collect();
    names.join(", ")
}

impl fmt::Display for Part {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(match self {
            Part::Encoder => "encoder",
            Part::Compressor => "compressor",
            Part::Fusion => "fusion",
            Part::Heads => "heads",
        })
    }
}

/// A name that no part has.
#[derive(Debug, thiserror::Error)]
#[error("expected encoder, compressor, fusion or heads, found `{0}`")]
pub struct UnknownPart(String);

impl FromStr for Part {
    type Err = UnknownPart;

    fn from_str(name: &str) -> Result<Self, UnknownPart> {
        let mut all = Part::ALL.into_iter();
        all.find(|part| part.to_string() == name)
            .ok_or_else(|| UnknownPart(name.into()))
    }
}

/// Parts that stay as they are.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Frozen(BTreeSet<Part>);

impl Frozen {
    /// What a training of a model leaves as it is: what is asked for, and an encoder that is another file's.
    pub fn of(model: &Model, asked: &[Part]) -> Self {
        let encoder = model.encoder.as_ref().map(|_| Part::Encoder);
        Frozen(asked.iter().copied().chain(encoder).collect())
    }

    /// Whether a part stays.
    pub fn has(&self, part: Part) -> bool {
        self.0.contains(&part)
    }

    /// Whether all of a network stays.
    pub(crate) fn is_all(&self, model: &Model) -> bool {
        let layers = Layers::of(model);
        let keys = self.keys(&layers);
        layers.tensors().all(|spec| keys.contains(&spec.key))
    }

    /// Keys of the tensors that stay.
    pub(crate) fn keys(&self, layers: &Layers) -> HashSet<String> {
        let between = |part: Part| match part {
            Part::Encoder => layers.between(&[], &[layers.own]),
            Part::Compressor => layers.between(&[layers.own], &[layers.restored]),
            Part::Fusion => layers.between(&[layers.own, layers.restored], &[layers.fused]),
            Part::Heads => layers.between(&[layers.fused], &[layers.scores, layers.deltas]),
        };
        let steps = self.0.iter().flat_map(|part| between(*part));
        steps
            .flat_map(|step| step.layer.tensors())
            .map(|spec| spec.key)
            .collect()
    }
}
