//! Why there is no network, or no result.

use realo_kernels::conv::Isa;
use realo_nn::model::ModelError;
use realo_nn::weights::WeightsError;

/// Why a network cannot be built, or cannot take its input.
#[derive(Debug, thiserror::Error)]
pub enum NetworkError {
    /// The weights are not those of the model.
    #[error(transparent)]
    Weights(#[from] WeightsError),
    /// The model does not fit together.
    #[error(transparent)]
    Model(#[from] ModelError),
    /// The CPU lacks the instructions that were asked for.
    #[error("this CPU has no {asked}; the best that it has is {best}")]
    Isa {
        /// What was asked for.
        asked: Isa,
        /// What could be asked for.
        best: Isa,
    },
    /// A map is not of the model's size.
    #[error(
        "{what} has {} rows x {} columns x {} channels, model `{model}` wants {} x {} x {}",
        found[0], found[1], found[2], expected[0], expected[1], expected[2]
    )]
    Shape {
        /// Which map.
        what: &'static str,
        /// The model's name.
        model: String,
        /// Rows, columns, channels.
        expected: [usize; 3],
        /// Rows, columns, channels.
        found: [usize; 3],
    },
    /// The model is one of a single agent.
    #[error("model `{model}` fuses nothing: expected one whose `arch` does, such as attfuse")]
    NoFusion {
        /// The model's name.
        model: String,
    },
    /// A layer gives numbers that are none.
    #[error("layer `{layer}` gives NaN or infinity: nothing can stand for its results")]
    NotFinite {
        /// Its key.
        layer: String,
    },
    /// The model does not say what bytes stand for.
    #[error("model `{model}` has no `activations`, which int8 needs: `realo quantize` makes a model file that has")]
    NoActivations {
        /// The model's name.
        model: String,
    },
    /// There is no agent, or more than the model takes.
    #[error("model `{model}` fuses 1 to {most} agents, the ego among them, found {found}")]
    Agents {
        /// The model's name.
        model: String,
        /// As many as it takes.
        most: usize,
        /// As many as there are.
        found: usize,
    },
    /// A map has more or fewer numbers than its size says.
    #[error("{what} has {found} numbers, its size wants {expected}")]
    Length {
        /// Which map.
        what: &'static str,
        /// Numbers of its size.
        expected: usize,
        /// Numbers that it has.
        found: usize,
    },
}
