//! Weights as tensors of a device.

use std::collections::HashMap;

use candle_core::{DType, Device, Result, Tensor, bail};
use realo_nn::layers::Layers;
use realo_nn::weights::Weights;

/// Tensors by their keys in a state dict, all of f32 and on one device.
#[derive(Clone, Debug)]
pub struct Tensors {
    tensors: HashMap<String, Tensor>,
    /// Number type in which sums of products are computed.
    products: DType,
}

impl Tensors {
    /// Tensors whose products are computed in f32.
    pub fn new(tensors: HashMap<String, Tensor>) -> Self {
        Tensors {
            tensors,
            products: DType::F32,
        }
    }

    /// The weights of a network.
    ///
    /// # Errors
    /// Those of candle.
    ///
    /// # Panics
    /// If the weights are those of other layers.
    pub fn of(layers: &Layers, weights: &Weights, device: &Device) -> Result<Self> {
        let tensor = |(key, shape): (String, Vec<usize>)| {
            let tensor = Tensor::from_slice(weights.tensor(&key), shape, device)?;
            Ok((key, tensor))
        };
        let all = layers.tensors().map(|spec| tensor((spec.key, spec.shape)));
        Ok(Tensors::new(all.collect::<Result<_>>()?))
    }

    /// The same tensors, products computed in another type.
    pub fn with_products(self, products: DType) -> Self {
        Tensors { products, ..self }
    }

    /// Number type in which sums of products are computed.
    pub fn products(&self) -> DType {
        self.products
    }

    /// A tensor.
    ///
    /// # Errors
    /// If there is none of this key.
    pub fn get(&self, key: &str) -> Result<&Tensor> {
        match self.tensors.get(key) {
            Some(tensor) => Ok(tensor),
            None => bail!("there is no tensor `{key}`: expected those of the model's layers"),
        }
    }

    /// A linear layer on the last dimension of `[cells, inputs]`, with its biases if it has some.
    pub fn linear(&self, key: &str, from: &Tensor) -> Result<Tensor> {
        let bias = self.tensors.get(&format!("{key}.bias"));
        self.product(from, self.get(&format!("{key}.weight"))?, bias)
    }

    /// `from * weight^T + bias`, of `[cells, inputs]` and `[outputs, inputs]`.
    pub fn product(&self, from: &Tensor, weight: &Tensor, bias: Option<&Tensor>) -> Result<Tensor> {
        let (from, weight) = (from.to_dtype(self.products)?, weight.to_dtype(self.products)?);
        let made = from.matmul(&weight.t()?)?.to_dtype(DType::F32)?;
        match bias {
            Some(bias) => made.broadcast_add(bias),
            None => Ok(made),
        }
    }
}
