//! Convolutions of maps `[1, channels, rows, columns]`, batch norm folded in.

use candle_core::{DType, Result, Tensor};
use realo_nn::layers::ConvLayer;
use realo_nn::weights::Weights;

use crate::tensors::Tensors;

/// A convolution that is ready to run.
#[derive(Clone, Debug)]
pub struct Convolution {
    layer: ConvLayer,
    weight: Tensor,
    /// `[1, outputs, 1, 1]`.
    bias: Tensor,
}

impl Convolution {
    /// A layer with its tensors; `weights` gives its batch norm.
    pub fn new(layer: &ConvLayer, tensors: &Tensors, weights: &Weights) -> Result<Self> {
        let weight = tensors.get(&layer.weight_key())?;
        let device = weight.device();
        let mut bias = match layer.bias_key() {
            Some(key) => tensors.get(&key)?.clone(),
            None => Tensor::zeros(layer.outputs, DType::F32, device)?,
        };
        let mut weight = weight.clone();
        if let Some(norm) = &layer.norm {
            let norm = weights.batch_norm(norm);
            let [factor, summand] = [0, 1].map(|part| {
                let numbers: Vec<f32> = norm.iter().map(|of_output| of_output[part] as f32).collect();
                Tensor::from_vec(numbers, layer.outputs, device)
            });
            let factor = factor?;
            let outputs = match layer.transposed {
                true => (1, layer.outputs, 1, 1),
                false => (layer.outputs, 1, 1, 1),
            };
            weight = weight.broadcast_mul(&factor.reshape(outputs)?)?;
            bias = ((bias * factor)? + summand?)?;
        }
        if layer.transposed {
            // [inputs, outputs * kernel * kernel] to [outputs * kernel * kernel, inputs].
            weight = weight.flatten_from(1)?.t()?.contiguous()?;
        } else if is_pointwise(layer) {
            weight = weight.flatten_from(1)?;
        }
        Ok(Convolution {
            layer: layer.clone(),
            weight: weight.to_dtype(tensors.products())?,
            bias: bias.reshape((1, layer.outputs, 1, 1))?.to_dtype(tensors.products())?,
        })
    }

    /// `[1, outputs, rows, columns]`.
    pub fn run(&self, map: &Tensor) -> Result<Tensor> {
        let (_, inputs, rows, columns) = map.dims4()?;
        let ConvLayer {
            outputs,
            kernel,
            stride,
            ..
        } = self.layer;
        let products = || self.weight.matmul(&map.reshape((inputs, rows * columns))?);
        let made = if self.layer.transposed {
            // The kernel is as wide as the stride: every output sees one cell.
            let made = products()?.reshape((outputs, kernel, kernel, rows, columns))?;
            let made = made.permute((0, 3, 1, 4, 2))?.contiguous()?;
            made.reshape((1, outputs, rows * stride, columns * stride))?
        } else if is_pointwise(&self.layer) {
            products()?.reshape((1, outputs, rows, columns))?
        } else {
            map.conv2d(&self.weight, kernel / 2, stride, 1, 1)?
        };
        let made = made.broadcast_add(&self.bias)?;
        if self.layer.relu { made.relu() } else { Ok(made) }
    }
}

/// Whether it is a product of matrices.
fn is_pointwise(layer: &ConvLayer) -> bool {
    (layer.kernel, layer.stride) == (1, 1)
}
