//! What computes a network: the kernels on this processor, or candle on a GPU. No operator knows which.

use realo_kernels::agents::Agent;
use realo_kernels::bev::{BevMap, BevView};
use realo_kernels::canvas::Canvas;
use realo_methods::Loaded;
use realo_methods::network::{Heads, Network, NetworkError};
use realo_operator::Steps;
use realo_schemas::Elements;
use serde::{Deserialize, Serialize};

/// The devices that a network may be computed on.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Device {
    /// This processor.
    #[default]
    Cpu,
    /// The first GPU that CUDA lists.
    Cuda,
}

/// Why there is no network, or no result.
#[derive(Debug, thiserror::Error)]
pub enum EngineError {
    /// The kernels, or what they were given.
    #[error(transparent)]
    Network(#[from] NetworkError),
    /// The build has no GPU.
    #[cfg(not(feature = "cuda"))]
    #[error(
        "setting `device`: this build has no cuda: expected cpu, or a build of `cargo build --release --features cuda -p realo`, \
         which needs the CUDA toolkit"
    )]
    NotBuilt,
    /// A number type that is not computed in on a GPU.
    #[cfg(feature = "cuda")]
    #[error("setting `precision`: on cuda, expected f32 or bf16, found int8 of model `{model}`: say precision=bf16")]
    Precision {
        /// The model's name.
        model: String,
    },
    /// No GPU, or none that its driver lets this process use.
    #[cfg(feature = "cuda")]
    #[error("setting `device`: expected a GPU that CUDA can use, or device=cpu; found: {0}")]
    NoDevice(candle_core::Error),
    /// The GPU, or what it was given.
    #[cfg(feature = "cuda")]
    #[error("cuda: {0}")]
    Device(#[from] realo_methods::candle::Error),
}

/// A network that is ready to run.
pub enum Engine {
    /// On this processor.
    Kernels(Network),
    /// On a GPU.
    #[cfg(feature = "cuda")]
    Candle(Box<realo_methods::candle::Engine>),
}

impl Engine {
    /// The network of a model on a device; `elements`: what maps that agents keep leave a GPU as. Where compressed ones are shared in their
    /// place, these leave it as f32.
    ///
    /// # Errors
    /// A device that is not there or that the build lacks, and a number type that it does not compute in.
    pub fn new(loaded: Loaded, device: Device, elements: Elements) -> Result<Self, EngineError> {
        match device {
            Device::Cpu => Ok(Engine::Kernels(loaded.network)),
            Device::Cuda => on_cuda(&loaded, elements),
        }
    }

    /// From the canvas to the BEV map that an agent keeps for its own fusion.
    ///
    /// # Errors
    /// Those of [`Network::encode_own`], and of the device.
    pub fn encode_own(&mut self, canvas: &Canvas, steps: &mut Steps) -> Result<BevMap, EngineError> {
        match self {
            Engine::Kernels(network) => of_kernels(network.encode_own(canvas), steps),
            #[cfg(feature = "cuda")]
            Engine::Candle(engine) => Ok(engine.encode_own(canvas, &mut Timed(steps))?),
        }
    }

    /// From the map that an agent keeps to the one that agents share; `None` if they are the same.
    ///
    /// # Errors
    /// Those of [`Network::share`], and of the device.
    pub fn share(&mut self, kept: BevView, steps: &mut Steps) -> Result<Option<BevMap>, EngineError> {
        match self {
            Engine::Kernels(network) => of_kernels(network.share(kept), steps),
            #[cfg(feature = "cuda")]
            Engine::Candle(engine) => Ok(engine.share(kept, &mut Timed(steps))?),
        }
    }

    /// How sure the heads are of each cell of a map that agents share, see [`Network::confidence`].
    ///
    /// # Errors
    /// Those of [`Network::confidence`], and of the device.
    pub fn confidence(&mut self, map: BevView, steps: &mut Steps) -> Result<Vec<f32>, EngineError> {
        match self {
            Engine::Kernels(network) => of_kernels(network.confidence(map), steps),
            #[cfg(feature = "cuda")]
            Engine::Candle(engine) => Ok(engine.confidence(map, &mut Timed(steps))?),
        }
    }

    /// From the maps that agents share, the ego's first, to the one that the heads read.
    ///
    /// # Errors
    /// Those of [`Network::fuse`], and of the device.
    pub fn fuse(&mut self, agents: &[Agent], steps: &mut Steps) -> Result<BevMap, EngineError> {
        match self {
            Engine::Kernels(network) => of_kernels(network.fuse(agents), steps),
            #[cfg(feature = "cuda")]
            Engine::Candle(engine) => Ok(engine.fuse(agents, &mut Timed(steps))?),
        }
    }

    /// Scores and deltas of one shared map without fusion. They stay until the next call.
    ///
    /// # Errors
    /// Those of [`Network::heads_alone`], and of the device.
    pub fn heads_alone(&mut self, map: BevView, steps: &mut Steps) -> Result<&Heads, EngineError> {
        match self {
            Engine::Kernels(network) => of_kernels(network.heads_alone(map), steps),
            #[cfg(feature = "cuda")]
            Engine::Candle(engine) => Ok(engine.heads_alone(map, &mut Timed(steps))?),
        }
    }

    /// From a BEV map to the heads, which stay until the next one.
    ///
    /// # Errors
    /// Those of [`Network::heads`], and of the device.
    pub fn heads(&mut self, map: BevView, steps: &mut Steps) -> Result<&Heads, EngineError> {
        match self {
            Engine::Kernels(network) => of_kernels(network.heads(map), steps),
            #[cfg(feature = "cuda")]
            Engine::Candle(engine) => Ok(engine.heads(map, &mut Timed(steps))?),
        }
    }
}

/// Times the steps of a device for the stage.
#[cfg(feature = "cuda")]
struct Timed<'a>(&'a mut Steps);

#[cfg(feature = "cuda")]
impl realo_methods::candle::Watch for Timed<'_> {
    fn step(&mut self, name: &'static str, work: &mut dyn FnMut()) {
        self.0.time(name, work);
    }
}

/// Kernels have no steps that are worth a name: their call is the stage's.
fn of_kernels<T>(made: Result<T, NetworkError>, _: &mut Steps) -> Result<T, EngineError> {
    Ok(made?)
}

#[cfg(not(feature = "cuda"))]
fn on_cuda(_: &Loaded, _: Elements) -> Result<Engine, EngineError> {
    Err(EngineError::NotBuilt)
}

#[cfg(feature = "cuda")]
fn on_cuda(loaded: &Loaded, elements: Elements) -> Result<Engine, EngineError> {
    use candle_core::{DType, Device};
    use realo_methods::candle;
    use realo_nn::model::Precision;

    let products = match loaded.precision {
        Precision::F32 => DType::F32,
        Precision::Bf16 => DType::BF16,
        Precision::Int8 => {
            let model = loaded.model.name.clone();
            return Err(EngineError::Precision { model });
        }
    };
    let crossing = match elements {
        Elements::F32 => candle::Elements::F32,
        Elements::F16 => candle::Elements::F16,
        Elements::Int8 => candle::Elements::Int8,
    };
    let device = Device::new_cuda(0).map_err(EngineError::NoDevice)?;
    let engine = candle::Engine::new(&loaded.model, &loaded.weights, &device, products, crossing)?;
    Ok(Engine::Candle(Box::new(engine)))
}

#[cfg(all(test, not(feature = "cuda")))]
mod tests {
    use super::*;

    #[test]
    fn a_build_without_cuda_says_how_to_build_one_that_has_it() {
        let lite = concat!(env!("CARGO_MANIFEST_DIR"), "/../../models/lite.toml");
        let loaded = realo_methods::load(lite.as_ref(), realo_methods::Kernels::auto(1)).unwrap();
        let error = Engine::new(loaded, Device::Cuda, Elements::Int8)
            .err()
            .expect("refused");
        let error = error.to_string();
        assert!(
            error.contains("`device`") && error.contains("--features cuda"),
            "{error}"
        );
    }
}
