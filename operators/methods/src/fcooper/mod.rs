//! F-Cooper: the maximum of each feature (Chen et al. 2019), as V2X-Real builds it.

mod kernel;
#[cfg(feature = "candle")]
mod tensor;

use realo_nn::layers::FuseLayer;
use realo_nn::model::Sharing;
use realo_nn::weights::Weights;
use serde::{Deserialize, Serialize};
use serde_json::Value;

pub use kernel::Max;

use crate::method::{Arithmetic, ByCell, Descent, Fuse, Method};
#[cfg(feature = "candle")]
use crate::tensors::{self, Tensors};

/// Settings in a model file: those of every fusion of features.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Settings(pub Sharing);

impl Method for Settings {
    const NAME: &'static str = "fcooper";
    const TITLE: &'static str = "F-Cooper";
    const REFERENCE: Option<&'static str> = Some("PointPillarFCooper");

    fn sharing(&self) -> Sharing {
        self.0
    }

    fn with_compression(self, compression: usize) -> Self {
        Settings(Sharing { compression, ..self.0 })
    }

    fn kernel(&self, _: &FuseLayer, _: &Weights, _: Arithmetic) -> Box<dyn Fuse> {
        Box::new(ByCell(Max))
    }

    fn descent(&self, _: &FuseLayer, _: &Weights) -> Option<Box<dyn Descent>> {
        Some(Box::new(ByCell(Max)))
    }

    #[cfg(feature = "candle")]
    fn operation(
        &self,
        _: &FuseLayer,
        _: &Tensors,
        agents: &[tensors::Agent],
    ) -> candle_core::Result<candle_core::Tensor> {
        tensor::max(&tensors::placed(agents)?)
    }

    fn of_reference(config: &Value, sharing: Sharing) -> Option<Result<Self, String>> {
        let is_it = match config["kind"].as_str() {
            Some(kind) => kind.split('_').next() == Some(Self::NAME),
            // The vector of the fusion alone has no settings.
            None => config.as_object().is_none_or(|config| config.is_empty()),
        };
        is_it.then_some(Ok(Settings(sharing)))
    }
}
