//! V2VNet: agents send each other messages before the ego detects (Wang et al. 2020), as V2X-Real builds it.

mod kernel;
mod keys;
#[cfg(feature = "candle")]
mod tensor;
mod unit;

use realo_nn::layers::{FuseLayer, MapSize};
use realo_nn::model::{Problems, Sharing};
use realo_nn::tensors::TensorSpec;
use realo_nn::weights::Weights;
use serde::{Deserialize, Serialize};
use serde_json::Value;

pub use unit::{GatedUnit, GatedUnitTensors};

use crate::method::{Arithmetic, Fuse, Method};
#[cfg(feature = "candle")]
use crate::tensors::{self, Tensors};
use kernel::Messages;
use realo_kernels::conv::Bf16;

/// Settings in a model file; those of V2X-Real by default.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Settings {
    /// Agents that are fused at most, the ego among them.
    pub agents: usize,
    /// How many times fewer channels cross than the map has; 0: all of them cross.
    pub compression: usize,
    /// Whether an agent's own map loses channels in its own fusion, too; if not, it is fused whole.
    pub compress_own: bool,
    /// How often all agents send.
    pub rounds: usize,
}

impl Default for Settings {
    fn default() -> Self {
        let Sharing {
            agents,
            compression,
            compress_own,
        } = Sharing::default();
        Settings {
            agents,
            compression,
            compress_own,
            rounds: 2,
        }
    }
}

impl Method for Settings {
    const NAME: &'static str = "v2vnet";
    const TITLE: &'static str = "V2VNet";
    const REFERENCE: Option<&'static str> = Some("PointPillarV2VNet");

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

    fn check(&self, _: MapSize, problems: &mut Problems) {
        problems.within("arch.rounds", self.rounds, 1, 16);
    }

    fn tensors(&self, channels: usize) -> Vec<TensorSpec> {
        keys::tensors(channels)
    }

    fn kernel(&self, layer: &FuseLayer, weights: &Weights, on: Arithmetic) -> Box<dyn Fuse> {
        let (rounds, channels) = (self.rounds, layer.channels);
        match on.half {
            true => Box::new(Messages::<Bf16>::new(rounds, channels, weights, on.isa)),
            false => Box::new(Messages::<f32>::new(rounds, channels, weights, on.isa)),
        }
    }

    #[cfg(feature = "candle")]
    fn operation(
        &self,
        _: &FuseLayer,
        tensors: &Tensors,
        agents: &[tensors::Agent],
    ) -> candle_core::Result<candle_core::Tensor> {
        tensor::fuse(self.rounds, tensors, agents)
    }

    fn of_reference(config: &Value, sharing: Sharing) -> Option<Result<Self, String>> {
        let rounds = [&config["iterations"], &config["v2vfusion"]["num_iteration"]];
        let rounds = rounds.into_iter().find_map(Value::as_u64)? as usize;
        Some(Ok(Settings {
            agents: sharing.agents,
            compression: sharing.compression,
            compress_own: sharing.compress_own,
            rounds,
        }))
    }
}
