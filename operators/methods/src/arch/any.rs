//! Methods whose type is known only when a model file is read.

use std::any::Any;
use std::fmt;
use std::sync::Arc;

use realo_nn::layers::{FuseLayer, MapSize};
use realo_nn::model::{Problems, Sharing};
use realo_nn::tensors::TensorSpec;
use realo_nn::weights::Weights;
use serde_json::{Map, Value};

use crate::method::{Arithmetic, Descent, Fuse, Method};
#[cfg(feature = "candle")]
use crate::tensors::{self, Tensors};

/// A [`Method`] of any type; its functions are those of the trait.
#[allow(missing_docs)]
pub trait AnyMethod: fmt::Debug + Send + Sync {
    fn name(&self) -> &'static str;
    fn title(&self) -> &'static str;
    fn sharing(&self) -> Sharing;
    fn with_compression(&self, compression: usize) -> Arc<dyn AnyMethod>;
    fn check(&self, map: MapSize, problems: &mut Problems);
    fn tensors(&self, channels: usize) -> Vec<TensorSpec>;
    fn kernel(&self, layer: &FuseLayer, weights: &Weights, on: Arithmetic) -> Box<dyn Fuse>;
    #[cfg(feature = "candle")]
    fn operation(
        &self,
        layer: &FuseLayer,
        tensors: &Tensors,
        agents: &[tensors::Agent],
    ) -> candle_core::Result<candle_core::Tensor>;
    fn descent(&self, layer: &FuseLayer, weights: &Weights) -> Option<Box<dyn Descent>>;
    fn initial(&self, spec: &TensorSpec, normal: &mut dyn FnMut() -> f64) -> Vec<f32>;
    fn sides(&self) -> Vec<usize>;

    /// The settings in a model file, in their order.
    fn settings(&self) -> Map<String, Value>;

    /// The settings by their type.
    fn as_any(&self) -> &dyn Any;

    /// Whether it is of the same type, with the same settings.
    fn equals(&self, other: &dyn AnyMethod) -> bool;
}

impl<M: Method> AnyMethod for M {
    fn name(&self) -> &'static str {
        M::NAME
    }

    fn title(&self) -> &'static str {
        M::TITLE
    }

    fn sharing(&self) -> Sharing {
        Method::sharing(self)
    }

    fn with_compression(&self, compression: usize) -> Arc<dyn AnyMethod> {
        Arc::new(Method::with_compression(self.clone(), compression))
    }

    fn check(&self, map: MapSize, problems: &mut Problems) {
        Method::check(self, map, problems);
    }

    fn tensors(&self, channels: usize) -> Vec<TensorSpec> {
        Method::tensors(self, channels)
    }

    fn kernel(&self, layer: &FuseLayer, weights: &Weights, on: Arithmetic) -> Box<dyn Fuse> {
        Method::kernel(self, layer, weights, on)
    }

    #[cfg(feature = "candle")]
    fn operation(
        &self,
        layer: &FuseLayer,
        tensors: &Tensors,
        agents: &[tensors::Agent],
    ) -> candle_core::Result<candle_core::Tensor> {
        Method::operation(self, layer, tensors, agents)
    }

    fn descent(&self, layer: &FuseLayer, weights: &Weights) -> Option<Box<dyn Descent>> {
        Method::descent(self, layer, weights)
    }

    fn initial(&self, spec: &TensorSpec, normal: &mut dyn FnMut() -> f64) -> Vec<f32> {
        Method::initial(self, spec, normal)
    }

    fn sides(&self) -> Vec<usize> {
        Method::sides(self)
    }

    fn settings(&self) -> Map<String, Value> {
        match serde_json::to_value(self) {
            Ok(Value::Object(settings)) => settings,
            _ => unreachable!("settings of `{}` are a struct of plain fields", M::NAME),
        }
    }

    fn as_any(&self) -> &dyn Any {
        self
    }

    fn equals(&self, other: &dyn AnyMethod) -> bool {
        other.as_any().downcast_ref::<M>() == Some(self)
    }
}
