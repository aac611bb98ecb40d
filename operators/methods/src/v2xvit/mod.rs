//! V2X-ViT: a transformer over agents and over windows of the map (Xu et al. 2022), as V2X-Real builds it.

mod agents;
mod beginning;
mod blocks;
mod descent;
mod forward;
mod kernel;
mod keys;
mod load;
mod norm;
mod parts;
mod reference;
mod settings;
mod state;
#[cfg(feature = "candle")]
mod tensor;
#[cfg(feature = "candle")]
mod tensor_agents;
#[cfg(feature = "candle")]
mod tensor_parts;
#[cfg(feature = "candle")]
mod tensor_windows;
mod tiles;
mod windows;

use realo_kernels::conv::{Bf16, Isa};
use realo_nn::layers::{FuseLayer, MapSize};
use realo_nn::model::{Problems, Sharing};
use realo_nn::tensors::TensorSpec;
use realo_nn::weights::Weights;
use serde_json::Value;

pub use beginning::initial_delays;
pub use parts::{Asking, Parts};
pub use reference::numbers_of;
pub use settings::{Settings, Window};

use crate::method::{Arithmetic, Descent, Fuse, Method};
#[cfg(feature = "candle")]
use crate::tensors::{self, Tensors};
use descent::Learner;
use kernel::Transformer;

impl Method for Settings {
    const NAME: &'static str = "v2xvit";
    const TITLE: &'static str = "V2X-ViT";
    const REFERENCE: Option<&'static str> = Some("PointPillarTransformer");

    fn sharing(&self) -> Sharing {
        Sharing {
            agents: self.agents,
            compression: self.compression,
            compress_own: self.compress_own,
        }
    }

    fn with_compression(self, compression: usize) -> Self {
        Settings { compression, ..self }
    }

    fn check(&self, map: MapSize, problems: &mut Problems) {
        self.note_problems(map, problems);
    }

    fn tensors(&self, channels: usize) -> Vec<TensorSpec> {
        keys::tensors(self, channels)
    }

    fn kernel(&self, layer: &FuseLayer, weights: &Weights, on: Arithmetic) -> Box<dyn Fuse> {
        match on.half {
            true => Box::new(Transformer::<Bf16>::new(self, layer.channels, weights, on.isa)),
            false => Box::new(Transformer::<f32>::new(self, layer.channels, weights, on.isa)),
        }
    }

    fn descent(&self, layer: &FuseLayer, weights: &Weights) -> Option<Box<dyn Descent>> {
        Some(Box::new(Learner::new(self, layer.channels, weights, Isa::detect())))
    }

    #[cfg(feature = "candle")]
    fn operation(
        &self,
        _: &FuseLayer,
        tensors: &Tensors,
        agents: &[tensors::Agent],
    ) -> candle_core::Result<candle_core::Tensor> {
        tensor::fuse(self, tensors, agents)
    }

    fn initial(&self, spec: &TensorSpec, normal: &mut dyn FnMut() -> f64) -> Vec<f32> {
        beginning::initial(spec, normal)
    }

    fn sides(&self) -> Vec<usize> {
        self.windows.iter().map(|window| window.side).collect()
    }

    fn of_reference(config: &Value, sharing: Sharing) -> Option<Result<Self, String>> {
        let of_transformer = [config, &config["transformer"]];
        let config = of_transformer
            .into_iter()
            .find(|config| !config["cav_att_config"].is_null())?;
        Some(reference::settings_of(config, sharing))
    }
}
