//! AttFuse: attention between the agents' features in each cell (Xu et al. 2022), as V2X-Real builds it.

mod kernel;
#[cfg(feature = "candle")]
mod tensor;

use realo_nn::layers::FuseLayer;
use realo_nn::model::Sharing;
use realo_nn::weights::Weights;
use serde::{Deserialize, Serialize};
use serde_json::Value;

pub use kernel::Attention;

use crate::method::{Arithmetic, ByCell, Descent, Fuse, Method};
#[cfg(feature = "candle")]
use crate::tensors::{self, Tensors};

/// Settings in a model file: those of every fusion of features.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Settings(pub Sharing);

impl Method for Settings {
    const NAME: &'static str = "attfuse";
    const TITLE: &'static str = "AttFuse";
    const REFERENCE: Option<&'static str> = Some("PointPillarIntermediate");

    fn sharing(&self) -> Sharing {
        self.0
    }

    fn with_compression(self, compression: usize) -> Self {
        Settings(Sharing { compression, ..self.0 })
    }

    fn kernel(&self, layer: &FuseLayer, _: &Weights, _: Arithmetic) -> Box<dyn Fuse> {
        Box::new(ByCell(Attention { width: layer.width }))
    }

    fn descent(&self, layer: &FuseLayer, _: &Weights) -> Option<Box<dyn Descent>> {
        Some(Box::new(ByCell(Attention { width: layer.width })))
    }

    #[cfg(feature = "candle")]
    fn operation(
        &self,
        layer: &FuseLayer,
        _: &Tensors,
        agents: &[tensors::Agent],
    ) -> candle_core::Result<candle_core::Tensor> {
        tensor::attention(&tensors::placed(agents)?, layer.width)
    }

    fn of_reference(config: &Value, sharing: Sharing) -> Option<Result<Self, String>> {
        let is_it = match config["kind"].as_str() {
            Some(kind) => kind.split('_').next() == Some(Self::NAME),
            // The vector of the fusion alone says for how many channels products are scaled.
            None => !config["feature_dim"].is_null(),
        };
        is_it.then_some(Ok(Settings(sharing)))
    }
}
