//! What a method of fusion is: how the maps of several agents become one.

use std::collections::BTreeMap;
use std::fmt;

use realo_kernels::agents::Agent;
use realo_kernels::by_cell::{CellDescent, CellFusion, descend, fuse};
use realo_kernels::conv::{Isa, Pool};
use realo_nn::layers::{FuseLayer, MapSize};
use realo_nn::model::{Problems, Sharing};
use realo_nn::tensors::{Role, TensorSpec};
use realo_nn::weights::Weights;
use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::Value;

#[cfg(feature = "candle")]
use crate::tensors::{self, Tensors};

/// A method of fusion, by its settings: what a model file says under `arch`, next to `kind`.
///
/// A folder holds all of a method, and a line of [`METHODS`](crate::METHODS) makes it known.
pub trait Method:
    Clone + fmt::Debug + Default + PartialEq + Serialize + DeserializeOwned + Send + Sync + 'static
{
    /// Its name in model files: `arch.kind`.
    const NAME: &'static str;

    /// Its name in texts.
    const TITLE: &'static str;

    /// The class of its network in V2X-Real's code, where there is one.
    const REFERENCE: Option<&'static str> = None;

    /// How agents share their maps.
    fn sharing(&self) -> Sharing;

    /// The same with another [`Sharing::compression`].
    fn with_compression(self, compression: usize) -> Self;

    /// Notes which settings do not fit; `map`: rows, columns and channels of the map that is fused.
    fn check(&self, _map: MapSize, _problems: &mut Problems) {}

    /// Its tensors on maps of so many channels, in the order of the state dict.
    fn tensors(&self, _channels: usize) -> Vec<TensorSpec> {
        Vec::new()
    }

    /// The fusion on this processor; `weights` hold its tensors.
    fn kernel(&self, layer: &FuseLayer, weights: &Weights, on: Arithmetic) -> Box<dyn Fuse>;

    /// The fusion on candle's tensors, `[rows, columns, channels]`; the first agent is the ego. Gradients lead back through it
    /// to its tensors.
    ///
    /// # Errors
    /// Those of candle; a tensor or an agent that is missing.
    #[cfg(feature = "candle")]
    fn operation(
        &self,
        layer: &FuseLayer,
        tensors: &Tensors,
        agents: &[tensors::Agent],
    ) -> candle_core::Result<candle_core::Tensor>;

    /// The fusion in training, of one that leads gradients back itself; else [`Method::operation`] does. `weights` hold its
    /// tensors.
    fn descent(&self, _layer: &FuseLayer, _weights: &Weights) -> Option<Box<dyn Descent>> {
        None
    }

    /// The numbers that a tensor has when training begins; `normal` draws from a normal distribution of deviation 1.
    fn initial(&self, spec: &TensorSpec, normal: &mut dyn FnMut() -> f64) -> Vec<f32> {
        initial(spec, normal)
    }

    /// Cells of a map that lie in one piece along each side: parts of maps are cut between such pieces.
    fn sides(&self) -> Vec<usize> {
        Vec::new()
    }

    /// The method as the configuration of a conformance vector describes it; `None` if it describes another one.
    ///
    /// # Errors
    /// What of the configuration is missing or of another type.
    fn of_reference(_config: &Value, _sharing: Sharing) -> Option<Result<Self, String>> {
        None
    }
}

/// Numbers and instructions of a kernel.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Arithmetic {
    /// Instructions.
    pub isa: Isa,
    /// Whether maps are computed in bf16 instead of f32.
    pub half: bool,
}

/// A fusion that is ready to run.
pub trait Fuse: Send + Sync {
    /// The fused map, `[rows, columns, channels]`, of agents' maps of one size, the ego's first.
    fn run(&self, agents: &[Agent], pool: &mut Pool) -> Vec<f32>;
}

/// A fusion that looks at one cell at a time.
pub struct ByCell<F>(pub F);

impl<F: CellFusion + Send> Fuse for ByCell<F> {
    fn run(&self, agents: &[Agent], pool: &mut Pool) -> Vec<f32> {
        fuse(&self.0, agents, pool)
    }
}

/// A fusion that leads gradients back to agents' maps and its tensors.
pub trait Descent: Send + Sync {
    /// The fused map, as [`Fuse::run`] gives it, and the way back from it.
    fn run(&self, agents: &[Agent], pool: &mut Pool) -> (Vec<f32>, Back);
}

/// Leads the gradient of a fused map back, given the same agents again.
pub type Back = Box<dyn FnOnce(&[Agent], &[f32], &mut Pool) -> Gradients + Send>;

/// The gradients of what a map was fused of.
#[derive(Clone, Debug, PartialEq)]
pub struct Gradients {
    /// Of the maps, the ego's first.
    pub maps: Vec<Vec<f32>>,
    /// Of the tensors that took part, by their keys.
    pub tensors: BTreeMap<String, Vec<f32>>,
}

impl<F: CellDescent + Clone + Send + 'static> Descent for ByCell<F> {
    fn run(&self, agents: &[Agent], pool: &mut Pool) -> (Vec<f32>, Back) {
        let fusion = self.0.clone();
        let back = move |agents: &[Agent], gradient: &[f32], pool: &mut Pool| Gradients {
            maps: descend(&fusion, agents, gradient, pool),
            tensors: BTreeMap::new(),
        };
        (fuse(&self.0, agents, pool), Box::new(back))
    }
}

/// Numbers of a tensor that keep the size of what passes through its layer, and norms that change nothing.
pub fn initial(spec: &TensorSpec, normal: &mut dyn FnMut() -> f64) -> Vec<f32> {
    let count = spec.count();
    match spec.role {
        Role::Weight { fan_in } => {
            let deviation = (1.0 / fan_in as f64).sqrt();
            (0..count).map(|_| (deviation * normal()) as f32).collect()
        }
        // A table whose rows are added begins as none.
        Role::Delays => vec![0.0; count],
        Role::NormWeight | Role::RunningVariance => vec![1.0; count],
        Role::Bias | Role::NormBias | Role::RunningMean => vec![0.0; count],
    }
}
