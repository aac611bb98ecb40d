//! Attention on tensors.

use candle_core::{D, Result, Tensor, bail};

use crate::tensors::Placed;
use crate::tensors::ops::softmax;

/// Attention of the ego, `[rows, columns, channels]`, with products scaled for `width` channels; the first map is the ego's.
pub fn attention(maps: &[Placed], width: usize) -> Result<Tensor> {
    let Some(ego) = maps.first() else {
        bail!("a fusion of no maps: expected the ego's at least");
    };
    let query = (&ego.map / (width as f64).sqrt())?;
    let score = |placed: &Placed| query.mul(&placed.map)?.sum_keepdim(D::Minus1)? + placed.absence()?;
    let scores = maps.iter().map(score).collect::<Result<Vec<Tensor>>>()?;
    let all: Vec<&Tensor> = maps.iter().map(|placed| &placed.map).collect();
    let weights = softmax(&Tensor::stack(&scores, 0)?, 0)?;
    Tensor::stack(&all, 0)?.broadcast_mul(&weights)?.sum(0)
}
