//! A weighted mean: the ego's features count once, those of others as much as one learned number for each channel says.
//!
//! The least that a method with weights needs.

mod kernel;
mod tensor;

use realo_methods::method::{Arithmetic, ByCell, Fuse, Method};
use realo_methods::tensors::{self, Tensors};
use realo_nn::layers::FuseLayer;
use realo_nn::model::Sharing;
use realo_nn::tensors::{Role, TensorSpec};
use realo_nn::weights::Weights;
use serde::{Deserialize, Serialize};
use serde_json::Value;

/// Key of the logits of how much others count.
const SHARE: &str = "fusion_net.share";

/// Settings in a model file.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Settings {
    /// Agents that are fused at most, the ego among them.
    pub agents: usize,
    /// How many times fewer channels cross than the map has; 0: all of them cross.
    pub compression: usize,
}

impl Default for Settings {
    fn default() -> Self {
        let Sharing {
            agents, compression, ..
        } = Sharing::default();
        Settings { agents, compression }
    }
}

impl Method for Settings {
    const NAME: &'static str = "toy";
    const TITLE: &'static str = "Weighted mean";

    fn sharing(&self) -> Sharing {
        Sharing {
            agents: self.agents,
            compression: self.compression,
            ..Sharing::default()
        }
    }

    fn with_compression(self, compression: usize) -> Self {
        Settings { compression, ..self }
    }

    fn tensors(&self, channels: usize) -> Vec<TensorSpec> {
        vec![TensorSpec {
            key: SHARE.into(),
            shape: vec![channels],
            role: Role::Bias,
        }]
    }

    fn kernel(&self, _: &FuseLayer, weights: &Weights, _: Arithmetic) -> Box<dyn Fuse> {
        Box::new(ByCell(kernel::Mean::new(weights.tensor(SHARE))))
    }

    fn operation(
        &self,
        _: &FuseLayer,
        tensors: &Tensors,
        agents: &[tensors::Agent],
    ) -> candle_core::Result<candle_core::Tensor> {
        tensor::mean(tensors.get(SHARE)?, &tensors::placed(agents)?)
    }

    fn of_reference(config: &Value, sharing: Sharing) -> Option<Result<Self, String>> {
        let Sharing {
            agents, compression, ..
        } = sharing;
        (config["kind"] == Self::NAME).then_some(Ok(Settings { agents, compression }))
    }
}
