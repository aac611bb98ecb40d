//! What networks of one model share.

use realo_nn::layers::{Layers, MapSize};
use realo_nn::weights::Weights;

use super::engine::{Engine, Parts};
use super::error::NetworkError;
use super::heads::Heads;
use super::options::{Choice, NetworkOptions, choose};
use super::part::Outcome;
use crate::arch::Model;
use crate::method::Fuse;

/// What all networks of a model share: everything but threads and maps.
pub(crate) struct Core {
    pub(super) name: String,
    pub(super) choice: Choice,
    /// From the canvas to the map that an agent keeps for its own fusion.
    pub(super) encode: Engine,
    /// From the kept map to the shared one, unless they are the same.
    pub(super) compress: Option<Engine>,
    /// From the shared map to the restored one, unless they are the same.
    pub(super) restore: Option<Engine>,
    pub(super) heads: Engine,
    /// How the network fuses, and how many agents.
    pub(super) fusion: Option<(Box<dyn Fuse>, usize)>,
    pub(super) canvas: MapSize,
    pub(super) kept: MapSize,
    pub(super) features: MapSize,
    pub(super) fused: MapSize,
    /// Numbers of a cell: scores and deltas.
    pub(super) outputs: [usize; 2],
    pub(super) result: MapSize,
}

impl Core {
    /// `weights` are those of `model`, which has been checked.
    pub fn new(model: &Model, weights: &Weights, options: &NetworkOptions) -> Result<Self, NetworkError> {
        Core::of(&Layers::of(model), weights, model, options)
    }

    /// As [`Core::new`], of layers that need not be the model's.
    pub(super) fn of(
        layers: &Layers,
        weights: &Weights,
        model: &Model,
        options: &NetworkOptions,
    ) -> Result<Self, NetworkError> {
        let choice = choose(model, options)?;
        let Layers {
            canvas,
            kept,
            features,
            restored,
            fused,
            heads,
            ..
        } = *layers;
        let parts = Parts {
            layers,
            weights,
            isa: choice.isa,
            activations: &model.activations,
        };
        let engine = |ends, outcome| parts.engine(choice.precision, ends, outcome);
        Ok(Core {
            name: model.name.clone(),
            choice,
            encode: engine([canvas, kept], Outcome::Own),
            compress: (features != kept).then(|| engine([kept, features], Outcome::Own)),
            restore: (restored != features).then(|| engine([features, restored], Outcome::Single)),
            heads: parts.engine(choice.float(), [fused, heads], Outcome::Single),
            fusion: match (layers.fusion(), model.arch.method()) {
                (Some(layer), Some(method)) => {
                    let fuse = method.kernel(layer, weights, choice.of_fusion());
                    Some((fuse, method.sharing().agents))
                }
                _ => None,
            },
            canvas: layers.size(canvas),
            kept: layers.size(kept),
            features: layers.size(features),
            fused: layers.size(fused),
            outputs: [layers.scores, layers.deltas].map(|map| layers.size(map)[2]),
            result: layers.size(heads),
        })
    }
}

impl Core {
    /// Heads of zeros.
    pub(super) fn result(&self) -> Heads {
        let [rows, columns, _] = self.result;
        let [scores, deltas] = self.outputs.map(|outputs| vec![0.0; rows * columns * outputs]);
        Heads {
            rows,
            columns,
            scores,
            deltas,
        }
    }
}
